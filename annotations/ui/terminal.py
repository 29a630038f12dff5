"""How the terminal at hand shows pictures: what it says of itself, never a question to it.

A terminal that is asked answers into the keyboard's stream, late over ssh, and one that does not
know the question says nothing; so only its environment is read. What is not known gets characters.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import sys
import termios
from collections.abc import Mapping
from typing import NamedTuple

WANTED = ("auto", "blocks", "halfblocks", "kitty", "sixel")
_MULTIPLEXERS = ("TMUX", "STY", "ZELLIJ")
# Terminals by TERM, which ssh hands on. WezTerm and Konsole speak kitty's protocol but not its
# placeholders.
_BY_TERM = {
    "xterm-kitty": "kitty", "xterm-ghostty": "kitty", "foot": "sixel", "foot-extra": "sixel",
    "wezterm": "sixel", "mlterm": "sixel", "contour": "sixel",
}  # fmt: skip
_BY_PROGRAM = {"kitty": "kitty", "ghostty": "kitty", "WezTerm": "sixel", "iTerm.app": "sixel",
               "iTerm2": "sixel"}  # fmt: skip


class CellSize(NamedTuple):
    """Pixels of a character cell."""

    width: int
    height: int


def choose_pictures(
    wanted: str,
    environ: Mapping[str, str] | None = None,
    *,
    is_terminal: bool | None = None,
    cell: CellSize | None = None,
) -> str:
    """The way pictures are shown: what was asked for, or the best known for ``auto``.

    ``blocks`` needs a font with block elements, which every terminal in UTF-8 has; else it is
    ``halfblocks``.

    Args:
        wanted: one of ``WANTED``.
        environ: the environment's variables, this process's by default.
        is_terminal: whether output goes to a terminal, asked of it by default.
        cell: pixels of a cell; without them sixels cannot fill a pane, asked of the terminal by
            default.
    """
    environ = os.environ if environ is None else environ
    is_terminal = sys.stdout.isatty() if is_terminal is None else is_terminal
    if wanted != "auto":
        return wanted
    known = known_graphics(environ) if is_terminal else None
    if known == "sixel" and (cell or cell_size()) is None:
        known = None
    if known is not None:
        return known
    utf8 = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    return "blocks" if utf8 else "halfblocks"


def known_graphics(environ: Mapping[str, str]) -> str | None:
    """``kitty``, ``sixel`` or None by what a terminal says of itself in the environment."""
    term = environ.get("TERM", "")
    if term.startswith(("tmux", "screen")) or any(environ.get(name) for name in _MULTIPLEXERS):
        return None  # they cut graphics out, or keep them where the pane was
    if term in _BY_TERM:
        return _BY_TERM[term]
    # Terminals inside others inherit variables: the one set last, TERM_PROGRAM, decides.
    program = environ.get("TERM_PROGRAM") or environ.get("LC_TERMINAL")
    if program:
        return _BY_PROGRAM.get(program)
    return "kitty" if environ.get("KITTY_WINDOW_ID") else None


def cell_size() -> CellSize | None:
    """Pixels of a cell as the terminal's driver knows them; None where it does not."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        answer = fcntl.ioctl(sys.__stdout__.fileno(), termios.TIOCGWINSZ, bytes(8))  # type: ignore[union-attr]
        rows, columns, width, height = struct.unpack("4H", answer)
        if min(rows, columns) > 0 and width >= columns and height >= rows:
            return CellSize(width // columns, height // rows)
    return None
