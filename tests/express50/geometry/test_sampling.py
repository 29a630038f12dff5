"""Bilinear sampling against the formula, the border, and spherical harmonics."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from express50.geometry.sampling import (
    bilinear,
    bilinear_slope,
    edge_width,
    evenly,
    local_moments,
    robust_moments,
    sh_polynomials,
)

PLANE = np.fromfunction(lambda y, x: 3 * (x + 0.5) - 2 * (y + 0.5) + 7, (20, 30))
POINTS = np.random.default_rng(0).uniform([0.5, 0.5], [29.4, 19.4], (9000, 2))


def test_a_plane_is_reproduced_with_its_slope() -> None:
    values, slope = bilinear_slope(PLANE[..., None], POINTS)
    assert np.allclose(values[:, 0], POINTS @ [3, -2] + 7, atol=1e-10)
    assert np.allclose(slope[:, 0], [3, -2], atol=1e-10)


@pytest.mark.parametrize("shape", [(), (3,)])
def test_quick_sampling_differs_only_by_the_rounding_of_places(shape: tuple[int, ...]) -> None:
    image = np.broadcast_to(PLANE.reshape(20, 30, *([1] * len(shape))), (20, 30, *shape))
    image = np.ascontiguousarray(image, np.float32)
    exact = (POINTS @ [3, -2] + 7).reshape(-1, *([1] * len(shape)))
    found = bilinear(image, POINTS)
    assert found.shape == (9000, *shape)
    assert found.dtype == np.float32
    assert np.abs(found - exact).max() < 5 / 64 + 1e-3


def test_the_border_repeats() -> None:
    image = np.full((4, 5), 8, np.float32)
    outside = np.array([[-3.0, 2.0], [0.0, 2.0], [2.5, 40.0]])
    assert bilinear(image, outside).tolist() == [8, 8, 8]
    assert np.isfinite(bilinear_slope(image[..., None], outside * 1e9)[0]).all()


def test_no_points() -> None:
    assert bilinear(np.zeros((4, 5), np.float32), np.zeros((0, 2))).shape == (0,)


def test_many_points() -> None:
    points = np.tile(POINTS, (1000, 1))
    image = PLANE.astype(np.float32)
    assert np.array_equal(bilinear(image, points)[-9000:], bilinear(image, POINTS))


def test_harmonics_are_orthonormal() -> None:
    heights, weights = np.polynomial.legendre.leggauss(8)
    angles = np.arange(16) * 2 * np.pi / 16
    z, angle = (grid.ravel() for grid in np.meshgrid(heights, angles, indexing="ij"))
    across = np.sqrt(1 - z**2)
    directions = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    norms = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 1.25, 15, 3.75]) / (4 * np.pi))
    Y = sh_polynomials(directions) * norms
    area = np.repeat(weights, 16) * 2 * np.pi / 16
    assert np.allclose(Y.T @ (area[:, None] * Y), np.eye(9), atol=1e-12)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_blur_is_measured_in_pixels_whatever_the_noise(sigma: float) -> None:
    rng = np.random.default_rng(1)
    cells = rng.integers(20, 236, (12, 12, 1)).astype(np.uint8)
    sharp = cv2.resize(np.repeat(cells, 3, axis=2), (480, 480), interpolation=cv2.INTER_NEAREST)
    blurred = cv2.GaussianBlur(sharp.astype(np.float32), (0, 0), sigma)
    noisy = np.clip(np.rint(blurred + rng.normal(0, 2, blurred.shape)), 0, 255).astype(np.uint8)
    width = edge_width(noisy)
    assert width == pytest.approx(sigma, rel=0.35)
    assert edge_width(np.full((64, 64, 3), 90, np.uint8)) is None


@pytest.mark.parametrize("count", [1, 2, 4, 9, 10, 30])
def test_an_even_choice_holds_both_ends_and_nothing_twice(count):
    chosen = evenly(range(10), count)
    assert len(chosen) == min(count, 10) and chosen[0] == 0
    assert count == 1 or (chosen[-1] == 9 and np.ptp(np.diff(chosen)) <= 1)
    assert evenly([], count) == []


def test_local_moments_are_those_of_the_window() -> None:
    image = np.random.default_rng(1).uniform(0, 9, (12, 15)).astype(np.float32)
    mean, variance = local_moments(image, 5)
    window = image[3:8, 4:9]
    assert mean[5, 6] == pytest.approx(window.mean(), rel=1e-5)
    assert variance[5, 6] == pytest.approx(window.var(), rel=1e-4)
    assert (local_moments(np.full_like(image, 7), 5)[1] == 0).all()


def test_robust_moments_are_those_of_most_values() -> None:
    values = np.random.default_rng(2).normal([3, -1], [0.5, 2], (4001, 2))
    values[::50] = 1e6
    middle, spread = robust_moments(values)
    assert middle == pytest.approx([3, -1], abs=0.15)
    assert spread == pytest.approx([0.5, 2], rel=0.12)
