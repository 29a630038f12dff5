"""Selection of parts of a foreign layout, under which names, as a capture.toml states it."""

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
class Selection:
    """Parts of a layout to read; the names are the layout's own.

    Attributes:
        sequences: shell patterns of sequences to take; none takes the layout's usual ones.
        cameras: shell patterns of cameras to take; none takes all.
        expressions: our expression id by sequence.
        metres_per_unit: length of one unit of the calibration's world; None where it is not given.
    """

    sequences: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    expressions: Mapping[str, str] = field(default_factory=dict)
    metres_per_unit: float | None = None

    def has_sequence(self, name: str, usual: str = "*") -> bool:
        """Return whether a sequence is selected."""
        return any(fnmatch.fnmatchcase(name, p) for p in self.sequences or (usual,))

    def left_out(self, sequences: Sequence[str]) -> dict[str, str]:
        """Return the sequences that are not selected, with the reason."""
        return {f"sequence {s}": "not asked for" for s in sequences if not self.has_sequence(s)}

    def has_camera(self, name: str) -> bool:
        """Return whether a camera is selected."""
        return not self.cameras or any(fnmatch.fnmatchcase(name, p) for p in self.cameras)

    def expression(self, sequence: str) -> str:
        """Return the expression id of a sequence: the given one, else one made of its name."""
        return self.expressions.get(sequence) or identifier(sequence, "_")


def identifier(text: str, other: str = "_-") -> str:
    """Make an id of any text: ``_`` replaces all but letters, digits and ``other``."""
    clean = re.sub(rf"[^A-Za-z0-9{re.escape(other)}]+", "_", text).strip("_-")
    return clean or "unnamed"


def parse_selection(meta: Mapping[str, Any], where: Path) -> Selection:
    """Selection of a capture.toml's content.

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
    return Selection(
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


def check_selection(selection: Selection, sequences: Sequence[str], cameras: Sequence[str]) -> None:
    """Refuse patterns that match nothing: a typing error would look like missing data.

    Raises:
        CaptureError: a wish fits nothing of the layout.
    """
    for what, patterns, known in (
        ("sequences", (*selection.sequences, *selection.expressions), sequences),
        ("cameras", selection.cameras, cameras),
    ):
        for pattern in patterns:
            if not fnmatch.filter(known, pattern):
                some = ", ".join(known[:8]) + (", ..." if len(known) > 8 else "")
                raise CaptureError(
                    f"capture.toml: {what} name {pattern!r}, which is not there; the layout has "
                    f"{some or 'none'}"
                )
