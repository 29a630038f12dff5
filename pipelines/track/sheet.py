"""A look at a whole track on one page: every expression's overlay, every camera's residual."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from express50.files.images import fit_into, write_image

TILE, COLUMNS = 192, 8
BAND, BAR = 20, 18  # heights of a tile's words and of a camera's row, pixels
ODD = 1.5  # times the median: such residuals are drawn in ALARM
PLAIN, ALARM, GROUND, DIM = (225, 225, 225), (255, 120, 90), 24, (110, 160, 210)
Table = Mapping[str, Mapping[str, float]]


def write_sheet(folder: Path, tiles: Mapping[str, np.ndarray], table: Table) -> None:
    """Write sheet.jpg: one overlay an expression and one bar a camera.

    Args:
        folder: target.
        tiles: expression to its overlay (H, W, 3) uint8, as ``draw_overlays`` returns them.
        table: expression to camera to RMS of its landmarks, pixels (``landmark_rms_px``).
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = [contact_sheet(tiles, expression_residuals(table)), camera_bars(table)]
    width = max(part.shape[1] for part in parts)
    padded = [
        np.pad(part, ((0, 0), (0, width - part.shape[1]), (0, 0)), constant_values=GROUND)
        for part in parts
    ]
    write_image(folder / "sheet.jpg", np.concatenate(padded), quality=90)


def expression_residuals(table: Table) -> dict[str, float]:
    """RMS pixels of every expression that has landmarks, its cameras counted alike."""
    return {name: _rms(row.values()) for name, row in table.items() if row}


def camera_residuals(table: Table) -> dict[str, tuple[float, int]]:
    """RMS pixels of every camera over its expressions, and how many those are; sorted by id."""
    found: dict[str, list[float]] = {}
    for row in table.values():
        for camera, value in row.items():
            found.setdefault(camera, []).append(value)
    return {camera: (_rms(found[camera]), len(found[camera])) for camera in sorted(found)}


def contact_sheet(
    tiles: Mapping[str, np.ndarray], residuals: Mapping[str, float] | None = None
) -> np.ndarray:
    """One picture (H, W, 3) uint8 of all expressions, each named and with its residual.

    Args:
        tiles: expression to its overlay (h, w, 3) uint8.
        residuals: expression to RMS pixels; those far above the median stand out.
    """
    known = residuals or {}
    limit = ODD * float(np.median(list(known.values()))) if known else math.inf
    cells = [_cell(name, image, known.get(name), limit) for name, image in tiles.items()]
    columns = min(COLUMNS, max(1, math.ceil(math.sqrt(1.6 * len(cells)))))
    blank = np.full((TILE + BAND, TILE, 3), GROUND, np.uint8)
    cells += [blank] * (-len(cells) % columns or (0 if cells else columns))
    rows = [np.concatenate(cells[k : k + columns], 1) for k in range(0, len(cells), columns)]
    return np.concatenate(rows)


def _cell(name: str, image: np.ndarray, residual: float | None, limit: float) -> np.ndarray:
    """A tile with a band of words below."""
    cell = np.full((TILE + BAND, TILE, 3), GROUND, np.uint8)
    cell[:TILE] = fit_into(image, TILE, TILE)
    colour = ALARM if residual is not None and residual > limit else PLAIN
    value = "no landmarks" if residual is None else f"{residual:.2f} px"
    room = TILE - 10 - _words(cell, value, TILE - 4, TILE + 14, colour, right=True)
    while len(name) > 1 and _width(name) > room:
        name = name[:-1]
    _words(cell, name, 4, TILE + 14, colour)
    return cell


def camera_bars(table: Table) -> np.ndarray:
    """Bar chart (H, W, 3) uint8: RMS pixels of each camera, with how many expressions it saw."""
    rows = camera_residuals(table)
    values = [value for value, _ in rows.values()]
    limit = ODD * float(np.median(values)) if values else math.inf
    left, length = 16 + max(map(_width, rows), default=0), 2 * TILE
    chart = np.full((BAR * (len(rows) + 1) + 8, left + length + 190, 3), GROUND, np.uint8)
    title = "landmark residual by camera, RMS px" if rows else "no camera has landmarks"
    _words(chart, title, 6, 14, PLAIN)
    scale = length / max([*values, 1e-9])
    for k, (camera, (value, count)) in enumerate(rows.items(), 1):
        y = BAR * k
        odd = value > limit
        _words(chart, camera, 6, y + 14, ALARM if odd else PLAIN)
        end = left + max(1, round(value * scale))
        cv2.rectangle(chart, (left, y + 4), (end, y + 14), ALARM if odd else DIM, -1)
        words = f"{value:.2f}  ({count} expression{'s' if count > 1 else ''})"
        _words(chart, words, end + 6, y + 14, PLAIN)
    return chart


def _words(
    image: np.ndarray, text: str, x: int, y: int, colour: tuple[int, int, int], right: bool = False
) -> int:
    """Write words with their baseline at (x, y), or ending there; returns their width."""
    width = _width(text)
    place = (x - width if right else x, y)
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    return width


def _width(text: str) -> int:
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)[0][0]


def _rms(values: object) -> float:
    return float(np.sqrt(np.mean(np.square(np.fromiter(values, float)))))  # type: ignore[call-overload]
