"""Shut eyes are recognised by irises that cameras find at other times, shut lips by their gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.geometry.cameras import project
from express50.geometry.transforms import axis_angle_to_matrix
from express50.head.load import load_head
from express50.head.model import landmarks, landmarks_of, pose
from express50.landmarks.irises import EYES, Irises
from express50.landmarks.network import INNER_LIPS
from pipelines.track.basis import make_basis
from pipelines.track.eyes_and_jaw import shut_lids, shut_terms
from pipelines.track.fit import fit
from pipelines.track.observe import LandmarkView, Observation, landmark_sigma, triangulate_views
from pipelines.track.state import Target, initial_pose, start_state
from tests.express50.head.tiny_head import tiny_head
from tests.pipelines.term_checks import cost_at, gradient_at, slope_along
from tests.pipelines.test_track import make_camera, make_scene

TIMES = ("neutral", "smile", "wink_left", "pucker")
LEFT, RIGHT = 0, 1
RIG = [make_camera(angle) for angle in np.linspace(-0.7, 0.7, 6)]


def face(lips_m: float = 0.01) -> np.ndarray:
    """Landmarks (68, 3) of a head before the rig, the lids a centimetre apart."""
    marks = make_scene().marks.copy()
    mouth = marks[27] - [0.0, 0.06, 0.0]
    marks[48], marks[54] = mouth - [0.025, 0, 0], mouth + [0.025, 0, 0]
    for ids, side in zip(INNER_LIPS, (0.5, -0.5), strict=True):
        marks[list(ids)] = mouth + np.outer((-0.01, 0.0, 0.01), (1, 0, 0)) + [0, side * lips_m, 0]
    for side, (first, last, upper, lower) in enumerate(EYES):
        middle = marks[27] + np.array([0.03 if side == LEFT else -0.03, 0.0, 0.0])
        marks[first], marks[last] = middle - [0.015, 0, 0], middle + [0.015, 0, 0]
        for rank, x in enumerate((-0.005, 0.005)):
            marks[upper[rank]] = middle + [x, 0.005, 0]
            marks[lower[rank]] = middle + [x, -0.005, 0]
    return marks


def observe(found: np.ndarray, time: str, marks: np.ndarray | None = None) -> Observation:
    """`found` (cameras, 2): whose irises are found; the first cameras of the rig."""
    marks = face() if marks is None else marks
    views = []
    for camera, sides in zip(RIG, found, strict=False):
        sigma = np.where(sides, 1.0, np.inf)
        irises = Irises(np.zeros((2, 2)), sigma, np.where(sides, 0.5, 0.0))
        pixels = project(camera, marks)[0]
        views.append(LandmarkView(camera, pixels, np.ones(68), 0.9, irises))
    return triangulate_views(time, TIMES.index(time), views)[0]


def gap(observation: Observation, side: int) -> float:
    """Between the lids of an eye in the first camera, pixels."""
    upper, lower = (list(lid) for lid in EYES[side][2:])
    points = observation.views[0].points
    return float(np.linalg.norm(points[upper] - points[lower], axis=1).mean())


def seen(count: int) -> dict[str, np.ndarray]:
    return {time: np.ones((count, 2), dtype=bool) for time in TIMES}


@pytest.mark.parametrize("count", [1, len(RIG)])
def test_an_eye_without_its_iris_is_shut(count):
    found = seen(count)
    found["wink_left"][:, LEFT] = False
    before = [observe(table, time) for time, table in found.items()]
    after = shut_lids(before)
    wink = TIMES.index("wink_left")
    assert gap(after[wink], LEFT) < 0.2 * gap(before[wink], LEFT)
    assert gap(after[wink], RIGHT) == gap(before[wink], RIGHT)
    assert all(a is b for k, (a, b) in enumerate(zip(after, before, strict=True)) if k != wink)
    if count > 1:
        upper, lower = (list(lid) for lid in EYES[LEFT][2:])
        apart = np.linalg.norm(after[wink].points[upper] - after[wink].points[lower], axis=1)
        assert apart.max() < 0.002


def test_eyes_shut_in_a_whole_clip_are_found_by_other_clips():
    shut, open_ = np.zeros((3, 2), dtype=bool), np.ones((3, 2), dtype=bool)
    clip = [observe(shut, "neutral") for _ in range(8)]
    assert all(not seen.shut for seen in shut_lids(clip))
    peaks = [observe(open_, time) for time in TIMES]
    assert all(seen.shut == (LEFT, RIGHT) for seen in shut_lids(clip, peaks))
    assert not shut_lids([observe(open_, "smile")], peaks)[0].shut
    assert not shut_lids(clip, [])[0].shut


def test_one_iris_found_by_chance_does_not_open_an_eye():
    found = seen(len(RIG))
    found["wink_left"][1:, LEFT] = False
    observations = [observe(table, time) for time, table in found.items()]
    assert gap(shut_lids(observations)[2], LEFT) < 0.2 * gap(observations[2], LEFT)


def test_half_of_the_irises_are_an_open_eye():
    found = seen(len(RIG))
    found["wink_left"][::2, LEFT] = False
    observations = [observe(table, time) for time, table in found.items()]
    assert all(a is b for a, b in zip(shut_lids(observations), observations, strict=True))


def test_cameras_that_never_find_an_iris_shut_no_lids():
    found = {time: np.zeros((len(RIG), 2), dtype=bool) for time in TIMES}
    observations = [observe(table, time) for time, table in found.items()]
    assert all(a is b for a, b in zip(shut_lids(observations), observations, strict=True))


def test_an_eye_that_turned_away_is_not_shut():
    found = seen(len(RIG))
    found["wink_left"][:, LEFT] = False
    observations = [observe(table, time) for time, table in found.items()]
    narrow = []
    for view in observations[2].views:
        points = view.points.copy()
        first, last = EYES[LEFT][:2]
        points[last] = points[first] + 0.5 * (points[last] - points[first])
        narrow.append(replace(view, points=points))
    observations[2] = replace(observations[2], views=tuple(narrow))
    assert shut_lids(observations)[2] is observations[2]


def test_without_irises_and_without_observations():
    plain = [observe(table, time) for time, table in seen(2).items()]
    plain = [replace(o, views=tuple(replace(v, irises=None) for v in o.views)) for o in plain]
    assert all(a is b for a, b in zip(shut_lids(plain), plain, strict=True))
    assert shut_lids([]) == []


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), shut=st.sampled_from([(0,), (1,), (0, 1)]))
def test_the_lids_term_has_the_slope_it_says(seed, shut):
    rng = np.random.default_rng(seed)
    observation = replace(observe(np.ones((3, 2), dtype=bool), "neutral"), shut=shut)
    (term,) = shut_terms(tiny_head(), observation)
    assert len(term.anchors.vertices) == 2 * len(shut)
    vertices = rng.normal(size=(200, 3)) * 0.01
    way = rng.normal(size=vertices.shape)
    slope = (gradient_at(term, vertices) * way).sum()
    assert slope_along(term, vertices, way) == pytest.approx(slope, rel=1e-5, abs=1e-3)
    turn = axis_angle_to_matrix(rng.normal(size=3))
    moved = vertices @ turn.T + 1000.0
    assert cost_at(term, moved) == pytest.approx(cost_at(term, vertices), rel=1e-5)


def test_eyes_that_are_known_to_be_shut_shut_the_mesh():
    """The detector sees the lids of a wink nearly as far apart as open ones; the fit shuts them."""
    head = load_head("procedural")
    wink = torch.zeros(1, len(head.expression_names))
    wink[0, head.expression_names.index("eyeBlink_L")] = 0.15
    still = torch.zeros(1, 1)
    marks = landmarks(head, pose(head, still, wink))[0].double().numpy()
    marks = marks - marks.mean(0)
    found = seen(len(RIG)) | {"wink_left": np.tile([False, True], (len(RIG), 1))}
    observation = shut_lids([observe(table, time, marks) for time, table in found.items()])[2]
    assert observation.shut == (LEFT,) and len(shut_terms(head, observation)) == 1
    basis = make_basis(head)
    template = landmarks_of(head).astype(np.float64)
    start = start_state(basis, [initial_pose(observation, template)])
    sigma = landmark_sigma(observation)
    fitted = {}
    for known in (True, False):
        terms = shut_terms(head, observation) if known else ()
        state, _ = fit(basis, [Target(observation, sigma, False, terms=terms)], start, 20)
        blink = state.poses[0].own[[head.expression_names.index(f"eyeBlink_{s}") for s in "LR"]]
        fitted[known] = blink
    assert fitted[True][LEFT] > max(0.94, fitted[False][LEFT])
    assert abs(fitted[True][RIGHT]) < 0.1


def test_open_eyes_and_lips_add_no_term():
    assert shut_terms(tiny_head(), observe(np.ones((3, 2), dtype=bool), "neutral")) == ()


@pytest.mark.parametrize("count", [1, len(RIG)])
def test_lips_that_are_hardly_seen_apart_meet(count):
    (term,) = shut_terms(tiny_head(), observe(np.ones((count, 2), bool), "neutral", face(0.0005)))
    assert len(term.anchors.vertices) == 3
    assert cost_at(term, np.zeros((200, 3))) == 0.0


def test_lips_that_nobody_sees_are_not_shut():
    seen_by = observe(np.ones((2, 2), dtype=bool), "neutral", face(0.0))
    blind = [replace(view, sigma=np.full(68, np.inf)) for view in seen_by.views]
    assert shut_terms(tiny_head(), replace(seen_by, views=tuple(blind))) == ()
