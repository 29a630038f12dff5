"""Encode and decode the pictures of a shard.

The profiles ``compact`` and ``lossless`` use JPEG and PNG, which every image library reads.
``fast`` uses what imagecodecs decodes fastest: alpha and parts as zstd of their bytes, depth as
lossless LERC (Esri's limited error raster compression, version 2, at error 0).
"""

from __future__ import annotations

import struct

import imagecodecs
import numpy as np

from express50.errors import FormatError
from express50.files.images import decode_image, encode_jpeg, encode_png, image_size
from express50.files.text import refusing
from express50.geometry.shapes import PIXEL_LIMIT

AGAIN = "rerun 'express50 pack'"
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
    """Encode the pictures of a sample; return the members by name.

    Colours (H, W, 3) are uint8 sRGB, alpha (H, W) is uint8, depth (H, W) is in uint16 steps, 0
    where unknown, and parts (H, W) are uint8 labels, or None. `profile` is one of `PROFILES`.
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
    """Decode a member: RGB (H, W, 3) uint8, alpha and parts (H, W) uint8, depth (H, W) uint16.

    The header is checked before any pixel is decoded, so that a wrong member cannot fill the
    memory.

    Raises:
        FormatError: the bytes are damaged, or of another size or kind than expected.
    """
    if name not in (*RGB, *ALPHA, *PARTS, *DEPTH):
        raise FormatError(f"{where}: {name} is not a picture of a sample; {AGAIN}")
    size = (width, height)
    if not name.endswith(".zst"):
        size = lerc_size(data, where) if name.endswith(".lerc") else image_size(data, where)
    if size[0] * size[1] > PIXEL_LIMIT:
        raise FormatError(
            f"{where}: {size[0]}x{size[1]} pixels, expected at most {PIXEL_LIMIT}; {AGAIN}"
        )
    if size != (width, height):
        raise FormatError(
            f"{where}: {size[0]}x{size[1]} pixels, expected the meta's {width}x{height}; {AGAIN}"
        )
    with refusing(FormatError, f"{where}: cannot be decoded", AGAIN):
        if name.endswith(".zst"):
            bytes_out = bytearray(width * height + 1)  # one more, to notice contents too long
            count = len(imagecodecs.zstd_decode(data, out=bytes_out))
            image = np.frombuffer(bytes_out, np.uint8, count).reshape(height, width)
        elif name.endswith(".png"):
            image = decode_image(data, where)
        else:
            lerc = name.endswith(".lerc")
            image = (imagecodecs.lerc_decode if lerc else imagecodecs.jpeg8_decode)(data)
    shape = (height, width, 3) if name in RGB else (height, width)
    kind = np.dtype(np.uint16 if name in DEPTH else np.uint8)
    if image.dtype != kind or image.shape != shape:
        raise FormatError(f"{where}: {image.dtype} {image.shape}, expected {kind} {shape}; {AGAIN}")
    return image


def lerc_size(data: bytes, where: str) -> tuple[int, int]:
    """Read a LERC blob's width and height; FormatError unless it is one blob of one channel."""
    if len(data) >= LERC_HEADER.size:
        name, version, _, rows, columns, depth, _, _, size = LERC_HEADER.unpack_from(data)
        # A second blob after the first would decode as a second channel of the same size.
        alone = size == len(data) and depth == 1 and min(rows, columns) > 0
        if name == b"Lerc2 " and 4 <= version <= 6 and alone:
            return columns, rows
    raise FormatError(f"{where}: {len(data)} bytes are not a LERC image of one channel; {AGAIN}")
