"""NeRSemble v2: a participant's folder, ``018/``, one video per sequence and camera.

Footage is colour-corrected when it is read (``color_calibration.json``: a polynomial per camera, in
linear light), its files stay as they are. Source: the layout that nersemble-data 0.0.6 reads.
"""

from __future__ import annotations

from pathlib import Path

from express50.capture.colour_correction import check_matrix
from express50.capture.raw import RawCamera, RawCapture
from express50.capture.readers.selection import Selection, check_selection, identifier
from express50.capture.readers.timeline import Moment, common_timeline
from express50.errors import CaptureError
from express50.files.video import video_fps
from express50.rigs.camera_builder import read_table
from express50.rigs.dataset_formats import read_nersemble

CAMERAS = Path("calibration/camera_params.json")
COLOURS = Path("calibration/color_calibration.json")
BACKGROUND = "BACKGROUND"


def fits(path: Path) -> bool:
    """Return whether a folder is a participant's."""
    return (path / CAMERAS).is_file() and (path / "sequences").is_dir()


def subject_of(path: Path) -> str:
    """Return the participant's number."""
    return identifier(path.name)


def read(path: Path, selection: Selection) -> RawCapture:
    """Read a participant's sequences.

    Raises:
        CaptureError: no video can be found.
        CalibrationError: cameras or colours are malformed.
    """
    calibration = read_nersemble(path / CAMERAS)
    sequences = sorted(
        p.name for p in (path / "sequences").iterdir() if p.is_dir() and p.name != BACKGROUND
    )
    check_selection(selection, sequences, sorted(calibration))
    wanted = [name for name in sequences if selection.has_sequence(name)]
    serials = [serial for serial in sorted(calibration) if selection.has_camera(serial)]
    videos: dict[str, dict[Moment, str]] = {serial: {} for serial in serials}
    for serial in serials:
        for sequence in wanted:
            name = f"sequences/{sequence}/images/cam_{serial}.mp4"
            if (path / name).is_file():
                videos[serial][(sequence, 0)] = name
    line = common_timeline(videos, wanted, noun="videos")
    if not line.names or not line.moments:
        raise CaptureError(
            f"{path}: no video of {len(serials)} cameras and {len(wanted)} sequences; expected "
            "sequences/<name>/images/cam_<serial>.mp4"
        )
    colours, warnings = _colours(path, set(line.names))
    some = next(iter(line.names.values()))[0]
    plates = {serial: f"sequences/{BACKGROUND}/image_{serial}.jpg" for serial in sorted(line.names)}
    return RawCapture(
        root=path,
        subject=subject_of(path),
        fps=video_fps(path / some),
        meta={"licence": "research only, see the terms of NeRSemble"},
        cameras={
            serial: RawCamera(
                id=serial, kind="videos", path=path, names=names, correction=colours.get(serial, ())
            )
            for serial, names in line.names.items()
        },
        dropped=line.dropped,
        calibration={k: c for k, c in calibration.items() if k in line.names},
        plates={serial: name for serial, name in plates.items() if (path / name).is_file()},
        layout="nersemble",
        clips=tuple(selection.expression(sequence) for sequence in line.sequences),
        skipped=selection.left_out(sequences) | line.skipped,
        found={"colour_corrected": sorted(colours)},
        warnings=warnings,
    )


def _colours(path: Path, serials: set[str]) -> tuple[dict, dict[str, str]]:
    """Read the corrections by camera, and warnings about cameras without one."""
    if not (path / COLOURS).is_file():
        return {}, {"colours": f"{COLOURS} is missing; colours stay as each camera recorded them"}
    table = read_table(path / COLOURS)
    found = {
        serial: check_matrix(table[serial], f"{path / COLOURS}: {serial}")
        for serial in sorted(serials & set(table))
    }
    without = sorted(serials - set(found))
    words = {f"camera {s}": f"{COLOURS} has no correction of it" for s in without}
    return found, words
