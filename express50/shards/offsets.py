"""Offsets of subjects' rest shapes, beside the shards: once a subject, not once a sample."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from express50.errors import FormatError
from express50.files.arrays import read_npy

KEY = re.compile(r"[A-Za-z0-9_-]{1,80}")


def offsets_file(root: Path, subject: str) -> Path:
    """Where the offsets of a subject lie.

    Raises:
        FormatError: the subject's id has other characters than a key may have.
    """
    if not KEY.fullmatch(subject):
        raise FormatError(f"subject id {subject!r}: expected letters, digits, _ and -")
    return root / f"{subject}.offsets.npy"


def write_offsets(root: Path, subject: str, offsets: np.ndarray) -> None:
    """Write a subject's offsets (V, 3), metres, as float32."""
    np.save(offsets_file(root, subject), offsets.astype(np.float32), allow_pickle=False)


def read_offsets(root: Path, subject: str) -> np.ndarray:
    """Offsets (V, 3) float32, metres, of a subject's rest shape.

    Raises:
        FormatError: the file is missing, damaged, or holds something else.
    """
    path = offsets_file(root, subject)
    again = "copy the shards again or rerun 'express50 pack'"
    array = read_npy(path, FormatError, "offsets", again)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype != np.float32:
        raise FormatError(f"{path}: {array.dtype} {array.shape}, expected float32 (V, 3); {again}")
    if not np.isfinite(array).all():
        raise FormatError(f"{path}: holds NaN or Inf; {again}")
    return array
