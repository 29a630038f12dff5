"""Pictures as text: each cell shows two colours split by the block character that fits best.

A half block gives a cell 1 x 2 pixels; the quadrants give it 2 x 2, of which each takes one of the
cell's two colours, whichever split loses least. Nothing here knows of a widget.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from rich.color import Color
from rich.color_triplet import ColorTriplet
from rich.segment import Segment
from rich.style import Style
from textual.strip import Strip

# Pixels of a cell in the order top left, top right, bottom left, bottom right; 1 is foreground.
_SPLITS = np.array(
    [
        [1, 1, 0, 0], [1, 0, 1, 0], [1, 0, 0, 1], [1, 0, 0, 0],
        [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1],
    ],
    np.float32,
)  # fmt: skip
_GLYPHS = np.array(list("▀▌▚▘▝▖▗"))
# A quadrant must be this much better than the plain half block, so that flat parts stay calm.
_QUADRANT_GAIN = 1.02
_STEP = 8  # colours are kept in steps of 8: fewer styles, fewer bytes over ssh


def cell_colours(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Block characters of a picture.

    Args:
        picture: (2 h, w, 3) uint8 for half blocks or (2 h, 2 w, 3) for quadrants; which of the two
            it is is told by ``across``, the pixels of a cell.

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


def half_colours(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As ``cell_colours`` for a picture (2 h, w, 3): upper half blocks only."""
    front, back = _to_step(picture[0::2]), _to_step(picture[1::2])
    return np.full(front.shape[:2], "▀"), front, back


def _to_step(colours: np.ndarray) -> np.ndarray:
    """Colours rounded to the steps that are kept, the brightest to white."""
    level = np.rint(np.asarray(colours, np.float32) / _STEP)
    return np.minimum(level * _STEP, 255).astype(np.uint8)


def to_256(colours: np.ndarray) -> np.ndarray:
    """Colours (..., 3) uint8 moved to the cube and greys that a 256-colour terminal has."""
    levels = np.array([0, 95, 135, 175, 215, 255])
    bounds = (levels[1:] + levels[:-1]) / 2
    cube = levels[np.searchsorted(bounds, colours)]
    grey = colours.astype(np.float32).mean(-1, keepdims=True)
    ramp = np.clip(np.rint((grey - 8) / 10) * 10 + 8, 8, 238).repeat(3, -1)
    wanted = colours.astype(np.float32)
    nearer = ((ramp - wanted) ** 2).sum(-1) < ((cube - wanted) ** 2).sum(-1)
    return np.where(nearer[..., None], ramp, cube).astype(np.uint8)


def picture_strips(picture: np.ndarray, quadrants: bool = True, few: bool = False) -> list[Strip]:
    """Lines of text that show a picture.

    Args:
        picture: (2 h, 2 w, 3) uint8 for quadrants, (2 h, w, 3) for half blocks.
        quadrants: use the quadrant characters.
        few: the terminal has 256 colours only.
    """
    glyphs, front, back = cell_colours(picture) if quadrants else half_colours(picture)
    if few:
        front, back = to_256(front), to_256(back)
    weights = np.array([1 << 16, 1 << 8, 1])
    pairs = ((front.astype(np.int64) @ weights) << 24) | (back.astype(np.int64) @ weights)
    return [_line(g, p) for g, p in zip(glyphs, pairs, strict=True)]


def _line(glyphs: np.ndarray, pairs: np.ndarray) -> Strip:
    """One line; neighbours of the same two colours share a segment."""
    starts = np.flatnonzero(np.diff(pairs, prepend=pairs[0] ^ 1))
    text = "".join(glyphs)
    ends = [*starts[1:].tolist(), len(text)]
    colours = pairs[starts].tolist()
    begins = starts.tolist()
    segments = [
        Segment(text[a:b], _style(c)) for a, b, c in zip(begins, ends, colours, strict=True)
    ]
    return Strip(segments, len(text))


@lru_cache(maxsize=1 << 16)
def _style(pair: int) -> Style:
    return Style.from_color(_colour(pair >> 24), _colour(pair & 0xFFFFFF))


@lru_cache(maxsize=1 << 15)
def _colour(value: int) -> Color:
    return Color.from_triplet(ColorTriplet(value >> 16, value >> 8 & 255, value & 255))
