"""The fit's newer parts: columns in closed form, rest-space turns, the detector's bias."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from express50.geometry.cameras import project
from express50.geometry.transforms import axis_angle_to_matrix
from pipelines.track.basis import OFF, Basis, Points, make_basis
from pipelines.track.fit import fit
from pipelines.track.observe import LandmarkView, landmark_sigma, triangulate_views
from pipelines.track.state import Pose, State, Target
from pipelines.track.terms import MeshPlaces, NormalTerm
from tests.express50.head.tiny_head import tiny_head
from tests.pipelines.test_track import RIG, make_scene

# Of a face that the tiny head cannot have: the whole of it shifted, in head space.
ERROR = np.array([0.003, 0.0, 0.0])


def random_parameters(seed: int = 0) -> tuple[Basis, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    basis = make_basis(tiny_head(vertices=60, seed=2))
    parameters = np.concatenate([rng.normal(size=5 + 4), rng.normal(size=18) * 0.3])
    return basis, parameters, axis_angle_to_matrix(rng.normal(size=3))


@pytest.mark.parametrize("seed", [0, 1])
def test_columns_in_closed_form_are_those_of_forward_mode(seed: int) -> None:
    basis, parameters, rotation = random_parameters(seed)
    points = Points(basis, np.array([7, 0, 33, 7]))
    positions, jacobian = points.linearise(parameters, rotation)
    turn = torch.from_numpy(rotation)
    forward = torch.func.jacfwd(lambda x: points(x, turn))(torch.from_numpy(parameters)).numpy()
    np.testing.assert_allclose(jacobian, forward, atol=1e-12)
    np.testing.assert_allclose(positions, points.evaluate(parameters, rotation), atol=1e-14)


def shifted_targets(count: int, relief: bool) -> tuple[Basis, list[Target], State]:
    """Landmarks seen 3 mm aside in every expression; with relief also the exact surface."""
    targets, poses = [], []
    for seed in range(count):
        scene = make_scene(seed)
        marks = scene.marks + ERROR @ scene.rotation.T
        views = [LandmarkView(c, project(c, marks)[0], np.full(68, 0.3), 0.9) for c in RIG]
        observation, _ = triangulate_views("smile", 0, views)
        target = Target(observation, landmark_sigma(observation), False)
        if relief:
            target = dataclasses.replace(target, terms=(exact_surface(scene),))
        targets.append(target)
        poses.append(Pose(scene.own.copy(), scene.rotation))
    return scene.basis, targets, State(scene.shape.copy(), tuple(poses))


def exact_surface(scene) -> NormalTerm:
    """Every vertex three times, with normals along the axes: the true surface."""
    count = len(scene.vertices)
    return NormalTerm(
        MeshPlaces.of_vertices(np.repeat(np.arange(count), 3)),
        np.repeat(scene.vertices, 3, axis=0),
        np.tile(np.eye(3), (count, 1)),
        np.full(3 * count, 2e-4),
        0.02,
    )


def face_error(basis: Basis, state: State) -> float:
    """Mean distance of the vertices from the truth, metres."""
    points, errors = Points(basis, np.arange(90)), []
    for seed, item in enumerate(state.poses):
        got = points.evaluate(np.concatenate([state.shape, item.own]), item.rotation)
        errors.append(np.linalg.norm(got - make_scene(seed).vertices, axis=1).mean())
    return float(np.mean(errors))


def test_a_free_bias_takes_what_the_detector_errs_and_the_shape_does_not() -> None:
    basis, targets, state = shifted_targets(2, relief=True)
    free, cost = fit(basis, targets, state, 30, free=(OFF,))
    held, worse = fit(basis, targets, state, 30)
    assert cost < 0.5 * worse
    # The inner landmarks; the jaw line's count a quarter.
    assert np.linalg.norm(free.bias[17:].mean(0) - ERROR) < 0.6e-3
    assert np.linalg.norm(held.bias, axis=1).max() < 1e-6
    assert face_error(basis, free) < 0.3e-3
    assert np.abs(free.shape - state.shape).max() < 0.1
    assert np.abs(free.shape - state.shape).max() < np.abs(held.shape - state.shape).max()


def test_a_held_bias_moves_nothing_by_itself() -> None:
    basis, targets, state = shifted_targets(1, relief=False)
    held, _ = fit(basis, targets, state, 10)
    assert np.linalg.norm(held.bias, axis=1).max() < 1e-5


def test_without_a_free_bias_more_of_the_same_expression_changes_no_shape() -> None:
    """Five frames alike are not more evidence of the shape than one."""
    basis, targets, state = shifted_targets(1, relief=False)
    firm, loose = (scaled(basis, size) for size in (0.01, 0.03))
    zero = State(np.zeros(5), state.poses)
    one, _ = fit(firm, targets, zero, 25)
    many, _ = fit(firm, targets * 5, State(zero.shape, state.poses * 5), 25)
    size = np.abs(one.shape).max()
    np.testing.assert_allclose(many.shape, one.shape, atol=0.02 * size)
    looser, _ = fit(loose, targets, zero, 25)
    assert np.abs(0.03 * looser.shape - 0.01 * one.shape).max() > 0.2 * 0.01 * size


def scaled(basis: Basis, size: float) -> Basis:
    """The basis with shape directions so many times as large: the prior is firmer below 1."""
    model = dataclasses.replace(basis.model, shape_dirs=size * basis.model.shape_dirs)
    return make_basis(model)


def test_terms_take_part_and_the_cost_never_rises() -> None:
    basis, targets, state = shifted_targets(2, relief=True)
    start = State(np.zeros(5), state.poses)
    costs = [fit(basis, targets, start, n, free=(OFF,))[1] for n in (0, 1, 2, 4, 8)]
    assert all(b <= a for a, b in zip(costs, costs[1:], strict=False))
    assert costs[-1] < 0.01 * costs[0]
    end, _ = fit(basis, targets, start, 30, free=(OFF,))
    assert face_error(basis, end) < 0.3e-3
