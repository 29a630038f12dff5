"""Labels of one camera: the tracked mesh, and what of the matte stands before, around, below it."""

from __future__ import annotations

import cv2
import numpy as np

from express50.cameras import Camera, unproject
from pipelines.regions.config import RegionsConfig
from pipelines.regions.labels import HEAD, LABELS, label_mask
from pipelines.regions.mesh import TrackedHead

HAIR, TORSO = np.uint8(LABELS.index("hair")), np.uint8(LABELS.index("torso"))


def view_labels(
    head: TrackedHead,
    camera: Camera,
    seen: tuple[np.ndarray, np.ndarray],
    alpha: np.ndarray,
    depth: np.ndarray | None,
    config: RegionsConfig,
) -> np.ndarray:
    """Labels (H, W) uint8, SCALP among them, of every pixel that the matte holds any of.

    A pixel that shows the mesh has the mesh's label, unless the depth map sees something well
    before it. What lies below the neck's end is torso, what lies a little beyond the mesh is as the
    mesh there, all else is hair. Where the depth map knows nothing, the nearest pixel that it
    knows stands in; without a depth map, the mesh's own depth.

    Args:
        head: the tracked head.
        camera: pinhole.
        seen: what the camera sees of the head (``mesh.see``).
        alpha: (H, W) in [0, 1].
        depth: (H, W) camera z, metres, 0 where unknown; or None.
        config: the stage's.
    """
    mesh, mesh_depth = seen
    inside, hit = alpha > 0, mesh > 0
    if not hit.any() or not inside.any():
        return np.where(inside, TORSO if head.end is not None else HAIR, np.uint8(0))
    row, column, pixels_off = _nearest(hit)
    near_depth = mesh_depth[row, column]
    surface = _filled(near_depth, depth, inside)
    before = near_depth - surface > 1e-3 * config.stand_off_mm
    metres_off = pixels_off * near_depth / camera.K[0, 0]
    as_mesh = (metres_off <= 1e-3 * config.rim_mm) & ~before
    labels = np.where(as_mesh, mesh[row, column], HAIR)
    if head.end is not None:
        y, x = np.nonzero(inside & ~(hit & ~before))
        points = unproject(camera, np.stack([x, y], axis=1) + 0.5, surface[y, x])
        under = head.end.below(points)
        labels[y[under], x[under]] = TORSO
    return np.where(inside, labels, np.uint8(0))


def _nearest(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and distance in pixels (H, W) of the nearest pixel of a mask (H, W)."""
    distance, cell = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    place = np.zeros(int(cell.max()) + 1, np.int64)
    place[cell[mask]] = np.flatnonzero(mask)
    row, column = np.divmod(place[cell], mask.shape[1])
    return row, column, distance


def _filled(near_depth: np.ndarray, depth: np.ndarray | None, inside: np.ndarray) -> np.ndarray:
    """Depth (H, W) of what the matte holds, without gaps."""
    known = inside & (depth > 0) if depth is not None else None
    if depth is None or known is None or not known.any():
        return near_depth
    row, column, _ = _nearest(known)
    return depth[row, column]


def head_alpha(alpha: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Alpha (H, W) of the head alone by labels (h, w), which may be smaller.

    What is neither head nor torso (strands that a network calls background, glasses, hats,
    collars) goes with the nearer of the two; the cut is a pixel of the matte wide. No head gives
    an empty matte, no torso leaves all.
    """
    head, torso = label_mask(labels, *HEAD), label_mask(labels, "torso")
    if not head.any() or not torso.any():
        return alpha * np.float32(head.any())
    nearer = _distance(torso) - _distance(head)
    if labels.shape != alpha.shape:
        size = alpha.shape[1], alpha.shape[0]
        nearer = cv2.resize(nearer, size, interpolation=cv2.INTER_LINEAR)
        nearer *= max(alpha.shape) / max(labels.shape)
    return alpha * np.clip(0.5 + nearer / 2, 0, 1).astype(np.float32)


def _distance(mask: np.ndarray) -> np.ndarray:
    """Distance (H, W) to the nearest pixel of a mask (H, W)."""
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
