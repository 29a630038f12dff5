"""Faces are followed through a clip; one that is lost is searched for again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from express50.geometry.cameras import project
from express50.head.load import load_head
from express50.landmarks.detector import Detection, detect, detect_at
from express50.landmarks.irises import Irises
from express50.landmarks.network import face_box, load_network
from express50.landmarks.sources import Marked
from express50.landmarks.training.random_heads import random_head
from express50.landmarks.training.views import HeadScene
from pipelines.track.basis import freeze_shape
from pipelines.track.observe import triangulate_views
from pipelines.track.read_inputs import (
    FOLLOWED_VIEWS,
    _facing_cameras,
    _find_face,
    open_follower,
    search_all_views,
)
from pipelines.track.sequence import ClipTracker, track_window
from pipelines.track.stage import single_view_warnings
from pipelines.track.state import Target, start_state
from pipelines.track.terms import landmark_anchors
from tests.express50.landmarks.test_landmarks import on_canvas
from tests.pipelines.test_sequence import observations, unseen
from tests.pipelines.test_track import make_camera, make_scene, make_views

CAMERAS = {c.id: c for c in map(make_camera, (-2.8, -0.9, -0.5, 0.0, 0.5, 0.9, 2.8))}
SIGHT = 40.0  # pixels off its place at which a follower still sees a face


def marks(shift: float = 0.0) -> np.ndarray:
    model = load_head("procedural")
    places = landmark_anchors(model).at(model.template.double().numpy())
    return places - places.mean(0) + [shift, 0.0, 0.0]


class Stage:
    """Cameras before a face; counts how often it is searched for and followed."""

    def __init__(self, true: np.ndarray | None) -> None:
        self.true, self.searched, self.followed = true, 0, 0

    def seen(self, camera_id: str, near: np.ndarray | None = None) -> Marked:
        if self.true is None:
            points, score = np.zeros((68, 2)), 0.0
        else:
            points = project(CAMERAS[camera_id], self.true)[0]
            far = near is not None and np.linalg.norm(points - near, axis=1).mean() > SIGHT
            score = 0.0 if far else 0.9
        face = Detection(points, np.ones(68), np.ones(68), score)
        return Marked(face, Irises(np.zeros((2, 2)), np.full(2, np.inf), np.zeros(2)), False)

    def search(self, image: str, camera_id: str, frame: int) -> Marked:
        self.searched += 1
        return self.seen(camera_id)

    def follow(self, image: str, expected: np.ndarray) -> Marked:
        self.followed += 1
        return self.seen(image, expected)

    def look(self, expected: np.ndarray | None, peaks=(), follow: bool = True):  # noqa: ANN201
        """Images stand for themselves: each is its camera's name."""
        way: Callable | None = self.follow if follow else None
        return _find_face(str, CAMERAS, self.search, way, list(peaks), "smile", 7, expected)


def test_a_face_near_its_place_is_followed_in_the_views_it_looks_at() -> None:
    stage = Stage(marks())
    found = stage.look(marks(0.005))
    assert stage.searched == 0 and stage.followed == 5
    assert {view.camera_id for view in found.views} == set(_facing_cameras(CAMERAS, marks()))
    np.testing.assert_allclose(found.points, marks(), atol=1e-6)


@pytest.mark.parametrize(("found", "searches"), [(("cam-0.50",), 2), (("cam-0.50", "cam+0.50"), 1)])
def test_a_face_that_the_search_misses_is_found_where_the_rig_says(
    found: tuple[str, ...], searches: int
) -> None:
    stage = Stage(marks())

    def search(image: str, camera_id: str, frame: int) -> Marked:
        seen = stage.search(image, camera_id, frame)
        return seen if camera_id in found else Stage(None).seen(camera_id)

    # The second source, which takes long, is for rigs that show no more than one face.
    views = search_all_views(str, CAMERAS, 7, [search, search], stage.follow)
    assert stage.searched == searches * len(CAMERAS) - (searches - 1) * len(found)
    assert {view.camera_id for view in views} == set(_facing_cameras(CAMERAS, marks()))
    observation, refused = triangulate_views("smile", 7, views)
    np.testing.assert_allclose(observation.points, marks(), atol=1e-6)
    assert not refused
    searched = search_all_views(str, CAMERAS, 7, [search], None)
    assert {view.camera_id for view in searched} == set(found)


def test_a_face_that_one_of_several_cameras_shows_is_warned_of() -> None:
    stage = Stage(marks())

    def search(image: str, camera_id: str, frame: int) -> Marked:
        seen = stage.search(image, camera_id, frame)
        return seen if camera_id == "cam-0.50" else Stage(None).seen(camera_id)

    (view,) = search_all_views(str, CAMERAS, 7, [search], None)
    alone, _ = triangulate_views("smile", 7, [view])
    (note,) = single_view_warnings([alone], CAMERAS)
    assert note.what == "smile" and f"in cam-0.50 alone of {len(CAMERAS)} cameras" in note.why
    assert single_view_warnings([alone], {"cam-0.50": CAMERAS["cam-0.50"]}) == []


def test_a_small_face_on_its_side_is_seen_where_it_is_expected() -> None:
    model, rng = load_head("procedural"), np.random.default_rng(12)
    view = HeadScene(model, random_head(model, rng)).render(rng, 208, 0.3)
    image = np.ascontiguousarray(np.rot90(on_canvas(view.rgba, 5, (150, 120))))
    image = np.pad(image, ((0, 1200), (0, 1200), (0, 0)), constant_values=90)
    x, y = (view.points[:68] + (150, 120)).T
    true = np.stack([y, 400 - x], axis=1)
    net = load_network()
    assert detect(net, image).score < 0.2
    look = open_follower("embedded", detect_at)
    found = look(image, true + (12, -9)).face
    assert found.score > 0.5
    off = np.linalg.norm(found.points - true, axis=1)[17:].mean()
    assert off < 0.04 * face_box(true)[1]


@pytest.mark.parametrize("cut", [0.3, -0.2])
def test_after_a_cut_the_face_is_searched_for_anew(cut: float) -> None:
    stage = Stage(marks(cut))
    found = stage.look(marks())
    assert stage.searched == len(CAMERAS)
    np.testing.assert_allclose(found.points, marks(cut), atol=1e-6)


def test_a_clip_begins_where_its_peak_was() -> None:
    views = make_views(marks(), cameras=list(CAMERAS.values())[1:-1])
    peak = triangulate_views("smile", 3, views)[0]
    stage = Stage(marks(0.004))
    assert stage.look(None, [peak]) is not None and stage.searched == 0
    gone = Stage(marks(0.3))
    assert gone.look(marks(), [peak]) is not None and gone.searched == len(CAMERAS)


def test_sources_that_cannot_follow_search_the_whole_picture() -> None:
    stage = Stage(marks())
    assert stage.look(marks(), follow=False) is not None
    assert stage.searched == len(CAMERAS) and stage.followed == 0
    assert open_follower("points.npz") is None


def test_a_frame_without_a_face_is_none() -> None:
    stage = Stage(None)
    assert stage.look(marks()) is None and stage.look(None) is None
    assert stage.searched == 2 * len(CAMERAS)


def test_no_more_views_are_followed_than_are_of_use() -> None:
    many = {c.id: c for c in (make_camera(a) for a in np.linspace(-1.2, 1.2, 30))}
    chosen = _facing_cameras(many, marks())
    assert len(chosen) == FOLLOWED_VIEWS
    assert max(abs(float(name[3:])) for name in chosen) < 0.6
    # Beyond the frame's edge there is nothing to follow.
    assert _facing_cameras(many, marks() + [0.0, 3.0, 0.0]) == []


def test_after_a_lost_frame_the_next_is_looked_for_everywhere() -> None:
    scene = make_scene()
    person = freeze_shape(scene.basis, scene.shape, np.zeros((68, 3)))
    seen = observations(scene, 0.2)[:5]
    asked: list[np.ndarray | None] = []

    def look(frame: int) -> Callable:
        def answer(expected: np.ndarray | None):  # noqa: ANN202
            asked.append(expected)
            return None if frame == 2 else seen[frame]

        return answer

    found = track_window(ClipTracker(person), ((look(frame), unseen) for frame in range(5)))
    assert sorted(found) == [0, 1, 3, 4]
    assert [one is None for one in asked] == [True, False, False, True, False]
    assert np.linalg.norm(asked[4] - seen[3].points, axis=1).mean() < 0.004


def test_a_frame_whose_landmarks_fit_no_head_costs_only_itself() -> None:
    scene = make_scene()
    person = freeze_shape(scene.basis, scene.shape, np.zeros((68, 3)))
    seen = observations(scene, 0.2)[:5]
    seen[2] = replace(seen[2], points=3 * seen[2].points)  # three times as large as a head
    clip = [(lambda expected, one=one: one, unseen) for one in seen]
    assert sorted(track_window(ClipTracker(person), clip)) == [0, 1, 3, 4]


@pytest.mark.parametrize("shift", [(0, 0), (30, 0), (-20, 22), (3, -30)])
def test_a_face_that_jumps_thirty_pixels_is_found(shift: tuple[int, int]) -> None:
    model, rng = load_head("procedural"), np.random.default_rng(11)
    look = open_follower("embedded")
    errors = []
    for yaw in (0.0, 0.4, -0.5):
        view = HeadScene(model, random_head(model, rng)).render(rng, 208, yaw)
        image = on_canvas(view.rgba, 5, (150, 120))
        true = view.points[:68] + (150, 120)
        found = look(image, true - shift).face
        side = face_box(true)[1]
        assert found.score > 0.5
        errors.append(np.linalg.norm(found.points - true, axis=1)[17:].mean() / side)
    assert np.median(errors) < 0.03


def test_nothing_to_follow_scores_low() -> None:
    look = open_follower("embedded")
    somewhere = np.random.default_rng(2).uniform(20, 80, (68, 2))
    for at in (0.0, 500.0, -500.0):
        found = look(np.full((100, 90, 3), 128, np.uint8), somewhere + at).face
        assert found.score < 0.5 and np.isfinite(found.points).all()


def test_condensed_evidence_has_the_cost_and_slope_of_the_full_one() -> None:
    from pipelines.track.fit import condensed, fit
    from pipelines.track.state import State

    scene = make_scene()
    person = freeze_shape(scene.basis, scene.shape, np.zeros((68, 3)))
    seen = observations(scene, 0.5)[4]
    target = Target(seen, np.where(seen.inliers, 1.0, np.inf), neutral=False)
    start = start_state(person, [(scene.rotation, scene.own[-3:])])
    fitted, _ = fit(person, [target], start, 40)
    pose = fitted.poses[0]
    short = condensed(person, target, pose)
    assert not np.isfinite(short.sigma).any() and short.terms == ()
    again, _ = fit(person, [short], State(np.zeros(0), (pose,)), 5)
    np.testing.assert_allclose(again.poses[0].own, pose.own, atol=1e-4)
    # From beside the minimum both lead back to it.
    aside = pose.own + np.where(np.arange(len(pose.own)) >= len(pose.own) - 3, 1e-3, 0.0)
    back, _ = fit(person, [short], State(np.zeros(0), (type(pose)(aside, pose.rotation),)), 8)
    np.testing.assert_allclose(back.poses[0].own[-3:], pose.own[-3:], atol=1e-4)
