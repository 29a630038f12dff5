"""Key a frame against its plate: find what differs from the plate, and solve its alpha.

Large parts that differ from the plate by more than noise are the subject's region. Its solid inside
is found by shape and has alpha 1. Around it, alpha is solved from the plate and the subject's
colours nearby (`pipelines.matte.plates`), so that a strand of fair hair over a fair plate is as
opaque as a dark one. A shirt of the wall's colour is found by the texture of the wall, which it
hides. benchmarks/matte.py compares all this with plain keys and textbook matting.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.pixels import LIGHT_OF_LEVEL, box_about, shrink
from pipelines.matte.plates import (
    ODD_STEPS,
    PlateModel,
    block_means,
    blurred,
    border_of,
    enlarged,
    exposed,
    exposure_gain,
    fit_plate,
    light_noise,
    local_colours,
    nearest_first,
    shrunk,
    solve_opacity,
    to_light,
)

# Deviations are standard deviations of noise, radii and distances shares of the longer side.
LEAST_PART = 0.02  # a part of the subject smaller than this share of the largest is clutter
LARGEST_HOLE = 0.06  # share of the window under which a hole in the subject may be filled
REACH = 0.012  # least distance from which colours are taken
SURE = 2.0  # deviations of alpha by which it must be under 1 in the solid to count as a gap
SPREAD = 0.2  # share by which hair may be brighter or darker than visible hair nearby
LOW = 1.2  # deviations at which noise and subject are equally likely; alpha is 0 below
HIGH = 6.0  # deviations that prove foreground; weaker pixels must be connected to such ones
FIRM = 0.5  # share of the nearby subject's difference over which a pixel looks opaque
# Single pixels stand out from noise if the subject differs by PLAIN deviations in all but a share
# FAINT of its pixels, each judged by the strongest of STRONGEST x STRONGEST. Noisier pictures are
# blurred up to SOFTENINGS times (docs/LOG.md, "Noisy footage").
PLAIN, FAINT, STRONGEST, SOFTENINGS = 4.2, 0.04, 5, 3
SHADED = 1.6  # deviations: areas that differ by less from the darkened plate are in shadow
CORE = 0.018  # radius of the disc that must fit inside a part of the subject for it to be solid
OPEN = 1.5  # deviations: an area that differs by less shows the plate
BLACK, WHITE = 24, 250  # grey levels beyond which two surfaces may look the same
FILL = 0.012  # distance from the solid's edge from which its spots and gaps are filled
WIDE = 0.01  # radius of a disc that is wider than strands and soft edges
WINDOW_SIDE = 960  # longer side, pixels, of the picture in which the subject is looked for first
# The wall's texture is compared in pictures of TEXTURE_SIDE pixels: what is finer than FINE, in
# windows of deviation WINDOW. Of all pixels that are as strongly textured, at least LEAST_WALL, the
# quantile USUAL shows what noise leaves of it; that must be VISIBLE.
TEXTURE_SIDE, FINE, WINDOW, USUAL, VISIBLE, LEAST_WALL = 512, 3.0, 5.0, 0.6, 0.4, 500
HIDDEN = 0.5  # share of the usual texture under which the wall is hidden; half of it on average
LEAST_LOST = 0.005  # share of the picture; beside smaller parts lies texture that the head hides
SEAM = 3  # pixels between parts found by colour and by texture
MOST_ODD = 0.02  # share of a rim of plate that may lack its texture; compression takes more

Erode = Callable[[np.ndarray, int], np.ndarray]
"""`eroded` or `eroded_about`."""


@dataclass(frozen=True)
class Support:
    """The pixels (H, W) bool that show the subject: `core` for certain, `near` perhaps."""

    core: np.ndarray
    near: np.ndarray


def key_alpha(frame: np.ndarray, plate: np.ndarray, valid: np.ndarray, shadow: float) -> np.ndarray:
    """Return the opacity (H, W) float32 in [0, 1] of a frame (H, W, 3) uint8 against its plate.

    Pixels outside `valid` (H, W) get 0. Darkening of the plate by up to `shadow` is a shadow.
    """
    alpha = _keyed(frame, plate, valid, shadow)
    part = part_like_the_wall(alpha, frame, plate, valid)
    return np.maximum(alpha, part, where=valid, out=alpha) if part.any() else alpha


def _keyed(
    frame: np.ndarray, plate: np.ndarray, valid: np.ndarray, shadow: float, softened: int = 0
) -> np.ndarray:
    """Key a frame by its colours.

    Pictures in which parts of the subject hardly exceed the noise are blurred and keyed again;
    `softened` counts how often.
    """
    alpha, given = np.zeros(valid.shape, np.float32), (frame, plate)
    length = max(valid.shape)
    whole = subject_window(frame, plate, valid, shadow)
    model = fit_plate(plate, frame, valid, whole)
    frame, image = frame[whole], frame[whole].astype(np.float32)
    dark, difference, unshaded = plate_difference(image, model, shadow, length)
    difference = np.where(valid[whole], difference, 0.0)
    strength = _strength(difference, np.where(valid[whole], unshaded, 0.0), valid.size)
    if softened < SOFTENINGS and not (strength.size and np.quantile(strength, FAINT) > PLAIN):
        frame, plate = (cv2.GaussianBlur(image, (0, 0), 2.0**softened) for image in given)
        return _keyed(frame, plate, valid, shadow, softened + 1)
    region = subject_region(difference, valid.size)
    if not region.any():
        return alpha
    # The remaining steps work around the subject only.
    window = box_about(region, _margin(length))
    part = PlateModel(model.plate[window], model.sigma[window], model.whiten)
    frame, image, dark = frame[window], image[window], dark[window]
    difference, region = difference[window], region[window]
    clear = clear_plate(unshaded[window], part, length)
    # The first support only says which colours the subject has nearby.
    support = find_support(difference > 2 * LOW, region, clear, length, eroded_about)
    if support.core.any():
        own = whitened(subject_colour(image, support.core, length) - part.plate, part)
        firm = firm_pixels(image, difference, own, support.core, part)
        # Where the plate has the subject's colours, what looks like it may be a shirt.
        clear &= _length(own) > HIGH
        support = find_support(firm, region, clear, length)
    alpha[whole][window] = _opacity(frame, difference, dark, support, part, length)
    alpha[~valid] = 0.0
    return alpha


def part_like_the_wall(
    alpha: np.ndarray, frame: np.ndarray, plate: np.ndarray, valid: np.ndarray
) -> np.ndarray:
    """Return the opacity (H, W) float32 of the parts beside the subject that look like the wall.

    They have its colours, but hide its texture, which shadows do not. There are none before smooth
    walls, nor where texture is missing at the picture's rim too: compression or a draught took it.
    """
    opaque = np.rint(255 * alpha), 255 * valid
    solid, known = (shrink(v.astype(np.uint8), TEXTURE_SIDE) > 240 for v in opaque)
    frame, plate = (shrink(image, TEXTURE_SIDE) for image in (frame, plate))
    seen, held = frame.astype(np.float32), exposed(plate, exposure_gain(frame, plate))
    alike = known & (np.abs(cv2.blur(seen - held, (5, 5))).max(-1) < ODD_STEPS)
    shown = texture_shown(seen, held, alike)
    hidden = alike & (shown < HIDDEN)
    rim = known & border_of(hidden.shape)
    if not hidden.any() or (hidden & rim).sum() > MOST_ODD * rim.sum():
        return np.zeros(alpha.shape, np.float32)
    body = opened(eroded(solid | hidden, 2), _pixels(CORE, max(hidden.shape))) | solid
    _, labels = cv2.connectedComponents(dilated(body, SEAM).astype(np.uint8))
    part = body & ~solid & np.isin(labels, np.unique(labels[solid]))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(part.astype(np.uint8))
    area = stats[:, cv2.CC_STAT_AREA]
    mean = np.bincount(labels.ravel(), shown.ravel()) / np.maximum(area, 1)
    part &= ((area > LEAST_LOST * part.size) & (mean < HIDDEN / 2))[labels]
    # Between the two, colours and texture are mixed.
    part |= eroded(dilated(part | solid, SEAM), SEAM) & dilated(part, SEAM)
    return cv2.resize(part.astype(np.float32), alpha.shape[::-1])


def texture_shown(seen: np.ndarray, held: np.ndarray, alike: np.ndarray) -> np.ndarray:
    """Return how much (H, W) of the texture that a plate has its frame shows: 1 if all, 0 if none.

    The frame is `seen`, the plate `held`, both (H, W, 3) float32 in one exposure. Noise weakens
    what they share, so it is compared with what they share in most pixels whose colours are `alike`
    (H, W), which show the wall. Texture that noise hides counts as shown.
    """
    greys = [cv2.transform(image, np.full((1, 3), 1 / 3)) for image in (seen, held)]
    seen, held = (grey - cv2.GaussianBlur(grey, (0, 0), FINE) for grey in greys)
    power = cv2.GaussianBlur(held * held, (0, 0), WINDOW) + 1e-4
    limit = 2 * np.sqrt(power)  # the subject's own edges may be far stronger
    common = cv2.GaussianBlur(np.clip(seen, -limit, limit) * held, (0, 0), WINDOW) / power
    octave = np.rint(np.log2(power))
    shown = np.ones(alike.shape, np.float32)
    for strength in np.unique(octave[alike]):
        similar = octave == strength
        wall = common[similar & alike]
        usual = np.quantile(wall, USUAL)
        if len(wall) >= LEAST_WALL and usual > VISIBLE:
            shown[similar] = common[similar] / usual
    return shown


def _strength(difference: np.ndarray, unshaded: np.ndarray, size: int) -> np.ndarray:
    """Return the strongest difference close to each of the subject's pixels, without shadows.

    So neither soft edges nor gaps between strands count. In noise, a dark shirt looks like a
    shadow, but unlike one it differs from the darkened plate in the average of pixels.
    """
    smooth = smoothed(difference)
    there = subject_region(unshaded, size) & (smooth > SHADED)
    return cv2.dilate(smooth, np.ones((STRONGEST, STRONGEST), np.uint8))[there]


def subject_window(
    frame: np.ndarray, plate: np.ndarray, valid: np.ndarray, shadow: float
) -> tuple[slice, slice]:
    """Return rows and columns around the subject of a frame, looked for in a smaller picture.

    What is too thin to show there does not count further than `_margin` from all that does.
    """
    small = [shrink(image, WINDOW_SIDE) for image in (frame, plate, 255 * valid.astype(np.uint8))]
    region, factor = np.ones((1, 1), bool), max(valid.shape)  # the whole frame
    if small[0] is not frame:
        known, side = small[2] == 255, max(small[2].shape)
        model, image = fit_plate(small[1], small[0], known), small[0].astype(np.float32)
        difference = plate_difference(image, model, shadow, side)[1]
        found = subject_region(np.where(known, difference, 0.0), known.size)
        if found.any():
            region, factor = found, factor / side
    x, y, width, height = (factor * side for side in cv2.boundingRect(region.astype(np.uint8)))
    margin = _margin(max(valid.shape)) + math.ceil(2 * factor)
    rows, columns = (
        slice(max(0, math.floor(low) - margin), math.ceil(high) + margin)
        for low, high in ((y, y + height), (x, x + width))
    )
    return rows, columns


def _margin(length: int) -> int:
    return 2 * _pixels(CORE, length) + 2  # beyond every disc, and three deviations of the blurs


def _opacity(
    frame: np.ndarray,
    difference: np.ndarray,
    dark: np.ndarray,
    support: Support,
    model: PlateModel,
    length: int,
) -> np.ndarray:
    """Solve alpha (H, W) float32: 1 deep in the core and 0 off the support.

    `dark` (H, W) is the factor of a broad shadow on the plate's values, 0 where there is none.
    """
    core = support.core
    alpha = core.astype(np.float32)
    # Near its edge the core may have gaps between strands, so alpha is solved there too.
    todo = support.near | (core & ~eroded_about(core, _pixels(FILL, length)))
    if not todo.any():
        return alpha
    weight = _rim(core, length).astype(np.float32)
    if not core.any():
        strong = difference >= np.percentile(difference[difference > 0], 98)
        weight = (strong & support.near).astype(np.float32)
    light = cv2.LUT(frame, LIGHT_OF_LEVEL)
    mean, covariance = local_colours(light, weight, todo, REACH * length, SPREAD)
    plate = model.plate[todo]
    if dark.any():
        plate = plate * shade_of_plate(dark, ~(core | support.near), length)[todo][:, None]
    noise = light_noise(plate, model.sigma[todo], model.whiten)
    behind = to_light(plate)
    value, deviation, at_zero = solve_opacity(light[todo], behind, mean, covariance, noise)
    # Doubtful pixels count as solid in the core and as plate outside it.
    solid = 1 - shrunk(1 - value, SURE * deviation)
    strand = shrunk(value, LOW * at_zero)
    alpha[todo] = np.clip(np.where(core[todo], solid, strand), 0, 1)
    return alpha


def _pixels(share: float, length: int) -> int:
    return max(1, round(share * length))


def eroded(mask: np.ndarray, radius: float) -> np.ndarray:
    """Return the pixels (H, W) bool further than `radius` from any pixel outside the mask.

    The mask continues beyond the image's border. Above 8 pixels, the time does not depend on the
    radius, but distances are up to 2 % off.
    """
    if mask.all():
        return mask > 0
    if radius <= 8:
        side = np.arange(-radius, radius + 1)
        disc = (side[:, None] ** 2 + side**2 <= radius**2).astype(np.uint8)
        return cv2.erode(mask.astype(np.uint8), disc) > 0
    return cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) > radius


def eroded_about(mask: np.ndarray, radius: int) -> np.ndarray:
    """Return `eroded` of a mask; from 32 pixels on at reduced size, the radius within a tenth."""
    step = radius // 16
    if step < 2:
        return eroded(mask, radius)
    height, width = mask.shape
    padding = (0, -height % step, 0, -width % step)
    whole = cv2.copyMakeBorder(mask.astype(np.uint8), *padding, cv2.BORDER_REPLICATE)
    rows, columns = (n // step for n in whole.shape)
    blocks = cv2.erode(whole, np.ones((step, step), np.uint8), anchor=(0, 0))[::step, ::step]
    small = eroded(blocks, radius / step).astype(np.uint8)
    large = cv2.resize(small, (columns * step, rows * step), interpolation=cv2.INTER_NEAREST)
    return large[:height, :width] > 0


def dilated(mask: np.ndarray, radius: float) -> np.ndarray:
    """Return the pixels (H, W) bool within `radius` of the mask."""
    return ~eroded(mask == 0, radius)


def opened(mask: np.ndarray, radius: int, erode: Erode = eroded) -> np.ndarray:
    """Return the part of a mask (H, W) that is covered by discs inside it."""
    return (mask > 0) & ~erode(~erode(mask, radius), radius)


def whitened(error: np.ndarray, model: PlateModel) -> np.ndarray:
    """Return errors (H, W, 3) from a plate as independent ones of deviation 1 for noise."""
    return cv2.transform(error / model.sigma, model.whiten)


def _length(white: np.ndarray) -> np.ndarray:
    """Return the root mean square (H, W) of whitened errors (H, W, 3): 1 on average for noise."""
    return cv2.sqrt(cv2.transform(cv2.multiply(white, white), np.full((1, 3), 1 / 3)))


def plate_difference(
    image: np.ndarray, model: PlateModel, shadow: float, length: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measure the difference (H, W) of an image (H, W, 3) from the plate, in noise deviations.

    Where a whole neighbourhood is darker than the plate, by at most `shadow`, the difference is
    from the darkened plate. A dark strand is darker too, but not its whole neighbourhood.

    Returns:
        The shadow's factor (H, W) on sRGB values, 0 where there is none; the difference; and the
        difference from the plate without shadow.
    """
    off = image - model.plate
    difference = _length(whitened(off, model))
    if shadow <= 0:
        return np.zeros_like(difference), difference, difference
    # Darkening linear light by s darkens sRGB values by about s^(1/2.2).
    lumas = [cv2.cvtColor(values, cv2.COLOR_RGB2GRAY) for values in (image, model.plate)]
    dark = np.clip(lumas[0] / np.maximum(lumas[1], 1.0), (1 - shadow) ** (1 / 2.2), 1.0)
    off += model.plate * (1 - dark)[..., None]
    shaded = _length(whitened(off, model))
    # Opening drops narrow areas.
    broad = opened(shaded < 3.0, _pixels(WIDE, length), eroded_about)
    return dark * broad, np.where(broad, np.minimum(difference, shaded), difference), difference


def shade_of_plate(dark: np.ndarray, clear: np.ndarray, length: int) -> np.ndarray:
    """Interpolate the shadow's factor (H, W) from `dark` (H, W) where the plate is `clear`."""
    weight = ((dark > 0) & clear).astype(np.float32)
    reach = REACH * length
    # With no plate in reach there is no measurement, so no shadow is assumed.
    return (blurred(dark * weight, reach) + 1e-3) / (blurred(weight, reach) + 1e-3)


def smoothed(difference: np.ndarray) -> np.ndarray:
    """Return the root mean square (H, W) over 3 x 3 pixels of differences (H, W)."""
    # Running sums leave values a little under 0 where pixels are equal, as in grey footage.
    return np.sqrt(np.maximum(cv2.blur(difference**2, (3, 3)), 0))


def subject_region(difference: np.ndarray, size: int) -> np.ndarray:
    """Return the pixels (H, W) of large connected parts that differ, each with a certain pixel.

    `size` is that of the whole frame, pixels.
    """
    smooth = smoothed(difference)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        (smooth > 2.2).astype(np.uint8), connectivity=8
    )
    sure = np.zeros(count, bool)
    sure[labels[smooth > HIGH]] = True
    sure[0] = False
    if not sure.any():
        return np.zeros(difference.shape, bool)
    area = stats[:, cv2.CC_STAT_AREA]
    # A few isolated pixels are not a subject, however much they differ.
    least = max(LEAST_PART * area[sure].max(), 2e-4 * size)
    return (sure & (area >= least))[labels]


def clear_plate(difference: np.ndarray, model: PlateModel, length: int) -> np.ndarray:
    """Return the pixels (H, W) of wide areas whose difference from the plate is only noise.

    There the wall shows, as between a hand and the face. A shirt of the wall's colour differs by
    its folds. Black hair in front of a black wall may not differ, nor skin in front of a lamp, so
    black and white plates do not count.
    """
    smooth = smoothed(difference)
    red, green, blue = cv2.split(model.plate)
    exposed = (cv2.max(cv2.max(red, green), blue) > BLACK) & (
        cv2.min(cv2.min(red, green), blue) < WHITE
    )
    return opened((smooth < OPEN) & exposed, _pixels(WIDE, length), eroded_about)


def find_support(
    firm: np.ndarray, region: np.ndarray, clear: np.ndarray, length: int, erode: Erode = eroded
) -> Support:
    """Split the region (H, W) into the solid inside and the rest, where alpha is to be solved.

    `firm` (H, W) marks pixels that look opaque by themselves. The subject is solid where these
    leave no gaps as strands do, and deep inside the outline, but not where it is `clear` (H, W).
    """
    solid = (firm & region).astype(np.uint8)
    radius, edge = _pixels(CORE, length), _pixels(FILL, length)
    # The image's border cuts the subject off; the subject continues behind it.
    rows, columns = box_about(solid)
    spaces = rows.start, len(solid) - rows.stop, columns.start, solid.shape[1] - columns.stop
    pad = [4 * radius + edge + 2 if space < 3 * edge else 0 for space in spaces]
    solid = cv2.copyMakeBorder(solid, *pad, cv2.BORDER_REPLICATE)
    thick = opened(solid, _pixels(0.006, length), erode)
    closed = thick | eroded_about(~eroded_about(~thick, 2 * edge), 2 * edge)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        (~closed).astype(np.uint8), connectivity=4
    )
    fill = stats[:, cv2.CC_STAT_AREA] < LARGEST_HOLE * firm.size
    # At its lower border the picture cuts the subject off, so a gap there is enclosed.
    fill[np.concatenate([labels[0], labels[:, 0], labels[:, -1]])] = False
    fill[0] = False  # the closed part itself
    wall = cv2.copyMakeBorder(clear.astype(np.uint8), *pad, cv2.BORDER_REPLICATE)
    hull = (closed | fill[labels]) & (wall == 0)
    core = opened((solid > 0) | eroded_about(hull, 2 * edge), radius, erode)
    # The outermost pixels of the solid are mixed with plate by lens and sampling.
    core = eroded(core, 2 if length >= 256 else 1)
    core = core[pad[0] : core.shape[0] - pad[1], pad[2] : core.shape[1] - pad[3]]
    return Support(core, dilated(region, 1) & ~core)


def firm_pixels(
    image: np.ndarray, difference: np.ndarray, own: np.ndarray, core: np.ndarray, model: PlateModel
) -> np.ndarray:
    """Return the pixels (H, W) bool that look opaque, given a first core and the colours near it.

    `own` (H, W, 3) are these colours' whitened errors from the plate. Thin hair differs less from
    the plate than dense hair. Skin under dark hair may differ little too, but is not a mixture of
    hair and plate: colours off the line between these are subject.
    """
    reach = _length(own)
    firm = difference > np.maximum(FIRM * reach, 2 * LOW)
    left = core & ~firm
    if not left.any():
        return firm
    pixels = PlateModel(model.plate[left][None], model.sigma[left][None], model.whiten)
    own, reach = own[left][None], reach[left]
    off = whitened(image[left][None] - pixels.plate, pixels)
    along = np.einsum("...i,...i->...", off, own)
    share = np.clip(along / (3 * np.maximum(reach, 1e-3) ** 2), 0, 1)
    misfit = _length(off - share[..., None] * own)[0]
    # At least half of the difference, because in 8-bit steps mixtures lie on a curve.
    firm[left] = misfit > np.maximum(2 * LOW, 0.5 * difference[left])
    return firm


def subject_colour(image: np.ndarray, core: np.ndarray, length: int) -> np.ndarray:
    """Return the mean colour (H, W, 3) of the core's rim, over the nearest reach that has any."""
    weight = _rim(core, length).astype(np.float32)
    factor = max(1, int(REACH * length / 3))  # the blur leaves no finer detail
    colours, weight = (block_means(v, factor) for v in (image * weight[..., None], weight))
    reach = REACH * length / factor
    weights = nearest_first(weight, reach, 4, least=1e-12)
    return enlarged(nearest_first(colours, reach, 4) / weights[..., None], factor, core.shape)


def _rim(core: np.ndarray, length: int) -> np.ndarray:
    """Return the core's pixels (H, W) near its edge, except those that may be mixed with plate."""
    inner = eroded(core, 2)
    inner = inner if inner.any() else core
    return inner & ~eroded_about(inner, 2 * _pixels(REACH, length))
