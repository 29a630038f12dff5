"""Name the results of the chain, and measure how far those of two runs lie apart.

Results are products that the dataset's layout names. The first part of a product's path is the
stage that makes it, so that nothing here knows a stage by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from express50.capture.expressions import NEUTRAL
from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.dataset.depth_files import depth_file, read_depth
from express50.dataset.tracks import read_registration, read_track
from express50.errors import Express50Error, FormatError
from express50.files.images import read_image
from express50.files.text import read_json_table
from express50.geometry.pixels import resize_area
from express50.geometry.transforms import rigid_fit
from express50.head.load import load_head
from express50.head.model import vertex_normals

RIM = 0.008  # share of a picture's longer side: how wide the band about an outline is
COMPARED = 4  # cameras of an expression; more change the mean by less than expressions do


@dataclass(frozen=True)
class ResultKind:
    """A result of the chain."""

    name: str  # for people
    unit: str  # of its error
    # its paths by dataset, subject, expression and camera; of several, the last one counts
    places: Sequence[Callable[[Dataset, str, str, str], Path]]
    # how far the results of a subject in two datasets differ, of each of the expressions
    apart: Callable[[Dataset, Dataset, str, Sequence[str]], Iterable[float]]

    def made_by(self, names: Iterable[str]) -> list[str]:
        """Return the stages of an ordered list that make the result, the last first."""
        any_one = Dataset(Path("dataset"))
        paths = [place(any_one, "s", "e", "c") for place in self.places]
        makers = {path.relative_to(any_one.root).parts[0] for path in paths}
        return [name for name in reversed(list(names)) if name in makers]


def whole_peaks(dataset: Dataset, subject: str) -> Path:
    """Return the path of a subject's peaks from before a trial left most of them out."""
    return dataset.peaks_file(subject).with_name("whole.json")


def _peak_frames(dataset: Dataset, subject: str) -> dict[str, int]:
    paths = whole_peaks(dataset, subject), dataset.peaks_file(subject)
    path = next((path for path in paths if path.is_file()), None)
    rows = read_json_table(path, FormatError) if path else {}
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
        with suppress(Express50Error):  # a stage before it made nothing
            if values := list(kind.apart(a, b, subject, names)):
                found[kind.name] = round(float(np.mean(values)), 9)  # rigid fits leave 1e-14
    return found


def _frames_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    one, two = (_peak_frames(dataset, subject) for dataset in (a, b))
    return [float(abs(one[name] - two[name])) for name in names if name != NEUTRAL]


def _mattes_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    """Compare pixels about either outline, as the error of a matte is stated."""
    cameras = list(read_cameras_of(a, subject))
    found = []
    for name in names:
        pairs = [[d.matte_file(subject, name, c) for d in (a, b)] for c in cameras]
        there = [pair for pair in pairs if all(path.is_file() for path in pair)]
        for pair in there[:COMPARED]:
            one, two = (read_image(path) for path in pair)
            if one.ndim == two.ndim == 2:
                one, two = (resize_area(image, *_larger(one, two)) for image in (one, two))
                reach = np.ones([2 * max(1, round(RIM * max(one.shape))) + 1] * 2, np.uint8)
                highest = cv2.dilate(np.maximum(one, two), reach)
                rim = (highest > 12) & (cv2.erode(np.minimum(one, two), reach) < 243)
                apart = np.abs(one[rim].astype(np.float32) - two[rim]) / 255
                found.append(float(apart.mean()) if rim.any() else 0.0)
    return found


def _tracks_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    paths = [dataset.track_file(subject) for dataset in (a, b)]
    if not all(path.is_file() for path in paths):
        return []
    tracks = [read_track(path) for path in paths]
    same = [name for name in names if all(name in track.expressions for track in tracks)]
    return _medians_apart([[t.vertices[t.row(name)] for name in same] for t in tracks])


def _meshes_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    """Compare registrations along their normals, as their error is stated."""
    files = [[d.registration_file(subject, name) for d in (a, b)] for name in names]
    there = [pair for pair in files if all(path.is_file() for path in pair)]
    both = [[read_registration(path).vertices for path in pair] for pair in there]
    if not both:
        return []
    faces = load_head(read_track(b.track_file(subject)).head).faces
    return _medians_apart([[pair[k] for pair in both] for k in (0, 1)], faces)


def _medians_apart(
    meshes: Sequence[Sequence[np.ndarray]], faces: torch.Tensor | None = None
) -> list[float]:
    """Return the median distance of vertices of E pairs of meshes (V, 3), millimetres.

    With `faces` (F, 3) only what lies along the second mesh's normals counts. One rigid motion is
    taken out before: solved rigs have worlds of their own.
    """
    if not meshes[0] or meshes[0][0].shape != meshes[1][0].shape:
        return []
    one, two = (np.stack(list(some)).astype(np.float64) for some in meshes)
    R, t = rigid_fit(one.reshape(-1, 3), two.reshape(-1, 3))
    off = one @ R.T + t - two
    apart = np.linalg.norm(off, axis=2)
    if faces is not None:
        centred = torch.from_numpy(two - two.mean(1, keepdims=True))
        apart = np.abs((off * vertex_normals(centred, faces).numpy()).sum(2))
    return list(1000 * np.median(apart, axis=1))


def _depths_apart(a: Dataset, b: Dataset, subject: str, names: Sequence[str]) -> list[float]:
    cameras = list(read_cameras_of(a, subject))
    found = []
    for name in names:
        folders = [dataset.surface_file(subject, name).parent for dataset in (a, b)]
        pairs = [[depth_file(folder, c) for folder in folders] for c in cameras]
        for one, two in [pair for pair in pairs if None not in pair][:COMPARED]:
            (near, valid), (far, also) = (read_depth(path) for path in (one, two) if path)
            size = _larger(near, far)
            near, far = (resize_area(depth, *size) for depth in (near, far))
            known = [resize_area(one.astype(np.float32), *size) == 1 for one in (valid, also)]
            if (both := known[0] & known[1]).any():
                found.append(float(1000 * np.median(np.abs(near - far)[both])))
    return found


def _larger(one: np.ndarray, two: np.ndarray) -> tuple[int, int]:
    """Return width and height of the larger of two pictures, whose sizes settings may change."""
    height, width = max(one.shape, two.shape)[:2]
    return width, height


RESULTS = (
    ResultKind("mesh", "mm", (lambda d, s, e, c: d.registration_file(s, e),), _meshes_apart),
    ResultKind("track", "mm", (lambda d, s, e, c: d.track_file(s),), _tracks_apart),
    ResultKind("depth", "mm", (lambda d, s, e, c: d.surface_file(s, e),), _depths_apart),
    ResultKind("mattes", "alpha", (Dataset.matte_file,), _mattes_apart),
    ResultKind("peaks", "frames", (lambda d, s, e, c: d.peaks_file(s),), _frames_apart),
)
