"""Encode and decode the pictures of a shard, by profile and by a member's name.

``compact`` and ``lossless`` hold what every image library reads (JPEG, PNG). ``fast`` holds what
decodes in the least time: alpha and parts as zstd over their bytes, depth as LERC without loss
(Esri's limited error raster compression, version 2, at error 0); both through imagecodecs.
"""

from __future__ import annotations

import struct

import imagecodecs
import numpy as np

from express50.errors import FormatError
from express50.files.images import decode_image, encode_jpeg, encode_png, image_size
from express50.geometry.shapes import PIXEL_LIMIT

PROFILES = ("compact", "fast", "lossless")
RGB = ("rgb.jpg", "rgb.png")
ALPHA = ("alpha.png", "alpha.zst")
PARTS = ("parts.png", "parts.zst")
DEPTH = ("depth.png", "depth.lerc")
ZSTD_LEVEL = 3
crc32 = imagecodecs.deflate_crc32  # zlib's CRC-32, eight times as fast
# Name, version, checksum, rows, columns, depth, valid pixels, block, bytes of the blob.
LERC_HEADER = struct.Struct("<6siIiiiiii")


def encode_pictures(
    rgb: np.ndarray, alpha: np.ndarray, depth: np.ndarray, parts: np.ndarray | None, profile: str
) -> dict[str, bytes]:
    """Encode the pictures of a sample as members by name.

    Args:
        rgb: (H, W, 3) uint8 sRGB.
        alpha: (H, W) uint8.
        depth: (H, W) uint16 steps, 0 = unknown.
        parts: (H, W) uint8 labels, or None.
        profile: one of `PROFILES`.
    """
    if profile == "lossless":
        members = {"rgb.png": encode_png(rgb)}
    else:
        members = {"rgb.jpg": encode_jpeg(rgb, 90 if profile == "compact" else 95)}
    small = {"alpha": alpha} | ({} if parts is None else {"parts": parts})
    if profile == "fast":
        for name, image in small.items():
            code = imagecodecs.zstd_encode(image.tobytes(), level=ZSTD_LEVEL)
            members[f"{name}.zst"] = bytes(code)
        members["depth.lerc"] = bytes(imagecodecs.lerc_encode(np.ascontiguousarray(depth), level=0))
    else:
        members |= {f"{name}.png": encode_png(image) for name, image in small.items()}
        members["depth.png"] = encode_png(depth)
    return members


def decode_picture(name: str, data: bytes, width: int, height: int, where: str) -> np.ndarray:
    """Decode a member: (H, W, 3) uint8, (H, W) uint8 or, of depth, (H, W) uint16.

    A header is checked before a pixel is decoded: no member makes more memory than its size says.

    Raises:
        FormatError: the bytes are damaged, or of another size or kind than expected.
    """
    size = (width, height)
    if not name.endswith(".zst"):
        size = lerc_size(data, where) if name.endswith(".lerc") else image_size(data, where)
    if size[0] * size[1] > PIXEL_LIMIT:
        raise FormatError(f"{where}: {size[0]}x{size[1]} pixels, over the limit {PIXEL_LIMIT}")
    if size != (width, height):
        raise FormatError(
            f"{where}: {size[0]}x{size[1]} pixels, expected the meta's {width}x{height};"
            " rerun 'express50 pack'"
        )
    if name.endswith(".zst"):
        return _unzstd(data, width, height, where)
    try:
        if name not in (*RGB, *ALPHA, *PARTS, *DEPTH):
            raise ValueError(f"{name} is not a picture of a sample")
        if name.endswith(".png"):
            image = decode_image(data, where)
        else:
            lerc = name.endswith(".lerc")
            image = (imagecodecs.lerc_decode if lerc else imagecodecs.jpeg8_decode)(data)
    except (RuntimeError, ValueError) as error:  # imagecodecs' errors are RuntimeErrors
        raise FormatError(f"{where}: cannot be decoded ({error})") from None
    kind = np.uint16 if name in DEPTH else np.uint8
    if image.dtype != kind or image.shape != (height, width, 3)[: 3 if name in RGB else 2]:
        raise FormatError(f"{where}: {image.dtype} {image.shape}, expected {np.dtype(kind)}")
    return image


def _unzstd(data: bytes, width: int, height: int, where: str) -> np.ndarray:
    image = bytearray(width * height + 1)  # one more, so that a longer content shows
    try:
        count = len(imagecodecs.zstd_decode(data, out=image))
    except (RuntimeError, ValueError) as error:
        raise FormatError(f"{where}: cannot be decoded ({error})") from None
    if count != width * height:
        raise FormatError(f"{where}: {count} bytes or more, expected {width}x{height}")
    return np.frombuffer(image, np.uint8, count).reshape(height, width)


def lerc_size(data: bytes, where: str) -> tuple[int, int]:
    """Read width and height from the header of a LERC blob.

    Raises:
        FormatError: the bytes are not such a blob.
    """
    if len(data) >= LERC_HEADER.size:
        name, version, _, rows, columns, depth, _, _, size = LERC_HEADER.unpack_from(data)
        # A second blob behind the first would be a second channel of the whole size.
        alone = size == len(data) and depth == 1 and min(rows, columns) > 0
        if name == b"Lerc2 " and 4 <= version <= 6 and alone:
            return columns, rows
    raise FormatError(f"{where}: {len(data)} bytes are not a LERC image of one channel")
