"""The space that the cameras of a moment share, and what each of them sees in it.

Space is a cube of cells around the point that the cameras look at, in units of the rig's own, so
that neither metres nor the world's origin matter. A ball in it is in view of most cameras; there
every camera's silhouette counts (visual hull, Laurentini 1994, but by votes: a place is empty
where several cameras see clear background). Outside the ball few cameras see anything: only what
continues the subject out of it, such as the shoulders, is possible there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_centres
from express50.rigs.world_frame import meeting_point

CUBE = 1.6  # half side of the cube, in radii of the ball
BODY = 0.8  # radii that the subject may reach on from where it leaves the ball
FAINT = 0.03  # alpha below this is clear background
INSIDE = 0.5  # alpha from which a pixel shows the subject
OUT, CLEAR, RIM, SOLID = range(4)  # what a view says of a cell


@dataclass(frozen=True)
class Ball:
    """Centre (3,) and radius, world units, of the unit ball that views are compared in."""

    center: np.ndarray
    radius: float


@dataclass(frozen=True)
class View:
    """One camera's reduced picture and matte.

    Attributes:
        name: camera id.
        projection: (3, 4) float32 from the unit ball's coordinates to (x, y, 1) z, pixels.
        center: (3,) camera centre in the ball's coordinates.
        rgb: (h, w, 3) uint8.
        alpha: (h, w) float32 in [0, 1].
        valid: (h, w) bool, pixels with footage.
    """

    name: str
    projection: np.ndarray
    center: np.ndarray
    rgb: np.ndarray
    alpha: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True)
class Space:
    """Counts (n, n, n) uint16 of the views that see a cell, see it clear, see the subject there.

    Attributes:
        axis: (n,) float32 coordinates of the cells, the same along x, y and z.
        seen, clear, solid: the counts.
        labels: what each view says of each pixel, (h * w + 1,) uint8, the last for "not in view".
    """

    axis: np.ndarray
    seen: np.ndarray
    clear: np.ndarray
    solid: np.ndarray
    labels: dict[str, np.ndarray]


def ball_of(cameras: Mapping[str, Camera]) -> Ball | None:
    """The ball about what the cameras look at, as large as most have whole in view.

    None where the optical axes are parallel or most cameras do not look at where they meet.
    """
    center = meeting_point(cameras)
    if center is None:
        return None
    extents = []
    for camera in cameras.values():
        depth = camera.cam_from_world[2, :3] @ center + camera.cam_from_world[2, 3]
        extents.append(depth * min(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]))
    radius = float(np.median(extents)) / 2
    return Ball(center, radius) if radius > 0 else None


def projection_of(camera: Camera, ball: Ball) -> np.ndarray:
    """Projection (3, 4) float32 of the ball's coordinates into a pinhole camera's image."""
    R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    # Over the radius, so that depths are in its units too and float32 suffices.
    offset = (R @ ball.center + t) / ball.radius
    return np.column_stack([camera.K @ R, camera.K @ offset]).astype(np.float32)


def center_of(camera: Camera, ball: Ball) -> np.ndarray:
    """A camera's centre (3,) in the ball's coordinates."""
    return (camera.center - ball.center) / ball.radius


def label_pixels(view: View, margin: float) -> np.ndarray:
    """What a view says of its pixels (h * w + 1,) uint8; clear is further than `margin` pixels."""
    opaque = view.alpha > FAINT
    labels = np.full(opaque.shape, CLEAR, np.uint8)
    if opaque.any():
        distance = cv2.distanceTransform((~opaque).astype(np.uint8), cv2.DIST_L2, 5)
        labels[distance <= margin] = RIM
    labels[view.alpha > INSIDE] = SOLID
    # What the image cuts off goes on behind its border: nothing is clear next to no footage.
    beyond = cv2.dilate((~view.valid).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    labels[beyond & (labels == CLEAR)] = OUT
    labels[~view.valid] = OUT
    return np.append(labels.ravel(), np.uint8(OUT))


def cells_in(view: View, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel that each cell falls on, h * w where out of view, and its depth; (n, n, n) each."""
    height, width = view.alpha.shape
    P = view.projection
    x, y, z = (
        P[i, 0] * axis[:, None, None] + P[i, 1] * axis[:, None] + (P[i, 2] * axis + P[i, 3])
        for i in range(3)
    )
    ahead = z > 1e-6
    scale = 1 / np.where(ahead, z, np.float32(1))
    x, y = x * scale, y * scale
    inside = ahead & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = np.where(inside, x, 0).astype(np.int32), np.where(inside, y, 0).astype(np.int32)
    return np.where(inside, y * width + x, height * width), z


def make_space(views: Sequence[View], cells: int, margin: float) -> Space:
    """Count what every view says of every cell; `margin` is in pixels."""
    axis = (CUBE * (cell_centres(cells) / cells * 2 - 1)).astype(np.float32)
    seen, clear, solid = (np.zeros((cells,) * 3, np.uint16) for _ in range(3))
    labels = {}
    for view in views:
        labels[view.name] = label_pixels(view, margin)
        said = labels[view.name][cells_in(view, axis)[0]]
        seen += said != OUT
        clear += said == CLEAR
        solid += said == SOLID
    return Space(axis, seen, clear, solid, labels)


def subject_place(space: Space, votes: int) -> np.ndarray:
    """Cells (n, n, n) bool where the subject may be: the ball, and where it leaves the ball."""
    a = space.axis
    square = a[:, None, None] ** 2 + a[:, None] ** 2 + a**2
    ball = square <= 1
    parts, count = ndimage.label((space.clear < votes) & (space.solid >= 2) & ball)
    if not count:
        return ball
    weight = np.bincount(parts.ravel(), weights=space.solid.ravel())
    subject = parts == 1 + int(np.argmax(weight[1:]))
    step = a[1] - a[0]
    leaves = subject & (square > (1 - 2 * step) ** 2)
    if not leaves.any():
        return ball
    return ball | (ndimage.distance_transform_edt(~leaves) * step <= BODY)


def splat(shape: tuple[int, int], pixels: np.ndarray, spread: int) -> np.ndarray:
    """Pixels (h, w) bool that cells fall on (N,), each `spread` pixels around."""
    hit = np.zeros(shape[0] * shape[1] + 1, np.uint8)
    hit[pixels] = 1
    side = 2 * spread + 1
    return cv2.dilate(hit[:-1].reshape(shape), np.ones((side, side), np.uint8)) > 0


def cell_spread(view: View, axis: np.ndarray) -> int:
    """Pixels around a cell's own within which its neighbours fall: splats then leave no gap."""
    focal = float(np.linalg.norm(view.projection[0, :3]))
    return max(1, int(np.ceil(focal * float(axis[1] - axis[0]) / float(view.projection[2, 3]) / 2)))
