"""Describe how well a matte's rim is known, for the error that it states."""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.matte.key import dilated

RIM = 0.008  # share of the longer side: so far from the outline a matte can be wrong by a part
WINDOW = 5  # pixels, odd


def rim_of(alpha: np.ndarray) -> np.ndarray:
    """Return the pixels (H, W) bool about the outline of an alpha (H, W) uint8."""
    reach = max(1, round(RIM * max(alpha.shape)))
    return dilated(alpha > 12, reach) & dilated(alpha < 243, reach)


def rim_figures(
    alpha: np.ndarray, rgb: np.ndarray, plated: bool, views: int
) -> dict[str, np.ndarray | float]:
    """Describe the N pixels of the rim of an alpha (H, W) uint8.

    The frame (h, w, 3) uint8 may be reduced; its grain off the subject stands for noise.
    """
    rim, share = rim_of(alpha), alpha.astype(np.float32) / 255
    open_part = share * (1 - share)
    inside = (share > 0.5).astype(np.uint8)
    edge = int((inside - cv2.erode(inside, np.ones((3, 3)))).sum())
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    behind = cv2.resize(cv2.dilate(alpha, np.ones((5, 5))), grey.shape[::-1]) < 3
    grain = np.abs(cv2.Laplacian(grey, cv2.CV_32F))[behind]
    return {
        "soft": 0.05 + 4 * open_part[rim],
        "spread": 0.01 + deviation(share)[rim],
        "noise": 0.2 + float(np.median(grain)) if grain.size else np.inf,
        "width": 0.1 + float(open_part.sum()) / max(edge, 1),
        "side": float(max(alpha.shape)),
        "plated": 1.0 if plated else 2.0,
        "views": float(views),
    }


def deviation(values: np.ndarray) -> np.ndarray:
    """Return the standard deviation (H, W) of values (H, W) within a window."""
    mean, square = (cv2.blur(v, (WINDOW, WINDOW)) for v in (values, values * values))
    return np.sqrt(np.maximum(square - mean * mean, 0))
