"""A small optimiser that can be had one for every row."""

from __future__ import annotations

import numpy as np


class Adam:
    """Adam (Kingma and Ba 2015) of one array; its time stands still while it is not stepped."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        """Start at rest."""
        self._mean, self._square = np.zeros(shape), np.zeros(shape)
        self._time = 0

    def step(self, gradient: np.ndarray) -> np.ndarray:
        """The change to make at rate 1; nearly every entry lies in [-1, 1]."""
        self._time += 1
        self._mean = 0.9 * self._mean + 0.1 * gradient
        self._square = 0.99 * self._square + 0.01 * gradient**2
        scale = np.sqrt(self._square / (1 - 0.99**self._time))
        return -self._mean / (1 - 0.9**self._time) / np.maximum(scale, 1e-12)
