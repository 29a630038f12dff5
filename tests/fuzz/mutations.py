"""Hostile variants of a valid file: bits flipped, ends cut, parts moved, sizes made huge."""

from __future__ import annotations

import re
import struct
import zlib

from hypothesis import given, settings
from hypothesis import strategies as st

Steps = list[tuple[str, int, int]]

KINDS = ("flip", "byte", "cut", "drop", "copy", "huge", "huge", "zero", "word", "word", "number")
# What a length field, a shape or an offset is set to, of 1 to 8 bytes in both byte orders.
HUGE = [
    struct.pack(f"{order}{code}", value)
    for code, values in (("B", (255,)), ("H", (65535, 32767)), ("I", (2**32 - 1, 2**31 - 1, 2**28)),
                         ("Q", (2**64 - 1, 2**63 - 1, 2**40)))
    for value in values
    for order in "<>"
]  # fmt: skip
WORDS = [
    b"NaN", b"1e999", b"-1", b"9" * 5000, b"9" * 400, b"null", b"true", b'""', b"[" * 5000,
    b'{"a":' * 5000, b'"../../../etc/passwd"', b'"/dev/zero"', b"{}", b"[]", b"0", b"\x00", b"\xff",
    b"- " * 5000, b"2147483647", b"99999999999", b'"\\u0000"', "²".encode(), b"\n\n",
]  # fmt: skip


def draw_steps(count: int) -> list[Steps]:
    """So many lists of one to three steps, the same on every run."""
    step = st.tuples(st.sampled_from(KINDS), st.integers(0, 2**16), st.integers(0, 2**16))
    found: list[Steps] = []

    @settings(max_examples=count, derandomize=True, deadline=None, database=None)
    @given(st.lists(step, min_size=1, max_size=3))
    def collect(steps: Steps) -> None:
        found.append(steps)

    collect()
    return found


def mutate(data: bytes, steps: Steps, salt: str) -> bytes:
    """The file after the steps; ``salt`` moves their places, so that readers see different ones."""
    for number, (kind, place, choice) in enumerate(steps):
        mixed = zlib.crc32(f"{salt} {number} {place} {choice}".encode())
        # Half of the places lie in the header, where the sizes are.
        span = len(data) if mixed % 2 else min(len(data), 256)
        data = _step(data, kind, (mixed >> 1) % max(span, 1), mixed >> 8)
    return data


def _step(data: bytes, kind: str, at: int, choice: int) -> bytes:
    length = 1 + choice % 64
    match kind:
        case "flip":
            turned = bytes(b ^ (1 << choice % 8) for b in data[at : at + 1])
            return data[:at] + turned + data[at + 1 :]
        case "byte":
            return data[:at] + bytes([choice % 256]) + data[at + 1 :]
        case "cut":
            return data[:at]
        case "drop":
            return data[:at] + data[at + length :]
        case "copy":
            source = choice % max(len(data), 1)
            return data[:at] + data[source : source + length] + data[at:]
        case "zero":
            return data[:at] + bytes(length) + data[at + length :]
        case "huge":
            field = HUGE[choice % len(HUGE)]
            return data[:at] + field + data[at + len(field) :]
        case "number":
            return _replace(data, rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", at, choice)
        case _:
            return _replace(data, rb'"[^"\n]*"|[\w.+-]+', at, choice)


def _replace(data: bytes, pattern: bytes, at: int, choice: int) -> bytes:
    """A text with one of its words or numbers replaced."""
    found = list(re.finditer(pattern, data[: 1 << 16]))
    if not found:
        return data[:at] + WORDS[choice % len(WORDS)] + data[at:]
    word = found[at % len(found)]
    return data[: word.start()] + WORDS[choice % len(WORDS)] + data[word.end() :]
