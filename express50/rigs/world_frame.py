"""Check where a rig looks, which every calibration must pass, and choose a solved rig's world.

The cameras of a head rig all look at a point in front of them. A calibration with the wrong
convention (camera to world instead of world to camera, or OpenGL axes instead of OpenCV's) fails
this check, and usually only one convention passes.

The world of a solved rig is made from the cameras alone, so that the same footage always gives the
same one:
- origin: the point nearest to all optical axes (where the rig looks);
- y: up, opposite to the mean of the cameras' downward image axes, or the head's own up if it is
  known and shows that the cameras lie on their sides;
- z: horizontally from the origin towards the mean camera, or towards the first camera by name if
  the rig surrounds the subject and has no such side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from express50.errors import CalibrationError, few
from express50.geometry.cameras import Camera, nearest_to_lines, transform_camera
from express50.geometry.conventions import FLIP_YZ
from express50.geometry.transforms import is_rigid, make_transform

# Below this the mean viewing direction of a rig is noise: the cameras surround the subject.
CLEAR_SIDE = 0.15
# If the cosine to the head's up is below this, the cameras, not the head, lie on their side.
ON_ITS_SIDE = 0.7
# Axes within about 1 degree of parallel have no useful meeting point.
PARALLEL = 3e-4
# A rig whose cameras are closer to the head or farther from it than this is not in metres.
NEAR_M, FAR_M = 0.1, 10.0
# By these shares of their distance axes miss the point nearest to all of them: rigs that were read
# right or wrong.
MEETING, SCATTERED = 0.1, 0.3
UNKNOWN = "is world_to_camera inverted, or are its axes not OpenCV's (x right, y down, z ahead)?"


def meeting_point(cameras: Mapping[str, Camera]) -> np.ndarray | None:
    """Return the point (3,) nearest to all optical axes; None for (nearly) parallel axes."""
    centers = np.array([camera.center for camera in cameras.values()])
    axes = [camera.cam_from_world[2, :3] for camera in cameras.values()]
    middle = centers.mean(0)
    point = nearest_to_lines(centers - middle, axes, PARALLEL * len(cameras))
    return None if point is None else middle + point


def depths_behind(cameras: Mapping[str, Camera]) -> dict[str, float]:
    """Return the depths, metres, of the cameras that have the rig's meeting point behind them.

    Inverted matrices (camera to world) and a wrong axis convention show up here. Empty if the axes
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


def check_meeting(cameras: Mapping[str, Camera], where: str) -> None:
    """Raise CalibrationError unless the point the cameras look at is in front of each of them."""
    for name, camera in cameras.items():
        if not is_rigid(camera.cam_from_world):
            raise CalibrationError(
                f"{where}: the pose of {name} is not a rotation and a translation; expected finite"
                " numbers and det 1: calibrate again"
            )
    problem, remedy = _misreading(cameras)
    if problem:
        raise CalibrationError(f"{where}: {problem}; {remedy or UNKNOWN}")


@dataclass(frozen=True)
class RigVerdict:
    """Figures and warnings about a rig."""

    cameras: int  # number of cameras
    meeting: tuple[float, float, float] | None  # nearest to all axes; None if parallel
    distance_m: float | None  # median distance of the cameras from it
    miss_mm: float | None  # median distance of the axes from it
    problem: str  # what is wrong, empty if nothing is
    remedy: str  # the convention that would fix it, empty if none would
    warnings: tuple[str, ...]  # what is unusual but may be intended


def judge(cameras: Mapping[str, Camera]) -> RigVerdict:
    """Judge a rig of at least one camera."""
    problem, remedy = _misreading(cameras)
    point = meeting_point(cameras)
    if point is None:
        words = ("the axes are parallel",) if len(cameras) > 1 else ()
        return RigVerdict(len(cameras), None, None, None, problem, remedy, words)
    misses, distance = _misses(cameras, point)
    warnings = []
    if not NEAR_M < distance < FAR_M:
        warnings.append(
            f"cameras are {distance:.3g} m from the point they look at: are the calibration's or"
            " board's lengths in metres?"
        )
    stray = [name for name, miss in misses.items() if miss > 0.35 * distance]
    if stray:
        warnings.append(f"{', '.join(stray)}: not looking at the same point as the others")
    for name, camera in cameras.items():
        offset = np.abs(camera.K[:2, 2] / (camera.width, camera.height) - 0.5).max()
        if offset > 0.2:
            warnings.append(
                f"{name}: principal point is {offset:.0%} of the image away from its centre"
            )
    return RigVerdict(
        cameras=len(cameras),
        meeting=(float(point[0]), float(point[1]), float(point[2])),
        distance_m=distance,
        miss_mm=1e3 * float(np.median(list(misses.values()))),
        problem=problem,
        remedy=remedy,
        warnings=tuple(warnings),
    )


def _misreading(cameras: Mapping[str, Camera]) -> tuple[str, str]:
    """Return what is wrong with a rig, and the convention that explains it; "" where unknown.

    Several conventions may put the common point in front of all cameras; the right one is that in
    which their axes meet best.
    """
    problem, spread = "", _scatter(cameras)
    if behind := depths_behind(cameras):
        shown = few([f"{name} (z = {depth:.3g} m)" for name, depth in behind.items()], 4)
        problem = f"the point all cameras look at lies behind {shown}; expected z > 0"
    if not problem and not spread > SCATTERED:
        return "", ""
    readings = {
        "the matrices are camera to world: invert them": lambda T: np.linalg.inv(T),
        "the axes are OpenGL's: flip y and z": lambda T: FLIP_YZ @ T,
        "the matrices are camera to world with OpenGL axes": lambda T: np.linalg.inv(T @ FLIP_YZ),
    }
    found = {}
    for words, read in readings.items():
        other = {
            name: replace(camera, cam_from_world=read(camera.cam_from_world))
            for name, camera in cameras.items()
        }
        if meeting_point(other) is not None and not depths_behind(other):
            found[words] = _scatter(other)
    best = min(found, key=lambda words: found[words], default="")
    if not problem and found.get(best, np.inf) < MEETING:
        problem = (
            "the cameras look at no common point: their axes miss the nearest one by"
            f" {spread:.0%} of their distance"
        )
    return problem, best if problem else ""


def _scatter(cameras: Mapping[str, Camera]) -> float:
    """Return by which share of their distance axes miss their nearest point; 0 if parallel."""
    point = meeting_point(cameras)
    if point is None:
        return 0.0
    misses, distance = _misses(cameras, point)
    return float(np.median(list(misses.values()))) / distance


def _misses(cameras: Mapping[str, Camera], point: np.ndarray) -> tuple[dict[str, float], float]:
    """Return by how far each optical axis misses a point, and the cameras' median distance."""
    gaps = {name: point - camera.center for name, camera in cameras.items()}
    axes = {name: camera.cam_from_world[2, :3] for name, camera in cameras.items()}
    misses = {n: float(np.linalg.norm(g - axes[n] * (axes[n] @ g))) for n, g in gaps.items()}
    return misses, float(np.median([np.linalg.norm(gap) for gap in gaps.values()]))


def canonical_from_rig(
    cameras: Mapping[str, Camera], fallback: np.ndarray, head_up: np.ndarray | None = None
) -> np.ndarray:
    """Return the transform (4, 4) from the rig's space to the canonical world of this module.

    `fallback` (3,), rig space, is the origin if the axes do not meet (one camera, or parallel
    axes); `head_up` (3,) is the direction from chin to crown, if a head is known.
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
    """Return the unit direction of a vector's part perpendicular to `up`; zero if it is tiny."""
    level = vector - up * (up @ vector)
    length = np.linalg.norm(level)
    return level / length if length > 1e-3 * np.linalg.norm(vector) else np.zeros(3)


def move_cameras(cameras: Mapping[str, Camera], new_from_old: np.ndarray) -> dict[str, Camera]:
    """Return all cameras after the world moved by a rigid transform (4, 4)."""
    return {name: transform_camera(camera, new_from_old) for name, camera in cameras.items()}
