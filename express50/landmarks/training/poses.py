"""Random shape, expression and pose of the heads that the landmark detector learns from.

Most heads play entries of the 60-expression script, weaker, stronger, lopsided or two at once; the
others move random muscles, so that unscripted expressions occur as well.
"""

from __future__ import annotations

import numpy as np
import torch

from express50.capture.expressions import Expression, load_script
from express50.head.model import HeadModel

SCRIPTED_SHARE = 0.6
Rng = np.random.Generator


def random_parameters(model: HeadModel, rng: Rng) -> dict[str, torch.Tensor]:
    """Draw arguments for `express50.head.model.pose`, a batch of one."""
    shape = rng.normal(size=len(model.shape_names)) * rng.uniform(0.5, 1.4)
    jaw = rng.normal(size=3) * np.array([0.03, 0.03, 0.02])
    neck = rng.normal(size=3) * 0.15
    gaze = rng.normal(size=2) * np.array([0.2, 0.3])
    if not model.unit_expressions:
        expression = rng.normal(size=len(model.expression_names))
    elif rng.random() < SCRIPTED_SHARE:
        expression = np.zeros(len(model.expression_names))
        script = load_script()
        for number in rng.integers(len(script), size=1 + int(rng.random() < 0.25)):
            strength = rng.uniform(0.3, 1.15)
            expression += strength * _lopsided(script[number], model, rng)
            jaw += strength * np.array(script[number].jaw)
            gaze += strength * np.array([-script[number].gaze[1], script[number].gaze[0]])
    else:
        expression = _random_muscles(model, rng)
    if model.unit_expressions:
        _close_eyes(expression, model, rng)
        expression = np.clip(expression, -1.0, 1.2)
    if rng.random() < 0.25:
        jaw[0] = rng.uniform(0.0, 0.5)
    arguments = {
        "shape": shape,
        "expression": expression,
        "neck": neck,
        "jaw": jaw,
        "eyes": np.array([*gaze, 0.0, *gaze, 0.0]),
    }
    return {
        name: torch.from_numpy(value.astype(np.float32))[None] for name, value in arguments.items()
    }


def _lopsided(entry: Expression, model: HeadModel, rng: Rng) -> np.ndarray:
    """Coefficients (X,) of a script entry; in some draws one side of the face does less."""
    sides = {"_L": 1.0, "_R": 1.0}
    if rng.random() < 0.3:
        sides[("_L", "_R")[rng.integers(2)]] = rng.uniform(0.0, 1.0)
    names = {name: column for column, name in enumerate(model.expression_names)}
    out = np.zeros(len(names))
    for name, value in entry.controls.items():
        gain = sides.get(name[-2:], 1.0) * rng.normal(1.0, 0.15)
        if name in names:
            out[names[name]] = gain * value
    return out


def _random_muscles(model: HeadModel, rng: Rng) -> np.ndarray:
    """Up to eight random directions (X,), weak ones likelier than strong ones."""
    count = len(model.expression_names)
    out = np.zeros(count)
    active = rng.choice(count, size=rng.integers(0, min(9, count + 1)), replace=False)
    out[active] = rng.beta(1.0, 1.2, size=active.size)
    return out


def _close_eyes(expression: np.ndarray, model: HeadModel, rng: Rng) -> None:
    """A blink in some draws, a wink in others, in place."""
    kind = rng.random()
    if kind > 0.22:
        return
    sides = "LR" if kind < 0.1 else "LR"[rng.integers(2)]
    for side in sides:
        name = f"eyeBlink_{side}"
        if name in model.expression_names:
            expression[model.expression_names.index(name)] = rng.uniform(0.6, 1.0)
