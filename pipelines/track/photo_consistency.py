"""Search for the surface along the mesh's normals with small patches.

A patch around every sample is moved along the normal; the surface is where the views agree best on
its appearance. The search is exhaustive, so it works from several millimetres away, where
gradients of colour lead astray. Samples without a clear best height are left out. Scores are means
of normalised cross-correlations over all pairs of views (as in Goesele et al. 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from express50.geometry.cameras import Camera, project_pinhole, project_with_slope
from express50.geometry.conventions import corner_to_cell
from express50.geometry.raycast import join_rays, mesh_scene
from express50.geometry.transforms import unit
from express50.head.model import HeadModel, in_regions
from pipelines.regions.colour import like_skin_around
from pipelines.track.surface import (
    COVERED,
    FEATURES,
    UNCOVERED_SKIN,
    FrameSetCrops,
    Visibility,
    sample_normals,
    spread_samples,
    view_colours,
    view_weights,
)
from pipelines.track.terms import MeshPlaces, NormalTerm

PATCH = 7  # samples per side of a patch
VIEWS = 8  # views that are compared, the best ones; more add little
SPACING_PX = 1.0  # between the samples of a patch
STEP_PX = 0.7  # between the heights that are tried
MEAN_KERNEL = np.full(PATCH * PATCH, 1.0 / (PATCH * PATCH), np.float32)
GREY = np.full(3, 1.0 / 3.0, np.float32)
# Noise that a patch's contrast must exceed: root of light, 0..1.
NOISE = 0.006
LEAST_SCORE, LEAST_SHARP = 0.3, 0.02  # least values of a height that counts as found
NEIGHBOURS, NEIGHBOUR_LIMIT_PX = 24, 1.2  # largest distance from the neighbours' median height
OUTLIER_PX = 2.5
SIGMA_PX = 0.8  # standard deviation of a height with a score of 1
# Cosine to the camera below which a patch is foreshortened too much to be compared.
MIN_COSINE = 0.4
# Hair and cloth may cover neck and ears: fewer samples per sample of the face, and less trust.
COVERED_SHARE, COVERED_TRUST = 0.25, 0.3

# A beard or a fringe covers a place if more than this share of its nearest samples is unlike skin;
# brows and nostrils are narrower.
HAIR_NEIGHBOURS, HAIR_SHARE = 40, 0.65

SkinSamples = list[tuple[MeshPlaces, float]]
"""Where the surface is searched for, and the trust in what is found there."""


@dataclass(frozen=True)
class PatchSearch:
    """The heights that a search found at S samples."""

    height: np.ndarray  # (S,) metres along the normals
    score: np.ndarray  # (S,) the views' mean correlation there, 0 where nothing was found
    sharpness: np.ndarray  # (S,) the score's margin over any other height
    pixel: float  # width of a pixel at the samples, metres


@dataclass(frozen=True)
class PatchViews:
    """How C views see S places on a mesh (V, 3) with faces (F, 3)."""

    # grey pictures (H, W) float32, root of light, with their pinhole cameras
    images: list[tuple[np.ndarray, Camera]]
    weights: np.ndarray  # (C, S), 0 where a place is not seen
    places: np.ndarray  # (S, 3) in the world
    normals: np.ndarray  # (S, 3) of unit length
    mesh: np.ndarray
    faces: np.ndarray

    @property
    def pixel(self) -> float:
        """Return how wide a pixel is at the places, metres."""
        middle = self.places.mean(0)
        sizes = [
            np.linalg.norm(middle - camera.center) / camera.K[0, 0] for _, camera in self.images
        ]
        return float(np.median(sizes)) if sizes else 1e-3


def search(views: PatchViews, reach: float) -> PatchSearch:
    """Search for the surface within `reach` metres of the places, along the normals."""
    pixel = views.pixel
    steps = max(3, int(np.ceil(reach / (STEP_PX * pixel))))
    heights = np.arange(-steps, steps + 1) * (reach / steps)
    # The highest score of each patch is placed between the steps by a parabola.
    score = agreement(views, heights)
    best = score.argmax(1)
    inner = (best > 0) & (best < len(heights) - 1)
    at = np.clip(best, 1, len(heights) - 2)
    row = np.arange(len(score))
    left, top, right = score[row, at - 1], score[row, at], score[row, at + 1]
    bend = np.maximum(2 * top - left - right, 1e-6)
    shift = np.clip(0.5 * (right - left) / bend, -0.5, 0.5)
    step = heights[1] - heights[0]
    far = np.abs(np.arange(len(heights))[None] - at[:, None]) > 2
    # A patch whose surroundings look like it, as on a flat cheek, has no clear height.
    rival = np.where(far, score, -1.0).max(1)
    return PatchSearch(
        heights[at] + shift * step,
        np.where(inner, top, 0.0),
        np.where(inner, np.clip(top - rival, 0.0, 1.0), 0.0),
        pixel,
    )


def agreement(views: PatchViews, heights: np.ndarray) -> np.ndarray:
    """Score (S, D) how alike views see patches that are moved by heights (D,), metres.

    Patches are bent to follow the mesh. The score is 0 where fewer than two views see the place.
    """
    weights, places, normals = views.weights, views.places, views.normals
    if len(weights) > VIEWS:
        weights = np.where(weights >= np.sort(weights, axis=0)[-VIEWS], weights, 0.0)
    mass, square = weights.sum(0), (weights**2).sum(0)
    pairs = mass**2 - square
    score = np.zeros((len(places), len(heights)))
    seen = np.flatnonzero(pairs > 0.1)
    if not len(seen):
        return score
    shapes = _shapes(views, seen)
    total = np.zeros((len(seen), len(heights), PATCH * PATCH), np.float32)
    for (image, camera), weight in zip(views.images, weights[:, seen], strict=True):
        chosen = np.flatnonzero(weight > 0)
        if not len(chosen):
            continue
        at = seen[chosen]
        patches = _patches(image, camera, places[at], normals[at], heights, shapes[chosen])
        total[chosen] += weight[chosen, None, None].astype(np.float32) * patches
    together = np.einsum("sdk,sdk->sd", total, total).astype(np.float64)
    score[seen] = (together - square[seen, None]) / pairs[seen, None]
    return score


def _patches(
    image: np.ndarray,
    camera: Camera,
    places: np.ndarray,
    normals: np.ndarray,
    heights: np.ndarray,
    shape: np.ndarray,
) -> np.ndarray:
    """Sample patches (S, D, PATCH^2) float32 of one picture, mean removed, of about unit length.

    `shape` (S, 3, PATCH^2) are the patches' points about their samples.
    """
    centre = places[:, None] + heights[None, :, None] * normals[:, None]
    pixels, _ = project_pinhole(camera, centre)
    # Heights change a patch's size in the image by less than 1 %, so all use the slope at the mesh.
    # Image coordinates fit single precision; world coordinates may not.
    _, slope = project_with_slope(camera, places)
    offsets = slope.astype(np.float32) @ shape.astype(np.float32)
    middle = corner_to_cell(pixels).astype(np.float32)
    x, y = (
        (middle[:, :, k, None] + offsets[:, None, k]).reshape(len(places), -1) for k in range(2)
    )
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values = values.reshape(len(places), len(heights), -1)
    values -= (values @ MEAN_KERNEL)[..., None]
    length = np.einsum("sdk,sdk->sd", values, values) + np.float32((NOISE * PATCH) ** 2)
    values /= np.sqrt(length)[..., None]
    return values


def _shapes(views: PatchViews, chosen: np.ndarray) -> np.ndarray:
    """Lay a square grid (N, 3, PATCH^2) on the mesh about each of the chosen places (N,).

    A nose is too round for flat patches.
    """
    normals, spacing, centre = views.normals[chosen], SPACING_PX * views.pixel, views.mesh.mean(0)
    scene = mesh_scene(views.mesh - centre, views.faces)
    # The tangents must not depend on the camera.
    axis = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    across = unit(np.cross(axis, normals))
    along = np.cross(normals, across)
    grid = spacing * (np.arange(PATCH) - PATCH // 2)
    v, u = np.meshgrid(grid, grid, indexing="ij")
    flat = u.reshape(1, -1, 1) * across[:, None] + v.reshape(1, -1, 1) * along[:, None]
    lift = 2.0 * spacing * PATCH
    start = views.places[chosen, None] - centre + flat + lift * normals[:, None]
    hit = scene.cast_rays(join_rays(start, -normals[:, None]))["t_hit"].numpy()
    rise = np.where(np.isfinite(hit), lift - hit, 0.0)
    # A hit further away is another part of the face, which does not continue the patch.
    rise = np.where(np.abs(rise) < spacing * PATCH, rise, 0.0)
    return np.swapaxes(flat + rise[..., None] * normals[:, None], 1, 2)


def surface_term(
    found: PatchSearch, samples: MeshPlaces, places: np.ndarray, normals: np.ndarray, weight: float
) -> NormalTerm | None:
    """Make the term of the samples whose search was conclusive; None if none was."""
    good = np.flatnonzero((found.score > LEAST_SCORE) & (found.sharpness > LEAST_SHARP))
    if len(good) < 2 * NEIGHBOURS:
        return None
    # The mesh's error changes slowly along the skin; that of a mismatched patch does not.
    _, near = cKDTree(places[good]).query(places[good], NEIGHBOURS)
    odd = np.abs(found.height[good] - np.median(found.height[good][near], axis=1))
    good = good[odd < NEIGHBOUR_LIMIT_PX * found.pixel]
    if not len(good):
        return None
    goals = places[good] + found.height[good, None] * normals[good]
    sure = found.score[good] * np.minimum(found.sharpness[good] / 0.2, 1.0)
    sigma = found.pixel * SIGMA_PX / np.sqrt(weight * sure)
    return NormalTerm(samples.some(good), goals, normals[good], sigma, OUTLIER_PX * found.pixel)


def skin_samples(model: HeadModel, count: int) -> SkinSamples:
    """Spread `count` samples over the face and fewer over neck and ears, which may be covered."""
    covered = spread_samples(model, round(COVERED_SHARE * count), COVERED)
    return [(spread_samples(model, count), 1.0), (covered, COVERED_TRUST)]


def patch_terms(
    model: HeadModel,
    skin: SkinSamples,
    pictures: FrameSetCrops,
    mesh: np.ndarray,
    reach: float,
    weight: float,
    covered: np.ndarray | None = None,
) -> list[NormalTerm]:
    """Search a frame set's surface about the current mesh (V, 3).

    `reach` is in metres to either side, `weight` is the trust in the result. Vertices that are
    `covered` (V,) are left out.
    """
    if len(pictures.crops) < 2:  # nothing to compare
        return []
    faces = model.faces.numpy()
    images = [(root @ GREY, camera) for root, camera in pictures.images()]
    visibility, terms = Visibility(mesh, faces), []
    for samples, trust in skin:
        if covered is not None:
            samples = samples.some(~covered[samples.vertices].any(1))
        places, normals = samples.at(mesh), sample_normals(samples, mesh)
        weights = view_weights(visibility, pictures, places, normals)
        weights = np.where(weights > MIN_COSINE, weights**2, 0.0)
        found = search(PatchViews(images, weights, places, normals, mesh, faces), reach)
        term = surface_term(found, samples, places, normals, trust * weight)
        if term is not None:
            terms.append(term)
    return terms


def under_hair(
    model: HeadModel, skin: SkinSamples, pictures: FrameSetCrops, mesh: np.ndarray
) -> np.ndarray:
    """Return the vertices (V,) bool of the face that hair hides on the mesh (V, 3), by colour.

    Where most of the neighbouring samples are unlike the rest of the face, there is a beard or a
    fringe. Views agree on the surface of hair as well as on skin, so it would be taken for skin.
    """
    samples = skin[0][0]
    samples = samples.some(~in_regions(model, FEATURES)[samples.vertices].any(1))
    places, normals = samples.at(mesh), sample_normals(samples, mesh)
    views = view_weights(Visibility(mesh, model.faces.numpy()), pictures, places, normals)
    seen = np.flatnonzero((views > 0).any(0))
    hidden = np.zeros(len(mesh), bool)
    if len(seen) < 2 * HAIR_NEIGHBOURS:
        return hidden
    views = views[:, seen, None]
    logs = np.log(np.maximum(view_colours(pictures.images(), views[..., 0], places[seen]), 0.01))
    middle = np.nanmedian(np.where(views > 0, logs, np.nan), axis=0)
    left = samples.at(model.template.double().numpy())[seen, 0] > 0
    odd = ~like_skin_around(middle, left)
    face = np.flatnonzero(in_regions(model, UNCOVERED_SKIN))
    near = cKDTree(places[seen]).query(mesh[face], HAIR_NEIGHBOURS)[1]
    hidden[face] = odd[near].mean(1) > HAIR_SHARE
    return hidden
