"""Outlines of mattes hold the skull, ears and jaw, which carry no landmark.

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
from express50.geometry.pinhole import project_with_slope
from express50.geometry.raycast import mesh_scene
from express50.geometry.sampling import bilinear_slope
from express50.head.model import HeadModel
from pipelines.track.terms import MeshPlaces, Residuals, huber

# Head outlines count as about this many independent points per view.
EFFECTIVE_POINTS = 24
POINTS_PER_VIEW = 60
OUTLINE_SIDE = 384
EDGE_SIGMA_M = 0.0015
# Where hair, cloth or shoulders may stand before the skin: standard deviation of their thickness,
# and the gap (metres) at which what lies inside the matte stops to pull.
COVER_SIGMA_M, HAIR_GAP_M, BALD_GAP_M = 0.008, 0.004, 0.03
COVERED = ("neck", "scalp", "forehead", "left_ear", "right_ear")
BARE = ("face", "nose", "lips")


@dataclass(frozen=True)
class SignedDistance:
    """Signed distance to a matte's edge in pixels, positive outside, with its camera.

    Attributes:
        values: (H, W) float32 at pixel centres.
        camera: pinhole camera of full size.
        step: (2,) full-size pixels per cell, x and y.
    """

    values: np.ndarray
    camera: Camera
    step: np.ndarray


@dataclass(frozen=True)
class OutlineTerm:
    """Vertices on the mesh's outline should lie on the outline of one view's matte.

    Attributes:
        distance: the view's signed distance.
        anchors: n vertices.
        sigma: (n, 2) standard deviations in full-size pixels, inside and outside the matte.
        gap: (n,) pixels inside the matte at which the pull fades.
    """

    distance: SignedDistance
    anchors: MeshPlaces
    sigma: np.ndarray
    gap: np.ndarray

    @classmethod
    def of(
        cls,
        distance: SignedDistance,
        ids: np.ndarray,
        positions: np.ndarray,
        covered: np.ndarray,
        pictures: int,
        bald: bool,
    ) -> OutlineTerm:
        """Make the term of vertices `ids` (n,), now at positions (n, 3).

        `covered` (n,) marks where hair or cloth may hide the skin. Its thickness is much the same
        in all `pictures` of a subject, so more pictures are not more evidence of the skin;
        likewise neighbours on an outline err alike. A `bald` head is pulled from any distance;
        otherwise only a near outline pulls, as hair hides skull, temples and jaw.
        """
        camera, count = distance.camera, len(positions)
        depth = (positions @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]).mean()
        scale = camera.K[0, 0] / max(float(depth), 1e-6)
        redundancy = max(1.0, count / EFFECTIVE_POINTS) ** 0.5
        edge = np.hypot(0.5 * distance.step.max(), EDGE_SIGMA_M * scale)
        cover = np.hypot(edge, COVER_SIGMA_M * scale) * max(1, pictures) ** 0.5
        sigma = np.stack([np.where(covered, cover, edge), np.full(count, edge)], axis=1)
        gap = np.full(count, (BALD_GAP_M if bald else HAIR_GAP_M) * scale)
        return cls(distance, MeshPlaces.of_vertices(ids), sigma * redundancy, gap)

    def residuals(self, places: np.ndarray) -> Residuals:
        """Signed distance over sigma; inside the matte v^2 becomes v^2 / (1 + v^2 / gap^2)."""
        pixels, slope = project_with_slope(self.distance.camera, places)
        value, gradient = sample_distance(self.distance, pixels)
        fade = 1.0 + np.where(value < 0, value / self.gap, 0.0) ** 2
        sigma = np.where(value < 0, self.sigma[:, 0], self.sigma[:, 1])
        residual = value / np.sqrt(fade) / sigma
        along = (fade**-1.5 / sigma)[:, None, None]
        return np.arange(len(places)), residual[:, None], (gradient[:, None] @ slope) * along

    def loss(self, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Huber's."""
        return huber(square)


def signed_distance(alpha: np.ndarray, camera: Camera, side: int = 640) -> SignedDistance | None:
    """Compute the signed distance of a matte (H, W) uint8; None where it is empty or full.

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


def sample_distance(distance: SignedDistance, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate the distance (n,) and its gradient (n, 2) at full-size pixels (n, 2)."""
    value, slope = bilinear_slope(distance.values[..., None], pixels / distance.step)
    return value[:, 0], slope[:, 0] / distance.step


def outline_vertices(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, allowed: np.ndarray
) -> np.ndarray:
    """Find the vertices (n,) on the outer outline of a mesh in a view, at most POINTS_PER_VIEW.

    A vertex counts if it lies between faces turned to and from the camera and projects to within a
    pixel and a half of the edge of the mesh's own mask, so that inner folds do not.

    Args:
        vertices: (V, 3) world.
        faces: (F, 3).
        camera: pinhole.
        allowed: (V,) bool.
    """
    depth = vertices @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
    if (depth <= 1e-3).any():
        return np.zeros(0, dtype=np.int64)
    shrink = OUTLINE_SIDE / max(camera.width, camera.height)
    window = resized(
        camera, max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink))
    )
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
    if len(chosen) > POINTS_PER_VIEW:
        chosen = chosen[np.linspace(0, len(chosen) - 1, POINTS_PER_VIEW).astype(int)]
    return chosen


def outline_regions(model: HeadModel, bald: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return masks (V,) of vertices that may form an outline and of those that may be covered."""

    def union(names: tuple[str, ...]) -> np.ndarray:
        return np.any([model.regions[name].numpy() for name in names], axis=0)

    allowed = union(BARE + COVERED) & ~model.regions["boundary"].numpy()
    return allowed, union(("neck",) if bald else COVERED)


def _mask_distance(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the distance (H, W) of pixels in the mesh's mask to the mask's edge; 0 outside."""
    scene = mesh_scene(vertices, faces)
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        intrinsic_matrix=o3d.core.Tensor(camera.K),
        extrinsic_matrix=o3d.core.Tensor(camera.cam_from_world),
        width_px=camera.width,
        height_px=camera.height,
    )
    return edge_distance(scene.test_occlusions(rays).numpy())


def outline_terms(
    model: HeadModel,
    distances: tuple[SignedDistance, ...],
    mesh: np.ndarray,
    pictures: int,
    bald: bool,
) -> list[OutlineTerm]:
    """Make the outline terms of one frame set on the current mesh (V, 3)."""
    allowed, covered = outline_regions(model, bald)
    faces, terms = model.faces.numpy(), []
    for distance in distances:
        ids = outline_vertices(mesh, faces, distance.camera, allowed)
        if len(ids) >= 8:
            terms.append(OutlineTerm.of(distance, ids, mesh[ids], covered[ids], pictures, bald))
    return terms
