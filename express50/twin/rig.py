"""Place the rig's cameras, and turn light into pictures as their sensors do.

The cameras stand on a part of a sphere around the subject, closer together at the front.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from express50.files.images import linear_to_srgb
from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_centres
from express50.geometry.transforms import look_at

TARGET = np.array([0.0, 1.25, 0.0])  # where heads are: a seated person, y up, metres
SPAN_DEG = 300.0
RADIUS_M = 1.05
FRAME_M = 0.43  # what the shorter image side shows at the target; a head fills about 60 %
_RINGS_DEG = (4.0, 21.0, -13.0, 11.0, 28.0, -4.0)


def make_rig(count: int, width: int, height: int, seed: int) -> dict[str, Camera]:
    """Draw cameras cam00... by id, distorted (COLMAP's OPENCV model), in the true world.

    The rig depends on the seed alone: the same cameras record every subject. Camera 0 is leftmost
    as the subject sees it; the world's y is up and subjects look along +z.
    """
    rng = np.random.default_rng([seed, 101])
    cameras, short = {}, min(width, height)
    for index in range(count):
        camera_id = f"cam{index:02d}"
        place = 2.0 * (index + 0.5) / count - 1.0
        # The slope is under 1 in the middle, so cameras are closer at the front.
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
        focal = short * radius / FRAME_M * (1.0 + rng.uniform(-0.02, 0.02))
        aspect = 1.0 + rng.uniform(-0.0015, 0.0015)
        cx, cy = np.array([width, height]) / 2 + short * rng.uniform(-0.012, 0.012, 2)
        k1, k2 = rng.uniform(-0.22, -0.08), rng.uniform(0.05, 0.3)
        p1, p2 = rng.uniform(-0.0012, 0.0012, 2)
        lens = tuple(float(x) for x in (focal, focal * aspect, cx, cy, k1, k2, p1, p2))
        cameras[camera_id] = Camera(camera_id, width, height, "OPENCV", lens, pose)
    return cameras


_SHOT, _READ = 0.0055, 0.0016  # noise of a clean studio exposure, linear light
_KNEE = 0.75
_CURVE_STEPS = 16384


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One camera's colour gain (3,), and how much darker its corners are."""

    gain: np.ndarray
    vignette: float


def make_sensor(camera_index: int, seed: int) -> Sensor:
    """Draw a camera's sensor."""
    rng = np.random.default_rng([seed, 301, camera_index])
    gain = 0.85 * rng.uniform(0.94, 1.06) * (1.0 + rng.normal(0.0, 0.025, 3))
    return Sensor(gain=gain.astype(np.float32), vignette=float(rng.uniform(0.02, 0.08)))


def expose(
    sensor: Sensor, linear: np.ndarray, rng: np.random.Generator, noise: float
) -> np.ndarray:
    """Return the 8-bit sRGB picture (H, W, 3) of linear light (H, W, 3) float32."""
    height, width = linear.shape[:2]
    y = cell_centres(height).astype(np.float32) / height * 2 - 1
    x = cell_centres(width).astype(np.float32) / width * 2 - 1
    falloff = 1.0 - sensor.vignette * 0.5 * (x[None] ** 2 + y[:, None] ** 2)
    signal = linear * sensor.gain * falloff[..., None]
    if noise > 0:
        grain = rng.standard_normal(signal.shape, dtype=np.float32)
        signal = signal + noise * grain * np.sqrt(_READ**2 + _SHOT**2 * np.maximum(signal, 0.0))
    steps = np.clip(signal * (_CURVE_STEPS / 2.0), 0, _CURVE_STEPS - 1).astype(np.int32)
    return _CURVE[steps]


# 8-bit levels of linear light 0 to 2 in steps of at most half a level. Light over the knee is
# compressed, so that highlights do not clip abruptly.
_LIGHT = (np.arange(_CURVE_STEPS) + 0.5) * 2.0 / _CURVE_STEPS
_OVER = 1.0 - np.exp(-np.maximum(_LIGHT - _KNEE, 0.0) / (1 - _KNEE))
_CURVE = np.rint(255.0 * linear_to_srgb(np.minimum(_LIGHT, _KNEE) + (1 - _KNEE) * _OVER)).astype(
    np.uint8
)
