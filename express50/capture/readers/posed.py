"""Folders that other reconstruction tools leave: pictures with COLMAP cameras or transforms.json.

Neither says what its unit is; ``metres_per_unit`` in capture.toml does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from express50.capture.raw import IMAGE_SUFFIXES, RawCamera, RawCapture
from express50.capture.readers.selection import Selection, check_selection, identifier
from express50.capture.readers.timeline import Moment, common_timeline
from express50.errors import CalibrationError, CaptureError
from express50.files.containers import inside
from express50.geometry.cameras import Camera
from express50.rigs.camera_builder import in_metres, read_table
from express50.rigs.colmap import is_colmap, read_colmap_images
from express50.rigs.transforms_json import camera_names, read_transforms

FPS = 24.0  # of photographs it means nothing
MODELS = ("sparse/0", "sparse", ".")
MOMENT = "photo"


def subject_of(path: Path) -> str:
    """The folder's name."""
    return identifier(path.resolve().name)


def fits_colmap(path: Path) -> bool:
    """Return whether a folder holds a COLMAP model and its pictures."""
    return path.is_dir() and _model(path) is not None and (path / "images").is_dir()


def _model(path: Path) -> Path | None:
    return next((path / name for name in MODELS if is_colmap(path / name)), None)


def read_colmap_folder(path: Path, selection: Selection) -> RawCapture:
    """Every posed picture as a camera of one moment.

    Raises:
        CaptureError: no picture is there.
        CalibrationError: the model cannot be read, or has a lens that ours lack.
    """
    model = _model(path)
    if model is None:
        raise CaptureError(f"{path}: holds no COLMAP model; expected one in sparse/0")
    cameras, files = read_colmap_images(model)
    moment = (MOMENT, 0)
    pictures = {
        name: {moment: f"images/{file}"}
        for name, file in files.items()
        if _there(path, f"images/{file}")
    }
    return _assemble(path, "colmap", cameras, pictures, selection, sorted(files))


def fits_transforms(path: Path) -> bool:
    """Return whether a folder, or the file itself, is a transforms.json with frames."""
    if path.is_dir():
        return (path / "transforms.json").is_file()
    return path.name.startswith("transforms") and path.suffix == ".json"


def read_transforms_folder(path: Path, selection: Selection) -> RawCapture:
    """Cameras and time steps of a transforms.json.

    Raises:
        CaptureError: no picture is there.
        CalibrationError: the cameras are malformed, or move between time steps.
    """
    file = path / "transforms.json" if path.is_dir() else path
    cameras = read_transforms(file, None)
    frames = read_table(file)["frames"]
    pictures: dict[str, dict[Moment, str]] = {name: {} for name in cameras}
    for name, frame in zip(camera_names(frames), frames, strict=True):
        step = frame.get("timestep_index", 0)
        if not isinstance(step, int) or isinstance(step, bool) or step < 0:
            raise CaptureError(f"{file}: timestep_index {step!r}, expected 0 or more")
        found = _picture(file.parent, str(frame.get("file_path", "")))
        if found is not None:
            pictures[name][(MOMENT, step)] = found
    return _assemble(file.parent, "transforms", cameras, pictures, selection, sorted(cameras))


def _picture(root: Path, name: str) -> str | None:
    """The picture's name with its ending, which some tools leave out."""
    name = name.removeprefix("./")
    return next((n for n in (name, *(name + s for s in IMAGE_SUFFIXES)) if _there(root, n)), None)


def _there(root: Path, name: str) -> bool:
    return bool(name) and inside(root, name).is_file()


def _assemble(
    root: Path,
    layout: str,
    cameras: Mapping[str, Camera],
    pictures: Mapping[str, Mapping[Moment, str]],
    selection: Selection,
    known: list[str],
) -> RawCapture:
    check_selection(selection, [MOMENT], known)
    ids = {name: identifier(name) for name in cameras}
    if len(set(ids.values())) < len(ids):
        raise CalibrationError(
            f"{root}: camera names {', '.join(list(ids)[:4])} become the same id"
        )
    wanted = {ids[n]: table for n, table in pictures.items() if table and selection.has_camera(n)}
    line = common_timeline(wanted, [MOMENT])
    if not line.names or not line.moments:
        raise CaptureError(f"{root}: no picture of {len(cameras)} cameras is there; copy them")
    without = {ids[n]: "its picture is not there" for n in cameras if not pictures.get(n)}
    given = {ids[n]: replace(c, id=ids[n]) for n, c in cameras.items() if ids[n] in line.names}
    scale = selection.metres_per_unit
    warnings = {}
    if scale is None:
        warnings["scale"] = (
            f"{layout} does not say what its unit is, metres are assumed; say metres_per_unit in "
            "capture.toml"
        )
    return RawCapture(
        root=root,
        subject=subject_of(root),
        fps=FPS,
        meta={},
        cameras={
            name: RawCamera(
                id=name, kind="frames", path=root, names=names,
                counts=line.counts, stamps=line.stamps,
            )
            for name, names in line.names.items()
        },
        dropped=without | line.dropped,
        calibration=in_metres(given, scale or 1.0),
        layout=layout,
        clips=tuple(selection.expression(sequence) for sequence in line.sequences),
        skipped=line.skipped,
        found={},
        warnings=warnings,
    )  # fmt: skip
