"""Read arrays from ``.npz``, ``.npy``, pickle and torch files without executing anything.

Sizes are checked before memory is allocated: each array's shape and type must fit the size of the
file. All arrays of a file together must stay below a limit. FLAME's files are Python 2 pickles that
name chumpy and scipy classes; landmark embeddings hold torch tensors. Every class comes from a
short allow list, and those of chumpy and scipy are replaced by records that only keep their state.
A pickle that names anything else is refused before anything is called. Torch's own files, and
storages inside a pickle, are read with ``weights_only``.
"""

from __future__ import annotations

import io
import math
import pickle
import struct
import warnings
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Collection
from lzma import LZMAError
from pathlib import Path
from tokenize import TokenError
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np

from express50.errors import Express50Error, HeadModelError
from express50.files.text import AGAIN, Kind, no_file, open_file, reason, refusing, unreadable

SIZE_LIMIT = 2 << 30  # bytes per unpacked file; 60 expressions of a 26,000-vertex head take 19 MB
HEADER_LIMIT = 4096  # characters in an array's header
# Numbers in an array made from a list, a sparse matrix or a view; FLAME's largest has six million.
VALUES_LIMIT = 1 << 25
# What zipfile, NumPy, the standard unpickler and torch raise on damaged files.
DAMAGE = (
    ValueError, TypeError, EOFError, OSError, KeyError, IndexError, OverflowError, MemoryError,
    NotImplementedError, RuntimeError, SyntaxError, UnicodeError, AttributeError, ImportError,
    AssertionError, LZMAError, zipfile.BadZipFile, zlib.error, TokenError, struct.error,
    pickle.UnpicklingError,
)  # fmt: skip


def read_arrays(
    path: Path,
    kind: Kind,
    what: str,
    wanted: Collection[str] = (),
    fix: str = AGAIN,
    only: bool = False,
) -> dict[str, np.ndarray]:
    """Read the arrays of an ``.npz`` file by name; refuse arrays of objects.

    Messages say ``what`` the file should be, such as "a track", and how to ``fix`` it. With
    ``only``, no other arrays than the ``wanted`` ones are read.

    Raises:
        Express50Error: of the given kind: the file is missing, damaged, lacks a wanted array, or
            unpacks to more than ``SIZE_LIMIT``.
    """
    try:
        with open_file(path) as whole, zipfile.ZipFile(whole) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > SIZE_LIMIT:
                raise ValueError(f"{size} bytes unpacked, expected at most {SIZE_LIMIT}")
            if len({member.header_offset for member in members}) < len(members):
                raise ValueError("entries overlap")  # Python 3.13 would only warn of them
            found = {}
            for member in members:
                name = member.filename.removesuffix(".npy")
                if only and name not in wanted:
                    continue
                with archive.open(member) as file:
                    data = io.BytesIO(file.read(member.file_size))
                found[name] = _array(data, member.file_size)
    except DAMAGE as error:
        raise _refused(path, kind, what, fix, error) from None
    missing = [name for name in wanted if name not in found]
    if missing:
        raise kind(f"{path}: not {what} (has no {', '.join(missing)}); {fix}")
    return found


def _refused(path: Path, kind: Kind, what: str, fix: str, error: Exception) -> Express50Error:
    """Make the error of a file that is not ``what`` it should be, or not there."""
    if why := unreadable(path):
        return kind(f"{path}: {why}")
    why = f"not {what} ({reason(error)})" if path.is_file() else no_file(path)
    return kind(f"{path}: {why}; {fix}")


def read_npy(path: Path, kind: Kind, what: str, fix: str = AGAIN) -> np.ndarray:
    """Read the array of an ``.npy`` file; refuse an array of objects.

    Raises:
        Express50Error: of the given kind: the file is missing or damaged.
    """
    try:
        with open_file(path) as file:
            return _array(file, path.stat().st_size)
    except DAMAGE as error:
        raise _refused(path, kind, what, fix, error) from None


def read_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype]:
    """Read shape and type from an array's header, leaving the file position just after it.

    Raises:
        ValueError: the header is damaged or has an unknown version.
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


class Record:
    """Stands in for a class that is not imported, and keeps the state that the pickle gives it."""

    state: dict[str, Any]

    def __new__(cls, *_: object) -> Record:
        """Start with an empty state: pickles may build objects without calling __init__."""
        made = super().__new__(cls)
        made.state = {}
        return made

    def __init__(self, *_: object) -> None:
        """Ignore constructor arguments: the state holds everything."""

    def __setstate__(self, state: object) -> None:
        """Keep the state; slots come as a pair (dict, dict)."""
        for part in state if isinstance(state, tuple) else (state,):
            if isinstance(part, dict):
                self.state.update(part)


class ChumpyArray(Record):
    """Stands in for a chumpy.Ch: the array is in state["x"]."""


class SparseMatrix(Record):
    """Stands in for a scipy.sparse csr matrix."""

    compression = "csr_array"

    def dense(self) -> np.ndarray:
        """Make a dense (rows, columns) array, after SciPy has checked the compressed one."""
        import scipy.sparse

        rows, columns = self.state.get("_shape", self.state.get("shape"))  # type: ignore[misc]
        if not 0 <= rows * columns <= VALUES_LIMIT:
            raise ValueError(f"a sparse matrix of {rows} x {columns}")
        parts = tuple(np.asarray(self.state[key]) for key in ("data", "indices", "indptr"))
        made = getattr(scipy.sparse, self.compression)(parts, shape=(rows, columns))
        made.check_format(full_check=True)
        return made.toarray()


class ColumnMatrix(SparseMatrix):
    """Stands in for a scipy.sparse csc matrix."""

    compression = "csc_array"


class ArrayType(Record):
    """Stands in for numpy.ndarray, with which a pickle could make arrays of any size."""


def _new_record(kind: object = Record, *_: object) -> Record:
    """Do what copy_reg._reconstructor does, but only for records."""
    if isinstance(kind, type) and issubclass(kind, Record):
        return kind()
    raise pickle.UnpicklingError("copy_reg._reconstructor of a class that is not allowed")


def _encode(text: object, encoding: object = "latin1") -> bytes:
    """Do what _codecs.encode does for the byte strings of protocol 2."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("_codecs.encode of something other than latin-1 text")
    return text.encode("latin-1")


def _reconstruct_array(kind: object, shape: object, code: object) -> np.ndarray:
    """Do what numpy's _reconstruct does, but only for plain arrays."""
    if kind is not ArrayType:
        raise pickle.UnpicklingError("numpy array subclass")
    return np.ndarray((0,), np.dtype("b"))


def _array_of_bytes(
    data: object, dtype: object, shape: Any, order: object = "C", *_: object
) -> np.ndarray:
    """Do what numpy's _frombuffer does, with which protocol 5 stores arrays."""
    if isinstance(data, (bytes, bytearray)) and isinstance(dtype, np.dtype):
        flat = np.frombuffer(data, dtype)  # refuses a type of Python objects
        if order == "C":
            return flat.reshape(shape)
        if order == "F":
            return flat.reshape(shape, order="F")
    raise pickle.UnpicklingError("numpy array without bytes")


def _dtype(code: object, *flags: object) -> np.dtype:
    """Make a numpy.dtype from a type code string."""
    if not isinstance(code, (str, bytes)):
        raise pickle.UnpicklingError("numpy.dtype from something other than a code")
    return np.dtype(code.decode("ascii") if isinstance(code, bytes) else code)


def _scalar(dtype: np.dtype, data: object) -> np.generic:
    """Rebuild a NumPy scalar from its bytes."""
    raw = data.encode("latin1") if isinstance(data, str) else data
    if not isinstance(raw, bytes) or dtype.hasobject:
        raise pickle.UnpicklingError("numpy scalar without bytes")
    return np.frombuffer(raw, dtype=dtype, count=1)[0]


def _tensor(
    storage: object, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: object
) -> np.ndarray:
    """Do what torch._utils._rebuild_tensor_v2 does, on a NumPy storage and with bounds checks."""
    if not isinstance(storage, np.ndarray) or storage.ndim != 1 or offset < 0:
        raise pickle.UnpicklingError("tensor without a storage")
    if min((*size, *stride, 0)) < 0:
        raise pickle.UnpicklingError("tensor with negative size or stride")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 not in size and last >= storage.size:
        raise pickle.UnpicklingError("tensor reaches beyond its storage")
    if math.prod(size) > VALUES_LIMIT:  # a stride of 0 repeats one number endlessly
        raise pickle.UnpicklingError(f"tensor of {math.prod(size)} numbers, over {VALUES_LIMIT}")
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()


def _read_torch_storage(data: object) -> np.ndarray:
    """Read a storage pickled into an array file, as torch.storage._load_from_bytes does."""
    import torch

    if not isinstance(data, bytes):
        raise pickle.UnpicklingError("torch storage without bytes")
    storage = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    if not isinstance(storage, torch.TypedStorage):
        raise pickle.UnpicklingError("a torch storage that holds something else")
    return torch.tensor([], dtype=storage.dtype).set_(storage).numpy()


_NUMPY = ("numpy.core.multiarray", "numpy._core.multiarray")
_ALLOWED = MappingProxyType(
    {
        **{(module, "_reconstruct"): _reconstruct_array for module in _NUMPY},
        **{(module, "scalar"): _scalar for module in _NUMPY},
        ("numpy.core.numeric", "_frombuffer"): _array_of_bytes,
        ("numpy._core.numeric", "_frombuffer"): _array_of_bytes,
        ("numpy", "ndarray"): ArrayType,
        ("numpy", "dtype"): _dtype,
        ("_codecs", "encode"): _encode,
        ("copy_reg", "_reconstructor"): _new_record,
        ("copyreg", "_reconstructor"): _new_record,
        ("__builtin__", "object"): Record,
        ("builtins", "object"): Record,
        ("__builtin__", "set"): set,
        ("builtins", "set"): set,
        ("collections", "OrderedDict"): OrderedDict,
        ("torch._utils", "_rebuild_tensor_v2"): _tensor,
        ("torch.storage", "_load_from_bytes"): _read_torch_storage,
    }
)


class SafeUnpickler(pickle.Unpickler):
    """Unpickles only names on the allow list."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401 (pickle's own signature)
        """Return the stand-in for a name, or refuse."""
        if (module, name) in _ALLOWED:
            return _ALLOWED[(module, name)]
        if module.split(".")[0] == "chumpy":
            return ChumpyArray
        if module.startswith("scipy.sparse") and name in ("csc_matrix", "csc_array"):
            return ColumnMatrix
        if module.startswith("scipy.sparse") and name in ("csr_matrix", "csr_array"):
            return SparseMatrix
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is not on the allow list")


def read_pickle(path: Path) -> Any:  # noqa: ANN401 (whatever the file holds)
    """Read a pickle without executing anything.

    Raises:
        HeadModelError: the file is unreadable, damaged, or names a class that is not on the allow
            list.
    """
    with refusing(HeadModelError, f"{path}: refused or damaged pickle", errors=DAMAGE):
        size = path.stat().st_size
        if size > SIZE_LIMIT:
            raise HeadModelError(f"{path}: {size} bytes, expected at most {SIZE_LIMIT}")
        with open_file(path) as file:
            return SafeUnpickler(file, encoding="latin1").load()


def read_object_array(path: Path) -> Any:  # noqa: ANN401 (whatever the file holds)
    """Read an `.npy` file, even one that holds a pickled object, without executing anything.

    Raises:
        HeadModelError: as for `read_pickle`.
    """
    words = f"{path}: refused or damaged array"
    with refusing(HeadModelError, words, errors=DAMAGE), open_file(path) as file:
        shape, dtype = read_header(file)
        if not dtype.hasobject:
            return read_npy(path, HeadModelError, "an array")
        content = SafeUnpickler(file, encoding="latin1").load()
    return content.item() if isinstance(content, np.ndarray) and shape == () else content


def to_array(value: object, name: str, where: str) -> np.ndarray:
    """Convert what a pickle held (array, chumpy, sparse matrix or list) to a dense array.

    Raises:
        HeadModelError: it is not numeric, is too large, or holds NaN or Inf.
    """
    for _ in range(8):  # they may be nested; the limit ends a cycle
        if isinstance(value, ChumpyArray):
            value = next((value.state[key] for key in ("x", "a", "v") if key in value.state), None)
    with refusing(HeadModelError, f"{where}: {name} is not an array", errors=DAMAGE):
        array = value.dense() if isinstance(value, SparseMatrix) else np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise HeadModelError(f"{where}: {name} holds {array.dtype}, expected numbers")
    if array.size > VALUES_LIMIT:
        raise HeadModelError(f"{where}: {name} holds {array.size} numbers, over {VALUES_LIMIT}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise HeadModelError(f"{where}: {name} holds NaN or Inf, expected finite numbers")
    return array


def read_weights(path: Path, kind: Kind, where: str, what: str, fix: str = AGAIN) -> Any:  # noqa: ANN401
    """Read a file written by ``torch.save`` to the CPU.

    Messages say ``where`` the file is, ``what`` it should be, such as "a torch state dict", and how
    to ``fix`` it.

    Raises:
        Express50Error: of the given kind: the file is missing, damaged, or names something that
            ``weights_only`` does not allow.
    """
    import torch

    if not Path(path).is_file():
        raise kind(f"{where}: {no_file(Path(path))}; {fix}")
    try:
        with warnings.catch_warnings(action="ignore"):  # about pickles that are refused
            return torch.load(path, map_location="cpu", weights_only=True)
    except DAMAGE as error:
        # Torch's own message says how to switch the protection off.
        why = "it is damaged or of another kind"
        if isinstance(error, pickle.UnpicklingError):
            why = "it holds more than tensors and plain values; nothing in it was run"
        raise kind(f"{where}: not {what} ({why}); {fix}") from None
