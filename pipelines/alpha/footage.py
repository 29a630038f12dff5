"""A plate for a camera that has none, out of footage that shows the subject.

Over time: a pixel shows the plate where it holds one colour for most of the time. Over subjects of
a fixed rig: where most subjects show the same colour. Neither sees behind a head that always
covers the same place; the plate of another subject before the same rig does. Pixels that nothing
shows are unknown; they are filled in from around, and what that is worth is measured where the
plate is known. On a backdrop it is worth much, on clutter nothing, and then there is no plate.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.files.images import edge_distance
from pipelines.alpha.key import dilated, eroded
from pipelines.alpha.plate import MOST_NOISE, exposed, exposure_gain

LEAST_MOTION = 0.06  # share of the image that must differ from the median in half of the frames
STATIC = 0.95  # share of the time in which a pixel that never changes agrees with its median
LEAST_KNOWN = 0.3  # share of the image under which nothing is believed
MOST_DOUBT = 8.0  # 8-bit steps by which filled pixels may be off
AGREE = 8.0  # 8-bit steps within which medians of two subjects show the same
BAND_ROWS = 128  # rows at once, so that memory is that of the frames


@dataclass(frozen=True)
class FootagePlate:
    """An estimated plate.

    Attributes:
        plate: (H, W, 3) uint8; filled in from around where not known.
        known: (H, W) bool, where the footage shows it.
        doubt: deviation, 8-bit steps, that the filled pixels may be off.
    """

    plate: np.ndarray
    known: np.ndarray
    doubt: float

    @property
    def flaw(self) -> str:
        """Why it cannot be used, empty where it can."""
        share = float(self.known.mean())
        if share < LEAST_KNOWN:
            return f"only {share:.0%} of the image shows one background"
        if self.doubt > MOST_DOUBT:
            return (
                f"{1 - share:.0%} of the image is always covered, and what surrounds it is too"
                f" varied to fill that in (off by {self.doubt:.0f} of 255, limit {MOST_DOUBT:.0f})"
            )
        return ""


def plate_over_time(frames: list[np.ndarray]) -> FootagePlate | None:
    """Plate from frames (H, W, 3) uint8 of one subject; None where it hardly moves in them.

    A subject that sits still is itself what holds one colour for most of the time, and no pixel
    tells the two apart: so much of the image must change, and what never changes counts only where
    it reaches the top or a side of the image without crossing what does.
    """
    median = time_median(frames)
    agree = np.zeros(median.shape[:2], np.float32)
    changed = []
    for frame in frames:
        off = cv2.absdiff(frame, median).max(axis=-1) > 2 * MOST_NOISE
        agree += ~off
        changed.append(float(off.mean()))
    if np.median(changed) < LEAST_MOTION:
        return None
    agree /= len(frames)
    static = agree > STATIC
    known = (agree >= 0.5) & ~(static & ~_from_outside(static))
    return _completed(median, known)


def plate_over_subjects(medians: list[np.ndarray]) -> FootagePlate:
    """Plate from time medians (H, W, 3) uint8 of subjects, two or more, before one rig.

    In the exposure of the first. A pixel is known where more than half of the subjects agree,
    three at least or both of two, for skin is like skin; and where that place reaches the top or a
    side of the image, for people in like clothes agree in the middle.
    """
    first = medians[0]
    alike = [np.clip(exposed(m, exposure_gain(first, m)), 0, 255) for m in medians]
    plate = np.zeros(first.shape, np.float32)
    most = np.zeros(first.shape[:2], np.float32)
    for one in alike:
        votes = np.zeros_like(most)
        total = np.zeros_like(plate)
        for other in alike:
            near = cv2.absdiff(one, other).max(axis=-1) <= AGREE
            votes += near
            total += near[..., None] * other
        better = votes > most
        plate[better] = total[better] / votes[better][:, None]
        most[better] = votes[better]
    known = _from_outside(most >= max(min(len(medians), 3), len(medians) // 2 + 1))
    return _completed(np.rint(plate).astype(np.uint8), known)


def plate_of_another(plate: np.ndarray, median: np.ndarray) -> FootagePlate | None:
    """A plate (H, W, 3) uint8 shot with another subject, in the exposure of a subject's median.

    None where the two do not show one background around the subject: then the camera or the set
    was moved in between.
    """
    shown = np.clip(exposed(plate, exposure_gain(median, plate)), 0, 255)
    alike = _from_outside(cv2.absdiff(shown, median.astype(np.float32)).max(axis=-1) <= AGREE)
    if alike.mean() < LEAST_KNOWN:
        return None
    return FootagePlate(np.rint(shown).astype(np.uint8), np.ones(alike.shape, bool), 0.0)


def time_median(frames: list[np.ndarray]) -> np.ndarray:
    """Median (H, W, 3) uint8 of frames."""
    out = np.empty_like(frames[0])
    for top in range(0, len(out), BAND_ROWS):
        rows = np.s_[top : top + BAND_ROWS]
        out[rows] = np.median(np.stack([frame[rows] for frame in frames]), axis=0)
    return out


def _from_outside(mask: np.ndarray) -> np.ndarray:
    """What of a mask (H, W) bool reaches the image's top or sides, but by a thread."""
    radius = max(1, round(0.004 * max(mask.shape)))
    thick = eroded(mask, radius)
    _, labels = cv2.connectedComponents(thick.astype(np.uint8), connectivity=4)
    outside = np.unique(np.concatenate([labels[0], labels[:, 0], labels[:, -1]]))
    return mask & dilated(np.isin(labels, outside[outside > 0]), radius + 1)


def _completed(plate: np.ndarray, known: np.ndarray) -> FootagePlate:
    """Fill what is not known, and measure on known pixels around it what that is worth."""
    if known.all() or not known.any():
        return FootagePlate(plate, known, 0.0)
    image = plate.astype(np.float32)
    # As wide a rim is hidden as half of what has to be bridged.
    depth = edge_distance(~known)
    hidden = known & dilated(~known, max(1.0, float(depth.max()) / 2))
    rest = known & ~hidden
    doubt = 255.0
    if rest.any() and hidden.any():
        off = np.abs(filled(image, rest)[hidden] - image[hidden]).max(axis=-1)
        doubt = 1.4826 * float(np.median(off))
    return FootagePlate(np.rint(filled(image, known)).astype(np.uint8), known, doubt)


def filled(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) float32 with pixels that are not known taken from coarser levels."""
    height, width = known.shape
    if known.all() or max(height, width) == 1:
        return image
    size = ((width + 1) // 2, (height + 1) // 2)
    weight = known.astype(np.float32)
    total = cv2.resize(image * weight[..., None], size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    coarse = filled(total / np.maximum(share, 1e-6)[..., None], share > 0)
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(known[..., None], image, smooth)
