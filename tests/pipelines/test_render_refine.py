"""Render-and-compare refinement, on pictures of the procedural head with known parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from express50 import native
from express50.errors import ConfigError, StageError
from express50.geometry.mesh_raster import rasterize
from express50.geometry.mesh_render import covered
from express50.geometry.transforms import axis_angle_to_matrix
from pipelines.track.adam import Adam
from pipelines.track.config import TrackConfig
from pipelines.track.render_config import RenderConfig
from pipelines.track.render_loss import Shot, make_look, outline
from pipelines.track.render_refine import Problem, Refined, refine, target_of
from pipelines.track.state import Pose, State
from tests.pipelines.render_scenes import appearance, head, random_state, ring, shoot, vertices_of

PLACE = np.array([0.2, 1.1, -0.3])
QUICK = RenderConfig(levels=(2, 1), rounds=4)
ONLY_POSE = {"shape_rate": 0.0, "expression_rate": 0.0, "joint_rate": 0.0, "prior": 0.0}
LOOK = appearance()


def pictures(truth: State, size: int, place=PLACE) -> list[list[Shot]]:
    return [
        [shoot(vertices_of(truth, index), camera, LOOK) for camera in ring(size, place)]
        for index in range(len(truth.poses))
    ]


def perturbed(truth: State, turn: float, move: float, coefficients: float) -> State:
    """The state moved by a seeded amount of these standard deviations."""
    rng = np.random.default_rng(5)
    count = head().expression_dirs.shape[2]
    poses = []
    for pose in truth.poses:
        own = pose.own.copy()
        own[:count] += coefficients * 0.3 * rng.normal(size=count) * (rng.random(count) < 0.3)
        own[-3:] += move * rng.normal(size=3)
        rotation = axis_angle_to_matrix(turn * rng.normal(size=3)) @ pose.rotation
        poses.append(Pose(own, rotation))
    return State(truth.shape + coefficients * rng.normal(size=len(truth.shape)), tuple(poses))


def error_mm(truth: State, state: State) -> float:
    apart = [vertices_of(state, i) - vertices_of(truth, i) for i in range(len(truth.poses))]
    return 1e3 * float(np.linalg.norm(np.concatenate(apart), axis=1).mean())


def run(state: State, shots, config: RenderConfig = QUICK) -> Refined:
    neutral = [False] * len(state.poses)
    return refine(head(), state, LOOK, shots, neutral, TrackConfig(), config)


@pytest.fixture(scope="module")
def scene():
    truth = random_state(2, PLACE)
    return truth, pictures(truth, 96)


def test_shape_expression_and_pose_are_recovered(scene):
    truth, shots = scene
    start = perturbed(truth, 0.03, 0.004, 0.3)
    found = run(start, shots)
    before, after = error_mm(truth, start), error_mm(truth, found.state)
    assert before > 5.0 and after < before / 8 and after < 0.8
    assert found.after < 0.1 * found.before


def test_outlines_alone_recover_a_pose(scene):
    truth, shots = State(scene[0].shape, scene[0].poses[:1]), scene[1][:1]
    start = perturbed(truth, 0.1, 0.02, 0.0)
    grey = [[replace(s, image=np.full_like(s.image, 0.5)) for s in views] for views in shots]
    config = RenderConfig(
        levels=(2, 1), rounds=8, photometric=0.0, turn_rate=0.01, move_rate=0.003, **ONLY_POSE
    )
    found = run(start, grey, config)
    assert error_mm(truth, start) > 30.0 and error_mm(truth, found.state) < 0.2
    np.testing.assert_array_equal(found.state.shape, truth.shape)
    for pose, true in zip(found.state.poses, truth.poses, strict=True):
        np.testing.assert_array_equal(pose.own[:-6], true.own[:-6])


def test_an_expression_that_is_not_looked_at_does_not_move(scene):
    truth, shots = scene
    config = replace(QUICK, shape_rate=0.02)
    problem = Problem(
        head(),
        perturbed(truth, 0.02, 0.002, 0.2),
        make_look(head(), LOOK),
        TrackConfig(),
        config,
    )
    for index in (0, 1):
        targets = [target_of(s, LOOK, 2, np.zeros(3)) for s in shots[index]]
        views = problem.see(index, targets)
        still = problem.poses[1 - index]
        kept, shape = (still.own.tobytes(), still.rotation.tobytes()), problem.shape.copy()
        for _ in range(3):
            problem.step(index, False, targets, views, 1.0)
        after = problem.poses[1 - index]
        assert (after.own.tobytes(), after.rotation.tobytes()) == kept
        assert (problem.shape != shape).any()
    alone = run(truth, [shots[0], []], replace(QUICK, rounds=1, levels=(2,)))
    np.testing.assert_array_equal(alone.state.poses[1].rotation, truth.poses[1].rotation)
    np.testing.assert_allclose(alone.state.poses[1].own, truth.poses[1].own, atol=1e-15)
    assert (alone.state.poses[0].own != truth.poses[0].own).any()


def test_adam_takes_equal_first_steps_and_forgets_nothing_while_it_rests():
    step = Adam((3,))
    np.testing.assert_allclose(step.step(np.array([1e-3, -5.0, 0.0])), [-1, 1, 0], atol=1e-6)
    other = Adam((3,))
    other.step(np.array([1e-3, -5.0, 0.0]))
    gradient = np.array([1e-3, 4.0, 1.0])
    np.testing.assert_array_equal(step.step(gradient), other.step(gradient))


def test_the_same_bytes_again(scene):
    truth, shots = scene
    start = perturbed(truth, 0.02, 0.002, 0.2)
    config = RenderConfig(levels=(4, 2), rounds=1, steps=3)
    a, b = run(start, shots, config), run(start, shots, config)
    assert a.state.shape.tobytes() == b.state.shape.tobytes()
    assert [p.own.tobytes() for p in a.state.poses] == [p.own.tobytes() for p in b.state.poses]


def test_a_kilometre_from_the_origin_changes_nothing():
    far = np.array([900.0, 20.0, -500.0])
    errors = []
    for place in (np.zeros(3), far):
        truth = random_state(1, place)
        start = perturbed(truth, 0.02, 0.003, 0.2)
        found = run(start, pictures(truth, 64, place), replace(QUICK, rounds=2))
        errors.append(error_mm(truth, found.state))
    assert errors[0] == pytest.approx(errors[1], abs=0.05)


def test_terms_do_not_depend_on_resolution_or_on_the_number_of_views():
    truth = random_state(1, PLACE)
    start = perturbed(truth, 0.03, 0.004, 0.3)
    still = RenderConfig(
        levels=(1,), rounds=1, steps=1, turn_rate=0.0, move_rate=0.0, outline=0.0, **ONLY_POSE
    )
    (small,), (large,) = pictures(truth, 64), pictures(truth, 192)
    terms = [run(start, [shots], still).before for shots in (small, large, small * 3)]
    assert terms[1] == pytest.approx(terms[0], rel=0.15)
    assert terms[2] == pytest.approx(terms[0], rel=1e-5)


def test_the_pull_of_outlines_does_not_depend_on_resolution():
    truth, pulls = random_state(1, PLACE), []
    vertices = vertices_of(truth, 0)
    for size in (64, 192):
        camera = ring(size, PLACE)[1]
        target = target_of(shoot(vertices, camera, LOOK), LOOK, 1, PLACE)
        moved = torch.from_numpy(vertices - PLACE + [0.02, 0, 0]).float().requires_grad_()
        raster = rasterize(moved.detach().numpy(), head().faces.numpy(), target.camera)
        term = outline(make_look(head(), LOOK), target, covered(raster), moved)
        pulls.append(torch.autograd.grad(term, moved)[0].sum(0))
    assert pulls[0][0] > 0.5  # shares of the area a metre, towards where the head is
    torch.testing.assert_close(pulls[0], pulls[1], rtol=0.1, atol=0.3)


def test_unknown_outlines_and_distrusted_colours_count_for_nothing(scene):
    truth, shots = scene
    start = perturbed(truth, 0.03, 0.004, 0.3)
    config = replace(QUICK, levels=(2,), rounds=1)
    unknown = [[replace(s, alpha=np.full_like(s.alpha, np.nan)) for s in v] for v in shots]
    absent = [[replace(s, alpha=None) for s in v] for v in shots]
    assert run(start, unknown, config).after == run(start, absent, config).after
    blank = [[replace(s, weight=np.zeros_like(s.weight)) for s in v] for v in absent]
    still = run(start, blank, replace(config, prior=0.0))
    assert still.before == still.after == 0.0
    assert error_mm(start, still.state) < 1e-9


def test_bad_input_is_told(scene, monkeypatch):
    truth, shots = scene
    with pytest.raises(ValueError, match="2 poses, 1 lists of shots and 2 neutral flags"):
        run(truth, shots[:1])
    with pytest.raises(ValueError, match=r"shot of camera cam0: weight has shape \(2, 2\)"):
        replace(shots[0][0], weight=np.zeros((2, 2)))
    with pytest.raises(ValueError, match="shot of camera cam0: image has 1 values"):
        image = shots[0][0].image.copy()
        image[0, 0, 0] = np.nan
        replace(shots[0][0], image=image)
    for wrong in ({"levels": ()}, {"rounds": 0}, {"softness": 0.0}, {"prior": -1.0}):
        with pytest.raises(ConfigError, match="track: render"):
            RenderConfig(**wrong)
    with pytest.raises(StageError, match="diverged"):
        run(truth, shots, replace(QUICK, move_rate=1e38, rounds=3))
    monkeypatch.setattr(native, "why_missing", lambda: "the native library was not built")
    with (
        pytest.warns(UserWarning, match="without outlines"),
        pytest.raises(StageError, match="needs the native library"),
    ):
        run(truth, shots, replace(QUICK, levels=(4,)))
