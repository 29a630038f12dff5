"""Pictures as lines of the terminal: block characters in any terminal, or sixels.

A half block gives a cell 1 x 2 pixels; the quadrants give it 2 x 2, of which each takes one of the
cell's two colours, whichever split loses least. Sixels are the DEC graphics that xterm, WezTerm,
foot and iTerm2 draw (DEC VT330/VT340 Programmer Reference, volume 2, chapter 14): a sixel is a
column of six pixels of one colour, and each band of six rows is written once per colour in it.
"""

from __future__ import annotations

import contextlib
import fcntl
import struct
import sys
import termios
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from rich.color import Color
from rich.color_triplet import ColorTriplet
from rich.segment import ControlType, Segment
from rich.style import Style
from textual.geometry import Size
from textual.strip import Strip

from annotations.ui import theme
from annotations.ui.frames import FrameCrop

PICTURES = ("blocks", "sixel")
KEPT = 32  # painted pictures that are kept for going back and forth
SIXEL_PIXELS = 480 * 540  # sixels are shown at their own size; more would take too long to send
COLOURS = 64  # of a sixel picture: 38 dB on a face; 128 give 41 dB in 1.5 times the time

# Pixels of a cell in the order top left, top right, bottom left, bottom right; 1 is foreground.
_SPLITS = np.array(
    [
        [1, 1, 0, 0], [1, 0, 1, 0], [1, 0, 0, 1], [1, 0, 0, 0],
        [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1],
    ],
    np.float32,
)  # fmt: skip
_GLYPHS = np.array(list("▀▌▚▘▝▖▗"))
# A quadrant must be this much better than the plain half block, so that flat areas stay calm.
_QUADRANT_GAIN = 1.02
_STEP = 8  # colours are kept in steps of 8: fewer styles, fewer bytes over ssh
_BAND = 6


class CellSize(NamedTuple):
    """Pixels of a character cell."""

    width: int
    height: int


class PaneShape(NamedTuple):
    """A picture's size in cells, the pixels of each cell, and a cell's height over width."""

    columns: int
    rows: int
    across: int
    down: int
    cell_aspect: float = 2.0  # a character cell is about twice as high as wide


def cell_size() -> CellSize | None:
    """Ask the terminal's driver for the pixels of a cell; None where it does not know them."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        terminal = sys.__stdout__.fileno()  # type: ignore[union-attr]
        answer = fcntl.ioctl(terminal, termios.TIOCGWINSZ, bytes(8))
        rows, columns, width, height = struct.unpack("4H", answer)
        if min(rows, columns) > 0 and width >= columns and height >= rows:
            return CellSize(width // columns, height // rows)
    return None


class Painter(ABC):
    """Paints pictures as large as a pane allows, and keeps the last ones as lines."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[FrameCrop, Size], list[Strip]] = OrderedDict()

    @abstractmethod
    def shape(self, pane: Size) -> PaneShape:
        """Return the picture's shape in a pane of so many cells."""

    @abstractmethod
    def _paint(self, pane: Size, picture: np.ndarray) -> list[Strip]:
        """Return the lines of the pane."""

    def strips(
        self, shot: FrameCrop, pane: Size, read: Callable[[FrameCrop], np.ndarray]
    ) -> list[Strip]:
        """Return the lines that show a crop; ``read`` gives its pixels (height, width, 3) uint8."""
        key = shot, pane
        if key not in self._kept:
            self._kept[key] = self._paint(pane, read(shot))
        self._kept.move_to_end(key)
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return self._kept[key]


class BlockPainter(Painter):
    """Block characters in two colours, which any terminal in UTF-8 has."""

    few = False  # set where the terminal has 256 colours only

    def shape(self, pane: Size) -> PaneShape:
        """Return four pixels per cell."""
        return PaneShape(max(1, pane.width), max(1, pane.height), 2, 2)

    def _paint(self, pane: Size, picture: np.ndarray) -> list[Strip]:
        return picture_strips(picture, self.few)


class SixelPainter(Painter):
    """Sixels, drawn after the pane's last line."""

    def __init__(self, cell: CellSize) -> None:
        super().__init__()
        self._cell = cell

    def shape(self, pane: Size) -> PaneShape:
        """Return the whole pane, or its middle where the pane has more pixels than the limit."""
        cells = self._cell.width * self._cell.height
        share = min(1.0, (SIXEL_PIXELS / (max(1, pane.area) * cells)) ** 0.5)
        columns, rows = (max(1, int(side * share)) for side in pane)
        return PaneShape(columns, rows, *self._cell, self._cell.height / self._cell.width)

    def _paint(self, pane: Size, picture: np.ndarray) -> list[Strip]:
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
    """Choose the block character and the two colours of every cell.

    Args:
        picture: (2 h, 2 w, 3) uint8.

    Returns:
        Glyphs (h, w) as strings of one character, foreground and background (h, w, 3) uint8.
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
    best = spread.argmax(0)[None]
    take = best[..., None]
    inside = np.take_along_axis(np.broadcast_to(inside, spread.shape), best, 0)[0][..., None]
    front = np.take_along_axis(front, take, 0)[0]
    back = total - front
    return _GLYPHS[best[0]], _to_step(front / inside), _to_step(back / (4 - inside))


def _to_step(colours: np.ndarray) -> np.ndarray:
    """Round colours to the steps that are kept, the brightest to white."""
    level = np.rint(np.asarray(colours, np.float32) / _STEP)
    return np.minimum(level * _STEP, 255).astype(np.uint8)


def to_256(colours: np.ndarray) -> np.ndarray:
    """Move colours (..., 3) uint8 to the cube and greys that a 256-colour terminal has."""
    levels = np.array([0, 95, 135, 175, 215, 255])
    bounds = (levels[1:] + levels[:-1]) / 2
    cube = levels[np.searchsorted(bounds, colours)]
    grey = colours.astype(np.float32).mean(-1, keepdims=True)
    ramp = np.clip(np.rint((grey - 8) / 10) * 10 + 8, 8, 238).repeat(3, -1)
    wanted = colours.astype(np.float32)
    nearer = ((ramp - wanted) ** 2).sum(-1) < ((cube - wanted) ** 2).sum(-1)
    return np.where(nearer[..., None], ramp, cube).astype(np.uint8)


def picture_strips(picture: np.ndarray, few: bool = False) -> list[Strip]:
    """Return the lines of text that show a picture.

    Args:
        picture: (2 h, 2 w, 3) uint8.
        few: the terminal has 256 colours only.
    """
    glyphs, front, back = cell_colours(picture)
    if few:
        front, back = to_256(front), to_256(back)
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


@lru_cache(maxsize=1 << 16)
def _style(pair: int) -> Style:
    return Style.from_color(_colour(pair >> 24), _colour(pair & 0xFFFFFF))


@lru_cache(maxsize=1 << 15)
def _colour(value: int) -> Color:
    return Color.from_triplet(ColorTriplet(value >> 16, value >> 8 & 255, value & 255))


def encode_sixel(picture: np.ndarray) -> str:
    """Encode a picture (H, W, 3) uint8 as one escape sequence that draws it at the cursor."""
    height, width = picture.shape[:2]
    palette, numbers = quantise(picture)
    percent = np.rint(palette * (100 / 255)).astype(int)
    table = "".join(f"#{n};2;{r};{g};{b}" for n, (r, g, b) in enumerate(percent.tolist()))
    bands = "-".join(_bands(numbers, len(palette)))
    return f'\x1bP0;1;0q"1;1;{width};{height}{table}{bands}\x1b\\'


def quantise(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a picture to COLOURS colours (N, 3) float and each pixel's number (H, W) uint8.

    Median cut (P. Heckbert, Color image quantization for frame buffer display, 1982) over colours
    of five bits per channel: the box with most pixels times its longest side is halved at its
    median.
    """
    channels = (picture >> 3).astype(np.int32)
    codes = channels[..., 0] << 10 | channels[..., 1] << 5 | channels[..., 2]
    counts = np.bincount(codes.reshape(-1), minlength=1 << 15)
    used = np.flatnonzero(counts)
    cells = np.stack([used >> 10, used >> 5 & 31, used & 31], axis=1)
    means = np.stack(
        [
            np.bincount(codes.reshape(-1), picture[..., c].reshape(-1), 1 << 15)[used]
            for c in range(3)
        ],
        axis=1,
    )
    boxes = _median_cut(cells, counts[used])
    number_of = np.zeros(1 << 15, np.uint8)
    palette = np.empty((len(boxes), 3))
    for number, box in enumerate(boxes):
        number_of[used[box]] = number
        palette[number] = means[box].sum(0) / counts[used[box]].sum()
    return palette, number_of[codes]


def _median_cut(cells: np.ndarray, counts: np.ndarray) -> list[np.ndarray]:
    """Split colours into boxes, each given by its rows of ``cells`` (N, 3)."""
    boxes = [np.arange(len(cells))]
    worth = [_worth(cells, counts)]
    while len(boxes) < COLOURS and max(worth) > 0:
        pick = int(np.argmax(worth))
        box = boxes.pop(pick)
        worth.pop(pick)
        axis = int(np.argmax(np.ptp(cells[box], axis=0)))
        box = box[np.argsort(cells[box, axis], kind="stable")]
        below = np.cumsum(counts[box])
        middle = int(np.searchsorted(below, below[-1] / 2)) + 1
        middle = min(max(middle, 1), len(box) - 1)
        for half in (box[:middle], box[middle:]):
            boxes.append(half)
            worth.append(_worth(cells[half], counts[half]))
    return boxes


def _worth(cells: np.ndarray, counts: np.ndarray) -> float:
    """Rate the gain of halving a box; 0 for a single colour."""
    return float(np.ptp(cells, axis=0).max()) * float(counts.sum()) if len(cells) > 1 else 0.0


def _bands(numbers: np.ndarray, colours: int) -> list[str]:
    """Write the bands: for each colour its number and sixels, ``$`` goes back to the left."""
    height, width = numbers.shape
    count = -(-height // _BAND)
    bits = np.zeros((count, colours, width), np.uint8)
    columns = np.arange(width)
    for row in range(height):
        # Columns differ, so that no place is written twice in one assignment.
        bits[row // _BAND, numbers[row], columns] |= np.uint8(1 << row % _BAND)
    band, colour = np.nonzero(bits.any(2))
    parts: list[list[str]] = [[] for _ in range(count)]
    for place, number, text in zip(
        band.tolist(), colour.tolist(), _packed(bits[band, colour]), strict=True
    ):
        parts[place].append(f"#{number}{text}")
    return ["$".join(part) for part in parts]


def _packed(rows: np.ndarray) -> list[str]:
    """Write the sixels of each row (N, W), long runs as ``!count``, without blanks at the end."""
    begins = np.ones(rows.shape, bool)
    begins[:, 1:] = rows[:, 1:] != rows[:, :-1]
    starts = np.flatnonzero(begins)
    letters = rows.reshape(-1)[starts]
    lengths = np.diff(starts, append=rows.size)
    owners = starts // rows.shape[1]
    last = np.append(owners[1:] != owners[:-1], True)
    kept = ~(last & (letters == 0))
    pieces = _pieces(letters[kept], lengths[kept])
    ends = np.searchsorted(owners[kept], np.arange(len(rows)), side="right").tolist()
    return ["".join(pieces[a:b]) for a, b in zip([0, *ends], ends, strict=False)]


def _pieces(letters: np.ndarray, lengths: np.ndarray) -> list[str]:
    """Write the text of each run; equal runs are written once and looked up."""
    known, places = np.unique(lengths.astype(np.int64) << 8 | letters, return_inverse=True)
    runs = ((code >> 8, chr((code & 255) + 63)) for code in known.tolist())
    texts = [f"!{n}{letter}" if n > 3 else letter * n for n, letter in runs]
    return [texts[place] for place in places.tolist()]
