"""Light: how a camera's exposure and white balance change over a capture.

The scene changes too, where the subject moves; its background and most of the face do not. So each
frame's cells are compared with the same cells' median over time, and the median over cells counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.files.images import srgb_to_linear

CELLS = 16
DARK, BRIGHT = 0.004, 0.85  # linear light between which a cell tells the camera's gain
SPAN = 9  # frames over which curves are smoothed: a passing hand is no drift
FEWEST = 12  # cells that a judgement needs
FEWEST_FRAMES = 12  # of fewer, a movement cannot be told from a drift
_CURVE = srgb_to_linear(np.arange(256, dtype=np.float32) / 255.0).astype(np.float32)


@dataclass(frozen=True)
class Drift:
    """How far a camera's light went from its darkest to its brightest, in stops.

    Attributes:
        exposure: mean over red, green and blue.
        red, blue: against green.
        brightest, darkest: frames of the exposure's ends.
    """

    exposure: float
    red: float
    blue: float
    brightest: int
    darkest: int


def cells_of(image: np.ndarray) -> np.ndarray:
    """Mean linear light (16, 16, 3) float32 of an image (H, W, 3) uint8."""
    return cv2.resize(_CURVE[image], (CELLS, CELLS), interpolation=cv2.INTER_AREA)


def light_drift(cells: np.ndarray) -> Drift | None:
    """Drift of a camera of its frames' cells (F, 16, 16, 3); None where too little tells it."""
    if len(cells) < FEWEST_FRAMES:
        return None
    usual = np.median(cells, axis=0)
    told = ((usual > DARK) & (usual < BRIGHT)).all(axis=-1)
    if told.sum() < FEWEST:
        return None
    stops = np.log2(np.maximum(cells[:, told], 1e-4) / usual[told])  # (F, N, 3)
    curve = _smooth(np.median(stops, axis=1))
    exposure = curve.mean(axis=1)
    ends = int(exposure.argmax()), int(exposure.argmin())
    return Drift(
        exposure=float(np.ptp(exposure)),
        red=float(np.ptp(curve[:, 0] - curve[:, 1])),
        blue=float(np.ptp(curve[:, 2] - curve[:, 1])),
        brightest=ends[0],
        darkest=ends[1],
    )


def _smooth(curve: np.ndarray) -> np.ndarray:
    """Running median (F, 3) over time."""
    half = min(SPAN, len(curve)) // 2
    padded = np.pad(curve, ((half, half), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    return np.median(windows, axis=-1)


def judge_light(drift: Drift, exposure_ev: float, colour_ev: float) -> str:
    """What is wrong with a camera's light, in words; empty where nothing is."""
    wrong = []
    if drift.exposure > exposure_ev:
        wrong.append(
            f"exposure changes by {drift.exposure:.2f} stops between frame {drift.darkest} (dark) "
            f"and {drift.brightest} (bright)"
        )
    colours = [(n, v) for n, v in (("red", drift.red), ("blue", drift.blue)) if v > colour_ev]
    if colours:
        words = " and ".join(f"{name} by {value:.2f} stops" for name, value in colours)
        wrong.append(f"white balance changes, {words} against green")
    return "; ".join(wrong)
