"""From a frame and its plate to alpha: what differs from the plate, and by how much.

What differs from the plate by more than noise, in parts of some size, is the subject's region. The
solid inside is found by shape and is 1; around it alpha is solved from the plate and the subject's
colours nearby (`pipelines.matte.opacity`), so that a strand of fair hair over a fair plate is as
opaque as a dark one. Measured against plain keys and textbook matting in benchmarks/matte.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from express50.files.images import edge_distance, resize_area
from pipelines.matte.opacity import (
    light_noise,
    local_colours,
    shrunk,
    solve_opacity,
    to_light,
)
from pipelines.matte.plates import PlateModel, exposed, exposure_gain, fit_plate

# A part of the subject smaller than this share of its largest part is clutter.
LEAST_PART = 0.02
# A plate-coloured hole inside the subject is at most this share of the image.
LARGEST_HOLE = 0.05
# Least distance, a share of the image's longer side, from which a subject's colours are taken.
REACH = 0.012
# Deviations by which a pixel of the solid must be open to count as a gap.
SURE = 2.0
# Share by which hair may be brighter or darker than what is seen of it nearby.
SPREAD = 0.2
# A difference of this share of the local foreground's own may belong to the solid inside.
FIRM = 0.5
# Radius of the disc that must fit inside a part of the subject for it to be solid.
CORE = 0.018
# Plate-coloured spots and gaps in the solid subject are filled this far from its edge.
FILL = 0.012
# Least noise assumed, in 8-bit steps.
NOISE_FLOOR = 1.0
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)


@dataclass(frozen=True)
class KeyOptions:
    """The settings of keying; see ``MatteConfig``."""

    scale: float = 1.0
    low: float = 1.2
    high: float = 6.0
    shadow: float = 0.25
    linear: bool = True


@dataclass(frozen=True)
class Support:
    """The pixels that show the subject: `core` (H, W) surely, `near` (H, W) perhaps."""

    core: np.ndarray
    near: np.ndarray


def alpha_of(
    frame: np.ndarray, model: PlateModel, valid: np.ndarray, options: KeyOptions
) -> np.ndarray:
    """Opacity (H, W) float32 in [0, 1] of the subject in a frame (H, W, 3) uint8.

    `model` is the plate in this frame's exposure; pixels outside `valid` (H, W) get 0.
    """
    alpha = np.zeros(valid.shape, np.float32)
    length = max(valid.shape)
    image = frame.astype(np.float32)
    difference = plate_difference(image, model, options.shadow, length)
    difference[~valid] = 0.0
    region = subject_region(difference, options.high)
    if not region.any():
        return alpha
    # All else happens around the subject only.
    window = _window(region, 4 * _pixels(CORE, length))
    part = PlateModel(model.plate[window], model.sigma[window], model.whiten)
    image, difference, region = image[window], difference[window], region[window]
    support = find_support(difference > 2 * options.low, region, length)
    if support.core.any():
        firm = firm_pixels(image, difference, support.core, part, length, options)
        support = find_support(firm, region, length)
    alpha[window] = _opacity(image, difference, support, part, length, options)
    alpha[~valid] = 0.0
    return alpha


def _opacity(
    image: np.ndarray,
    difference: np.ndarray,
    support: Support,
    model: PlateModel,
    length: int,
    options: KeyOptions,
) -> np.ndarray:
    """Solve alpha (H, W) float32: 1 deep in the core and 0 off the support."""
    core, linear = support.core, options.linear
    alpha = core.astype(np.float32)
    # Between strands the solid looks closed from a distance; near its edge it is measured.
    todo = support.near | (core & ~eroded(core, _pixels(FILL, length)))
    if not todo.any():
        return alpha
    weight = _rim(core, length).astype(np.float32)
    if not core.any():
        strong = difference >= np.percentile(difference[difference > 0], 98)
        weight = (strong & support.near).astype(np.float32)
    light = to_light(image, linear)
    reach = REACH * length
    mean, covariance = local_colours(light, weight, todo, reach, SPREAD)
    plate = model.plate
    if options.shadow > 0:
        clear = ~(core | support.near)
        plate = plate * shade_of_plate(image, model, clear, options.shadow, length)[..., None]
    noise = light_noise(plate[todo], model.sigma[todo], model.whiten, linear)
    behind = to_light(plate[todo], linear)
    value, deviation, at_zero = solve_opacity(light[todo], behind, mean, covariance, noise)
    # In the core what is not surely open is solid, off it what is not surely subject is plate.
    solid = 1 - shrunk(1 - value, SURE * deviation)
    strand = shrunk(value, options.low * at_zero)
    alpha[todo] = np.clip(np.where(core[todo], solid, strand), 0, 1)
    return alpha


def _pixels(share: float, length: int) -> int:
    return max(1, round(share * length))


def eroded(mask: np.ndarray, radius: float) -> np.ndarray:
    """Pixels (H, W) bool further than `radius` from any outside pixel; the border counts inside.

    By distances, so that the time does not grow with the disc.
    """
    if mask.all():
        return mask > 0
    return edge_distance(mask) > radius


def dilated(mask: np.ndarray, radius: float) -> np.ndarray:
    """Pixels (H, W) bool within `radius` of the mask."""
    return ~eroded(mask == 0, radius)


def opened(mask: np.ndarray, radius: float) -> np.ndarray:
    """Keep of a mask (H, W) what discs of a radius cover that lie wholly inside it."""
    return dilated(eroded(mask, radius), radius)


def _window(region: np.ndarray, margin: int) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + 1 + margin),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + 1 + margin),
    )


def _length(error: np.ndarray, model: PlateModel) -> np.ndarray:
    """Root mean square (H, W) of whitened errors (H, W, 3), 1 on average for mere noise."""
    white = cv2.transform(error / model.sigma, model.whiten)
    return np.sqrt(np.einsum("...i,...i->...", white, white) / 3.0)


def plate_difference(
    image: np.ndarray, model: PlateModel, shadow: float, length: int
) -> np.ndarray:
    """Difference (H, W) of an image (H, W, 3) from the plate, in noise deviations.

    Where a whole neighbourhood is the plate darkened (no more than by `shadow`), the difference
    is taken from the darkened plate. A dark strand darkens too, but not a whole neighbourhood.
    """
    difference = _length(image - model.plate, model)
    if shadow <= 0:
        return difference
    _, broad, shaded = _darkened(image, model, shadow, length)
    return np.where(broad, np.minimum(difference, shaded), difference)


def shade_of_plate(
    image: np.ndarray, model: PlateModel, clear: np.ndarray, shadow: float, length: int
) -> np.ndarray:
    """Factor (H, W) on the plate's sRGB values by the shadow on it, as `clear` (H, W) shows."""
    dark, broad, _ = _darkened(image, model, shadow, length)
    weight = (broad & clear).astype(np.float32)
    reach = REACH * length
    # Where no plate is in reach a shadow cannot be measured; assume none.
    return (_blur(dark * weight, reach) + 1e-3) / (_blur(weight, reach) + 1e-3)


def _darkened(
    image: np.ndarray, model: PlateModel, shadow: float, length: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Darkening (H, W), where neighbourhoods are plate but for it, and the difference left."""
    # Darkening linear light by s darkens sRGB values by about s^(1/2.2).
    dark = np.clip(
        (image @ _LUMA) / np.maximum(model.plate @ _LUMA, 1.0), (1 - shadow) ** (1 / 2.2), 1.0
    )
    shaded = _length(image - model.plate * dark[..., None], model)
    # Opened by a disc wider than strands and soft edges: what is left is broad.
    return dark, opened(shaded < 3.0, _pixels(0.01, length)), shaded


def subject_region(difference: np.ndarray, high: float) -> np.ndarray:
    """Pixels (H, W) of large connected parts that differ, each holding a sure pixel."""
    smooth = np.sqrt(cv2.blur(difference**2, (3, 3)))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        (smooth > 2.2).astype(np.uint8), connectivity=8
    )
    sure = np.zeros(count, bool)
    sure[np.unique(labels[smooth > high])] = True
    sure[0] = False
    if not sure.any():
        return np.zeros(difference.shape, bool)
    area = stats[:, cv2.CC_STAT_AREA]
    # A few isolated pixels are not a subject, however bright.
    least = max(LEAST_PART * area[sure].max(), 2e-4 * difference.size)
    return (sure & (area >= least))[labels]


def find_support(firm: np.ndarray, region: np.ndarray, length: int) -> Support:
    """Split the region (H, W) into the solid inside and the rest, where alpha is to be measured.

    `firm` (H, W) marks pixels that look opaque one by one; where they leave no gap that a strand
    could make, and deep inside the outline, the subject is solid.
    """
    solid = (firm & region).astype(np.uint8)
    radius, edge = _pixels(CORE, length), _pixels(FILL, length)
    # The image's border cuts the subject off; it goes on behind it.
    pad = 4 * radius + edge + 2
    solid = cv2.copyMakeBorder(solid, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    thick = opened(solid, _pixels(0.006, length))
    hull = _filled(eroded(dilated(thick, 2 * edge), 2 * edge), firm.size)
    core = opened((solid > 0) | eroded(hull, 2 * edge), radius)
    # The outermost pixels of the solid are mixed with plate by lens and sampling.
    core = eroded(core, 2 if length >= 256 else 1)[pad:-pad, pad:-pad]
    return Support(core, dilated(region, 1) & ~core)


def _filled(mask: np.ndarray, pixels: int) -> np.ndarray:
    """The mask (H, W) with enclosed holes filled up to LARGEST_HOLE of `pixels`."""
    holes = (mask == 0).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(holes, connectivity=4)
    fill = stats[:, cv2.CC_STAT_AREA] < LARGEST_HOLE * pixels
    touching = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    fill[np.unique(touching)] = False
    fill[0] = False  # the mask itself
    return mask | fill[labels]


def firm_pixels(
    image: np.ndarray,
    difference: np.ndarray,
    core: np.ndarray,
    model: PlateModel,
    length: int,
    options: KeyOptions,
) -> np.ndarray:
    """Pixels (H, W) bool that look opaque, knowing the subject's colour about a first core.

    Thin hair differs from the plate by less than hair itself does. Skin under dark hair may too,
    but it is not a mixture of hair and plate: colours off the line between them are subject too.
    """
    off = image - model.plate
    own = subject_colour(image, core, length) - model.plate
    reach = _length(own, model)
    firm = difference > np.maximum(FIRM * reach, 2 * options.low)
    white = cv2.transform(own / model.sigma, model.whiten)
    along = np.einsum("...i,...i->...", cv2.transform(off / model.sigma, model.whiten), white)
    share = np.clip(along / (3 * np.maximum(reach, 1e-3) ** 2), 0, 1)
    misfit = _length(off - share[..., None] * own, model)
    # Half of the difference at least: light mixes along a curve in 8-bit steps.
    return firm | (core & (misfit > np.maximum(2 * options.low, 0.5 * difference)))


def subject_colour(image: np.ndarray, core: np.ndarray, length: int) -> np.ndarray:
    """Colour (H, W, 3) of the subject nearby: of the core's rim, the nearest reach that has any."""
    weight = _rim(core, length).astype(np.float32)
    total = np.zeros_like(image)
    weights = np.full(core.shape, 1e-12, np.float32)
    colours = image * weight[..., None]
    for octave in range(4):
        reach = REACH * length * 2**octave
        share = np.float32(1e-2**octave)
        total += share * _blur(colours, reach)
        weights += share * _blur(weight, reach)
    return total / weights[..., None]


def _rim(core: np.ndarray, length: int) -> np.ndarray:
    """Pixels (H, W) of the core near its edge, but for those that may be mixed with plate."""
    inner = eroded(core, 2)
    inner = inner if inner.any() else core
    return inner & ~eroded(inner, 2 * _pixels(REACH, length))


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur, at reduced size where that is wide (a blur this wide has no detail)."""
    factor = max(1, int(sigma / 3))
    if factor == 1:
        return cv2.GaussianBlur(image, (0, 0), sigma)
    height, width = image.shape[:2]
    size = (max(1, width // factor), max(1, height // factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma / factor)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


class Keyer:
    """A plate and its noise; gives the alpha of frames of that camera."""

    def __init__(
        self,
        plate: np.ndarray,
        frames: list[np.ndarray],
        valid: np.ndarray,
        options: KeyOptions,
    ) -> None:
        """Measure the noise of `frames` (H, W, 3) uint8 around `plate`, inside `valid` (H, W)."""
        self.options = options
        self.full_size = (plate.shape[1], plate.shape[0])
        self.size = tuple(max(8, round(n * options.scale)) for n in self.full_size)
        self.plate = self._shrink(plate)
        self.valid = valid
        self._valid_small = self._shrink(valid.astype(np.uint8) * 255) == 255
        small = [self._shrink(f) for f in frames]
        self.model: PlateModel = fit_plate(self.plate, small, self._valid_small, NOISE_FLOOR)

    def _shrink(self, image: np.ndarray) -> np.ndarray:
        return image if self.size == self.full_size else resize_area(image, *self.size)

    def alpha(self, frame: np.ndarray) -> np.ndarray:
        """Opacity (H, W) float32 in [0, 1] of the subject in a frame (H, W, 3) uint8."""
        small = self._shrink(frame)
        plate = exposed(self.plate, exposure_gain(small, self.plate))
        alpha = alpha_of(small, replace(self.model, plate=plate), self._valid_small, self.options)
        if self.size != self.full_size:
            alpha = cv2.resize(alpha, self.full_size, interpolation=cv2.INTER_LINEAR)
        return np.where(self.valid, alpha, np.float32(0))
