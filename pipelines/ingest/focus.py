"""Focus: how wide the sharpest edges of a picture are, in pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

REACH = 8  # pixels on either side of an edge within which its two levels are looked for
SMOOTH = 0.8  # standard deviation of the filter against noise, pixels; taken off the width again
STEP = 30.0  # grey levels that an edge must part, so that noise is none
FEWEST = 12  # edges that a judgement needs
SHARPEST = 20  # percentile of the widths: a face is soft, its lashes and hair are not


def edge_width(image: np.ndarray) -> float | None:
    """Width of the sharpest edges of an image (H, W, 3) uint8; None where it has too few edges.

    The width is the standard deviation, pixels, of the Gaussian that would blur a step so much: a
    step of height h, blurred by s, rises by at most h / (s sqrt(2 pi)) a pixel.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), SMOOTH)
    slope = np.hypot(
        cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1) / 2,
        cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=1) / 2,
    )
    window = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
    height = cv2.dilate(grey, window) - cv2.erode(grey, window)
    steepest = slope == cv2.dilate(slope, np.ones((REACH + 1, REACH + 1), np.uint8))
    edges = steepest & (height > STEP) & (slope > 0)
    if edges.sum() < FEWEST:
        return None
    widths = height[edges] / (slope[edges] * math.sqrt(2 * math.pi))
    width = float(np.percentile(widths, SHARPEST))
    return math.sqrt(max(width**2 - SMOOTH**2, 0.0))


def judge_focus(
    widths: Mapping[str, Sequence[tuple[int, float]]], ratio: float
) -> tuple[dict[str, float], dict[str, str]]:
    """Each camera's width, pixels, and what is wrong with some.

    Args:
        widths: (frame, width) samples by camera.
        ratio: from where on a camera is out of focus.
    """
    middle = {name: float(np.median([w for _, w in rows])) for name, rows in widths.items() if rows}
    wrong = {}
    for name, width in middle.items():
        others = [w for other, w in middle.items() if other != name]
        usual = float(np.median(others)) if len(others) > 1 else width
        if width > ratio * max(usual, 0.5):
            wrong[name] = (
                f"out of focus: its sharpest edges are {width:.1f} px wide, the other cameras' "
                f"{usual:.1f}"
            )
            continue
        third = max(1, len(widths[name]) // 3)
        first, last = widths[name][:third], widths[name][-third:]
        before, after = (float(np.median([w for _, w in rows])) for rows in (first, last))
        if len(widths[name]) >= 6 and max(before, after) > ratio * max(min(before, after), 0.5):
            wrong[name] = (
                f"its focus changes: the sharpest edges are {before:.1f} px wide about frame "
                f"{first[0][0]}, {after:.1f} about frame {last[-1][0]}"
            )
    return middle, wrong
