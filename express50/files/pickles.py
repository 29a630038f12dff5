"""Read a user's pickles without executing anything.

FLAME's files are Python 2 pickles that name chumpy and scipy classes; landmark embeddings hold
torch tensors. None of those libraries is imported: every class comes from a short allow list, and
those of chumpy, scipy and torch are replaced by records that only keep their state. A pickle that
names anything else is refused before anything is called.
"""

from __future__ import annotations

import codecs
import io
import math
import pickle
import pickletools
from collections import OrderedDict
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, cast

import numpy as np

from express50.errors import HeadModelError
from express50.files.arrays import DAMAGE, read_header, read_npy

PICKLE_LIMIT_BYTES = 2 << 30
# Of an array made from a list, a sparse matrix or a view; FLAME's largest has six million.
VALUES_LIMIT = 1 << 25


class Record:
    """Stands for an object of a class that is not imported; keeps what the pickle says of it."""

    state: dict[str, Any]

    def __new__(cls, *_: object) -> Record:
        """Start with an empty state: pickles may build objects without calling __init__."""
        made = super().__new__(cls)
        made.state = {}
        return made

    def __init__(self, *_: object) -> None:
        """Ignore constructor arguments: the state says all."""

    def __setstate__(self, state: object) -> None:
        """Keep the state; slots come as a pair (dict, dict)."""
        for part in state if isinstance(state, tuple) else (state,):
            if isinstance(part, dict):
                self.state.update(part)


class ChumpyArray(Record):
    """A chumpy.Ch: the array is in state["x"]."""


class SparseMatrix(Record):
    """A scipy.sparse csc or csr matrix."""


class CscMatrix(SparseMatrix):
    """Column-compressed."""


class CsrMatrix(SparseMatrix):
    """Row-compressed."""


class StorageType(Record):
    """Names a torch storage type; never instantiated by what it names."""


class ArrayType(Record):
    """Names numpy.ndarray; itself, called by a pickle, would make arrays of any size."""


def _new_record(kind: object = Record, *_: object) -> Record:
    """What copy_reg._reconstructor does, for records alone."""
    if isinstance(kind, type) and issubclass(kind, Record):
        return kind()
    raise pickle.UnpicklingError("copy_reg._reconstructor of a class that is not allowed")


def _encode(text: object, encoding: object = "latin1") -> bytes:
    """What _codecs.encode does for the byte strings of protocol 2."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("_codecs.encode of something other than latin-1 text")
    return codecs.latin_1_encode(text)[0]


def _reconstruct_array(kind: object, shape: object, code: object) -> np.ndarray:
    """What numpy's _reconstruct does, for plain arrays alone."""
    if kind is not ArrayType:
        raise pickle.UnpicklingError("numpy array subclass")
    return np.ndarray((0,), np.dtype("b"))


def _dtype(code: object, *flags: object) -> np.dtype:
    """numpy.dtype from a type code string."""
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
    """What torch._utils._rebuild_tensor_v2 does, on a NumPy storage, bounds checked."""
    if not isinstance(storage, np.ndarray) or storage.ndim != 1 or offset < 0:
        raise pickle.UnpicklingError("tensor without a storage")
    if min((*size, *stride, 0)) < 0:
        raise pickle.UnpicklingError("tensor with negative size or stride")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 not in size and last >= storage.size:
        raise pickle.UnpicklingError("tensor reaches beyond its storage")
    if math.prod(size) > VALUES_LIMIT:  # a stride of 0 repeats one number for ever
        raise pickle.UnpicklingError(f"tensor of {math.prod(size)} numbers, over {VALUES_LIMIT}")
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()


def _storage_from_bytes(data: object) -> np.ndarray:
    """What torch.storage._load_from_bytes does: a nested file, read by `_read_torch_storage`."""
    if not isinstance(data, bytes):
        raise pickle.UnpicklingError("torch storage without bytes")
    return _read_torch_storage(data)


_NUMPY = ("numpy.core.multiarray", "numpy._core.multiarray")
_ALLOWED = MappingProxyType(
    {
        **{(module, "_reconstruct"): _reconstruct_array for module in _NUMPY},
        **{(module, "scalar"): _scalar for module in _NUMPY},
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
        ("torch.storage", "_load_from_bytes"): _storage_from_bytes,
    }
)
_STORAGE_DTYPES = MappingProxyType(
    {
        "FloatStorage": np.float32, "DoubleStorage": np.float64, "HalfStorage": np.float16,
        "LongStorage": np.int64, "IntStorage": np.int32, "ShortStorage": np.int16,
        "ByteStorage": np.uint8, "CharStorage": np.int8, "BoolStorage": np.bool_,
    }
)  # fmt: skip


class SafeUnpickler(pickle.Unpickler):
    """Unpickler that resolves names from the allow list only."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401 (pickle's own signature)
        """Return the stand-in for a name, or refuse."""
        if (module, name) in _ALLOWED:
            return _ALLOWED[(module, name)]
        if module.split(".")[0] == "chumpy":
            return ChumpyArray
        if module.startswith("scipy.sparse") and name in ("csc_matrix", "csc_array"):
            return CscMatrix
        if module.startswith("scipy.sparse") and name in ("csr_matrix", "csr_array"):
            return CsrMatrix
        if module == "torch" and name in _STORAGE_DTYPES:
            return type(name, (StorageType,), {})
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is not on the allow list")

    def persistent_load(self, pid: object) -> np.ndarray:
        """Storages of torch's old format: ("storage", type, key, location, count, view)."""
        storages = getattr(self, "storages", None)
        if storages is None or not isinstance(pid, tuple) or len(pid) < 5 or pid[0] != "storage":
            raise pickle.UnpicklingError("a persistent id outside a torch storage")
        dtype, count = _STORAGE_DTYPES[pid[1].__name__], int(pid[4])
        if not 0 <= count <= self.longest:  # type: ignore[attr-defined]
            raise pickle.UnpicklingError(f"a torch storage of {count} numbers that are not there")
        return storages.setdefault(str(pid[2]), np.zeros(count, dtype))


def _read_torch_storage(data: bytes) -> np.ndarray:
    """Read a storage pickled into an array file: torch's old format, magic number first.

    Layout: pickles of magic, protocol, system information, the storage, its keys; then for each key
    an int64 count and the raw little-endian numbers.
    """
    stream = io.BytesIO(data)
    for _ in range(3):
        _load(stream)
    reader = _checked_unpickler(stream)
    reader.storages, reader.longest = {}, len(data)  # type: ignore[attr-defined]
    storage = reader.load()
    keys = _load(stream)
    if not isinstance(keys, list) or not isinstance(storage, np.ndarray) or len(keys) != 1:
        raise pickle.UnpicklingError("a torch storage with an unknown layout")
    count = int(np.frombuffer(stream.read(8), "<i8", count=1)[0])
    raw = stream.read(storage.nbytes)
    if count != storage.size or len(raw) != storage.nbytes:
        raise pickle.UnpicklingError("a torch storage that is cut short")
    return np.frombuffer(raw, storage.dtype).copy()


def read_pickle(path: Path) -> Any:  # noqa: ANN401 (whatever the file holds)
    """Read a pickle, nothing executed.

    Raises:
        HeadModelError: unreadable, damaged, or naming something that is not on the allow list.
    """
    try:
        size = path.stat().st_size
        if size > PICKLE_LIMIT_BYTES:
            raise HeadModelError(f"{path}: {size} bytes, expected at most {PICKLE_LIMIT_BYTES}")
        with path.open("rb") as file:
            return _load(file)
    except OSError as error:
        raise HeadModelError(f"{path}: cannot be read: {error}") from error
    except _DAMAGE as error:
        raise HeadModelError(f"{path}: refused or damaged pickle: {_one_line(error)}") from error


def read_object_array(path: Path) -> Any:  # noqa: ANN401 (whatever the file holds)
    """Read an `.npy` file, also one that holds a pickled object, nothing executed.

    Raises:
        HeadModelError: as `read_pickle`.
    """
    try:
        with path.open("rb") as file:
            shape, dtype = read_header(file)
            if not dtype.hasobject:
                return read_npy(path, HeadModelError, "an array")
            content = _load(file)
    except OSError as error:
        raise HeadModelError(f"{path}: cannot be read: {error}") from error
    except _DAMAGE as error:
        raise HeadModelError(f"{path}: refused or damaged array: {_one_line(error)}") from error
    return content.item() if isinstance(content, np.ndarray) and shape == () else content


# What a damaged pickle makes the standard unpickler and the stand-ins above raise.
_DAMAGE = (*DAMAGE, pickle.UnpicklingError, ImportError, AssertionError)


def _load(file: BinaryIO) -> Any:  # noqa: ANN401 (whatever the file holds)
    return _checked_unpickler(file).load()


def _checked_unpickler(file: BinaryIO) -> SafeUnpickler:
    """An unpickler of what comes next in a file, after a look at its opcodes.

    Python's asks for as much memory as a length in the file says, and for a table as long as the
    largest number under which something is memorised, before it sees that nothing is there.
    """
    start, end = file.tell(), file.seek(0, io.SEEK_END)
    file.seek(start)
    opcodes = pickletools.genops(cast(BinaryIO, _Bounded(file, end)))
    for count, (opcode, argument, _) in enumerate(opcodes, 1):
        number = argument if isinstance(argument, int) else 0
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and not 0 <= number <= 16 * count:
            raise pickle.UnpicklingError(f"memorises under {number} after {count} steps")
        if opcode.name == "FRAME" and not 0 <= number <= end:
            raise pickle.UnpicklingError(f"a frame of {number} bytes that are not there")
        if opcode.name == "LONG4" and number.bit_length() > 1 << 16:
            raise pickle.UnpicklingError("a whole number of thousands of digits")
    file.seek(start)
    return SafeUnpickler(file, encoding="latin1")


class _Bounded:
    """A file for `pickletools` that refuses to read past its end."""

    def __init__(self, file: BinaryIO, end: int) -> None:
        self._file, self._end = file, end
        self.readline, self.tell = file.readline, file.tell

    def read(self, size: int) -> bytes:
        """So many bytes, all of them there."""
        if not 0 <= size <= self._end - self._file.tell():
            raise pickle.UnpicklingError(f"{size} bytes that are not there")
        return self._file.read(size)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
