"""Multiface: ``m--<date>--<time>--<entity>--GHS`` with a ``KRT`` file and folders of pictures.

``KRT`` is text: a camera's name, three rows of K, one of distortion, three of [R|t] (world to
camera, millimetres), an empty line; K belongs to pictures of 1334 x 2048. Source: the dataset's
own reader.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from express50.capture.raw import RawCapture
from express50.capture.readers.selection import Selection, check_selection, identifier
from express50.capture.readers.timeline import Moment, common_timeline
from express50.errors import CalibrationError, CaptureError
from express50.files.text import NAME, read_text
from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_from_opencv
from express50.rigs.camera_builder import camera_from_K, checked, in_metres

SIZE = (1334, 2048)
FPS = 30.0


def fits(path: Path) -> bool:
    """Return whether a folder is a capture of Multiface."""
    return (path / "KRT").is_file() and (path / "images").is_dir()


def subject_of(path: Path) -> str:
    """Return the entity in the folder's name, or the whole name where it has none."""
    parts = path.name.split("--")
    return identifier(parts[3] if len(parts) == 5 else path.name)


def read(path: Path, selection: Selection) -> RawCapture:
    """Read a capture's segments.

    Raises:
        CaptureError: no picture can be found, or the list of frames is malformed.
        CalibrationError: ``KRT`` is malformed.
    """
    calibration = read_krt(path / "KRT")
    listed = read_frame_list(path / "frame_list.txt")
    segments = list(dict.fromkeys(segment for segment, _ in listed))
    check_selection(selection, segments, sorted(calibration))
    wanted = [moment for moment in listed if selection.has_sequence(moment[0])]
    names = [name for name in calibration if selection.has_camera(name)]
    pictures: dict[str, dict[Moment, str]] = {name: {} for name in names}
    for name in names:
        have = {segment: _stems(path / "images" / segment / name) for segment in dict(wanted)}
        for segment, number in wanted:
            file = have[segment].get(f"{number:06d}")
            if file:
                pictures[name][(segment, number)] = f"images/{segment}/{name}/{file}"
    line = common_timeline(pictures, segments, listed=wanted)
    if not line.names or not line.moments:
        raise CaptureError(
            f"{path}: no picture of {len(names)} cameras and {len(wanted)} frames; expected "
            "images/<segment>/<camera>/000123.png"
        )
    return RawCapture(
        root=path,
        subject=subject_of(path),
        fps=FPS,
        meta={"licence": "research only, see the terms of Multiface"},
        cameras=line.cameras(path),
        dropped=line.dropped,
        calibration={k: c for k, c in calibration.items() if k in line.names},
        layout="multiface",
        clips=tuple(selection.expression(segment) for segment in line.sequences),
        skipped=selection.left_out(segments) | line.skipped,
        found={"frames_listed": len(wanted)},
    )


def _stems(folder: Path) -> dict[str, str]:
    if not folder.is_dir():
        return {}
    files = (f.name for f in folder.iterdir() if f.suffix.lower() in (".png", ".jpg"))
    return {Path(name).stem: name for name in sorted(files)}


def read_krt(path: Path) -> dict[str, Camera]:
    """Read the cameras of a KRT file, metres, for pictures of 1334 x 2048.

    Raises:
        CalibrationError: a camera's lines are not what the layout says.
    """
    text, found = read_text(path, CalibrationError), {}
    for block in re.split(r"\n\s*\n", text.strip()):
        name, *rows = [line.strip() for line in block.splitlines()] or [""]
        if not NAME.fullmatch(name):
            raise CalibrationError(f"{path}: camera {name[:40]!r}, expected such as 400002")
        try:
            table = [np.array(row.split(), dtype=np.float64) for row in rows]
        except ValueError:
            table = []
        if [len(row) for row in table] != [3, 3, 3, 5, 4, 4, 4] or not all(
            np.isfinite(row).all() for row in table
        ):
            raise CalibrationError(
                f"{path}: camera {name} has rows of {[len(r) for r in table]} numbers, expected "
                "three of 3 (K), one of 5 (distortion), three of 4 ([R|t])"
            )
        pose = np.vstack([*table[4:], [0, 0, 0, 1]])
        K = K_from_opencv(np.array(table[:3]))
        camera = identifier(name)
        found[camera] = camera_from_K(camera, K, table[3], SIZE, pose)
    return checked(in_metres(found, 1e-3), path)


def read_frame_list(path: Path) -> list[Moment]:
    """Read segment and frame number of each line ``E001_Neutral_Eyes_Open 000123``.

    Raises:
        CaptureError: a line is something else.
    """
    lines = read_text(path, CaptureError).split("\n")
    found = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        if len(words) != 2 or not NAME.fullmatch(words[0]) or not words[1].isdecimal():
            raise CaptureError(f"{path}:{number}: {line[:60]!r}, expected a segment and a frame")
        found.append((words[0], int(words[1][:9])))
    return found
