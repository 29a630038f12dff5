"""Read ``.npz`` and ``.npy`` files, checking sizes before memory is allocated.

Nothing in a file is executed: pickled objects are refused. The shape and type in an array's header
must fit the bytes of the file, and all arrays of a file together a limit.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Collection
from lzma import LZMAError
from pathlib import Path
from tokenize import TokenError
from typing import BinaryIO

import numpy as np

from express50.files.text import AGAIN, Kind, reason

SIZE_LIMIT = 2 << 30  # unpacked bytes of a file; 60 expressions of a 26,000-vertex head take 19 MB
HEADER_LIMIT = 4096  # characters of an array's header
# What zipfile and NumPy raise on damaged files.
DAMAGE = (
    ValueError, TypeError, EOFError, OSError, KeyError, IndexError, OverflowError, MemoryError,
    NotImplementedError, RuntimeError, SyntaxError, UnicodeError, AttributeError, LZMAError,
    zipfile.BadZipFile, zlib.error, TokenError,
)  # fmt: skip


def read_arrays(
    path: Path,
    kind: Kind,
    what: str,
    wanted: Collection[str] = (),
    fix: str = AGAIN,
) -> dict[str, np.ndarray]:
    """Read the arrays of an ``.npz`` file by name, none of them of objects.

    Args:
        path: the file.
        kind: class of the errors.
        what: it is expected to be, for messages, such as "a track".
        wanted: names of arrays that are required.
        fix: how to fix a damaged file, for messages.

    Raises:
        Express50Error: of the given kind: it is missing, damaged, lacks a wanted array, or unpacks
            to more than ``SIZE_LIMIT``.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > SIZE_LIMIT:
                raise ValueError(f"{size} bytes unpacked, expected at most {SIZE_LIMIT}")
            found = {}
            for member in members:
                with archive.open(member) as file:
                    data = io.BytesIO(file.read(member.file_size))
                found[member.filename.removesuffix(".npy")] = _array(data, member.file_size)
    except DAMAGE as error:
        raise kind(f"{path}: not {what} ({reason(error)}); {fix}") from None
    missing = [name for name in wanted if name not in found]
    if missing:
        raise kind(f"{path}: not {what} (has no {', '.join(missing)}); {fix}")
    return found


def read_npy(path: Path, kind: Kind, what: str, fix: str = AGAIN) -> np.ndarray:
    """Read the array of an ``.npy`` file, not of objects.

    Raises:
        Express50Error: of the given kind: it is missing or damaged.
    """
    try:
        with path.open("rb") as file:
            return _array(file, path.stat().st_size)
    except DAMAGE as error:
        raise kind(f"{path}: not {what} ({reason(error)}); {fix}") from None


def read_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype]:
    """Read shape and type from an array's header, leaving the file behind it.

    Raises:
        ValueError: it is damaged or of an unknown version.
    """
    version = np.lib.format.read_magic(file)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise ValueError(f".npy version {version}, expected (1, 0) or (2, 0)")
    shape, _, dtype = readers[version](file, max_header_size=HEADER_LIMIT)
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"an array's shape is {shape}")
    return shape, dtype


def _array(file: BinaryIO, size: int) -> np.ndarray:
    """Read an array from the start of a file of ``size`` bytes."""
    shape, dtype = read_header(file)
    count: int = math.prod(list(shape))
    need, have = count * dtype.itemsize, size - file.tell()
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are not read")
    if (count and not dtype.itemsize) or need > have:
        raise ValueError(f"an array {dtype} {shape} needs {need} bytes, the file has {have}")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
