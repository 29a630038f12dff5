"""Judge a rig: where its cameras look, and which misreading of its matrices would explain it.

Cameras of a head rig look at one place in front of them all. A calibration read the wrong way round
(camera to world for world to camera, or OpenGL axes for OpenCV's) fails this, and usually only one
reading passes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.conventions import FLIP_YZ
from express50.rigs.world_frame import depths_behind, describe_behind, meeting_point

# A rig whose cameras stand closer or further from the head than this is not in metres.
NEAR_M, FAR_M = 0.1, 10.0


@dataclass(frozen=True)
class RigVerdict:
    """Figures and warnings of a rig.

    Attributes:
        cameras: how many.
        meeting: (3,) world point nearest to all axes, None when they are parallel.
        distance_m: median distance of the cameras from it.
        miss_mm: median distance of the axes from it.
        problem: what is wrong, empty if nothing is.
        remedy: the reading that would fix it, empty if none would.
        warnings: what is unusual but may be intended.
    """

    cameras: int
    meeting: tuple[float, float, float] | None
    distance_m: float | None
    miss_mm: float | None
    problem: str
    remedy: str
    warnings: tuple[str, ...]


def judge(cameras: Mapping[str, Camera]) -> RigVerdict:
    """Judge a rig of at least one camera."""
    problem = describe_behind(depths_behind(cameras))
    point = meeting_point(cameras)
    if point is None:
        return RigVerdict(len(cameras), None, None, None, problem, "", ("the axes are parallel",))
    distances = [float(np.linalg.norm(c.center - point)) for c in cameras.values()]
    misses = [_miss(c, point) for c in cameras.values()]
    distance = float(np.median(distances))
    return RigVerdict(
        cameras=len(cameras),
        meeting=(float(point[0]), float(point[1]), float(point[2])),
        distance_m=distance,
        miss_mm=1e3 * float(np.median(misses)),
        problem=problem,
        remedy=_remedy(cameras) if problem else "",
        warnings=tuple(_warnings(cameras, distance, misses)),
    )


def _miss(camera: Camera, point: np.ndarray) -> float:
    """Distance, metres, of a camera's optical axis from a point."""
    axis = camera.cam_from_world[2, :3]
    gap = point - camera.center
    return float(np.linalg.norm(gap - axis * (axis @ gap)))


def _remedy(cameras: Mapping[str, Camera]) -> str:
    """Name the first other reading of the matrices that passes."""
    readings = {
        "the matrices are camera to world: invert them": lambda T: np.linalg.inv(T),
        "the axes are OpenGL's: flip y and z": lambda T: FLIP_YZ @ T,
        "the matrices are camera to world with OpenGL axes": lambda T: np.linalg.inv(T @ FLIP_YZ),
    }
    for words, read in readings.items():
        other = {
            name: replace(camera, cam_from_world=read(camera.cam_from_world))
            for name, camera in cameras.items()
        }
        if meeting_point(other) is not None and not depths_behind(other):
            return words
    return ""


def _warnings(cameras: Mapping[str, Camera], distance: float, misses: list[float]) -> list[str]:
    found = []
    if not NEAR_M < distance < FAR_M:
        found.append(f"cameras stand {distance:.3g} m from where they look: are the units metres?")
    stray = [n for n, miss in zip(cameras, misses, strict=True) if miss > 0.35 * distance]
    if stray:
        found.append(f"{', '.join(stray)} look elsewhere than the others")
    for name, camera in cameras.items():
        offset = np.abs(camera.K[:2, 2] / (camera.width, camera.height) - 0.5).max()
        if offset > 0.2:
            found.append(f"{name}: principal point {offset:.0%} of the image from its middle")
    return found
