"""Choose tracked subjects and expressions to export, and publish the folder that takes them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch

from express50.contract.exclusions import exclusion_reason
from express50.contract.layout import Dataset
from express50.dataset.tracks import OF_FRAMES, Track, existing_track, read_sequence, read_track
from express50.errors import FormatError, StageError
from express50.files.atomic import replace_directory, sync_tree
from express50.files.images import read_image
from express50.head.load import load_head
from express50.head.model import HeadModel, pose

META = "export.json"
SCHEMA = "express50.export/1"
SHARED = ("schema", "head", "expressions", "shape", "offsets")


@dataclass(frozen=True, kw_only=True, eq=False)
class Head:
    """A subject's tracked head.

    Attributes:
        subject: its id.
        track: the chosen rows of its track.
        model: the head model it was tracked with.
        albedo: (H, W, 3) uint8 sRGB texture, its first row at v = 1; None where there is none.
    """

    subject: str
    track: Track
    model: HeadModel
    albedo: np.ndarray | None


def tracked_subjects(dataset: Dataset, wanted: Sequence[str]) -> list[str]:
    """The wanted subjects, or all that are tracked and not excluded.

    Raises:
        StageError: a wanted one is unknown, excluded or not tracked, or none is tracked.
    """
    known = dataset.subjects()
    for name in wanted:
        if name not in known:
            listed = ", ".join(known) or "none"
            raise StageError(f"{dataset.root}: no subject {name!r}; expected one of {listed}")
        if (reason := exclusion_reason(dataset, name)) is not None:
            raise StageError(f"{name}: is excluded ({reason}); it is not exported")
        existing_track(dataset, name)
    if wanted:
        return list(dict.fromkeys(wanted))
    found = [
        name
        for name in known
        if dataset.track_file(name).is_file() and exclusion_reason(dataset, name) is None
    ]
    if not found:
        raise StageError(f"{dataset.root}: nothing is tracked; run 'express50 track' first")
    return found


def read_tracked(dataset: Dataset, subject: str, expressions: Sequence[str]) -> Head:
    """A subject's head with the wanted expressions, or all, in the track's order.

    Raises:
        StageError: the subject or a wanted expression is not tracked.
        FormatError: the track is damaged or does not fit its head model.
        HeadModelError: the head model cannot be loaded.
    """
    path = existing_track(dataset, subject)
    track = read_track(path)
    unknown = sorted(set(expressions) - set(track.expressions))
    if unknown:
        raise StageError(
            f"{subject}: {', '.join(unknown)} not tracked; expected some of"
            f" {', '.join(track.expressions)}"
        )
    model = load_head(track.head)
    _check_fit(path, track, model)
    if expressions:
        track = chosen(track, [name for name in track.expressions if name in expressions])
    return Head(subject=subject, track=track, model=model, albedo=read_albedo(path.parent))


def with_clips(dataset: Dataset, head: Head, wanted: Sequence[str]) -> Head:
    """The head with every tracked frame of its clips in the place of its peaks.

    The frames' names are the clip's and the frame's, such as ``smile_000123``; where clips are
    wanted by id, others are left out.

    Raises:
        StageError: its clips are not tracked, or none of these.
        FormatError: they are damaged, or were tracked with another head model.
    """
    path = existing_track(dataset, head.subject).with_name("sequence.npz")
    clips = read_sequence(path)
    if clips.head != head.track.head or len(clips.shape) != len(head.track.shape):
        raise FormatError(f"{path}: is not of the track beside it; run 'express50 track' again")
    rows = [i for i, cue in enumerate(clips.cues) if not wanted or cue in wanted]
    if not rows:
        raise StageError(f"{path}: holds no frame of {', '.join(wanted) or 'any clip'}")
    own = {name: getattr(clips, name)[rows] for name in OF_FRAMES}
    names = tuple(f"{clips.cues[i]}_{clips.frames[i]:06d}" for i in rows)
    vertices = np.stack([_posed(head, {k: v[i] for k, v in own.items()}) for i in range(len(rows))])
    track = replace(head.track, expressions=names, vertices=vertices, **own)
    return replace(head, track=track)


def _posed(head: Head, row: dict[str, np.ndarray]) -> np.ndarray:
    """World vertices (V, 3) float32 of one frame's parameters."""
    batch = {name: torch.from_numpy(row[name])[None] for name in ("neck", "jaw", "eyes")}
    shape, expression, offsets = (
        torch.from_numpy(np.asarray(array, np.float64))[None]
        for array in (head.track.shape, row["expression"], head.track.offsets)
    )
    model = head.model.to(dtype=torch.float64)
    vertices = pose(model, shape, expression, **batch, offsets=offsets)[0].numpy()
    return (vertices @ row["R"].T + row["t"]).astype(np.float32)


def _check_fit(path: Path, track: Track, model: HeadModel) -> None:
    counts = {
        "vertices": (track.vertices.shape[1], len(model.template)),
        "shape": (len(track.shape), model.shape_dirs.shape[2]),
        "expression": (track.expression.shape[1], model.expression_dirs.shape[2]),
    }
    for name, (got, there) in counts.items():
        if got > there or (name == "vertices" and got != there):
            raise FormatError(
                f"{path}: {got} {name}, its head model {model.name!r} has {there};"
                " run 'express50 track' again"
            )


def chosen(track: Track, expressions: Sequence[str]) -> Track:
    """The track of some of its expressions."""
    rows = [track.row(name) for name in expressions]
    parts = {
        item.name: getattr(track, item.name)[rows]
        for item in fields(track)
        if item.name not in SHARED
    }
    return replace(track, expressions=tuple(expressions), **parts)


def read_albedo(folder: Path) -> np.ndarray | None:
    """The texture beside a track, if there is one.

    Raises:
        FormatError: it is no 8-bit colour image.
    """
    path = folder / "albedo.png"
    if not path.is_file():
        return None
    image = read_image(path)
    if image.ndim != 3 or image.dtype != np.uint8:
        raise FormatError(f"{path}: {image.dtype} {image.shape}, expected 8-bit RGB; track again")
    return np.ascontiguousarray(image[..., :3])


@contextmanager
def exporting(out: Path, subject: str) -> Iterator[Path]:
    """Yield an empty folder aside; on a clean exit it becomes ``out/subject`` in one rename.

    A former export of the subject is replaced; what a killed run left aside is deleted.

    Raises:
        StageError: ``out/subject`` holds something else than an export.
    """
    target, aside = out / subject, out / f".{subject}.part"
    if target.exists() and not (target / META).is_file():
        raise StageError(
            f"{target}: exists and holds no {META}, so it is not an export; name another folder"
        )
    former = aside.with_name(aside.name + ".former")
    if former.exists() and not target.exists():
        former.rename(target)
    for leftover in (aside, former):
        shutil.rmtree(leftover, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        yield aside
        sync_tree(aside)
        replace_directory(aside, target)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
