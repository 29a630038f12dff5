"""A stage is a pure function over one work item plus a frozen config."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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


def no_gpu(config: Any) -> bool:
    """Say that a stage runs on CPUs whatever its configuration."""
    return False


@dataclass(frozen=True)
class Growth:
    """Sizes of the footage that a stage's cost is proportional to, for ``express50 plan``.

    The sizes are ``subjects``, ``expressions``, ``views`` (cameras), ``pixels`` (of an image) and
    ``frames`` (of a camera); several are multiplied.

    Attributes:
        items: number of items.
        time: seconds per item.
        disk: bytes per item.
    """

    items: tuple[str, ...] = ("subjects",)
    time: tuple[str, ...] = ()
    disk: tuple[str, ...] = ()


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
        needs_gpu: whether items of this config may only run where there is a GPU; one at a time
            runs on each.
        help: one line for the command line, in the imperative.
        purpose: one or two sentences for the report.
        runs_first: stages that the command of this one runs before it.
        prepare: takes captures that the command names into the dataset and returns the ids of
            their items; only a stage that has it accepts captures.
        account: lines for people about items that were made, printed after the stage's account.
        growth: what its cost is proportional to.
    """

    name: str
    version: int
    config: type
    presets: dict[str, dict[str, object]]
    items: Callable[[Dataset], list[str]]
    inputs: Callable[[Dataset, str, Any], dict[str, Path | str]]
    run: Callable[[Dataset, str, Any, Path], Result]
    needs_gpu: Callable[[Any], bool] = no_gpu
    help: str = ""
    purpose: str = ""
    runs_first: tuple[str, ...] = ()
    prepare: Callable[[Dataset, Sequence[Path]], list[str]] | None = None
    account: Callable[[Dataset, Sequence[str]], Iterable[str]] | None = None
    growth: Growth = Growth()
