"""Lay a tracked mesh onto a surface: match along normals, then bend the mesh as little as needed.

Each vertex searches for the surface along its normal. A thin plate is fitted to the heights that
are found, and interpolates them where none are; weak springs hold the rest in place. Samples of
the plate's posterior give the uncertainty. Vertices move along normals only: tracking sees the
skin's texture, so it knows better where along the skin they belong. The surface's colours and
confidence distinguish skin from hair and cloth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree

from express50.geometry.meshes import cotangent_laplacian
from express50.geometry.pixels import srgb_to_linear
from express50.geometry.raycast import join_rays, mesh_scene
from express50.geometry.sampling import robust_moments
from express50.geometry.transforms import unit
from express50.head.model import HeadModel, in_regions, normals_of
from pipelines.register.untangle import untangled
from pipelines.track.basis import movable_vertices

# Per round: search distance to either side, metres, and the finest wavelength that the mesh
# follows, in multiples of the last round's. Broad differences come first.
ROUNDS = ((0.010, 2.0), (0.008, 1.25), (0.006, 1.0), (0.004, 1.0), (0.003, 1.0), (0.002, 1.0))
AGREE = 0.6  # least cosine between the normals of mesh and surface
OUTLIER = 0.3  # share of the search distance; heights this far off the plate keep a quarter weight
REWEIGHTINGS = 2
NOISE_M = 0.0003  # standard deviation of a height that is fully trusted
# Errors that neighbouring heights share. Set on three synthetic people so that 90 % intervals hold
# there (docs/LOG.md, Registration).
SURFACE_M = 0.0004
UNSEEN_SIGMA_M = 0.003  # standard deviation of the tracked mesh where no surface is found
FOLD_M = 0.03  # a vertex that faces the mesh itself nearer than this lies in a fold
NOSTRILS_M = 0.010  # so near to nostrils, depth's surface lies up to 2.5 mm outside the skin
FINE = ("lips", "left_eye_region", "right_eye_region")  # with few views depth errs by 1 mm here
SAMPLES = 64  # of the posterior; their standard deviation is known to 9 %
# Trust in regions where the surface is not skin or is coarser than tracking; ears consist of folds.
TRUST = {
    "scalp": 0.0, "mouth_interior": 0.0, "boundary": 0.0, "neck": 0.0, "left_ear": 0.0,
    "right_ear": 0.0, "lips": 0.5, "left_eye_region": 0.1, "right_eye_region": 0.1,
}  # fmt: skip
FACE = ("face", "nose")  # except for NOT_BARE it is bare skin on nearly everybody
NOT_BARE = (
    "lips", "left_eye_region", "right_eye_region", "mouth_interior", "forehead", "boundary",
)  # fmt: skip
NEAR_M, LIPS_M = 0.004, 0.01  # a surface this near to the mesh is its skin; this near to lips, lips
LEAST_SKIN_VERTICES = 100  # fewest vertices of bare skin that show its colour
# Least standard deviations of the logarithms of red over green, blue over green, brightness.
SPREADS = (0.05, 0.05, 0.2)
COLOUR_LIMIT = 3.0  # standard deviations off skin's colour at which trust is halved
# Confidences, as shares of bare skin's, that give no trust and full trust.
CONFIDENCE_RANGE = (0.5, 1.0)
# Bare skin's confidence where views agree is 0.7 to 0.85. Much less means that cameras, mattes or
# synchronisation are wrong, and tracking is nearer to the head than the surface.
AGREEING = 0.6
# The rim of hair has colours of skin, so a vertex is trusted only as far as those around it.
AROUND_M, NEIGHBOURS, EVERY = 0.008, 12, 14


@dataclass(frozen=True)
class GivenSurface:
    """A surface: vertices (N, 3), metres, faces (F, 3), trust (N,) from 0 to 1."""

    vertices: np.ndarray
    faces: np.ndarray
    trust: np.ndarray


@dataclass(frozen=True)
class LaidMesh:
    """A mesh that was laid onto a surface."""

    vertices: np.ndarray  # (V, 3), world, metres
    seen: np.ndarray  # (V,) bool, where the surface was found and trusted
    residual: np.ndarray  # (V,) height of the surface above the mesh there, metres; 0 elsewhere
    sigma: np.ndarray  # (V,) standard deviation of the vertices along their normals, metres


def lay(model: HeadModel, start: np.ndarray, surface: GivenSurface, detail: float) -> LaidMesh:
    """Lay a head model's mesh, which starts at ``start`` (V, 3), onto a surface; metres.

    ``detail`` is the finest wavelength that the mesh follows, metres.
    """
    search, trusted = SurfaceSearch(surface), trusted_vertices(model)
    faces, free = model.faces.numpy(), movable_vertices(model)
    mesh = start
    for reach, multiple in ROUNDS:
        laplacian = cotangent_laplacian(mesh, faces)
        plate = Plate(*laplacian, free, multiple * detail)
        normals = smoothed(mesh_normals(mesh, model.faces), *laplacian, 2 * multiple * detail)
        height, trust = search.heights(mesh, normals, reach)
        trust = trust * trusted * ~folded(mesh, normals, faces)
        moved = ((mesh - start) * normals).sum(1)
        weight = trust / NOISE_M**2
        for _ in range(REWEIGHTINGS):
            rise = plate.factor(weight).solve(weight * height - moved * plate.stay)
            off = (height - rise) / (OUTLIER * reach)
            weight = trust / NOISE_M**2 / (1.0 + off**2) ** 2  # Geman and McClure 1985
        mesh = mesh + rise[:, None] * normals
    mesh = untangled(model, mesh)
    normals = mesh_normals(mesh, model.faces)
    residual, trust = search.heights(mesh, normals, ROUNDS[-1][0])
    seen = trust * trusted * ~folded(mesh, normals, faces) > 0.05
    # Tracked vertices share their errors, so the springs between them underestimate these.
    sigma = np.hypot(plate.sigma(weight), np.where(seen, SURFACE_M, UNSEEN_SIGMA_M))
    return LaidMesh(mesh, seen, np.where(seen, residual, 0.0), sigma)


class SurfaceSearch:
    """Searches a surface along normals; the ray tree is built once."""

    def __init__(self, surface: GivenSurface) -> None:
        # Far from the origin float32 rays are too coarse, so rays are cast about the centre.
        self.centre = surface.vertices.mean(0)
        self.surface = surface
        self.scene = mesh_scene(surface.vertices - self.centre, surface.faces)
        a, b, c = ((surface.vertices - self.centre)[surface.faces[:, k]] for k in range(3))
        self.normals = unit(np.cross(b - a, c - a))

    def heights(
        self, places: np.ndarray, normals: np.ndarray, reach: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find heights (S,) of the surface above places (S, 3), and trust (S,).

        Both are 0 where the surface is further than `reach` or its normal does not agree.
        """
        height, trust = np.zeros(len(places)), np.zeros(len(places))
        nearest = np.full(len(places), np.inf)
        for sign in (1.0, -1.0):
            hit = self.scene.cast_rays(join_rays(places - self.centre, sign * normals))
            distance = hit["t_hit"].numpy()
            found = np.flatnonzero(distance < np.minimum(reach, nearest))
            face = hit["primitive_ids"].numpy()[found].astype(np.int64)
            agrees = (self.normals[face] * normals[found]).sum(1) > AGREE
            found, face = found[agrees], face[agrees]
            nearest[found], height[found] = distance[found], sign * distance[found]
            trust[found] = self.surface.trust[self.surface.faces[face]].mean(1)
        return height, trust


class Plate:
    """A thin plate over a mesh of stiffness (V, V) and mass (V,), held in place by weak springs.

    Only `free` vertices (V,) bool move. It follows heights of wavelengths over `detail` metres.
    """

    def __init__(
        self, stiffness: sparse.csr_matrix, mass: np.ndarray, free: np.ndarray, detail: float
    ) -> None:
        # Bending to a wave of this length and amplitude NOISE_M costs as much as missing it.
        scale = (detail / (2 * np.pi)) ** 2 / (NOISE_M * np.sqrt(np.median(mass)))
        self.bend = sparse.diags(scale * mass**-0.5) @ stiffness
        self.stay = np.where(free, UNSEEN_SIGMA_M, 1e-6) ** -2.0

    def factor(self, weight: np.ndarray) -> SuperLU:
        """Factor the normal equations for heights of weights (V,), 1 / square metres."""
        matrix = self.bend.T @ self.bend + sparse.diags(weight + self.stay)
        return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def sigma(self, weight: np.ndarray) -> np.ndarray:
        """Estimate standard deviations (V,), metres, of the plate from samples of its posterior.

        The heights that it was fitted to have weights (V,), 1 / square metres.
        """
        random = np.random.default_rng(0)
        pull = self.bend.T @ random.normal(size=(len(weight), SAMPLES))
        pull += np.sqrt(weight + self.stay)[:, None] * random.normal(size=pull.shape)
        return np.sqrt((self.factor(weight).solve(pull) ** 2).mean(1))


def trusted_vertices(model: HeadModel) -> np.ndarray:
    """Return the trust (V,), by region, that a surface near a vertex is its skin."""
    trust = movable_vertices(model).astype(np.float64)
    for name, share in TRUST.items():
        trust = np.where(in_regions(model, (name,)), np.minimum(trust, share), trust)
    return trust


def folded(mesh: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mark vertices (V,) that face another part of the mesh, as in nostrils or between lips."""
    centred = mesh - mesh.mean(0)
    hit = mesh_scene(centred, faces).cast_rays(join_rays(centred + 2e-4 * normals, normals))
    return hit["t_hit"].numpy() < FOLD_M


def too_fine(model: HeadModel, mesh: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Mark places (N, 3) at lips, eyes and nostrils of a mesh (V, 3), which depth rounds off."""
    folds = folded(mesh, mesh_normals(mesh, model.faces), model.faces.numpy())
    distance, _ = cKDTree(mesh[folds & in_regions(model, ("nose",))]).query(places)
    _, owner = cKDTree(mesh).query(places)
    return (distance < NOSTRILS_M) | in_regions(model, FINE)[owner]


def mesh_normals(vertices: np.ndarray, faces: torch.Tensor) -> np.ndarray:
    """Return unit normals (V, 3) of a mesh (V, 3)."""
    return normals_of(vertices - vertices.mean(0), faces)


def smoothed(
    normals: np.ndarray, stiffness: sparse.csr_matrix, mass: np.ndarray, wavelength: float
) -> np.ndarray:
    """Return a mesh's unit normals (V, 3), averaged over a wavelength in metres.

    Stiffness (V, V) and mass (V,) are those of `cotangent_laplacian`.
    """
    spread = sparse.diags(mass) + (wavelength / (2 * np.pi)) ** 2 * stiffness
    return unit(splu(spread.tocsc()).solve(mass[:, None] * normals))


def bare_skin(model: HeadModel, mesh: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the indices of a surface's vertices (N, 3) near bare skin of a mesh (V, 3); metres."""
    bare = in_regions(model, FACE) & ~in_regions(model, NOT_BARE)
    distance, nearest = cKDTree(vertices).query(mesh[bare])
    return np.unique(nearest[distance < NEAR_M])


def skin_trust(
    model: HeadModel,
    mesh: np.ndarray,
    vertices: np.ndarray,
    colors: np.ndarray,
    confidence: np.ndarray,
    skin: np.ndarray,
    agreeing: float = 0.0,
) -> np.ndarray:
    """Return the trust (N,), 0 to 1, that a surface's vertices (N, 3) are skin and well placed.

    It depends on how much colours (N, 3), uint8 sRGB, and confidence (N,), 0 to 1, differ from
    those of `skin`, the indices of `bare_skin`, whose confidence counts as at least `agreeing`.
    The tracked mesh (V, 3) shows where the lips are. Places are in metres.
    """
    if len(skin) < LEAST_SKIN_VERTICES:
        return confidence.astype(np.float64)
    # Standard deviations that colours are off those of bare skin.
    log = np.log(srgb_to_linear(colors / 255.0) + 0.01)
    axes = np.stack([log[:, 0] - log[:, 1], log[:, 2] - log[:, 1], log.mean(1)], axis=1)
    middle, spread = robust_moments(axes[skin])
    odd = np.linalg.norm((axes - middle) / np.maximum(spread, SPREADS), axis=1)
    _, owner = cKDTree(mesh).query(vertices, distance_upper_bound=LIPS_M)
    odd[np.r_[in_regions(model, ("lips",)), False][owner]] = 0.0
    sure = confidence / max(float(np.median(confidence[skin])), agreeing, 1e-6)
    trust = np.clip(
        (sure - CONFIDENCE_RANGE[0]) / (CONFIDENCE_RANGE[1] - CONFIDENCE_RANGE[0]), 0.0, 1.0
    ) / (1.0 + (odd / COLOUR_LIMIT) ** 4)
    # A vertex among untrusted ones is not trusted either; every 14th neighbour is enough.
    some = np.arange(0, len(vertices), EVERY)
    distance, nearest = cKDTree(vertices[some]).query(vertices, min(NEIGHBOURS, len(some)))
    near = distance < AROUND_M
    around = (trust[some][nearest] * near).sum(1) / np.maximum(near.sum(1), 1)
    return trust * around**2
