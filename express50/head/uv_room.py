"""Room for new charts on a texture map: rectangles that no triangle of it touches."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from express50.errors import HeadModelError

GRID = 512  # cells a side of the search
GUTTER = 3  # cells kept free around a chart, so that neighbours do not bleed into each other
SHRINK, LEAST = 0.9, 0.15  # of the wanted size: what is tried next, and the smallest taken


def place_charts(
    uv: np.ndarray, uv_faces: np.ndarray, sizes: Sequence[tuple[float, float]], name: str
) -> tuple[np.ndarray, ...]:
    """Free rectangles (left, bottom, right, top), one a wanted (width, height) on the unit square.

    Each is shrunk until it fits; the first free place from the top of the map is taken.

    Args:
        uv: (T, 2), v up.
        uv_faces: (F, 3).
        sizes: wanted sizes, the most important first.
        name: of the head model, for errors.

    Raises:
        HeadModelError: there is no room for one of them at LEAST of its size.
    """
    taken = covered_cells(uv, uv_faces, GRID)
    taken = cv2.dilate(taken.astype(np.uint8), np.ones((2 * GUTTER + 1,) * 2, np.uint8)) > 0
    taken[:GUTTER] = taken[-GUTTER:] = taken[:, :GUTTER] = taken[:, -GUTTER:] = True
    found = []
    for width, height in sizes:
        box = _first_free(taken, width * GRID, height * GRID)
        if box is None:
            raise HeadModelError(
                f"head model {name!r}: its texture map has no room for a mouth; load it without a"
                " mouth, or leave a free corner in the template's map"
            )
        row, column, rows, columns = box
        around = slice(max(0, row - GUTTER), row + rows + GUTTER)
        taken[around, max(0, column - GUTTER) : column + columns + GUTTER] = True
        # Cells count down from the top, v counts up.
        bottom, top = GRID - row - rows, GRID - row
        found.append(np.array([column, bottom, column + columns, top]) / GRID)
    return tuple(found)


def covered_cells(uv: np.ndarray, uv_faces: np.ndarray, size: int) -> np.ndarray:
    """Cells (size, size), bool, first row at v = 1, that triangles cover or touch."""
    cells = np.zeros((size, size), np.uint8)
    places = np.stack([uv[:, 0], 1 - uv[:, 1]], -1) * size
    corners = np.floor(places).clip(0, size - 1).astype(np.int32)[uv_faces]
    for triangle in corners:
        cv2.fillConvexPoly(cells, triangle, 1)
    return cells > 0


def _first_free(taken: np.ndarray, width: float, height: float) -> tuple[int, int, int, int] | None:
    """Row, column, rows and columns of the largest free rectangle that is tried."""
    scale = 1.0
    while scale >= LEAST:
        rows, columns = max(2, round(height * scale)), max(2, round(width * scale))
        total = np.pad(np.cumsum(np.cumsum(taken, 0), 1), ((1, 0), (1, 0)))
        inside = (
            total[rows:, columns:]
            - total[:-rows, columns:]
            - total[rows:, :-columns]
            + total[:-rows, :-columns]
        )
        free = np.argwhere(inside == 0)
        if len(free):
            return int(free[0, 0]), int(free[0, 1]), rows, columns
        scale *= SHRINK
    return None
