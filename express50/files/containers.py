"""Read images by name, from plain files and from inside containers.

``decoder/image/cam400.zip!/cam400/000123.avif`` is a member of a zip, and
``0026_e0_raw.smc!/Camera/03/color/0`` an array of encoded bytes in an HDF5 file. Nothing is
unpacked to disk, names that lead out of the footage's folder are refused, and sizes are checked
before anything is read.
"""

from __future__ import annotations

import io
import warnings
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import h5py
import numpy as np
from PIL import Image

from express50.errors import CaptureError, FormatError
from express50.files.arrays import DAMAGE as ARRAY_DAMAGE
from express50.files.digests import cached_by_file
from express50.files.images import decode_cv, read_image, upright
from express50.files.text import check_readable, read_bytes, refusing
from express50.geometry.pixels import linear_to_srgb
from express50.geometry.shapes import PIXEL_LIMIT

WITHIN = "!/"
BYTES_LIMIT = 1 << 28  # per encoded image or array
NAME_LIMIT = 255  # bytes per path component
OVEREXPOSED = 4.0  # median light two stops above white: values of 0 to 255, say
OPEN_FILES = 4  # containers a process keeps open
# What h5py raises on bad files.
DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, AttributeError)


def to_srgb(image: np.ndarray) -> np.ndarray:
    """Convert an image (H, W[, C]), linear float or 8- or 16-bit sRGB, to (H, W, 3) uint8 sRGB.

    Raises:
        ValueError: the image holds NaN or infinity, or values on another scale than 0 to 1.
    """
    image = image[..., None] if image.ndim == 2 else image
    # Grey is repeated, alpha is dropped.
    image = np.repeat(image[..., :1], 3, axis=2) if image.shape[2] < 3 else image[..., :3]
    if image.dtype.kind == "f":
        if not np.isfinite(image).all():
            raise ValueError("image holds NaN or infinity")
        if np.median(image) > OVEREXPOSED:
            raise ValueError(
                f"its median is {np.median(image):.3g}, expected linear light from 0 to 1"
            )
        image = np.rint(linear_to_srgb(np.clip(image, 0.0, 1.0)) * 255.0)
    elif image.dtype == np.uint16:
        image = np.rint(image / 257.0)
    return np.ascontiguousarray(image.astype(np.uint8))


def inside(root: Path, name: str) -> Path:
    """Return the path of a name relative to a folder.

    Raises:
        CaptureError: the name is absolute, cannot be shown, or leads out of the folder. Links may
            lead out of it, as those of git-annex do.
    """
    pure = PurePosixPath(name)
    if not name.isprintable():
        raise CaptureError(f"{root}: {name!r} has characters that cannot be shown; rename it")
    if any(len(part.encode(errors="replace")) > NAME_LIMIT for part in pure.parts):
        raise CaptureError(
            f"{root}: {name[:40]!r}... is too long, expected at most {NAME_LIMIT} bytes per part"
        )
    if pure.is_absolute() or ".." in pure.parts:
        raise CaptureError(f"{root}: {name!r} leads out of this folder; expected a name inside it")
    return root / name


def read_picture(root: Path, name: str, orientation: int = 1) -> np.ndarray:
    """Read an image (H, W, 3) uint8 sRGB by its name below a folder, rotated by an orientation.

    Raises:
        CaptureError: it is missing, damaged, too large, or its name leads out of the folder.
    """
    container, within, member = name.partition(WITHIN)
    path = inside(root, container)
    if within:
        stored = decode_picture(member_bytes(path, member), f"{path}{WITHIN}{member}")
    elif path.suffix.lower() == ".avif":
        stored = decode_picture(read_bytes(path, CaptureError, BYTES_LIMIT), str(path))
    else:
        stored = read_srgb(path)
    return upright(stored, orientation)


def read_srgb(path: Path) -> np.ndarray:
    """Read an image (H, W, 3) uint8 sRGB; CaptureError if it is missing, damaged or too large."""
    try:
        return to_srgb(read_image(path))
    except FormatError as error:
        raise CaptureError(str(error)) from error
    except ValueError as error:
        raise CaptureError(f"{path}: {error}; export it again") from error


def decode_picture(data: bytes, where: str) -> np.ndarray:
    """Decode JPEG, PNG or AVIF bytes to (H, W, 3) uint8 sRGB, after checking the header's size.

    Raises:
        CaptureError: the bytes are not such an image, or the image has too many pixels.
    """
    not_one = f"{where}: {len(data)} bytes are not a JPEG, PNG or AVIF image"
    damage = (*ARRAY_DAMAGE, Image.DecompressionBombError)
    with (
        refusing(CaptureError, not_one, errors=damage),
        warnings.catch_warnings(action="ignore"),  # Pillow's limit is lower than ours
        Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "AVIF")) as header,
    ):
        width, height = header.size
    if width * height > PIXEL_LIMIT:
        raise CaptureError(f"{where}: {width}x{height} pixels, expected at most {PIXEL_LIMIT}")
    try:
        return decode_cv(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION, where)
    except FormatError as error:
        raise CaptureError(str(error)) from None


def member_bytes(path: Path, member: str) -> bytes:
    """Read a member of a container, which is a zip or otherwise an HDF5 file.

    Raises:
        CaptureError: the container is damaged, or the member is missing, too large or of the wrong
            type.
    """
    where = f"{path}{WITHIN}{member}"
    if path.suffix.lower() != ".zip":
        array = read_array(open_hdf5(path), member)
        if array.dtype != np.uint8 or array.ndim != 1:
            raise CaptureError(
                f"{where}: {array.dtype} of shape {array.shape}, expected encoded bytes (uint8, one"
                " dimension)"
            )
        return array.tobytes()
    archive = open_zip(path)
    if member not in archive.NameToInfo:
        raise CaptureError(f"{path}: has no member {member}; copy it again")
    with refusing(CaptureError, f"{where}: damaged", errors=ARRAY_DAMAGE):
        _check_size(archive.getinfo(member).file_size, where)
        return archive.read(member)


def _check_size(size: int, where: str) -> None:
    if size > BYTES_LIMIT:
        raise CaptureError(f"{where}: {size} bytes, expected at most {BYTES_LIMIT}; it is damaged")


def open_zip(path: Path) -> zipfile.ZipFile:
    """Open a zip, the last few stay open; CaptureError if it is missing or not a zip."""
    check_readable(path)
    with refusing(CaptureError, f"{path}: not a zip archive", errors=ARRAY_DAMAGE):
        return _open_zip(path)


_open_zip = cached_by_file(OPEN_FILES)(zipfile.ZipFile)


def open_hdf5(path: Path) -> h5py.File:
    """Open an HDF5 file, the last few stay open; CaptureError if it is missing or damaged."""
    if path.is_dir():
        raise CaptureError(f"{path}: is a folder, expected an HDF5 file such as .smc")
    check_readable(path)
    with refusing(CaptureError, f"{path}: cannot be opened as HDF5", errors=DAMAGE):
        return _hdf5_of(path, "r")


_hdf5_of = cached_by_file(OPEN_FILES)(h5py.File)


def child(file: h5py.File, name: str) -> Any:
    """Return the group or dataset at a path in an HDF5 file, or None.

    Links are refused: an external link could read any file on the machine.

    Raises:
        CaptureError: a part of the path is a link, or the file is damaged.
    """
    node: Any = file
    with refusing(CaptureError, f"{file.filename}: {name} is damaged", errors=DAMAGE):
        for part in name.split("/"):
            link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
            if link is None:
                return None
            if not isinstance(link, h5py.HardLink):
                raise CaptureError(
                    f"{file.filename}: {name} is a link, expected data in the file itself"
                )
            node = node[part]
    return node


def members(group: h5py.Group) -> list[str]:
    """List the names in a group of an HDF5 file; CaptureError if the file is damaged."""
    with refusing(CaptureError, f"{group.file.filename}: a group is damaged", errors=DAMAGE):
        return [str(name) for name in group]


def attribute(group: h5py.Group, name: str, default: object) -> np.ndarray:
    """Read a group's attribute, or its default, as a flat array; CaptureError if damaged."""
    with refusing(
        CaptureError, f"{group.file.filename}: attribute {name} is damaged", errors=DAMAGE
    ):
        return np.ravel(np.asarray(group.attrs.get(name, default)))


def read_array(file: h5py.File, name: str) -> np.ndarray:
    """Read a dataset's array after checking its type and size.

    Raises:
        CaptureError: it is missing, not plain numbers, too large, or stored in another file.
    """
    node, where = child(file, name), file.filename
    if not isinstance(node, h5py.Dataset):
        raise CaptureError(f"{where}: has no array {name}; copy the file again")
    with refusing(CaptureError, f"{where}: {name} is damaged", errors=DAMAGE):
        if node.dtype.kind not in "uif" or node.is_virtual or node.external:
            raise CaptureError(
                f"{where}: {name} is {node.dtype}, expected numbers stored in this file"
            )
        size = int(np.prod(node.shape, dtype=object)) * node.dtype.itemsize
        _check_size(size, f"{where}: {name}")
        return np.asarray(node[()])
