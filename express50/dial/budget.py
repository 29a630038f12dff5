"""Read budgets and goals as people write them, and count what a run has spent of its budget."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import get_args

from express50.contract.stage import Unit
from express50.errors import ConfigError
from express50.runner.ledger import Receipt

SECONDS = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ch": 3600.0}
SAFETY = 0.95  # of the time left is planned with: what items take varies
PART = re.compile(r"(\d+(?:\.\d+)?)(s|min|m|ch|h|d)")


@dataclass(frozen=True)
class Budget:
    """Seconds that a run may take: of the clock, or of all cores together."""

    text: str  # the budget as the user wrote it
    seconds: float  # clock seconds, or processor seconds of the items
    cores: bool  # True if ``seconds`` are processor seconds


@dataclass(frozen=True)
class Goal:
    """An upper limit for a result's error, in the result's unit, and as the user wrote it."""

    text: str
    value: float
    unit: str


def parse_budget(text: str) -> Budget:
    """Read a budget: ``90s``, ``45m``, ``2h``, ``1h30m``, ``1d``; ``40ch`` are core hours.

    Raises:
        ConfigError: the text is not such a time, or is 0.
    """
    parts = PART.findall(text)
    seconds = sum(float(number) * SECONDS[unit] for number, unit in parts)
    cores = any(unit == "ch" for _, unit in parts)
    read = "".join(map("".join, parts)) == text and not (cores and len(parts) > 1)
    if not (read and 0 < seconds < math.inf):
        raise ConfigError(
            f"--budget {text!r}: expected a time such as 45m, 2h or 1h30m, or core hours such as"
            " 40ch"
        )
    return Budget(text, seconds, cores)


def budget_text(seconds: float, cores: bool) -> str:
    """Write seconds as a budget, rounded up; at least a second, as no budget is 0."""
    seconds = max(seconds, 1.0)
    if cores:
        return f"{math.ceil(seconds / 36) / 100:g}ch"
    if seconds < 120:
        return f"{math.ceil(seconds)}s"
    return f"{math.ceil(seconds / 60)}m" if seconds < 36000 else f"{math.ceil(seconds / 3600)}h"


def parse_goal(text: str) -> Goal:
    """Read a goal: ``0.5mm``, ``0.004alpha``; ConfigError unless it is a number with a unit."""
    found = re.fullmatch(r"(\d*\.?\d+)\s*([A-Za-z]+)", text)
    if found is None or found[2] not in get_args(Unit) or not float(found[1]) > 0:
        units = ", ".join(get_args(Unit))
        raise ConfigError(
            f"--error {text!r}: expected a number and a unit, such as 0.5mm; units: {units}"
        )
    return Goal(text, float(found[1]), found[2])


@dataclass
class Clock:
    """Counts what a run spends, over all its sessions; a `RunMonitor` of the runner."""

    budget: Budget | None  # the limit; None for no limit
    spent: float = 0.0  # seconds spent in earlier sessions
    # stores the time spent; called about every two seconds while items end
    keep: Callable[[], None] = lambda: None
    item: float = 0.0  # expected seconds of one item of the running stage, which must still fit
    early: float = 0.0  # seconds of the budget reserved for later stages
    until: float = math.inf  # spent seconds after which no item begins, if before the budget's end
    core: float = 0.0
    running: set[str] = field(default_factory=set)  # items; their processor time is not known yet
    began: float = field(default_factory=time.monotonic)
    _kept: float = 0.0
    _closed: bool = False

    @property
    def cores(self) -> bool:
        """Return whether processor seconds count."""
        return self.budget is not None and self.budget.cores

    def now(self) -> float:
        """Return what was spent up to now."""
        return self.spent + (self.core if self.cores else time.monotonic() - self.began)

    def left(self) -> float:
        """Return what may still be spent."""
        return float("inf") if self.budget is None else self.budget.seconds - self.now()

    def plannable(self) -> float:
        """Return the seconds that plans may use."""
        return SAFETY * self.left()

    def expect(self, item: float, early: float = 0.0, until: float = math.inf) -> None:
        """Set the expected seconds of the next items, the reserve for later stages, and a limit."""
        self.item, self.early, self.until, self._closed = item, early, until, False

    def begun(self, item: str) -> None:
        """Count an item as running."""
        self.running.add(item)

    def settled(self, receipt: Receipt) -> None:
        """Count an item; one with 0 attempts was not made but restored."""
        self.running.discard(receipt.item)
        self.core += receipt.core_seconds if receipt.attempts else 0.0
        if receipt.attempts and self.until < math.inf:  # a trial: what its items take is a guess
            self.item = max(self.item, receipt.core_seconds if self.cores else receipt.seconds)
        if time.monotonic() - self._kept > 2.0:
            self._kept = time.monotonic()
            self.keep()

    def closed(self) -> bool:
        """Return whether a further item would probably end after the budget, or the limit."""
        left = min(self.left() - self.early, self.until - self.now())
        left -= len(self.running) * self.item if self.cores else 0.0
        self._closed = self._closed or left < self.item
        return self._closed
