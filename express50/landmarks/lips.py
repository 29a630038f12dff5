"""Opens the inner lips where the image shows teeth or a dark mouth between them.

The network sees a mouth in some thirty pixels and often takes a row of teeth for closed lips. Lips
are redder than teeth, and much lighter than an open mouth's dark. Down each of three columns
between the outer lips the longest run of pixels that do not look like lips is taken as the opening.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from express50.landmarks.detector import Detection, cut_crop, place_level_crop

# Outer lip above, inner above, inner below, outer lip below, of each column.
COLUMNS = ((50, 61, 67, 58), (51, 62, 66, 57), (52, 63, 65, 56))
WIDTH, SPAN = 72, 1.2
LEAST_MOUTH_PX = 12.0
# Inner lips further apart than this share of the mouth's width are open already: they are kept.
SHUT = 0.08
# Half the columns' width that is averaged, rows kept clear of the outer lips (shares of the
# mouth's width), and the least height of an opening.
HALF, CLEAR, LEAST = 0.03, 0.03, 0.045
# A pixel is not lip if it is this much less red than the lips, next to the skin's difference from
# grey, or has less than this share of their light.
PALE, DARK = 0.5, 0.55
SIGMA = 0.02


def open_lips(image: np.ndarray, seen: Detection) -> Detection:
    """Part a detection's inner lips where the image shows an opening.

    Args:
        image: (H, W, 3) uint8 RGB.
        seen: its landmarks.

    Returns:
        The same detection where the network saw the mouth open, or where it is shut or small.
    """
    along = seen.points[54] - seen.points[48]
    width = float(np.linalg.norm(along))
    if not np.isfinite(seen.points[48:]).all() or width < LEAST_MOUTH_PX:
        return seen
    gaps = seen.points[[67, 66, 65]] - seen.points[[61, 62, 63]]
    if np.linalg.norm(gaps, axis=1).mean() > SHUT * width:
        return seen
    window = place_level_crop(seen.points[48:60].mean(0), SPAN * along / WIDTH, WIDTH)
    crop = cut_crop(image, window, WIDTH).astype(np.float64) / 255.0
    inverse = np.linalg.inv(np.vstack([window, [0.0, 0.0, 1.0]]))
    inside = seen.points @ inverse[:2, :2].T + inverse[:2, 2]
    found = _openings(crop, inside)
    if found is None:
        return seen
    points, sigma = seen.points.copy(), seen.sigma.copy()
    for (_, upper, lower, _), (top, bottom) in zip(COLUMNS, found, strict=True):
        for point, y in ((upper, top), (lower, bottom)):
            points[point] = window[:, :2] @ [inside[point, 0], y] + window[:, 2]
            sigma[point] = max(SIGMA * width, 0.5 * seen.sigma[point])
    return replace(seen, points=points, sigma=sigma)


def _openings(crop: np.ndarray, points: np.ndarray) -> list[tuple[float, float]] | None:
    """Upper and lower edge (crop rows) of the opening in each column; None where it is shut."""
    light = crop.mean(2) + 1e-3
    redness = (crop[..., 0] - crop[..., 1]) / light
    polygon = np.zeros((WIDTH, WIDTH), np.uint8)
    cv2.fillPoly(polygon, [np.round(points[48:60]).astype(np.int32)], 1)
    mouth = polygon > 0
    if mouth.sum() < 40:
        return None
    # Whatever is open, the reddest of the mouth is lip, and the lightest of that is lit lip.
    red = float(np.percentile(redness[mouth], 75))
    lit = float(np.median(light[mouth & (redness >= np.median(redness[mouth]))]))
    no_lip = (redness < PALE * red) | (light < DARK * lit)
    found = []
    for above, _, _, below in COLUMNS:
        x = 0.5 * (points[above, 0] + points[below, 0])
        reach = max(1, round(HALF * WIDTH / SPAN))
        columns = slice(max(0, round(x) - reach), round(x) + reach + 1)
        clear = CLEAR * WIDTH / SPAN
        low, high = round(points[above, 1] + clear), round(points[below, 1] + 2 * clear)
        run = _longest(no_lip[max(low, 0) : high, columns].mean(1) > 0.5)
        if run is None or run[1] - run[0] < LEAST * WIDTH / SPAN:
            return None
        found.append((max(low, 0) + run[0], max(low, 0) + run[1]))
    return found


def _longest(flags: np.ndarray) -> tuple[int, int] | None:
    """Return first and past-the-last index of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    if not len(edges):
        return None
    runs = edges.reshape(-1, 2)
    first, last = runs[int(np.argmax(runs[:, 1] - runs[:, 0]))]
    return int(first), int(last)
