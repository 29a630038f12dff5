"""Peaks of activity curves and of synthetic landmark motion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotations.suggest import (
    CROP,
    LIDS,
    ClipObservation,
    Suggestion,
    activity,
    candidates,
    displacements,
    landmark_weights,
    suggest_peak,
)
from express50.expressions import load_script

RNG = np.random.default_rng(0)
FACE = RNG.uniform(0, 100, (68, 2))
SCRIPT = {e.id: e for e in load_script()}


def _clip(points, crops=None):
    frames = len(points)
    crops = np.zeros((frames, CROP, CROP), np.float32) if crops is None else crops
    return ClipObservation(points, np.ones(frames), crops)


def test_the_middle_of_a_plateau_is_suggested_not_its_first_frame():
    curve = np.array([0, 0, 1, 4, 4, 4, 4, 4, 1, 0, 0], float)
    assert suggest_peak(curve, 100).frame == 105


def test_one_frame_and_a_flat_curve_have_an_answer():
    assert suggest_peak(np.array([2.0]), 7).frame == 7
    flat = suggest_peak(np.zeros(5), 0)
    assert flat.confidence == 0.0
    assert 0 <= flat.frame < 5


def test_neutral_takes_the_calmest_frame():
    assert suggest_peak(np.array([3.0, 1, 0, 0, 0, 2, 4]), 0, at_rest=True).frame == 3


@pytest.mark.parametrize("curve", [np.array([]), np.array([1.0, np.nan])])
def test_a_curve_without_numbers_is_refused(curve):
    with pytest.raises(ValueError, match="finite"):
        suggest_peak(curve, 0)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=40), st.integers(0, 1000))
def test_a_suggestion_lies_in_its_window(values, first):
    found = suggest_peak(np.array(values), first)
    assert first <= found.frame < first + len(values)
    assert 0.0 <= found.confidence <= 1.0


def test_head_motion_is_no_expression():
    angle = 0.3
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = 1.4 * FACE @ R.T + [30, -20]
    np.testing.assert_allclose(displacements(moved[None], FACE), 0.0, atol=1e-9)


def test_a_blink_does_not_pass_for_a_smile():
    frames = 9
    points = np.repeat(FACE[None], frames, axis=0) + RNG.normal(0, 0.05, (frames, 68, 2))
    points[2, LIDS] += 6.0  # the blink, stronger than the smile
    smile = np.exp(-((np.arange(frames) - 6.0) ** 2) / 2)
    points[:, 48:68] += 3.0 * smile[:, None, None]
    rest = _clip(np.repeat(FACE[None], 5, axis=0) + RNG.normal(0, 0.05, (5, 68, 2)))
    curve = activity([_clip(points)], [rest], SCRIPT["smile"])
    assert suggest_peak(curve, 0).frame == 6


def test_looks_alone_can_tell_a_peak():
    frames = 7
    crops = np.zeros((frames, CROP, CROP), np.float32)
    crops[4, 20:40, 20:40] = 0.8  # a tongue that moves no landmark
    points = np.repeat(FACE[None], frames, axis=0)
    curve = activity([_clip(points, crops)], [_clip(points[:3])], SCRIPT["neutral"])
    assert suggest_peak(curve, 0).frame == 4


def test_every_scripted_expression_has_points_that_take_part():
    for expression in SCRIPT.values():
        assert landmark_weights(expression).sum() > 0
    assert landmark_weights(SCRIPT["smile"])[LIDS].sum() == 0


def test_candidates_are_maxima_apart_with_the_suggestion_first():
    curve = np.array([0, 3, 1, 0, 0, 5, 4.9, 0, 2, 0.0])
    assert candidates(Suggestion(105, 0.9, curve), 100) == [105, 101, 108]
    assert candidates(Suggestion(7, 0.1, np.ones(1)), 7) == [7]
    assert len(candidates(Suggestion(0, 0.5, np.tile([1.0, 0, 0], 40)), 0)) == 5
