"""Sheets of pictures that show what the model's parameters do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grmm.checkpoint import Loaded
from grmm.edit import (
    Head,
    controlled,
    principal_directions,
    sample_expression,
    sample_identity,
    trained_head,
    transfer,
)
from grmm.render import picture
from grmm.scene import View

Sheet = tuple[list[list[np.ndarray]], list[str]]
STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
TURNS = {  # what a step of 1 means: entry and radians
    "neck, yaw": ("neck.1", 0.35),
    "eyes, yaw": ("eyes", 0.4),
}
JAW_OPEN = 0.35  # radians
DEVIATIONS = 1.5  # standard deviations a step of 1 moves a code


def control_sheet(loaded: Loaded, head: Head, view: View) -> Sheet:
    """Rows that change one thing each, all else held (the paper's figure of disentangled control).

    Jaw, neck and eyes; the strongest expression coefficients of training; the first principal
    directions of z_id and z_exp. A code without directions (one subject) has no row.
    """
    changes: dict[str, list[dict[str, tuple[float, ...]]]] = {
        "jaw": [{"jaw": (JAW_OPEN * (step + 1) / 2, 0.0, 0.0)} for step in STEPS]
    }
    for label, (name, reach) in TURNS.items():
        values = [reach * step for step in STEPS]
        changes[label] = [{name: (0.0, v, 0.0) if name == "eyes" else (v,)} for v in values]
    for number in strongest_coefficients(loaded, 2):
        size = max(abs(f.expression[number]) for f in loaded.gallery.frames.values())
        name = f"expression.{number}"
        label = loaded.head.expression_names[number]
        changes[label] = [{name: (size * (step + 1) / 2,)} for step in STEPS]
    for code in ("z_id", "z_exp"):
        for number in range(min(2, len(principal_directions(getattr(loaded.model, code))))):
            name = f"{code}.{number}"
            changes[name] = [{name: (DEVIATIONS * step,)} for step in STEPS]
    rows = [
        [picture(loaded, controlled(loaded, head, change), view) for change in row]
        for row in changes.values()
    ]
    return rows, list(changes)


def strongest_coefficients(loaded: Loaded, count: int) -> list[int]:
    """Numbers of the expression coefficients that vary most over the training frames."""
    length = max(len(f.expression) for f in loaded.gallery.frames.values())
    rows = [np.pad(f.expression, (0, length - len(f.expression))) for f in _frames(loaded)]
    order = np.argsort(-np.std(rows, axis=0), kind="stable")
    return [int(number) for number in order[:count]]


def _frames(loaded: Loaded) -> list:
    return list(loaded.gallery.frames.values())


def residual_sheet(loaded: Loaded, identity: Head, expression: Head, view: View) -> Sheet:
    """What transfer is made of: head-model parameters and residual code, alone and together.

    Columns: neither, parameters alone, code alone, both, and both with z_exp = 0, which shows
    what the expression code carries (the paper's supplement, figure on the extended UV map).
    """
    moved = transfer(identity.tracked, expression.tracked)
    both = replace(identity, tracked=moved, z_exp=expression.z_exp)
    heads = [
        identity,
        replace(identity, tracked=moved),
        replace(identity, z_exp=expression.z_exp),
        both,
        controlled(loaded, both, {"z_exp": (0.0,)}),
        expression,
    ]
    labels = ["identity | FLAME moved | z_exp moved | both | both, z_exp = 0 | donor"]
    return [[picture(loaded, head, view) for head in heads]], labels


def sample_sheet(
    loaded: Loaded, head: Head, view: View, count: int, seed: int, spread: float = 1.0
) -> tuple[Sheet, dict[str, list[Head]]]:
    """Three rows of samples, and their heads: new people, new expressions, both."""
    rng = np.random.default_rng(seed)
    neutral = head
    if "neutral" in loaded.model.expressions:
        neutral = trained_head(loaded, loaded.model.subjects[0], "neutral")
    people = [sample_identity(loaded, neutral, rng, spread) for _ in range(count)]
    faces = [sample_expression(loaded, head, rng, spread) for _ in range(count)]
    rows = {
        "new people": people,
        "new expressions": faces,
        "both": [sample_expression(loaded, person, rng, spread) for person in people],
    }
    pictures = [[picture(loaded, one, view) for one in row] for row in rows.values()]
    return (pictures, list(rows)), rows
