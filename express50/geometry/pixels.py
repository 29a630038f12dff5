"""Work on pixels: linear light, sizes, masks, and pictures laid out as contact sheets.

Images are RGB (H, W, 3) uint8 sRGB unless a name says linear.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cache

import cv2
import numpy as np

TINT = 0.02  # mean difference of a grey picture's channels, as a share of its brightness


def srgb_to_linear(image_srgb: np.ndarray) -> np.ndarray:
    """Decode sRGB values in [0, 1] to linear light; IEC 61966-2-1."""
    x = np.asarray(image_srgb)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(image_linear: np.ndarray) -> np.ndarray:
    """Encode linear light as sRGB values in [0, 1]; IEC 61966-2-1."""
    x = np.asarray(image_linear)
    return np.where(
        x <= 0.0031308, x * 12.92, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055
    )


LIGHT_OF_LEVEL = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
"""Linear light (256,) of the levels of 8-bit sRGB."""

# The same in 16 bits, where the darkest levels are 20 steps apart; and the inverse, the nearest
# level of each 16-bit value.
DEEP_LIGHT_OF_LEVEL = np.rint(65535 * LIGHT_OF_LEVEL.astype(np.float64)).astype(np.uint16)
LEVEL_OF_DEEP_LIGHT = np.rint(255 * linear_to_srgb(np.arange(65536) / 65535)).astype(np.uint8)


KNEE = 0.75  # light, 1 being white, over which highlights are compressed
BT2020_LUMA = (0.2627, 0.6780, 0.0593)  # weights of red, green and blue
# From the primaries of BT.2020 to those of sRGB.
NARROWER = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
)
WHITE_NITS, HLG_NITS, PQ_NITS = 203.0, 1000.0, 10_000.0  # white; what the two curves end at
BRIGHTEST = 5.0  # light that is cut, because it is compressed to white anyway


def compress_highlights(light: np.ndarray) -> np.ndarray:
    """Compress light over KNEE smoothly, so that highlights stay below 1 and do not clip."""
    over = 1.0 - np.exp(-np.maximum(light - KNEE, 0.0) / (1 - KNEE))
    return np.minimum(light, KNEE) + (1 - KNEE) * over


@cache
def _hdr_light(curve: str) -> np.ndarray:
    """Return the light (256,) of a curve's levels; of HLG that of the scene, before the screen."""
    level = np.arange(256) / 255
    if curve == "HLG":
        a = 0.17883277
        b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
        light = np.where(level <= 0.5, level**2 / 3, (np.exp((level - c) / a) + b) / 12) * HLG_NITS
    else:
        power = level ** (1 / 78.84375)
        ratio = np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)
        light = ratio ** (1 / 0.1593017578125) * PQ_NITS
    return (light / WHITE_NITS).astype(np.float32)


# The levels (65536,) of light from 0 to BRIGHTEST.
LEVEL_OF_HDR_LIGHT = LEVEL_OF_DEEP_LIGHT[
    np.rint(65535 * compress_highlights(np.linspace(0, BRIGHTEST, 65536))).astype(np.uint16)
]


def hdr_to_srgb(image: np.ndarray, curve: str) -> np.ndarray:
    """Convert a picture (H, W, 3) uint8 of high dynamic range, with BT.2020's primaries, to sRGB.

    The curve is "PQ" or "HLG". White is at 203 cd/m2; brighter light is compressed.

    Source: ITU-R BT.2100-2, tables 4 and 5; BT.2408-4, section 5.1 (white); BT.2087-0 (primaries).
    """
    light = cv2.LUT(image, _hdr_light(curve))
    if curve == "HLG":  # a screen shows brighter places brighter still
        luma = cv2.transform(light, np.array([BT2020_LUMA])) * (WHITE_NITS / HLG_NITS)
        light *= (luma**0.2).reshape(*light.shape[:2], 1)
    light = np.clip(cv2.transform(light, NARROWER), 0, BRIGHTEST)
    return LEVEL_OF_HDR_LIGHT[np.rint(light * (65535 / BRIGHTEST)).astype(np.uint16)]


def scale_light(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Multiply an image's (H, W, 3) uint8 sRGB linear light by gain (3,), clipping at white."""
    if not (np.isfinite(gain).all() and (gain > 0).all()):
        raise ValueError(f"gain is {gain}, expected three finite numbers above 0")
    table = np.rint(scaled_levels(gain)).astype(np.uint8)
    return np.stack([table[image[..., channel], channel] for channel in range(3)], axis=-1)


def scaled_levels(gain: np.ndarray) -> np.ndarray:
    """Map the 256 levels of 8-bit sRGB (256, 3) when linear light is multiplied by gain (3,)."""
    return np.minimum(255.0 * linear_to_srgb(LIGHT_OF_LEVEL[:, None] * gain), 255.0)


def is_grey(rgb: np.ndarray) -> bool:
    """Return whether a picture (H, W, 3) shows no colours, as that of a monochrome camera."""
    return bool(np.ptp(rgb, axis=2).mean() <= TINT * rgb.max(axis=2).mean())


def resize_area(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize an image (H, W[, C]): average areas to shrink it, interpolate to enlarge it.

    Raises:
        ValueError: the image or its new size is empty.
    """
    if 0 in image.shape or min(width, height) < 1:
        had = f"{image.shape[1]}x{image.shape[0]}"
        raise ValueError(f"resize of {had} to {width}x{height} pixels, expected 1x1 or more")
    shrinking = width <= image.shape[1] and height <= image.shape[0]
    mode = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    image = np.ascontiguousarray(image)
    # OpenCV averages blocks of whole pixels three times as fast as parts of pixels.
    most = max(1, min(image.shape[1] // width, image.shape[0] // height))
    step = max(k for k in range(1, most + 1) if image.shape[1] % k == image.shape[0] % k == 0)
    if step > 1:
        size = image.shape[1] // step, image.shape[0] // step
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.resize(image, (width, height), interpolation=mode)


def shrunk_size(width: int, height: int, side: int) -> tuple[int, int]:
    """Return width and height of an image after its longer side is reduced to ``side`` pixels."""
    scale = side / max(width, height)
    return (width, height) if scale >= 1 else (
        max(1, round(width * scale)), max(1, round(height * scale))
    )  # fmt: skip


def shrink(image: np.ndarray, side: int) -> np.ndarray:
    """Average an image (H, W[, C]) down to at most ``side`` pixels on its longer side."""
    width, height = shrunk_size(image.shape[1], image.shape[0], side)
    return image if image.shape[:2] == (height, width) else resize_area(image, width, height)


def reduce_light(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Average an image (H, W, 3) uint8 sRGB to a smaller size in linear light.

    A pixel at an outline then mixes subject and background by their areas, as keying assumes.
    """
    light = cv2.LUT(np.ascontiguousarray(image), DEEP_LIGHT_OF_LEVEL)
    return LEVEL_OF_DEEP_LIGHT[resize_area(light, width, height)]


def edge_distance(mask: np.ndarray) -> np.ndarray:
    """Measure the distance (H, W) float32 of each pixel of a mask (H, W) to the nearest outside it.

    Distances are in pixels, zero outside; the mask must have an outside. The last bit of OpenCV's
    square roots depends on where the mask lies in memory. Squared distances are integers, so
    rounding them gives the same bytes everywhere, up to 1,400 pixels from the edge, beyond which
    float32 cannot distinguish them.
    """
    rough = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.sqrt(np.rint(np.square(rough)))


def box_about(mask: np.ndarray, margin: int = 0) -> tuple[slice, slice]:
    """Return rows and columns of the marked pixels of a mask (H, W), and `margin` more around."""
    x, y, width, height = cv2.boundingRect(np.asarray(mask, np.uint8))
    return np.s_[max(0, y - margin) : y + height + margin, max(0, x - margin) : x + width + margin]


def disc(radius: int) -> np.ndarray:
    """Return a disc of a radius in pixels, for morphology."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def fit_into(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scale an image (h, w[, 3]) uint8 to fit, centred on a dark (height, width, 3) tile."""
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    scale = min(width / image.shape[1], height / image.shape[0])
    w, h = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    tile = np.full((height, width, 3), 24, np.uint8)
    y, x = (height - h) // 2, (width - w) // 2
    tile[y : y + h, x : x + w] = resize_area(image[..., :3], w, h)
    return tile


WHITE, ALARM = (255, 255, 255), (255, 120, 90)


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray]],
    labels: Sequence[str | Sequence[str]] = (),
    tile: tuple[int, int] = (160, 160),
    captions: Sequence[str] = (),
    alarming: Collection[str] = (),
) -> np.ndarray:
    """Lay out rows of images as one picture (H, W, 3) uint8.

    A row's label is one text, or one per image; ``captions`` stand above the columns. Labels that
    are ``alarming`` are red.
    """
    columns = max((len(row) for row in rows), default=1)
    blank = np.full((*tile, 3), 24, np.uint8)
    lines = []
    if captions:
        lines.append(np.full((20, columns * tile[1], 3), 24, np.uint8))
        _write_texts(lines[0], captions, tile[1])
    for number, row in enumerate(rows):
        tiles = [fit_into(image, *tile) for image in row]
        line = np.concatenate(tiles + [blank] * (columns - len(tiles)), axis=1)
        if number < len(labels) and labels[number]:
            line[:20] //= 3  # a dark band, so that white text is legible on any picture
            label = labels[number]
            texts = [label] if isinstance(label, str) else label
            _write_texts(line, texts, tile[1], alarming)
        lines.append(line)
    return np.concatenate(lines, axis=0) if lines else blank


def _write_texts(
    line: np.ndarray, texts: Sequence[str], step: int, alarming: Collection[str] = ()
) -> None:
    for number, text in enumerate(texts):
        end = None if len(texts) == 1 else (number + 1) * step
        colour = ALARM if text in alarming else WHITE
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(line[:, number * step : end], text, (5, 14), font, 0.42, colour, 1, cv2.LINE_AA)


def tile_sheet(
    pictures: Mapping[str, np.ndarray], columns: int, side: int, alarming: Collection[str] = ()
) -> np.ndarray:
    """Lay out named pictures in rows of square tiles, each with its name above it.

    Names that are ``alarming`` are red.
    """
    names = list(pictures)
    rows = [names[k : k + columns] for k in range(0, len(names), columns)]
    tiles = [[pictures[name] for name in row] for row in rows]
    return contact_sheet(tiles, rows, (side, side), alarming=alarming)
