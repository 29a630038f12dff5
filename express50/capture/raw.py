"""Read a raw capture as it comes off the rig: check the folder and report every fault.

Layout: capture.toml, cameras/<id>/video.mp4 or cameras/<id>/frames/000000.png..., and optionally
calibration.json, plates/<id>.png, board/<id>.mp4 or board/<id>/*.png with board/board.toml, and
cues.csv.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Container, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from express50.capture.index import Cue
from express50.errors import CalibrationError, CaptureError, few, nearest
from express50.files.calibration import read_cameras
from express50.files.text import (
    ID,
    TOML_LIMIT,
    check_readable,
    csv_table,
    identifier,
    is_given,
    is_number,
    no_folder,
    read_text,
    read_toml,
    refusing,
    unreadable,
)
from express50.files.video import common_fps
from express50.geometry.cameras import Camera

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr")
VIDEO_SUFFIXES = (
    ".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mxf", ".mts", ".m2ts", ".ts", ".mpg",
    ".mpeg", ".wmv", ".flv",
)  # fmt: skip
# Pictures and videos of phones, cameras and the web that are not read.
UNDEVELOPED = (
    ".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef",
    ".iiq", ".3fr", ".srw", ".webp", ".avif", ".gif", ".bmp", ".jp2", ".jxl", ".jfif", ".dpx",
    ".tga", ".ppm", ".pgm", ".hdr", ".psd", ".ogv", ".3gp", ".vob", ".braw", ".r3d", ".crm",
)  # fmt: skip
# Windows reserves these names for devices, in any letter case.
RESERVED = {"CON", "PRN", "AUX", "NUL"}
RESERVED |= {f"{port}{n}" for port in ("COM", "LPT") for n in range(1, 10)}
# Files beside the footage that are read; suffixes of others that somebody may expect to be read.
FILES_READ = ("capture.toml", "cues.csv", "calibration.json")
DATA_SUFFIXES = (".csv", ".json", ".npz", ".toml", ".xml", ".yaml", ".yml")
CUE_COLUMNS = ("expression_id", "start_frame", "end_frame")
EXPORT = "not read: export them as JPEG, PNG, TIFF or .mp4"
ANY_FPS = 24.0  # a placeholder where the rate is not needed


@dataclass(frozen=True, kw_only=True)
class RawCamera:
    """Footage of one camera, as consecutive clips."""

    id: str
    kind: str  # ``video`` (the file is ``path``), ``videos`` (a file per clip) or ``frames``
    path: Path  # the video, or the folder that ``names`` are relative to
    names: tuple[str, ...] = ()  # in order; an image may lie in a container (`files.containers`)
    counts: tuple[int, ...] = ()  # number of images of each clip; if empty, there is one clip
    stamps: tuple[int, ...] = ()  # the layout's own number for each image; if empty, its position
    # rows of a polynomial colour correction (`colour_correction`), or none
    correction: tuple[tuple[float, ...], ...] = ()
    orientation: int = 1  # how images are rotated when they are read (`files.images`)


@dataclass(frozen=True, kw_only=True)
class RawCapture:
    """A capture in any layout, checked without decoding footage."""

    root: Path  # the folder that footage and plates are relative to
    subject: str
    fps: float  # frames per second
    meta: dict  # content of capture.toml
    cameras: dict[str, RawCamera]  # footage by camera id
    dropped: dict[str, str] = field(default_factory=dict)  # unusable cameras, with the reason
    calibration: dict[str, Camera] | None = None  # None if cameras are to be calibrated
    plates: dict[str, str] = field(default_factory=dict)  # by camera id, relative to the root
    board: dict | None = None  # content of board.toml, and each camera's images or one video
    cues: tuple[Cue, ...] = ()  # scripted expressions in file order
    # name of the layout in `express50.capture.readers.read`; ours is ``express50``
    layout: str = "express50"
    # expression of each clip, if the footage comes in clips; the cues follow from them
    clips: tuple[str, ...] = ()
    # parts of a layout that were left out (sequences, frames), with the reason
    skipped: dict[str, str] = field(default_factory=dict)
    found: dict = field(default_factory=dict)  # facts about the layout, for metrics
    warnings: dict[str, str] = field(default_factory=dict)  # oddities that may be intentional


def read_capture(root: Path) -> RawCapture:
    """Read and check a raw capture.

    Raises:
        CaptureError: a missing or malformed file makes the whole capture unusable.
        CalibrationError: calibration.json exists but is malformed.
    """
    meta = read_meta(root)
    folder = root / "cameras"
    if not folder.is_dir():
        raise CaptureError(
            f"{folder}: {no_folder(folder)}; expected cameras/<id>/video.mp4 or frames/"
        )
    cameras, dropped = {}, {}
    for path in sorted(p for p in folder.iterdir() if not p.name.startswith(".")):
        if not path.is_dir():
            if not path.exists():
                dropped[path.name] = f"{path}: {unreadable(path)}"
            continue
        why = unreadable(path)
        footage = not why and ((path / "frames").is_dir() or _videos(path))
        if footage and not ID.fullmatch(path.name):
            raise CaptureError(
                f"{path}: camera id {path.name!r}, expected at most 120 letters, digits, '_' and"
                f" '-'; call it {identifier(path.name)[:120]!r} here, in plates/, board/ and"
                " calibration.json"
            )
        if path.name.startswith("@"):  # such as @eaDir, which Synology's disks add everywhere
            continue
        if why:
            dropped[path.name] = f"{path}: {why}"
            continue
        try:
            cameras[path.name] = _read_camera(path)
        except CaptureError as error:
            dropped[path.name] = str(error)
    calibration = read_calibration(root, cameras, dropped)
    if "fps" not in meta:
        videos = [camera.path for camera in cameras.values() if camera.kind == "video"]
        meta["fps"] = common_fps(root / "capture.toml", videos)
    return RawCapture(
        root=root,
        subject=meta["subject"],
        fps=float(meta["fps"]),
        meta=meta,
        cameras=cameras,
        dropped=dropped,
        calibration=calibration,
        plates=read_plates(root, cameras),
        board=read_board(root, cameras),
        cues=read_cues(root / "cues.csv"),
        warnings=unused_files(root, [*cameras, *dropped]),
    )


def read_calibration(
    root: Path, cameras: dict[str, RawCamera], dropped: dict[str, str]
) -> dict[str, Camera] | None:
    """Read calibration.json, if it is there, and drop cameras that only one side knows.

    Raises:
        CalibrationError: it is malformed.
    """
    given = root / "calibration.json"
    if not is_given(given):
        return None
    calibration = read_cameras(given)
    for name in sorted(set(calibration) - set(cameras) - set(dropped)):
        dropped[name] = "calibrated, but the capture has no footage of it"
    for name in sorted(set(cameras) - set(calibration)):
        near = nearest(name, calibration.keys() - cameras.keys())
        dropped[name] = (
            f"not in calibration.json{near}; rename it, add it there, or delete that file to"
            " calibrate all cameras"
        )
        del cameras[name]
    return calibration


def read_meta(root: Path) -> dict:
    """Read capture.toml; CaptureError if it is missing, or subject or a given fps is invalid."""
    path = root / "capture.toml"
    if not path.is_file():
        what = "has no capture.toml" if root.is_dir() else no_folder(root)
        raise CaptureError(
            f"{root}: {what}; expected a capture folder whose capture.toml gives the subject"
        )
    meta = read_capture_toml(root)
    check_identity(path, meta.get("subject"), meta.get("fps", ANY_FPS))
    return meta


def read_capture_toml(root: Path) -> dict:
    """Read a capture.toml, dates as text, without checking its content; empty if there is none.

    Raises:
        CaptureError: it cannot be read or is not TOML.
    """
    path = root / "capture.toml"
    table = read_toml(path, CaptureError) if is_given(path) else {}
    return {key: dates_as_text(value) for key, value in table.items()}


def check_identity(path: Path, subject: object, fps: object) -> None:
    """Raise CaptureError unless subject id and frame rate are of the right type and in range."""
    if not isinstance(subject, str) or not ID.fullmatch(subject):
        raise CaptureError(
            f"{path}: subject is {subject!r:.130}, expected at most 120 letters, digits, '_'"
            " and '-', such as 'S001'"
        )
    if subject.upper() in RESERVED:
        raise CaptureError(
            f"{path}: subject is {subject!r}, a name that Windows reserves for a device; expected"
            " another, such as 'S001'"
        )
    if not is_number(fps):
        raise CaptureError(f"{path}: fps is {fps!r}, expected a number such as 24")
    if not (math.isfinite(fps) and 0 < fps <= 10_000):
        raise CaptureError(f"{path}: fps is {fps!r}, expected more than 0 and at most 10000")


def check_focals(path: Path, given: Any) -> None:
    """Raise CalibrationError unless ``focal_px`` is positive: a number, or a table per camera."""
    for name, value in (given if isinstance(given, dict) else {"all cameras": given}).items():
        if not (is_number(value) and 0 < value < math.inf):
            raise CalibrationError(
                f"{path}: focal_px of {name} is {value!r}, expected a positive number of pixels"
            )


def dates_as_text(value: object) -> object:
    """Convert dates in TOML content to text, so that it can go into JSON."""
    if isinstance(value, dict):
        return {key: dates_as_text(one) for key, one in value.items()}
    if isinstance(value, list):
        return [dates_as_text(one) for one in value]
    return value if isinstance(value, str | int | float) else str(value)


def is_shown(path: Path, suffixes: Container[str]) -> bool:
    """Return whether a path's name has one of the suffixes, and is not that of a hidden file."""
    return path.suffix.lower() in suffixes and not path.name.startswith(".")


def hint_at_undeveloped(files: Iterable[Path]) -> str:
    """Return how to make files readable, as the end of an error, if some are `UNDEVELOPED`."""
    suffixes = sorted({file.suffix.lower() for file in files} & set(UNDEVELOPED))
    if not suffixes:
        return ""
    return f". Files such as *{suffixes[0]} are {EXPORT}"


def is_data_folder(path: Path) -> bool:
    """Return whether a path is a folder that is neither hidden nor a disk's own, as @eaDir is."""
    return path.is_dir() and path.name[0] not in ".@" and path.name != "lost+found"


def _videos(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if is_shown(path, VIDEO_SUFFIXES))


def _read_camera(folder: Path) -> RawCamera:
    videos = _videos(folder)
    found = [video for video in videos if video.stem.lower() == "video" and not video.is_dir()]
    frames = folder / "frames"
    if len(found) + frames.is_dir() > 1:
        names = ", ".join([video.name for video in found] + ["frames/"] * frames.is_dir())
        raise CaptureError(f"{folder}: holds {names}, expected only one; move the others away")
    if found:
        return RawCamera(id=folder.name, kind="video", path=found[0])
    if not frames.is_dir():
        other = f"; rename {videos[0].name} to video{videos[0].suffix}" if videos else ""
        held = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
        if held and not videos:
            other = f" (or another of {' '.join(VIDEO_SUFFIXES)}); got {few(held)}"
        raise CaptureError(
            f"{folder}: holds no footage, expected video.mp4 or frames/000000.png{other}"
        )
    check_readable(frames)
    files = sorted(image_names(frames), key=lambda name: len(Path(name).stem))  # 9 before 10
    if not files:
        raise CaptureError(f"{frames}: holds no image, expected 000000.png and so on")
    for number, name in enumerate(files):
        stem = Path(name).stem
        if not stem.isdecimal() or len(stem) > 18 or int(stem) != number:
            raise CaptureError(
                f"{frames}: frame {number} is missing: found {name}, expected {number:06d} with "
                f"one of {' '.join(IMAGE_SUFFIXES)}; restore it, or renumber from 000000"
            )
    return RawCamera(id=folder.name, kind="frames", path=frames, names=tuple(files))


def image_names(folder: Path) -> list[str]:
    """List the image files in a folder, sorted; none when the folder is missing."""
    if not folder.is_dir():
        return []
    return sorted(path.name for path in folder.iterdir() if is_shown(path, IMAGE_SUFFIXES))


def read_plates(root: Path, cameras: Container[str]) -> dict[str, str]:
    """Return the background plates that can be read, by camera and relative to the capture."""
    shut = _unreadable_plates(root)
    names = [] if "plates" in shut else image_names(root / "plates")
    plates = {identifier(Path(name).stem): f"plates/{name}" for name in names}
    return {
        camera: plate for camera, plate in plates.items() if camera in cameras and plate not in shut
    }


def _unreadable_plates(root: Path) -> dict[str, str]:
    """Return why the folder of plates, or else some of them, cannot be read, by relative path."""
    if why := unreadable(root / "plates"):
        return {"plates": why}
    plates = [f"plates/{name}" for name in image_names(root / "plates")]
    return {plate: why for plate in plates if (why := unreadable(root / plate))}


def read_board(root: Path, cameras: Iterable[str]) -> dict | None:
    """Return the content of board.toml and each camera's files, relative to the capture, or None.

    The files are images of the board, or one video.

    Raises:
        CaptureError: board.toml is missing, or a camera has several videos, or images and a video.
    """
    folder = root / "board"
    if not folder.is_dir():
        return None
    path = folder / "board.toml"
    if not is_given(path):
        raise CaptureError(
            f"{folder}: has no board.toml; write one that describes the ChArUco board, see"
            " docs/FORMAT.md"
        )
    config = read_toml(path, CaptureError)
    found: dict[str, list[str]] = {}
    for camera in cameras:
        named = [path for path in sorted(folder.iterdir()) if identifier(path.name) == camera]
        inside = [path for path in named if path.is_dir()]
        videos = [video for video in _videos(folder) if identifier(video.stem) == camera]
        videos += [video for inner in inside for video in _videos(inner)]
        images = [inner / name for inner in inside for name in image_names(inner)]
        if len(videos) > 1 or (videos and images):
            names = ", ".join(path.name for path in [*videos, *images][:4])
            raise CaptureError(
                f"{folder}: {camera} has {names}, expected one video or only images; move the"
                " others away"
            )
        if files := [f"board/{path.relative_to(folder).as_posix()}" for path in videos or images]:
            found[camera] = files
    return {"config": dates_as_text(config), "cameras": found}


def unused_files(root: Path, cameras: Iterable[str]) -> dict[str, str]:
    """Return what a capture holds that nothing reads, with what to do: a name may be misspelt.

    These are plates that cannot be read, files of ``plates`` and ``board`` that belong to no
    camera, pictures and videos in formats that are not read, and tables, settings and calibrations
    beside those that are read.
    """
    known, shut = list(cameras), _unreadable_plates(root)
    found = {name: f"{why}; left out" for name, why in shut.items()}
    for part, suffixes in (("plates", IMAGE_SUFFIXES), ("board", VIDEO_SUFFIXES)):
        folder = root / part
        names = [
            path.name
            for path in (sorted(folder.iterdir()) if folder.is_dir() and part not in shut else ())
            if is_shown(path, suffixes) or (part == "board" and path.is_dir())
            if identifier(path.name if path.is_dir() else path.stem) not in known
        ]
        if names:
            found[part] = (
                f"holds {few(names)}, but cameras are {few(known, 8)}; rename it after its camera"
            )
    names = [
        path.name
        for path in sorted(root.iterdir())
        if is_shown(path, DATA_SUFFIXES) and path.name not in FILES_READ
    ]
    if names:
        found["folder"] = (
            f"holds {few(names)}, which nothing reads; cues come from cues.csv, cameras from"
            " calibration.json (make it with 'express50 cameras import')"
        )
    files = sorted(file for depth in ("*", "*/*", "*/*/*") for file in root.glob(depth))
    read = {f.with_suffix("") for f in files if is_shown(f, IMAGE_SUFFIXES + VIDEO_SUFFIXES)}
    unread = [f for f in files if is_shown(f, UNDEVELOPED) and f.with_suffix("") not in read]
    if unread:  # raw files beside their JPEGs are usual
        found["files"] = f"{few([str(f.relative_to(root)) for f in unread])}: {EXPORT}"
    return found


def read_cues(path: Path) -> tuple[Cue, ...]:
    """Read ``expression_id,start_frame,end_frame`` rows; no file means no cues.

    Raises:
        CaptureError: a column is missing, a value is not a frame number, a cue ends before it
            starts, or an expression appears twice.
    """
    if not is_given(path):
        return ()
    text = read_text(path, CaptureError, TOML_LIMIT)
    reader, head = csv_table(text, skipinitialspace=True), text.partition("\n")[0]
    with refusing(CaptureError, f"{path}: not CSV", errors=(csv.Error,)):
        missing = [name for name in CUE_COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise CaptureError(
                f"{path}: no column {', '.join(missing)}; got {head!r:.100}, expected "
                f"{','.join(CUE_COLUMNS)} in the first line"
            )
        # Spreadsheets write rows of empty cells below a table that was once longer.
        cues = [_read_cue(path, reader.line_num, row) for row in reader if any(row.values())]
    seen: set[str] = set()
    for cue in cues:
        if cue.expression_id in seen:
            raise CaptureError(f"{path}: {cue.expression_id} appears twice, expected once")
        seen.add(cue.expression_id)
    return tuple(cues)


def _read_cue(path: Path, line: int, row: dict[str, str]) -> Cue:
    name = (row["expression_id"] or "").strip()
    if not ID.fullmatch(name) or "-" in name:
        raise CaptureError(
            f"{path}:{line}: expression_id is {name[:130]!r}, expected at most 120 letters, digits"
            " and '_'"
        )
    try:
        start, end = int(row["start_frame"]), int(row["end_frame"])
    except (TypeError, ValueError) as error:
        raise CaptureError(
            f"{path}:{line}: frames are {row['start_frame']!r} and {row['end_frame']!r}, "
            "expected two whole numbers"
        ) from error
    if not 0 <= start <= end < 2**31:
        raise CaptureError(
            f"{path}:{line}: {name} runs from {start} to {end}; expected 0 <= start <= end "
            "(the end frame is included)"
        )
    return Cue(name, start, end)


def check_calibrated_sizes(raw: RawCapture, sizes: dict[str, tuple[int, int]]) -> None:
    """Refuse cameras whose calibrated (width, height) differs from their footage's.

    Raises:
        CalibrationError: a size differs; a guessed scale would give wrong depths.
    """
    for name, (width, height) in sizes.items():
        camera = (raw.calibration or {}).get(name)
        if camera is not None and (camera.width, camera.height) != (width, height):
            raise CalibrationError(
                f"{raw.root / 'calibration.json'}: camera {name} is calibrated for "
                f"{camera.width}x{camera.height}, its footage is {width}x{height}; "
                "calibrate at the footage's size or scale the intrinsics"
            )
