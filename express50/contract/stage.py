"""A stage is a pure function over one work item plus a frozen config."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from express50.contract.layout import Dataset


@dataclass(frozen=True)
class Note:
    """A remark about a part of an item: what it concerns, and why."""

    what: str
    why: str


@dataclass(frozen=True)
class Result:
    """The outcome of one item, besides the files it wrote.

    Attributes:
        metrics: deterministic figures that JSON can hold.
        dropped: parts of the item that were left out.
        warnings: parts that were kept although something about them is doubtful.
    """

    metrics: Mapping[str, Any] = field(default_factory=dict)
    dropped: Sequence[Note] = ()
    warnings: Sequence[Note] = ()

    def to_json(self) -> dict[str, Any]:
        """The content of ``metrics.json``."""
        notes = {"dropped": self.dropped, "warnings": self.warnings}
        return {**self.metrics, **{key: [asdict(n) for n in rows] for key, rows in notes.items()}}


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
            returns a ``Result`` (the runner writes it to ``metrics.json``). Raises Express50Error
            when the data of this item are bad.
        sources: items of the same stage whose outputs an item reads. They are run before it,
            whether they were asked for or not, so that its bytes do not hang on the order; the
            output read must be among ``inputs``, where it is there.
        needs_gpu: whether items of this config may only run where there is a GPU; one at a time
            runs on each.
        help: one line for the command line, in the imperative.
        purpose: one or two sentences for the report.
    """

    name: str
    version: int
    config: type
    presets: dict[str, dict[str, object]]
    items: Callable[[Dataset], list[str]]
    inputs: Callable[[Dataset, str, Any], dict[str, Path | str]]
    run: Callable[[Dataset, str, Any, Path], Result | dict]
    sources: Callable[[Dataset, str, Any], list[str]] = no_sources
    needs_gpu: Callable[[Any], bool] = no_gpu
    help: str = ""
    purpose: str = ""
