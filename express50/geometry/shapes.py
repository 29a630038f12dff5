"""Check array arguments; errors say in one line what was expected and what was given."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

PIXEL_LIMIT = 200_000_000  # per image, six times an 8K frame; stops decompression bombs


def check_shape(
    name: str, array: np.ndarray, expected: Sequence[int | None], where: str = ""
) -> None:
    """Raise unless ``array`` has the expected shape (``None`` stands for any length).

    Raises:
        ValueError: the shape differs; the message names the argument and both shapes.
    """
    shape = tuple(array.shape)
    fits = len(shape) == len(expected) and all(
        want is None or want == got for got, want in zip(shape, expected, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in expected) + ")"
        prefix = f"{where}: " if where else ""
        raise ValueError(f"{prefix}{name} has shape {shape}, expected {wanted}")


def check_finite(name: str, array: np.ndarray) -> None:
    """Raise ValueError if ``array`` holds NaN or Inf; it says how many, and the first's index."""
    bad = ~np.isfinite(array)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name} has {int(bad.sum())} values that are not finite, the first at {first};"
            " expected finite numbers"
        )
