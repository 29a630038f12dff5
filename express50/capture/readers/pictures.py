"""Read pictures of one instant: photographs, and the folders of reconstruction tools.

Photographs come without cameras, COLMAP models and transforms.json with them. Neither tool states
its unit; ``metres_per_unit`` in capture.toml does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from express50.capture.raw import IMAGE_SUFFIXES, RawCapture, image_names
from express50.capture.readers.folders import FPS, footage_folder, pictures_in, read_listed
from express50.capture.readers.selection import (
    Moment,
    Selection,
    check_selection,
    common_timeline,
    folder_id,
    unique_ids,
)
from express50.errors import CalibrationError, CaptureError
from express50.files.containers import inside
from express50.files.text import read_json_table, unreadable
from express50.geometry.cameras import Camera
from express50.rigs.camera_builder import in_metres
from express50.rigs.per_picture import camera_names, is_colmap, read_colmap_images, read_transforms

MODELS = ("sparse/0", "sparse", ".")
MOMENT = "photo"


def fits_photos(path: Path) -> bool:
    """Return whether a folder holds photographs."""
    return bool(image_names(footage_folder(path)))


def read_photos(path: Path, selection: Selection) -> RawCapture:
    """Read each photograph as a camera of one moment; raises as `read_listed` does.

    Cameras are those of calibration.json; without it, calibrate solves them. A photograph whose
    EXIF says that it lies on its side is read upright.
    """
    names = pictures_in(path, footage_folder(path))
    ids = unique_ids(path, names, lambda name: Path(name).stem)
    rows = {camera: {(MOMENT, 0): name} for name, camera in ids.items()}
    return read_listed(path, "frames", rows, selection)


def fits_colmap(path: Path) -> bool:
    """Return whether a folder holds a COLMAP model and its pictures."""
    return _model(path) is not None and (path / "images").is_dir()


def _model(path: Path) -> Path | None:
    return next((path / name for name in MODELS if is_colmap(path / name)), None)


def read_colmap_folder(path: Path, selection: Selection) -> RawCapture:
    """Read every posed picture as a camera of one moment.

    Raises:
        CaptureError: no picture can be found.
        CalibrationError: the model cannot be read, or has a lens that ours lack.
    """
    cameras, files = read_colmap_images(_model(path) or path)
    pictures = {name: {(MOMENT, 0): f"images/{file}"} for name, file in files.items()}
    return _read_posed(path, "colmap", cameras, pictures, selection)


def fits_transforms(path: Path) -> bool:
    """Return whether a folder, or the file itself, is a transforms.json with frames."""
    if path.is_dir():
        return (path / "transforms.json").is_file()
    return path.name.startswith("transforms") and path.suffix == ".json"


def read_transforms_folder(path: Path, selection: Selection) -> RawCapture:
    """Read cameras and time steps of a transforms.json.

    Raises:
        CaptureError: no picture can be found.
        CalibrationError: the cameras are malformed, or move between time steps.
    """
    file = path / "transforms.json" if path.is_dir() else path
    cameras = read_transforms(file, None)
    frames = read_json_table(file, CalibrationError)["frames"]
    pictures: dict[str, dict[Moment, str]] = {name: {} for name in cameras}
    for name, frame in zip(camera_names(frames), frames, strict=True):
        step = frame.get("timestep_index", 0)
        if not isinstance(step, int) or isinstance(step, bool) or step < 0:
            raise CaptureError(f"{file}: timestep_index {step!r}, expected 0 or more")
        given = str(frame.get("file_path", "")).removeprefix("./")
        endings = ("", *IMAGE_SUFFIXES)  # some tools leave out the ending
        found = (given + end for end in endings if _is_picture(file.parent, given + end))
        pictures[name][(MOMENT, step)] = next(found, given)
    return _read_posed(file.parent, "transforms", cameras, pictures, selection)


def _read_posed(
    root: Path,
    layout: str,
    calibration: Mapping[str, Camera],
    pictures: Mapping[str, Mapping[Moment, str]],
    selection: Selection,
) -> RawCapture:
    ids = unique_ids(root, calibration, str)
    check_selection(selection, [MOMENT], sorted(calibration))
    there = {
        ids[name]: {moment: file for moment, file in table.items() if _is_picture(root, file)}
        for name, table in pictures.items()
    }
    without = {
        ids[name]: unreadable(root / next(iter(table.values()))) or "its picture is not there"
        for name, table in pictures.items()
        if not there[ids[name]]
    }
    wanted = {ids[n]: there[ids[n]] for n in ids if there[ids[n]] and selection.has_camera(n)}
    line = common_timeline(root, wanted, [MOMENT], dropped=without)
    scale, warnings = selection.metres_per_unit, {}
    if scale is None:
        warnings["scale"] = (
            f"{layout} does not state its unit, metres are assumed; set metres_per_unit in "
            "capture.toml"
        )
    return RawCapture(
        root=root,
        subject=folder_id(root),
        fps=FPS,
        meta={},
        cameras=line.cameras,
        dropped=line.dropped,
        calibration=in_metres(
            {ids[n]: replace(camera, id=ids[n]) for n, camera in calibration.items()}, scale or 1.0
        ),
        clips=tuple(selection.expression(sequence) for sequence in line.sequences),
        skipped=line.skipped,
        warnings=warnings,
    )


def _is_picture(root: Path, name: str) -> bool:
    return bool(name) and inside(root, name).is_file()
