"""Define a stage, and find the stages, commands and hooks of other packages.

A stage is a pure function over one work item plus a frozen config. The core imports no package
above it: a package names what it offers in its ``pyproject.toml``::

    [project.entry-points."express50.stages"]
    mine = "my_package.stages:STAGES"

- ``express50.stages``: a tuple of `Stage`, in the order in which they run;
- ``express50.commands``: a `Command` of the entry point's name;
- ``express50.hooks``: functions that audits and withdrawals call, see `hook`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from statistics import median
from typing import Any, Literal, get_args

from express50.contract.layout import Dataset
from express50.errors import ConfigError, StageError, rounded


@dataclass(frozen=True)
class Note:
    """A remark about a part of an item: what it concerns, and why."""

    what: str
    why: str

    def __str__(self) -> str:
        """Format for people."""
        return f"{self.what}: {self.why}"


Unit = Literal["mm", "px", "frames", "alpha", "dB"]


@dataclass(frozen=True)
class ExpectedError:
    """How wrong a result probably is, judged without ground truth."""

    value: float  # expected error, in the stage's own measure (docs/FORMAT.md)
    low: float  # lower end of the 90 % interval of the true error
    high: float  # upper end of it
    unit: Unit  # unit of all three

    def __post_init__(self) -> None:
        """Raise StageError unless the figures are finite and in order, and the unit is known."""
        figures = (self.low, self.value, self.high)
        if not all(map(math.isfinite, figures)) or list(figures) != sorted(figures):
            raise StageError(
                f"expected error: got low, value, high = {figures}; expected finite numbers in"
                " rising order (state None if the error is not known)"
            )
        if self.unit not in get_args(Unit):
            raise StageError(
                f"expected error: unit {self.unit!r}; expected one of {', '.join(get_args(Unit))}"
            )

    def __str__(self) -> str:
        """Format for people: ``0.31 mm (0.22 to 0.5)``."""
        unit = "alpha at the outline" if self.unit == "alpha" else self.unit
        return f"{rounded(self.value)} {unit} ({rounded(self.low)} to {rounded(self.high)})"


def typical_error(metrics: Iterable[Mapping[str, Any]]) -> ExpectedError | None:
    """Return the median of the items' expected errors, from their metrics; None without any."""
    stated = []
    for row in metrics:
        with suppress(TypeError, StageError):  # absent, or a file that somebody changed
            stated.append(ExpectedError(**row.get("expected_error")))  # type: ignore[arg-type]
    if not stated:
        return None
    value, low, high = (median(getattr(e, key) for e in stated) for key in ("value", "low", "high"))
    return ExpectedError(value, low, high, stated[0].unit)


@dataclass(frozen=True)
class Result:
    """The outcome of one item, besides the files it wrote."""

    metrics: Mapping[str, Any] = field(default_factory=dict)  # deterministic, for JSON
    dropped: Sequence[Note] = ()  # parts of the item that were left out
    warnings: Sequence[Note] = ()  # parts that were kept although something about them is doubtful
    expected_error: ExpectedError | None = None  # None if the stage cannot say

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``metrics.json``."""
        notes = {"dropped": self.dropped, "warnings": self.warnings}
        stated = {"expected_error": asdict(self.expected_error)} if self.expected_error else {}
        rows = {key: [asdict(note) for note in parts] for key, parts in notes.items()}
        return {**self.metrics, **rows, **stated}


def no_gpu(config: Any) -> bool:
    """Return False: the stage runs on CPUs whatever its configuration."""
    return False


def no_files(config: Any) -> None:
    """Check nothing, because no setting names a file."""


@dataclass(frozen=True, kw_only=True)
class NoSettings:
    """The configuration of a stage without settings."""


@dataclass(frozen=True)
class Growth:
    """Sizes of the footage that a stage's cost is proportional to, for ``express50 plan``.

    The sizes are ``subjects``, ``expressions``, ``views`` (cameras), ``pixels`` (of a recorded
    image), ``picture`` (pixels of a peak frame, which may be reduced), ``converted`` (the mean of
    these two), ``frames`` (of a camera) and ``decoded`` (those that ingest decodes); several are
    multiplied.
    """

    items: tuple[str, ...] = ("subjects",)  # number of items
    time: tuple[str, ...] = ()  # seconds per item
    disk: tuple[str, ...] = ()  # bytes per item
    more: tuple[str, ...] = ()  # number of further items, such as one of plates per subject
    # longer side, pixels, to which the stage reduces pictures for most of its work at standard
    # settings, so that larger pictures take no longer; 0 if it does not
    side: int = 0
    # name of the stage's setting to whose pixels it reduces the longer side of pictures for all
    # later stages; 0 pixels leave them as they are
    reduces: str = ""
    skips: str = ""  # name of the stage's setting that says of how many frames one is decoded


@dataclass(frozen=True)
class Stage:
    """One processing step; the runner owns files, retries, receipts and progress."""

    name: str  # command, table in TOML and folder of the outputs
    version: int  # raise it when the same inputs and config give other outputs
    config: type  # frozen keyword-only dataclass; a string under each field documents it
    items: Callable[[Dataset], list[str]]  # ids of work items; ``S001`` or nested ``S001/cam03``
    # what one item reads: paths are digested by content, strings are literal digests
    inputs: Callable[[Dataset, str, Any], dict[str, Path | str]]
    # ``run(dataset, item, config, out_dir)`` writes every file into ``out_dir`` and returns a
    # ``Result`` (the runner writes it to ``metrics.json``). Raises Express50Error when the data of
    # this item are bad.
    run: Callable[[Dataset, str, Any, Path], Result]
    # values of ``draft`` and ``reference`` that differ from the defaults, which are ``standard``;
    # none if the stage offers no trade between time and error
    presets: dict[str, dict[str, object]] = field(default_factory=dict)
    # opens the files that settings name; commands call it before any stage runs. Raises
    # Express50Error where one cannot be used.
    try_files: Callable[[Any], None] = no_files
    # whether items of this config need a GPU; one item at a time runs on each
    needs_gpu: Callable[[Any], bool] = no_gpu
    help: str = ""  # one line for the command line, in the imperative
    purpose: str = ""  # one or two sentences for the report
    runs_first: tuple[str, ...] = ()  # stages that the command of this one runs before it
    # registers captures that the command names, and returns the ids of their items; if its last
    # argument is true, they may replace other captures of their subjects. Only a stage that has it
    # accepts captures.
    prepare: Callable[[Dataset, Sequence[Path], bool], list[str]] | None = None
    # lines for people about items that were made, printed after the stage's account
    account: Callable[[Dataset, Sequence[str]], Iterable[str]] | None = None
    growth: Growth = Growth()  # what its cost is proportional to


OWN = "toolkit"  # the entry point of this project's own stages, which come first
INSTALL = "run 'pip install -e .' in the folder of the sources"


@dataclass(frozen=True)
class Command:
    """A command of ``express50`` that another package adds."""

    help: str  # one line for the list of commands
    # ``add(subparsers)`` adds the command's parser; called when the command is asked for. A command
    # with a stage's name gets that stage's parser, to add options to it.
    add: Callable[[Any], None]


def _load(point: EntryPoint) -> Any:
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"entry point {point.name} = {point.value} of {point.group} does not load ({error}); "
            f"{INSTALL}, or fix or uninstall its package"
        ) from error


@functools.cache
def stages() -> dict[str, Stage]:
    """Return every installed stage by name, in the order in which they run.

    Raises:
        StageError: none is installed.
        ConfigError: two stages have one name.
    """
    found: dict[str, Stage] = {}
    points = entry_points(group="express50.stages")
    for point in sorted(points, key=lambda p: (p.name != OWN, p.name)):
        for stage in _load(point):
            if stage.name in found:
                raise ConfigError(
                    f"entry point {point.name} = {point.value}: a stage {stage.name!r} is installed"
                    " already; give the new one another name"
                )
            found[stage.name] = stage
    if not found:
        raise StageError(f"no stage is known, because express50 is not installed; {INSTALL}")
    return found


def with_required(names: Iterable[str]) -> list[Stage]:
    """Return the named stages and those that their commands run first, in order."""
    known = stages()
    wanted = {other for name in names for other in (*known[name].runs_first, name)}
    return [stage for name, stage in known.items() if name in wanted]


def commands() -> dict[str, Command]:
    """Return the commands that other packages add, by name.

    A command that does not load raises its ConfigError only when it is called.
    """
    found = {}
    for point in sorted(entry_points(group="express50.commands")):
        try:
            found[point.name] = _load(point)
        except ConfigError as error:
            found[point.name] = Command("does not load", functools.partial(_raise, error))
    return found


def _raise(error: ConfigError, subparsers: Any) -> None:
    raise error


def hook(name: str) -> Callable[..., Any]:
    """Return an installed hook.

    ``label_problems(dataset, subjects)`` checks labels against their footage;
    ``read_checkpoint(path)`` reads a trained model or refuses it; ``redact_checkpoint(path,
    subject)`` takes a person out of one.

    Raises:
        StageError: no package brings it.
    """
    for point in entry_points(group="express50.hooks", name=name):
        return _load(point)
    raise StageError(f"no installed package has the hook {name!r}; {INSTALL}")
