"""Register the generator's mesh to ICT-FaceKit's mean face, for `people`.

Landmarks are put on landmarks, and lids, lips and ears along their rims. The rest is registered by
non-rigid ICP with normals (after Amberg, Romdhani and Vetter 2007). Units are millimetres in the
head space of `field`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.interpolate import PchipInterpolator, RBFInterpolator
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import LinearOperator, cg, splu
from scipy.spatial import cKDTree

from express50.geometry.meshes import cotangent_laplacian, edge_graph, open_edges
from express50.geometry.transforms import unit
from express50.head.generator.features import LID_SEGMENTS
from express50.head.generator.mesh import WholeMesh, is_skin
from express50.head.generator.regions import embed_landmarks
from express50.head.ict import LANDMARKS, RANGES, IctArrays
from express50.head.model import normals_of

Array = np.ndarray

FLIP, FLAT = np.array([-1.0, 1.0, 1.0]), np.array([0.0, 1.0, 1.0])  # mirrored; on the mid plane
LIDS, LIPS = range(36, 48), range(60, 68)  # landmarks that rims replace
FREE = [k for k in range(68) if k not in (*LIDS, *LIPS)]  # the others
# Edges from the open ends of ICT's skin to the lids' margins, and to where closed lips meet.
MARGIN_RING, SLIT_RINGS = 2, (7, 8)
# The left ear's rim from the helix's root over the top to the lobe and up the front edge, (y, z) mm
# in ICT's own space and in the generator's; read off pictures of both.
ICT_EAR = np.array([
    (25.4, 12.8), (30.4, 10.6), (33.9, 6.8), (36.1, -1.8), (32.8, -10.3), (25.4, -15.3),
    (18.4, -16.5), (9.3, -15.9), (1.3, -13.3), (-4.7, -9.7), (-11.3, -4.2), (-16.2, 1.8),
    (-19.4, 8.8), (-20.4, 15.4), (-17.4, 18.3), (-7.7, 15.9), (-1.7, 14.2), (6.3, 12.8),
    (16.4, 10.8), (25.4, 12.8),
])  # fmt: skip
OWN_EAR = np.array([
    (11.8, -6.2), (25.9, -12.6), (31.9, -17.2), (36.3, -26.2), (32.9, -35.3), (24.9, -40.7),
    (19.9, -41.5), (12.8, -40.3), (2.8, -36.3), (-8.3, -28.3), (-14.3, -22.6), (-19.3, -17.2),
    (-21.9, -12.6), (-22.3, -8.2), (-18.7, -3.8), (-12.3, -3.1), (-4.2, -3.4), (4.8, -4.6),
    (9.0, -5.5), (11.8, -6.2),
])  # fmt: skip
RIM_POINTS, LOBE = 40, 14  # points in a row of the ear; the tables' last row before the front edge
STIFFNESS = np.geomspace(3000.0, 2.0, 24)  # per round
EAR_FIRMNESS = 20.0
NORMAL_MM = 6.0  # distance that is as bad as a unit of difference between normals


@dataclass(frozen=True)
class RimTargets:
    """Goals of vertices: ids (N,), goals (N, 3), weights (N,)."""

    ids: Array
    goals: Array
    weights: Array


@dataclass(frozen=True)
class IctSkin:
    """ICT's mean skin: all vertices (N, 3) mm, its faces, normals, edges, and its open ends."""

    points: Array
    faces: Array
    normals: Array
    edges: sparse.csr_matrix
    ends: Array

    @property
    def marks(self) -> Array:
        """Return the 68 landmarks (68, 3)."""
        return self.points[list(LANDMARKS)]

    def ring(self, marks: Array, steps: tuple[int, ...]) -> Array:
        """Return the vertices that are `steps` edges from the open end inside some landmarks."""
        ends = self.ends[np.linalg.norm(self.points[self.ends] - marks.mean(0), axis=1) < 35]
        far = dijkstra(self.edges, indices=ends, unweighted=True, min_only=True)
        return self.points[np.isin(far, steps)]


def ict_skin(arrays: IctArrays) -> IctSkin:
    """Return the skin of ICT's mean face, without mouth and eye sockets and what is in them."""
    points = 10.0 * arrays.template
    faces = arrays.faces[(arrays.faces < RANGES["mouth_socket"][0]).all(1)]
    graph, ends = edge_graph(faces, len(points)), np.unique(open_edges(faces))
    return IctSkin(points, faces, normals_of(points, faces), graph, ends)


def rim_targets(mesh: WholeMesh, skin: IctSkin) -> RimTargets:
    """Return the goals of lids, lips and ears of both sides along ICT's."""
    rows = [
        (mesh.tag("lid0", "left"), _lid_margin(skin), 4.0),
        (mesh.tag("lip0", "left"), _slit(mesh, skin), 4.0),
        (*_ear_rim(mesh, skin), 0.5),
    ]
    ids = np.concatenate([np.concatenate([row, mesh.mirror[row]]) for row, _, _ in rows])
    goals = np.concatenate([np.concatenate([goal, goal * FLIP]) for _, goal, _ in rows])
    return RimTargets(ids, goals, np.concatenate([np.full(2 * len(r), w) for r, _, w in rows]))


def _lid_margin(skin: IctSkin) -> Array:
    """Return the left lid margin (40, 3): upper lid outwards, lower lid back, as in `features`."""
    marks = skin.marks
    inner, outer = marks[42], marks[45]
    ring = skin.ring(marks[42:48], (MARGIN_RING,))
    ring = ring[ring[:, 0] > 0]
    line = inner + (ring[:, :1] - inner[0]) / (outer[0] - inner[0]) * (outer - inner)
    x = inner[0] + (0.5 - 0.5 * np.cos(np.linspace(0, np.pi, LID_SEGMENTS + 1))) * (
        outer[0] - inner[0]
    )
    lids = []
    for part in (ring[ring[:, 1] > line[:, 1]], ring[ring[:, 1] <= line[:, 1]]):
        row = np.concatenate([[inner], part[np.argsort(part[:, 0])], [outer]])
        row = row[np.r_[True, np.diff(row[:, 0]) > 0.05]]
        lids.append(np.column_stack([x, PchipInterpolator(row[:, 0], row[:, 1:])(x)]))
    return np.concatenate([lids[0], lids[1][-2:0:-1]])


def _slit(mesh: WholeMesh, skin: IctSkin) -> Array:
    """Return the goals of the left half of the lips' loop, where upper and lower lip meet."""
    around = skin.ring(skin.marks[60:68], SLIT_RINGS)
    corner, out = skin.marks[64], np.abs(around[:, 0])
    bins = np.arange(0.0, 21.2, 1.5)
    rows = [np.r_[x, around[np.abs(out - x) < 0.9, 1:].mean(0)] for x in bins]
    curve = np.array([*rows, corner])
    own = mesh.vertices[mesh.tag("lip0", "left")]
    x = own[:, 0] / own[:, 0].max() * corner[0]
    goal = np.column_stack([x, PchipInterpolator(curve[:, 0], curve[:, 1:])(x)])
    sign = np.r_[np.ones(len(own) // 2), 0.0, -np.ones(len(own) // 2)]
    goal[:, 1] += 0.05 * sign
    return goal - [0.0, 0.0, 0.6]  # they meet slightly behind the crease


def _ear_rim(mesh: WholeMesh, skin: IctSkin) -> tuple[Array, Array]:
    """Return vertices of the left ear's rim, and their goals.

    Along the front edge, where the ear meets the cheek, the rows from foot to rim have goals too.
    """
    ear = mesh.tag("ear", "left")
    rows = [mesh.tag("ear_foot", "left"), *ear[: 4 * RIM_POINTS].reshape(4, RIM_POINTS)]
    places = cKDTree(mesh.vertices[rows[-1]][:, 1:]).query(OWN_EAR)[1].astype(float)
    places[0] -= RIM_POINTS  # the row starts after the helix's root
    places[1:] = np.maximum.accumulate(places[1:])
    side = skin.points[np.unique(skin.faces)]
    side = side[side[:, 0] > 62]
    near = cKDTree(side[:, 1:]).query_ball_point(ICT_EAR, 2.5)
    goals = np.column_stack([[side[ids, 0].max() for ids in near], ICT_EAR])
    steps = np.arange(places[0], places[-1] + 1)
    columns = steps.astype(int) % RIM_POINTS
    along = np.column_stack([np.interp(steps, places, goals[:, k]) for k in range(3)])
    front = steps > places[LOBE + 2]
    ids, found = [rows[-1][columns]], [along]
    for row, ahead in zip(rows[:-1], (2.0, 1.4, 0.8, 0.3), strict=True):
        ids.append(row[columns[front]])
        found.append(along[front] + [-0.4 * ahead, 0.0, ahead])
    return np.concatenate(ids), np.concatenate(found)


def warp_between(mesh: WholeMesh, skin: IctSkin) -> RBFInterpolator:
    """Return a smooth warp of space from the generator's head to ICT's, by landmarks and rims."""
    targets = rim_targets(mesh, skin)
    faces, weights = embed_landmarks(mesh)
    own = (mesh.vertices[mesh.faces[faces]] * weights[..., None]).sum(1)
    body, other = (
        _outer_points(points, chin)
        for points, chin in (
            (mesh.vertices[np.unique(mesh.faces[is_skin(mesh)])], own[8, 1]),
            (skin.points[np.unique(skin.faces)], skin.marks[8, 1]),
        )
    )
    here = np.concatenate([mesh.vertices[targets.ids], own[FREE], body])
    there = np.concatenate([targets.goals, skin.marks[FREE], other])
    once = np.unique(here.round(3), axis=0, return_index=True)[1]
    return RBFInterpolator(here[once], there[once], kernel="thin_plate_spline", smoothing=5.0)


def _outer_points(points: Array, chin: float) -> Array:
    """Return points (N, 3) of a head's skin: crown, occiput and around the neck."""
    x, y, z = points.T
    middle = np.abs(x) < 6
    found = [points[np.argmax(y)], points[np.argmin(np.where(np.abs(y - 30) < 12, z, np.inf))]]
    for below in (40, 70):
        level = np.where((np.abs(y - chin + below) < 7) & middle, 1.0, np.nan)
        found += [points[np.nanargmax(sign * z * level)] * FLAT for sign in (1, -1)]
    level = np.where((np.abs(y - chin + 40) < 7) & (np.abs(z + 15) < 12), 1.0, np.nan)
    beside = points[np.nanargmax(x * level)]
    return np.array([found[0] * FLAT, found[1] * FLAT, *found[2:], beside, beside * FLIP])


def hidden_vertices(mesh: WholeMesh) -> Array:
    """Return the skin's vertices that have no counterpart on ICT's skin."""
    names = ("nostril3", "nostril4", "nostril5", "nostril_top", "lip0", "lid_edge", "lid_hidden")
    return np.unique(np.concatenate([mesh.tag(name) for name in names]))


def register_skin(mesh: WholeMesh, skin: IctSkin, own: Array, warp: RBFInterpolator) -> Array:
    """Register the generator's skin, vertices `own` (N,), to ICT's; return its places (N, 3)."""
    index = np.full(len(mesh.vertices), -1)
    index[own] = np.arange(len(own))
    faces = index[mesh.faces[is_skin(mesh)]]
    mirror = index[mesh.mirror[own]]
    targets = rim_targets(mesh, skin)
    sample = sample_skin(skin)
    tree = cKDTree(np.concatenate([sample.places, NORMAL_MM * sample.normals], axis=1))
    seen = ~np.isin(own, hidden_vertices(mesh))
    mark_faces, mark_weights = embed_landmarks(mesh)
    rows = np.repeat(np.arange(len(FREE)), 3), index[mesh.faces[mark_faces[FREE]]].ravel()
    at_marks = sparse.csr_matrix((mark_weights[FREE].ravel(), rows), (len(FREE), len(own)))
    mark_trust = np.where(np.array(FREE) < 17, 2.0, 6.0)
    held = np.zeros(len(own))
    np.add.at(held, index[targets.ids], 20.0 * targets.weights)
    fixed = at_marks.T @ sparse.diags(mark_trust) @ at_marks + sparse.diags(held + 1e-3)
    # The folds of the two ears differ, so ears keep the generator's.
    firm = np.where(np.isin(own, mesh.tag("ear")), EAR_FIRMNESS, 1.0)
    start = warp(mesh.vertices[own])
    points = start.copy()
    for number, stiffness in enumerate(STIFFNESS):
        laplacian, mass = cotangent_laplacian(points / 1000, faces)
        bending = laplacian.T @ sparse.diags(firm / np.maximum(1e6 * mass, 0.3)) @ laplacian
        facing = normals_of(points, faces)
        nearest = tree.query(np.concatenate([points, NORMAL_MM * facing], axis=1))[1]
        towards, normals = sample.places[nearest] - points, sample.normals[nearest]
        alike = (facing * normals).sum(1) > 0.4
        reach = 25 if number < 6 else 12 if number < 11 else 6
        # Later rounds do not pull back to the generator's own relief.
        memory = 0.15 if number < 9 else 0.0
        trust = seen * alike * (np.linalg.norm(towards, axis=1) < reach)
        # Mostly along the normal, so that skin may slide where landmarks and bending pull it.
        along = trust * (normals * towards).sum(1)
        right = along[:, None] * normals + 0.05 * trust[:, None] * towards
        right -= memory * stiffness * (bending @ (points - start))
        right += at_marks.T @ (mark_trust[:, None] * (skin.marks[FREE] - at_marks @ points))
        pulled = np.zeros_like(points)
        weight = 20.0 * targets.weights[:, None]
        np.add.at(pulled, index[targets.ids], weight * (targets.goals - points[index[targets.ids]]))
        smooth = (stiffness * bending + fixed + sparse.diags(0.05 * trust)).tocsc()
        points = points + _solve(smooth, trust, normals, right + pulled)
        points = 0.5 * (points + points[mirror] * FLIP)
    return points


def _solve(smooth: sparse.csc_matrix, trust: Array, normals: Array, right: Array) -> Array:
    """Solve (smooth + trust n n^T) u = right for moves u (N, 3) by conjugate gradients."""
    near = splu((smooth + sparse.diags(trust / 3)).tocsc())

    def apply(flat: Array) -> Array:
        u = flat.reshape(-1, 3)
        return (smooth @ u + (trust * (normals * u).sum(1))[:, None] * normals).ravel()

    size = right.size
    by_smooth = LinearOperator((size, size), lambda r: near.solve(r.reshape(-1, 3)).ravel())
    operator = LinearOperator((size, size), apply)
    found, _ = cg(operator, right.ravel(), rtol=1e-4, maxiter=200, M=by_smooth)
    return found.reshape(-1, 3)


@dataclass(frozen=True)
class SkinSample:
    """Places (N, 3) all over ICT's skin, with normals, and their vertices and weights."""

    places: Array
    normals: Array
    corners: Array  # (N, 3) vertices
    weights: Array  # (N, 3)


def sample_skin(skin: IctSkin) -> SkinSample:
    """Draw places evenly over ICT's skin."""
    rng, count = np.random.default_rng(0), 300_000
    a, b, c = (skin.points[skin.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners = skin.faces[rng.choice(len(area), count, p=area / area.sum())]
    weights = rng.dirichlet((1, 1, 1), count)
    normals = unit((skin.normals[corners] * weights[..., None]).sum(1))
    return SkinSample((skin.points[corners] * weights[..., None]).sum(1), normals, corners, weights)
