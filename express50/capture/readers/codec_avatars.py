"""Read Meta's captures of heads: AVA-256 (Goliath's heads have the same tree) and Multiface.

AVA-256: ``m--..--GHS`` with a ``decoder`` folder. ``K`` and ``T`` are stored column by column
(transposed), and belong to pictures of 2668 x 4096 whatever size was downloaded. Pictures stay in
their zips. The list of frames names some that were never published.

Multiface: ``m--<date>--<time>--<entity>--GHS`` with a ``KRT`` file and folders of pictures. ``KRT``
is text: a camera's name, three rows of K, one of distortion, three of [R|t], an empty line; K
belongs to pictures of 1334 x 2048.

Both are in millimetres, world to camera. Sources: the datasets' datasheets and loaders.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from express50.capture.raw import RawCapture
from express50.capture.readers.selection import Moment, Selection, check_selection, common_timeline
from express50.errors import CalibrationError, CaptureError
from express50.files.calibration import finite_array
from express50.files.containers import WITHIN, open_zip
from express50.files.text import (
    NAME,
    check_readable,
    identifier,
    read_json_table,
    read_text,
    refusing,
)
from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_from_opencv
from express50.rigs.camera_builder import as_rig, camera_from_K, in_metres

AVA256_SIZE, MULTIFACE_SIZE = (2668, 4096), (1334, 2048)
SUFFIXES = (".avif", ".png", ".jpg")
FPS = 30.0


def subject_of(path: Path) -> str:
    """Return the subject in the folder's name, or the whole name where it has none.

    Names are ``<date>--<time>--<subject>`` or ``m--<date>--<time>--<subject>--GHS``.
    """
    parts = path.name.split("--")
    if parts[0] == "m" and parts[-1] == "GHS":
        parts = parts[1:-1]
    return identifier(parts[2] if len(parts) == 3 else path.name)


def read_ava256(path: Path, selection: Selection) -> RawCapture:
    """Read a capture's segments.

    Raises:
        CaptureError: a list or an archive is malformed, or no picture can be found.
        CalibrationError: the cameras are malformed.
    """
    file = path / "decoder/frame_list.csv"
    columns = "expected columns seg_id and frame_id"
    with refusing(CaptureError, f"{file}: not a list of frames", columns):
        table = csv.DictReader(read_text(file, CaptureError).splitlines())
        listed = [(row["seg_id"].strip(), int(row["frame_id"][:9])) for row in table]
    cameras = _ava256_cameras(path / "decoder/camera_calibration.json")
    return _read(path, "AVA-256", cameras, listed, _ava256_pictures, selection)


def read_multiface(path: Path, selection: Selection) -> RawCapture:
    """Read a capture's segments.

    Raises:
        CaptureError: no picture can be found, or the list of frames is malformed.
        CalibrationError: ``KRT`` is malformed.
    """
    file, listed = path / "frame_list.txt", []
    for number, line in enumerate(read_text(file, CaptureError).split("\n"), 1):
        words = line.split()  # such as E001_Neutral_Eyes_Open 000123
        if not words:
            continue
        if len(words) != 2 or not NAME.fullmatch(words[0]) or not words[1].isdecimal():
            raise CaptureError(f"{file}:{number}: {line[:60]!r}, expected a segment and a frame")
        listed.append((words[0], int(words[1][:9])))
    cameras = _multiface_cameras(path / "KRT")
    return _read(path, "Multiface", cameras, listed, _multiface_pictures, selection)


def _read(
    path: Path,
    dataset: str,
    calibration: dict[str, Camera],
    listed: list[Moment],
    find: Callable[[Path, str, list[Moment]], dict[Moment, str]],
    selection: Selection,
) -> RawCapture:
    segments = list(dict.fromkeys(segment for segment, _ in listed))
    check_selection(selection, segments, sorted(calibration))
    wanted = [moment for moment in listed if selection.has_sequence(moment[0])]
    pictures, dropped = {}, {}
    for name in filter(selection.has_camera, calibration):
        try:
            pictures[name] = find(path, name, wanted)
        except CaptureError as error:
            dropped[name] = str(error)
    line = common_timeline(path, pictures, segments, listed=wanted, dropped=dropped)
    return RawCapture(
        root=path,
        subject=subject_of(path),
        fps=FPS,
        meta={"licence": f"research only, see the terms of {dataset}"},
        cameras=line.cameras,
        dropped=line.dropped,
        calibration=calibration,
        clips=tuple(selection.expression(segment) for segment in line.sequences),
        skipped=selection.left_out(segments) | line.skipped,
        found={"frames_listed": len(wanted)},
    )


def _ava256_cameras(path: Path) -> dict[str, Camera]:
    rows = read_json_table(path, CalibrationError).get("KRT")
    if not isinstance(rows, list) or not rows:
        raise CalibrationError(f"{path}: has no list of cameras called KRT; copy the file again")
    found = {}
    for row in rows:
        where = f"{path}: camera {row.get('cameraId') if isinstance(row, dict) else row!r}"
        if not isinstance(row, dict) or not {"cameraId", "K", "T", "distortion"} <= row.keys():
            raise CalibrationError(f"{where}: expected cameraId, K, T and distortion")
        name = f"cam{identifier(str(row['cameraId']))}"
        model = row.get("distortionModel", "RadialAndTangential")
        if model != "RadialAndTangential":
            raise CalibrationError(
                f"{where}: distortionModel {model}, expected RadialAndTangential"
            )
        what, given = f"{where}: array", row["distortion"]
        K, T = finite_array(row["K"], (3, 3), what).T, finite_array(row["T"], (4, 4), what).T
        dist = finite_array(given, (len(given) if isinstance(given, list) else 0,), what)
        pose = np.vstack([T[:3], [0, 0, 0, 1]])
        found[name] = camera_from_K(name, K_from_opencv(K), dist, AVA256_SIZE, pose)
    return as_rig(in_metres(found, 1e-3).values(), path)


def _ava256_pictures(path: Path, name: str, wanted: list[Moment]) -> dict[Moment, str]:
    archive = f"decoder/image/{name}.zip"
    check_readable(path / "decoder/image", path / archive)
    if not (path / archive).is_file():
        raise CaptureError(f"{path / archive}: no such file; download it")
    members = open_zip(path / archive).namelist()
    ours = {member.rpartition(".")[0]: member for member in members if member.endswith(SUFFIXES)}
    places = {moment: f"{name}/{moment[1]:06d}" for moment in wanted}
    return {m: f"{archive}{WITHIN}{ours[place]}" for m, place in places.items() if place in ours}


def _multiface_cameras(path: Path) -> dict[str, Camera]:
    text, found = read_text(path, CalibrationError), {}
    for block in re.split(r"\n\s*\n", text.strip()):
        name, *rows = [line.strip() for line in block.splitlines()] or [""]
        if not NAME.fullmatch(name):
            raise CalibrationError(f"{path}: camera {name[:40]!r}, expected an id like 400002")
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
        found[camera] = camera_from_K(camera, K, table[3], MULTIFACE_SIZE, pose)
    return as_rig(in_metres(found, 1e-3).values(), path)


def _multiface_pictures(path: Path, name: str, wanted: list[Moment]) -> dict[Moment, str]:
    """Name each wanted picture that a camera has; folders are listed once, for network drives.

    Raises:
        CaptureError: a folder of the camera cannot be read.
    """
    have = {}
    for segment in dict(wanted):
        folder = path / "images" / segment / name
        check_readable(folder)
        for file in sorted(folder.iterdir()) if folder.is_dir() else []:
            if file.suffix.lower() in (".png", ".jpg"):
                have[segment, file.stem] = f"images/{segment}/{name}/{file.name}"
    places = {moment: (moment[0], f"{moment[1]:06d}") for moment in wanted}
    return {moment: have[place] for moment, place in places.items() if place in have}
