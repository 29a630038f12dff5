"""Files of torch from outside: state dicts and TorchScript archives.

State dicts are read with ``weights_only``: nothing in them is executed. Archives are zips; before
torch unpacks one, it is looked at whether it holds what it says.
"""

from __future__ import annotations

import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import torch

from express50.arrays import DAMAGE
from express50.reading import AGAIN, Kind, reason

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
            holds, or names what ``weights_only`` does not allow.
    """
    if not Path(path).is_file():
        raise kind(f"{where}: no such file; {mend}")
    try:
        check_archive(path)
        return torch.load(path, map_location="cpu", weights_only=True)
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
