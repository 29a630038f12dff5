"""Smooth offsets beyond the shape: as large as asked on any mesh, none where nothing may move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.head.load import load_head
from express50.head.model import pose
from pipelines.track.basis import (
    OFFSET_SIGMA_M,
    RIGID,
    cotangent_laplacian,
    offset_modes,
    split_shape,
    with_modes,
)
from tests.express50.head.tiny_head import tiny_head
from tests.pipelines.textured_scenes import RADIUS, ball, ball_head

SIGMA, LENGTH = 0.001, 0.04


def deviation(heights: np.ndarray) -> np.ndarray:
    return np.sqrt((heights**2).sum(1))


@pytest.fixture(scope="module")
def coarse() -> np.ndarray:
    return offset_modes(ball_head(16), 100, SIGMA, LENGTH)


def test_the_deviation_is_the_one_set_on_every_mesh(coarse) -> None:
    fine = offset_modes(ball_head(32), 100, SIGMA, LENGTH)
    for heights in (coarse, fine):
        assert deviation(heights).mean() == pytest.approx(SIGMA, rel=0.1)
        assert deviation(heights).std() < 0.05 * SIGMA
    assert deviation(fine).mean() == pytest.approx(deviation(coarse).mean(), rel=0.05)
    # So does what a random offset looks like: its correlation over 2 cm.
    for rings, heights in ((16, coarse), (32, fine)):
        vertices, _ = ball(rings=rings)
        near = np.abs(np.linalg.norm(vertices - vertices[rings], axis=1) - 0.02)
        other = int(near.argmin())
        together = heights[rings] @ heights[other]
        share = together / (deviation(heights)[rings] * deviation(heights)[other])
        assert 0.6 < share < 0.95


def test_deviation_and_scale_follow_their_settings(coarse) -> None:
    twice = offset_modes(ball_head(16), 100, 2 * SIGMA, LENGTH)
    assert deviation(twice).mean() == pytest.approx(2 * deviation(coarse).mean(), rel=1e-6)
    large = ball_head(16)
    large = replace(large, template=10 * large.template)
    same = offset_modes(large, 100, SIGMA, 10 * LENGTH)
    assert deviation(same).mean() == pytest.approx(deviation(coarse).mean(), rel=0.02)


def test_modes_are_the_same_in_every_run_and_broad_before_fine(coarse) -> None:
    np.testing.assert_array_equal(coarse, offset_modes(ball_head(16), 100, SIGMA, LENGTH))
    size = np.sort(np.linalg.norm(coarse, axis=0))[::-1]
    assert size[0] > 3 * size[-1]
    assert np.ptp(coarse[:, np.linalg.norm(coarse, axis=0).argmax()]) < 1e-6


def test_on_the_head_eyes_teeth_and_mouth_stay() -> None:
    head = load_head("procedural")
    heights = offset_modes(head, 60)
    rigid = np.any([head.regions[name].numpy() for name in RIGID if name in head.regions], axis=0)
    assert 0.1 < rigid.mean() < 0.6 and (heights[rigid] == 0).all()
    skin = head.regions["face"].numpy() & ~rigid
    # The broadest 60 modes hold most, but not all, of the field.
    assert 0.5 < deviation(heights[skin]).mean() / OFFSET_SIGMA_M < 1.1
    assert (deviation(heights[skin]) > 0).all()


def test_modes_join_the_shape_and_come_apart_again() -> None:
    model = ball_head(12)
    assert with_modes(model, 0) is model
    more = with_modes(model, 20)
    own = len(model.shape_names)
    assert more.shape_names[:own] == model.shape_names and len(more.shape_names) == own + 20
    shape = np.random.default_rng(0).normal(size=own + 20)
    coefficients, offsets = split_shape(more, shape)
    np.testing.assert_array_equal(coefficients, shape[:own])
    still = torch.zeros(1, 4, dtype=torch.float64)
    whole = pose(more, torch.from_numpy(shape)[None], still)
    apart = pose(
        model, torch.from_numpy(coefficients)[None], still, offsets=torch.from_numpy(offsets)[None]
    )
    np.testing.assert_allclose(whole.numpy(), apart.numpy(), atol=1e-12)
    assert 1e-4 < np.abs(offsets).mean() < 5e-3
    normal = model.template.numpy() / RADIUS
    along = (offsets * normal).sum(1)
    np.testing.assert_allclose(offsets, along[:, None] * normal, atol=0.05 * np.abs(along).max())
    coefficients, offsets = split_shape(model, shape[:own])
    assert len(coefficients) == own and (offsets == 0).all()


def test_laplacian_of_a_sphere() -> None:
    """Coordinates on a sphere are eigenfunctions: eigenvalue 2 / r^2. Constants cost nothing."""
    vertices, faces = ball(rings=40)
    stiffness, mass = cotangent_laplacian(vertices, faces)
    assert mass.sum() == pytest.approx(4 * np.pi * RADIUS**2, rel=0.01)
    np.testing.assert_allclose(stiffness @ np.ones(len(vertices)), 0.0, atol=1e-9)
    for axis in range(3):
        x = vertices[:, axis]
        value = (x @ (stiffness @ x)) / (x @ (mass * x))
        assert value == pytest.approx(2 / RADIUS**2, rel=0.03)


def test_slivers_and_loose_vertices_do_no_harm() -> None:
    vertices, faces = ball(rings=12)
    sliver = np.array([[0.2, 0, 0], [0.2, 1e-9, 0], [0.3, 0, 0], [9.0, 9, 9]])
    stiffness, mass = cotangent_laplacian(
        np.concatenate([vertices, sliver]),
        np.concatenate([faces, len(vertices) + np.array([[0, 1, 2], [0, 2, 2]])]),
    )
    assert np.isfinite(stiffness.data).all() and (mass > 0).all()
    random = np.random.default_rng(0).normal(size=(len(mass), 8))
    assert ((random * (stiffness @ random)).sum(0) >= 0).all()


def test_more_modes_than_vertices_are_cut() -> None:
    heights = offset_modes(tiny_head(vertices=30), 500, SIGMA, LENGTH)
    assert heights.shape[0] == 30 and heights.shape[1] <= 28 and np.isfinite(heights).all()
