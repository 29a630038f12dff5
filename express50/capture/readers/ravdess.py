"""RAVDESS: a folder ``Actor_01`` of one camera's clips, whose names describe the acting.

``MM-VC-EM-IN-ST-RE-AA.mp4``: modality, vocal channel, emotion, intensity, statement, repetition,
actor; actors of odd number are male. Source: S. Livingstone and F. Russo, "The Ryerson Audio-Visual
Database of Emotional Speech and Song", PLoS ONE 13(5), 2018.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from express50.capture.raw import VIDEO_SUFFIXES, RawCamera, RawCapture
from express50.capture.readers.selection import Selection, check_selection
from express50.errors import CaptureError
from express50.files.video import video_fps

NAME = re.compile(r"(\d\d)-(\d\d)-(\d\d)-(\d\d)-(\d\d)-(\d\d)-(\d\d)")
CAMERA = "front"
CHANNELS = {"01": "speech", "02": "song"}
EMOTIONS = {
    "01": "neutral", "02": "calm", "03": "happy", "04": "sad",
    "05": "angry", "06": "fearful", "07": "disgust", "08": "surprised",
}  # fmt: skip
INTENSITIES = {"01": "normal", "02": "strong"}
STATEMENTS = {"01": "kids", "02": "dogs"}


@dataclass(frozen=True, order=True)
class Clip:
    """The words that the parts of a file's name stand for."""

    channel: str
    emotion: str
    intensity: str
    statement: str
    repetition: int
    modality: str
    actor: str

    @property
    def sequence(self) -> str:
        """The clip's name as an expression: ``happy_strong_kids_1``, of songs ``song_...``."""
        words = [self.emotion, self.intensity, self.statement, str(self.repetition)]
        return "_".join(["song", *words] if self.channel == "song" else words)


def parse_name(stem: str) -> Clip | None:
    """Parse a file's name without its ending; None where it is not one of RAVDESS."""
    match = NAME.fullmatch(stem)
    if match is None:
        return None
    modality, channel, emotion, intensity, statement, repetition, actor = match.groups()
    known = (
        modality in ("01", "02", "03")
        and channel in CHANNELS
        and emotion in EMOTIONS
        and intensity in INTENSITIES
        and statement in STATEMENTS
    )
    if not known:
        return None
    return Clip(
        CHANNELS[channel], EMOTIONS[emotion], INTENSITIES[intensity], STATEMENTS[statement],
        int(repetition), modality, actor,
    )  # fmt: skip


def fits(path: Path) -> bool:
    """Return whether a path is such a clip or a folder of such clips."""
    return any(parse_name(file.stem) for file in _videos(path))


def _videos(path: Path) -> list[Path]:
    files = [path] if path.is_file() else sorted(path.iterdir())
    return [f for f in files if f.is_file() and f.suffix.lower() in VIDEO_SUFFIXES]


def subject_of(path: Path) -> str:
    """Return the actor's folder name, such as ``Actor_01``.

    Raises:
        CaptureError: the folder holds several actors.
    """
    actors = sorted({clip.actor for f in _videos(path) if (clip := parse_name(f.stem))})
    if len(actors) != 1:
        raise CaptureError(
            f"{path}: holds actors {', '.join(actors[:4])}, expected one actor per folder"
        )
    return f"Actor_{actors[0]}"


def read(path: Path, selection: Selection) -> RawCapture:
    """Read an actor's clips; of a clip with and without sound the one with sound is taken.

    Raises:
        CaptureError: no clip can be used.
    """
    root = path if path.is_dir() else path.parent
    subject = subject_of(path)
    skipped: dict[str, str] = {}
    taken: dict[str, tuple[Clip, str]] = {}
    known = []
    for file in _videos(path):
        clip = parse_name(file.stem)
        if clip is None:
            skipped[f"file {file.name}"] = "its name is not one of RAVDESS"
            continue
        known.append(clip.sequence)
        if not selection.has_sequence(clip.sequence):
            skipped[f"file {file.name}"] = "not asked for"
        elif clip.sequence in taken:  # sorted by name: the one with sound came first
            skipped[f"file {file.name}"] = f"the same clip as {taken[clip.sequence][1]}"
        else:
            taken[clip.sequence] = clip, file.name
    check_selection(selection, known, [CAMERA])
    if not taken:
        raise CaptureError(
            f"{path}: no clip can be used; expected such as 01-01-03-02-01-01-05.mp4"
        )
    rows = sorted(taken.values())
    names = tuple(name for _, name in rows)
    return RawCapture(
        root=root,
        subject=subject,
        fps=video_fps(root / names[0]),
        meta={
            "licence": "CC BY-NC-SA 4.0",
            "gender": "male" if int(rows[0][0].actor) % 2 else "female",
        },
        cameras={CAMERA: RawCamera(id=CAMERA, kind="videos", path=root, names=names)},
        layout="ravdess",
        clips=tuple(selection.expression(clip.sequence) for clip, _ in rows),
        skipped=skipped,
        found={"emotions": sorted({clip.emotion for clip, _ in rows})},
    )
