"""Read what was tracked and registered: a subject's head in its peak frames and its clips.

Every package reads tracks here, so that a damaged or foreign file gives one line of error.
Nothing in a file is executed: pickled objects are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.contract.layout import Dataset
from express50.errors import FormatError, StageError
from express50.files.arrays import read_arrays
from express50.files.digests import file_sha256
from express50.files.text import ID
from express50.geometry.shapes import check_finite, check_shape

SCHEMA = "express50.track/2"
SEQUENCE_SCHEMA = "express50.sequence/1"
REGISTRATION_SCHEMA = "express50.registration/1"
_WIDTHS = {"neck": (3,), "jaw": (3,), "eyes": (6,), "R": (3, 3), "t": (3,)}
_AGAIN = "run 'express50 track' again"


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Holds what was tracked of a subject: E expressions, V vertices; world = R @ head + t.

    Attributes:
        head: head model, as ``load_head`` takes it.
        expressions: E ids.
        frames: (E,) int64 decode indices.
        shape: (S,) coefficients, shared by all expressions.
        expression: (E, X) coefficients.
        neck, jaw: (E, 3) axis-angle, radians.
        eyes: (E, 6) axis-angles, left then right.
        R: (E, 3, 3) rotations.
        t: (E, 3) metres.
        vertices: (E, V, 3) float32 metres, world.
        offsets: (V, 3) float32 metres, added to the rest shape; zeros where there are none.
        sigma: (E, V) float32 metres, standard deviations by the fit's own covariance; NaN where
            the file has none, as of a scan.
        bound: (E, V) float32 metres: nine vertices in ten are nearer than this to the true ones;
            NaN where the file has none.
        glasses: (n, 3) float32 metres, world, places all over frames and lenses; None where the
            file does not say whether there are any.
        glasses_row: (n,) int64, whose row each is.
    """

    head: str
    expressions: tuple[str, ...]
    frames: np.ndarray
    shape: np.ndarray
    expression: np.ndarray
    neck: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray
    R: np.ndarray
    t: np.ndarray
    vertices: np.ndarray
    offsets: np.ndarray
    sigma: np.ndarray
    bound: np.ndarray
    glasses: np.ndarray | None
    glasses_row: np.ndarray

    def row(self, expression: str) -> int:
        """Return the row of an expression; StageError if it is not tracked."""
        if expression not in self.expressions:
            raise StageError(f"{expression}: it is not tracked; see the metrics of track")
        return self.expressions.index(expression)

    def glasses_in(self, expression: str) -> np.ndarray | None:
        """Return the places (n, 3) of an expression's glasses; None where that is unknown."""
        if self.glasses is None:
            return None
        return self.glasses[self.glasses_row == self.row(expression)].astype(np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sequence:
    """Holds what was tracked of a subject's clips, F frames; arrays mean what they do in `Track`.

    Attributes:
        head: head model, as ``load_head`` takes it.
        cues: (F,) ids of the clips, one per frame.
        frames: (F,) int64 decode indices.
        shape: (S,) coefficients.
        expression, neck, jaw, eyes, R, t: (F, ...).
    """

    head: str
    cues: tuple[str, ...]
    frames: np.ndarray
    shape: np.ndarray
    expression: np.ndarray
    neck: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray
    R: np.ndarray
    t: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """Holds an expression's mesh on the reconstructed surface, V vertices.

    Attributes:
        track: SHA-256 of the track.npz that was registered.
        vertices: (V, 3) float32 metres, world.
        offsets: (V, 3) float32 metres, added to the rest shape of the tracked parameters.
        seen: (V,) bool, where the surface was found and trusted.
        residual: (V,) float32 metres, height of the surface over the mesh there, 0 elsewhere.
        sigma: (V,) float32 metres, standard deviation of the vertices along their normals.
        bound: (V,) float32 metres: along their normals nine vertices in ten are nearer than this
            to the true ones; NaN where the file has none, as of a scan.
    """

    track: str
    vertices: np.ndarray
    offsets: np.ndarray
    seen: np.ndarray
    residual: np.ndarray
    sigma: np.ndarray
    bound: np.ndarray


def existing_track(dataset: Dataset, subject: str) -> Path:
    """Return the path of the subject's track; StageError if it is missing."""
    path = dataset.track_file(subject)
    if not path.is_file():
        raise StageError(f"subject {subject!r} is not tracked; run 'express50 track'")
    return path


def read_track(path: Path) -> Track:
    """Read and check a track.

    Raises:
        StageError: the file is missing.
        FormatError: it is not a track, its arrays do not fit each other, or one holds NaN or Inf.
    """
    if not path.is_file():
        raise StageError(f"{path}: the track is missing; run 'express50 track'")
    with _arrays_of(path, "a track", SCHEMA, _AGAIN) as arrays:
        names, vertices = arrays["expressions"], arrays["vertices"]
        count = vertices.shape[1] if vertices.ndim == 3 else None
        further = {"vertices": (names.size, count, 3), "offsets": (count, 3)}
        numbers = _checked(arrays, names, further)
        for name in ("sigma", "bound"):
            numbers[name] = _doubt(arrays, name, numbers["vertices"].shape[:2])
        if len(set(names.tolist())) != len(names):
            raise ValueError("an expression appears twice")
        glasses, rows = _glasses(arrays, len(names))
        return Track(
            head=str(arrays["head"]), expressions=tuple(names.tolist()), **numbers,
            glasses=glasses, glasses_row=rows,
        )  # fmt: skip


@contextmanager
def _arrays_of(path: Path, what: str, schema: str, again: str) -> Iterator[dict[str, np.ndarray]]:
    """Read the arrays of a file; what is missing or wrong with them becomes one FormatError."""
    arrays = read_arrays(path, FormatError, what, fix=again)
    try:
        if str(arrays["schema"]) != schema:
            raise ValueError(f"schema {str(arrays['schema'])!r}, expected {schema}")
        yield arrays
    except (KeyError, ValueError) as error:
        words = f"has no {error}" if isinstance(error, KeyError) else str(error)
        raise FormatError(f"{path}: not {what} ({words}); {again}") from None


def read_registration(path: Path) -> Registration:
    """Read and check a registration.

    Raises:
        StageError: the file is missing.
        FormatError: it is not a registration, or its arrays do not fit or hold NaN or Inf.
    """
    if not path.is_file():
        raise StageError(f"{path}: the registration is missing; run 'express50 register'")
    again = "run 'express50 register' again"
    with _arrays_of(path, "a registration", REGISTRATION_SCHEMA, again) as arrays:
        count = len(arrays["vertices"])
        for name, width in {"vertices": (3,), "offsets": (3,), "residual": (), "sigma": ()}.items():
            check_shape(name, arrays[name], (count, *width))
            check_finite(name, arrays[name])
        check_shape("seen", arrays["seen"], (count,))
        names = ("vertices", "offsets", "seen", "residual", "sigma")
        return Registration(
            track=str(arrays["track"]),
            **{name: arrays[name] for name in names},
            bound=_doubt(arrays, "bound", (count,)),
        )


def _doubt(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return deviations or bounds of vertices; NaN where a file has none.

    Raises:
        ValueError: they have another shape, or are not finite.
    """
    if name not in arrays:
        return np.full(shape, np.nan, np.float32)
    check_shape(name, arrays[name], shape)
    check_finite(name, arrays[name])
    return arrays[name].astype(np.float32)


def _glasses(arrays: dict[str, np.ndarray], count: int) -> tuple[np.ndarray | None, np.ndarray]:
    """Return the places of glasses in `count` expressions, and their rows; None without any.

    Raises:
        ValueError: they do not fit each other, or are not finite.
    """
    if "glasses" not in arrays:
        return None, np.zeros(0, np.int64)
    places, rows = arrays["glasses"], arrays["glasses_row"]
    check_shape("glasses", places, (rows.size, 3))
    check_finite("glasses", places)
    if rows.ndim != 1 or rows.dtype.kind not in "iu" or not np.isin(rows, np.arange(count)).all():
        raise ValueError(f"glasses_row is not a row of {count} expressions for each place")
    return places.astype(np.float32), rows.astype(np.int64)


def registration_of(path: Path, track: Track, digest: str) -> Registration | None:
    """Return the registration in a file, of a track whose file has a digest; None without a file.

    Raises:
        FormatError: it is damaged, or of another track.
    """
    if not path.is_file():
        return None
    found = read_registration(path)
    if found.track != digest or found.vertices.shape != track.vertices.shape[1:]:
        raise FormatError(f"{path}: belongs to another track; run 'express50 register' again")
    return found


def best_vertices(dataset: Dataset, subject: str, track: Track) -> np.ndarray:
    """Return the vertices (E, V, 3) float32 of a subject's track, registered where possible.

    Raises:
        FormatError: a registration is damaged, or of another track.
    """
    vertices, digest = track.vertices.copy(), file_sha256(dataset.track_file(subject))
    for row, expression in enumerate(track.expressions):
        path = dataset.registration_file(subject, expression)
        found = registration_of(path, track, digest)
        if found is not None:
            vertices[row] = found.vertices
    return vertices


OF_FRAMES = ("frames", "expression", "neck", "jaw", "eyes", "R", "t")  # a row per frame, with cues


def read_sequence(path: Path) -> Sequence:
    """Read and check the frames of a subject's clips.

    Raises:
        StageError: the file is missing.
        FormatError: it is not a sequence, its arrays do not fit, or one holds NaN or Inf.
    """
    if not path.is_file():
        raise StageError(
            f"{path}: the sequence is missing; run 'express50 track --set track.frames=clips', or"
            " 'express50 photo' on a video"
        )
    with _arrays_of(path, "a sequence", SEQUENCE_SCHEMA, _AGAIN) as arrays:
        cues = arrays["cues"]
        numbers = _checked(arrays, cues, {})
        return Sequence(head=str(arrays["head"]), cues=tuple(cues.tolist()), **numbers)


def _checked(
    arrays: dict[str, np.ndarray], names: np.ndarray, further: dict[str, tuple[int | None, ...]]
) -> dict[str, np.ndarray]:
    """Return the numbers of E expressions or cues with their final types.

    ``further`` are the shapes of arrays that only one kind of file has.

    Raises:
        ValueError: one has another shape or kind, or holds what it must not.
        KeyError: one is missing.
    """
    if names.ndim != 1 or names.dtype.kind != "U" or not len(names):
        raise ValueError(f"expressions are {names.dtype} {names.shape}, expected (E,) strings")
    for name in names.tolist():
        if not ID.fullmatch(name):  # they become names of files
            raise ValueError(f"expression {name!r}, expected letters, digits, _ and -")
    count = len(names)
    shapes: dict[str, tuple[int | None, ...]] = {
        "frames": (count,),
        "shape": (None,),
        "expression": (count, None),
        **{name: (count, *width) for name, width in _WIDTHS.items()},
    } | further
    for name, shape in shapes.items():
        check_shape(name, arrays[name], shape)
        if arrays[name].dtype.kind not in ("iu" if name == "frames" else "fiu"):
            raise ValueError(f"{name} is {arrays[name].dtype}, expected numbers")
        check_finite(name, arrays[name])
    R = arrays["R"]
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max()
    if error > 1e-3 or (np.linalg.det(R) < 0).any():
        raise ValueError(f"R is not a rotation: R R^T differs from 1 by {error:.2g}")
    kinds = {"frames": np.int64, "vertices": np.float32, "offsets": np.float32}
    return {name: arrays[name].astype(kinds.get(name, np.float64)) for name in shapes}
