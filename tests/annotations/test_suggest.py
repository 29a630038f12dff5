"""Events of synthetic clips: which movement, which frame of it, and how sure."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotations.align.suggest import (
    Canonical,
    candidate_rows,
    canonical_of,
    strongest_event,
    suggest,
    suggest_rest,
)

N = 120
GROUPS = np.arange(N) // 4
SAME = np.stack([np.arange(N), np.arange(N)])


def direction(seed):
    """A unit vector of N features."""
    vector = np.random.default_rng(seed).normal(size=N)
    return vector / np.linalg.norm(vector)


def bump(frames, apex, width=3.0):
    """A movement's course (frames,), 1 at its apex."""
    return np.exp(-0.5 * ((np.arange(frames) - apex) / width) ** 2)


def clip(*movements, noise=0.3, seed=0):
    """Features of a clip: (course, direction seed, strength) of each movement, and noise."""
    values = sum(strength * np.outer(course, direction(way)) for course, way, strength in movements)
    return values + noise * np.random.default_rng(seed).normal(size=values.shape)


def test_middle_of_a_plateau_is_suggested():
    course = np.array([0, 0, 1, 4, 4, 4, 4, 4, 1, 0, 0], float)
    assert suggest(np.outer(course, direction(1)), GROUPS, None).row == 5


def test_clear_movement_has_high_confidence_and_noise_low():
    sure = suggest(clip((bump(30, 17), 1, 20.0)), GROUPS, None)
    vague = suggest(clip((bump(30, 17), 1, 0.0)), GROUPS, None)
    assert abs(sure.row - 17) <= 1
    assert sure.confidence > 0.9
    assert vague.confidence < 0.5


def test_still_face_gets_a_suggestion_with_zero_confidence():
    still = suggest(np.zeros((5, N)), GROUPS, None)
    assert 0 <= still.row < 5
    assert still.confidence == 0.0
    assert suggest(np.ones((1, N)), GROUPS, None).row == 0


@pytest.mark.parametrize("values", [np.zeros((0, N)), np.full((3, N), np.nan)])
def test_empty_or_nan_features_are_refused(values):
    with pytest.raises(ValueError):
        suggest(values, GROUPS, None)
    with pytest.raises(ValueError):
        suggest_rest(values, GROUPS, 1.0)


def test_movement_most_like_the_reference_is_chosen():
    reference = canonical_of(clip((bump(30, 12), 1, 20.0)), 12, SAME, N)
    values = clip((bump(40, 8), 1, 12.0), (bump(40, 28), 2, 25.0))
    assert strongest_event(values).apex == pytest.approx(28, abs=1)
    matched = suggest(values, GROUPS, reference)
    assert matched.row == pytest.approx(8, abs=1)
    assert matched.confidence < 0.7  # two movements: a person should look
    assert any(abs(row - 28) <= 1 for row in matched.candidates)


def test_reference_with_another_movement_does_not_overrule_the_clip():
    reference = canonical_of(clip((bump(30, 12), 7, 20.0)), 12, SAME, N)
    assert suggest(clip((bump(40, 28), 2, 25.0)), GROUPS, reference).row == pytest.approx(28, abs=1)


@pytest.mark.parametrize("side", [-1, 1])
def test_canonical_frame_off_the_apex_matches_an_equal_share_of_the_movement(side):
    course = bump(40, 15, 5.0)
    row = 15 + side * 6
    reference = canonical_of(clip((course, 1, 30.0)), row, SAME, N)
    assert reference.side == side
    assert reference.level == pytest.approx(course[row], abs=0.08)
    other = bump(50, 25, 8.0)
    found = suggest(clip((other, 1, 18.0), seed=3), GROUPS, reference)
    assert np.sign(found.row - 25) == side
    assert other[found.row] == pytest.approx(course[row], abs=0.12)
    assert found.match is not None
    assert found.match.max() == pytest.approx(found.match[found.row], abs=0.05)


def test_only_shared_features_are_compared():
    theirs = clip((bump(30, 12), 1, 20.0))
    shared = np.stack([np.arange(N // 2), np.arange(N // 2)])
    reference = canonical_of(theirs, 12, shared, N)
    assert not reference.direction[N // 2 :].any()
    assert suggest(clip((bump(30, 20), 1, 15.0)), GROUPS, reference).row == pytest.approx(20, abs=1)


def test_still_reference_has_no_effect():
    empty = Canonical(np.zeros(N), 1.0, 0)
    values = clip((bump(30, 20), 1, 15.0))
    assert suggest(values, GROUPS, empty).row == suggest(values, GROUPS, None).row


def test_rest_is_the_calmest_frame():
    course = np.concatenate([bump(8, 0), np.zeros(12)])
    found = suggest_rest(clip((course, 1, 20.0)), GROUPS, typical=20.0)
    assert found.row > 6
    assert found.confidence > 0.9


def test_candidates_keep_their_distance_and_start_with_the_suggestion():
    curve = np.array([0, 5, 0, 0, 9, 0, 0, 7, 6.9, 0, 0, 1, 0.0])
    assert candidate_rows(4, [7], curve) == [4, 7, 1, 11]


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 40), st.integers(0, 1000), st.floats(0, 1e6), st.floats(1e-6, 1e3),
    st.one_of(st.none(), st.floats(0, 1)),
)  # fmt: skip
def test_a_suggestion_lies_in_its_clip_and_is_finite(frames, seed, strength, noise, level):
    values = clip((bump(frames, frames / 2), 1, strength), noise=noise, seed=seed)
    reference = None if level is None else Canonical(direction(1), level, -1 if level < 0.9 else 0)
    found = suggest(values, GROUPS, reference)
    assert 0 <= found.row < frames
    assert 0.0 <= found.confidence <= 1.0
    assert np.isfinite(found.activity).all()
    assert found.candidates[0] == found.row
    assert all(0 <= row < frames for row in found.candidates)
    again = suggest(values, GROUPS, reference)
    assert (again.row, again.confidence) == (found.row, found.confidence)
