"""Pictures as sixels, the DEC graphics that WezTerm, foot, iTerm2 and others draw.

Format: DEC VT330/VT340 Programmer Reference, volume 2, chapter 14. A sixel is a column of six
pixels of one colour; each band of six rows is written once for every colour that it holds.
"""

from __future__ import annotations

import numpy as np

COLOURS = 64  # 38 dB on a face; 128 give 41 dB and take half as long again
_BAND = 6


def encode_sixel(picture: np.ndarray) -> str:
    """A picture (H, W, 3) uint8 as one escape sequence that draws it at the cursor."""
    height, width = picture.shape[:2]
    palette, numbers = quantise(picture)
    percent = np.rint(palette * (100 / 255)).astype(int)
    table = "".join(f"#{n};2;{r};{g};{b}" for n, (r, g, b) in enumerate(percent.tolist()))
    bands = "-".join(_bands(numbers, len(palette)))
    return f'\x1bP0;1;0q"1;1;{width};{height}{table}{bands}\x1b\\'


def quantise(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most COLOURS colours (N, 3) float and the number of each pixel's, (H, W) uint8.

    Median cut (P. Heckbert, Color image quantization for frame buffer display, 1982) over colours
    of five bits a channel: the box with most pixels times its longest side is halved at its median.
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
    """Boxes of colours, each the rows of ``cells`` (N, 3) in it."""
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
    """How much a box gains by being halved; 0 for a single colour."""
    return float(np.ptp(cells, axis=0).max()) * float(counts.sum()) if len(cells) > 1 else 0.0


def _bands(numbers: np.ndarray, colours: int) -> list[str]:
    """The bands' text: for each colour its number and sixels, ``$`` going back to the left."""
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
    """Sixels of each row (N, W), runs of four and more as ``!count``; no blanks at the end."""
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
    """The text of each run; equal runs are written once and looked up."""
    known, places = np.unique(lengths.astype(np.int64) << 8 | letters, return_inverse=True)
    runs = ((code >> 8, chr((code & 255) + 63)) for code in known.tolist())
    texts = [f"!{n}{letter}" if n > 3 else letter * n for n, letter in runs]
    return [texts[place] for place in places.tolist()]
