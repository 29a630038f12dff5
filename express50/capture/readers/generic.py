"""Footage in no dataset's layout: photographs, one video, or folders of reconstruction tools.

Photographs and videos come without cameras, COLMAP models and transforms.json with them. Neither
tool states its unit; ``metres_per_unit`` in capture.toml does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from express50.capture.raw import IMAGE_SUFFIXES, VIDEO_SUFFIXES, RawCamera, RawCapture, image_names
from express50.capture.readers.selection import Selection, check_selection, identifier
from express50.capture.readers.timeline import Moment, common_timeline
from express50.errors import CalibrationError, CaptureError, FormatError
from express50.files.containers import inside
from express50.files.images import ORIENTATION, read_exif
from express50.files.video import video_fps, video_turn
from express50.geometry.cameras import Camera
from express50.rigs.camera_builder import in_metres, read_table
from express50.rigs.colmap import is_colmap, read_colmap_images
from express50.rigs.transforms_json import camera_names, read_transforms

FPS = 24.0  # meaningless for photographs
CAMERA = "video"


def subject_of(path: Path) -> str:
    """Return the folder's or the video's name."""
    return identifier(path.stem if path.is_file() else path.resolve().name)


def fits_photos(path: Path) -> bool:
    """Return whether a folder holds photographs."""
    return path.is_dir() and bool(image_names(path))


def read_photos(path: Path, selection: Selection) -> RawCapture:
    """Read each photograph as a camera of one moment; calibrate solves the cameras.

    A photograph that lies on its side by its EXIF is read upright.

    Raises:
        CaptureError: two names become one camera id, or no photograph can be used.
    """
    names = image_names(path)
    ids = {name: identifier(Path(name).stem) for name in names}
    check_selection(selection, ["photo"], sorted(ids.values()))
    dropped: dict[str, str] = {}
    cameras: dict[str, RawCamera] = {}
    for name, camera in ids.items():
        if not selection.has_camera(camera):
            continue
        if camera in cameras:
            raise CaptureError(
                f"{path / name}: becomes camera {camera}, as {cameras[camera].names[0]} does; "
                "rename one"
            )
        try:
            orientation, _ = read_exif(path / name)
        except FormatError as error:
            dropped[camera] = str(error)
            continue
        cameras[camera] = RawCamera(
            id=camera, kind="frames", path=path, names=(name,), counts=(1,), orientation=orientation
        )
    if not cameras:
        reasons = "; ".join(f"{k}: {v}" for k, v in dropped.items())
        raise CaptureError(f"{path}: no photograph can be used: {reasons or 'none was asked for'}")
    return RawCapture(
        root=path, subject=subject_of(path), fps=FPS, meta={}, cameras=cameras, dropped=dropped,
        layout="photos", clips=(selection.expression("photo"),),
    )  # fmt: skip


def fits_video(path: Path) -> bool:
    """Return whether a path is a video file."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def read_video(path: Path, selection: Selection) -> RawCapture:
    """Read a video as one camera and one clip, named ``clip`` unless the selection names it.

    A video that lies on its side, as telephones store what they film upright, is read upright.

    Raises:
        CaptureError: it is not a video.
    """
    check_selection(selection, ["clip"], [CAMERA])
    orientation = ORIENTATION[video_turn(path)]
    camera = RawCamera(
        id=CAMERA, kind="videos", path=path.parent, names=(path.name,), orientation=orientation
    )
    return RawCapture(
        root=path.parent, subject=subject_of(path), fps=video_fps(path), meta={},
        cameras={CAMERA: camera}, layout="video", clips=(selection.expression("clip"),),
    )  # fmt: skip


MODELS = ("sparse/0", "sparse", ".")
MOMENT = "photo"


def folder_name(path: Path) -> str:
    """Return the path's last name as an id."""
    return identifier(path.resolve().name)


def fits_colmap(path: Path) -> bool:
    """Return whether a folder holds a COLMAP model and its pictures."""
    return path.is_dir() and _model(path) is not None and (path / "images").is_dir()


def _model(path: Path) -> Path | None:
    return next((path / name for name in MODELS if is_colmap(path / name)), None)


def read_colmap_folder(path: Path, selection: Selection) -> RawCapture:
    """Read every posed picture as a camera of one moment.

    Raises:
        CaptureError: no picture can be found.
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
        if _is_picture(path, f"images/{file}")
    }
    return _assemble(path, "colmap", cameras, pictures, selection, sorted(files))


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
    frames = read_table(file)["frames"]
    pictures: dict[str, dict[Moment, str]] = {name: {} for name in cameras}
    for name, frame in zip(camera_names(frames), frames, strict=True):
        step = frame.get("timestep_index", 0)
        if not isinstance(step, int) or isinstance(step, bool) or step < 0:
            raise CaptureError(f"{file}: timestep_index {step!r}, expected 0 or more")
        given = str(frame.get("file_path", "")).removeprefix("./")
        for file_name in (given, *(given + suffix for suffix in IMAGE_SUFFIXES)):
            if _is_picture(file.parent, file_name):  # some tools leave out the ending
                pictures[name][(MOMENT, step)] = file_name
                break
    return _assemble(file.parent, "transforms", cameras, pictures, selection, sorted(cameras))


def _is_picture(root: Path, name: str) -> bool:
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
        subject=folder_name(root),
        fps=FPS,
        meta={},
        cameras=line.cameras(root),
        dropped=without | line.dropped,
        calibration=in_metres(given, scale or 1.0),
        layout=layout,
        clips=tuple(selection.expression(sequence) for sequence in line.sequences),
        skipped=line.skipped,
        warnings=warnings,
    )
