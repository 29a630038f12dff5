"""Photo makes one photograph or video without calibration ready for the stages."""

from __future__ import annotations

from typing import Any

from express50.contract.stage import Command


def add_commands(subparsers: Any) -> None:
    """Add the command, see `pipelines.photo.cli`."""
    from pipelines.photo.cli import add_commands as add

    add(subparsers)


COMMAND = Command("track the face in a single photograph or video", add_commands)
