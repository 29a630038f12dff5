"""What the samples of a subject share, read once."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from express50.cameras import Camera
from express50.errors import CaptureError, FormatError, StageError
from express50.exclusions import exclusion_reason
from express50.frames import read_cameras_of, read_peaks
from express50.index import read_index
from express50.layout import Dataset

PARAMETERS = ("expression", "neck", "jaw", "eyes", "R", "t")


@dataclass(frozen=True)
class Subject:
    """What all samples of a subject share: cameras, peaks, track arrays by expression, and meta."""

    name: str
    cameras: dict[str, Camera]
    peaks: dict[str, int]
    labels: dict[str, dict]
    tracked: dict[str, dict]
    vertices: dict[str, np.ndarray]
    meta: dict


def read_subjects(dataset: Dataset, dropped: list[dict[str, str]]) -> list[Subject]:
    """All subjects that can be packed; the others are added to ``dropped`` with their reason."""
    subjects = []
    for name in dataset.subjects():
        if (reason := exclusion_reason(dataset, name)) is not None:
            dropped.append({"what": name, "why": f"excluded: {reason}"})
            continue
        try:
            subjects.append(_read_subject(dataset, name))
        except (StageError, FormatError, CaptureError) as error:
            dropped.append({"what": name, "why": str(error)})
    return subjects


def _read_subject(dataset: Dataset, name: str) -> Subject:
    """Everything that a subject's samples share.

    Raises:
        StageError: it is not calibrated, aligned or tracked.
        FormatError: one of these files is malformed.
    """
    index = read_index(dataset, name)
    peaks = read_peaks(dataset, name)
    labels = json.loads((dataset.item_dir("align", name) / "peaks.json").read_text("utf-8"))
    path = dataset.item_dir("track", name) / "track.npz"
    if not path.is_file():
        raise StageError(f"subject {name!r} is not tracked; run 'express50 track'")
    tracked, vertices, head = {}, {}, ""
    try:
        with np.load(path, allow_pickle=False) as table:
            head = str(table["head"])
            for row, expression in enumerate(table["expressions"].tolist()):
                arrays = {key: table[key][row].tolist() for key in PARAMETERS}
                tracked[expression] = arrays | {"shape": table["shape"].tolist()}
                vertices[expression] = table["vertices"][row].astype(np.float64)
    except (ValueError, KeyError, IndexError, OSError) as error:
        raise FormatError(f"{path}: not a track ({error}); run 'express50 track' again") from None
    bad = [one for one, points in vertices.items() if not np.isfinite(points).all()]
    if bad:
        raise FormatError(f"{path}: vertices of {', '.join(bad)} are not finite; track again")
    meta = {
        "subject": name,
        "head": head,
        "fps": index.fps,
        "consent": index.meta.get("consent_id", index.meta.get("consent")),
        "licence": index.meta.get("licence", index.meta.get("license")),
        "session": index.meta.get("session"),
    }
    cameras = read_cameras_of(dataset, name)
    return Subject(name, cameras, peaks, labels, tracked, vertices, meta)
