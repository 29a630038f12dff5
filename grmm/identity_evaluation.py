"""Evaluate a model on people it never saw: fit them from a few views, measure on the others."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from express50.errors import ConfigError
from grmm.checkpoint import Loaded
from grmm.data import HeadViews, Item
from grmm.evaluate import HELD_IDENTITY, Row, evaluate
from grmm.fit import FitState, run_stages, start
from grmm.perceptual_metrics import PerceptualMetrics
from grmm.sampler import spread
from grmm.scene import Rendering

NOVEL_VIEW = f"{HELD_IDENTITY}, novel view"
NOVEL_EXPRESSION = f"{HELD_IDENTITY}, other expression"


@dataclass(frozen=True, kw_only=True)
class FitProtocol:
    """The views of an unseen person that a fit gets.

    Attributes:
        cameras: patterns of the cameras to fit from; empty: the first by id.
        expression: the expression to fit; others are rendered with the codes of training.
        images: the most to measure per person and kind, 0 = all.
    """

    cameras: tuple[str, ...] = ()
    expression: str = "neutral"
    images: int = 0


def evaluate_unseen(
    loaded: Loaded,
    views: HeadViews,
    subject: str,
    protocol: FitProtocol,
    judge: PerceptualMetrics,
    keep: Callable[[int, Tensor], None] | None = None,
    among: Sequence[int] | None = None,
) -> tuple[list[Row], dict[str, Any]]:
    """Fit a person from the protocol's views; rows of its other views and expressions, effort.

    ``among`` are the indices to measure, by default all of the person's.

    Raises:
        ConfigError: the shards hold no such views, or nothing is left to measure.
    """
    given = given_views(views, subject, protocol)
    cameras = {views.keys[i].camera for i in given}
    known = {protocol.expression, *loaded.model.expressions}
    own = [
        i
        for i in (range(len(views.keys)) if among is None else among)
        if views.keys[i].subject == subject
        and views.keys[i].expression in known
        and views.keys[i].camera not in cameras
    ]
    if not own:
        raise ConfigError(
            f"{subject}: no view is left to measure: it is fitted from cameras "
            f"{', '.join(sorted(cameras))}, and expressions must be {', '.join(sorted(known))}"
        )
    state = start(loaded, views, given)
    _, effort = run_stages(state, lambda: {})
    rows = []
    for kind, fitted in ((NOVEL_VIEW, True), (NOVEL_EXPRESSION, False)):
        chosen = [i for i in own if (views.keys[i].expression in state.z_exp) == fitted]
        chosen = spread(chosen, protocol.images) if protocol.images else chosen
        rows += evaluate(
            views, chosen, any_expression(state), judge, lambda key, kind=kind: kind, keep
        )
    return rows, {"subject": subject, "cameras": sorted(cameras)} | effort


def given_views(views: HeadViews, subject: str, protocol: FitProtocol) -> list[int]:
    """Choose the views to fit from.

    Raises:
        ConfigError: the shards have none.
    """
    own = [
        i
        for i, key in enumerate(views.keys)
        if key.subject == subject and key.expression == protocol.expression
    ]
    cameras = sorted({views.keys[i].camera for i in own})
    patterns: Sequence[str] = protocol.cameras or cameras[:1]
    given = [i for i in own if any(fnmatch.fnmatchcase(views.keys[i].camera, p) for p in patterns)]
    if not given:
        raise ConfigError(
            f"{subject}: no view of expression {protocol.expression} by cameras "
            f"{', '.join(patterns) or 'any'}; {_what(views, subject, cameras)}"
        )
    return given


def _what(views: HeadViews, subject: str, cameras: Sequence[str]) -> str:
    """Describe what the shards have of a person, for an error."""
    if cameras:
        return f"its cameras are {', '.join(cameras)}"
    people = sorted({key.subject for key in views.keys})
    if subject not in people:
        return f"the shards have subjects {', '.join(people)}"
    shown = sorted({key.expression for key in views.keys if key.subject == subject})
    return f"its expressions are {', '.join(shown)}"


def any_expression(state: FitState) -> Callable[[Item], Rendering]:
    """Make a function that renders a fitted person in fitted and training expressions."""
    model = state.model

    def render(item: Item) -> Rendering:
        name = item.key.expression
        if name in state.z_exp:
            z_exp = state.z_exp[name]
        else:
            z_exp = model.z_exp[model.expressions.index(name)]
        return model.render(state.z_id, z_exp, item.state, item.view, state.views.background)

    return render
