"""Readers take mutated files or refuse them with a project error; nothing else happens.

Each reader's cases run in a forked child with bounded memory and time, so that a native library
that crashes or stalls fails its own test alone.
"""

from __future__ import annotations

import os
import re
import resource
import signal
import traceback
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from express50.errors import Express50Error
from tests.fuzz.seeds import READERS, write_seeds

CASES = 20
SECONDS = 60
ADDRESSES = 4 << 30  # bytes that a child may ask for beyond what it has
WORDS = [b"NaN", b"1e999", b"-1", b"9" * 400, b"null", b'""', b"[" * 3000, b'"../../../etc/passwd"',
         b"{}", b"0", b"\x00", b"\xff", b"2147483647", b"\n\n"]  # fmt: skip
HUGE = [b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x7f\xff\xff\xff", b"\xff" * 8]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Change one to three places: bits, lengths, words; cut, drop or repeat a part."""
    for _ in range(rng.integers(1, 4)):
        # Half of the places lie in the header, where the sizes are.
        span = len(data) if rng.random() < 0.5 else min(len(data), 256)
        at, length = int(rng.integers(0, max(span, 1))), int(rng.integers(1, 65))
        match rng.choice(["flip", "cut", "drop", "repeat", "zero", "huge", "word", "word"]):
            case "flip":
                flipped = bytes(byte ^ (1 << int(rng.integers(8))) for byte in data[at : at + 1])
                data = data[:at] + flipped + data[at + 1 :]
            case "cut":
                data = data[:at]
            case "drop":
                data = data[:at] + data[at + length :]
            case "repeat":
                data = data[:at] + data[at : at + length] + data[at:]
            case "zero":
                data = data[:at] + bytes(length) + data[at + length :]
            case "huge":
                field = HUGE[rng.integers(len(HUGE))]
                data = data[:at] + field + data[at + len(field) :]
            case "word":
                found = list(re.finditer(rb'"[^"\n]*"|[\w.+-]+', data[: 1 << 16]))
                place = found[rng.integers(len(found))].span() if found else (at, at)
                data = data[: place[0]] + WORDS[rng.integers(len(WORDS))] + data[place[1] :]
    return data


def in_child(work: Callable[[], str]) -> str:
    """Return what work says in a forked child, or how the child ended."""
    source, sink = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(source)
        signal.alarm(SECONDS)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * os.sysconf("SC_PAGE_SIZE") + ADDRESSES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        try:
            os.write(sink, work().encode()[:4000])
        finally:
            os._exit(0)
    os.close(sink)
    with os.fdopen(source, "rb") as pipe:
        said = pipe.read().decode(errors="replace")
    _, status = os.waitpid(child, 0)
    return said if status == 0 else f"ended by signal {status & 0x7F}"


def read_mutations(root: Path, name: str, read: Callable[[Path], object]) -> str:
    """Read every mutation; return what went wrong, or how many were refused."""
    path, refused = root / name, 0
    valid = path.read_bytes()
    read(root)
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    for number in range(CASES):
        path.write_bytes(mutate(valid, rng))
        try:
            read(root)
        except Express50Error as error:
            refused += 1
            if "\n" in str(error):
                return f"case {number}: an error of several lines: {error}"
        except Exception:  # noqa: BLE001  any other is what this test looks for
            return f"case {number}: {traceback.format_exc()[-3000:]}"
    return f"{refused} refused"


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("seeds")
    write_seeds(root)
    return root


@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_read_or_refused(seeds: Path, name: str) -> None:
    valid = (seeds / name).read_bytes()
    try:
        said = in_child(lambda: read_mutations(seeds, name, READERS[name]))
    finally:
        (seeds / name).write_bytes(valid)
        for journal in seeds.glob(f"{name}-*"):  # SQLite's
            journal.unlink()
    assert re.fullmatch(r"\d+ refused", said), said
