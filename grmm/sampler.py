"""Choose samples: shuffled for training, evenly spread for measuring.

The order of training is a pure function of (seed, epoch, position), so that a resumed run goes on
exactly where it stopped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from express50.errors import TrainError

Item = TypeVar("Item")


class Shuffle:
    """Endless shuffled order over ``indices``; its state is (epoch, position)."""

    def __init__(self, indices: Sequence[int], seed: int, rank: int = 0, world: int = 1) -> None:
        """Take every world-th entry of the common order for process ``rank``."""
        if not indices:
            raise TrainError("no samples to train on; check the split and the held-out cameras")
        self.indices, self.seed, self.rank, self.world = list(indices), seed, rank, world
        self.epoch, self.position = 0, 0
        self._order = self._permutation()

    def _permutation(self) -> np.ndarray:
        return np.random.default_rng([self.seed, self.epoch]).permutation(self.indices)

    def next(self) -> int:
        """Return the index of this rank's next sample."""
        taken = None
        for rank in range(self.world):
            if self.position == len(self._order):
                self.epoch, self.position = self.epoch + 1, 0
                self._order = self._permutation()
            if rank == self.rank:
                taken = int(self._order[self.position])
            self.position += 1
        assert taken is not None
        return taken

    def state(self) -> dict[str, int]:
        """Return the state that `restore` takes."""
        return {"epoch": self.epoch, "position": self.position}

    def restore(self, state: dict[str, int]) -> None:
        """Resume after the last sample taken when ``state`` was saved."""
        self.epoch, self.position = state["epoch"], state["position"]
        self._order = self._permutation()


def spread(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most ``count`` of the items, evenly chosen (first and last included)."""
    if len(items) <= count:
        return list(items)
    steps = np.linspace(0, len(items) - 1, count).round().astype(int)
    return [items[i] for i in steps]
