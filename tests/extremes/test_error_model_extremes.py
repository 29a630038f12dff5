"""Errors that stages expect, at the extremes: an interval or nothing, never NaN."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.contract.stage import ExpectedError
from express50.error_model import error_bounds, error_models, single_camera_sigma
from express50.geometry.cameras import Camera
from pipelines.matte.stage import rim_figures, rim_of

STAGES = ("calibrate", "align", "matte", "track", "depth", "register")
ANY = st.floats(allow_nan=True, allow_infinity=True)


@pytest.mark.parametrize("stage", STAGES)
def test_the_shipped_constants_rise_and_are_finite(stage):
    model = error_models()[stage]
    assert (np.diff(model.scores) > 0).all()
    for table in (model.typical, model.bound):
        assert np.isfinite(table).all() and (np.diff(table) >= 0).all()
    assert (model.bound >= model.typical).all()
    assert np.isfinite(model.weights).all() and (model.limits[:, 0] <= model.limits[:, 1]).all()
    assert 0 <= model.item[0] <= model.item[1] <= model.item[2]


@pytest.mark.parametrize("stage", STAGES)
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_figures_give_finite_bounds(stage, data):
    model = error_models()[stage]
    figures = {
        name: np.array(data.draw(st.lists(ANY, min_size=3, max_size=3))) for name in model.features
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = error_bounds(stage, figures)
    for values in (found.typical, found.bound):
        assert values.shape == (3,) and np.isfinite(values).all() and (values > 0).all()
    assert isinstance(found.expected, ExpectedError)


@pytest.mark.parametrize("stage", STAGES)
def test_nothing_to_judge_states_nothing(stage):
    figures = {name: np.zeros(0) for name in error_models()[stage].features}
    found = error_bounds(stage, figures)
    assert found.expected is None and found.bound.shape == (0,)


@pytest.mark.parametrize("stage", STAGES)
def test_a_figure_that_is_not_known_counts_as_the_worst(stage):
    model = error_models()[stage]
    middle = {n: np.exp(m) for n, m in zip(model.features, model.limits.mean(1), strict=True)}
    known = error_bounds(stage, middle).bound[0]
    for name in model.features:
        assert error_bounds(stage, middle | {name: np.nan}).bound[0] >= known


def test_a_lone_camera_does_not_know_how_far_away_a_head_is():
    one = Camera("a", 64, 64, "PINHOLE", (60, 60, 32, 32), np.eye(4))
    places = np.array([[0, 0, 1.0], [0, 0, 2.0]])
    assert single_camera_sigma([one, one], places).tolist() == [0, 0]
    near, far = single_camera_sigma([one], places)
    assert far == pytest.approx(2 * near) and 20 < near < 80
    figures = dict.fromkeys(error_models()["track"].features, 1.0)
    alone, together = (error_bounds("track", figures, s) for s in (np.array([near]), 0.0))
    assert alone.bound[0] > 1.6 * near > together.bound[0]
    assert alone.expected.low < 10 < near < alone.expected.high


@pytest.mark.parametrize("shape", [(1, 1), (2, 7), (64, 48)])
@pytest.mark.parametrize("fill", ["empty", "full", "pixel", "half", "noise"])
def test_mattes_of_any_content_give_an_interval_or_nothing(shape, fill):
    rng = np.random.default_rng(0)
    alpha = np.zeros(shape, np.uint8)
    if fill == "full":
        alpha[:] = 255
    elif fill == "pixel":
        alpha[0, 0] = 255
    elif fill == "half":
        alpha[:, shape[1] // 2 :] = 128
    elif fill == "noise":
        alpha = rng.integers(0, 256, shape, np.uint8)
    rgb = rng.integers(0, 256, (max(shape[0] // 2, 1), max(shape[1] // 2, 1), 3), np.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = error_bounds("matte", rim_figures(alpha, rgb, 1.0, plated=True, views=1))
    assert found.bound.shape == (rim_of(alpha).sum(),) and np.isfinite(found.bound).all()
    assert (found.expected is None) == (not found.bound.size)
