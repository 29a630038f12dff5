"""Fit the skull, ears and jaw, which have no landmarks, to the outlines of mattes.

The signed distance to the matte's edge is sampled under the vertices that form the outline of the
current mesh, so no point-to-point matching is needed and the residual is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from express50.geometry.cameras import (
    Camera,
    depth_in,
    project_pinhole,
    project_with_slope,
    resized,
)
from express50.geometry.pixels import edge_distance
from express50.geometry.raycast import mesh_scene
from express50.geometry.sampling import bilinear_slope
from express50.head.model import HeadModel, in_regions
from pipelines.track.surface import SignedDistance, near_things
from pipelines.track.terms import MeshPlaces, Residuals, huber

# A head's outline counts as about this many independent points per view.
EFFECTIVE_POINTS = 24
POINTS_PER_VIEW = 60
OUTLINE_SIDE, MATTE_SIDE = 384, 640
EDGE_SIGMA_M = 0.0015
# Where hair, cloth or shoulders may hide the skin: standard deviation of their thickness, and the
# gap (metres) at which the pull on vertices inside the matte has faded.
COVER_SIGMA_M, HAIR_GAP_M, BALD_GAP_M = 0.008, 0.004, 0.03
COVERED = ("neck", "scalp", "forehead", "left_ear", "right_ear")
BARE = ("face", "nose", "lips")


@dataclass(frozen=True)
class OutlineTerm:
    """Vertices on the mesh's outline should lie on the outline of one view's matte."""

    distance: SignedDistance
    anchors: MeshPlaces
    sigma: np.ndarray  # (n, 2) standard deviations, pixels, inside and outside the matte
    gap: np.ndarray  # (n,) pixels at which the pull fades inside the matte

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

        `covered` (n,) marks where hair or cloth may hide the skin. Its thickness is similar in
        all `pictures` of a subject, so more pictures add no evidence of the skin; neighbours on an
        outline err together too. A `bald` head is pulled from any distance, any other only by a
        near outline, because hair hides skull, temples and jaw.
        """
        camera, count = distance.camera, len(positions)
        depth = float(depth_in(camera, positions).mean())
        scale = camera.K[0, 0] / max(depth, 1e-6)
        redundancy = max(1.0, count / EFFECTIVE_POINTS) ** 0.5
        edge = np.hypot(0.5 * distance.step.max(), EDGE_SIGMA_M * scale)
        cover = np.hypot(edge, COVER_SIGMA_M * scale) * max(1, pictures) ** 0.5
        sigma = np.stack([np.where(covered, cover, edge), np.full(count, edge)], axis=1)
        gap = np.full(count, (BALD_GAP_M if bald else HAIR_GAP_M) * scale)
        return cls(distance, MeshPlaces.of_vertices(ids), sigma * redundancy, gap)

    def residuals(self, places: np.ndarray) -> Residuals:
        """Return the signed distance over sigma.

        Inside the matte, v^2 becomes v^2 / (1 + v^2 / gap^2).
        """
        pixels, slope = project_with_slope(self.distance.camera, places)
        value, gradient = sample_distance(self.distance, pixels)
        fade = 1.0 + np.where(value < 0, value / self.gap, 0.0) ** 2
        sigma = np.where(value < 0, self.sigma[:, 0], self.sigma[:, 1])
        residual = value / np.sqrt(fade) / sigma
        along = (fade**-1.5 / sigma)[:, None, None]
        return np.arange(len(places)), residual[:, None], (gradient[:, None] @ slope) * along

    loss = staticmethod(huber)


def matte_distance(alpha: np.ndarray, camera: Camera) -> SignedDistance | None:
    """Compute the signed distance of a matte (H, W) uint8; None where it is empty or full.

    Large mattes are averaged down to about MATTE_SIDE pixels first.
    """
    full, shrink = np.array(alpha.shape[::-1]), max(alpha.shape) / MATTE_SIDE
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
    # A mask has no partly covered pixels; a light blur restores the edge's slope.
    return SignedDistance(cv2.GaussianBlur(values, (0, 0), 0.8) * step.mean(), camera, step)


def sample_distance(distance: SignedDistance, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate the distance (n,) and its gradient (n, 2) at full-size pixels (n, 2)."""
    value, slope = bilinear_slope(distance.values[..., None], pixels / distance.step)
    return value[:, 0], slope[:, 0] / distance.step


def outline_vertices(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, allowed: np.ndarray
) -> np.ndarray:
    """Find vertices (n,) on the outer outline of a mesh in a view, at most POINTS_PER_VIEW.

    A vertex counts if it is `allowed` (V,), lies between faces turned to and from the camera and
    projects to within a pixel and a half of the edge of the mesh's own mask, so that inner folds do
    not.
    """
    if (depth_in(camera, vertices) <= 1e-3).any():
        return np.zeros(0, dtype=np.int64)
    shrink = OUTLINE_SIDE / max(camera.width, camera.height)
    window = resized(
        camera, max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink))
    )
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        o3d.core.Tensor(window.K), o3d.core.Tensor(window.cam_from_world),
        window.width, window.height,
    )  # fmt: skip
    edge = edge_distance(mesh_scene(vertices, faces).test_occlusions(rays).numpy())
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = ((camera.center - corners[:, 0]) * normals).sum(1) > 0
    turned_to, turned_from = np.zeros(len(vertices), bool), np.zeros(len(vertices), bool)
    turned_to[faces[front].ravel()] = True
    turned_from[faces[~front].ravel()] = True
    chosen = np.flatnonzero(turned_to & turned_from & allowed)
    cell = np.floor(project_pinhole(window, vertices[chosen])[0]).astype(int)
    size = np.array([window.width, window.height])
    column, row = np.clip(cell, 0, size - 1).T
    chosen = chosen[((cell >= 0) & (cell < size)).all(1) & (edge[row, column] <= 1.5)]
    if len(chosen) > POINTS_PER_VIEW:
        chosen = chosen[np.linspace(0, len(chosen) - 1, POINTS_PER_VIEW).astype(int)]
    return chosen


def outline_terms(
    model: HeadModel,
    distances: tuple[SignedDistance, ...],
    mesh: np.ndarray,
    pictures: int,
    bald: bool,
    hidden: np.ndarray,
    things: np.ndarray,
) -> list[OutlineTerm]:
    """Make a frame set's outline terms on the current mesh (V, 3).

    Vertices that are `hidden` (V,), lie behind `things` (n, 3) in a view, or whose nearest edge of
    the matte is that of a thing, are left out.
    """
    allowed = in_regions(model, BARE + COVERED) & ~in_regions(model, ("boundary",)) & ~hidden
    covered = in_regions(model, ("neck",) if bald else COVERED)
    faces, terms = model.faces.numpy(), []
    for distance in distances:
        camera = distance.camera
        ids = outline_vertices(mesh, faces, camera, allowed)
        pixels, _ = project_pinhole(camera, mesh[ids])
        value, slope = sample_distance(distance, pixels)
        edge = pixels - value[:, None] * slope  # of the matte, which may be a thing's
        ids = ids[~(near_things(things, camera, pixels) | near_things(things, camera, edge))]
        if len(ids) >= 8:
            terms.append(OutlineTerm.of(distance, ids, mesh[ids], covered[ids], pictures, bald))
    return terms
