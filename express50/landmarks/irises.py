"""Find the irises of a face in the pixels.

Every eye is scaled to one size by its corners. A disc and the ring around it, both limited to the
opening between the lids, are compared at every place and with a few radii: iris and pupil are
darker than the white around them (Daugman 1993 uses the difference across a circle). Shut eyes
give nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.conventions import cell_to_corner
from express50.landmarks.detector import Detection, cut_crop, place_level_crop, points_in_crop

# Landmarks of the subject's left eye, then the right one: corners, upper lid, lower lid.
EYES = ((42, 45, (43, 44), (47, 46)), (36, 39, (37, 38), (41, 40)))
SIDE = 64
SPAN = 1.5  # width of the crop, in eye widths
# In eye widths: an iris has a fifth, more if the head is turned and the width foreshortened.
RADII = (0.17, 0.2, 0.235, 0.275)
RING = 1.55  # outer radius of the ring, in radii of the disc
SLACK = 0.1  # share of the eye width by which landmarks may make the opening too small
LEAST_WIDTH_PX = 6.0
SHUT, OPEN = 0.1, 0.2  # heights of the opening, in eye widths, that give no and full confidence
# Contrast between disc and ring, of a crop whose mean light is a half: the least, which shut lids
# do not have, and the one that gives half of the confidence.
LEAST_CONTRAST, CONTRAST = 0.12, 0.08
LEAST_COVER, LEAST_CONFIDENCE = 0.35, 0.2
SIGMA = 0.04  # standard deviation of a centre with confidence 1, in eye widths


@dataclass(frozen=True)
class Irises:
    """Iris centres of one image, the subject's left eye first."""

    centres: np.ndarray  # (2, 2) pixels, corner origin; the eye's middle if the confidence is 0
    sigma: np.ndarray  # (2,) expected error in pixels; infinite if the confidence is 0
    confidence: np.ndarray  # (2,) in 0..1; 0 for shut, hidden and tiny eyes


def find_irises(image: np.ndarray, seen: Detection) -> Irises:
    """Find both irises of a face that was detected in an image (H, W, 3) uint8 RGB."""
    found = [_find(image, seen, eye) for eye in EYES]
    centres, sigma, confidence = (np.array(part) for part in zip(*found, strict=True))
    return Irises(centres, sigma, confidence)


def _find(
    image: np.ndarray, seen: Detection, eye: tuple[int, int, tuple[int, int], tuple[int, int]]
) -> tuple[np.ndarray, float, float]:
    """Find one iris: centre (2,), sigma and confidence."""
    first, last, upper, lower = eye
    points = seen.points
    ring = points[[first, *upper, last, *reversed(lower)]]
    middle = ring.mean(0)
    along = points[last] - points[first]
    width = float(np.linalg.norm(along))
    nothing = (middle, np.inf, 0.0)
    if not np.isfinite(ring).all() or width < LEAST_WIDTH_PX:
        return nothing
    across = np.array([-along[1], along[0]]) / width
    lids = points[list(lower)].mean(0) - points[list(upper)].mean(0)
    opening = abs(float(lids @ across)) / width
    openness = float(np.clip((opening - SHUT) / (OPEN - SHUT), 0.0, 1.0))
    trust = float(np.median(seen.confidence[[first, *upper, last, *lower]]))
    size = np.array([image.shape[1], image.shape[0]])
    if openness * trust <= 0.0 or (middle < 0).any() or (middle >= size).any():
        return nothing
    window = place_level_crop(middle, SPAN * along / SIDE, SIDE)
    crop = cut_crop(image, window, SIDE).astype(np.float32)
    # Red counts most, because blue irises are dark in it; the mean light becomes 0.5.
    light = 0.6 * crop[..., 0] + 0.4 * crop[..., 1]
    light = light * (0.5 / max(float(light.mean()), 10.0))
    # The opening between the lids, slightly enlarged.
    inside = np.round(points_in_crop(window, ring)).astype(np.int32)
    mask = cv2.fillPoly(np.zeros((SIDE, SIDE), np.uint8), [inside], 1)
    grow = 2 * round(SLACK * SIDE / SPAN) + 1
    mask = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (grow, grow)))
    place, contrast, cover = _disc(light, mask.astype(np.float32))
    confidence = trust * openness * cover * contrast / (contrast + CONTRAST)
    if contrast < LEAST_CONTRAST or cover < LEAST_COVER or confidence < LEAST_CONFIDENCE:
        return nothing
    centre = window[:, :2] @ place + window[:, 2]
    return centre, SIGMA * width / confidence**0.5, confidence


def _disc(crop: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Find the best disc: centre (2,) in crop pixels, contrast, and share inside the opening."""
    best = (-np.inf, np.full(2, SIDE / 2), 0.0, 0.0)
    for radius in RADII:
        pixels = radius * SIDE / SPAN
        grid = np.arange(-np.ceil(RING * pixels), np.ceil(RING * pixels) + 1)
        distance = np.hypot(grid[:, None], grid)
        disc = np.clip(pixels + 0.5 - distance, 0.0, 1.0)
        ring = np.clip(RING * pixels + 0.5 - distance, 0.0, 1.0) - disc
        disc, ring = (disc / disc.sum()).astype(np.float32), (ring / ring.sum()).astype(np.float32)
        within, around, light, other = (
            cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_CONSTANT)
            for image in (mask, crop * mask)
            for kernel in (disc, ring)
        )
        contrast = other / np.maximum(around, 1e-3) - light / np.maximum(within, 1e-3)
        score = contrast * np.sqrt(np.clip(within * around, 0.0, None)) * (mask > 0)
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[row, column] > best[0]:
            place = cell_to_corner(np.array([column, row])) + _peak(score, int(row), int(column))
            best = (
                float(score[row, column]), place,
                float(contrast[row, column]), float(min(within[row, column], 1.0)),
            )  # fmt: skip
    return best[1], best[2], best[3]


def _peak(score: np.ndarray, row: int, column: int) -> np.ndarray:
    """Return the offset (2,) x, y from the best pixel to the top of a parabola around it."""
    offset = np.zeros(2)
    for axis, (line, at) in enumerate(((score[row], column), (score[:, column], row))):
        if not 0 < at < SIDE - 1:
            continue
        line = line[at - 1 : at + 2]
        bend = float(line[0] - 2 * line[1] + line[2])
        if bend < -1e-9:
            offset[axis] = np.clip(0.5 * float(line[0] - line[2]) / bend, -0.5, 0.5)
    return offset
