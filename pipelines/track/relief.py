"""Where the skin really is before and behind the mesh: small patches compared between the views.

Around every sample a patch of the tangent plane is moved along the normal; where the views agree on
what it looks like, there the surface is. The search is exhaustive, so that it finds its way from
millimetres off, where gradients of colour lead astray; what agrees nowhere is left out. Scores are
means of normalised correlations over all pairs of views (as in Goesele et al. 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from express50.geometry.cameras import Camera
from express50.geometry.conventions import corner_to_cell
from express50.geometry.raycast import mesh_scene
from pipelines.track.pinhole import project_with_slope

PATCH = 7
VIEWS = 8
SPACING_PX = 1.0
STEP_PX = 0.7
# What a patch's contrast must stand out from: root of light, 0..1.
NOISE = 0.006
LEAST_SCORE, LEAST_SHARP = 0.3, 0.02
NEIGHBOURS, ODD_PX, OUTLIER_PX = 24, 1.2, 2.5
SIGMA_PX = 0.8


@dataclass(frozen=True)
class Relief:
    """Points of the surface that the views agree on.

    Attributes:
        rows: (S, 3) the samples' corners among the fit's points.
        bary: (S, 3).
        goals: (S, 3) world.
        normals: (S, 3) world; only the distance along them counts.
        sigma: (S,) metres.
        outlier: metres at which a point is more likely wrong than the mesh.
    """

    rows: np.ndarray
    bary: np.ndarray
    goals: np.ndarray
    normals: np.ndarray
    sigma: np.ndarray
    outlier: float

    def _distance(self, positions: np.ndarray) -> np.ndarray:
        places = np.einsum("sk,skc->sc", self.bary, positions[self.rows])
        return ((places - self.goals) * self.normals).sum(1)

    def cost(self, positions: np.ndarray) -> float:
        """Half the sum of squared distances over sigma^2, Geman and McClure's beyond `outlier`."""
        square = self._distance(positions) ** 2
        return 0.5 * float((square / (1.0 + square / self.outlier**2) / self.sigma**2).sum())

    def normal(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton matrix (S, 3, 3) and gradient (S, 3) by the samples' positions, metres."""
        off = self._distance(positions)
        weight = 1.0 / (self.sigma * (1.0 + (off / self.outlier) ** 2)) ** 2
        matrix = weight[:, None, None] * self.normals[:, :, None] * self.normals[:, None, :]
        return matrix, (weight * off)[:, None] * self.normals


@dataclass(frozen=True)
class Sweep:
    """Result of a search.

    Attributes:
        height: (S,) metres along the normals.
        score: (S,) mean correlation of the views there, 0 where nothing was found.
        sharpness: (S,) by how much that is more than anywhere else.
        pixel: metres a pixel at the samples.
    """

    height: np.ndarray
    score: np.ndarray
    sharpness: np.ndarray
    pixel: float


def sweep(
    images: list[tuple[np.ndarray, Camera]],
    weights: np.ndarray,
    places: np.ndarray,
    normals: np.ndarray,
    mesh: np.ndarray,
    faces: np.ndarray,
    reach: float,
) -> Sweep:
    """Search every sample's surface within `reach` metres along its normal.

    Args:
        images: C grey pictures (H, W) float32, root of light, with their pinhole cameras.
        weights: (C, S) trust in each view of each sample; 0 where it is not seen.
        places: (S, 3) world.
        normals: (S, 3) unit, world.
        mesh: (V, 3) world, what the patches are bent after.
        faces: (F, 3).
        reach: metres.
    """
    pixel = _pixel_size(images, places)
    steps = max(3, int(np.ceil(reach / (STEP_PX * pixel))))
    heights = np.arange(-steps, steps + 1) * (reach / steps)
    centre = mesh.mean(0)
    shapes = _shapes(mesh_scene(mesh - centre, faces), centre, places, normals, SPACING_PX * pixel)
    count, size = len(places), PATCH * PATCH
    total = np.zeros((count, len(heights), size), np.float32)
    mass, square = np.zeros(count), np.zeros(count)
    for (image, camera), weight in zip(images, _best_views(weights), strict=True):
        chosen = np.flatnonzero(weight > 0)
        if not len(chosen):
            continue
        patches = _patches(image, camera, places[chosen], normals[chosen], heights, shapes[chosen])
        total[chosen] += weight[chosen, None, None].astype(np.float32) * patches
        mass[chosen] += weight[chosen]
        square[chosen] += weight[chosen] ** 2
    pairs = mass**2 - square
    enough = pairs > 0.1
    score = np.zeros((count, len(heights)))
    together = (total[enough].astype(np.float64) ** 2).sum(2)
    score[enough] = (together - square[enough, None]) / pairs[enough, None]
    return _peaks(score, heights, pixel)


def _best_views(weights: np.ndarray) -> np.ndarray:
    """Weights (C, S) with all but each sample's best VIEWS set to zero: more add little."""
    if len(weights) <= VIEWS:
        return weights
    least = np.sort(weights, axis=0)[-VIEWS]
    return np.where(weights >= least, weights, 0.0)


def _pixel_size(images: list[tuple[np.ndarray, Camera]], places: np.ndarray) -> float:
    """Median metres a pixel at the samples."""
    middle = places.mean(0)
    sizes = [float(np.linalg.norm(middle - camera.center)) / camera.K[0, 0] for _, camera in images]
    return float(np.median(sizes)) if sizes else 1e-3


def _patches(
    image: np.ndarray,
    camera: Camera,
    places: np.ndarray,
    normals: np.ndarray,
    heights: np.ndarray,
    shape: np.ndarray,
) -> np.ndarray:
    """Patches (S, D, PATCH^2) float32 of one picture, mean removed, of about unit length.

    `shape` (S, 3, PATCH^2) are the patches' points about their samples.
    """
    centre = places[:, None] + heights[None, :, None] * normals[:, None]
    pixels, slope = project_with_slope(camera, centre)
    # Image coordinates fit single precision; world coordinates need not.
    spread = slope.astype(np.float32) @ shape[:, None].astype(np.float32)
    where = spread + corner_to_cell(pixels[..., None]).astype(np.float32)
    x, y = (np.ascontiguousarray(where[:, :, k].reshape(len(places), -1)) for k in range(2))
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values = values.reshape(len(places), len(heights), -1)
    values -= values.mean(2, keepdims=True)
    length = np.einsum("sdk,sdk->sd", values, values) + np.float32((NOISE * PATCH) ** 2)
    values /= np.sqrt(length)[..., None]
    return values


def _shapes(
    scene: o3d.t.geometry.RaycastingScene,
    origin: np.ndarray,
    places: np.ndarray,
    normals: np.ndarray,
    spacing: float,
) -> np.ndarray:
    """Points (S, 3, PATCH^2) of each sample's patch about it: a square grid laid on the mesh.

    A nose is too round for flat patches. The scene's origin lies at `origin` (3,) in the world.
    """
    across = _tangent(normals)
    along = np.cross(normals, across)
    grid = spacing * (np.arange(PATCH) - PATCH // 2)
    v, u = np.meshgrid(grid, grid, indexing="ij")
    flat = u.reshape(1, -1, 1) * across[:, None] + v.reshape(1, -1, 1) * along[:, None]
    lift = 2.0 * spacing * PATCH
    start = places[:, None] - origin + flat + lift * normals[:, None]
    rays = np.concatenate([start, np.broadcast_to(-normals[:, None], start.shape)], axis=2)
    hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
    rise = np.where(np.isfinite(hit), lift - hit, 0.0)
    # Another part of the face under the patch is no continuation of it.
    rise = np.where(np.abs(rise) < spacing * PATCH, rise, 0.0)
    return np.swapaxes(flat + rise[..., None] * normals[:, None], 1, 2)


def _tangent(normals: np.ndarray) -> np.ndarray:
    """A unit tangent (S, 3) to each normal, the same whichever camera asks."""
    axis = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(axis, normals)
    return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)


def _peaks(score: np.ndarray, heights: np.ndarray, pixel: float) -> Sweep:
    """Highest score of every row (S, D), placed between the steps by a parabola."""
    best = score.argmax(1)
    inner = (best > 0) & (best < len(heights) - 1)
    at = np.clip(best, 1, len(heights) - 2)
    row = np.arange(len(score))
    left, top, right = score[row, at - 1], score[row, at], score[row, at + 1]
    bend = np.maximum(2 * top - left - right, 1e-6)
    shift = np.clip(0.5 * (right - left) / bend, -0.5, 0.5)
    step = heights[1] - heights[0]
    far = np.abs(np.arange(len(heights))[None] - at[:, None]) > 2
    # A patch that is much the same everywhere, as on a flat cheek, tells no height.
    rival = np.where(far, score, -1.0).max(1)
    return Sweep(
        heights[at] + shift * step,
        np.where(inner, top, 0.0),
        np.where(inner, np.clip(top - rival, 0.0, 1.0), 0.0),
        pixel,
    )


def make_relief(
    found: Sweep,
    rows: np.ndarray,
    bary: np.ndarray,
    places: np.ndarray,
    normals: np.ndarray,
    strength: float,
) -> Relief | None:
    """The samples whose search was conclusive; None if none was."""
    good = np.flatnonzero((found.score > LEAST_SCORE) & (found.sharpness > LEAST_SHARP))
    good = good[_in_company(places[good], found.height[good], ODD_PX * found.pixel)]
    if not len(good):
        return None
    goals = places[good] + found.height[good, None] * normals[good]
    sure = found.score[good] * np.minimum(found.sharpness[good] / 0.2, 1.0)
    sigma = found.pixel * SIGMA_PX / np.sqrt(strength * sure)
    return Relief(rows[good], bary[good], goals, normals[good], sigma, OUTLIER_PX * found.pixel)


def _in_company(places: np.ndarray, heights: np.ndarray, limit: float) -> np.ndarray:
    """Which heights (S,) at places (S, 3) are within `limit` of the median of their neighbours.

    What a mesh is off by changes slowly along the skin; a patch that matched elsewhere does not.
    """
    if len(places) < 2 * NEIGHBOURS:
        return np.zeros(len(places), dtype=bool)
    _, near = cKDTree(places).query(places, NEIGHBOURS)
    return np.abs(heights - np.median(heights[near], axis=1)) < limit
