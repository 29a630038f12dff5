"""Which characters the terminal at hand has for pictures."""

from __future__ import annotations

import sys


def choose_protocol(wanted: str) -> str:
    """The way pictures are shown: what was asked for, or the best for ``auto``.

    ``quadrant`` needs a font with block elements, which every terminal in UTF-8 has.
    """
    if wanted != "auto":
        return wanted
    utf8 = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    return "quadrant" if utf8 else "halfblock"
