"""Rotations and fits, NumPy against torch."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.geometry import transforms
from express50.geometry import transforms_torch as torch_transforms

ANGLES = [0.0, 1e-12, 1e-5, 9.9e-4, 1.1e-3, 0.5, np.pi - 1e-9, np.pi, np.pi + 0.1, 2 * np.pi, 11.0]
AXES = [np.array(a) / np.linalg.norm(a) for a in ([1.0, 0, 0], [0, -1.0, 0], [1.0, 2, -3])]


@pytest.mark.parametrize("angle", ANGLES)
def test_torch_agrees_at_every_angle_and_rotations_come_back(angle):
    for axis in AXES:
        R = transforms.axis_angle_to_matrix(axis * angle)
        again = transforms.axis_angle_to_matrix(transforms.matrix_to_axis_angle(R))
        np.testing.assert_allclose(again, R, atol=1e-12)
        twin = torch_transforms.axis_angle_to_matrix(torch.tensor(axis * angle))
        np.testing.assert_allclose(twin.numpy(), R, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3))
def test_rotations_are_orthonormal_and_round_trip(vector):
    R = transforms.axis_angle_to_matrix(np.array(vector))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    q = transforms.matrix_to_quat(R)
    np.testing.assert_allclose(transforms.quat_to_matrix(q), R, atol=1e-12)
    np.testing.assert_allclose(
        torch_transforms.matrix_to_quat(torch.tensor(R)).numpy(), q, atol=1e-12
    )


def test_torch_gradients_are_finite_at_zero_and_pi():
    for value in ([0.0, 0, 0], [np.pi, 0, 0], [1e-5, 0, 0], [0.3, -0.2, 0.1]):
        a = torch.tensor([value], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(torch_transforms.axis_angle_to_matrix, a)


def test_fits_recover_a_similarity_and_never_reflect():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(10, 3))
    R = transforms.axis_angle_to_matrix(np.array([1.0, 2.0, 0.5]))
    scale, got, t = transforms.similarity_fit(points, 2.5 * points @ R.T + [1, 2, 3])
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(got, R, atol=1e-12)
    np.testing.assert_allclose(t, [1, 2, 3], atol=1e-12)
    mirrored, _ = transforms.rigid_fit(points, points * [-1, 1, 1])
    assert np.linalg.det(mirrored) == pytest.approx(1.0)


def test_fits_refuse_what_has_no_answer():
    with pytest.raises(ValueError, match="3 points with weight"):
        transforms.rigid_fit(np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="not all the same"):
        transforms.rigid_fit(np.ones((5, 3)), np.zeros((5, 3)))
    with pytest.raises(ValueError, match="zero norm"):
        transforms.quat_to_matrix(np.zeros(4))


@pytest.mark.parametrize("scale", [1e-160, 1e-22, 1.0, 1e22, 1e200])
def test_quaternions_of_any_length_give_rotations(scale):
    quat = np.array([1.0, 1.0, 0.5, 0.0])
    expected = transforms.quat_to_matrix(quat)
    np.testing.assert_allclose(transforms.quat_to_matrix(scale * quat), expected, atol=1e-15)
    dtype = torch.float32 if 1e-40 < scale < 1e30 else torch.float64
    given = torch.tensor(scale * quat, dtype=dtype, requires_grad=True)
    R = torch_transforms.quat_to_matrix(given)
    np.testing.assert_allclose(R.detach().numpy(), expected, atol=1e-6)
    assert torch.isfinite(torch.autograd.grad(R[0, 1], given)[0]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_fits_refuse_points_that_are_not_finite(bad):
    points = np.eye(4, 3)
    with pytest.raises(ValueError, match="finite points"):
        transforms.rigid_fit(points, np.where(points == 1, bad, points))


def test_look_at_puts_the_target_ahead_with_up_upwards():
    T = transforms.look_at(np.array([0.0, 1, 2]), np.array([0.0, 1, 0]))
    np.testing.assert_allclose(T @ [0, 1, 0, 1], [0, 0, 2, 1], atol=1e-12)
    assert (T @ [0, 2, 0, 1])[1] < 0  # up in the world is -y in an OpenCV camera
    np.testing.assert_allclose(transforms.invert_transform(T) @ T, np.eye(4), atol=1e-12)


def test_points_move_in_space_and_in_pixels():
    T = transforms.make_transform(
        transforms.axis_angle_to_matrix(np.array([0.0, 0.0, np.pi / 2])), np.array([1.0, 2.0, 3.0])
    )
    moved = transforms.transform_points(T, np.array([[[1.0, 0.0, 0.0]]]))
    np.testing.assert_allclose(moved, [[[1.0, 3.0, 3.0]]], atol=1e-12)
    window = np.array([[2.0, 0.0, 5.0], [0.0, 2.0, 6.0]])
    np.testing.assert_array_equal(
        transforms.transform_points(window, np.ones((1, 2))), [[7.0, 8.0]]
    )
