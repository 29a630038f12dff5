"""Name the results of the chain, and measure how far those of two runs lie apart.

Results are products that the dataset's layout names. The first part of a product's path is the
stage that makes it, so that nothing here knows a stage by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.dataset.depth_files import depth_file, read_depth
from express50.dataset.tracks import best_vertices, read_track
from express50.errors import FormatError
from express50.files.images import read_image
from express50.files.text import read_json_table
from express50.geometry.transforms import rigid_fit

COMPARED = 4  # cameras of an expression; more change the mean by less than expressions do


@dataclass(frozen=True)
class ResultKind:
    """A result of the chain.

    Attributes:
        name: for people.
        unit: of its error.
        places: paths of it; of a subject's expression and camera. The last one made counts.
        apart: how far the results of a subject in two datasets differ, of each of the expressions.
    """

    name: str
    unit: str
    places: Sequence[Callable[[Dataset, str, str, str], Path]]
    apart: Callable[[Dataset, Dataset, str, Sequence[str]], Iterable[float]]

    def made_by(self, names: Iterable[str]) -> list[str]:
        """Return the stages of an ordered list that make it, the last first."""
        any_one = Dataset(Path("dataset"))
        paths = [place(any_one, "s", "e", "c") for place in self.places]
        makers = {path.relative_to(any_one.root).parts[0] for path in paths}
        return [name for name in reversed(list(names)) if name in makers]


def whole_peaks(dataset: Dataset, subject: str) -> Path:
    """Return the path of a subject's peaks from before a trial left most of them out."""
    return dataset.peaks_file(subject).with_name("whole.json")


def _peak_frames(dataset: Dataset, subject: str) -> dict[str, int]:
    whole, path = whole_peaks(dataset, subject), dataset.peaks_file(subject)
    rows = read_json_table(whole if whole.is_file() else path, FormatError)
    return {name: int(row["frame"]) for name, row in rows.items()}


def differences(
    a: Dataset, b: Dataset, subject: str, kinds: Sequence[ResultKind]
) -> dict[str, float]:
    """Return the mean difference of each result of a subject that both datasets hold, by name.

    Where the peaks of an expression differ, its other results are of different frames, and are
    left out.
    """
    one, two = (_peak_frames(dataset, subject) for dataset in (a, b))
    same = sorted(e for e in one.keys() & two.keys() if one[e] == two[e])
    found = {}
    for kind in kinds:
        names = sorted(one.keys() & two.keys()) if kind.apart is _frames_apart else same
        values = list(kind.apart(a, b, subject, names))
        if values:
            found[kind.name] = float(np.mean(values))
    return found


def _frames_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    one, two = (_peak_frames(dataset, subject) for dataset in (a, b))
    return [float(abs(one[name] - two[name])) for name in names]


def _mattes_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    cameras = list(read_cameras_of(a, subject))
    found = []
    for name in names:
        pairs = [[d.matte_file(subject, name, c) for d in (a, b)] for c in cameras]
        there = [pair for pair in pairs if all(path.is_file() for path in pair)]
        for pair in there[:COMPARED]:
            one, two = (read_image(path).astype(np.float32) / 255 for path in pair)
            if one.shape == two.shape:
                found.append(float(np.abs(one - two).mean()))
    return found


def _meshes_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    """Compare vertices after one rigid motion: solved rigs have worlds of their own."""
    if not all(dataset.track_file(subject).is_file() for dataset in (a, b)):
        return []
    tracks = [read_track(dataset.track_file(subject)) for dataset in (a, b)]
    meshes = [best_vertices(d, subject, t) for d, t in zip((a, b), tracks, strict=True)]
    same = [name for name in names if all(name in track.expressions for track in tracks)]
    if not same or meshes[0].shape[1:] != meshes[1].shape[1:]:
        return []
    rows = [[track.row(name) for name in same] for track in tracks]
    one, two = (m[r].reshape(-1, 3).astype(float) for m, r in zip(meshes, rows, strict=True))
    R, t = rigid_fit(one, two)
    squares = ((one @ R.T + t - two) ** 2).sum(axis=1).reshape(len(same), -1)
    return list(1000 * np.sqrt(squares.mean(axis=1)))


def _depths_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    cameras = list(read_cameras_of(a, subject))
    found = []
    for name in names:
        folders = [dataset.surface_file(subject, name).parent for dataset in (a, b)]
        pairs = [[depth_file(folder, c) for folder in folders] for c in cameras]
        for one, two in [pair for pair in pairs if None not in pair][:COMPARED]:
            (near, valid), (far, also) = (read_depth(path) for path in (one, two) if path)
            if near.shape == far.shape and (valid & also).any():
                found.append(float(1000 * np.median(np.abs(near - far)[valid & also])))
    return found


RESULTS = (
    ResultKind(
        "mesh",
        "mm",
        (lambda d, s, e, c: d.track_file(s), lambda d, s, e, c: d.registration_file(s, e)),
        _meshes_apart,
    ),
    ResultKind("depth", "mm", (lambda d, s, e, c: d.surface_file(s, e),), _depths_apart),
    ResultKind("mattes", "alpha", (Dataset.matte_file,), _mattes_apart),
    ResultKind("peaks", "frames", (lambda d, s, e, c: d.peaks_file(s),), _frames_apart),
)
