"""Read tracks and registrations: a subject's head in its peak frames and its clips.

Every package reads tracks through this module, so that a damaged or foreign file gives a one-line
error. Nothing in a file is executed: pickled objects are refused.
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
    """Holds a subject's tracked head: E expressions, V vertices; world = R @ head + t."""

    head: str  # head model name, as ``load_head`` takes it
    expressions: tuple[str, ...]  # E expression ids
    frames: np.ndarray  # (E,) int64 decode indices
    shape: np.ndarray  # (S,) coefficients, shared by all expressions
    expression: np.ndarray  # (E, X) coefficients
    # neck, jaw: (E, 3) axis-angle, radians
    neck: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray  # (E, 6) axis-angles, left then right
    R: np.ndarray  # (E, 3, 3) rotations
    t: np.ndarray  # (E, 3) metres
    vertices: np.ndarray  # (E, V, 3) float32 metres, world
    offsets: np.ndarray  # (V, 3) float32 metres, added to the rest shape; zeros if there are none
    # (E, V) float32 metres, standard deviations from the fit's own covariance; NaN if the file has
    # none, as for a scan
    sigma: np.ndarray
    # (E, V) float32 metres: nine vertices in ten are nearer than this to the true ones; NaN if the
    # file has none
    bound: np.ndarray
    # (n, 3) float32 metres, world, points spread over frames and lenses; None if the file does not
    # say whether glasses are worn
    glasses: np.ndarray | None
    glasses_row: np.ndarray  # (n,) int64, the track row that each point belongs to

    def row(self, expression: str) -> int:
        """Return the row of an expression; StageError if it is not tracked."""
        if expression not in self.expressions:
            raise StageError(f"{expression}: it is not tracked; see the track stage's metrics.json")
        return self.expressions.index(expression)

    def glasses_in(self, expression: str) -> np.ndarray | None:
        """Return points (n, 3) on an expression's glasses; None if the file does not say."""
        if self.glasses is None:
            return None
        return self.glasses[self.glasses_row == self.row(expression)].astype(np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sequence:
    """Holds a subject's tracked clips, F frames; arrays mean what they do in `Track`."""

    head: str  # head model name, as ``load_head`` takes it
    cues: tuple[str, ...]  # (F,) clip ids, one per frame
    frames: np.ndarray  # (F,) int64 decode indices
    shape: np.ndarray  # (S,) coefficients
    # expression, neck, jaw, eyes, R, t: (F, ...)
    expression: np.ndarray
    neck: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray
    R: np.ndarray
    t: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """Holds an expression's mesh on the reconstructed surface, V vertices."""

    track: str  # SHA-256 of the track.npz that was registered
    vertices: np.ndarray  # (V, 3) float32 metres, world
    offsets: np.ndarray  # (V, 3) float32 metres, added to the rest shape of the tracked parameters
    seen: np.ndarray  # (V,) bool, True where the surface was found and trusted
    # (V,) float32 metres, height of the surface above the mesh if seen, otherwise 0
    residual: np.ndarray
    sigma: np.ndarray  # (V,) float32 metres, standard deviation of the vertices along their normals
    # (V,) float32 metres: along their normals nine vertices in ten are nearer than this to the true
    # ones; NaN if the file has none, as for a scan
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
    """Yield a file's arrays; a missing or wrong array raises one FormatError."""
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
        FormatError: it is not a registration, its arrays do not fit each other, or one holds NaN
            or Inf.
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
    """Return the vertices' deviations or bounds; NaN if the file has none.

    Raises:
        ValueError: they have the wrong shape, or are not finite.
    """
    if name not in arrays:
        return np.full(shape, np.nan, np.float32)
    check_shape(name, arrays[name], shape)
    check_finite(name, arrays[name])
    return arrays[name].astype(np.float32)


def _glasses(arrays: dict[str, np.ndarray], count: int) -> tuple[np.ndarray | None, np.ndarray]:
    """Return points on glasses in `count` expressions, and their rows; None without any.

    Raises:
        ValueError: points and rows do not fit each other, or are not finite.
    """
    if "glasses" not in arrays:
        return None, np.zeros(0, np.int64)
    places, rows = arrays["glasses"], arrays["glasses_row"]
    check_shape("glasses", places, (rows.size, 3))
    check_finite("glasses", places)
    if rows.ndim != 1 or rows.dtype.kind not in "iu" or not np.isin(rows, np.arange(count)).all():
        raise ValueError(f"glasses_row must name one of {count} expressions for each point")
    return places.astype(np.float32), rows.astype(np.int64)


def registration_of(path: Path, track: Track, digest: str) -> Registration | None:
    """Read the registration of a track, given the track file's digest; None without a file.

    Raises:
        FormatError: it is damaged, or belongs to another track.
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
        FormatError: a registration is damaged, or belongs to another track.
    """
    vertices, digest = track.vertices.copy(), file_sha256(dataset.track_file(subject))
    for row, expression in enumerate(track.expressions):
        path = dataset.registration_file(subject, expression)
        found = registration_of(path, track, digest)
        if found is not None:
            vertices[row] = found.vertices
    return vertices


OF_FRAMES = ("frames", "expression", "neck", "jaw", "eyes", "R", "t")  # one row per frame


def read_sequence(path: Path) -> Sequence:
    """Read and check the frames of a subject's clips.

    Raises:
        StageError: the file is missing.
        FormatError: it is not a sequence, its arrays do not fit each other, or one holds NaN or
            Inf.
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
    """Return the numeric arrays of E expressions or cues, converted to their final types.

    ``further`` holds the shapes of arrays that only one kind of file has.

    Raises:
        ValueError: an array has the wrong shape or type, or holds invalid values.
        KeyError: an array is missing.
    """
    if names.ndim != 1 or names.dtype.kind != "U" or not len(names):
        raise ValueError(f"expressions are {names.dtype} {names.shape}, expected (E,) strings")
    for name in names.tolist():
        if not ID.fullmatch(name):  # they become file names
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
        raise ValueError(f"R is not a rotation: R R^T differs from identity by {error:.2g}")
    kinds = {"frames": np.int64, "vertices": np.float32, "offsets": np.float32}
    return {name: arrays[name].astype(kinds.get(name, np.float64)) for name in shapes}
