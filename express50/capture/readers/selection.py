"""What a capture.toml may ask of a foreign layout: which parts, under which names."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from express50.errors import CaptureError

EXPRESSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9_]*")


@dataclass(frozen=True, kw_only=True)
class Wishes:
    """A reader's choice of a layout's parts; the names are the layout's own.

    Attributes:
        sequences: shell patterns of sequences to take; none takes the layout's usual ones.
        cameras: shell patterns of cameras to take; none takes all.
        expressions: our expression id by sequence.
        metres_per_unit: what one unit of the calibration's world is; None where nothing is said.
    """

    sequences: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    expressions: Mapping[str, str] = field(default_factory=dict)
    metres_per_unit: float | None = None

    def wants_sequence(self, name: str, usual: str = "*") -> bool:
        """Whether a sequence is to be taken."""
        return any(fnmatch.fnmatchcase(name, p) for p in self.sequences or (usual,))

    def wants_camera(self, name: str) -> bool:
        """Whether a camera is to be taken."""
        return not self.cameras or any(fnmatch.fnmatchcase(name, p) for p in self.cameras)

    def expression(self, sequence: str) -> str:
        """Expression id of a sequence: the one that was asked for, else its name made one."""
        return self.expressions.get(sequence) or identifier(sequence, "_")


def identifier(text: str, other: str = "_-") -> str:
    """An id out of any text: letters, digits and ``other``; what else there is becomes ``_``."""
    clean = re.sub(rf"[^A-Za-z0-9{re.escape(other)}]+", "_", text).strip("_-")
    return clean or "unnamed"


def parse_wishes(meta: Mapping[str, Any], where: Path) -> Wishes:
    """Wishes of a capture.toml's content.

    Raises:
        CaptureError: a value is of another type, or an expression id cannot be one.
    """
    scale = meta.get("metres_per_unit")
    usable = isinstance(scale, int | float) and not isinstance(scale, bool)
    if scale is not None and not (usable and math.isfinite(scale) and scale > 0):
        raise CaptureError(f"{where}: metres_per_unit is {scale!r}, expected a number above 0")
    names = meta.get("expressions", {})
    if not isinstance(names, dict) or not all(
        isinstance(v, str) and EXPRESSION.fullmatch(v) for v in names.values()
    ):
        raise CaptureError(
            f"{where}: expressions is {names!r}, expected a table from sequence to an id of "
            "letters, digits and '_'"
        )
    return Wishes(
        sequences=_patterns(meta, "sequences", where),
        cameras=_patterns(meta, "cameras", where),
        expressions=names,
        metres_per_unit=None if scale is None else float(scale),
    )


def _patterns(meta: Mapping[str, Any], key: str, where: Path) -> tuple[str, ...]:
    value = meta.get(key, [])
    if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
        raise CaptureError(f"{where}: {key} is {value!r}, expected a list such as ['EXP*']")
    return tuple(value)


def check_wishes(wishes: Wishes, sequences: Sequence[str], cameras: Sequence[str]) -> None:
    """Refuse patterns that nothing matches: a slip there would look like missing data.

    Raises:
        CaptureError: a wish fits nothing of the layout.
    """
    for what, patterns, known in (
        ("sequences", (*wishes.sequences, *wishes.expressions), sequences),
        ("cameras", wishes.cameras, cameras),
    ):
        for pattern in patterns:
            if not fnmatch.filter(known, pattern):
                some = ", ".join(known[:8]) + (", ..." if len(known) > 8 else "")
                raise CaptureError(
                    f"capture.toml: {what} name {pattern!r}, which is not there; the layout has "
                    f"{some or 'none'}"
                )
