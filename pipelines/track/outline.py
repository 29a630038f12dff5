"""Outlines: where the head ends in the mattes, for skull, ears and jaw that carry no landmark.

The signed distance to the matte's edge is sampled under the vertices that form the outline of the
current mesh, so no point-to-point matching is needed and the residual is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from express50.files.images import edge_distance
from express50.geometry.cameras import Camera, resized
from express50.geometry.conventions import corner_to_cell
from express50.geometry.raycast import mesh_scene
from express50.head.model import HeadModel
from pipelines.track.pinhole import project_with_slope

# Head outlines count as about this many independent points a view.
EFFECTIVE_POINTS = 24
POINTS_A_VIEW = 60
OUTLINE_SIDE = 192
EDGE_SIGMA_M = 0.0015
# Where hair, cloth or shoulders may stand before the skin: standard deviation of their thickness,
# and the gap (metres) at which what lies inside the matte stops to pull.
COVER_SIGMA_M, HAIR_GAP_M, BALD_GAP_M = 0.008, 0.004, 0.03
COVERED = ("neck", "scalp", "forehead", "left_ear", "right_ear")
BARE = ("face", "nose", "lips")


@dataclass(frozen=True)
class SignedDistance:
    """Signed distance to a matte's edge, pixels, positive outside, and the camera it belongs to.

    Attributes:
        values: (H, W) float32 at pixel centres.
        camera: pinhole camera of full size.
        step: (2,) full-size pixels a cell, x and y.
    """

    values: np.ndarray
    camera: Camera
    step: np.ndarray


@dataclass(frozen=True)
class Outline:
    """Outline vertices of one view.

    Attributes:
        distance: the view's signed distance.
        index: (n,) positions of the vertices among the fit's points.
        sigma: (n, 2) standard deviations in full-size pixels, inside and outside the matte.
        gap: (n,) pixels inside the matte at which the pull fades.
    """

    distance: SignedDistance
    index: np.ndarray
    sigma: np.ndarray
    gap: np.ndarray

    @classmethod
    def of(
        cls,
        distance: SignedDistance,
        first: int,
        positions: np.ndarray,
        covered: np.ndarray,
        pictures: int,
        bald: bool,
    ) -> Outline:
        """Outline of points that start at `first`, now at positions (n, 3).

        `covered` (n,) says where hair or cloth may hide the skin. Their thickness is much the same
        in all `pictures` of a subject, so that more pictures are no more evidence of it; likewise
        neighbours on an outline err alike. Under a `bald` head's outline there is skin, however far
        off; else only what is near pulls, as hair hides skull, temples and jaw.
        """
        camera, count = distance.camera, len(positions)
        depth = (positions @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]).mean()
        scale = camera.K[0, 0] / max(float(depth), 1e-6)
        crowd = max(1.0, count / EFFECTIVE_POINTS) ** 0.5
        edge = np.hypot(0.5 * distance.step.max(), EDGE_SIGMA_M * scale)
        cover = np.hypot(edge, COVER_SIGMA_M * scale) * max(1, pictures) ** 0.5
        sigma = np.stack([np.where(covered, cover, edge), np.full(count, edge)], axis=1) * crowd
        gap = np.full(count, (BALD_GAP_M if bald else HAIR_GAP_M) * scale)
        return cls(distance, np.arange(first, first + count), sigma, gap)

    def residuals(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Block (index (n,), residual (n, 1), slope (n, 1, 3)) of all points' positions (P, 3).

        Inside the matte the squared residual is Geman and McClure's, v^2 / (1 + v^2 / gap^2).
        """
        pixels, slope = project_with_slope(self.distance.camera, positions[self.index])
        value, gradient = sample(self.distance, pixels)
        fade = 1.0 + np.where(value < 0, value / self.gap, 0.0) ** 2
        sigma = np.where(value < 0, self.sigma[:, 0], self.sigma[:, 1])
        residual = value / np.sqrt(fade) / sigma
        along = (fade**-1.5 / sigma)[:, None, None]
        return self.index, residual[:, None], (gradient[:, None, :] @ slope) * along


def signed_distance(alpha: np.ndarray, camera: Camera, side: int = 640) -> SignedDistance | None:
    """Signed distance of a matte (H, W) uint8; None where it is empty or full.

    Large mattes are averaged down to about `side` pixels first.
    """
    full, shrink = np.array(alpha.shape[::-1]), max(alpha.shape) / side
    if shrink > 1.0:
        size = np.maximum(np.rint(full / shrink), 1).astype(int)
        alpha = cv2.resize(alpha, size.tolist(), interpolation=cv2.INTER_AREA)
    # Sizes are rounded, so that the two directions differ a little.
    step = full / alpha.shape[::-1]
    inside = alpha >= 128
    if inside.all() or not inside.any():
        return None
    # Distances are to the nearest pixel of the other side, half a pixel beyond the edge.
    values = np.where(inside, 0.5 - edge_distance(inside), edge_distance(~inside) - 0.5)
    # Full pixels know no part cover; a light blur gives the edge its slope back.
    return SignedDistance(cv2.GaussianBlur(values, (0, 0), 0.8) * step.mean(), camera, step)


def sample(distance: SignedDistance, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear value (n,) and gradient (n, 2) at full-size pixels (n, 2), clamped to the image."""
    values = distance.values
    height, width = values.shape
    where = corner_to_cell(pixels / distance.step)
    x, y = np.clip(where, 0.0, [width - 1.001, height - 1.001]).T
    column, row = x.astype(int), y.astype(int)
    fx, fy = x - column, y - row
    a, b = values[row, column], values[row, column + 1]
    c, d = values[row + 1, column], values[row + 1, column + 1]
    value = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
    gradient = np.stack(
        [(b - a) * (1 - fy) + (d - c) * fy, (c - a) * (1 - fx) + (d - b) * fx], axis=1
    )
    return value, gradient / distance.step


def outline_vertices(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, allowed: np.ndarray
) -> np.ndarray:
    """Vertices (n,) that form the outer outline of a mesh in a view, at most POINTS_A_VIEW.

    A vertex counts if it lies between faces turned to and from the camera and projects to within a
    pixel and a half of the edge of the mesh's own mask, so that inner folds do not.

    Args:
        vertices: (V, 3) world.
        faces: (F, 3).
        camera: pinhole.
        allowed: (V,) bool.
    """
    window = _window(vertices, camera)
    if window is None:
        return np.zeros(0, dtype=np.int64)
    edge = _mask_distance(vertices, faces, window)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = ((camera.center - corners[:, 0]) * normals).sum(1) > 0
    turned_to, turned_from = np.zeros(len(vertices), bool), np.zeros(len(vertices), bool)
    turned_to[faces[front].ravel()] = True
    turned_from[faces[~front].ravel()] = True
    chosen = np.flatnonzero(turned_to & turned_from & allowed)
    local = vertices[chosen] @ window.cam_from_world[:3, :3].T + window.cam_from_world[:3, 3]
    pixels = local[:, :2] / local[:, 2:] * window.K[[0, 1], [0, 1]] + window.K[:2, 2]
    column, row = np.floor(pixels).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < window.width) & (row < window.height)
    column, row = np.clip(column, 0, window.width - 1), np.clip(row, 0, window.height - 1)
    chosen = chosen[inside & (edge[row, column] <= 1.5)]
    if len(chosen) > POINTS_A_VIEW:
        chosen = chosen[np.linspace(0, len(chosen) - 1, POINTS_A_VIEW).astype(int)]
    return chosen


def outline_regions(model: HeadModel, bald: bool) -> tuple[np.ndarray, np.ndarray]:
    """Masks (V,) of the vertices that may form an outline, and of those that may be covered."""

    def union(names: tuple[str, ...]) -> np.ndarray:
        return np.any([model.regions[name].numpy() for name in names], axis=0)

    allowed = union(BARE + COVERED) & ~model.regions["boundary"].numpy()
    return allowed, union(("neck",) if bald else COVERED)


def _window(vertices: np.ndarray, camera: Camera) -> Camera | None:
    """A small camera that sees the part of the image where the mesh is."""
    local = vertices @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    if (local[:, 2] <= 1e-3).any():
        return None
    side = max(camera.width, camera.height)
    return resized(
        camera,
        max(1, round(camera.width * OUTLINE_SIDE * 2 / side)),
        max(1, round(camera.height * OUTLINE_SIDE * 2 / side)),
    )


def _mask_distance(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """Distance (H, W) of each pixel inside the mesh's mask to the mask's edge; 0 outside."""
    scene = mesh_scene(vertices, faces)
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        intrinsic_matrix=o3d.core.Tensor(camera.K),
        extrinsic_matrix=o3d.core.Tensor(camera.cam_from_world),
        width_px=camera.width,
        height_px=camera.height,
    )
    return edge_distance(scene.test_occlusions(rays).numpy())
