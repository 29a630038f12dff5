"""Declare ``express50 cameras`` for the list of commands, without importing what it needs."""

from __future__ import annotations

from typing import Any

from express50.contract.stage import Command


def add_commands(subparsers: Any) -> None:
    """Add the parsers of `pipelines.calibrate.cli`, which is imported when they are asked for."""
    from pipelines.calibrate.cli import add_commands as add

    add(subparsers)


COMMAND = Command("import and check calibrations", add_commands)
