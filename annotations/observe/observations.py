"""Observations of a subject's face: the file that the observe stage writes and align reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.contract.layout import Dataset
from express50.errors import FormatError, StageError
from express50.files.arrays import read_arrays

SCHEMA = "express50.observations/1"
NEUTRAL = "neutral"
SEEN_SCORE = 0.15  # of a frame that shows the face at all


@dataclass(frozen=True)
class FaceObservations:
    """The faces that C cameras saw of a subject in F frames.

    Attributes:
        cameras: ids, the one that sees the face best first.
        frames: (F,) frame numbers, increasing.
        points: (C, F, 68, 2) landmarks in proxy pixels.
        scores: (C, F) face scores, 0 to 1.
        faces: (C, F, S, S) uint8 grey, head motion removed.
    """

    cameras: tuple[str, ...]
    frames: np.ndarray
    points: np.ndarray
    scores: np.ndarray
    faces: np.ndarray


def observations_path(dataset: Dataset, subject: str) -> Path:
    """Return the file of a subject's observations."""
    return dataset.item_dir("observe", subject) / "observations.npz"


def read_observations(dataset: Dataset, subject: str) -> FaceObservations:
    """Read what the stage wrote.

    Raises:
        StageError: the subject was not observed.
        FormatError: the file is damaged or of another version.
    """
    path = observations_path(dataset, subject)
    if not path.is_file():
        raise StageError(f"{path}: {subject!r} is not observed; run 'express50 align' on it")
    try:
        table = read_arrays(path, FormatError, "observations", fix="run 'express50 align'")
        if str(table["schema"]) != SCHEMA:
            raise ValueError(f"schema is {table['schema']}, expected {SCHEMA}")
        rest = (table[key] for key in ("frames", "points", "scores", "faces"))
        return FaceObservations(tuple(map(str, table["cameras"])), *rest)
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path}: no observations ({error}); run 'express50 align'") from None
