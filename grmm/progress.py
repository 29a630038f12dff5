"""What a run says while it goes on, and how it stops."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from express50.console import readers_may_leave
from express50.errors import ConfigError, FormatError, TrainError
from express50.files.atomic import write_bytes
from express50.files.text import parse_json, read_text


def append_log(path: Path, iteration: int, seconds: float, terms: dict[str, float]) -> None:
    """Add where a run is to OUT/log.jsonl, one JSON object a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    entry = {"iteration": iteration, "seconds": round(seconds, 3)}
    numbers = {"loss": sum(terms.values())} | terms
    entry |= {name: round(value, 8) for name, value in numbers.items()}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


@contextmanager
def tensorboard(folder: Path, wanted: bool) -> Iterator[Callable[[int, dict[str, float]], None]]:
    """What writes the terms of an iteration for TensorBoard; nothing where it is not wanted.

    Raises:
        ConfigError: it is wanted, and the package is not installed.
    """
    if not wanted:
        yield lambda iteration, terms: None
        return
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ConfigError(
            "train.tensorboard is true, but tensorboard is not installed; "
            "pip install 'express50[tensorboard]' or set it to false"
        ) from error
    with SummaryWriter(str(folder)) as writer:

        def write(iteration: int, terms: dict[str, float]) -> None:
            for name, value in ({"loss": sum(terms.values())} | terms).items():
                writer.add_scalar(f"train/{name}", value, iteration)

        yield write


def start_log(path: Path, iteration: int) -> None:
    """Keep the lines of the log up to an iteration: a resumed run repeats what came later."""
    if not path.exists():
        return
    kept = []
    for line in read_text(path, TrainError).split("\n"):
        with contextlib.suppress(FormatError):  # the torn end of a line that a kill cut short
            row = parse_json(line, str(path), FormatError)
            if isinstance(row, dict) and row.get("iteration", iteration + 1) <= iteration:
                kept.append(json.dumps(row) + "\n")
    write_bytes(path, "".join(kept).encode())


def log(line: str) -> None:
    """Progress goes to standard error: standard output is for results."""
    with readers_may_leave(sys.stderr):
        sys.stderr.write(line + "\n")
        sys.stderr.flush()


@dataclass
class Interrupt:
    """Set by Ctrl-C or SIGTERM."""

    requested: bool = False


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Let the current iteration end before Ctrl-C or SIGTERM takes effect."""
    interrupt = Interrupt()

    def request(number: int, frame: object) -> None:
        interrupt.requested = True

    try:
        former = {s: signal.signal(s, request) for s in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not the main thread: nobody interrupts it
        yield interrupt
        return
    try:
        yield interrupt
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
