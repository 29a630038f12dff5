"""The 60-expression script: what subjects are asked to do, as data in ``expressions.toml``."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, field
from functools import cache
from importlib import resources

from express50.errors import FormatError
from express50.files.text import parse_toml

CATEGORIES = (
    "neutral", "basic", "mouth", "eyes", "brows", "cheeks", "jaw", "tongue", "asymmetry", "gaze",
    "viseme", "extreme",
)  # fmt: skip
_FIELDS = {"id", "name", "description", "categories", "controls", "jaw", "neck", "gaze"}


@dataclass(frozen=True, kw_only=True)
class Expression:
    """One entry of the script.

    Attributes:
        id: snake_case id, used in cues, labels and file names.
        name: short title for people.
        description: what to do, with FACS action units.
        categories: from ``CATEGORIES``.
        controls: activation of named expression directions; 1 is full, negative is its opposite.
        jaw: (3,) axis-angle of the jaw, radians; opening is +x.
        neck: (3,) axis-angle of the neck, radians.
        gaze: (2,) yaw to the subject's left and pitch upwards, radians.
    """

    id: str
    name: str
    description: str
    categories: tuple[str, ...]
    controls: dict[str, float] = field(default_factory=dict)
    jaw: tuple[float, ...] = (0.0, 0.0, 0.0)
    neck: tuple[float, ...] = (0.0, 0.0, 0.0)
    gaze: tuple[float, ...] = (0.0, 0.0)


def expression_words(expression: str) -> tuple[str, str]:
    """Return name and description of an expression; outside the script its id and no words."""
    entry = next((e for e in load_script() if e.id == expression), None)
    return (expression, "") if entry is None else (entry.name, entry.description)


@cache
def load_script() -> tuple[Expression, ...]:
    """Read the built-in script: 60 expressions in recording order, ``neutral`` first."""
    file = resources.files("express50.capture") / "expressions.toml"
    return parse_script(file.read_text(encoding="utf-8"), "expressions.toml")


def parse_script(text: str, where: str) -> tuple[Expression, ...]:
    """Read a script from TOML text; ``where`` names it in errors.

    Raises:
        FormatError: not TOML, an unknown field or category, a value of the wrong kind, a repeated
            id, or a first expression that is not ``neutral``.
    """
    rows = parse_toml(text, where, FormatError).get("expression", [])
    script = tuple(_parse_row(row, f"{where}: expression {n}") for n, row in enumerate(rows, 1))
    ids = [expression.id for expression in script]
    repeated = sorted({i for i in ids if ids.count(i) > 1})
    if repeated:
        raise FormatError(f"{where}: id {repeated[0]!r} is used twice, expected every id once")
    if not ids or ids[0] != "neutral":
        raise FormatError(f"{where}: first id is {ids[:1]}, expected 'neutral' first")
    return script


def select(ids: list[str] | tuple[str, ...] | None = None) -> tuple[Expression, ...]:
    """Select the script's entries by id, in the order asked for; all of them for None.

    Raises:
        FormatError: an id is not in the script; the nearest one is named.
    """
    script = {expression.id: expression for expression in load_script()}
    if ids is None:
        return tuple(script.values())
    for wanted in ids:
        if wanted not in script:
            near = difflib.get_close_matches(wanted, script, 1, cutoff=0.0)
            raise FormatError(f"expression {wanted!r} is not in the script; nearest is {near[0]!r}")
    return tuple(script[wanted] for wanted in ids)


def _parse_row(row: dict, where: str) -> Expression:
    unknown = sorted(set(row) - _FIELDS)
    missing = sorted({"id", "name", "description", "categories"} - set(row))
    if unknown or missing:
        raise FormatError(f"{where}: unknown fields {unknown}, missing fields {missing}")
    where = f"{where} ({row['id']})"
    if not str(row["id"]).isidentifier() or str(row["id"]) != str(row["id"]).lower():
        raise FormatError(f"{where}: expected an id in snake_case")
    strange = sorted(set(row["categories"]) - set(CATEGORIES))
    if strange or not row["categories"]:
        raise FormatError(f"{where}: categories {strange} unknown; expected {list(CATEGORIES)}")
    controls = row.get("controls", {})
    jaw, neck = row.get("jaw", [0.0] * 3), row.get("neck", [0.0] * 3)
    gaze = row.get("gaze", [0.0] * 2)
    numbers = [*controls.values(), *jaw, *neck, *gaze]
    if (len(jaw), len(neck), len(gaze)) != (3, 3, 2) or not all(
        isinstance(x, int | float) and math.isfinite(x) for x in numbers
    ):
        raise FormatError(f"{where}: controls, jaw (3), neck (3) and gaze (2) must be numbers")
    return Expression(
        id=row["id"],
        name=row["name"],
        description=row["description"],
        categories=tuple(row["categories"]),
        controls={key: float(value) for key, value in controls.items()},
        jaw=tuple(map(float, jaw)),
        neck=tuple(map(float, neck)),
        gaze=tuple(map(float, gaze)),
    )
