"""Files of torch from outside: state dicts and TorchScript archives.

State dicts are read with ``weights_only``: nothing in them is executed. Archives are zips; before
torch unpacks one, it is looked at whether it holds what it says.
"""

from __future__ import annotations

import math
import pickle
import struct
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from express50.files.arrays import DAMAGE
from express50.files.text import AGAIN, Kind, reason

# Torch stores tensors as they are; the code of TorchScript and small tables are compressed.
PACKED_LIMIT = 64 << 20


def read_weights(path: Path, kind: Kind, where: str, what: str, mend: str = AGAIN) -> Any:
    """Content of a file of ``torch.save``, on the CPU.

    Args:
        path: the file.
        kind: of the errors.
        where: how messages name the file.
        what: it is expected to be, such as "a torch state dict".
        mend: what to do about it.

    Raises:
        Express50Error: of the given kind: it is missing, damaged, would unpack to more than it
            holds, has a tensor of more numbers than are there, or names what ``weights_only`` does
            not allow.
    """
    if not Path(path).is_file():
        raise kind(f"{where}: no such file; {mend}")
    try:
        check_archive(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
        for tensor in _tensors(content):
            _check_held(tensor)
        return content
    except (*DAMAGE, pickle.UnpicklingError, AssertionError, struct.error) as error:
        raise kind(f"{where}: not {what} ({reason(error)}); {mend}") from None


def check_archive(path: Path) -> None:
    """Refuse a zip that unpacks to more than it holds; torch's older format is none and passes.

    Raises:
        ValueError: it does.
        zipfile.BadZipFile: it is damaged.
    """
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    stored = sum(m.file_size for m in members if m.compress_type == zipfile.ZIP_STORED)
    packed = sum(m.file_size for m in members if m.compress_type != zipfile.ZIP_STORED)
    have = Path(path).stat().st_size
    if stored > have or packed > PACKED_LIMIT:
        raise ValueError(f"it says to hold {stored + packed} bytes, the file has {have}")


def _tensors(content: Any) -> Iterator[Tensor]:
    """Every tensor in nested tables and lists, which may hold themselves."""
    left, seen = [content], set()
    while left:
        item = left.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, Tensor):
            yield item
        elif isinstance(item, dict):
            left.extend(item.values())
        elif isinstance(item, list | tuple | set):
            left.extend(item)


def _check_held(tensor: Tensor) -> None:
    """Refuse a tensor that repeats numbers: a stride of 0 makes a short file fill the memory.

    Raises:
        ValueError: it says to have more numbers than its storage, or it is sparse.
    """
    shape = " x ".join(map(str, tensor.shape))
    if tensor.layout != torch.strided or tensor.device.type != "cpu":
        raise ValueError(f"a tensor {shape} is not an array of numbers on the CPU")
    need, have = tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes()
    if need > have:
        raise ValueError(f"a tensor {shape} needs {need} bytes, the file has {have}")


class AtMost(TorchFunctionMode):
    """Within it, ``torch.empty``, ``zeros`` and ``randn`` make so many numbers in all, no more.

    For networks whose sizes a file names: their weights cannot take more than the file has.
    """

    def __init__(self, numbers: int) -> None:
        """Allow this many."""
        super().__init__()
        self.numbers = self.left = numbers

    def __torch_function__(
        self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        """Call torch, unless that would be too many: ValueError."""
        if func in (torch.empty, torch.zeros, torch.randn):
            size = args[0] if isinstance(args[0], Sequence) else args
            self.left -= max(1, math.prod(size))  # at least 1: empty layers end as well
            if self.left < 0:
                shape = " x ".join(map(str, size))
                raise ValueError(f"a tensor {shape} is asked for, of {self.numbers} numbers in all")
        return func(*args, **(kwargs or {}))
