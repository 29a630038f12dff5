"""Footage without any layout: a folder of photographs of one moment, or one video of one camera."""

from __future__ import annotations

from pathlib import Path

from express50.capture.raw import VIDEO_SUFFIXES, RawCamera, RawCapture, image_names
from express50.capture.readers.selection import Selection, check_selection, identifier
from express50.errors import CaptureError, FormatError
from express50.files.images import ORIENTATION, read_exif
from express50.files.video import video_fps, video_turn

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
