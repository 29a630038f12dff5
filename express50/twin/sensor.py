"""The cameras' sensors: colour gain, vignetting, noise, tone curve, 8 bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.files.images import linear_to_srgb
from express50.twin.noise import random_stream

_SHOT, _READ = 0.0055, 0.0016  # noise of a clean studio exposure, linear light
_KNEE = 0.75
_CURVE_STEPS = 16384


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One camera's colour gain (3,) and how much its corners darken."""

    gain: np.ndarray
    vignette: float


def make_sensor(camera_index: int, seed: int) -> Sensor:
    """Draw a camera's sensor."""
    rng = random_stream(seed, 301, camera_index)
    gain = 0.85 * rng.uniform(0.94, 1.06) * (1.0 + rng.normal(0.0, 0.025, 3))
    return Sensor(gain=gain.astype(np.float32), vignette=float(rng.uniform(0.02, 0.08)))


def expose(
    sensor: Sensor, linear: np.ndarray, rng: np.random.Generator, noise: float
) -> np.ndarray:
    """The 8-bit sRGB picture (H, W, 3) of linear light (H, W, 3) float32."""
    height, width = linear.shape[:2]
    y = (np.arange(height, dtype=np.float32) + 0.5) / height * 2 - 1
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    falloff = 1.0 - sensor.vignette * 0.5 * (x[None] ** 2 + y[:, None] ** 2)
    signal = linear * sensor.gain * falloff[..., None]
    if noise > 0:
        grain = rng.standard_normal(signal.shape, dtype=np.float32)
        signal = signal + noise * grain * np.sqrt(_READ**2 + _SHOT**2 * np.maximum(signal, 0.0))
    steps = np.clip(signal * (_CURVE_STEPS / 2.0), 0, _CURVE_STEPS - 1).astype(np.int32)
    return _CURVE[steps]


def _tone(linear: np.ndarray) -> np.ndarray:
    """Soft shoulder above the knee, so that highlights do not clip hard."""
    over = np.maximum(linear - _KNEE, 0.0)
    return np.minimum(linear, _KNEE) + (1 - _KNEE) * (1.0 - np.exp(-over / (1 - _KNEE)))


# Linear light 0 to 2 in fine steps; one step is at most half of one level.
_CURVE = np.rint(
    255.0 * linear_to_srgb(_tone((np.arange(_CURVE_STEPS) + 0.5) * 2.0 / _CURVE_STEPS))
).astype(np.uint8)
