"""The setting that did best in a given time, where that was measured."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from express50.errors import ConfigError

MEASURED = Path(__file__).with_name("measured.json")  # written by benchmarks.grmm_trade


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What a budget is best spent on.

    Attributes:
        setting: its name in docs/TRADEOFFS.md.
        changes: table -> key -> value over the demo preset.
        budget_s: the processor seconds it was measured with.
        psnr_db: on held-out cameras there.
    """

    setting: str
    changes: dict[str, dict[str, Any]]
    budget_s: float
    psnr_db: float

    def __str__(self) -> str:
        return f"{self.setting} ({self.psnr_db:.1f} dB in {self.budget_s:.0f} s where measured)"


def choose(seconds: float, measured: Path = MEASURED) -> Choice:
    """The best setting of the longest measured budget that fits in ``seconds``.

    Less time than any that was measured gets the choice of the shortest. A machine's speed is not
    asked: one twice as fast spends the choice of half the time, which is the safe side.

    Raises:
        ConfigError: the budget is not positive.
    """
    if not seconds > 0:
        raise ConfigError(f"budget is {seconds} s, expected more than 0, such as 4m")
    rows = sorted(json.loads(measured.read_text("utf-8")), key=lambda row: row["budget_s"])
    fitting = [row for row in rows if row["budget_s"] <= seconds]
    return Choice(**(fitting or rows[:1])[-1])
