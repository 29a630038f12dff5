"""Model the plate of a camera, and solve alpha where plate and subject mix.

Noise decides which difference from the plate is significant. It is measured in the frame itself,
where that shows plate. It grows with brightness and, through compression and resampling, with the
plate's own contrast; its channels are correlated.

A pixel is ``alpha * F + (1 - alpha) * B`` in linear light, which lenses average. B, the plate, is
known up to noise; F has the mean and the covariance of the subject's colours nearby. The most
likely alpha is the Bayesian matting of Chuang et al. 2001 with B given. Thanks to the covariance, a
strand may be lighter or darker than its neighbours and still be as opaque. The deviation of alpha
is large where F and B are alike. There it is the mean of all alphas, weighted by their likelihood:
grey hair in front of a grey wall differs from it in every strand, although not on average.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from express50.geometry.conventions import affine_from_opencv, affine_to_opencv
from express50.geometry.pixels import (
    LIGHT_OF_LEVEL,
    linear_to_srgb,
    scaled_levels,
    shrink,
    srgb_to_linear,
)

LEVELS = np.linspace(16.0, 240.0, 8)  # 8-bit intensities at which noise is tabulated
MOST_NOISE = 14.0  # 8-bit steps; larger differences are not noise, whatever the camera
NOISE_FLOOR = 1.0  # least noise assumed, in 8-bit steps
TILTED = 0.6  # share of the noise that a change of light across the image must leave at most
LEAST_PLATE = 0.05  # with a smaller share of plate in view, noise and exposure cannot be measured
# Largest changes of exposure that are tried, natural logarithms: 0.7 stops, then two stops.
GAINS = (0.51, 1.41)
# A plate that explains less than GOOD_SHARE of a frame's rim is moved and its light is evened,
# unless it explains TURNED_SHARE of that of the picture turned.
RIM, ODD_STEPS, GOOD_SHARE, TURNED_SHARE, LEAST_GAIN = 0.06, 12.0, 0.97, 0.99, 0.01
WIDE_RIM = 0.15  # width of the rim by which a plate is aligned
MOST_MOVED = 0.03  # share of the longer side; alignments that move the plate further are rejected
LEAST_SHARE = 0.9  # a plate that explains less shows another set
LEAST_UNSHADED = 0.75  # of a rim, beside which a shadow on the plate is explained
# Shadows darken all channels alike: the largest difference of logarithms of light, to which DARK is
# added; hard ones are HARD deep at least, which other walls hardly are.
GREY, DARK, HARD = 0.2, 2e-3, 0.7
LEAST_OPEN = 0.2  # of a frame's border that the person leaves open, so that a plate can be compared
WHITE, MOST_WHITE = 250, 0.3  # level, and share of a rim, from which the exposure is unknown
ALIGN_SIDE = 960  # pixels of the pictures that are aligned
ROUNDS = 3  # of solving, since a pixel's covariance depends on its alpha; 0.01 off after two
DOUBT = 0.05  # deviation of alpha from which its mean is better than the most likely value
TRIED = np.linspace(0.0, 1.0, 17, dtype=np.float32)  # values of alpha whose mean is taken
CERTAIN = 0.1  # probability that only the plate or only the subject shows, over that of a mixture
OCTAVES = 4  # of distance, in which colours are searched
TINT = 0.1  # spread in colour, as a share of that in brightness
SAMPLES = 1e5  # pixels from which exposure and noise are measured
CHUNK = 1 << 14  # pixels solved at once: as many as stay in the cache
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MATRIX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True)
class PlateModel:
    """Plate (H, W, 3) float32, 8-bit steps in the frame's exposure, and the noise around it.

    `sigma` (H, W, 3) is the deviation per channel. With `whiten` (3, 3), the squared length of
    `whiten @ ((frame - plate) / sigma)` is three on average where the frame shows plate.
    """

    plate: np.ndarray
    sigma: np.ndarray
    whiten: np.ndarray


WHOLE = np.s_[:, :]


def exposure_gain(frame: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Estimate the gain (3,) of linear light from plate to frame, (H, W, 3) uint8 sRGB each.

    Pixels that show the plate form the sharpest peak in the histogram of ratios, whatever the
    subject looks like. The gain is 1 if there is no clear peak, as when the subject fills the
    frame. A large gain is accepted only if there is no peak at small ones.
    """
    gains = np.ones(3)
    step = max(1, round(np.sqrt(frame.shape[0] * frame.shape[1] / SAMPLES)))
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
    """Return a plate (H, W, 3) uint8 in the frame's exposure: float32, 8-bit steps."""
    if np.abs(gain - 1.0).max() < 0.004:  # less than half a step everywhere
        return plate.astype(np.float32)
    table = scaled_levels(gain).astype(np.float32)
    return np.stack([table[plate[..., c], c] for c in range(3)], axis=-1)


@dataclass(frozen=True)
class MatchedPlate:
    """A plate (H, W, 3) uint8, aligned with a frame and its light evened where that helps.

    `share` is how much it explains of the frame's top and upper sides, or of its whole border
    `beside` the person; it is `sure` if the plate explains that as it was.
    """

    plate: np.ndarray
    share: float
    beside: bool = False
    sure: bool = False


def match_plate(
    plate: np.ndarray, frame: np.ndarray, valid: np.ndarray, person: np.ndarray | None = None
) -> MatchedPlate:
    """Match a plate to a frame that the camera took after it moved a little, or in other light.

    Both are (H, W, 3) uint8, ``valid`` (H, W) bool marks the pixels with footage. A body leaves
    most frames below, so their top and upper sides are compared. If the plate does not fit there as
    it is, it is compared beside the `person` as well: where one may be, (h, w) bool of any size.
    """
    share = open_share(plate, frame, valid)
    if share > GOOD_SHARE:
        return MatchedPlate(plate, share, sure=True)
    first = _matched(plate, frame, valid)
    if person is None:
        return first
    border = border_of(person.shape, RIM, np.zeros_like(person))
    if (~person[border]).mean() < LEAST_OPEN:
        return first
    size = valid.shape[::-1]
    person = cv2.resize(person.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    second = _matched(plate, frame, valid, person)
    # The fewer pixels are compared, the sooner a plate in other light seems to fit.
    border = valid & border_of(valid.shape, RIM, person)
    return first if explained_share(first.plate, frame, border) > second.share else second


def _matched(
    plate: np.ndarray, frame: np.ndarray, valid: np.ndarray, person: np.ndarray | None = None
) -> MatchedPlate:
    """Match a plate by the frame's top and upper sides, or by its border beside a person (H, W)."""
    rim = valid & border_of(valid.shape, RIM, person)
    best = MatchedPlate(plate, explained_share(plate, frame, rim), beside=person is not None)
    if best.share > GOOD_SHARE:
        return replace(best, sure=True)
    wide = border_of(valid.shape, WIDE_RIM, person)
    for light in (plate, _evened(plate, frame, rim)):
        for image in (light, _aligned(light, frame, valid & wide)):
            found = replace(best, plate=image, share=explained_share(image, frame, rim))
            best = found if found.share > best.share + LEAST_GAIN else best
    return best


def border_of(
    shape: tuple[int, ...], share: float = RIM, person: np.ndarray | None = None, turns: int = 0
) -> np.ndarray:
    """Mark the top and the upper sides (H, W) of an image; `share` of the longer side wide.

    Where a person may be (H, W) bool, if known, is left out instead of the lower part. `turns` are
    quarter turns to the left of the camera's picture.
    """
    if turns:
        return np.rot90(border_of(shape[::-1] if turns % 2 else shape, share), turns)
    height, width = shape
    edge = max(2, round(share * max(shape)))
    low = round(0.6 * height) if person is None else height
    rim = np.zeros(shape, bool)
    rim[:edge] = True
    rim[:low, :edge] = rim[:low, width - edge :] = True
    if person is not None:
        rim[height - edge :] = True
        rim &= ~person
    return rim


def white_share(image: np.ndarray, valid: np.ndarray) -> float:
    """Return the share of an image's top and sides that is too bright to compare."""
    rim = valid & border_of(valid.shape)
    return float((image[rim] >= WHITE).any(-1).mean()) if rim.any() else 0.0


def open_share(plate: np.ndarray, frame: np.ndarray, valid: np.ndarray) -> float:
    """Return the share of a frame's top and upper sides that a plate explains.

    Where the body leaves the picture of a camera that lies on its side, the plate explains little
    of these, but nearly all of what they would be if the picture were turned.
    """
    first, *turned = (border_of(valid.shape, turns=turns) for turns in range(4))
    share = explained_share(plate, frame, valid & first)
    if share > GOOD_SHARE:
        return share
    shares = (
        explained_share(plate, frame, valid & rim)
        for rim in turned
        if valid[rim].mean() > LEAST_OPEN
    )
    return next((other for other in shares if other > TURNED_SHARE), share)


def explained_share(plate: np.ndarray, frame: np.ndarray, rim: np.ndarray) -> float:
    """Return the share of a rim (H, W) where plate and frame differ by less than ODD_STEPS.

    Where that is most of the rim, the rest may show the plate in a hard shadow of its colours.
    """
    plate, frame = shrink(plate, ALIGN_SIDE), shrink(frame, ALIGN_SIDE)
    rim = shrink(rim.astype(np.uint8) * 255, ALIGN_SIDE) == 255
    if not rim.any():  # nothing speaks against the plate
        return 1.0
    seen, shown = frame.astype(np.float32), exposed(plate, exposure_gain(frame, plate))
    alike = _largest(cv2.blur(seen - shown, (3, 3))[rim]) < ODD_STEPS
    if alike.mean() < LEAST_UNSHADED:
        return float(alike.mean())
    darker = darkening(cv2.blur(seen, (3, 3))[rim], cv2.blur(shown, (3, 3))[rim])
    shaded = (darker.max(1) < -HARD) & (np.ptp(darker, axis=1) < GREY)
    return float((alike | shaded).mean())


def _aligned(plate: np.ndarray, frame: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Return a plate aligned with a frame's rim by an affine motion; unchanged if none fits."""
    scale = min(1.0, ALIGN_SIDE / max(rim.shape))
    grey = [
        cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None, fx=scale, fy=scale,
                   interpolation=cv2.INTER_AREA)
        for image in (frame, plate)
    ]  # fmt: skip
    height, width = grey[0].shape
    mask = cv2.resize(rim.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    motion = np.eye(2, 3, dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    try:
        for blur in (15, 5):  # coarse to fine
            _, motion = cv2.findTransformECC(
                *grey, motion, cv2.MOTION_AFFINE, stop, inputMask=mask, gaussFiltSize=blur
            )
    except cv2.error:  # the rim has no structure, or no motion explains it
        return plate
    motion = affine_from_opencv(motion)
    motion[:, 2] /= scale
    height, width = rim.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]])
    moved = np.linalg.norm(corners @ motion.T - corners[:, :2], axis=1)
    if moved.max() > MOST_MOVED * max(width, height):
        return plate
    return cv2.warpAffine(
        plate, affine_to_opencv(motion), (width, height),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip


def _evened(plate: np.ndarray, frame: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Return a plate in a frame's light.

    The change is a gain per channel whose logarithm is linear across the image, so that it is also
    known where the person hides the plate.
    """
    height, width = rim.shape
    weight = rim.astype(np.float32)
    reach = 0.02 * max(rim.shape)
    seen, held = (
        blurred((LIGHT_OF_LEVEL[image].astype(np.float32) + 1e-3) * weight[..., None], reach)
        for image in (frame, plate)
    )
    step = max(1, max(rim.shape) // 256)
    rows, columns = (index[rim[::step, ::step]] for index in np.mgrid[0:height:step, 0:width:step])
    seen, held = (np.maximum(light[rows, columns], 1e-6) for light in (seen, held))
    ratio = np.log(seen / held)
    sides = [np.ones(len(rows)), rows / height, columns / width]
    slope = np.linalg.lstsq(np.stack(sides, axis=1), ratio, rcond=None)[0]
    y, x = np.arange(height)[:, None, None] / height, np.arange(width)[:, None] / width
    gain = np.exp(np.clip(slope[0] + slope[1] * y + slope[2] * x, -1.5, 1.5)).astype(np.float32)
    even = linear_to_srgb(np.clip(LIGHT_OF_LEVEL[plate] * gain, 0, 1))
    return np.rint(255 * even).astype(np.uint8)


def fit_plate(
    plate: np.ndarray, frame: np.ndarray, valid: np.ndarray, window: tuple[slice, slice] = WHOLE
) -> PlateModel:
    """Model a window of a plate (H, W, 3) uint8 in a frame's exposure, and the frame's noise.

    The noise is measured on the frame (H, W, 3) uint8 where `valid` (H, W); with too little plate
    in view it is NOISE_FLOOR everywhere.
    """
    gain = exposure_gain(frame, plate)
    shown = exposed(plate[window], gain)
    # The gradient, eighths of an 8-bit step per pixel.
    slopes = [cv2.Sobel(plate, cv2.CV_16S, x, 1 - x) for x in (1, 0)]
    step = max(1, round(np.sqrt(valid.size / SAMPLES)))
    some = np.s_[step // 2 :: step, step // 2 :: step]
    there = valid[some]
    level = exposed(plate[some], gain)[there]
    error = frame[some][there].astype(np.float32) - level
    rows, columns = (index[:, None] for index in np.nonzero(there))
    tilt = _tilt(error, level, rows, columns)
    if tilt.any():
        error -= level * _along(tilt, rows, columns)
        rows, columns = np.ogrid[: len(valid), : valid.shape[1]]
        rows, columns = ((np.float32(index) - step // 2) / step for index in (rows, columns))
        across = _along(tilt, rows[window[0], :, None], columns[:, window[1], None])
        shown = np.clip(shown * (1 + across), 0, 255)
    quiet = _largest(error) < MOST_NOISE
    if quiet.sum() < max(LEAST_PLATE * len(error), 100):
        return PlateModel(shown, np.full_like(shown, NOISE_FLOOR), np.eye(3, dtype=np.float32))
    error, level, x, y = (
        image[quiet] for image in (error, *(i[some][there] for i in (plate, *slopes)))
    )
    contrast = np.hypot(x, y, dtype=np.float32) / 8
    table = _noise_table(error, level.astype(np.float32))
    by_level = table[level, np.arange(3)]
    share = _contrast_share(error, by_level, contrast)
    sigma = cv2.LUT(np.ascontiguousarray(plate[window]), table[None] ** 2)
    for slope in slopes if share > 0 else ():
        cv2.accumulateSquare(slope[window] * np.float32(share / 8), sigma)
    sigma = cv2.sqrt(sigma)
    scaled = error / np.sqrt(by_level**2 + (share * contrast) ** 2)
    inside = scaled[_largest(scaled) < 4.0]
    covariance = inside.T @ inside / max(len(inside), 1)
    # A tenth of independent noise, so that no direction that happens to be quiet dominates.
    values, vectors = np.linalg.eigh(covariance + 0.1 * np.eye(3))
    whiten = (vectors / np.sqrt(np.maximum(values, 0.1))) @ vectors.T
    return PlateModel(shown, sigma, whiten.astype(np.float32))


def _along(tilt: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return a linear change (..., 3) at rows and columns (..., 1), by coefficients (3, 3)."""
    change: np.ndarray = tilt[0] + rows * tilt[1] + columns * tilt[2]
    return change


def _tilt(
    error: np.ndarray, level: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Return how the light on the wall changed across the image, as shares of the plate's levels.

    People in the room take light from one side of a wall. Larger changes, which make a plate seem
    another set's, were `_evened` before. Errors and levels are (N, 3), rows and columns (N, 1). The
    coefficients (3, 3), by `_along`'s terms and channel, are 0 unless they explain much of the
    error.
    """
    quiet = _largest(error) < MOST_NOISE
    tilt = np.zeros((3, 3), np.float32)
    if quiet.sum() < max(LEAST_PLATE * len(error), 100):
        return tilt
    before, after = np.zeros((2, 3))
    for channel in range(3):
        left = whole = error[quiet, channel]
        before[channel] = _robust_deviation(np.abs(whole))
        sides = level[quiet, channel, None] * np.hstack([rows**0, rows, columns])[quiet]
        for _ in range(ROUNDS):
            near = np.abs(left) <= 2 * _robust_deviation(np.abs(left))
            tilt[:, channel] = np.linalg.lstsq(sides[near], whole[near], rcond=None)[0]
            left = whole - sides @ tilt[:, channel]
        after[channel] = _robust_deviation(np.abs(left))
    return tilt if after.mean() < TILTED * before.mean() else np.zeros_like(tilt)


def _largest(error: np.ndarray) -> np.ndarray:
    """Return the largest size (N,) in each row of errors (N, 3), which `max` takes long for."""
    return np.maximum.reduce([np.abs(channel) for channel in error.T])


def _noise_table(error: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the robust deviation (256, 3) float32 by plate value, from errors at levels (N, 3)."""
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
    fine = [np.interp(np.arange(256), LEVELS, c) for c in np.maximum(table, NOISE_FLOOR).T]
    return np.stack(fine, axis=1).astype(np.float32)


def _robust_deviation(size: np.ndarray) -> float:
    """Return the standard deviation from absolute errors, robust to some pixels of the subject.

    It starts from the median, and takes the mean square within three deviations, because a median
    of integers moves in steps. Normal errors cut at three deviations keep 0.9866 of theirs.
    """
    deviation = 1.4826 * float(np.median(size))
    for _ in range(3):
        inside = size[size < 3 * max(deviation, 0.7)]
        deviation = float(np.sqrt(np.mean(inside**2))) / 0.9866
    return deviation


def _contrast_share(error: np.ndarray, by_level: np.ndarray, contrast: np.ndarray) -> float:
    """Return the share of the plate's gradient that appears as error (shifts, compression)."""
    steep = contrast > max(float(np.percentile(contrast, 90)), 2.0)
    if steep.sum() < 100:
        return 0.0
    deviation = _robust_deviation(np.abs(error[steep]))
    more = deviation**2 - float(np.median(by_level[steep])) ** 2
    return float(np.clip(np.sqrt(max(more, 0.0)) / np.median(contrast[steep]), 0.0, 0.3))


def to_light(values: np.ndarray) -> np.ndarray:
    """Return linear light in [0, 1], float32, of sRGB values in 8-bit steps."""
    return srgb_to_linear(np.clip(values, 0, 255) / 255.0).astype(np.float32)


def light_per_step(values: np.ndarray) -> np.ndarray:
    """Return how much linear light changes per 8-bit step at sRGB values in such steps."""
    level = np.clip(values, 1, 254)
    return (to_light(level + 1) - to_light(level - 1)) / 2


def darkening(image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Return logarithms (..., 3) of an image's light over its plate's; both are sRGB values."""
    return np.log((to_light(image) + DARK) / (to_light(plate) + DARK))


def light_noise(plate: np.ndarray, sigma: np.ndarray, whiten: np.ndarray) -> np.ndarray:
    """Return the covariance (N, 3, 3) of light from that of 8-bit steps at plate values (N, 3)."""
    deviation = light_per_step(plate) * sigma
    mixing = np.linalg.inv(whiten.astype(np.float64))
    mixed = (mixing @ mixing.T).astype(np.float32)
    return deviation[:, :, None] * mixed * deviation[:, None, :]


def local_colours(
    light: np.ndarray, weight: np.ndarray, where: np.ndarray, reach: float, spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (N, 3) and covariance (N, 3, 3) of colours near the pixels of `where` (H, W).

    Args:
        light: (H, W, 3) colours.
        weight: (H, W), which of them count.
        where: (H, W) bool, N of them true.
        reach: pixels; up to OCTAVES doublings of it are searched, the nearest colours count most.
        spread: share by which brightness may differ from the colours nearby.
    """
    # A wide blur has no detail, so it is computed at reduced size; by channel, to save memory.
    factor, places = max(1, int(reach / 3)), np.flatnonzero(where)

    def nearby(values: np.ndarray) -> np.ndarray:
        small = block_means(values, factor)
        least = 1e-3 * 1e-2**OCTAVES * small.mean()  # counts if none is near
        total = nearest_first(small, reach / factor, OCTAVES, least)
        return enlarged(total, factor, where.shape).take(places)

    share = np.maximum(nearby(weight), 1e-20)
    channels = cv2.split(light)
    weighted = [channel * weight for channel in channels]
    mean = np.stack([nearby(c) / share for c in weighted], axis=1)
    squares = [nearby(weighted[i] * channels[j]) / share for i, j in _PAIRS]
    outer = mean[:, :, None] * mean[:, None, :]
    covariance = np.stack(squares, axis=1)[:, _MATRIX] - outer
    tint = (TINT * spread) ** 2 * (mean**2).mean(axis=1)
    return mean, covariance + spread**2 * outer + tint[:, None, None] * np.eye(3, dtype=np.float32)


def block_means(values: np.ndarray, factor: int) -> np.ndarray:
    """Average values (H, W[, C]) over blocks of a whole number of pixels; beyond them is 0."""
    rest = [-side % factor for side in values.shape[:2]]
    whole = cv2.copyMakeBorder(values, 0, rest[0], 0, rest[1], cv2.BORDER_CONSTANT)
    size = whole.shape[1] // factor, whole.shape[0] // factor
    return cv2.resize(whole, size, interpolation=cv2.INTER_AREA)


def enlarged(means: np.ndarray, factor: int, shape: tuple[int, ...]) -> np.ndarray:
    """Interpolate `block_means` at the pixels (H, W) that they were made of."""
    size = means.shape[1] * factor, means.shape[0] * factor
    return cv2.resize(means, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]]


def nearest_first(image: np.ndarray, reach: float, octaves: int, least: float = 0) -> np.ndarray:
    """Sum blurs of an image (H, W[, C]): each reaches twice as far as the last and counts 1 %."""
    total = np.full_like(image, least)
    for octave in range(octaves):
        total += np.float32(1e-2**octave) * blurred(image, reach * 2**octave)
    return total


def blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an image (H, W[, C]) by a Gaussian, at reduced size if that is wide."""
    factor = max(1, int(sigma / 3))
    height, width = image.shape[:2]
    size = (max(1, width // factor), max(1, height // factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma / factor)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def solve_opacity(
    seen: np.ndarray,
    behind: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return alpha (N,), not clipped, its deviation (N,), and that at alpha 0.

    It is the most likely alpha, and where that is in DOUBT the mean. Single precision takes half
    the time and changes alpha by at most 1e-5.

    Args:
        seen: (N, 3) light of the pixels.
        behind: (N, 3) light of the plate.
        mean: (N, 3) of the subject's colours.
        covariance: (N, 3, 3) of the subject's colours.
        noise: (N, 3, 3) covariance of seen light that shows plate.
    """
    out, least = np.zeros((3, len(seen)), np.float32), 1e-10 * np.eye(3, dtype=np.float32)
    for start in range(0, len(seen), CHUNK):
        part = slice(start, start + CHUNK)
        difference = np.ascontiguousarray((seen[part] - behind[part]).T)
        reach = np.ascontiguousarray((mean[part] - behind[part]).T)
        spread, own = _rows(covariance[part]), _rows(noise[part] + least)
        precision = _precision(own, reach)[1]
        out[2, part] = 1 / np.sqrt(np.maximum(precision, 1e-12))
        alpha = np.full(reach.shape[1], 0.5, np.float32)
        for _ in range(ROUNDS):
            direction, precision = _precision(own + np.clip(alpha, 0, 1) ** 2 * spread, reach)
            alpha = (difference * direction).sum(0) / np.maximum(precision, 1e-12)
        deviation = 1 / np.sqrt(np.maximum(precision, 1e-12))
        doubt = deviation > DOUBT
        alpha[doubt] = _mean_opacity(*(rows[:, doubt] for rows in (difference, reach, spread, own)))
        out[:2, part] = alpha, deviation
    return out[0], out[1], out[2]


def _rows(matrices: np.ndarray) -> np.ndarray:
    """Return the upper triangles of symmetric matrices (N, 3, 3) as rows (6, N), quick to add."""
    return np.stack([matrices[:, i, j] for i, j in _PAIRS])


def _mean_opacity(
    difference: np.ndarray, reach: np.ndarray, covariance: np.ndarray, own: np.ndarray
) -> np.ndarray:
    """Return the mean alpha (N,) over its likelihood at TRIED.

    `difference` and `reach` (3, N) are the light of the pixels and the mean light of the subject,
    both minus the plate's; `covariance` (6, N) is of the subject's colours, `own` of noise.
    """
    weights = np.empty((len(TRIED), reach.shape[1]), np.float32)
    for row, alpha in zip(weights, TRIED, strict=True):
        off = difference - alpha * reach
        solved, volume = _solved(own + alpha**2 * covariance, off)
        row[:] = (off * solved).sum(0) + np.log(np.maximum(volume, 1e-37))
    weights = np.exp((weights.min(axis=0) - weights) / 2)
    weights[[0, -1]] *= CERTAIN * (len(TRIED) - 2)
    return TRIED @ weights / weights.sum(axis=0)


def _precision(covariance: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``C^-1 r`` (3, N) and ``r' C^-1 r`` (N,): the weights and precision along r."""
    direction, _ = _solved(covariance, reach)
    return direction, (reach * direction).sum(0)


def _solved(covariance: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``C^-1 r`` (3, N) and the determinant (N,) of C, given as `_rows` (6, N).

    Solved with cofactors, in a quarter of a general solver's time.
    """
    a, b, c, d, e, f = covariance
    x, y, z = right
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    weights = np.stack([p * x + q * y + r * z, q * x + s * y + t * z, r * x + t * y + u * z])
    volume = a * p + b * q + c * r
    return weights / volume, volume


def shrunk(values: np.ndarray, doubt: np.ndarray) -> np.ndarray:
    """Shrink values (N,) to 0 if they are under their doubt (N,), and little if far above it.

    This is the non-negative garrote (Breiman 1995); unlike a ramp, it keeps large values.
    """
    kept = 1 - (doubt / np.maximum(values, 1e-9)) ** 2
    return np.where(values > 0, values * np.clip(kept, 0, 1), 0.0)
