"""Fit the built-in head's mean and shape directions to people.

`ict_registration` registers the generator's mesh to ICT-FaceKit's mean face (USC Institute for
Creative Technologies, MIT licence). So every vertex has a place there that moves with each identity
of the published model, whose coefficients are independent with unit variance. The mean and the
principal directions of these people and their mirror images are kept. Units are millimetres in the
head space of `field`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
import scipy.sparse as sparse
from scipy.interpolate import RBFInterpolator
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from express50.geometry.meshes import edge_graph
from express50.geometry.raycast import mesh_scene
from express50.head.generator.expressions import LID_SHARE
from express50.head.generator.field import EYE_CENTER, EYE_RADIUS
from express50.head.generator.ict_registration import (
    FLAT,
    FLIP,
    NORMAL_MM,
    IctSkin,
    hidden_vertices,
    ict_skin,
    register_skin,
    sample_skin,
    warp_between,
)
from express50.head.generator.mesh import WholeMesh, is_skin
from express50.head.ict import RANGES, IctArrays, read_ict_npz
from express50.head.model import normals_of

Array = np.ndarray

KEPT_VARIANCE = 0.995
LID_MM = 13.2  # least distance of a lid from its eyeball's centre
TOOTH_GAP_MM = 5.0  # from the meeting lips back to the incisors


@dataclass(frozen=True)
class People:
    """Mean (V, 3), shape directions (V, 3, K) of one standard deviation, joints (3, 3); mm."""

    mean: Array
    directions: Array
    joints: Array  # collar, upper neck, jaw hinge of the mean


def fit_people(mesh: WholeMesh, joints: Array, ict: Path) -> People:
    """Fit the mean head and its directions to ICT-FaceKit's people, an .npz of its arrays.

    `joints` (3, 3) are those of the generator's mesh.

    Raises:
        HeadModelError: the file is damaged or holds something else.
    """
    arrays = read_ict_npz(ict)
    skin = ict_skin(arrays)
    own = np.unique(mesh.faces[is_skin(mesh)])
    warp = warp_between(mesh, skin)
    laid = register_skin(mesh, skin, own, warp)
    points = warp(mesh.vertices)
    points[own] = laid
    moves = _skin_moves(mesh, skin, arrays, points, own)
    points, moves = _fill_inside(mesh, arrays, warp, points, moves)
    points, moves, centre = _seat_eyes(mesh, arrays, points, moves)
    shift = (EYE_CENTER - centre) * FLAT
    mean = 0.5 * (points + points[mesh.mirror] * FLIP) + shift
    return People(mean, principal_directions(moves, mesh.mirror), warp(joints) * FLAT + shift)


def principal_directions(moves: Array, mirror: Array) -> Array:
    """Return principal directions (V, 3, K) of people (V, 3, N) and of their mirror images."""
    other = moves[mirror] * FLIP[:, None]
    # Symmetric and antisymmetric motions are uncorrelated, so each direction is one or the other.
    kinds = [0.5 * (moves + sign * other) for sign in (1.0, -1.0)]
    found, spread = [], []
    for kind in kinds:
        flat = kind.reshape(-1, kind.shape[-1])
        values, vectors = np.linalg.eigh(flat.T @ flat)
        found.append(flat @ vectors)
        spread.append(np.maximum(values, 0.0))
    order = np.argsort(-np.concatenate(spread), kind="stable")
    share = np.cumsum(np.concatenate(spread)[order]) / np.sum(spread)
    kept = order[: int(np.searchsorted(share, KEPT_VARIANCE)) + 1]
    directions = np.concatenate(found, axis=1)[:, kept]
    # The largest entry is made positive, so that all machines give the same signs.
    largest = directions[np.abs(directions).argmax(0), np.arange(len(kept))]
    return (directions * np.sign(largest)).reshape(*moves.shape[:2], -1)


def _skin_moves(
    mesh: WholeMesh, skin: IctSkin, arrays: IctArrays, points: Array, own: Array
) -> Array:
    """Return how every vertex (V, 3, 100) moves with ICT's identities; 0 off the skin `own`."""
    faces = mesh.faces[is_skin(mesh)]
    normals = normals_of(points, faces)[own]
    sample = sample_skin(skin)
    tree = cKDTree(np.concatenate([sample.places, NORMAL_MM * sample.normals], axis=1))
    nearest = tree.query(np.concatenate([points[own], NORMAL_MM * normals], axis=1))[1]
    corners, weights = sample.corners[nearest], sample.weights[nearest]
    found = 10.0 * np.einsum("nk,nkcs->ncs", weights, arrays.shape_dirs[corners])
    far = np.linalg.norm(sample.places[nearest] - points[own], axis=1) > 4.0
    alike = (sample.normals[nearest] * normals).sum(1) > 0.3
    known = ~far & alike & ~np.isin(own, hidden_vertices(mesh))
    # Unknown moves are filled in from those around, as heat spreads.
    index = np.full(len(points), -1)
    index[own] = np.arange(len(own))
    links = edge_graph(index[faces], len(own))
    laplacian = sparse.diags(np.asarray(links.sum(1)).ravel()) - links
    free, flat = np.flatnonzero(~known), found.reshape(len(own), -1).astype(np.float64)
    right = -laplacian[free][:, known] @ flat[known]
    flat[free] = splu(laplacian[free][:, free].tocsc()).solve(right)
    moves = np.zeros((*points.shape, found.shape[-1]))
    moves[own] = flat.reshape(found.shape)
    for row in (mesh.tag("lip0", side) for side in ("left", "right")):
        moves[row] = 0.5 * (moves[row] + moves[row[::-1]])  # the lips meet in all people
    return moves


def _fill_inside(
    mesh: WholeMesh, arrays: IctArrays, warp: RBFInterpolator, points: Array, moves: Array
) -> tuple[Array, Array]:
    """Put teeth, gums and tongue behind the lips as one piece, and the mouth's walls around."""
    names = ("upper_teeth", "lower_teeth", "upper_gums", "lower_gums", "tongue")
    hard = np.unique(np.concatenate([mesh.tag(name) for name in names]))
    own = mesh.vertices[hard]
    warped = warp(own)
    centred, target = own - own.mean(0), warped - warped.mean(0)
    scale = float(np.sqrt((target**2).sum() / (centred**2).sum()))
    placed = scale * centred + warped.mean(0) * [0, 1, 1]
    slit = points[mesh.tag("lip0", "left")[0]]
    teeth = np.isin(hard, np.r_[mesh.tag("upper_teeth"), mesh.tag("lower_teeth")])
    placed[:, 2] += slit[2] - TOOTH_GAP_MM - placed[teeth, 2].max()
    placed[:, 1] += slit[1] - warp(mesh.vertices[mesh.tag("lip0", "left")[:1]])[0, 1]
    points[hard] = placed
    # People's jaws differ by affine motions, which are fitted to ICT's teeth.
    number = slice(RANGES["upper_teeth"][0], RANGES["lower_teeth"][1])
    there = np.pad(10.0 * arrays.template[number], ((0, 0), (0, 1)), constant_values=1.0)
    motion = 10.0 * arrays.shape_dirs[number].reshape(len(there), -1)
    affine = np.linalg.lstsq(there, motion, rcond=None)[0]
    inside = np.r_[hard, mesh.tag("cavity")]
    at = np.pad(points[inside], ((0, 0), (0, 1)), constant_values=1.0)
    moves[inside] = (at @ affine).reshape(len(inside), 3, -1)
    for side in ("left", "right"):
        lip = mesh.tag("lip0", side)
        bent = points[lip] - warp(mesh.vertices[lip])
        for depth in range(7):
            ring, share = mesh.tag(f"cavity{depth}", side), max(0.0, 1.0 - depth / 4.0)
            points[ring] = warp(mesh.vertices[ring]) + share * bent
            moves[ring] += share * (moves[lip] - moves[ring])
    points = _sink(mesh, points)
    for side in ("left", "right"):  # the backs of the lips are behind them as drawn by rule
        lip, back = mesh.tag("lip0", side), mesh.tag("cavity0", side)
        points[back] = points[lip] + mesh.vertices[back] - mesh.vertices[lip]
    return points, moves


def _sink(mesh: WholeMesh, points: Array) -> Array:
    """Return points (V, 3) with gums and the mouth's walls well under the skin."""
    scene = mesh_scene(points, mesh.faces[is_skin(mesh)])
    parts = [(mesh.tag(f"cavity{k}"), 5.0) for k in range(1, 7)]
    parts += [(mesh.tag(f"{row}_gums"), 6.0) for row in ("upper", "lower")]
    for ids, depth in parts:
        for _ in range(5):
            at = o3d.core.Tensor(points[ids].astype(np.float32))
            nearest = scene.compute_closest_points(at)
            away = points[ids] - nearest["points"].numpy()
            outward = nearest["primitive_normals"].numpy()
            under = -(away * outward).sum(1)
            points[ids] -= np.maximum(depth - under, 0.0)[:, None] * outward
    return points


def _seat_eyes(
    mesh: WholeMesh, arrays: IctArrays, points: Array, moves: Array
) -> tuple[Array, Array, Array]:
    """Put the eyeballs behind the lids, and the lids around them; also return the left centre."""
    ball = slice(*RANGES["left_eyeball"])
    centre = 10.0 * arrays.template[ball].mean(0)
    lids = points[np.concatenate([mesh.tag(f"lid{k}", "left") for k in range(3)])] - centre
    # On the axis of ICT's eyeball, as far forward as the lids' thickness allows.
    inner = np.sqrt(np.maximum(LID_MM**2 - (lids[:, :2] ** 2).sum(1), 0.0))
    wide = (lids[:, :2] ** 2).sum(1) < 0.8 * LID_MM**2
    centre[2] += np.median((lids[:, 2] - inner)[wide])
    for side, mirror in (("left", 1.0), ("right", -1.0)):
        middle = centre * [mirror, 1, 1]
        eyeball = mesh.tag("eyeball", side)
        points[eyeball] = mesh.vertices[eyeball] - EYE_CENTER * [mirror, 1, 1] + middle
        rigid = 10.0 * arrays.shape_dirs[slice(*RANGES[f"{side}_eyeball"])].mean(0)
        moves[eyeball] = rigid
        for k, share in enumerate(LID_SHARE):
            ring = mesh.tag(f"lid{k}", side)
            away = points[ring] - middle
            length = np.linalg.norm(away, axis=1, keepdims=True)
            away /= length
            points[ring] += np.maximum(LID_MM - length, 0.0) * away
            # Lids keep their distance from the eyeball.
            radial = np.einsum("nc,ncs->ns", away, moves[ring] - rigid)
            moves[ring] -= (1.0 - share) * away[..., None] * radial[:, None]
        margin = points[mesh.tag("lid0", side)] - middle
        edge = margin * (EYE_RADIUS + 0.15) / np.linalg.norm(margin, axis=1, keepdims=True)
        own_edge, own_hidden = (
            mesh.vertices[mesh.tag(t, side)] for t in ("lid_edge", "lid_hidden")
        )
        hidden = edge + own_hidden - own_edge
        hidden *= (EYE_RADIUS + 0.2) / np.linalg.norm(hidden, axis=1, keepdims=True)
        for tag, place in (("lid_edge", edge), ("lid_hidden", hidden)):
            points[mesh.tag(tag, side)] = middle + place
            moves[mesh.tag(tag, side)] = moves[mesh.tag("lid0", side)]
    return points, moves, centre
