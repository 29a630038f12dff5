"""The step between the fit and the refinement by rendering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from express50.files.images import linear_to_srgb
from express50.geometry.mesh_render import sh_light
from pipelines.track import appearance as model_of_light
from pipelines.track.appearance import sh_basis
from pipelines.track.config import TrackConfig
from pipelines.track.pictures import Moment
from pipelines.track.render import radiance, rendered_like_pictures
from pipelines.track.shots import Shot
from pipelines.track.state import Pose, State, Target
from tests.pipelines.render_scenes import appearance, head, random_state, ring, shoot, vertices_of

PLACE = np.array([0.2, 1.1, -0.3])
RNG = np.random.default_rng(0)
MODEL = head().to(dtype=torch.float64)


def test_light_is_the_same_in_either_convention():
    normals = RNG.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = RNG.normal(size=(9, 3))
    there = sh_light(torch.from_numpy(normals), torch.from_numpy(radiance(light))).numpy()
    np.testing.assert_allclose(there, sh_basis(normals) @ light, atol=1e-12)


def test_a_head_that_was_moved_is_brought_back():
    """The first expression is where it was, its colours are baked; the second was pushed."""
    truth = random_state(2, PLACE)
    light = np.zeros((9, 3))
    light[0] = 0.8
    look = replace(appearance(), light=radiance(light), gains={})
    moments = [moment(truth, index, look) for index in range(2)]
    pushed = truth.poses[1].own.copy()
    pushed[-3:] += [0.0012, -0.0015, 0.0]
    start = State(truth.shape, (truth.poses[0], Pose(pushed, truth.poses[1].rotation)))
    known = model_of_light.Appearance(light, {}, np.zeros((0, 3)))
    targets = [Target(None, np.zeros((0, 68)), index == 0) for index in range(2)]  # type: ignore[arg-type]
    config = TrackConfig(render_rounds=3, texture_side=256)
    found = rendered_like_pictures(MODEL, targets, start, moments, known, config)
    assert error_mm(found, truth) < 0.5 * error_mm(start, truth)
    assert np.array_equal(found.bias, start.bias)


def test_nothing_seen_changes_nothing():
    state = random_state(1, PLACE)
    known = model_of_light.Appearance(np.zeros((9, 3)), {}, np.zeros((0, 3)))
    target = Target(None, np.zeros((0, 68)), True)  # type: ignore[arg-type]
    empty = [Moment((), ())]
    config = TrackConfig(render_rounds=1)
    assert rendered_like_pictures(MODEL, [target], state, empty, known, config) is state


def moment(state: State, index: int, look) -> Moment:
    """An expression's pictures as 8-bit crops."""
    shots = []
    for camera in ring(128, PLACE):
        shot = shoot(vertices_of(state, index), camera, look)
        levels = np.rint(255 * linear_to_srgb(np.clip(shot.image, 0, 1))).astype(np.uint8)
        alpha = np.rint(255 * np.nan_to_num(shot.alpha)).astype(np.uint8)
        shots.append(Shot(camera.id, camera, levels, alpha))
    return Moment((), tuple(shots))


def error_mm(state: State, truth: State) -> float:
    apart = vertices_of(state, 1) - vertices_of(truth, 1)
    return 1e3 * float(np.linalg.norm(apart, axis=1).mean())
