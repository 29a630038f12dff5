"""Whether a JPEG file was cut short: decoders fill what is missing with grey and say nothing."""

from __future__ import annotations

import mmap
from pathlib import Path

START, SCAN, END = b"\xff\xd8", 0xDA, b"\xff\xd9"


def cut_short(data: bytes | mmap.mmap) -> bool:
    """Whether a JPEG's bytes stop before its end marker; False of what is no JPEG.

    Thumbnails in the header have end markers of their own, and some cameras write more after the
    picture's: so it is looked for behind the first scan's header. In a scan 0xFF is always followed
    by a byte that says what it is (ITU-T T.81, B.1.1.5), so that nothing else looks like it.
    """
    if data[:2] != START:
        return False
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == SCAN:
            return data.find(END, position) < 0
    return True


def file_cut_short(path: Path) -> bool:
    """`cut_short` of a file that can be opened, without reading it whole; False of an empty one."""
    with path.open("rb") as file:
        if file.read(2) != START:
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return cut_short(data)
