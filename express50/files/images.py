"""Image files through OpenImageIO, depth maps, colour curves, resizing and contact sheets.

OpenImageIO reads and writes 8 and 16 bits, half and single float, with one interface; JPEG bytes
in memory go through OpenCV. Images are RGB, (H, W, 3); files hold sRGB unless a name says linear.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio

from express50.errors import FormatError
from express50.files.jpeg import cut_short, file_cut_short
from express50.geometry.shapes import PIXEL_LIMIT

# What an image may unpack to: so much in any case, beyond it so many times its file. Deflate packs
# zeros 1032-fold, JPEG's blocks of one colour about as much, and no camera comes near.
ROOM_BYTES, RATIO_LIMIT = 64 << 20, 4096
CUT = "truncated: a JPEG without its end; copy it again"
DEPTH_UNIT_M = 5e-5  # one step of a 16-bit depth map; 3.28 m at most, 0.025 mm rounding
DEPTH_LIMIT_M = DEPTH_UNIT_M * 65535


def read_image(path: Path) -> np.ndarray:
    """Read an image as (H, W) or (H, W, C) RGB in the file's own type.

    Returns:
        uint8, uint16 or float32 (half is widened) array.

    Raises:
        FormatError: the file is missing, not a flat image, truncated, over the pixel limit, or says
            that it unpacks to what its bytes cannot hold.
    """
    source = open_image(path)
    try:
        spec = source.spec()
        kind = {"uint8": "uint8", "uint16": "uint16"}.get(str(spec.format), "float")
        channels = min(spec.nchannels, 4)
        _check_image(path, spec, channels * np.dtype("f4" if kind == "float" else kind).itemsize)
        pixels = source.read_image(0, 0, 0, channels, kind)
        if pixels is None:
            raise FormatError(f"{path}: truncated or damaged ({_said(source.geterror)})")
        if file_cut_short(Path(path)):
            raise FormatError(f"{path}: {CUT}")
    finally:
        source.close()
    array = np.asarray(pixels).reshape(spec.height, spec.width, channels)
    return array[..., 0] if channels == 1 else array


def open_image(path: Path) -> oiio.ImageInput:
    """An image file, its header read; close it.

    Raises:
        FormatError: it is missing or not an image.
    """
    source = oiio.ImageInput.open(str(path)) if Path(path).is_file() else None
    if source is None:
        why = _said(oiio.geterror) or "it cannot be opened"
        raise FormatError(f"{path}: cannot be read as an image ({why}); copy it again")
    return source


def _said(geterror: Callable[[], str]) -> str:
    """What OpenImageIO says went wrong; it may quote bytes of the file that are no text."""
    try:
        return geterror().strip()
    except UnicodeDecodeError:
        return "damaged"


def _check_image(path: Path, spec: oiio.ImageSpec, pixel_bytes: int) -> None:
    """Refuse what is no flat picture, or says to hold more than it can."""
    size = f"{spec.width}x{spec.height} pixels of {spec.nchannels} channels"
    if spec.deep or spec.depth > 1 or min(spec.width, spec.height, spec.nchannels) < 1:
        raise FormatError(f"{path}: {size}, deep or a volume; expected a flat image")
    if spec.width * spec.height > PIXEL_LIMIT:
        raise FormatError(f"{path}: {size}, over {PIXEL_LIMIT}; store it smaller")
    have = Path(path).stat().st_size
    if spec.width * spec.height * pixel_bytes > max(ROOM_BYTES, RATIO_LIMIT * have):
        raise FormatError(f"{path}: {size} in {have} bytes; it is damaged, copy it again")


def read_alpha(path: Path) -> np.ndarray:
    """Read an 8-bit grey image (H, W) uint8.

    Raises:
        FormatError: it cannot be read, or is of another kind.
    """
    alpha = read_image(path)
    if alpha.ndim != 2 or alpha.dtype != np.uint8:
        raise FormatError(f"{path}: {alpha.dtype} {alpha.shape}, expected an 8-bit grey matte")
    return alpha


def write_image(path: Path, image: np.ndarray, quality: int = 95, half: bool = False) -> None:
    """Write (H, W) or (H, W, C) uint8, uint16 or float32; the ending chooses the format.

    Args:
        path: target; .png .jpg .tif .exr.
        image: the pixels, RGB.
        quality: JPEG quality, 1 to 100 (4:4:4 from 95 upwards).
        half: store floats as half (EXR, TIFF).

    Raises:
        FormatError: the file cannot be written.
    """
    image = np.ascontiguousarray(image)
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    channels = 1 if image.ndim == 2 else image.shape[2]
    kind = "half" if half else {"uint8": "uint8", "uint16": "uint16"}.get(str(image.dtype), "float")
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], channels, kind)
    spec.attribute("Compression", _compression(Path(path).suffix.lower(), quality))
    if quality >= 95:
        spec.attribute("jpeg:subsampling", "4:4:4")
    spec.attribute("png:compressionLevel", 3)
    if Path(path).suffix.lower() == ".exr":  # the time of writing would go into its header
        spec.attribute("DateTime", "1970:01:01 00:00:00")
    target = oiio.ImageOutput.create(str(path))
    if target is None or not target.open(str(path), spec):
        raise FormatError(f"{path}: cannot be written ({oiio.geterror().strip()})")
    written = target.write_image(image.reshape(image.shape[0], image.shape[1], channels))
    if not target.close() or not written:
        raise FormatError(f"{path}: writing failed ({target.geterror().strip()})")


def _compression(suffix: str, quality: int) -> str:
    return {".jpg": f"jpeg:{quality}", ".jpeg": f"jpeg:{quality}", ".exr": "zip"}.get(suffix, "zip")


def encode_jpeg(image: np.ndarray, quality: int = 95) -> bytes:
    """JPEG bytes of an RGB (H, W, 3) or grey (H, W) uint8 image; 4:4:4 from quality 95 upwards."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if quality >= 95:
        flags += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return cv2.imencode(".jpg", _swap(image), flags)[1].tobytes()


def encode_png(image: np.ndarray) -> bytes:
    """PNG bytes of a grey or RGB uint8 or uint16 image."""
    return cv2.imencode(".png", _swap(image), [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def decode_image(data: bytes, name: str = "image") -> np.ndarray:
    """Decode JPEG or PNG bytes to RGB (H, W, 3) or grey (H, W), keeping 8 or 16 bits.

    Raises:
        FormatError: the bytes are no image, or one over the pixel limit.
    """
    width, height = image_size(data, name)
    if width * height > min(PIXEL_LIMIT, max(ROOM_BYTES, RATIO_LIMIT * len(data))):
        raise FormatError(f"{name}: {width}x{height} pixels in {len(data)} bytes; it is damaged")
    return _swap(decode_cv(data, cv2.IMREAD_UNCHANGED, name))


def decode_cv(data: bytes, flags: int, name: str) -> np.ndarray:
    """The image in encoded bytes as OpenCV has it; look at its size before.

    Raises:
        FormatError: the bytes are damaged, or end too soon.
    """
    if cut_short(data):
        raise FormatError(f"{name}: {CUT}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FormatError(f"{name}: cannot be decoded ({error.err}); copy it again") from None
    if image is None:
        raise FormatError(f"{name}: {len(data)} bytes are a damaged image; copy it again")
    return image


def image_size(data: bytes, where: str) -> tuple[int, int]:
    """Width and height in a PNG's or JPEG's header, before any pixel is decoded.

    What decoders would pass over (garbage between segments) is refused: they might find another
    header there than this one.

    Raises:
        FormatError: the bytes are neither.

    Source: PNG 1.2, 11.2.2 (IHDR); ITU-T T.81, B.1.1.2 to B.2.2 (markers, frame header).
    """
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        return struct.unpack(">II", data[16:24])
    position = 2 if data[:2] == b"\xff\xd8" else len(data)
    while position + 9 < len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4])
        if marker == 0xFF:  # a fill byte
            position += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        if marker < 0xC0 or 0xD0 <= marker <= 0xDA:  # has no length, or ends the header
            break
        position += 2 + length
    raise FormatError(f"{where}: {len(data)} bytes are no PNG or JPEG image")


def _swap(image: np.ndarray) -> np.ndarray:
    """RGB to BGR or back; a copy that OpenCV accepts."""
    return np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image


def depth_to_uint16(depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """16-bit steps (H, W) of a depth map (H, W), metres; 0 where not valid.

    Raises:
        ValueError: a valid depth is not finite, not positive or over 3.27 m.
    """
    inside = depth[valid]
    if inside.size and not (
        np.isfinite(inside).all() and inside.min() > 0 and inside.max() < DEPTH_LIMIT_M
    ):
        raise ValueError(
            f"valid depth must lie in (0, {DEPTH_LIMIT_M:.3f}) m; is the rig in metres?"
        )
    steps = np.where(valid, np.maximum(np.rint(depth / DEPTH_UNIT_M), 1), 0)
    return np.nan_to_num(steps).astype(np.uint16)


def depth_from_uint16(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) float32 metres (0 where unknown) and its validity (H, W) of 16-bit steps."""
    return (steps * np.float32(DEPTH_UNIT_M)).astype(np.float32), steps > 0


def write_depth_png(path: Path, depth: np.ndarray, valid: np.ndarray) -> None:
    """Write a depth map (H, W), metres, as 16-bit PNG in steps of 0.05 mm; 0 means unknown."""
    write_image(path, depth_to_uint16(depth, valid))


def read_depth_png(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read depth (H, W) float32 metres and validity (H, W) bool.

    Raises:
        FormatError: the file is not a 16-bit grey image.
    """
    steps = read_image(path)
    if steps.dtype != np.uint16 or steps.ndim != 2:
        raise FormatError(f"{path}: {steps.dtype} {steps.shape}, expected a 16-bit grey depth map")
    return depth_from_uint16(steps)


def srgb_to_linear(image_srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values in [0, 1]; IEC 61966-2-1."""
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


def scale_light(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Image (H, W, 3) uint8 sRGB with linear light times gain (3,); what exceeds white is white."""
    if not (np.isfinite(gain).all() and (gain > 0).all()):
        raise ValueError(f"gain is {gain}, expected three finite numbers above 0")
    table = np.rint(scaled_levels(gain)).astype(np.uint8)
    return np.stack([table[image[..., channel], channel] for channel in range(3)], axis=-1)


def scaled_levels(gain: np.ndarray) -> np.ndarray:
    """What the 256 levels of 8-bit sRGB become (256, 3) when linear light is times gain (3,)."""
    return np.minimum(255.0 * linear_to_srgb(LIGHT_OF_LEVEL[:, None] * gain), 255.0)


def resize_area(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize (H, W[, C]); averages areas when shrinking, interpolates when growing."""
    shrinking = width <= image.shape[1] and height <= image.shape[0]
    mode = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=mode)


def edge_distance(mask: np.ndarray) -> np.ndarray:
    """Distance (H, W) float32 of each pixel of a mask (H, W) to the nearest outside it, in pixels.

    Zero outside; a mask without an outside has no meaning. OpenCV's roots differ in the last bit
    with where in memory a mask lies; squared distances are whole numbers, and rounding them gives
    the same bytes everywhere (up to 1,400 pixels from the edge, where float32 no longer tells).
    """
    rough = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.sqrt(np.rint(np.square(rough)))


def fit_into(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """The image (h, w[, 3]) uint8 scaled to fit and centred on a dark (height, width, 3) tile."""
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    scale = min(width / image.shape[1], height / image.shape[0])
    w, h = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    tile = np.full((height, width, 3), 24, np.uint8)
    y, x = (height - h) // 2, (width - w) // 2
    tile[y : y + h, x : x + w] = resize_area(image[..., :3], w, h)
    return tile


_LABEL = (cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray]],
    labels: Sequence[str] | None = None,
    tile: tuple[int, int] = (160, 160),
) -> np.ndarray:
    """One picture (H, W, 3) uint8 of rows of images, each row with an optional label."""
    columns = max((len(row) for row in rows), default=1)
    blank = np.full((*tile, 3), 24, np.uint8)
    lines = []
    for number, row in enumerate(rows):
        tiles = [fit_into(image, *tile) for image in row]
        line = np.concatenate(tiles + [blank] * (columns - len(tiles)), axis=1)
        if labels is not None:
            line[:20] //= 3  # a dark band, so that white words read on any picture
            cv2.putText(line, labels[number], (5, 14), *_LABEL)
        lines.append(line)
    return np.concatenate(lines, axis=0) if lines else blank
