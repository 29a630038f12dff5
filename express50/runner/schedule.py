"""Which items of a stage run, and which before which."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from typing import Any

from express50.contract.config import nearest
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.errors import ConfigError, Express50Error, StageError


def select_items(stage: Stage, dataset: Dataset, pattern: str) -> list[str]:
    """Items of a stage whose id matches a shell pattern.

    Raises:
        ConfigError: none does.
    """
    known = stage.items(dataset)
    chosen = [item for item in known if fnmatch.fnmatchcase(item, pattern)]
    if not chosen:
        some = ", ".join(known[:8]) + (", ..." if len(known) > 8 else "")
        raise ConfigError(
            f"--items {pattern!r}: no item of {stage.name} matches{nearest(pattern, known)}; "
            f"items: {some or 'none'}"
        )
    return chosen


def waves_of(stage: Stage, dataset: Dataset, config: Any, chosen: Sequence[str]) -> list[list[str]]:
    """The items and their sources, in lists of which each needs the ones before it only.

    Raises:
        StageError: items wait for each other.
    """
    needs: dict[str, list[str]] = {}
    waiting = list(chosen)
    while waiting:
        item = waiting.pop()
        if item not in needs:
            try:
                needs[item] = stage.sources(dataset, item, config)
            except Express50Error:  # the item says so itself when its inputs are read
                needs[item] = []
            waiting += needs[item]
    order = [*chosen, *sorted(set(needs) - set(chosen))]
    waves: list[list[str]] = []
    while order:
        left = set(order)
        ready = [item for item in order if left.isdisjoint(needs[item])]
        if not ready:
            raise StageError(f"{stage.name}: {', '.join(order[:3])} wait for each other")
        waves.append(ready)
        order = [item for item in order if not left.isdisjoint(needs[item])]
    return waves
