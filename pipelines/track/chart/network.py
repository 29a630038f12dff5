"""Landmarks on the face laid flat.

On a chart every face is upright, turned to the reader and of one size, and what is left to find is
by how much a mesh is off. So the landmark network, trained on from its weights for whole heads,
sees the middle of a chart at twice the resolution it has of a head, and looks again whenever the
mesh has moved. The jaw line is not among its landmarks: a chart does not end at it.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from express50.head.model import HeadModel
from express50.landmarks.network import CROP, MIRROR, LandmarkNet
from pipelines.track.chart.layout import MARKS, Chart, make_chart, to_texels

WEIGHTS = Path(__file__).with_name("weights.npz")
# First landmark that is read, first column and row of the part of the chart that is, and its side.
FIRST = 17
LEFT, UPPER, SIDE = 36, 34, 120
TEXELS_A_PIXEL = SIDE / CROP


def window(colors: np.ndarray) -> np.ndarray:
    """The part of a chart (HEIGHT, WIDTH, 3) that is read, (128, 128, 3)."""
    part = colors[UPPER : UPPER + SIDE, LEFT : LEFT + SIDE]
    return cv2.resize(part, (CROP, CROP), interpolation=cv2.INTER_LINEAR)


def to_window(texels: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of the window from texels, both with corner origin."""
    return (texels - (LEFT, UPPER)) / TEXELS_A_PIXEL


def from_window(pixels: np.ndarray) -> np.ndarray:
    """Texels (..., 2) of the chart from pixels of the window."""
    return pixels * TEXELS_A_PIXEL + (LEFT, UPPER)


def read_marks(net: LandmarkNet, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texels (51, 2) of landmarks 17 to 67 on a chart, and how far off they may be (51,).

    The chart and its mirror image are read, as neither side of a face comes first; by how much the
    two differ counts as error.

    Args:
        net: from `load_network(WEIGHTS)`.
        colors: (HEIGHT, WIDTH, 3) in [0, 1].
    """
    image = torch.from_numpy(window(colors)).permute(2, 0, 1)[None].float()
    with torch.inference_mode():
        output = net(torch.cat([image, image.flip(3)]))
    points, scale = output.points.numpy(), np.exp(output.log_scale.numpy())
    turned = np.stack([CROP - points[1, MIRROR, 0], points[1, MIRROR, 1]], axis=1)
    apart = 0.5 * np.linalg.norm(points[0] - turned, axis=1)
    error = np.hypot(0.5 * (scale[0] + scale[1, MIRROR]), apart)
    mean = 0.5 * (points[0] + turned)
    return from_window(mean)[FIRST:], (error * TEXELS_A_PIXEL)[FIRST:]


def reading_chart(model: HeadModel) -> Chart:
    """The part of a head's chart that is read."""
    return make_chart(model).inner(LEFT, UPPER, SIDE)


def mark_places() -> np.ndarray:
    """Texels (51, 2) where landmarks 17 to 67 belong."""
    return to_texels(MARKS)[FIRST:]
