"""What a stage is: a pure function over one work item plus a frozen config; nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from express50.contract.layout import Dataset


def no_sources(dataset: Dataset, item: str, config: Any) -> list[str]:
    """No item of the stage reads another's output."""
    return []


def no_gpu(config: Any) -> bool:
    """The stage runs on CPUs whatever its configuration."""
    return False


@dataclass(frozen=True)
class Stage:
    """One processing step; the runner owns files, retries, receipts and progress.

    Attributes:
        name: command, table in TOML and folder of the outputs.
        version: raise it when the same inputs and config give other outputs.
        config: frozen keyword-only dataclass; a string under each field documents it.
        presets: ``draft``, ``standard`` and ``reference`` values that differ from the defaults.
        items: ids of the work items of a dataset; ``S001`` or nested ``S001/cam03``.
        inputs: what one item reads: paths are digested by content, strings are literal digests.
        run: ``run(dataset, item, config, out_dir)`` writes every file into ``out_dir`` and
            returns deterministic JSON-able metrics (the runner writes ``metrics.json``). Parts of
            the item left out are listed as ``{"dropped": [{"what": ..., "why": ...}]}``. Raises
            Express50Error when the data of this item are bad.
        sources: items of the same stage whose outputs an item reads. They are run before it,
            whether they were asked for or not, so that its bytes do not hang on the order; the
            output read must be among ``inputs``, where it is there.
        needs_gpu: whether items of this config may only run where there is a GPU; one at a time
            runs on each.
    """

    name: str
    version: int
    config: type
    presets: dict[str, dict[str, object]]
    items: Callable[[Dataset], list[str]]
    inputs: Callable[[Dataset, str, Any], dict[str, Path | str]]
    run: Callable[[Dataset, str, Any, Path], dict]
    sources: Callable[[Dataset, str, Any], list[str]] = no_sources
    needs_gpu: Callable[[Any], bool] = no_gpu
