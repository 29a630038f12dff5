"""What the samples of a subject share, read once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.capture.frames import read_cameras_of, read_gains, read_peaks
from express50.capture.index import read_index
from express50.contract.exclusions import exclusion_reason
from express50.contract.layout import Dataset
from express50.dataset.tracks import read_track, track_file
from express50.errors import CaptureError, FormatError, StageError
from express50.files.text import read_json_table
from express50.geometry.cameras import Camera

PARAMETERS = ("expression", "neck", "jaw", "eyes", "R", "t")


@dataclass(frozen=True)
class Subject:
    """What a subject's samples share.

    Cameras, gains, peaks, tracks by expression, offsets (V, 3) of the rest shape (None: zeros),
    and meta.
    """

    name: str
    cameras: dict[str, Camera]
    gains: dict[str, np.ndarray]
    peaks: dict[str, int]
    labels: dict[str, dict]
    tracked: dict[str, dict]
    vertices: dict[str, np.ndarray]
    offsets: np.ndarray | None
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
    peak_rows = read_json_table(dataset.item_dir("align", name) / "peaks.json", FormatError)
    labels = {expression: nameless(row) for expression, row in peak_rows.items()}
    track = read_track(track_file(dataset, name))
    shared = {"shape": track.shape.tolist(), "offsets": bool(track.offsets.any())}
    tracked, vertices = {}, {}
    for row, expression in enumerate(track.expressions):
        tracked[expression] = {key: getattr(track, key)[row].tolist() for key in PARAMETERS}
        tracked[expression] |= shared
        vertices[expression] = track.vertices[row].astype(np.float64)
    meta = {
        "subject": name,
        "head": track.head,
        "fps": index.fps,
        "consent": index.meta.get("consent_id", index.meta.get("consent")),
        "licence": index.meta.get("licence", index.meta.get("license")),
        "session": index.meta.get("session"),
    }
    cameras = read_cameras_of(dataset, name)
    gains = read_gains(dataset, name)
    offsets = track.offsets if shared["offsets"] else None
    return Subject(name, cameras, gains, peaks, labels, tracked, vertices, offsets, meta)


def nameless(label: dict) -> dict:
    """A label without its annotator's name: ``person`` stands for whoever is no rule's name."""
    who = str(label.get("annotator", "unknown"))
    kept = who in ("auto", "unknown") or who.startswith("rule:")
    return label | {"annotator": who if kept else "person"}
