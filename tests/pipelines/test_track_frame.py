"""A clip's frame: what its pictures say, kept as a quadratic, and where they move the head."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.track.appearance import EVEN_LIGHT, Appearance
from pipelines.track.config import TrackConfig
from pipelines.track.frame import Held, held_to_pictures
from pipelines.track.observe import Observation
from pipelines.track.pictures import Moment, skin_of
from pipelines.track.sequence import freeze_shape
from pipelines.track.sparse_head import make_basis
from pipelines.track.state import Pose, Target, start_state
from tests.pipelines.test_track_appearance import shot_of
from tests.pipelines.test_track_photometry import make_term
from tests.pipelines.textured_scenes import ball_head, rig

CONFIG = TrackConfig(samples=500, clip_rounds=3, photo_weight=1.0)


def test_a_held_term_has_the_cost_and_slope_of_the_term_where_it_was_taken() -> None:
    term, vertices = make_term(1.0)
    here = vertices + 3e-4
    held = Held.of(term, here)
    assert held.cost(here) == pytest.approx(term.cost(here))
    for one, other in zip(held.normal(here), term.normal(here), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_a_held_term_is_a_quadratic_whose_slope_is_its_own() -> None:
    term, vertices = make_term(0.3)
    held = Held.of(term, vertices)
    rng = np.random.default_rng(0)
    there = vertices + rng.normal(size=vertices.shape) * 1e-3
    way = rng.normal(size=vertices.shape)
    gradient = held.normal(there)[1]
    full = np.zeros_like(vertices)
    np.add.at(full, held.rows, held.bary[..., None] * gradient[:, None])
    slope = (held.cost(there + 1e-4 * way) - held.cost(there - 1e-4 * way)) / 2e-4
    assert (full * way).sum() == pytest.approx(slope, rel=1e-6)


def scene():
    """A painted ball that is a head, its crops, its colours, and a frame without landmarks."""
    model, cameras = ball_head(), rig()
    moment = Moment((), tuple(shot_of(camera) for camera in cameras))
    even = Appearance(EVEN_LIGHT, {c.id: np.ones(3) for c in cameras}, np.zeros((0, 3)))
    skin = skin_of(model, [moment], model.template.numpy()[None], even, CONFIG)
    basis = make_basis(model)
    person = freeze_shape(basis, np.zeros(basis.shape_size), np.zeros((68, 3)))
    unknown = np.full((68, 3), np.nan)
    nothing = Observation("smile", 0, (), np.zeros((0, 68), bool), unknown, np.zeros((68, 3, 3)))
    target = Target(nothing, np.zeros((0, 68)), neutral=False)
    return person, target, moment, skin


@pytest.mark.parametrize("move", [(8e-4, -6e-4, 0.0), (0.0, 0.0, 1.5e-3), (5e-4, 5e-4, -1e-3)])
def test_pictures_bring_a_head_home(move: tuple[float, float, float]) -> None:
    person, target, moment, skin = scene()
    pose = start_state(person, [(np.eye(3), np.array(move))]).poses[0]
    seen, found = held_to_pictures(person, target, pose, moment, skin, CONFIG)
    assert np.linalg.norm(found.own[-3:]) < 0.3 * np.linalg.norm(move)
    assert len(seen.terms) == 2 and all(isinstance(term, Held) for term in seen.terms)


def test_without_pictures_or_rounds_a_frame_stays_as_it_is() -> None:
    person, target, moment, skin = scene()
    pose = start_state(person, [(np.eye(3), np.full(3, 1e-3))]).poses[0]
    blind = held_to_pictures(person, target, pose, Moment((), ()), skin, CONFIG)
    idle = held_to_pictures(person, target, pose, moment, skin, TrackConfig(clip_rounds=0))
    assert blind == idle == (target, pose) and isinstance(pose, Pose)
