"""Read the 60-expression script: what subjects are asked to do (``expressions.toml``)."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from functools import cache
from importlib import resources

from express50.errors import FormatError, check_known

NEUTRAL = "neutral"  # the resting face, which has no peak


@dataclass(frozen=True, kw_only=True)
class Expression:
    """One entry of the script."""

    id: str  # snake_case id, used in cues, labels and file names
    name: str  # short title shown to people
    description: str  # what to do, with FACS action units
    # activation of named expression directions; 1 is full, a negative value is the opposite
    # movement
    controls: dict[str, float] = field(default_factory=dict)
    jaw: tuple[float, ...] = (0.0, 0.0, 0.0)  # (3,) axis-angle of the jaw, radians; opening is +x
    neck: tuple[float, ...] = (0.0, 0.0, 0.0)  # (3,) axis-angle of the neck, radians
    # (2,) yaw, positive to the subject's left, and pitch, positive upwards; radians
    gaze: tuple[float, ...] = (0.0, 0.0)


def expression_words(expression: str) -> tuple[str, str]:
    """Return an expression's name and description; its id and "" if it is not in the script."""
    entry = next((e for e in load_script() if e.id == expression), None)
    return (expression, "") if entry is None else (entry.name, entry.description)


@cache
def load_script() -> tuple[Expression, ...]:
    """Return the built-in script: 60 expressions in recording order, ``neutral`` first."""
    file = resources.files("express50.capture") / "expressions.toml"
    script = []
    for row in tomllib.loads(file.read_text(encoding="utf-8"))["expression"]:
        numbers = {key: tuple(row[key]) for key in ("jaw", "neck", "gaze") if key in row}
        controls = {
            name.replace("_LR", side): value
            for name, value in row.get("controls", {}).items()
            for side in (("_L", "_R") if name.endswith("_LR") else ("",))
        }
        script.append(Expression(**row | numbers | {"controls": controls}))
    return tuple(script)


def select(ids: list[str] | tuple[str, ...] | None = None) -> tuple[Expression, ...]:
    """Return the script's entries with these ids, in their order; all of them for None.

    Raises:
        FormatError: an id is not in the script; the message suggests a similar one.
    """
    script = {expression.id: expression for expression in load_script()}
    if ids is None:
        return tuple(script.values())
    check_known("the script", "expression", ids, script, FormatError)
    return tuple(script[wanted] for wanted in ids)
