"""Where the matte of one camera lies about the tracked head, and the head's own matte."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.contract.segmentation_labels import HEAD, LABELS, label_mask
from express50.files.images import edge_distance
from express50.geometry.cameras import Camera, unproject
from express50.geometry.conventions import opencv_pixels_to_corner
from pipelines.regions.mesh import TrackedHead, see

HAIR, TORSO = np.uint8(LABELS.index("hair")), np.uint8(LABELS.index("torso"))


@dataclass(frozen=True)
class Geometry:
    """Every pixel of one camera about the tracked head.

    Attributes:
        mesh: (H, W) uint8 label of the mesh, SCALP among them, 0 where it is not.
        near: (H, W) uint8 label at the nearest pixel of the mesh; 0 where it is in no pixel.
        rim: (H, W) bool, just beyond the mesh.
        height: (H, W) float32 metres over the neck's end; inf where the model does not tell.
    """

    mesh: np.ndarray
    near: np.ndarray
    rim: np.ndarray
    height: np.ndarray

    def labels(self) -> np.ndarray:
        """Labels (H, W) uint8 by geometry alone, as if the matte were everywhere.

        The mesh and its rim are what the mesh is; what lies below the neck's end is torso, all
        else hair.
        """
        around = np.where(self.rim, self.near, HAIR)
        return np.where(
            self.mesh > 0, self.mesh, np.where(self.height < 0, TORSO, around)
        )  # fmt: skip


def place(
    head: TrackedHead, camera: Camera, alpha: np.ndarray, depth: np.ndarray | None, rim_m: float
) -> Geometry:
    """Place a camera's pixels about a head.

    Where the depth map knows nothing, the nearest pixel of the matte that it knows stands in;
    without a depth map, the mesh's own depth. Where the mesh is in no pixel, all is far below the
    neck's end.

    Args:
        head: the tracked head.
        camera: pinhole.
        alpha: (H, W) in [0, 1].
        depth: (H, W) camera z, metres, 0 where unknown; or None.
        rim_m: width of the rim, metres.
    """
    mesh, mesh_depth = see(head, camera)
    hit = mesh > 0
    if not hit.any():
        height = np.full(mesh.shape, np.inf if head.end is None else -np.inf, np.float32)
        return Geometry(mesh, mesh, hit, height)
    row, column, pixels = _nearest(hit)
    surface = mesh_depth[row, column]
    rim = ~hit & (pixels * surface / camera.K[0, 0] <= rim_m)
    known = hit if depth is None else (alpha > 0) & (depth > 0)
    if depth is not None and known.any():
        there = _nearest(known)[:2]
        surface = depth[there]
    height = np.full(mesh.shape, np.inf, np.float32)
    if head.end is not None:
        y, x = np.nonzero(alpha > 0)
        points = unproject(camera, opencv_pixels_to_corner(np.stack([x, y], axis=1)), surface[y, x])
        height[y, x] = head.end.height(points)
    return Geometry(mesh, mesh[row, column], rim, height)


def _nearest(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and distance in pixels (H, W) of the nearest pixel of a mask (H, W)."""
    distance, cell = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    places = np.zeros(int(cell.max()) + 1, np.int64)
    places[cell[mask]] = np.flatnonzero(mask)
    row, column = np.divmod(places[cell], mask.shape[1])
    return row, column, distance


def head_alpha(alpha: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Alpha (H, W) of the head alone by labels (h, w), which may be smaller.

    What is neither head nor torso (strands that a network calls background, glasses, hats,
    collars) goes with the nearer of the two; the cut is a pixel of the matte wide. No head gives
    an empty matte, no torso leaves all.
    """
    head, torso = label_mask(labels, *HEAD), label_mask(labels, "torso")
    if not head.any() or not torso.any():
        return alpha * np.float32(head.any())
    nearer = edge_distance(~torso) - edge_distance(~head)
    if labels.shape != alpha.shape:
        size = alpha.shape[1], alpha.shape[0]
        nearer = cv2.resize(nearer, size, interpolation=cv2.INTER_LINEAR)
        nearer *= max(alpha.shape) / max(labels.shape)
    return alpha * np.clip(0.5 + nearer / 2, 0, 1).astype(np.float32)
