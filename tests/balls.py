"""Meet a ball by rays: the closed form that pictures are drawn and depths are checked with."""

from __future__ import annotations

import numpy as np


def meet_ball(
    origin: np.ndarray, ways: np.ndarray, radius: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return how many ways (..., 3) it is to a ball about 0, and its depth (...) along them.

    The second is the square of half the way through the ball; below 0, the ray misses it, and
    the first is then where it passes closest.
    """
    square = (ways**2).sum(-1)
    closest = -(ways @ origin) / square
    through = closest**2 - (origin @ origin - radius**2) / square
    return closest - np.sqrt(np.maximum(through, 0)), through
