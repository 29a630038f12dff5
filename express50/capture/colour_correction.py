"""Correct colours with polynomials fitted to colour charts: linear light in, linear light out.

The terms are those of V. Cheung, S. Westland, D. Connah and C. Ripamonti, "A comparative study of
the characterisation of colour cameras by means of neural networks and polynomial transforms",
Coloration Technology 120(1), 2004, in the order that the colour-science library uses.
"""

from __future__ import annotations

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.pixels import LIGHT_OF_LEVEL, linear_to_srgb

_SQUARES = ("RR", "GG", "BB")
_PRODUCTS = ("RG", "RB", "GB")
_CUBES = ("RRR", "GGG", "BBB")
_MIXED = ("RRG", "GGB", "BBR")
TERMS: dict[int, tuple[str, ...]] = {
    3: ("R", "G", "B"),
    4: ("R", "G", "B", ""),
    5: ("R", "G", "B", "RGB", ""),
    7: ("R", "G", "B", *_PRODUCTS, ""),
    8: ("R", "G", "B", *_PRODUCTS, "RGB", ""),
    10: ("R", "G", "B", *_PRODUCTS, *_SQUARES, ""),
    11: ("R", "G", "B", *_PRODUCTS, *_SQUARES, "RGB", ""),
    14: ("R", "G", "B", *_PRODUCTS, *_SQUARES, "RGB", *_CUBES, ""),
    17: ("R", "G", "B", *_PRODUCTS, *_SQUARES, "RGB", *_MIXED, *_CUBES, ""),
}
STRIPE = 256  # rows at a time: the terms of a whole 4K frame would take a gigabyte


def check_matrix(matrix: object, where: str) -> tuple[tuple[float, ...], ...]:
    """Check a correction matrix (3, T), where T is a number of terms in TERMS; return its rows.

    Raises:
        CalibrationError: it has the wrong shape, or holds NaN or infinity.
    """
    try:
        array = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    usable = array.ndim == 2 and len(array) == 3 and array.shape[1] in TERMS
    if not usable or not np.isfinite(array).all():
        raise CalibrationError(
            f"{where}: colour correction has shape {array.shape}, expected 3 rows of "
            f"{', '.join(map(str, TERMS))} finite numbers"
        )
    return tuple(tuple(map(float, row)) for row in array)


def expand(linear: np.ndarray, terms: int) -> np.ndarray:
    """Compute the terms (..., T) of linear light (..., 3)."""
    channel = {"R": linear[..., 0], "G": linear[..., 1], "B": linear[..., 2]}
    columns = []
    for product in TERMS[terms]:
        column = np.ones_like(linear[..., 0])
        for letter in product:
            column = column * channel[letter]
        columns.append(column)
    return np.stack(columns, axis=-1)


def correct_srgb(image: np.ndarray, matrix: tuple[tuple[float, ...], ...]) -> np.ndarray:
    """Apply a correction to an sRGB image (H, W, 3) uint8; clip values that are out of range."""
    rows = np.asarray(matrix, dtype=np.float32)
    out = np.empty_like(image)
    for top in range(0, len(image), STRIPE):
        linear = LIGHT_OF_LEVEL[image[top : top + STRIPE]]
        fixed = np.clip(expand(linear, rows.shape[1]) @ rows.T, 0.0, 1.0)
        out[top : top + STRIPE] = np.rint(linear_to_srgb(fixed) * 255.0)
    return out
