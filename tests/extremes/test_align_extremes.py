"""Alignment at the edges: faces without size, huge, tiny or still ones, windows of a frame."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotations.align.features import expression_values, measure, measure_features
from annotations.align.suggest import suggest, suggest_all
from annotations.observe.stage import (
    FACE,
    FaceObservations,
    align_faces,
    choose_cameras,
    frames_to_try,
    similarity_2d,
)
from express50.capture.expressions import load_script
from express50.capture.index import Cue
from express50.errors import StageError

SHAPE = np.random.default_rng(0).uniform(0, 1, (68, 2))
SMILE = next(e for e in load_script() if e.id == "smile")


def observed(points, faces=None):
    faces = np.zeros((len(points), FACE, FACE), np.uint8) if faces is None else faces
    frames = np.arange(len(points))
    scores = np.ones((1, len(points)))
    return FaceObservations(("a",), frames, points[None].astype(np.float32), scores, faces[None])


def suggested(points, windows, expression="smile"):
    features = measure(observed(points), windows)
    values = expression_values(features, SMILE, windows[expression])
    assert np.isfinite(values).all()
    return suggest(values, features.owner, None)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
@pytest.mark.parametrize("origin", [0.0, 1e5])
def test_suggestion_is_invariant_to_scale_and_position(scale, origin):
    rng = np.random.default_rng(1)
    course = np.exp(-0.5 * ((np.arange(40) - 28.0) / 2) ** 2)
    points = SHAPE + rng.normal(0, 0.002, (40, 68, 2))
    points[:, 48:68] += 0.05 * course[:, None, None]
    if scale < 1 and origin > 0:
        pytest.skip("a face of a thousandth of a pixel, far off, is below single precision")
    windows = {"neutral": np.arange(15), "smile": np.arange(15, 40)}
    found = suggested(scale * points + origin, windows)
    assert abs(15 + found.row - 28) <= 1


@pytest.mark.parametrize(
    "points", [np.zeros((6, 68, 2)), np.repeat(SHAPE[None], 6, axis=0) * 100], ids=["dot", "still"]
)
def test_face_without_size_or_motion_has_zero_confidence(points):
    windows = {"neutral": np.arange(3), "smile": np.arange(3, 6)}
    assert suggested(points, windows).confidence == 0.0


def test_frames_without_a_face_are_never_a_peak():
    """A grey frame's points lie anywhere, and so far from rest as no expression does."""
    points = SHAPE * 100 + np.random.default_rng(2).normal(0, 0.2, (30, 68, 2))
    points[12:20, 48:68] += np.array([0, 1, 2, 3, 3, 2, 1, 0])[:, None, None]
    points[24:27] = np.random.default_rng(3).uniform(0, 300, (3, 68, 2))
    seen = observed(points)
    seen.scores[0, [24, 25, 26, 29]] = 0.02
    cues = [Cue("neutral", 0, 9), Cue("smile", 10, 28), Cue("pucker", 29, 29)]
    watched = measure_features(SimpleNamespace(subject="S001", cues=cues), seen)
    assert set(watched.windows) == {"neutral", "smile"}
    found, _ = suggest_all(watched, {"smile": SMILE}, None)
    assert 14 <= watched.frames[watched.windows["smile"][found["smile"].row]] <= 17


def test_frames_are_tried_until_one_shows_a_face():
    scores = {3: 0.0, 0: 0.1, 6: 0.05, 40: 0.9}
    index = SimpleNamespace(subject="S001", cameras={"a": None, "b": None})
    tries = frames_to_try(np.array([0, 3, 6]), np.arange(0, 71, 10))
    assert tries[:3] == [3, 0, 6] and len(set(tries)) == len(tries)
    asked: list[float] = []

    def score(camera: str, frame: int, smallest: float) -> float:
        asked.append(smallest)
        return scores.get(frame, 0.0) if smallest < 0.1 or frame != 40 else 0.2

    looks = list(product((0.25, 0.08), tries))
    assert choose_cameras(index, score, looks, 0.3) == (0.08, 40, ["a", "b"])
    # Small windows take long, so they are searched last.
    assert asked[: 2 * len(tries)] == [0.25] * 2 * len(tries)
    with pytest.raises(StageError, match=r"0, 3, 6 .*0\.10"):
        choose_cameras(index, score, list(product((0.25, 0.08), tries[:3])), 0.3)


def test_windows_of_one_frame_and_windows_that_overlap():
    points = SHAPE * 100 + np.random.default_rng(2).normal(0, 0.2, (6, 68, 2))
    assert suggested(points, {"neutral": np.array([0]), "smile": np.array([5])}).row == 0
    both = {"neutral": np.arange(4), "smile": np.arange(2, 6)}
    assert 0 <= suggested(points, both).row < 4


def test_outlier_frame_does_not_beat_a_movement():
    rng = np.random.default_rng(3)
    points = SHAPE * 100 + rng.normal(0, 0.2, (40, 68, 2))
    course = np.exp(-0.5 * ((np.arange(40) - 28.0) / 3) ** 2)
    points[:, 48:68] += 8.0 * course[:, None, None]
    points[20] += rng.normal(0, 4.0, (68, 2))  # the detector lost the face for one frame
    windows = {"neutral": np.arange(15), "smile": np.arange(15, 40)}
    assert abs(15 + suggested(points, windows).row - 28) <= 2


def test_face_smaller_than_a_pixel_is_cut_out():
    image = np.full((4, 5, 3), 200, np.uint8)
    faces = align_faces([image], np.zeros((1, 68, 2)), np.zeros((68, 2)))
    assert faces.shape == (1, FACE, FACE)


@settings(max_examples=25, deadline=None)
@given(st.floats(1e-6, 1e6), st.floats(-3.1, 3.1), st.floats(-1e6, 1e6))
def test_a_similarity_is_undone_at_any_scale(scale, angle, shift):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = scale * SHAPE @ turn.T + shift
    A = similarity_2d(moved, SHAPE)
    back = moved @ A[:, :2].T + A[:, 2]
    precision = 1e-9 + 1e-13 * abs(shift) / scale
    np.testing.assert_allclose(back, SHAPE, atol=10 * precision)
