"""Say why outputs are not what the present inputs, settings and stages would give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from express50.contract.config import config_texts
from express50.contract.stage import Stage
from express50.runner.ledger import Made

NAMED = 3  # inputs or settings that are named


def why_outdated(stage: Stage, config: Any, made: Made, inputs: Mapping[str, str]) -> str:
    """Say what differs between what an output was made from and with, and what is there now.

    Args:
        stage: the stage as it is now.
        config: its present settings.
        made: inputs, settings and version of the output.
        inputs: digests of the present inputs by name.
    """
    words = []
    if changed := _differing(made.inputs, inputs):
        words.append(f"inputs changed: {few(changed, NAMED)}")
    if settings := other_settings(made, config):
        words.append(f"settings changed: {few(settings, NAMED)}")
    if made.version not in (0, stage.version):
        words.append(f"stage version changed: it was {made.version}, is {stage.version}")
    return "; ".join(words) or "settings or stage version changed"


def other_settings(made: Made, config: Any) -> list[str]:
    """List the settings that an output was made with and that differ from the given ones."""
    then, now = made.settings, config_texts(config)
    names = _differing(then, now) if then else []
    return [f"{n} was {then.get(n, 'unknown')}, is {now.get(n, 'gone')}" for n in names]


def few(names: Sequence[str], count: int = 3) -> str:
    """List the first names, then how many more there are."""
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return ", ".join(names[:count]) + more


def _differing(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    return [n for n in sorted(one.keys() | other.keys()) if one.get(n) != other.get(n)]
