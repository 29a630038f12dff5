"""Label peak expressions: labels, suggestions, and the terminal annotator."""

from __future__ import annotations

from typing import Any

from express50.contract.stage import Command


def add_commands(subparsers: Any) -> None:
    """Add the command, see `annotations.cli`."""
    from annotations.cli import add_commands as add

    add(subparsers)


COMMAND = Command("label peak frames, review and export labels", add_commands)
