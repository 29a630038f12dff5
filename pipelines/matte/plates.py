"""Model the plate of a camera: its exposure relative to the frame, and its noise.

The noise decides how large a difference is significant. It is measured on the frames themselves,
where they show plate: it grows with brightness and, through compression and resampling, with the
plate's own contrast, and its channels go together (compression keeps less colour than light).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.files.images import LIGHT_OF_LEVEL, scaled_levels

LEVELS = np.linspace(16.0, 240.0, 8)  # 8-bit intensities at which noise is tabulated
# Differences above this, in 8-bit steps, are not noise whatever the camera.
MOST_NOISE = 14.0
# Below this share of plate in view there is nothing to measure noise or exposure on.
LEAST_PLATE = 0.05
# Largest changes of exposure, natural logarithms: a few tenths of a stop as a rule, else two stops.
GAINS = (0.51, 1.41)


@dataclass(frozen=True)
class PlateModel:
    """Plate (H, W, 3) float32 in 8-bit steps and the noise of frames around it.

    `sigma` (H, W, 3) is the deviation a channel; `whiten` (3, 3) makes the squared length of
    `whiten @ ((frame - plate) / sigma)` three on average where a frame shows plate.
    """

    plate: np.ndarray
    sigma: np.ndarray
    whiten: np.ndarray


def exposure_gain(frame: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Gain (3,) of linear light from plate to frame, (H, W, 3) uint8 sRGB each.

    The plate's pixels form the sharpest peak of the ratios' histogram, whatever the subject
    does; 1 where no peak stands out (the subject fills the frame). Another stop is believed only
    where there is no peak near the plate's own exposure.
    """
    gains = np.ones(3)
    step = max(1, round(np.sqrt(frame.shape[0] * frame.shape[1] / 5e5)))
    for channel in range(3):
        a, b = frame[::step, ::step, channel], plate[::step, ::step, channel]
        use = (b > 30) & (b < 240) & (a > 8) & (a < 250)
        ratios = np.log(LIGHT_OF_LEVEL[a[use]] / LIGHT_OF_LEVEL[b[use]])
        if ratios.size < 200:
            continue
        for limit in GAINS:
            edges = np.arange(-limit, limit + 0.01, 0.02)
            counts = np.convolve(np.histogram(ratios, edges)[0], np.ones(3), "same")
            peak = float(edges[np.argmax(counts)] + 0.01)
            near = ratios[np.abs(ratios - peak) < 0.06]
            if near.size > 4 * LEAST_PLATE * ratios.size:
                gains[channel] = np.exp(np.median(near))
                break
    return gains


def exposed(plate: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Plate (H, W, 3) uint8 as the frame's exposure would show it: float32, 8-bit steps."""
    if np.abs(gain - 1.0).max() < 0.004:  # within half a step everywhere
        return plate.astype(np.float32)
    table = scaled_levels(gain).astype(np.float32)
    return np.stack([table[plate[..., c], c] for c in range(3)], axis=-1)


def fit_plate(
    plate: np.ndarray, frames: list[np.ndarray], valid: np.ndarray, floor: float
) -> PlateModel:
    """Measure the noise of frames (H, W, 3) uint8 against their plate where `valid` (H, W).

    With too little plate in view the noise is `floor`, in 8-bit steps, everywhere.
    """
    base = plate.astype(np.float32)
    slope = _contrast(base)
    step = max(1, round(np.sqrt(valid.size / 4e5)))
    window = np.s_[step // 2 :: step, step // 2 :: step]
    errors, levels, slopes, total = [], [], [], 0
    for frame in frames:
        shown = exposed(plate, exposure_gain(frame, plate))
        error = (frame.astype(np.float32) - shown)[window][valid[window]]
        total += len(error)
        quiet = np.abs(error).max(axis=1) < MOST_NOISE
        errors.append(error[quiet])
        levels.append(base[window][valid[window]][quiet])
        slopes.append(slope[window][valid[window]][quiet])
    error, level = np.concatenate(errors), np.concatenate(levels)
    contrast = np.concatenate(slopes)
    if len(error) < max(LEAST_PLATE * total, 100):
        return PlateModel(base, np.full_like(base, floor), np.eye(3, dtype=np.float32))
    table = _noise_table(error, level, floor)
    by_level = _look_up(table, level)
    share = _contrast_share(error, by_level, contrast)
    sigma = np.sqrt(_look_up(table, base) ** 2 + (share * slope) ** 2).astype(np.float32)
    scaled = error / np.sqrt(by_level**2 + (share * contrast) ** 2)
    return PlateModel(base, sigma, _whitening(scaled))


def _contrast(image: np.ndarray) -> np.ndarray:
    """Length (H, W, 3) of the gradient, 8-bit steps a pixel."""
    dx = cv2.Sobel(image, cv2.CV_32F, 1, 0) / 8.0
    dy = cv2.Sobel(image, cv2.CV_32F, 0, 1) / 8.0
    return np.hypot(dx, dy)


def _noise_table(error: np.ndarray, level: np.ndarray, floor: float) -> np.ndarray:
    """Robust deviation (8, 3) at each of LEVELS from errors and plate values (N, 3)."""
    half = (LEVELS[1] - LEVELS[0]) / 2
    table = np.full((len(LEVELS), 3), np.nan)
    for channel in range(3):
        for i, centre in enumerate(LEVELS):
            mine = np.abs(error[np.abs(level[:, channel] - centre) <= half, channel])
            if mine.size >= 100:
                table[i, channel] = _robust_deviation(mine)
        known = np.isfinite(table[:, channel])
        overall = _robust_deviation(np.abs(error[:, channel]))
        table[:, channel] = (
            np.interp(LEVELS, LEVELS[known], table[known, channel]) if known.any() else overall
        )
    return np.maximum(table, floor)


def _robust_deviation(size: np.ndarray) -> float:
    """Deviation from absolute errors, trimmed of subject pixels that slipped in.

    The median finds the scale; the mean square inside three of it does not step as the median of
    whole numbers does. A normal variable cut at three deviations keeps 0.9866 of its own.
    """
    deviation = 1.4826 * float(np.median(size))
    for _ in range(3):
        inside = size[size < 3 * max(deviation, 0.7)]
        deviation = float(np.sqrt(np.mean(inside**2))) / 0.9866
    return deviation


def _look_up(table: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Deviation of each channel at plate values (..., 3)."""
    steps = np.arange(256)
    fine = np.stack([np.interp(steps, LEVELS, table[:, c]) for c in range(3)], axis=1)
    index = np.clip(level + 0.5, 0, 255).astype(np.uint8)
    return np.stack([fine[index[..., c], c] for c in range(3)], axis=-1).astype(np.float32)


def _contrast_share(error: np.ndarray, by_level: np.ndarray, contrast: np.ndarray) -> float:
    """Share of the plate's gradient that shows up as error (misregistration, compression)."""
    steep = contrast > max(float(np.percentile(contrast, 90)), 2.0)
    if steep.sum() < 100:
        return 0.0
    deviation = _robust_deviation(np.abs(error[steep]))
    more = deviation**2 - float(np.median(by_level[steep])) ** 2
    return float(np.clip(np.sqrt(max(more, 0.0)) / np.median(contrast[steep]), 0.0, 0.3))


def _whitening(scaled: np.ndarray) -> np.ndarray:
    """Matrix (3, 3) that gives errors (N, 3), unit variance each, unit covariance."""
    inside = scaled[np.abs(scaled).max(axis=1) < 4.0]
    covariance = inside.T @ inside / max(len(inside), 1)
    # A tenth of independent noise keeps a direction that only looked quiet from ruling the key.
    values, vectors = np.linalg.eigh(covariance + 0.1 * np.eye(3))
    return ((vectors / np.sqrt(np.maximum(values, 0.1))) @ vectors.T).astype(np.float32)
