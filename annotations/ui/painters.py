"""From pictures to lines of the terminal: as characters, by kitty's protocol, or as sixels."""

from __future__ import annotations

import itertools
import random
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from rich.segment import ControlType, Segment
from textual.geometry import Size
from textual.strip import Strip

from annotations.ui import kitty, theme
from annotations.ui.blocks import picture_strips
from annotations.ui.frames import Shot
from annotations.ui.sixel import encode_sixel
from annotations.ui.terminal import CellSize

KEPT = 32  # pictures kept as text, for going to and fro
# Pixels of a picture that is sent. kitty brings it to its size, and a face in a proxy has no more;
# sixels are shown as they are, so that fewer would be a smaller picture.
KITTY_PIXELS, SIXEL_PIXELS = 400 * 400, 480 * 540
_USUAL_CELL = CellSize(8, 16)
_LEAST_NUMBER = 1 << 16  # below it other programs in the same terminal count up


class PaneShape(NamedTuple):
    """A picture's size in cells, the pixels of each of them, and a cell's height over width."""

    columns: int
    rows: int
    across: int
    down: int
    cell_aspect: float = 2.0  # a character cell is about twice as high as wide


class Painter(ABC):
    """Paints pictures that fill a pane as far as they can, and keeps the last ones as lines."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[Shot, Size], list[Strip]] = OrderedDict()

    @abstractmethod
    def shape(self, pane: Size) -> PaneShape:
        """The picture's shape in a pane of so many cells."""

    @abstractmethod
    def _paint(self, shot: Shot, pane: Size, picture: np.ndarray) -> list[Strip]:
        """The lines of the pane."""

    def _leave(self, shot: Shot, pane: Size) -> None:  # noqa: B027 - most have nothing to free
        """A picture is not kept any longer."""

    def strips(self, shot: Shot, pane: Size, read: Callable[[Shot], np.ndarray]) -> list[Strip]:
        """The lines that show a shot; ``read`` gives its picture (height, width, 3) uint8."""
        key = shot, pane
        if key not in self._kept:
            self._kept[key] = self._paint(shot, pane, read(shot))
        self._kept.move_to_end(key)
        while len(self._kept) > KEPT:
            self._leave(*self._kept.popitem(last=False)[0])
        return self._kept[key]


class BlockPainter(Painter):
    """Block characters in two colours; any terminal has them."""

    def __init__(self, quadrants: bool = True) -> None:
        super().__init__()
        self._quadrants = quadrants
        self.few = False  # whether the terminal has 256 colours only

    def shape(self, pane: Size) -> PaneShape:
        """Two or four pixels a cell."""
        return PaneShape(max(1, pane.width), max(1, pane.height), 2 if self._quadrants else 1, 2)

    def _paint(self, shot: Shot, pane: Size, picture: np.ndarray) -> list[Strip]:
        return picture_strips(picture, quadrants=self._quadrants, few=self.few)


class KittyPainter(Painter):
    """Pictures sent by kitty's protocol, shown by placeholder characters.

    Args:
        write: writes to the terminal, in order with what Textual writes.
        numbers: pictures' numbers that no other painter uses.
        cell: pixels of a cell; only their proportion matters.
    """

    def __init__(
        self, write: Callable[[str], None], numbers: Iterator[int], cell: CellSize | None = None
    ) -> None:
        super().__init__()
        self._cell = cell or _USUAL_CELL
        self._write = write
        self._numbers = numbers
        self._sent: dict[tuple[Shot, Size], int] = {}

    def shape(self, pane: Size) -> PaneShape:
        """As many pixels a cell as the limit allows; the terminal brings them to their size."""
        most = len(kitty.diacritics())
        columns, rows = min(max(1, pane.width), most), min(max(1, pane.height), most)
        aspect = self._cell.height / self._cell.width
        sizes = ((n, max(1, int(n * aspect))) for n in range(self._cell.width, 0, -1))
        across, down = next(
            (s for s in sizes if columns * rows * s[0] * s[1] <= KITTY_PIXELS), (1, 1)
        )
        return PaneShape(columns, rows, across, down, aspect)

    def _paint(self, shot: Shot, pane: Size, picture: np.ndarray) -> list[Strip]:
        shape = self.shape(pane)
        number = self._sent[shot, pane] = next(self._numbers)
        self._write(kitty.transmit(number, kitty.encode_png(picture), shape.columns, shape.rows))
        lines = kitty.placeholder_strips(number, shape.columns, shape.rows)
        return [line.adjust_cell_length(pane.width, theme.PLAIN) for line in lines]

    def _leave(self, shot: Shot, pane: Size) -> None:
        self._write(kitty.forget(self._sent.pop((shot, pane))))


class SixelPainter(Painter):
    """Sixels, drawn once the pane's last line is blank."""

    def __init__(self, cell: CellSize | None = None) -> None:
        super().__init__()
        self._cell = cell or _USUAL_CELL

    def shape(self, pane: Size) -> PaneShape:
        """The whole pane, or its middle where that is more pixels than the limit."""
        cells = self._cell.width * self._cell.height
        share = min(1.0, (SIXEL_PIXELS / (max(1, pane.area) * cells)) ** 0.5)
        columns, rows = (max(1, int(side * share)) for side in pane)
        return PaneShape(columns, rows, *self._cell, self._cell.height / self._cell.width)

    def _paint(self, shot: Shot, pane: Size, picture: np.ndarray) -> list[Strip]:
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


def make_painter(
    pictures: str, write: Callable[[str], None], numbers: Iterator[int], cell: CellSize | None
) -> Painter:
    """The painter of a kind: ``blocks``, ``halfblocks``, ``kitty`` or ``sixel``."""
    if pictures == "kitty":
        return KittyPainter(write, numbers, cell)
    if pictures == "sixel":
        return SixelPainter(cell)
    return BlockPainter(pictures == "blocks")


def picture_numbers() -> Iterator[int]:
    """Numbers for kitty's pictures, from a place where other programs' are unlikely."""
    return itertools.count(random.randrange(_LEAST_NUMBER, kitty.MAX_ID >> 1))
