"""A frame of a clip is moved to the surface that its pictures agree on."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.track.basis import freeze_shape, make_basis
from pipelines.track.observe import Observation
from pipelines.track.photo_consistency import skin_samples
from pipelines.track.sequence import ClipTracker, fit_to_pictures
from pipelines.track.state import Target, start_state
from pipelines.track.surface import CutCrops, FrameSetCrops
from pipelines.track.terms import NormalTerm
from tests.pipelines.test_track_appearance import crop_of
from tests.pipelines.textured_scenes import ball_head, rig


def scene(rounds: int = 3, seen: bool = True) -> tuple[ClipTracker, Target, CutCrops]:
    """A painted ball that is a head, its crops, and a frame without landmarks."""
    model = ball_head()
    pictures = FrameSetCrops((), tuple(crop_of(camera) for camera in rig()) if seen else ())
    basis = make_basis(model)
    person = freeze_shape(basis, np.zeros(basis.shape_size), np.zeros((68, 3)))
    unknown = np.full((68, 3), np.nan)
    nothing = Observation("smile", 0, (), np.zeros((0, 68), bool), unknown, np.zeros((68, 3, 3)))
    skin = skin_samples(model, 500)
    tracker = ClipTracker(person, skin=skin, rounds=rounds)
    return tracker, Target(nothing, np.zeros((0, 68)), neutral=False), lambda mesh: pictures


@pytest.mark.parametrize("move", [(0.0, 0.0, 1.5e-3), (5e-4, 5e-4, -1e-3)])
def test_pictures_bring_a_head_home(move: tuple[float, float, float]) -> None:
    tracker, target, look = scene()
    pose = start_state(tracker.person, [(np.eye(3), np.array(move))]).poses[0]
    seen, found = fit_to_pictures(tracker, target, pose, look)
    assert np.linalg.norm(found.own[-3:]) < 0.4 * np.linalg.norm(move)
    assert seen.terms and all(isinstance(term, NormalTerm) for term in seen.terms)


@pytest.mark.parametrize(("rounds", "seen"), [(0, True), (2, False)])
def test_without_pictures_or_rounds_a_frame_stays_as_it_is(rounds: int, seen: bool) -> None:
    tracker, target, look = scene(rounds, seen)
    pose = start_state(tracker.person, [(np.eye(3), np.full(3, 1e-3))]).poses[0]
    assert fit_to_pictures(tracker, target, pose, look) == (target, pose)
