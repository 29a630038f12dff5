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
from express50.errors import FormatError, HeadModelError, StageError, advised
from express50.files.arrays import read_arrays
from express50.files.digests import cached_by_file
from express50.files.text import ID, refusing
from express50.geometry.shapes import check_finite, check_shape
from express50.head import HEADS, head_files

SCHEMA = "express50.track/2"
SEQUENCE_SCHEMA = "express50.sequence/1"
RIG_RATE = 24.0  # frames per second of the project's rig
REGISTRATION_SCHEMA = "express50.registration/1"
_WIDTHS = {"neck": (3,), "jaw": (3,), "eyes": (6,), "R": (3, 3), "t": (3,)}


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadPoses:
    """Holds parameters of a tracked head in N frames; world = R @ head + t."""

    head: str  # head model name, as ``load_head`` takes it
    frames: np.ndarray  # (N,) int64 decode indices
    shape: np.ndarray  # (S,) coefficients, shared by all frames
    expression: np.ndarray  # (N, X) coefficients
    neck: np.ndarray  # (N, 3) axis-angle, radians
    jaw: np.ndarray  # (N, 3) axis-angle, radians
    eyes: np.ndarray  # (N, 6) axis-angles, left then right
    R: np.ndarray  # (N, 3, 3) rotations
    t: np.ndarray  # (N, 3) metres


# Of 327 tracks of people, photographs and mistaken cameras, none exceeded 1.07; two rigs whose
# mattes and synchronisation were wrong had 1.9 and 2.4.
LARGEST_SPREAD = 1.2


def shape_spread(shape: np.ndarray) -> float:
    """Return the root mean square of shape coefficients (S,): standard deviations of people.

    About 0.5 for people; no person exceeds LARGEST_SPREAD.
    """
    return float(np.sqrt(np.mean(np.square(shape)))) if len(shape) else 0.0


OF_FRAMES = ("frames", "expression", "neck", "jaw", "eyes", "R", "t")  # arrays of a row per frame


@dataclass(frozen=True, kw_only=True, eq=False)
class Track(HeadPoses):
    """Holds a subject's head in the peak frames of E expressions, a mesh of V vertices in each."""

    expressions: tuple[str, ...]  # E ids, one per frame
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

    def mesh(self, expression: str, count: int, path: Path) -> np.ndarray:
        """Return the vertices (V, 3), float64, of an expression; its head model has `count`.

        Raises:
            StageError: the expression is not tracked.
            FormatError: the track, whose file is `path`, has another number of vertices.
        """
        vertices = self.vertices[self.row(expression)].astype(np.float64)
        if len(vertices) != count:
            raise FormatError(
                f"{path}: {len(vertices)} vertices, its head model has {count};"
                " run 'express50 track' again"
            )
        return vertices

    def glasses_in(self, expression: str) -> np.ndarray | None:
        """Return points (n, 3) on an expression's glasses; None if the file does not say."""
        if self.glasses is None:
            return None
        return self.glasses[self.glasses_row == self.row(expression)].astype(np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sequence(HeadPoses):
    """Holds a subject's head in every frame of its tracked clips."""

    cues: tuple[str, ...]  # clip ids, one per frame
    rate: float  # frames per second


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """Holds an expression's mesh on the reconstructed surface, V vertices."""

    track: str  # SHA-256 of the track.npz that was registered
    vertices: np.ndarray  # (V, 3) float32 metres, world
    offsets: np.ndarray  # (V, 3) float32 metres, added to the rest shape of the tracked parameters
    seen: np.ndarray  # (V,) bool, True where the surface was found and trusted
    residual: np.ndarray  # (V,) float32 metres, height of the surface above the mesh; 0 if unseen
    sigma: np.ndarray  # (V,) float32 metres, standard deviation of the vertices along their normals
    # (V,) float32 metres: along their normals nine vertices in ten are nearer than this to the true
    # ones; NaN if the file has none, as for a scan
    bound: np.ndarray


def existing_track(dataset: Dataset, subject: str) -> Path:
    """Return the path of the subject's track; StageError if it is missing."""
    path = dataset.track_file(subject)
    if not path.is_file():
        track = advised("express50 track", dataset.root)
        raise StageError(f"subject {subject!r} is not tracked; run {track}")
    return path


def track_inputs(dataset: Dataset, subject: str) -> dict[str, Path]:
    """Return what reading a subject's track opens: its file, and its head model's files.

    Raises:
        StageError: the subject is not tracked.
        FormatError: the file is not a track.
        HeadModelError: its head model is missing.
    """
    path = existing_track(dataset, subject)
    files = head_files(head := _head_of(path))
    if "head" in files and not files["head"].exists():
        raise HeadModelError(
            f"{path}: its head model {head} is missing; put it back there, or set {HEADS} to"
            f" the folder that holds {files['head'].name}"
        )
    return {"track": path, **files}


@cached_by_file(64)
def _head_of(path: Path) -> str:
    fix = "run 'express50 track' again"
    return str(read_arrays(path, FormatError, "a track", ("head",), fix, only=True)["head"])


def read_track(path: Path) -> Track:
    """Read and check a track.

    Raises:
        StageError: the file is missing.
        FormatError: it is not a track, its arrays do not fit each other, or one holds NaN or Inf.
    """
    with _arrays_of(path, "track", SCHEMA) as arrays:
        names, vertices = arrays["expressions"], arrays["vertices"]
        count = vertices.shape[1] if vertices.ndim == 3 else None
        further = {"vertices": (names.size, count, 3), "offsets": (count, 3)}
        numbers = _checked(arrays, names, further)
        for name in ("sigma", "bound"):
            numbers[name] = _doubt(arrays, name, numbers["vertices"].shape[:2])
        if len(set(names.tolist())) != len(names):
            raise ValueError("an expression appears twice")
        glasses, rows = None, np.zeros(0, np.int64)
        if "glasses" in arrays:
            glasses, rows = arrays["glasses"], arrays["glasses_row"]
            check_shape("glasses", glasses, (rows.size, 3))
            check_finite("glasses", glasses)
            known = np.arange(len(names))
            if rows.ndim != 1 or rows.dtype.kind not in "iu" or not np.isin(rows, known).all():
                raise ValueError(
                    f"glasses_row must name one of {len(names)} expressions for each point"
                )
            glasses, rows = glasses.astype(np.float32), rows.astype(np.int64)
        return Track(
            head=str(arrays["head"]), expressions=tuple(names.tolist()), **numbers,
            glasses=glasses, glasses_row=rows,
        )  # fmt: skip


@contextmanager
def _arrays_of(
    path: Path, what: str, schema: str, stage: str = "track", make: str = ""
) -> Iterator[dict[str, np.ndarray]]:
    """Yield a file's arrays, to be checked: a ValueError about them becomes a FormatError."""
    command = f"'express50 {stage}'"
    if path.is_dir():
        raise StageError(f"{path}: is a folder, expected the file of a {what} in it")
    if not path.is_file():
        raise StageError(f"{path}: the {what} is missing; run {make or command}")
    again = f"run {make or command}{'' if make else ' again'}"
    arrays = read_arrays(path, FormatError, f"a {what}", fix=again)
    with refusing(FormatError, f"{path}: not a {what}", again):
        if str(arrays["schema"]) != schema:
            raise ValueError(f"schema {str(arrays['schema'])!r}, expected {schema}")
        yield arrays


def read_registration(path: Path) -> Registration:
    """Read and check a registration.

    Raises:
        StageError: the file is missing.
        FormatError: it is not a registration, its arrays do not fit each other, or one holds NaN
            or Inf.
    """
    with _arrays_of(path, "registration", REGISTRATION_SCHEMA, "register") as arrays:
        count = len(arrays["vertices"])
        widths = {"vertices": (3,), "offsets": (3,), "seen": (), "residual": (), "sigma": ()}
        for name, width in widths.items():
            check_shape(name, arrays[name], (count, *width))
            check_finite(name, arrays[name])
        return Registration(
            track=str(arrays["track"]),
            **{name: arrays[name] for name in widths},
            bound=_doubt(arrays, "bound", (count,)),
        )


def _doubt(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the vertices' deviations or bounds; NaN if the file has none."""
    if name not in arrays:
        return np.full(shape, np.nan, np.float32)
    check_shape(name, arrays[name], shape)
    check_finite(name, arrays[name])
    return arrays[name].astype(np.float32)


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


def read_sequence(path: Path) -> Sequence:
    """Read and check the frames of a subject's clips.

    Raises:
        StageError: the file is missing.
        FormatError: it is not a sequence, its arrays do not fit each other, or one holds NaN or
            Inf.
    """
    make = "'express50 track --set track.frames=clips', or 'express50 photo' on a video"
    with _arrays_of(path, "sequence", SEQUENCE_SCHEMA, make=make) as arrays:
        cues = arrays["cues"]
        numbers, rate = _checked(arrays, cues, {}), float(arrays["rate"])
        if not 0 < rate < np.inf:
            raise ValueError(f"rate is {rate:g}, expected frames per second")
        names = tuple(cues.tolist())
        return Sequence(head=str(arrays["head"]), cues=names, rate=rate, **numbers)


def _checked(
    arrays: dict[str, np.ndarray], names: np.ndarray, further: dict[str, tuple[int | None, ...]]
) -> dict[str, np.ndarray]:
    """Return the numeric arrays of E expressions or cues, converted to their final types.

    ``further`` holds the shapes of arrays that only one kind of file has.
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
