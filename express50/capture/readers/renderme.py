"""Read RenderMe-360: a folder of one actor's ``.smc`` files (HDF5), or one such file.

There are two releases. The full one (21 actors) has pictures in ``raw/<id>/<id>_e0_raw.smc`` and
cameras in ``anno/<id>/<id>_e0_anno.smc``; the one of 500 actors has both in ``<id>_e0.smc``, but
only key frames of an expression. An expression's peak is the last frame of its clip in both, but
that is frame 119 of one and 12 of the other. Therefore the release and the frame's own number are
stored. ``RT`` is camera to world. Source: the dataset's published layout and reader.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from express50.capture.raw import RawCapture
from express50.capture.readers.selection import Moment, Selection, check_selection, common_timeline
from express50.errors import CaptureError
from express50.files.containers import WITHIN, attribute, child, members, open_hdf5
from express50.geometry.cameras import Camera
from express50.rigs.other_tools import read_renderme

FPS = 30.0
FULL, KEY_FRAMES = "full", "key frames"
USUAL = "e*"  # the twelve expressions; speech (s*) and hair (h*) are read only if selected
MOVED_MM = 1.0
NAME = re.compile(r"([0-9]+)_([ehs].*?)(?:_(raw|anno))?")  # actor, performance, kind


@dataclass(frozen=True)
class Performance:
    """One performance's files: ``raw`` has the pictures, ``anno`` (it may be the same) the rest."""

    part: str
    raw: Path
    anno: Path | None
    release: str


def fits(path: Path) -> bool:
    """Return whether a path is an SMC, or a folder that holds some."""
    if path.is_file():
        return path.suffix.lower() == ".smc"
    return any(path.glob("*.smc"))


def subject_of(path: Path) -> str:
    """Return the actor's number; CaptureError if the folder holds several actors."""
    actors = sorted({_parts(file)[0] for file in _files(path)})
    if len(actors) != 1:
        raise CaptureError(
            f"{path}: holds {len(actors)} actors ({', '.join(actors[:4])}), expected one; give the "
            "folder of one actor, such as raw/0026"
        )
    return actors[0]


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(path.glob("*.smc"))


def _parts(file: Path) -> tuple[str, str, str]:
    """Split a file's name into actor, performance and kind (``raw``, ``anno`` or empty)."""
    match = NAME.fullmatch(file.stem)
    if match is None:
        raise CaptureError(
            f"{file}: not the name of a RenderMe-360 performance; expected one like 0026_e0_raw.smc"
        )
    return match[1], match[2], match[3] or ""


def companions(path: Path) -> list[Path]:
    """List the files beside the footage that are read too."""
    folder = path if path.is_dir() else path.parent
    other = folder.parent.parent / "anno" / folder.name
    return [other] if other.is_dir() else []


def performances(path: Path) -> dict[str, Performance]:
    """Find the performances of a folder in their order: e0 to e11, then the others.

    Raises:
        CaptureError: there are annotations only.
    """
    found = {}
    for file in _files(path):
        actor, part, kind = _parts(file)
        if kind == "anno":
            continue
        places = (file.parent, *companions(path))
        anno = next((p for d in places if (p := d / f"{actor}_{part}_anno.smc").is_file()), None)
        release = FULL if kind == "raw" else KEY_FRAMES
        found[part] = Performance(part, file, anno if kind == "raw" else file, release)
    if not found:
        raise CaptureError(
            f"{path}: holds annotations only; give the folder with the pictures, such as raw/0026"
        )

    def rank(part: str) -> tuple[bool, int, str]:
        digits = "".join(c for c in part[1:].split("_")[0] if c.isdigit())
        return part[0] != "e", int(digits or 0), part

    return {part: found[part] for part in sorted(found, key=rank)}


def read(path: Path, selection: Selection) -> RawCapture:
    """Read an actor's performances.

    Raises:
        CaptureError: a file is damaged, or none can be used.
        CalibrationError: the cameras are malformed.
    """
    known, root = performances(path), path if path.is_dir() else path.parent
    clips, skipped = _selected_clips(path, known, selection)
    if not clips:
        reasons = "; ".join(f"{what}: {why}" for what, why in sorted(skipped.items()))
        raise CaptureError(f"{path}: no performance can be used: {reasons}")
    pictures: dict[str, dict[Moment, str]] = {}
    for part, clip in clips.items():
        for camera, keys in clip.frames.items():
            prefix = f"{known[part].raw.name}{WITHIN}Camera/{camera.removeprefix('cam')}/color"
            table = pictures.setdefault(camera, {})
            table |= {(part, key): f"{prefix}/{key}" for key in keys}
    last = {part: max(map(max, clip.frames.values())) for part, clip in clips.items()}
    line = common_timeline(root, pictures, list(clips), required=last.items())
    taken = [known[part] for part in clips]
    calibration, warnings = _calibration(taken, line.cameras.keys())
    expressions = {"e0": "neutral"} | dict(selection.expressions)
    names = {part: expressions.get(part) or selection.expression(part) for part in line.sequences}
    facts = {
        name: {
            "performance": part,
            "release": known[part].release,
            "num_frame": clips[part].count,
            "last_frame": last[part],
        }
        for part, name in names.items()
    }
    return RawCapture(
        root=root,
        subject=subject_of(path),
        fps=FPS,
        meta={"licence": "research only, see the terms of RenderMe-360"}
        | _person(taken[0])
        | {"renderme360": facts},
        cameras=line.cameras,
        dropped=line.dropped,
        calibration=calibration,
        clips=tuple(names.values()),
        skipped=skipped | line.skipped,
        found={"releases": sorted({performance.release for performance in taken})},
        warnings=warnings,
    )


@dataclass(frozen=True)
class PerformanceClip:
    """The frame numbers by camera, and the number of frames as the file states it."""

    frames: dict[str, list[int]]
    count: int


def _selected_clips(
    path: Path, known: dict[str, Performance], selection: Selection
) -> tuple[dict[str, PerformanceClip], dict[str, str]]:
    """Read the selected performances' clips of the selected cameras; say why others are skipped."""
    usual = "*" if path.is_file() else USUAL
    clips, skipped, seen = {}, {}, set[str]()
    for part, performance in known.items():
        what = f"sequence {part}"
        if not selection.has_sequence(part, usual):
            skipped[what] = "not a scripted expression; name it in sequences to include it"
            continue
        try:
            clip = _read_clip(performance)
        except CaptureError as error:
            skipped[what] = str(error)
            continue
        seen |= clip.frames.keys()
        frames = {name: keys for name, keys in clip.frames.items() if selection.has_camera(name)}
        if frames:
            clips[part] = replace(clip, frames=frames)
        else:
            skipped[what] = "has no picture of the selected cameras"
    check_selection(selection, list(known), sorted(seen) or list(selection.cameras))
    return clips, skipped


def _read_clip(performance: Performance) -> PerformanceClip:
    """Read a performance's frame numbers.

    Raises:
        CaptureError: the file is damaged, or a scripted clip lacks its end, where its peak is.
    """
    file = open_hdf5(performance.raw)
    group = child(file, "Camera")
    if not isinstance(group, h5py.Group):
        raise CaptureError(f"{performance.raw}: has no Camera group; copy the file again")
    found: dict[str, list[int]] = {}
    for name in members(group):
        if not name.isdecimal():
            continue
        colour = child(file, f"Camera/{name}/color")
        keys = members(colour) if isinstance(colour, h5py.Group) else []
        if keys:  # some have sound only
            numbers = [key for key in keys if key.isdecimal() and len(key) < 9]
            found[f"cam{name}"] = sorted(map(int, numbers))
    have = {key for keys in found.values() for key in keys}
    if not have:
        raise CaptureError(f"{performance.raw}: holds no picture; copy the file again")
    stated = attribute(group, "num_frame", len(have))
    usable = stated.size == 1 and stated.dtype.kind in "ui"
    count = int(stated[0]) if usable else len(have)
    if performance.part.startswith("e") and max(have) != count - 1 and len(have) != count:
        raise CaptureError(
            f"{performance.raw}: has {len(have)} frames up to number {max(have)}, num_frame is "
            f"{count}: the end of the clip, where the expression is, is missing; copy it again"
        )
    return PerformanceClip(found, count)


def _person(performance: Performance) -> dict[str, object]:
    """Read age and gender, which dataset cards count; the rest about the body is not read."""
    file = open_hdf5(performance.raw)
    age, gender = attribute(file, "age", ()), attribute(file, "gender", "").tolist()
    person: dict[str, object] = {}
    if age.size == 1 and age.dtype.kind in "ui" and 0 < age[0] < 130:
        person["age"] = int(age[0])
    if len(gender) == 1 and isinstance(gender[0], str) and gender[0].isalpha():
        person["gender"] = gender[0][:20]
    return person


def _calibration(
    taken: Iterable[Performance], names: Collection[str]
) -> tuple[dict[str, Camera] | None, dict[str, str]]:
    """Read the cameras of the first performance that has some; warn where others disagree."""
    first: dict[str, Camera] | None = None
    warnings = {}
    for performance in taken:
        if performance.anno is None:
            continue
        cameras = {k: c for k, c in read_renderme(performance.anno).items() if k in names}
        first = first or cameras
        moved = [
            name
            for name in sorted(first.keys() & cameras.keys())
            if np.linalg.norm(first[name].center - cameras[name].center) > 1e-3 * MOVED_MM
        ]
        if moved:
            warnings[f"calibration of {performance.part}"] = (
                f"{', '.join(moved[:4])} have moved since the first performance, whose cameras are "
                "used for all"
            )
    if not first:
        warnings["calibration"] = "no anno file was found; the cameras are solved from the footage"
    return first or None, warnings
