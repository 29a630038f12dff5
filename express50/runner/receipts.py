"""What a ledger keeps: receipts of items, the files they consist of, and runs of stages."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from express50.files.digests import file_sha256


@dataclass(frozen=True)
class FileMark:
    """A published file: size in bytes, modification time, inode, SHA-256."""

    size: int
    mtime_ns: int
    inode: int
    sha256: str


@dataclass(frozen=True)
class Made:
    """What an item was made from (digest of every input) and what it consists of."""

    inputs: dict[str, str]
    files: dict[str, FileMark]


@dataclass(frozen=True, kw_only=True)
class Receipt:
    """What became of one item.

    Attributes:
        stage: stage name.
        item: item id.
        fingerprint: digest of stage version, config and inputs.
        status: ``done`` or ``failed``.
        reason: one line for a failure, else empty.
        metrics: what the stage returned.
        seconds: wall time of the last attempt.
        peak_memory: largest resident memory while it ran, bytes.
        attempts: how often it was tried in that run.
        time: when it ended, seconds since 1970.
        made: inputs and files of what was published; `Ledger.made` reads it, `Ledger.read` not.
    """

    stage: str
    item: str
    fingerprint: str
    status: str
    reason: str = ""
    metrics: dict = field(default_factory=dict)
    seconds: float = 0.0
    peak_memory: int = 0
    attempts: int = 1
    time: float = field(default_factory=time.time)
    made: Made | None = None


@dataclass(frozen=True, kw_only=True)
class Run:
    """The last run of a stage; times are seconds since 1970.

    Attributes:
        stage: stage name.
        items: how many it was to bring up to date.
        current: how many of them were already.
        begun: when it began.
        seen: when it last gave a sign of life.
        ended: when it ended; 0 if it did not.
        running: when each item that is being worked at was begun.
    """

    stage: str
    items: int
    current: int = 0
    begun: float = 0.0
    seen: float = 0.0
    ended: float = 0.0
    running: dict[str, float] = field(default_factory=dict)


def mark_file(path: Path) -> FileMark:
    """Size, time and digest of a file as it is now."""
    stat = path.stat()
    return FileMark(stat.st_size, stat.st_mtime_ns, stat.st_ino, file_sha256(path))
