"""Read rigs: a folder of videos, one per camera, or folders by camera, by expression or by frame.

Nothing marks which side of a tree is the cameras. ``calibration.json`` names them; otherwise
names such as ``cam_01``, ``GoPro 2`` or a serial number tell. Where neither does, ``layout`` in
capture.toml has to say it: to guess could take people for one person's expressions. Folders may
hold files, or another level of folders: ``smile/cam_01.png`` and ``smile/cam_01/0001.png``.

What may lie beside the footage is that of our own layout (docs/FORMAT.md): ``calibration.json``,
``board``, ``plates``, and ``cues.csv`` if the footage is one clip. Pictures and videos that were
stored on their side are read upright. The footage may lie one folder deeper, as in ``rig/images``.
"""

from __future__ import annotations

import re
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from express50.capture.index import Cue
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
from express50.files.text import check_readable, identifier, unreadable
from express50.files.video import video_tags

FPS = 24.0  # of pictures, which do not state it
# The last is a serial number; people's numbers are shorter.
CAMERA = re.compile(r".*(cam|gopro|kinect|view).*|c[-_]?\d+|\d{5,}", re.IGNORECASE)
NUMBER = re.compile(r"\d+")
FRAME = re.compile(r"(frame|timestep|time|step|f|t)?[-_]?\d+", re.IGNORECASE)
PERSON = re.compile(r"(s|sub|subj|subject|p|participant|person|id|actor)[-_]?\d+", re.IGNORECASE)
# Some folder of most sets of expressions, and of few of people.
EXPRESSION = re.compile(
    r".*(neutral|smile|mouth|brow|jaw|lips|cheek|eyes|anger|happ|sad|surprise|disgust|fear).*",
    re.IGNORECASE,
)
# Folders that only hold the footage, of a rig or of one of its moments, and folders beside these.
WRAPPER = re.compile(
    r"(image|img|picture|photo|video|frame|timestep|recording|footage|rgb|raw|data)s?"
    r"([-_]\d*[a-z].*)?|hd(videos|imgs)",
    re.IGNORECASE,
)
BESIDE = re.compile(
    r"plates|board|(fg_?)?masks?([-_].*)?|mattes?|alphas?|depths?|annotations?", re.IGNORECASE
)


HOLDS = {"videos": fits_video, "frames": lambda file: is_shown(file, IMAGE_SUFFIXES)}


def footage_folder(path: Path) -> Path:
    """Return the folder that holds a rig's footage: the path, or such as ``images`` in it.

    It is the path where footage lies beside that folder, as one cannot tell which is meant.
    """
    if not path.is_dir() or _holds_footage(path):
        return path
    folders = [inner for inner in _listed(path) if is_data_folder(inner)]
    wrappers = [inner for inner in folders if WRAPPER.fullmatch(inner.name)]
    # In our own layout, ``cameras`` holds folders.
    wrappers += [inner for inner in folders if inner.name == "cameras" and _holds_footage(inner)]
    others = {f for f in folders if not BESIDE.fullmatch(f.name)} - set(wrappers)
    return wrappers[0] if len(wrappers) == 1 and not any(map(_holds_footage, others)) else path


def _holds_footage(path: Path) -> bool:
    return any(fits(file) for file in _listed(path) for fits in HOLDS.values())


def _listed(folder: Path) -> list[Path]:
    """List a folder, sorted; one without read permission as empty: its camera is left out."""
    return [] if unreadable(folder) else sorted(folder.iterdir())


def fits_videos(path: Path) -> bool:
    """Return whether a folder holds videos."""
    return path.is_dir() and any(map(fits_video, footage_folder(path).iterdir()))


@dataclass(frozen=True)
class Tree:
    """The footage in the folders of a folder."""

    kind: str  # frames or videos
    deep: bool  # whether it lies in folders of the folders
    places: dict[str, list[Path]]  # by folder: its files, or its folders of files
    empty: tuple[str, ...] = ()  # folders without footage

    def name(self, place: Path) -> str:
        """Return the name of a place: a folder's, or a file's without its ending."""
        return place.name if self.deep else place.stem

    def inner(self) -> set[str]:
        """Return the names of all places."""
        return {self.name(place) for row in self.places.values() for place in row}


def fits_camera_folders(path: Path) -> bool:
    """Return whether a folder holds a folder per camera, with the footage of each expression.

    That is one video or numbered pictures of all, a video of each, or a folder of each.
    """
    tree = _tree(path)
    if tree.kind == "frames" and not tree.deep and _all(NUMBER, tree.places):
        numbers = sorted(map(int, tree.places))
        if numbers and numbers[-1] - numbers[0] < len(numbers):  # they count frames
            return False
    return _are_cameras(path, tree.places)


def fits_expression_folders(path: Path) -> bool:
    """Return whether a folder holds a folder per expression, with the footage of each camera.

    That is a video, a picture or a folder of each.
    """
    tree = _tree(path)
    if tree.deep:  # people's rigs look the same
        known = (path / "calibration.json").is_file() or any(map(EXPRESSION.match, tree.places))
        return known and not _all(PERSON, tree.places) and _are_cameras(path, tree.inner())
    other = _all(PERSON, tree.places) or (tree.kind == "frames" and _all(FRAME, tree.places))
    return not other and _are_cameras(path, tree.inner())


def fits_frame_folders(path: Path) -> bool:
    """Return whether a folder holds a folder per frame, of a picture per camera."""
    tree = _tree(path)
    named = not _all(NUMBER, tree.places) or _are_cameras(path, tree.inner())
    pictures = tree.kind == "frames" and not tree.deep
    return pictures and bool(tree.places) and _all(FRAME, tree.places) and named


def holds_folders(path: Path) -> bool:
    """Return whether a folder holds several folders with footage."""
    return bool(_tree(path).places)


def read_videos(path: Path, selection: Selection) -> RawCapture:
    """Read each video of a folder as a camera; frame 17 of all shows the same moment.

    A file that cannot be read as a video, such as a sound recording, is dropped. Without cues, the
    whole footage is one clip.

    Raises as `read_listed` does, or CaptureError where a picture lacks its number.
    """
    names = _videos(path, footage_folder(path))
    ids = unique_ids(path, names, lambda name: Path(name).stem)
    return read_listed(path, "videos", {ids[name]: {(CLIP, 0): name} for name in names}, selection)


def read_camera_folders(path: Path, selection: Selection) -> RawCapture:
    """Read a folder per camera: its pictures, its only video, or a video or folder per expression.

    A camera's name before that of an expression is left out.

    Raises as `read_videos` does.
    """
    tree = _tree(path)
    one_clip = not tree.deep and (
        tree.kind == "frames" or all(len(row) == 1 for row in tree.places.values())
    )
    empty = [name for name in tree.empty if _are_cameras(path, [*tree.places, name])]
    rows: dict[str, dict[Moment, str]] = {folder: {} for folder in sorted([*tree.places, *empty])}
    for folder, places in tree.places.items():
        for place in places:
            name = tree.name(place)
            sequence = CLIP if one_clip else name.removeprefix(folder).strip("_- ") or name
            for file in _files(path, tree, place):
                _add(rows[folder], (sequence, _number(file) if tree.kind == "frames" else 0), file)
    return read_listed(path, tree.kind, rows, selection)


def read_expression_folders(path: Path, selection: Selection) -> RawCapture:
    """Read a folder per expression, with a video, a picture or a folder of each camera.

    Raises as `read_videos` does.
    """
    tree = _tree(path)
    many = tree.deep and tree.kind == "frames"
    return _read_inner(path, tree, selection, lambda f, name: (f, _number(name) if many else 0))


def read_frame_folders(path: Path, selection: Selection) -> RawCapture:
    """Read a folder per frame, which has a picture of each camera.

    Raises as `read_videos` does.
    """
    return _read_inner(path, _tree(path), selection, lambda folder, _: (CLIP, _number(folder)))


def _read_inner(
    path: Path, tree: Tree, selection: Selection, moment_of: Callable[[str, str], Moment]
) -> RawCapture:
    """Read folders that hold all cameras' files; their moments are of the folder and the file.

    Raises:
        CaptureError: a folder cannot be read, which all cameras would lose; or as `read_videos`.
    """
    check_readable(*(footage_folder(path) / name for name in tree.empty))
    rows: dict[str, dict[Moment, str]] = {name: {} for name in sorted(tree.inner())}
    for folder, places in tree.places.items():
        for place in places:
            for file in _files(path, tree, place):
                _add(rows[tree.name(place)], moment_of(folder, file), file)
    return read_listed(path, tree.kind, rows, selection)


def _tree(path: Path) -> Tree:
    """Find the videos, or else the pictures, in the folders of a folder, or one level below them.

    Under two folders with footage are none: a folder of folders was meant.
    """
    nothing = Tree("frames", False, {})
    if not path.is_dir() or (path.parent / "capture.toml").is_file():  # a part of our own layout
        return nothing
    folders = {
        inner.name: footage_folder(inner)
        for inner in sorted(footage_folder(path).iterdir())
        if is_data_folder(inner) and inner.name not in ("plates", "board")
    }
    for deep, (kind, holds) in product((False, True), HOLDS.items()):
        found = {name: _places(folder, deep, holds) for name, folder in folders.items()}
        if any(found.values()):
            held = {name: places for name, places in found.items() if places}
            empty = tuple(name for name, places in found.items() if not places)
            return Tree(kind, deep, held, empty) if len(held) > 1 else nothing
    return nothing


def _places(folder: Path, deep: bool, holds: Callable[[Path], bool]) -> list[Path]:
    if not deep:
        return list(filter(holds, _listed(folder)))
    inner = [path for path in _listed(folder) if is_data_folder(path)]
    inner = [path for path in inner if not BESIDE.fullmatch(path.name)]
    return [path for path in inner if any(map(holds, _listed(footage_folder(path))))]


def _files(root: Path, tree: Tree, place: Path) -> list[str]:
    if not tree.deep:
        return [place.relative_to(root).as_posix()]
    folder = footage_folder(place)
    return _videos(root, folder) if tree.kind == "videos" else pictures_in(root, folder)


def _videos(root: Path, folder: Path) -> list[str]:
    found = sorted(folder.iterdir())
    return [file.relative_to(root).as_posix() for file in found if fits_video(file)]


def pictures_in(root: Path, folder: Path) -> list[str]:
    """List the pictures in a folder below a root, relative to that."""
    return [(folder / name).relative_to(root).as_posix() for name in image_names(folder)]


def _without_gaps(cue: Cue, gaps: Sequence[int]) -> Cue:
    """Return a cue that counts the frames that are left, not those that the footage had."""
    start = cue.start_frame - bisect_left(gaps, cue.start_frame)
    end = cue.end_frame - bisect_right(gaps, cue.end_frame)
    return Cue(cue.expression_id, start, end)


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


def read_listed(
    path: Path, kind: str, rows: Mapping[str, Mapping[Moment, str]], selection: Selection
) -> RawCapture:
    """Read a rig whose files are listed by camera and moment, and what lies beside them.

    Raises:
        CaptureError: the cameras share no footage, two names become one camera id, or cues or the
            board's files are malformed.
        CalibrationError: calibration.json is malformed.
    """
    ids = unique_ids(path, rows, str)
    sequences = sorted({sequence for row in rows.values() for sequence, _ in row})
    check_selection(selection, sequences, sorted(ids.values()))
    wanted = {
        camera: {m: file for m, file in rows[name].items() if selection.has_sequence(m[0])}
        for name, camera in ids.items()
        if selection.has_camera(camera)
    }
    names = {camera: name for name, camera in ids.items()}
    turns: dict[str, int] = {}
    lost: dict[str, str] = {}
    for camera, row in wanted.items():
        if not row:
            folder = footage_folder(path) / names[camera]
            why = unreadable(folder)
            nothing = "its folder holds no footage, or none that is selected"
            lost[camera] = f"{folder}: {why}" if why else nothing
            continue
        first = path / row[min(row)]
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
    cues = tuple(_without_gaps(cue, line.gaps) for cue in cues)
    gone = [cue for cue in cues if cue.start_frame > cue.end_frame]
    skipped = {f"expression {cue.expression_id}": "all of its frames were left out" for cue in gone}
    warnings = unused_files(path, dict.fromkeys([*ids.values(), *dropped]))
    if line.sequences != (CLIP,) and (path / "cues.csv").is_file():
        warnings["cues.csv"] = "is not read, as the files are named by their expressions"
    return RawCapture(
        root=path, subject=folder_id(path), fps=first_fps(videos) if videos else FPS, meta={},
        cues=tuple(cue for cue in cues if cue not in gone), cameras=cameras, dropped=dropped,
        calibration=calibration,
        plates=read_plates(path, cameras), board=read_board(path, cameras),
        clips=() if cues else clips, warnings=warnings,
        skipped=selection.left_out(sequences) | line.skipped | skipped,
    )  # fmt: skip
