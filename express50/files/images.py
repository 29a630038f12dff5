"""Read, write, encode and decode images; quantise depth.

OpenImageIO reads files with 8 and 16 bits, half and single floats, and encodes TIFF and EXR;
imagecodecs reads PNG twice as fast; OpenCV decodes bytes in memory and encodes JPEG. Images are RGB
(H, W, 3); files hold sRGB unless a name says linear.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import OpenImageIO as oiio

from express50.errors import FormatError
from express50.files.atomic import naming_full_disk
from express50.files.text import open_file, reason, unreadable
from express50.geometry.shapes import PIXEL_LIMIT

DAMAGED = "truncated or damaged"
REPAIR = "copy it again, or run 'express50 check --fix' if a stage wrote it"
CUT = "truncated: the JPEG has no end marker; copy it again"
DEPTH_UNIT_M = 5e-5  # one step of a 16-bit depth map; 3.28 m at most, 0.025 mm rounding
DEPTH_LIMIT_M = DEPTH_UNIT_M * 65535
JPEG_ENDINGS = (".jpg", ".jpeg")
# Of TIFF (6.0, section 8): grey, RGB, palette and YCbCr. Conversions of others are guesses: inks
# need their printer's profile, and OpenImageIO's CIELAB is off by 30 of 255 levels.
PHOTOMETRIC = (0, 1, 2, 3, 6)
JPEG_SIDE, PNG_SIDE = 65500, 1_000_000  # pixels; encoder and decoder refuse longer sides
PNG_START = b"\x89PNG\r\n\x1a\n"
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
SRGB_SLACK = 2  # of 255 levels by which profiles of sRGB differ from each other
UP, PNG_LEVEL = 2, 3  # of PNG's filters the difference from the row above; libdeflate's level
# Orientation -> quarter turns counter-clockwise after an optional left-right flip (EXIF 2.3).
TURNS = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (1, True), 6: (3, False),
         7: (3, True), 8: (1, False)}  # fmt: skip
# Quarter turns counter-clockwise without a flip -> orientation.
ORIENTATION = {turns: number for number, (turns, flipped) in TURNS.items() if not flipped}


def read_image(path: Path) -> np.ndarray:
    """Read an image as (H, W) or (H, W, C) RGB in the file's own type.

    Returns:
        A uint8, uint16 or float32 array (half floats are widened).

    Raises:
        FormatError: the file is missing, truncated, not a flat image, or over the pixel limit.
    """
    if (plain := _plain_png(Path(path))) is not None:
        return plain
    source = open_image(path)
    try:
        spec = source.spec()
        size = f"{spec.width}x{spec.height} pixels of {spec.nchannels} channels"
        if spec.deep or spec.depth > 1 or min(spec.width, spec.height, spec.nchannels) < 1:
            raise FormatError(f"{path}: {size}, deep or a volume; expected a flat image")
        if spec.width * spec.height > PIXEL_LIMIT:
            raise FormatError(f"{path}: {size}, expected at most {PIXEL_LIMIT}; store it smaller")
        kind = _pixel_kind(spec.format)
        channels = min(spec.nchannels, 4)
        pixels = source.read_image(0, 0, 0, channels, kind)
        if pixels is None:
            raise FormatError(f"{path}: {DAMAGED} ({_error_text(source.geterror)}); {REPAIR}")
    finally:
        source.close()
    with (
        Path(path).open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        if is_cut_short(data):
            raise FormatError(f"{path}: {CUT}")
    array = np.asarray(pixels).reshape(spec.height, spec.width, channels)
    return array[..., 0] if channels == 1 else array


def _plain_png(path: Path) -> np.ndarray | None:
    """Read a PNG of 8 or 16 bits without a palette, in half of OpenImageIO's time.

    None for any other file, and for one that OpenImageIO has to refuse.

    Raises:
        FormatError: it is damaged. OpenImageIO's decoder would print that as well.
    """
    with suppress(OSError), open_file(path) as file:
        head = file.read(26)
        if len(head) < 26 or not head.startswith(PNG_START):
            return None
        width, height = image_size(head, str(path))
        if not 0 < width * height <= PIXEL_LIMIT or head[24] not in (8, 16):
            return None
        channels, data = {0: (), 2: (3,), 4: (2,), 6: (4,)}.get(head[25]), head + file.read()
        if channels is not None and (own := _own_png(data, (height, width, *channels))) is not None:
            return own
        try:
            pixels = imagecodecs.png_decode(data)
        except imagecodecs.PngError as error:
            raise FormatError(f"{path}: {DAMAGED} ({error}); {REPAIR}") from error
        return pixels if channels is not None and pixels.shape[2:] == channels else None
    return None


def _own_png(data: bytes, shape: tuple[int, ...]) -> np.ndarray | None:
    """Decode a PNG as `encode_png` makes them, in a third of libpng's time.

    None if another program wrote it, or if it is damaged: libpng then says how.
    """
    kind, end = np.dtype(f">u{data[24] // 8}"), len(data) - len(PNG_END)
    length = math.prod(shape[1:]) * kind.itemsize + 1  # of a row, with its filter type
    header, body = data[12:33], data[37:end]
    if data[26:29] != bytes(3) or int.from_bytes(data[33:37], "big") != len(body) - 8:
        return None
    if body[:4] != b"IDAT" or data[end:] != PNG_END or not (_intact(header) and _intact(body)):
        return None
    rows = np.empty((shape[0], length), np.uint8)
    try:
        if len(imagecodecs.deflate_decode(body[4:-4], out=rows.reshape(-1).data)) != rows.size:
            return None
    except imagecodecs.DeflateError:
        return None
    if (rows[:, 0] != UP).any():
        return None
    for above, row in zip(rows[:-1, 1:], rows[1:, 1:], strict=True):
        np.add(above, row, out=row)
    pixels = np.ascontiguousarray(rows[:, 1:]).view(kind).reshape(shape)
    return pixels.astype(kind.newbyteorder("="), copy=False)


def _intact(chunk: bytes) -> bool:
    """Return True if the kind and the data of a PNG's chunk have the checksum that follows them."""
    return int.from_bytes(chunk[-4:], "big") == imagecodecs.deflate_crc32(chunk[:-4])


def open_image(path: Path) -> oiio.ImageInput:
    """Open an image file and read its header; the caller closes it.

    Raises:
        FormatError: it is missing, not an image, or holds no grey or RGB, such as CMYK.
    """
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)  # otherwise colours are multiplied by alpha
    there = os.access(path, os.R_OK) and Path(path).is_file()
    source = oiio.ImageInput.open(str(path), straight) if there else None
    if source is None:
        why = _error_text(oiio.geterror) or "it cannot be opened"
        fix = "copy it again, or export it in RGB as PNG, JPEG or TIFF"
        why = unreadable(Path(path)) or f"cannot be read as an image ({why}); {fix}"
        raise FormatError(f"{path}: {why}")
    spec = source.spec()
    number = spec.get_int_attribute("tiff:PhotometricInterpretation", 2)
    kind = spec.get_string_attribute("jpeg:ColorSpace")
    if number not in PHOTOMETRIC or kind in ("CMYK", "YCbCrK"):
        kind = kind or spec.get_string_attribute("tiff:ColorSpace") or f"photometric {number}"
        source.close()
        raise FormatError(f"{path}: holds {kind}, expected grey or RGB; export it in RGB")
    return source


def _pixel_kind(given: object) -> str:
    return str(given) if str(given) in ("uint8", "uint16") else "float"


def _error_text(geterror: Callable[[], str]) -> str:
    """Return OpenImageIO's error, which may quote bytes of the file that are not text."""
    try:
        return geterror().strip()
    except UnicodeDecodeError:
        return "damaged"


def read_exif(path: Path) -> tuple[int, float]:
    """Read the orientation, 1 to 8, and the 35 mm equivalent focal length, 0 if unknown.

    A rig's images are used as stored, since a calibration refers to stored pixels. Bare photographs
    have no calibration: they are rotated upright first, so that width, height and principal point
    are those of the upright picture. A 35 mm equivalent focal length refers to the diagonal, which
    rotation does not change.

    Raises:
        FormatError: the file is not an image.
    """
    image = open_image(path)
    try:
        spec = image.spec()
        values = [spec.getattribute(name) for name in ("Orientation", "Exif:FocalLengthIn35mmFilm")]
    except UnicodeDecodeError:  # undecodable text instead of a number
        values = [1, 0.0]
    finally:
        image.close()
    orientation, film = (value if isinstance(value, int | float) else 0 for value in values)
    usable = math.isfinite(film) and 0 < film < 1e5
    return (int(orientation) if orientation in TURNS else 1), (float(film) if usable else 0.0)


@dataclass(frozen=True)
class ColourProfile:
    """An ICC profile whose colours are not those of sRGB."""

    name: str
    data: bytes

    def to_srgb(self, image: np.ndarray) -> np.ndarray:
        """Convert colours (H, W, 3) uint8 of this profile to sRGB; those outside of it are cut.

        Raises:
            RuntimeError: the profile cannot be used (imagecodecs.CmsError).
        """
        return imagecodecs.cms_transform(
            np.ascontiguousarray(image), self.data, imagecodecs.cms_profile("srgb"),
            colorspace="rgb", outcolorspace="rgb",
        )  # fmt: skip


def foreign_profile(path: Path) -> ColourProfile | None:
    """Read a picture's ICC profile; None without a usable one, and if it means sRGB's colours.

    OpenImageIO calls all pictures of 8 and 16 bits sRGB, whatever their profile is. Profiles of
    grey pictures do not count, and neither do those of float ones, which hold linear light.

    Raises:
        FormatError: the file is not an image.
    """
    image = open_image(path)
    spec = image.spec()
    image.close()
    data = spec.getattribute("ICCProfile")
    if data is None or spec.nchannels < 3 or _pixel_kind(spec.format) == "float":
        return None
    name = spec.get_string_attribute("ICCProfile:profile_description") or "without a name"
    profile = ColourProfile(name, bytes(data))
    levels = np.linspace(0, 255, 9).astype(np.uint8)
    colours = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, 27, 3)
    with suppress(imagecodecs.CmsError):  # damaged, or of another number of channels
        if np.abs(profile.to_srgb(colours).astype(int) - colours).max() > SRGB_SLACK:
            return profile
    return None


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate a stored image upright according to its EXIF orientation (1 to 8)."""
    turns, flipped = TURNS[orientation]
    if (turns, flipped) == (0, False):
        return image
    return np.ascontiguousarray(np.rot90(image[:, ::-1] if flipped else image, turns))


def read_alpha(path: Path) -> np.ndarray:
    """Read an 8-bit grey image (H, W) uint8; FormatError if it is anything else."""
    alpha = read_image(path)
    if alpha.ndim != 2 or alpha.dtype != np.uint8:
        raise FormatError(f"{path}: {alpha.dtype} {alpha.shape}, expected an 8-bit grey matte")
    return alpha


def write_image(path: Path, image: np.ndarray, quality: int = 95) -> None:
    """Write (H, W) or (H, W, C) RGB, uint8, uint16 or float32, as .png, .jpg, .tif or .exr.

    JPEG's ``quality`` is 1 to 100; from 95 upwards chroma is not subsampled (4:4:4).

    Raises:
        FormatError: the file cannot be written.
        DiskFullError: the disk is full.
    """
    image = np.ascontiguousarray(image)
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    ending = Path(path).suffix.lower()
    if ending in JPEG_ENDINGS:
        data = encode_jpeg(image, quality)
    elif ending == ".png" and image.dtype != np.float32:
        data = encode_png(image)
    else:
        data = _encode_in_memory(path, image)
    try:
        with naming_full_disk(path):
            path.write_bytes(data)
    except OSError as error:
        raise FormatError(f"{path}: cannot be written ({reason(error)})") from error


def _encode_in_memory(path: Path, image: np.ndarray) -> bytes:
    """Encode an image with OpenImageIO in the format that its file's name says.

    OpenImageIO must not write to disk itself: on a full one, it leaves out the end of a file
    without an error, or ends the process. Needs Linux.

    Raises:
        FormatError: the format cannot hold such an image.
    """
    target = _make_output(path)
    channels = 1 if image.ndim == 2 else image.shape[2]
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], channels, _pixel_kind(image.dtype))
    spec.attribute("Compression", "zip")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if Path(path).suffix.lower() == ".exr":  # otherwise its header would hold the time of writing
        spec.attribute("DateTime", "1970:01:01 00:00:00")
    file = os.memfd_create("image")
    try:
        name = f"/proc/self/fd/{file}"
        done = target.open(name, spec) and target.write_image(image.reshape(*image.shape[:2], -1))
        if not target.close() or not done:
            why = target.geterror().strip().replace(name, str(path))
            raise FormatError(f"{path}: cannot be written ({why}); give another name")
        return Path(name).read_bytes()
    finally:
        os.close(file)


def check_ending(path: Path) -> None:
    """Raise FormatError unless a picture's name ends as one of the formats that are written."""
    _make_output(path)


def _make_output(path: Path) -> oiio.ImageOutput:
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        oiio.geterror()  # otherwise it is printed when the process ends
        why = "expected .png, .jpg, .tif or .exr as its ending"
        raise FormatError(f"{path}: cannot be written ({why}); give another name")
    return output


def encode_jpeg(image: np.ndarray, quality: int = 95) -> bytes:
    """Encode an RGB (H, W, 3) or grey (H, W) uint8 image as JPEG; 4:4:4 from quality 95 upwards.

    Raises:
        FormatError: a side is empty or longer than the format allows, or it is another image.
    """
    _check_sides("JPEG", image, JPEG_SIDE)
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (1,), (3,)):
        kind = f"{image.dtype} {image.shape}"
        raise FormatError(f"JPEG: {kind}, expected 8 bits, grey or RGB; use .png or .tif")
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if quality >= 95:
        flags += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return cv2.imencode(".jpg", _swap(image), flags)[1].tobytes()


def encode_png(image: np.ndarray) -> bytes:
    """Encode a grey or RGB image (H, W[, C]) uint8 or uint16, with alpha or without, as PNG.

    Each row is stored as its difference from the one above and compressed by libdeflate. Libpng
    takes three to five times as long for as many bytes (docs/LOG.md).

    Raises:
        FormatError: a side is empty, or longer than OpenCV reads.

    Source: PNG 1.2, 4 (chunks), 6.4 (filter type Up).
    """
    _check_sides("PNG", image, PNG_SIDE)
    (height, width), channels = image.shape[:2], math.prod(image.shape[2:])
    rows = np.ascontiguousarray(image.astype(image.dtype.newbyteorder(">"), copy=False))
    rows = rows.view(np.uint8).reshape(height, -1)
    body = bytearray(height * (rows.shape[1] + 1))
    filtered = np.frombuffer(body, np.uint8).reshape(height, -1)
    filtered[:, 0], filtered[0, 1:] = UP, rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    colour = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", width, height, 8 * image.itemsize, colour, 0, 0, 0)
    pixels = imagecodecs.deflate_encode(body, level=PNG_LEVEL)
    chunks = ((b"IHDR", header), (b"IDAT", pixels), (b"IEND", b""))
    return PNG_START + b"".join(
        struct.pack(">I", len(data)) + kind + data
        + struct.pack(">I", imagecodecs.deflate_crc32(data, imagecodecs.deflate_crc32(kind)))
        for kind, data in chunks
    )  # fmt: skip


def _check_sides(kind: str, image: np.ndarray, longest: int) -> None:
    if max(image.shape[:2]) > longest or 0 in image.shape:
        size = f"{image.shape[1]}x{image.shape[0]} pixels"
        less = "; use PNG, or a smaller image" if kind == "JPEG" else ""
        raise FormatError(f"{kind}: {size}, expected sides of 1 to {longest}{less}")


def has_alpha(path: Path) -> bool:
    """Return True if a file is a PNG whose header declares an alpha channel."""
    with path.open("rb") as file:
        head = file.read(26)
    return head.startswith(PNG_START) and head[25:] in (b"\x04", b"\x06")  # grey or RGB, alpha


def decode_image(data: bytes, name: str = "image") -> np.ndarray:
    """Decode JPEG or PNG bytes to RGB (H, W, 3) or grey (H, W), keeping 8 or 16 bits.

    Raises:
        FormatError: the bytes are not an image, or the image is over the pixel limit.
    """
    width, height = image_size(data, name)
    if width * height > PIXEL_LIMIT:
        raise FormatError(f"{name}: {width}x{height} pixels, expected at most {PIXEL_LIMIT}")
    return _swap(decode_cv(data, cv2.IMREAD_UNCHANGED, name))


def decode_cv(data: bytes, flags: int, name: str) -> np.ndarray:
    """Decode bytes with OpenCV, refusing a truncated JPEG; callers check the image's size first.

    Raises:
        FormatError: the bytes are damaged or truncated.
    """
    if is_cut_short(data):
        raise FormatError(f"{name}: {CUT}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FormatError(f"{name}: cannot be decoded ({error.err}); copy it again") from None
    if image is None:
        raise FormatError(f"{name}: {len(data)} bytes are a damaged image; copy it again")
    return image


def image_size(data: bytes, where: str) -> tuple[int, int]:
    """Read width and height from a PNG's or JPEG's header, without decoding pixels.

    Raises:
        FormatError: the bytes are neither PNG nor JPEG.

    Source: PNG 1.2, 11.2.2 (IHDR).
    """
    if data[:8] == PNG_START and len(data) >= 24:
        return struct.unpack(">II", data[16:24])
    size, _ = _jpeg_header(data)
    if size is None:
        raise FormatError(f"{where}: {len(data)} bytes are not a PNG or JPEG image")
    return size


def is_cut_short(data: bytes | mmap.mmap) -> bool:
    """Return True if a JPEG stops before its end marker; False for other bytes.

    Decoders fill what is missing with grey and do not report it. Thumbnails in the header have end
    markers of their own, so the search starts after the first scan's header. Some cameras write
    more data after the picture's end marker. In a scan, 0xFF is always followed by a byte that says
    what it is (ITU-T T.81, B.1.1.5), so no other data looks like an end marker.
    """
    if data[:2] != b"\xff\xd8":
        return False
    _, scan = _jpeg_header(data)
    return scan is None or data.find(b"\xff\xd9", scan) < 0


def _jpeg_header(data: bytes | mmap.mmap) -> tuple[tuple[int, int] | None, int | None]:
    """Return a JPEG's (width, height) and the offset of its first scan; None if not found.

    Source: ITU-T T.81, B.1.1.2 to B.2.2 (markers, frame header).
    """
    size, position = None, 2 if data[:2] == b"\xff\xd8" else len(data)
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4])
        if marker == 0xFF:  # a fill byte
            position += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and size is None:
            frame = data[position + 5 : position + 9]
            size = (int.from_bytes(frame[2:4]), int.from_bytes(frame[:2]))
        position += 2 + length
        if marker == 0xDA:
            return size, position
    return size, None


def _swap(image: np.ndarray) -> np.ndarray:
    """Swap RGB and BGR; return a contiguous array, which OpenCV needs."""
    return np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image


def depth_to_uint16(depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Quantise a depth map (H, W), metres, to 16-bit steps; 0 where not valid.

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
    steps = np.zeros(depth.shape, np.uint16)
    steps[valid] = np.maximum(np.rint(inside / DEPTH_UNIT_M), 1)
    return steps
