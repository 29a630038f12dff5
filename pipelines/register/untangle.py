"""Separate lips and lids that pass through each other, by small and smooth displacements.

Intersecting faces are pushed apart until a plane separates them; a thin plate spreads the push over
the skin around. Each step starts from the one before, so separated faces do not spring back, and
closed lips still touch. Where skin is crumpled, neighbouring faces intersect: their corners move
as the vertices around them do on average. Eyeballs and teeth do not move.
"""

from __future__ import annotations

import numpy as np
import open3d as o3d
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from express50.geometry.meshes import cotangent_laplacian
from express50.geometry.transforms import rigid_fit, unit
from express50.head.model import HeadModel, in_regions

RIMS = ("lips", "left_eye_region", "right_eye_region")
FIXED = ("left_eyeball", "right_eyeball", "teeth", "gums", "tongue", "boundary")
GAP_M = 2e-5  # left between surfaces: more than float32 loses, less than anyone sees
PATCH_M = 0.015  # skin within this distance of intersecting faces moves
WAVE_M = 0.008  # a push spreads over about this wavelength
PUSH = 30.0  # weight of a push against the springs that hold the skin
STEPS = 40
# Share of the way to the plane that faces move in the first step, and its growth per step: a larger
# push would open lips that were closed.
SHARE, GROWTH = 0.4, 0.05
# Faces oppose if the cosine of their normals is under the first; their direction agrees with that
# at rest if the cosine is over the second.
OPPOSED, AGREE = -0.3, 0.3
BACK_STEPS = 8  # in these first steps, opposed faces move back against their normals
FLAT = 16  # from this step on, crumpled skin is flattened
PUSHED_ONLY, EVERY = 3, 4  # crumpled faces are pushed in these first steps, then in every fourth


def crossing_pairs(model: HeadModel, mesh: np.ndarray) -> np.ndarray:
    """Return the pairs (P, 2) of faces of lips and lids that intersect on a mesh (V, 3), metres.

    Faces that share a vertex do not count.
    """
    faces = model.faces.numpy()
    rims = np.flatnonzero(in_regions(model, RIMS)[faces].any(1))
    if not len(rims):
        return np.zeros((0, 2), np.int64)
    used, corners = np.unique(faces[rims], return_inverse=True)
    part = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector((mesh - mesh.mean(0))[used]),
        o3d.utility.Vector3iVector(corners.reshape(-1, 3)),
    )
    return rims[np.asarray(part.get_self_intersecting_triangles(), np.int64).reshape(-1, 2)]


def crossings(model: HeadModel, mesh: np.ndarray) -> np.ndarray:
    """Return the faces of lips and lids that intersect others of them on a mesh (V, 3)."""
    return np.unique(crossing_pairs(model, mesh))


def untangled(model: HeadModel, mesh: np.ndarray) -> np.ndarray:
    """Return a mesh (V, 3) with lips and lids separated that pass through each other.

    If STEPS do not suffice, it is the one with the fewest intersecting pairs.
    """
    pairs = crossing_pairs(model, mesh)
    if not len(pairs):
        return mesh
    skin, best, fewest = Skin(model, mesh), mesh, len(pairs)
    for step in range(STEPS):
        crumpled = skin.joined(pairs) & (step >= PUSHED_ONLY) & (step % EVERY != EVERY - 1)
        if crumpled.any():
            mesh = skin.evened(mesh, pairs[crumpled], step)
        if not crumpled.all():
            mesh = mesh + skin.parting(mesh, pairs[~crumpled], step)
        pairs = crossing_pairs(model, mesh)
        if len(pairs) < fewest:
            best, fewest = mesh, len(pairs)
        if not fewest:
            break
    return best


class Skin:
    """A mesh (V, 3) that can be pushed, and its model at rest, aligned with it."""

    def __init__(self, model: HeadModel, mesh: np.ndarray) -> None:
        self.faces, self.free = model.faces.numpy(), ~in_regions(model, FIXED)
        rest, rims = model.template.double().numpy(), in_regions(model, RIMS)
        R, t = rigid_fit(rest[rims], mesh[rims])
        self.rest = rest @ R.T + t
        stiffness, mass = cotangent_laplacian(mesh, self.faces)
        scale = (WAVE_M / (2 * np.pi)) ** 2 * (np.median(mass) * mass) ** -0.5
        self.bend = sparse.diags(scale) @ stiffness
        edges = np.concatenate([self.faces[:, [k, (k + 1) % 3]] for k in range(3)])
        half = sparse.coo_matrix((np.ones(len(edges)), edges.T), (len(mesh),) * 2).tocsr()
        self.edges = half + half.T

    def joined(self, pairs: np.ndarray) -> np.ndarray:
        """Mark the pairs (P,) of faces that an edge joins."""
        first, second = (self.faces[pairs[:, k]] for k in range(2))
        found = [
            np.asarray(self.edges[first[:, i], second[:, j]]).ravel() > 0
            for i in range(3)
            for j in range(3)
        ]
        return np.any(found, axis=0)

    def evened(self, mesh: np.ndarray, pairs: np.ndarray, step: int) -> np.ndarray:
        """Return the mesh with the pairs' corners moved half way to their neighbours' mean."""
        some = np.unique(self.faces[pairs])
        some = some[self.free[some]]
        # The model itself may be crumpled there: later steps leave its shape out.
        rest = self.rest * (step < FLAT)
        moved, around = mesh - rest, self.edges[some]
        mean = (around @ moved) / np.asarray(around.sum(1)).reshape(-1, 1)
        result = mesh.copy()
        result[some] = rest[some] + (moved[some] + mean) / 2
        return result

    def parting(self, mesh: np.ndarray, pairs: np.ndarray, step: int) -> np.ndarray:
        """Return moves (V, 3) that separate the pairs further; steps count from 0."""
        ids, ways, lengths = self.pushes(mesh, pairs, step)
        near, _ = cKDTree(mesh[np.unique(self.faces[pairs])]).query(
            mesh, distance_upper_bound=PATCH_M
        )
        patch = np.flatnonzero(self.free & np.isfinite(near))
        place = np.zeros(len(mesh), np.int64)
        place[patch] = np.arange(len(patch))
        bend = self.bend[:, patch]
        smooth = bend.T @ bend + sparse.identity(len(patch))
        rows = np.repeat(np.arange(len(ids)), 3)
        columns = (3 * place[ids][:, None] + np.arange(3)).ravel()
        shape = len(ids), 3 * len(patch)
        along = sparse.csr_matrix((ways.ravel(), (rows, columns)), shape)
        matrix = sparse.kron(smooth, sparse.identity(3)) + PUSH * along.T @ along
        wanted = PUSH * along.T @ lengths
        moves = np.zeros_like(mesh)
        solved = spsolve(matrix.tocsc(), wanted, permc_spec="MMD_AT_PLUS_A")
        moves[patch] = solved.reshape(-1, 3)
        return moves

    def pushes(
        self, mesh: np.ndarray, pairs: np.ndarray, step: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return moves after which a plane lies between the faces of every pair.

        They are vertices' ids (N,), directions (N, 3), and metres along them (N,).

        In the first steps opposed faces move back against their normals; all others move in the
        direction in which they lie apart at rest.
        """
        corners = mesh[self.faces[pairs]]  # (P, 2, 3, 3)
        edges = corners[:, :, 1:] - corners[:, :, :1]
        normals = unit(np.cross(edges[:, :, 0], edges[:, :, 1]))
        way = unit(np.subtract(*self.rest[self.faces[pairs]].mean(2).transpose(1, 0, 2)))
        inwards = unit(normals[:, 1] - normals[:, 0])
        facing = (normals[:, 0] * normals[:, 1]).sum(1) < OPPOSED
        facing &= (inwards * way).sum(1) > AGREE
        way = np.where(facing[:, None] & (step < BACK_STEPS), inwards, way)
        share = min(1.0, SHARE + GROWTH * step)
        height = np.einsum("pkvc,pc->pkv", corners, way)
        middle = (height[:, 0].min(1) + height[:, 1].max(1))[:, None] / 2
        moves = np.stack(
            [
                np.maximum(share * (middle - height[:, 0]) + GAP_M / 2, 0),
                np.minimum(share * (middle - height[:, 1]) - GAP_M / 2, 0),
            ],
            axis=1,
        ).ravel()
        ids = self.faces[pairs].ravel()
        some = (moves != 0) & self.free[ids]
        ways = np.broadcast_to(way[:, None, None], corners.shape).reshape(-1, 3)
        return ids[some], ways[some], moves[some]
