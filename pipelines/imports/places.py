"""Fill in the placeholders of a path pattern: subject, expression, camera and frame."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from express50.capture.index import read_index, read_peaks
from express50.contract.layout import Dataset
from express50.errors import ConfigError

PLACES = ("subject", "expression", "camera", "frame", "clip_frame")
_PLACE = re.compile(r"\{([^{}:]*)(?::0?(\d+)d?)?\}")


@dataclass(frozen=True, kw_only=True)
class PeakFrame:
    """Names the peak frame of an expression.

    Attributes:
        expression: its id.
        frame: decode index in the footage.
        clip_frame: the same, counted from the first frame of the expression's cue window.
    """

    expression: str
    frame: int
    clip_frame: int


def peak_frames(dataset: Dataset, subject: str) -> list[PeakFrame]:
    """List a subject's peak frames by expression, sorted."""
    starts = {cue.expression_id: cue.start_frame for cue in read_index(dataset, subject).cues}
    return [
        PeakFrame(expression=name, frame=frame, clip_frame=frame - starts.get(name, 0))
        for name, frame in sorted(read_peaks(dataset, subject).items())
    ]


def check_pattern(pattern: str, needed: tuple[str, ...]) -> set[str]:
    """Return the names of a pattern's placeholders.

    Raises:
        ConfigError: a placeholder is unknown, or a needed one is missing.
    """
    found = {match[1] for match in _PLACE.finditer(pattern)}
    known = ", ".join(f"{{{name}}}" for name in PLACES)
    if unknown := sorted(found - set(PLACES)):
        raise ConfigError(
            f"{pattern}: unknown placeholder {{{unknown[0]}}}; expected some of {known}"
        )
    if "expression" in needed and found & {"frame", "clip_frame"}:
        needed = tuple(name for name in needed if name != "expression")
    if missing := [name for name in needed if name not in found]:
        raise ConfigError(
            f"{pattern}: has no {{{missing[0]}}}; expected a pattern with {known}, and widths such"
            " as {frame:06d}"
        )
    return found


def fill(pattern: str, subject: str, peak: PeakFrame | None = None, camera: str = "") -> Path:
    """Return the path that a pattern names."""
    values: dict[str, str | int] = {"subject": subject, "camera": camera}
    if peak is not None:
        values |= vars(peak)

    def value(match: re.Match[str]) -> str:
        found = values.get(match[1], match[0])
        return f"{found:0{match[2] or 0}d}" if isinstance(found, int) else str(found)

    return Path(_PLACE.sub(value, pattern)).expanduser()
