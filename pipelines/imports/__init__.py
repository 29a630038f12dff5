"""Imports take tracks, mattes and depth that other tools made into the dataset."""

from __future__ import annotations

from typing import Any

from express50.contract.stage import Command


def add_commands(subparsers: Any) -> None:
    """Add the command, see `pipelines.imports.cli`."""
    from pipelines.imports.cli import add_commands as add

    add(subparsers)


COMMAND = Command("import tracks, mattes or depth that other tools made", add_commands)
