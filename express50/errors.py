"""Define the errors that users see: one line with where, what, got, expected and how to fix it."""

from __future__ import annotations

import difflib
import math
import re
import shlex
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

FEW = 8  # names that a message lists before it says how many more there are
LIKENESS = 0.75  # of a word and a name that is worth suggesting; 'train' and 'twin' have 0.67
LONGEST = 1200  # characters; text from a hostile file must not fill a terminal


class Express50Error(Exception):
    """Base of every error that the command line turns into one line and exit code 1.

    A message may quote pages from a library: it is folded into one line without control
    characters. If it is too long its middle is cut, because the end says what to do.
    """

    def __init__(self, message: str) -> None:
        line = " ".join(message.splitlines())
        line = "".join(c if c.isprintable() else " " for c in line).strip()
        if len(line) > LONGEST:
            line = f"{line[: LONGEST // 2]} [...] {line[-LONGEST // 2 :]}"
        super().__init__(line)


class CaptureError(Express50Error):
    """A raw capture is missing a file, or holds one that cannot be read."""


class CalibrationError(Express50Error):
    """Cameras are missing, malformed or do not fit their footage."""


class ConfigError(Express50Error):
    """A configuration key or value is unknown or out of range."""


class UnknownNameError(ConfigError):
    """A command names a subject, an expression or a camera that is not there."""


class NotReadyError(ConfigError):
    """The machine lacks what a command asks for: space, memory, a GPU, a scheduler, a folder."""


class FormatError(Express50Error):
    """A file does not follow its format."""


class DiskError(Express50Error):
    """The dataset's disk cannot be written to; finished work is kept."""


class DiskFullError(DiskError):
    """The disk is full, or a quota on it is used up; finished work is kept."""


class StageError(Express50Error):
    """A stage cannot process one of its items."""


UNREADABLE = CaptureError, FormatError, StageError
"""What reading a view's pictures raises; stages leave the view out, name it, and go on."""


class NoFaceError(StageError):
    """A picture shows no face where one is needed."""


class AnnotationError(Express50Error):
    """A label is invalid or contradicts the footage."""


class HeadModelError(Express50Error):
    """A head model file is malformed, unsafe or unsupported."""


class TrainError(Express50Error):
    """Training or fitting cannot continue."""


class DivergedError(TrainError):
    """Training or fitting has reached NaN or Inf."""


def check_known(
    where: str,
    what: str,
    wanted: Iterable[str],
    known: Collection[str],
    kind: type[Express50Error] = UnknownNameError,
) -> None:
    """Refuse names that are not known.

    Raises:
        UnknownNameError: a name is unknown (or an error of another ``kind``); lists known names.
    """
    for name in wanted:
        if name not in known:
            near = nearest(name, known) if len(known) > FEW else ""
            listed = f"expected one of {', '.join(known)}" if known else "there is none"
            raise kind(f"{where}: no {what} {name!r}{near}; {listed}")


def nearest(word: str, known: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` if a word is a likely slip of a known name, else nothing."""
    best = max(known, key=lambda name: _likeness(word, name), default="")
    return f" (did you mean {best!r}?)" if _likeness(word, best) >= LIKENESS else ""


def few(names: Sequence[str], count: int = 3, between: str = ", ") -> str:
    """List the first names, then how many more there are."""
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return between.join(names[:count]) + more


def rounded(value: float, digits: int = 2) -> str:
    """Round to significant digits, without the exponent that ``g`` gives large numbers."""
    return f"{value:.0f}" if value >= 10**digits - 0.5 else f"{value:.{digits}g}"


def advised(*words: str | Path) -> str:
    """Return a command in quotation marks, as messages advise it; its paths suit any shell.

    Paths with spaces and the like are quoted, and those that begin as options do get ``./``.
    """
    texts = []
    for word in words:
        text = f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word)
        texts.append(shlex.quote(text) if isinstance(word, Path) else text)
    line = " ".join(texts)
    mark = '"' if "'" in line else "'"
    return f"{mark}{line}{mark}"


def rounded_down(value: float) -> str:
    """Format a value that is too low, so that it never reads like its limit."""
    return f"{math.floor(100 * value) / 100:.2f}"


def _likeness(word: str, name: str) -> float:
    """Return how alike a word and a name, or a part of it, are, 0 to 1."""
    if re.findall(r"0*(\d+)", word) != re.findall(r"0*(\d+)", name):
        return 0.0  # S009 is not a slip of S008, S01 may be one of S001
    word, name = word.casefold(), name.casefold()
    parts = [name, *re.split(r"[_/.-]+", name)]
    if any(part and sorted(word) == sorted(part) for part in parts):  # letters swapped
        return 1.0
    return max(difflib.SequenceMatcher(None, word, part).ratio() for part in parts)
