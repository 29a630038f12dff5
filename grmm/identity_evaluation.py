"""Evaluate a model on people it never saw: fit them from a few views, measure on the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from express50.errors import ConfigError
from express50.geometry.sampling import evenly
from grmm.checkpoint import Checkpoint
from grmm.data import HeadViews
from grmm.evaluate import HELD_IDENTITY, Row, evaluate
from grmm.fit import run_stages, start
from grmm.metrics import PerceptualMetrics
from grmm.shard_source import select

NOVEL_VIEW = f"{HELD_IDENTITY}, novel view"
NOVEL_EXPRESSION = f"{HELD_IDENTITY}, other expression"


@dataclass(frozen=True, kw_only=True)
class FitProtocol:
    """The views of an unseen person that a fit gets.

    Attributes:
        cameras: patterns of those to fit from; empty: the first by id.
        expression: patterns of those to fit; others are rendered with the codes of training.
        images: the most to measure per person and kind, 0 = all.
    """

    cameras: tuple[str, ...] = ()
    expression: str = "neutral"
    images: int = 0


def evaluate_unseen(
    loaded: Checkpoint,
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
    given, own = unseen_views(loaded, views, subject, protocol, among)
    state = start(loaded, views, given)
    _, effort = run_stages(state, lambda: {})
    rows = []
    for kind, fitted in ((NOVEL_VIEW, True), (NOVEL_EXPRESSION, False)):
        chosen = [i for i in own if (views.keys[i].expression in state.z_exp) == fitted]
        chosen = evenly(chosen, protocol.images or len(chosen))
        rows += evaluate(views, chosen, state.render, judge, lambda key, kind=kind: kind, keep)
    cameras = sorted({views.keys[i].camera for i in given})
    return rows, {"subject": subject, "cameras": cameras} | effort


def unseen_views(
    loaded: Checkpoint,
    views: HeadViews,
    subject: str,
    protocol: FitProtocol,
    among: Sequence[int] | None = None,
) -> tuple[list[int], list[int]]:
    """Choose a person's views to fit from and to measure; see `evaluate_unseen`."""
    given = given_views(views, subject, protocol)
    cameras = {views.keys[i].camera for i in given}
    known = {*(views.keys[i].expression for i in given), *loaded.model.expressions}
    own = [
        i
        for i in (range(len(views.keys)) if among is None else among)
        if views.keys[i].subject == subject
        and views.keys[i].expression in known
        and views.keys[i].camera not in cameras
    ]
    if not own:
        raise ConfigError(
            f"{subject}: no view is left to measure: cameras {', '.join(sorted(cameras))} are "
            f"used for the fit, and only expressions {', '.join(sorted(known))} can be drawn"
        )
    return given, own


def given_views(views: HeadViews, subject: str, protocol: FitProtocol) -> list[int]:
    """Choose the views to fit from; a ConfigError says that the shards have none."""
    cameras = ",".join(protocol.cameras) or "*"
    try:
        given = select(views.keys, subject, protocol.expression, cameras)
    except ConfigError as error:
        raise ConfigError(
            f"{error}; --fit-cameras and --fit-expression choose the views to fit {subject} from"
        ) from error
    if protocol.cameras:
        return given
    first = min(views.keys[i].camera for i in given)
    return [i for i in given if views.keys[i].camera == first]
