"""The world a board calibration is delivered in, and the checks any calibration must pass.

The world is made from the cameras alone, so that the same footage always gives the same one:
- origin: the point nearest to all optical axes (where the rig looks);
- y: up, against the mean of the cameras' downward image axes, or the head's own up where that is
  known and says that the cameras lie on their sides;
- z: from the origin towards the mean camera, level; a rig round the whole subject has no such
  side, then towards the first camera by name.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera, transform_camera
from express50.geometry.transforms import make_transform

# Below this the mean viewing side of a rig is noise: the cameras stand all round.
CLEAR_SIDE = 0.15
# Cosine to the head's up below which the cameras, not the head, lie on their side.
ON_ITS_SIDE = 0.7
# Axes within about 1 degree of parallel meet nowhere in particular.
PARALLEL = 3e-4


def meeting_point(cameras: Mapping[str, Camera]) -> np.ndarray | None:
    """Point (3,) nearest to all optical axes in least squares; None for (nearly) parallel axes."""
    total, right = np.zeros((3, 3)), np.zeros(3)
    middle = np.mean([c.center for c in cameras.values()], axis=0)
    for camera in cameras.values():
        axis = camera.cam_from_world[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        total += across
        right += across @ (camera.center - middle)
    if np.linalg.eigvalsh(total)[0] < PARALLEL * len(cameras):
        return None
    return middle + np.linalg.solve(total, right)


def depths_behind(cameras: Mapping[str, Camera]) -> dict[str, float]:
    """Return the depths, metres, of the cameras that have the rig's meeting point behind them.

    Inverted matrices (camera to world) and a wrong axis convention show here. Empty where the axes
    do not meet.
    """
    point = meeting_point(cameras)
    if point is None:
        return {}
    extent = float(np.median([np.linalg.norm(c.center - point) for c in cameras.values()]))
    depths = {
        name: float((c.cam_from_world[:3, :3] @ point + c.cam_from_world[:3, 3])[2])
        for name, c in sorted(cameras.items())
    }
    return {name: depth for name, depth in depths.items() if depth <= 0.01 * extent}


def describe_behind(depths: Mapping[str, float]) -> str:
    """Put the result of `depths_behind` into words; empty where it is empty."""
    if not depths:
        return ""
    shown = ", ".join(f"{name} (z = {depth:.3g} m)" for name, depth in list(depths.items())[:4])
    more = f" and {len(depths) - 4} more" if len(depths) > 4 else ""
    return f"the point all cameras look at lies behind {shown}{more}; expected z > 0"


def check_meeting(cameras: Mapping[str, Camera], where: str) -> None:
    """Raise CalibrationError unless the point the cameras look at is in front of each of them."""
    depths = depths_behind(cameras)
    if depths:
        raise CalibrationError(
            f"{where}: {describe_behind(depths)}; "
            "is world_to_camera inverted, or are its axes not OpenCV's (x right, y down, z ahead)?"
        )


def canonical_from_rig(
    cameras: Mapping[str, Camera], fallback: np.ndarray, head_up: np.ndarray | None = None
) -> np.ndarray:
    """Transform (4, 4) from the rig's space to the canonical world of this module.

    `fallback` (3,), rig space, is the origin when the axes do not meet (one camera, or parallel);
    `head_up` (3,) is the direction from chin to crown, where a head is known.
    """
    met = meeting_point(cameras)
    origin = fallback if met is None else met
    names = sorted(cameras)
    up = -np.mean([cameras[name].cam_from_world[1, :3] for name in names], axis=0)
    if np.linalg.norm(up) < CLEAR_SIDE:
        up = -cameras[names[0]].cam_from_world[1, :3]
    y = up / np.linalg.norm(up)
    if head_up is not None and head_up @ y < ON_ITS_SIDE * np.linalg.norm(head_up):
        y = head_up / np.linalg.norm(head_up)
    towards = [_level(cameras[name].center - origin, y) for name in names]
    z = np.mean(towards, axis=0)
    if np.linalg.norm(z) < CLEAR_SIDE:
        z = towards[0]
    if np.linalg.norm(z) < CLEAR_SIDE:  # the first camera stands right above: any level axis
        z = max((_level(axis, y) for axis in np.eye(3)), key=np.linalg.norm)
    z = z / np.linalg.norm(z)
    R = np.stack([np.cross(y, z), y, z])
    return make_transform(R, -R @ origin)


def _level(vector: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Unit direction of a vector's part across `up`; zero if there is hardly any."""
    level = vector - up * (up @ vector)
    length = np.linalg.norm(level)
    return level / length if length > 1e-3 * np.linalg.norm(vector) else np.zeros(3)


def move_cameras(cameras: Mapping[str, Camera], new_from_old: np.ndarray) -> dict[str, Camera]:
    """All cameras after the world moved by a rigid transform (4, 4)."""
    return {name: transform_camera(camera, new_from_old) for name, camera in cameras.items()}
