"""AVA-256 (and Goliath heads, which have the same tree): ``m--..--GHS`` with a ``decoder`` folder.

``K`` and ``T`` are stored column by column (transposed), millimetres, world to camera, and belong
to pictures of 2668 x 4096 whatever size was downloaded. Pictures stay in their zips. The list of
frames names some that were never published. Source: the dataset's datasheet and loader.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from express50.capture.raw import RawCapture
from express50.capture.readers.selection import Selection, check_selection, identifier
from express50.capture.readers.timeline import Moment, common_timeline
from express50.errors import CalibrationError, CaptureError
from express50.files.containers import WITHIN, open_zip
from express50.files.text import read_text
from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_from_opencv
from express50.rigs.camera_builder import camera_from_K, checked, in_metres, read_table

CAMERAS = Path("decoder/camera_calibration.json")
FRAMES = Path("decoder/frame_list.csv")
SIZE = (2668, 4096)
SUFFIXES = (".avif", ".png", ".jpg")
FPS = 30.0


def fits(path: Path) -> bool:
    """Return whether a folder is a capture of AVA-256."""
    return (path / CAMERAS).is_file()


def subject_of(path: Path) -> str:
    """Return the subject in the folder's name, or the whole name where it has none.

    Names are ``<date>--<time>--<subject>`` or ``m--<date>--<time>--<subject>--GHS``.
    """
    parts = path.name.split("--")
    if parts[0] == "m" and parts[-1] == "GHS":
        parts = parts[1:-1]
    return identifier(parts[2] if len(parts) == 3 else path.name)


def read(path: Path, selection: Selection) -> RawCapture:
    """Read a capture's segments.

    Raises:
        CaptureError: a list or an archive is malformed, or no picture can be found.
        CalibrationError: the cameras are malformed.
    """
    calibration = read_calibration(path / CAMERAS)
    listed = read_frame_list(path / FRAMES)
    segments = list(dict.fromkeys(segment for segment, _ in listed))
    check_selection(selection, segments, sorted(calibration))
    wanted = [moment for moment in listed if selection.has_sequence(moment[0])]
    pictures, dropped = {}, {}
    for name in calibration:
        if not selection.has_camera(name):
            continue
        try:
            pictures[name] = _pictures(path, name, wanted)
        except CaptureError as error:
            dropped[name] = str(error)
    line = common_timeline(pictures, segments, listed=wanted)
    if not line.names or not line.moments:
        reasons = "; ".join(f"{k}: {v}" for k, v in (dropped | line.dropped).items())
        raise CaptureError(f"{path}: no usable camera: {reasons or 'no picture is there'}")
    return RawCapture(
        root=path,
        subject=subject_of(path),
        fps=FPS,
        meta={"licence": "research only, see the terms of AVA-256"},
        cameras=line.cameras(path),
        dropped=dropped | line.dropped,
        calibration={k: c for k, c in calibration.items() if k in line.names},
        layout="ava256",
        clips=tuple(selection.expression(segment) for segment in line.sequences),
        skipped=selection.left_out(segments) | line.skipped,
        found={"frames_listed": len(wanted)},
    )


def read_calibration(path: Path) -> dict[str, Camera]:
    """Read cameras by id (``cam<number>``), metres, for pictures of 2668 x 4096.

    Raises:
        CalibrationError: a camera lacks a field, or one has another shape or kind.
    """
    rows = read_table(path).get("KRT")
    if not isinstance(rows, list) or not rows:
        raise CalibrationError(f"{path}: has no list KRT of cameras; copy the file again")
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
        K, T = _array(where, row["K"], (3, 3)).T, _array(where, row["T"], (4, 4)).T
        given = row["distortion"]
        dist = _array(where, given, (len(given) if isinstance(given, list) else 0,))
        pose = np.vstack([T[:3], [0, 0, 0, 1]])
        found[name] = camera_from_K(name, K_from_opencv(K), dist, SIZE, pose)
    return checked(in_metres(found, 1e-3), path)


def _array(where: str, value: object, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all() or array.size > 16:
        raise CalibrationError(f"{where}: array of shape {array.shape}, expected {shape}, finite")
    return array


def read_frame_list(path: Path) -> list[Moment]:
    """Read segment and frame number of each row.

    Raises:
        CaptureError: a column is missing, or a frame is not a number.
    """
    try:
        table = csv.DictReader(read_text(path, CaptureError).splitlines())
        rows = [(row["seg_id"].strip(), int(row["frame_id"][:9])) for row in table]
    except (AttributeError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise CaptureError(
            f"{path}: no list of frames ({type(error).__name__}: {error}); expected columns seg_id "
            "and frame_id"
        ) from error
    return rows


def _pictures(path: Path, name: str, wanted: list[Moment]) -> Mapping[Moment, str]:
    """Find the name of each wanted picture that a camera has, in its zip or in a folder.

    Raises:
        CaptureError: there is neither, or the zip is damaged.
    """
    archive, folder = path / "decoder" / "image" / f"{name}.zip", path / "decoder" / "image" / name
    if archive.is_file():
        members = open_zip(archive).namelist()
        prefix = f"decoder/image/{name}.zip{WITHIN}"
    elif folder.is_dir():
        members = [f"{name}/{file.name}" for file in folder.iterdir()]
        prefix = "decoder/image/"
    else:
        raise CaptureError(f"{archive}: not there, nor a folder of that name; download it")
    ours = {m.rpartition(".")[0]: m for m in members if m.endswith(SUFFIXES)}
    places = {moment: f"{name}/{moment[1]:06d}" for moment in wanted}
    return {moment: prefix + ours[place] for moment, place in places.items() if place in ours}
