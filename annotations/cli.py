"""``express50 annotate``: labels without a screen; the same store that the screen writes to."""

from __future__ import annotations

import argparse

from annotations import cli_judge, cli_label, cli_manage, cli_sheet
from annotations.ui import cli as ui


def add_commands(subparsers: argparse._SubParsersAction) -> None:
    """Add ``annotate`` with its verbs."""
    words = "label peak frames, compare annotators, review and export"
    annotate = subparsers.add_parser("annotate", help=words, description=words)
    verbs = annotate.add_subparsers(dest="verb", metavar="VERB", required=True)
    for area in (ui, cli_label, cli_judge, cli_sheet, cli_manage):
        area.add_verbs(verbs)
