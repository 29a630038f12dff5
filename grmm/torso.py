"""Which footage shows shoulders and clothes: a head model has no Gaussians for them.

The paper's data were masked to the head by a segmentation network. Where the shards have labels of
parts, these tell. Else the tracked mesh and the depth map decide: what stands off the neck, or goes
on below its lower end, is torso.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor

from express50.contract.segmentation_labels import TORSO
from express50.head.model import HeadModel
from grmm.scene import View

STAND_OFF_M = 0.025  # a point this far off the neck belongs to a shirt, or to hair upon it
END_M = 0.01  # a point this far off the neck's lower end lies below it
GROW_PX = 2  # blurred borders


def labelled_torso(parts: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool that labels (H, W) of ``segmentation_labels.LABELS`` call torso, grown."""
    torso = parts == TORSO
    return _grown(torso)


def torso_mask(
    head: HeadModel, vertices: Tensor, view: View, alpha: np.ndarray, depth: np.ndarray | None
) -> np.ndarray:
    """Pixels (H, W) bool that show the torso.

    Args:
        head: its regions ``neck`` and ``boundary`` say where the torso begins; without them
            nothing is torso.
        vertices: (V, 3) tracked mesh, head space.
        view: camera in head space.
        alpha: (H, W) uint8 matte.
        depth: (H, W) camera z, metres, 0 where unknown; there the nearest known pixel's is taken.
            None: the mesh's own mean depth stands in.
    """
    foreground = alpha > 12
    neck, end = head.regions.get("neck"), head.regions.get("boundary")
    if neck is None or end is None or not bool(neck.any()) or not foreground.any():
        return np.zeros_like(foreground)
    rows, columns = np.nonzero(foreground)
    points = _points(view, rows, columns, _filled(depth, foreground, vertices, view))
    tree = cKDTree(vertices.detach().cpu().double().numpy())
    distance, nearest = tree.query(points)
    on_neck, on_end = (region.cpu().numpy()[nearest] for region in (neck, end))
    torso = np.zeros_like(foreground)
    torso[rows, columns] = (on_neck & (distance > STAND_OFF_M)) | (on_end & (distance > END_M))
    return _grown(torso)


def _filled(
    depth: np.ndarray | None, foreground: np.ndarray, vertices: Tensor, view: View
) -> np.ndarray:
    """Depth (H, W) without gaps."""
    known = np.zeros_like(foreground) if depth is None else depth > 0
    if depth is None or not known.any():
        camera = view.cam_from_head.to(vertices.dtype)
        return np.full(foreground.shape, float((vertices @ camera[2, :3] + camera[2, 3]).mean()))
    index = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return depth[tuple(index)]


def _points(view: View, rows: np.ndarray, columns: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Head-space points (N, 3) of pixels."""
    K, camera = view.K.cpu().numpy(), view.cam_from_head.cpu().numpy()
    z = depth[rows, columns].astype(np.float64)
    x = (columns + 0.5 - K[0, 2]) / K[0, 0] * z
    y = (rows + 0.5 - K[1, 2]) / K[1, 1] * z
    return (np.stack([x, y, z], 1) - camera[:3, 3]) @ camera[:3, :3]


def _grown(mask: np.ndarray) -> np.ndarray:
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return cv2.dilate(mask.astype(np.uint8), cross, iterations=GROW_PX, borderValue=0) > 0
