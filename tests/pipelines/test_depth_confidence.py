"""Confidence falls at jumps, at outlines, and where colours contradict the depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from express50.geometry.cameras import Camera
from pipelines.depth.maps import (
    UNSEEN_TRUST,
    DepthMaps,
    PhotoErrors,
    doubted,
    jumps,
    make_maps,
)

SIDE = 40


def camera(focal: float = 50.0) -> Camera:
    params = (focal, focal, SIDE / 2, SIDE / 2)
    return Camera("cam00", SIDE, SIDE, "PINHOLE", params, np.eye(4))


def wall(depth: np.ndarray) -> DepthMaps:
    """A wall seen straight on, of full confidence."""
    towards = np.broadcast_to([0.0, 0.0, -1.0], (SIDE, SIDE, 3))
    ones = np.ones((SIDE, SIDE))
    return make_maps(camera(), ones, depth, towards, ones)


def test_jumps_and_outlines_lower_confidence_and_a_plane_keeps_it():
    depth = np.full((SIDE, SIDE), 1.0)
    depth[:, 20:] = 1.2
    depth[30:] = np.inf
    found = wall(depth).confidence
    assert found[10, 10] > 0.99 and found[10, 30] > 0.99
    assert 0 < found[10, 19] < 0.4 and 0 < found[10, 20] < 0.4  # 8 pixels of 0.024 m deep
    assert found[29, 10] == 0 and found[35, 10] == 0


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_units_and_focal_lengths_do_not_count(scale):
    rng = np.random.default_rng(0)
    depth = scale * (1 + 0.05 * rng.random((SIDE, SIDE)))
    plain = jumps(camera(), depth)
    np.testing.assert_allclose(plain, jumps(camera(), depth / scale), rtol=1e-4)
    np.testing.assert_allclose(3 * plain, jumps(camera(150.0), depth), rtol=1e-4)
    assert np.isfinite(plain).all() and np.isinf(jumps(camera(), np.zeros((SIDE, SIDE)))).all()


def test_contradicting_colours_lower_confidence_and_single_pixels_do_not():
    view = wall(np.full((SIDE, SIDE), 1.0))
    errors = np.zeros((SIDE, SIDE), np.float32)
    errors[:, 20:] = 20.0
    errors[10, 10] = 20.0
    found = doubted(view, PhotoErrors(errors, 1.0)).confidence
    assert found[30, 5] == pytest.approx(1.0) and found[30, 35] < 0.2
    assert found[10, 10] > 0.85
    order = [doubted(view, PhotoErrors(np.full_like(errors, e), 1.0)).confidence.mean()
             for e in (0, 2, 8, 60)]  # fmt: skip
    assert order == sorted(order, reverse=True) and order[-1] < 0.01


def test_points_that_no_neighbour_sees_lose_confidence_without_nan():
    view = wall(np.full((SIDE, SIDE), 1.0))
    unseen = np.full((SIDE // 2, SIDE // 2), np.nan, np.float32)  # compared at half the size
    found = doubted(view, PhotoErrors(unseen, 0.0)).confidence
    np.testing.assert_allclose(found, UNSEEN_TRUST**0.5, rtol=1e-6)
    assert found.shape == view.depth.shape and found.dtype == np.float32
    nothing = replace(view, confidence=np.zeros_like(view.confidence))
    assert not doubted(nothing, PhotoErrors(unseen, 0.0)).confidence.any()
