"""The camera rig: N cameras on a sphere segment around the subject, denser at the front."""

from __future__ import annotations

import math

import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at
from express50.twin.noise import random_stream

TARGET = np.array([0.0, 1.25, 0.0])  # where heads are: a seated person, y up, metres
SPAN_DEG = 300.0
RADIUS_M = 1.05
FRAME_M = 0.43  # what the shorter image side shows at the target; a head fills about 60 %
_RINGS_DEG = (4.0, 21.0, -13.0, 11.0, 28.0, -4.0)


def make_rig(count: int, width: int, height: int, seed: int) -> dict[str, Camera]:
    """Draw cameras cam00... by id, distorted (COLMAP's OPENCV model), in the true world.

    The rig belongs to the seed alone: every subject is recorded by the same cameras. Camera 0 is
    the leftmost as the subject sees it; the world's y is up and subjects look along +z.
    """
    rng = random_stream(seed, 101)
    cameras = {}
    for index in range(count):
        camera_id = f"cam{index:02d}"
        place = 2.0 * (index + 0.5) / count - 1.0
        # A slope below one in the middle packs the cameras at the front.
        azimuth = math.radians(0.5 * SPAN_DEG) * (0.8 * place + 0.2 * place**3)
        azimuth += math.radians(rng.uniform(-2.0, 2.0))
        elevation = math.radians(_RINGS_DEG[index % len(_RINGS_DEG)] + rng.uniform(-1.5, 1.5))
        radius = RADIUS_M * (1.0 + rng.uniform(-0.04, 0.04))
        out = np.array(
            [
                -math.sin(azimuth) * math.cos(elevation),
                math.sin(elevation),
                math.cos(azimuth) * math.cos(elevation),
            ]
        )
        aim = TARGET + rng.uniform(-0.012, 0.012, 3)
        tilt = np.array([math.tan(math.radians(rng.uniform(-1.5, 1.5))), 1.0, 0.0])
        pose = look_at(TARGET + radius * out, aim, tilt)
        cameras[camera_id] = Camera(
            camera_id, width, height, "OPENCV", _intrinsics(rng, radius, width, height), pose
        )
    return cameras


def _intrinsics(
    rng: np.random.Generator, radius: float, width: int, height: int
) -> tuple[float, ...]:
    """Draw focal lengths, principal point and distortion of one lens, COLMAP's OPENCV order."""
    short = min(width, height)
    focal = short * radius / FRAME_M * (1.0 + rng.uniform(-0.02, 0.02))
    aspect = 1.0 + rng.uniform(-0.0015, 0.0015)
    cx, cy = np.array([width, height]) / 2 + short * rng.uniform(-0.012, 0.012, 2)
    k1, k2 = rng.uniform(-0.22, -0.08), rng.uniform(0.05, 0.3)
    p1, p2 = rng.uniform(-0.0012, 0.0012, 2)
    return tuple(float(x) for x in (focal, focal * aspect, cx, cy, k1, k2, p1, p2))
