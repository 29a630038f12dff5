"""Pictures by kitty's graphics protocol, shown through placeholder characters.

The picture is sent once under a number; the cells that show it hold U+10EEEE with two diacritics
for row and column, and the number as their colour. To everything between here and the screen that
is text: it scrolls, is covered by dialogs and is drawn in parts like any other.

Source: "Terminal graphics protocol", kitty's documentation, section "Unicode placeholders".
"""

from __future__ import annotations

import base64
from functools import lru_cache

import numpy as np
from rich.color import Color
from rich.segment import Segment
from rich.style import Style
from textual.strip import Strip

from annotations.ui import theme

PLACEHOLDER = "\U0010eeee"
MAX_ID = (1 << 24) - 1  # what a colour can hold
_CHUNK = 4096  # base64 letters of a message, kitty's limit
# kitty's table of diacritics for rows and columns: number n is the n-th of these characters.
_DIACRITICS = """
305 30d-30e 310 312 33d-33f 346 34a-34c 350-352 357 35b 363-36f 483-487 592-595 597-599 59c-5a1
5a8-5a9 5ab-5ac 5af 5c4 610-617 657-65b 65d-65e 6d6-6dc 6df-6e2 6e4 6e7-6e8 6eb-6ec 730 732-733
735-736 73a 73d 73f-741 743 745 747 749-74a 7eb-7f1 7f3 816-819 81b-823 825-827 829-82d 951 953-954
f82-f83 f86-f87 135d-135f 17dd 193a 1a17 1a75-1a7c 1b6b 1b6d-1b73 1cd0-1cd2 1cda-1cdb 1ce0
1dc0-1dc1 1dc3-1dc9 1dcb-1dcc 1dd1-1de6 1dfe 20d0-20d1 20d4-20d7 20db-20dc 20e1 20e7 20e9 20f0
2cef-2cf1 2de0-2dff a66f a67c-a67d a6f0-a6f1 a8e0-a8f1 aab0 aab2-aab3 aab7-aab8 aabe-aabf aac1
fe20-fe26 10a0f 10a38 1d185-1d189 1d1aa-1d1ad 1d242-1d244
"""


@lru_cache(maxsize=1)
def diacritics() -> str:
    """The characters that stand for the numbers 0, 1, 2, ... of rows and columns."""
    ranges = [[int(end, 16) for end in part.split("-")] for part in _DIACRITICS.split()]
    return "".join(chr(code) for ends in ranges for code in range(ends[0], ends[-1] + 1))


def transmit(number: int, png: bytes, columns: int, rows: int) -> str:
    """The messages that send a PNG under a number, to be shown in so many cells.

    The terminal fits it into the cells without distorting it and answers nothing (``q=2``).
    """
    text = base64.b64encode(png).decode()
    chunks = [text[at : at + _CHUNK] for at in range(0, len(text), _CHUNK)]
    head = f"a=T,U=1,f=100,t=d,i={number},c={columns},r={rows},q=2,"
    messages = []
    for place, chunk in enumerate(chunks):
        more = int(place + 1 < len(chunks))
        messages.append(f"\x1b_G{head if place == 0 else 'q=2,'}m={more};{chunk}\x1b\\")
    return "".join(messages)


def forget(number: int) -> str:
    """The message that removes a picture and frees its memory."""
    return f"\x1b_Ga=d,d=I,i={number},q=2\x1b\\"


def placeholder_strips(number: int, columns: int, rows: int) -> list[Strip]:
    """Lines of cells that show a picture; at most as many as there are diacritics."""
    signs = diacritics()
    columns, rows = min(columns, len(signs)), min(rows, len(signs))
    colour = Color.from_rgb(number >> 16, number >> 8 & 255, number & 255)
    style = Style.from_color(colour, theme.PLAIN.bgcolor)
    return [
        Strip([Segment("".join(PLACEHOLDER + signs[y] + signs[x] for x in range(columns)), style)],
              columns)
        for y in range(rows)
    ]  # fmt: skip


def encode_png(picture: np.ndarray) -> bytes:
    """PNG of a picture (H, W, 3) uint8; quick rather than small."""
    import cv2

    flags = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return cv2.imencode(".png", picture[..., ::-1], flags)[1].tobytes()
