"""Read footage stored as videos: NeRSemble v2, RAVDESS, or a single video.

NeRSemble v2: a participant's folder, ``018/``, one video per sequence and camera. Footage is
colour-corrected when it is read (``color_calibration.json``: a polynomial per camera, in linear
light); its files stay as they are. Source: the layout that nersemble-data 0.0.6 reads.

RAVDESS: a folder ``Actor_01`` of one camera's clips, whose names describe the acting,
``MM-VC-EM-IN-ST-RE-AA.mp4``: modality, vocal channel, emotion, intensity, statement, repetition,
actor; actors of odd number are male. Source: S. Livingstone and F. Russo, "The Ryerson Audio-Visual
Database of Emotional Speech and Song", PLoS ONE 13(5), 2018.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from express50.capture.colour_correction import check_matrix
from express50.capture.raw import VIDEO_SUFFIXES, RawCamera, RawCapture, is_data_folder, is_shown
from express50.capture.readers.selection import (
    Moment,
    Selection,
    check_selection,
    common_timeline,
    folder_id,
)
from express50.errors import CalibrationError, CaptureError
from express50.files.images import ORIENTATION
from express50.files.text import check_readable, identifier, read_json_table
from express50.files.video import video_fps, video_tags
from express50.rigs.other_tools import read_nersemble

CAMERAS = Path("calibration/camera_params.json")
COLOURS = Path("calibration/color_calibration.json")
BACKGROUND = "BACKGROUND"
CLIP = "clip"

NAME = re.compile(r"0[123]-(0[12])-(0[1-8])-(0[12])-(0[12])-(\d\d)-(\d\d)")
CHANNELS = {"01": "speech", "02": "song"}
EMOTIONS = {
    "01": "neutral", "02": "calm", "03": "happy", "04": "sad",
    "05": "angry", "06": "fearful", "07": "disgust", "08": "surprised",
}  # fmt: skip
INTENSITIES = {"01": "normal", "02": "strong"}
STATEMENTS = {"01": "kids", "02": "dogs"}


def read_participant(path: Path, selection: Selection) -> RawCapture:
    """Read the sequences of a participant of NeRSemble.

    Raises:
        CaptureError: no video can be found.
        CalibrationError: cameras or colours are malformed.
    """
    calibration = read_nersemble(path / CAMERAS)
    check_readable(*(path / "sequences").iterdir())
    sequences = sorted(
        p.name for p in (path / "sequences").iterdir() if is_data_folder(p) and p.name != BACKGROUND
    )
    check_selection(selection, sequences, sorted(calibration))
    wanted = [name for name in sequences if selection.has_sequence(name)]
    videos: dict[str, dict[Moment, str]] = {}
    dropped: dict[str, str] = {}
    for serial in filter(selection.has_camera, sorted(calibration)):
        names = {s: f"sequences/{s}/images/cam_{serial}.mp4" for s in wanted}
        videos[serial] = {(s, 0): name for s, name in names.items() if (path / name).is_file()}
        try:  # if only a part was not fetched, the timeline says what is missing
            check_readable(*(path / name for name in names.values() if not videos[serial]))
        except CaptureError as error:
            dropped[serial] = str(error)
            del videos[serial]
    if not any(map(len, videos.values())) and list(path.glob("sequences/*/timesteps")):
        raise CaptureError(
            f"{path}: holds pictures, as NeRSemble's first release, expected videos; give a"
            " sequence such as sequences/EXP-1-head, with a calibration.json beside its timesteps"
            " ('express50 cameras import'; its cameras must be called cam_<serial>, as the pictures"
            " are)"
        )
    listed = [(name, 0) for name in wanted]
    line = common_timeline(path, videos, wanted, "videos", listed=listed, dropped=dropped)
    colours, warnings = _colours(path, set(line.cameras))
    plates = {serial: f"sequences/{BACKGROUND}/image_{serial}.jpg" for serial in line.cameras}
    return RawCapture(
        root=path,
        subject=folder_id(path),
        fps=first_fps([path / camera.names[0] for camera in line.cameras.values()]),
        meta={"licence": "research only, see the terms of NeRSemble"},
        cameras={
            serial: replace(camera, correction=colours.get(serial, ()))
            for serial, camera in line.cameras.items()
        },
        dropped=line.dropped,
        calibration=calibration,
        plates={serial: name for serial, name in plates.items() if (path / name).is_file()},
        clips=tuple(selection.expression(sequence) for sequence in line.sequences),
        skipped=selection.left_out(sequences) | line.skipped,
        found={"colour_corrected": sorted(colours)},
        warnings=warnings,
    )


def _colours(path: Path, serials: set[str]) -> tuple[dict, dict[str, str]]:
    if not (path / COLOURS).is_file():
        return {}, {"colours": f"{COLOURS} is missing; colours stay as each camera recorded them"}
    table = read_json_table(path / COLOURS, CalibrationError)
    found = {
        serial: check_matrix(table[serial], f"{path / COLOURS}: {serial}")
        for serial in sorted(serials & set(table))
    }
    without = sorted(serials - set(found))
    return found, {f"camera {s}": f"{COLOURS} has no correction for it" for s in without}


@dataclass(frozen=True, order=True)
class Clip:
    """The meaning of the parts of a RAVDESS file's name."""

    channel: str
    emotion: str
    intensity: str
    statement: str
    repetition: int
    actor: str

    @property
    def sequence(self) -> str:
        """Return the clip's name as an expression: ``happy_strong_kids_1``, ``song_sad_...``."""
        words = [self.emotion, self.intensity, self.statement, str(self.repetition)]
        return "_".join(["song", *words] if self.channel == "song" else words)


def parse_name(stem: str) -> Clip | None:
    """Parse a file's name without its ending; None if it is not one of RAVDESS."""
    match = NAME.fullmatch(stem)
    if match is None:
        return None
    channel, emotion, intensity, statement, repetition, actor = match.groups()
    return Clip(
        CHANNELS[channel], EMOTIONS[emotion], INTENSITIES[intensity], STATEMENTS[statement],
        int(repetition), actor,
    )  # fmt: skip


def _clips(path: Path) -> dict[Path, Clip | None]:
    files = [path] if path.is_file() else sorted(path.iterdir())
    return {file: parse_name(file.stem) for file in files if fits_video(file)}


def fits_ravdess(path: Path) -> bool:
    """Return whether a path is a clip of RAVDESS or a folder of such clips."""
    return any(_clips(path).values())


def actor_of(path: Path) -> str:
    """Return the actor's folder name in RAVDESS, ``Actor_01``; CaptureError if it has several."""
    actors = sorted({clip.actor for clip in _clips(path).values() if clip})
    if len(actors) != 1:
        raise CaptureError(
            f"{path}: holds actors {', '.join(actors[:4])}, expected one actor per folder"
        )
    return f"Actor_{actors[0]}"


def read_actor(path: Path, selection: Selection) -> RawCapture:
    """Read an actor's clips; a clip with sound is preferred to the same clip without.

    Raises:
        CaptureError: no clip can be used.
    """
    clips = _clips(path)
    check_selection(selection, [clip.sequence for clip in clips.values() if clip], ["front"])
    skipped: dict[str, str] = {}
    taken: dict[str, tuple[Clip, str]] = {}
    for file, clip in clips.items():
        if clip is None:
            skipped[f"file {file.name}"] = "its name is not one of RAVDESS"
        elif not selection.has_sequence(clip.sequence):
            skipped[f"file {file.name}"] = "not selected"
        elif clip.sequence in taken:  # sorted by name: the one with sound came first
            skipped[f"file {file.name}"] = f"the same clip as {taken[clip.sequence][1]}"
        else:
            taken[clip.sequence] = clip, file.name
    if not taken:
        raise CaptureError(
            f"{path}: no clip can be used; expected names like 01-01-03-02-01-01-05.mp4"
        )
    rows = sorted(taken.values())
    root = path if path.is_dir() else path.parent
    names = tuple(name for _, name in rows)
    return RawCapture(
        root=root,
        subject=actor_of(path),
        fps=video_fps(root / names[0]),
        meta={
            "licence": "CC BY-NC-SA 4.0",
            "gender": "male" if int(rows[0][0].actor) % 2 else "female",
        },
        cameras={"front": RawCamera(id="front", kind="videos", path=root, names=names)},
        clips=tuple(selection.expression(clip.sequence) for clip, _ in rows),
        skipped=skipped,
        found={"emotions": sorted({clip.emotion for clip, _ in rows})},
    )


def fits_video(path: Path) -> bool:
    """Return whether a path is a video file."""
    # A link to nothing counts: reading it says what to do.
    return is_shown(path, VIDEO_SUFFIXES) and (path.is_file() or path.is_symlink())


def video_id(path: Path) -> str:
    """Return the video's name as an id."""
    return identifier(path.stem)


def read_video(path: Path, selection: Selection) -> RawCapture:
    """Read a video as one camera and one clip, named ``clip`` unless the selection names it.

    A video that a phone stored on its side is read upright.

    Raises:
        CaptureError: it is not a video.
    """
    check_selection(selection, [CLIP], ["video"])
    turn = ORIENTATION[video_tags(path).turn]
    camera = RawCamera(
        id="video", kind="videos", path=path.parent, names=(path.name,), orientation=turn
    )
    return RawCapture(
        root=path.parent, subject=video_id(path), fps=video_fps(path), meta={},
        cameras={"video": camera}, clips=(selection.expression(CLIP),),
    )  # fmt: skip


def first_fps(videos: Sequence[Path]) -> float:
    """Return the frame rate of the first video that states it; CaptureError if none does."""
    for video in videos[:-1]:
        with suppress(CaptureError):
            return video_fps(video)
    return video_fps(videos[-1])
