"""Run readers in a process of their own, which hostile bytes may fill, stall or kill."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import resource
import select
import signal
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import torch

from express50.errors import Express50Error
from express50.runner.worker import peak_memory, reset_peak_memory

SECONDS = 5.0  # of processor time for one file; a reader of a small file that takes longer hangs
SILENCE = 60.0  # seconds, on however busy a machine, until a child is given up
RESIDENT = 384 << 20  # bytes that reading a small file may really use
ADDRESSES = 2 << 30  # bytes that it may ask for
GOOD = ("read", "refused")


class Stalled(BaseException):
    """The alarm: no reader catches it."""


def judge(read: Callable[[], object]) -> tuple[str, str]:
    """How reading ended, in one word, and what was said."""
    reset_peak_memory()
    before = peak_memory()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        found = read()
        words = ("read", "") if finite(found) else ("not finite", "")
    except Express50Error as error:
        words = (_refusal(error), str(error))
    except MemoryError as error:
        words = ("memory", repr(error))
    except Stalled:
        words = ("hang", "")
    except Exception as error:  # noqa: BLE001  any other is a defect, which is what is counted
        words = ("traceback", f"{type(error).__name__}: {error}")
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    if peak_memory() - before > RESIDENT:
        return "memory", f"{(peak_memory() - before) >> 20} MiB; {words[1]}"
    return words


def _refusal(error: Express50Error) -> str:
    """Whether it is one short line, and not an allocation that happened to fail."""
    cause: BaseException | None = error
    while cause is not None:
        told = str(cause).lower()
        if isinstance(cause, MemoryError) or "insufficient memory" in told or "bad_alloc" in told:
            return "memory"
        cause = cause.__cause__ or cause.__context__
    return "refused" if "\n" not in str(error) and len(str(error)) < 1500 else "not one line"


def finite(found: object) -> bool:
    """Whether no number in arrays, tensors and tables is NaN or infinite."""
    if isinstance(found, np.ndarray):
        return found.dtype.kind not in "fc" or bool(np.isfinite(found).all())
    if isinstance(found, torch.Tensor):
        return not found.is_floating_point() or bool(torch.isfinite(found).all())
    if isinstance(found, float):
        return np.isfinite(found).item()
    if isinstance(found, Mapping):
        return all(map(finite, found.values()))
    if isinstance(found, list | tuple):
        return all(map(finite, found))
    if dataclasses.is_dataclass(found) and not isinstance(found, type):
        return all(finite(getattr(found, f.name)) for f in dataclasses.fields(found))
    return True


def outcomes(cases: list[Callable[[], object]]) -> list[tuple[str, str]]:
    """How each case ended, in one word, and what was said; a child that dies is replaced."""
    found: list[tuple[str, str]] = []
    while len(found) < len(cases):
        told, status = _run(cases, len(found))
        found += told
        if len(found) < len(cases):
            word = "hang" if status == signal.SIGKILL else "crash"
            found.append((word, f"signal {status}"))
    return found


def _run(cases: list[Callable[[], object]], start: int) -> tuple[list[tuple[str, str]], int]:
    """Outcomes from a case on until all are done or the process died, and its signal."""
    source, sink = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(source)
        _child(cases[start:], sink)
    os.close(sink)
    text = b""
    while True:
        ready, _, _ = select.select([source], [], [], SILENCE)
        if not ready:  # native code that the alarm does not reach
            os.kill(child, signal.SIGKILL)
        block = os.read(source, 1 << 16)
        if not block:
            break
        text += block
    os.close(source)
    _, status = os.waitpid(child, 0)
    lines = text[: text.rfind(b"\n") + 1].splitlines()
    return [tuple(json.loads(line)) for line in lines], status & 0x7F


def _child(cases: Iterable[Callable[[], object]], sink: int) -> None:
    """Report a line a case; never returns."""

    def stall(number: int, frame: object) -> None:
        raise Stalled

    signal.signal(signal.SIGPROF, stall)
    limit_memory()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # libraries' chatter about damaged files
        os.dup2(null, stream)
    with contextlib.suppress(BaseException):
        for case in cases:
            os.write(sink, (json.dumps(judge(case)) + "\n").encode())
    os._exit(0)


def limit_memory() -> None:
    """Let this process ask for no more than ``ADDRESSES`` beyond what it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + ADDRESSES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def say(line: str) -> None:
    """A line of the account."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
