"""Draw pictures as lines of the terminal: block characters in any terminal, or sixels.

A half block gives a cell 1 x 2 pixels. Quadrants give it 2 x 2, each in one of the cell's two
colours, split so that the error is least. Sixels are the DEC graphics that xterm, WezTerm, foot and
iTerm2 draw (DEC VT330/VT340 Programmer Reference, volume 2, chapter 14): a sixel is a column of six
pixels of one colour, and each band of six rows is written once per colour in it.
"""

from __future__ import annotations

import contextlib
import fcntl
import re
import struct
import sys
import termios
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from PIL import Image
from rich.color import Color
from rich.color_triplet import ColorTriplet
from rich.segment import ControlType, Segment
from rich.style import Style
from textual.geometry import Size
from textual.strip import Strip

from annotations.ui import theme
from express50.errors import AnnotationError

KEPT = 32  # painted pictures that are kept for going back and forth
SIXEL_PIXELS = 480 * 540  # sixels are shown at their own size; more would take too long to send
COLOURS = 96  # of a sixel picture: 34 dB on a textured face; 128 give 36 dB

# Pixels of a cell in the order top left, top right, bottom left, bottom right; 1 is foreground.
_SPLITS = np.array(
    [
        [1, 1, 0, 0], [1, 0, 1, 0], [1, 0, 0, 1], [1, 0, 0, 0],
        [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1],
    ],
    np.float32,
)  # fmt: skip
_GLYPHS = np.array(list("▀▌▚▘▝▖▗"))
# A quadrant must beat the plain half block by this much, so that flat areas do not flicker.
_QUADRANT_GAIN = 1.02
_STEP = 8  # colours are rounded to steps of 8: fewer styles, fewer bytes over ssh
_BAND = 6


class PaneShape(NamedTuple):
    """A picture's size in cells, the pixels of each cell, and a cell's height over width."""

    columns: int
    rows: int
    across: int
    down: int
    cell_aspect: float = 2.0  # a character cell is about twice as high as wide


def cell_size() -> Size:
    """Ask the terminal's driver for a cell's pixels; AnnotationError if it does not know them."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        terminal = sys.__stdout__.fileno()  # type: ignore[union-attr]
        answer = fcntl.ioctl(terminal, termios.TIOCGWINSZ, bytes(8))
        rows, columns, width, height = struct.unpack("4H", answer)
        if min(rows, columns) > 0 and width >= columns and height >= rows:
            return Size(width // columns, height // rows)
    raise AnnotationError(
        "--pictures sixel: the terminal does not report the pixel size of a cell;"
        " use --pictures blocks"
    )


class Painter:
    """Paints pictures as large as a pane allows, and keeps the last ones as lines.

    Pictures are block characters in two colours, which any terminal in UTF-8 has.
    """

    def __init__(self) -> None:
        # The lines that show a crop in a pane of that size; ``read`` gives the crop's pixels.
        self.strips = lru_cache(maxsize=KEPT)(lambda crop, pane, read: self.paint(pane, read(crop)))

    def shape(self, pane: Size) -> PaneShape:
        """Return the picture's shape in a pane of this size in cells: four pixels per cell."""
        return PaneShape(max(1, pane.width), max(1, pane.height), 2, 2)

    def paint(self, pane: Size, picture: np.ndarray) -> list[Strip]:
        """Return the lines of the pane that show a picture (2 h, 2 w, 3) uint8 of `shape`."""
        glyphs, front, back = cell_colours(picture)
        weights = np.array([1 << 16, 1 << 8, 1])
        pairs = ((front.astype(np.int64) @ weights) << 24) | (back.astype(np.int64) @ weights)
        lines = []
        for text, row in zip(map("".join, glyphs), pairs, strict=True):
            starts = np.flatnonzero(np.diff(row, prepend=row[0] ^ 1))
            colours, begins = row[starts].tolist(), starts.tolist()
            # Neighbours of the same two colours share a segment.
            runs = zip(begins, [*begins[1:], len(text)], colours, strict=True)
            lines.append(Strip([Segment(text[a:b], _style(c)) for a, b, c in runs], len(text)))
        return lines


class SixelPainter(Painter):
    """Paints sixels, drawn after the pane's last line."""

    def __init__(self, cell: Size) -> None:
        super().__init__()
        self._cell = cell

    def shape(self, pane: Size) -> PaneShape:
        """Return the full pane, or its middle if the pane has more pixels than the limit."""
        cells = self._cell.width * self._cell.height
        share = min(1.0, (SIXEL_PIXELS / (max(1, pane.area) * cells)) ** 0.5)
        columns, rows = (max(1, int(side * share)) for side in pane)
        return PaneShape(columns, rows, *self._cell, self._cell.height / self._cell.width)

    def paint(self, pane: Size, picture: np.ndarray) -> list[Strip]:
        """Return blank lines, the last of which draws the picture over all of them."""
        shape = self.shape(pane)
        left, top = (pane.width - shape.columns) // 2, (pane.height - shape.rows) // 2
        up, back = pane.height - 1 - top, pane.width - left
        # Text written over sixels erases them, so they follow the pane's last cell: save the
        # cursor, go to the picture's corner, draw, and return.
        there = (f"\x1b[{up}A" if up > 0 else "") + (f"\x1b[{back}D" if back > 0 else "")
        words = f"\x1b7{there}{encode_sixel(picture)}\x1b8"
        drawing = Segment(words, None, [(ControlType.CURSOR_FORWARD, 0)])
        blank = Strip.blank(pane.width, theme.PLAIN)
        last = Strip([*blank, drawing], pane.width)
        return [blank] * (pane.height - 1) + [last]


def cell_colours(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose the block character and two colours of each cell, of a picture (2 h, 2 w, 3) uint8.

    Glyphs (h, w) are strings of one character; foreground and background (h, w, 3) are uint8.
    """
    rows, columns = picture.shape[0] // 2, picture.shape[1] // 2
    cells = picture.reshape(rows, 2, columns, 2, 3).transpose(0, 2, 1, 3, 4)
    cells = cells.reshape(rows, columns, 4, 3).astype(np.float32)
    total = cells.sum(2)
    front = np.tensordot(_SPLITS, cells, axes=(1, 2))  # (splits, rows, columns, 3)
    back = total - front
    inside = _SPLITS.sum(1)[:, None, None]
    # The squared error that is left is a constant minus this.
    kept = (front**2).sum(-1) / inside + (back**2).sum(-1) / (4 - inside)
    spread = kept - (total**2).sum(-1) / 4
    spread[0] *= _QUADRANT_GAIN
    best = spread.argmax(0)
    inside = _SPLITS.sum(1)[best][..., None]
    front = np.take_along_axis(front, best[None, ..., None], 0)[0]
    return _GLYPHS[best], _to_step(front / inside), _to_step((total - front) / (4 - inside))


def _to_step(colours: np.ndarray) -> np.ndarray:
    """Round colours to the steps that are kept, the brightest to white."""
    level = np.rint(np.asarray(colours, np.float32) / _STEP)
    return np.minimum(level * _STEP, 255).astype(np.uint8)


@lru_cache(maxsize=1 << 16)
def _style(pair: int) -> Style:
    """Return the style of a foreground and a background, 24 bits each."""
    return Style.from_color(_colour(pair >> 24), _colour(pair & 0xFFFFFF))


@lru_cache(maxsize=1 << 15)  # all there are
def _colour(value: int) -> Color:
    return Color.from_triplet(ColorTriplet(value >> 16, value >> 8 & 255, value & 255))


def encode_sixel(picture: np.ndarray) -> str:
    """Encode a picture (H, W, 3) uint8 as one escape sequence that draws it at the cursor."""
    height, width = picture.shape[:2]
    palette, numbers = quantise(picture)
    percent = np.rint(palette * (100 / 255)).astype(int)
    table = "".join(f"#{n};2;{r};{g};{b}" for n, (r, g, b) in enumerate(percent.tolist()))
    bits = np.zeros((-(-height // _BAND), len(palette), width), np.uint8)
    columns = np.arange(width)
    for row in range(height):
        # Columns differ, so that no place is written twice in one assignment.
        bits[row // _BAND, numbers[row], columns] |= np.uint8(1 << row % _BAND)
    bands = []
    for band in bits:  # for each colour its number and sixels; "$" goes back to the left
        used = np.flatnonzero(band.any(1))
        texts = [row.tobytes().decode().rstrip("?") for row in band[used] + np.uint8(63)]
        bands.append("$".join(f"#{n}{text}" for n, text in zip(used, texts, strict=True)))
    runs = re.sub(r"([?-~])\1{3,}", lambda run: f"!{len(run[0])}{run[1]}", "-".join(bands))
    return f'\x1bP0;1;0q"1;1;{width};{height}{table}{runs}\x1b\\'


def quantise(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a picture to COLOURS colours (N, 3) and each pixel's number (H, W) uint8."""
    reduced = Image.fromarray(picture).quantize(
        COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
    )
    return np.array(reduced.getpalette()).reshape(-1, 3), np.asarray(reduced)
