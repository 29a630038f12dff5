"""``grmm study``."""

import argparse


def add_study(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm study``."""
