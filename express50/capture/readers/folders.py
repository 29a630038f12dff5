"""Read rigs: a folder of videos, one per camera, or folders by camera, by expression or by frame.

Nothing marks which side of a tree is the cameras. ``calibration.json`` names them; otherwise
names such as ``cam_01``, ``GoPro 2`` or a serial number tell. Where neither does, ``layout`` in
capture.toml has to say it: to guess could take people for one person's expressions.

What may lie beside the footage is that of our own layout (docs/FORMAT.md): ``calibration.json``,
``board``, ``plates``, and ``cues.csv`` if the footage is one clip. Pictures and videos that were
stored on their side are read upright. The footage may lie one folder deeper, as in ``rig/images``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path

from express50.capture.raw import (
    IMAGE_SUFFIXES,
    RawCapture,
    image_names,
    is_data_folder,
    is_shown,
    read_board,
    read_calibration,
    read_cues,
    read_plates,
    unused_files,
)
from express50.capture.readers.selection import (
    Moment,
    Selection,
    check_selection,
    common_timeline,
    folder_id,
    unique_ids,
)
from express50.capture.readers.videos import CLIP, first_fps, fits_video
from express50.errors import CaptureError, Express50Error
from express50.files.calibration import read_cameras
from express50.files.images import ORIENTATION, read_exif
from express50.files.text import identifier
from express50.files.video import video_tags

FPS = 24.0  # of pictures, which do not state it
# The last is a serial number; people's numbers are shorter.
CAMERA = re.compile(r".*(cam|gopro|kinect|view).*|c[-_]?\d+|\d{5,}", re.IGNORECASE)
NUMBER = re.compile(r"\d+")
FRAME = re.compile(r"(frame|timestep|time|step|f|t)?[-_]?\d+", re.IGNORECASE)
PERSON = re.compile(r"(s|sub|subj|subject|p|participant|person|id|actor)[-_]?\d+", re.IGNORECASE)
# Folders that only hold the footage, of a rig or of one of its moments, and folders beside these.
WRAPPER = re.compile(
    r"(image|img|picture|photo|video|frame|timestep|recording|footage|rgb|raw|data)s?"
    r"([-_]\d*[a-z].*)?|hd(videos|imgs)",
    re.IGNORECASE,
)
BESIDE = re.compile(
    r"plates|board|(fg_?)?masks?([-_].*)?|mattes?|alphas?|depths?|annotations?", re.IGNORECASE
)


def footage_folder(path: Path) -> Path:
    """Return the folder that holds a rig's footage: the path, or such as ``images`` in it.

    It is the path where footage lies beside that folder, as one cannot tell which is meant.
    """
    if not path.is_dir() or _holds_footage(path):
        return path
    folders = [inner for inner in path.iterdir() if is_data_folder(inner)]
    wrappers = [inner for inner in folders if WRAPPER.fullmatch(inner.name)]
    # In our own layout, ``cameras`` holds folders.
    wrappers += [inner for inner in folders if inner.name == "cameras" and _holds_footage(inner)]
    others = {f for f in folders if not BESIDE.fullmatch(f.name)} - set(wrappers)
    return wrappers[0] if len(wrappers) == 1 and not any(map(_holds_footage, others)) else path


def _holds_footage(path: Path) -> bool:
    return any(is_shown(file, IMAGE_SUFFIXES) or fits_video(file) for file in path.iterdir())


def fits_videos(path: Path) -> bool:
    """Return whether a folder holds videos."""
    return path.is_dir() and any(map(fits_video, footage_folder(path).iterdir()))


def fits_camera_folders(path: Path) -> bool:
    """Return whether a folder holds a folder per camera, of videos or of numbered pictures."""
    kind, files = _files_by_folder(path)
    if kind == "frames" and _all(NUMBER, files):
        numbers = sorted(map(int, files))
        if numbers and numbers[-1] - numbers[0] < len(numbers):  # they count frames
            return False
    return _are_cameras(path, files)


def fits_expression_folders(path: Path) -> bool:
    """Return whether a folder holds a folder per expression, of a video or picture per camera."""
    kind, files = _files_by_folder(path)
    other = _all(PERSON, files) or (kind == "frames" and _all(FRAME, files))
    return not other and _are_cameras(path, _stems(files))


def fits_frame_folders(path: Path) -> bool:
    """Return whether a folder holds a folder per frame, of a picture per camera."""
    kind, files = _files_by_folder(path)
    named = not _all(NUMBER, files) or _are_cameras(path, _stems(files))
    return kind == "frames" and bool(files) and _all(FRAME, files) and named


def holds_folders(path: Path) -> bool:
    """Return whether a folder holds several folders with footage."""
    return bool(_files_by_folder(path)[1])


def read_videos(path: Path, selection: Selection) -> RawCapture:
    """Read each video of a folder as a camera; frame 17 of all shows the same moment.

    A file that cannot be read as a video, such as a sound recording, is dropped. Without cues, the
    whole footage is one clip.

    Raises:
        CaptureError: the cameras share no footage, two names become one camera id, a picture lacks
            its number, or cues or the board's files are malformed.
        CalibrationError: calibration.json is malformed.
    """
    names = _videos(path, footage_folder(path))
    ids = unique_ids(path, names, lambda name: Path(name).stem)
    return _read(path, "videos", {ids[name]: {(CLIP, 0): name} for name in names}, selection)


def read_camera_folders(path: Path, selection: Selection) -> RawCapture:
    """Read a folder per camera: its pictures, its only video, or a video per expression.

    A camera's name before that of an expression is left out.

    Raises as `read_videos` does.
    """
    kind, files = _files_by_folder(path)
    one_clip = kind == "frames" or all(len(names) == 1 for names in files.values())
    rows: dict[str, dict[Moment, str]] = {folder: {} for folder in files}
    for folder, row in rows.items():
        for name in files[folder]:
            stem = Path(name).stem
            sequence = CLIP if one_clip else stem.removeprefix(folder).strip("_- ") or stem
            _add(row, (sequence, _number(name) if kind == "frames" else 0), name)
    return _read(path, kind, rows, selection)


def read_expression_folders(path: Path, selection: Selection) -> RawCapture:
    """Read a folder per expression, which has a video or a picture of each camera.

    Raises as `read_videos` does.
    """
    return _read_inner(path, selection, lambda folder: (folder, 0))


def read_frame_folders(path: Path, selection: Selection) -> RawCapture:
    """Read a folder per frame, which has a picture of each camera.

    Raises as `read_videos` does.
    """
    return _read_inner(path, selection, lambda folder: (CLIP, _number(folder)))


def _read_inner(path: Path, selection: Selection, moment_of: Callable[[str], Moment]) -> RawCapture:
    """Read folders that hold all cameras' files of one moment each."""
    kind, files = _files_by_folder(path)
    rows: dict[str, dict[Moment, str]] = {stem: {} for stem in sorted(_stems(files))}
    for folder, names in files.items():
        for name in names:
            _add(rows[Path(name).stem], moment_of(folder), name)
    return _read(path, kind, rows, selection)


def _files_by_folder(path: Path) -> tuple[str, dict[str, list[str]]]:
    """List the ``videos``, or else the pictures (``frames``), of each folder in a folder.

    Their names are relative to the path. Under two folders with footage are none: a folder of
    folders was meant.
    """
    if not path.is_dir() or (path.parent / "capture.toml").is_file():  # a part of our own layout
        return "videos", {}
    folders = [
        inner
        for inner in sorted(footage_folder(path).iterdir())
        if is_data_folder(inner) and inner.name not in ("plates", "board")
    ]
    places = {folder.name: footage_folder(folder) for folder in folders}
    videos = {name: _videos(path, place) for name, place in places.items()}
    kind = "videos" if any(videos.values()) else "frames"
    files = videos if kind == "videos" else {n: pictures_in(path, p) for n, p in places.items()}
    files = {folder: names for folder, names in files.items() if names}
    return kind, files if len(files) > 1 else {}


def _videos(root: Path, folder: Path) -> list[str]:
    found = sorted(folder.iterdir())
    return [file.relative_to(root).as_posix() for file in found if fits_video(file)]


def pictures_in(root: Path, folder: Path) -> list[str]:
    """List the pictures in a folder below a root, relative to that."""
    return [(folder / name).relative_to(root).as_posix() for name in image_names(folder)]


def _stems(files: Mapping[str, Collection[str]]) -> set[str]:
    return {Path(name).stem for names in files.values() for name in names}


def _are_cameras(path: Path, names: Collection[str]) -> bool:
    """Return whether all names are cameras', by the calibration beside them or by their words."""
    file, ids = path / "calibration.json", {identifier(name) for name in names}
    known = set(read_cameras(file)) if names and file.is_file() else set()
    return ids <= known if known & ids else bool(names) and _all(CAMERA, names)


def _all(pattern: re.Pattern[str], names: Collection[str]) -> bool:
    return all(map(pattern.fullmatch, names))


def _number(name: str) -> int:
    """Return the last number in the name of a picture or of a frame's folder."""
    numbers = re.findall(r"\d+", Path(name).stem)
    if not numbers:
        raise CaptureError(f"{name}: has no number in its name, expected that of its frame; add it")
    return int(numbers[-1])


def _add(row: dict[Moment, str], moment: Moment, name: str) -> None:
    if moment in row:
        raise CaptureError(
            f"{row[moment]} and {name} both show {moment[0]} {moment[1]}; move one away"
        )
    row[moment] = name


def _read(
    path: Path, kind: str, rows: Mapping[str, Mapping[Moment, str]], selection: Selection
) -> RawCapture:
    """Read files by moment, by camera's name."""
    ids = unique_ids(path, rows, str)
    sequences = sorted({sequence for row in rows.values() for sequence, _ in row})
    check_selection(selection, sequences, sorted(ids.values()))
    wanted = {
        camera: {m: file for m, file in rows[name].items() if selection.has_sequence(m[0])}
        for name, camera in ids.items()
        if selection.has_camera(camera)
    }
    turns: dict[str, int] = {}
    lost: dict[str, str] = {}
    for camera, row in wanted.items():
        first = path / row[min(row)] if row else path
        try:
            turns[camera] = (
                ORIENTATION[video_tags(first).turn] if kind == "videos" else read_exif(first)[0]
            )
        except Express50Error as error:
            lost[camera] = str(error)
    line = common_timeline(path, {k: wanted[k] for k in turns}, sequences, kind, dropped=lost)
    cameras = {k: replace(one, orientation=turns[k]) for k, one in line.cameras.items()}
    dropped = dict(line.dropped)
    videos = [path / camera.names[0] for camera in cameras.values() if kind == "videos"]
    calibration = read_calibration(path, cameras, dropped)
    clips = tuple(selection.expression(sequence) for sequence in line.sequences)
    cues = read_cues(path / "cues.csv") if line.sequences == (CLIP,) else ()
    warnings = unused_files(path, ids.values())
    if line.sequences != (CLIP,) and (path / "cues.csv").is_file():
        warnings["cues.csv"] = "is not read, as the files are named by their expressions"
    return RawCapture(
        root=path, subject=folder_id(path), fps=first_fps(videos) if videos else FPS, meta={},
        cues=cues, cameras=cameras, dropped=dropped, calibration=calibration,
        plates=read_plates(path, cameras), board=read_board(path, cameras),
        clips=() if cues else clips, skipped=selection.left_out(sequences) | line.skipped,
        warnings=warnings,
    )  # fmt: skip
