"""Find glasses before the tracked head, by colour.

Frames are too thin for depth maps. But every view sees a place on a frame in a colour unlike skin,
whereas a place before a bare face has skin behind it in some view. So colours carve the space
before the eyes as silhouettes carve a hull. What is left is glasses if it runs around an eye;
lenses, which show the colours behind them, fill the ring.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import open3d as o3d
from scipy import ndimage

from express50.contract.segmentation_labels import LABELS
from express50.geometry.cameras import Camera, inside_frame
from express50.geometry.raycast import join_rays
from pipelines.regions.colour import colour_logs, like_skin
from pipelines.regions.geometry import TrackedHead, see

EYES, SKIN = LABELS.index("eyes"), LABELS.index("skin")
CELL_M = 0.002
# Of the searched box: half its size beside the eyes and above them, and its ends along the gaze.
BOX_M = ((-0.08, 0.08), (-0.045, 0.04), (-0.03, 0.045))
CLEAR_M, FAR_M = 0.003, 0.03  # from the mesh, between which glasses are looked for
LEAST_VIEWS, ERRING = 4, 16  # views that see an odd colour; one view in so many may see skin
LEAST_SKIN = 200  # pixels of skin in a view that is asked
LEAST_CELLS = 20  # of a connected part
FRONT_M, BRIDGE_M, REACH_M = 0.015, 0.005, 0.045  # depth of a rim, half a bridge, rim from its eye
BEARINGS, AROUND = 24, 0.6  # about an eye, and the share of them that shows a rim
EYE_M = 0.015  # radius of an eye with its lashes and shadow, which are not glasses
WIDER_M = 0.0012  # by which cells are wider than glasses: odd pixels are dilated by one

Picture = tuple[Camera, np.ndarray, np.ndarray]
"""A pinhole camera, its frame (H, W, 3) uint8 and its matte (H, W) in [0, 1]."""


def find_glasses(head: TrackedHead, pictures: Sequence[Picture]) -> np.ndarray:
    """Find places (n, 3), world, CELL_M apart, all over frames and lenses; none without glasses."""
    nothing = np.zeros((0, 3))
    eyes = (head.vertices[head.labels.vertices == EYES] - head.center) @ head.R
    if not len(eyes) or len(pictures) < LEAST_VIEWS:
        return nothing
    sides = [eyes[eyes[:, 0] * side > np.median(eyes[:, 0]) * side] for side in (-1, 1)]
    eyes = np.array([np.r_[eye.mean(0)[:2], eye[:, 2].max()] for eye in sides])
    axes = [np.arange(low, high, CELL_M) for low, high in BOX_M]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) + eyes.mean(0)
    odd = _odd(head, pictures, grid.reshape(-1, 3)).reshape(grid.shape[:3])
    parts, _ = ndimage.label(odd, np.ones((3, 3, 3)))
    odd &= (np.bincount(parts.ravel()) >= LEAST_CELLS)[parts]
    frame = grid[odd]
    beside = np.abs(frame[:, 0] - eyes[:, 0].mean()) > BRIDGE_M
    near = [np.linalg.norm(frame[:, :2] - eye[:2], axis=1) for eye in eyes]
    lenses = []
    for k, eye in enumerate(eyes):
        rim = frame[beside & (near[k] < np.minimum(near[1 - k], REACH_M))]
        if _is_around(rim, eye):
            lenses.append(_lens(rim, grid[:, :, 0, :2]))
    return np.concatenate([frame, *lenses]) @ head.R.T + head.center if lenses else nothing


def _odd(head: TrackedHead, pictures: Sequence[Picture], grid: np.ndarray) -> np.ndarray:
    """Mark the places (N,) of a grid (N, 3), about the head's centre, that no view sees as skin."""
    local = (grid @ head.R.T).astype(np.float32)
    apart = head.scene.compute_distance(o3d.core.Tensor(local), nthreads=1).numpy()
    ids = np.flatnonzero((apart > CLEAR_M) & (apart < FAR_M))
    odd, seen = np.zeros(len(ids), int), np.zeros(len(ids), int)
    for camera, rgb, alpha in pictures:
        open_still = seen - odd <= len(pictures) // ERRING  # the others are skin, or beside it
        ids, odd, seen = ids[open_still], odd[open_still], seen[open_still]
        places = local[ids]
        mesh, _ = see(head, camera)
        skin = (mesh == SKIN) & (alpha > 0.99)
        if skin.sum() < LEAST_SKIN:
            continue
        logs = colour_logs(rgb)
        unlike = ~like_skin(logs.reshape(-1, 3), logs[skin]).reshape(skin.shape)
        shown = cv2.dilate((unlike & (alpha > 0.5)).astype(np.uint8), np.ones((3, 3), np.uint8))
        pixels, inside = inside_frame(camera, places + head.center)
        column, row = np.clip(pixels.astype(np.int64), 0, np.array(skin.shape[::-1]) - 1).T
        rays = join_rays(places, camera.center - head.center - places)
        inside &= ~head.scene.test_occlusions(rays, nthreads=1).numpy()
        seen += inside
        odd += inside & (shown[row, column] > 0)
    found = np.zeros(len(grid), bool)
    found[ids[(odd >= LEAST_VIEWS) & (seen - odd <= seen // ERRING)]] = True
    return found


def _is_around(rim: np.ndarray, eye: np.ndarray) -> bool:
    """Check that a rim (N, 3) runs around an eye (3,), in axes of the head; brows do not."""
    off = rim[:, :2] - eye[:2]
    x, y = off[np.linalg.norm(off, axis=1) > EYE_M].T
    bearing = ((np.arctan2(y, x) / (2 * np.pi) % 1) * BEARINGS).astype(int)
    return len(np.unique(bearing)) >= AROUND * BEARINGS


def _lens(rim: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Fill a rim (N, 3) with places (n, 3); `grid` (nx, ny, 2) has the columns along the gaze."""
    rim = rim[rim[:, 2] > np.quantile(rim[:, 2], 0.9) - FRONT_M]  # without the bar to the ear
    outline = cv2.convexHull(((rim[:, :2] - grid[0, 0]) / CELL_M).round().astype(np.int32))
    filled = cv2.fillConvexPoly(np.zeros(grid.shape[1::-1], np.uint8), outline, 1).T > 0
    plane = np.linalg.lstsq(np.c_[rim[:, :2], np.ones(len(rim))], rim[:, 2], rcond=None)[0]
    places = grid[filled]
    return np.c_[places, np.c_[places, np.ones(len(places))] @ plane]


def shown_before(places: np.ndarray, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return pixels (H, W) bool that show places (n, 3) of glasses before a head.

    The depth (H, W) is the head's, camera z in metres, 0 beside it.
    """
    found = np.zeros(depth.shape, np.uint8)
    pixels, inside = inside_frame(camera, places)
    ahead = places[inside] @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
    column, row = pixels[inside].astype(np.int64).T
    clear = (depth[row, column] == 0) | (ahead < depth[row, column])
    found[row[clear], column[clear]] = 1
    if not clear.any():
        return found > 0
    metre_px = camera.K[0, 0] / np.median(ahead)
    size = (int(np.ceil(CELL_M * metre_px)) | 1) + 2
    whole = cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    size = 2 * round(WIDER_M * metre_px) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.erode(whole, kernel) > 0
