"""Bounds of depth grow where patches disagree and where colours contradict the depth."""

from __future__ import annotations

import numpy as np
import pytest

from express50.error_model import error_bounds
from express50.geometry.cameras import Camera
from pipelines.depth.maps import (
    SURE_MM,
    DepthMaps,
    PhotoErrors,
    grain,
    jumps,
    make_maps,
    roughness,
    smoothed_errors,
)

SIDE = 40
KNOWN = {
    "apart_mm": 4.0, "voxel_mm": 2.8, "pixel_mm": 1.6, "views": 8.0,
    "photo": 3.0, "photo_wide": 3.0, "photo_all": 2.0, "grain": 0.06, "grain_all": 0.06,
    "edge_px": 1.5,
}  # fmt: skip


def camera(focal: float = 50.0) -> Camera:
    params = (focal, focal, SIDE / 2, SIDE / 2)
    return Camera("cam00", SIDE, SIDE, "PINHOLE", params, np.eye(4))


def wall(depth: np.ndarray, agreement: float = 0.6, **further: object) -> DepthMaps:
    """A wall seen straight on, on which patches agree, with bounds."""
    ones, number = np.ones((SIDE, SIDE)), int((depth > 0).sum())
    towards, agreements = np.tile([0.0, 0.0, -1.0], (number, 1)), np.full(number, agreement)
    maps = make_maps(camera(), ones, depth, towards, agreements, 4.0)
    figures = {**maps.figures, **KNOWN, **further}
    return DepthMaps(**{**vars(maps), "bounds": error_bounds("depth", figures)})


def test_jumps_are_measured_and_nothing_is_stated_off_the_surface():
    depth = np.full((SIDE, SIDE), 1.0)
    depth[:, 20:] = 1.2
    depth[30:] = 0
    view = wall(depth)
    jump = np.zeros(depth.shape)
    jump[view.valid] = view.figures["jump"]
    assert jump[10, 19] > 4 > 0.1 > jump[10, 10] and jump[29, 10] == 1e3  # 8 pixels of 0.024 m deep
    assert view.confidence[10, 10] > 0 == view.confidence[35, 10]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_units_and_focal_lengths_do_not_count(scale):
    rng = np.random.default_rng(0)
    depth = scale * (1 + 0.05 * rng.random((SIDE, SIDE)))
    plain = jumps(camera(), depth)
    np.testing.assert_allclose(plain, jumps(camera(), depth / scale), rtol=1e-4)
    np.testing.assert_allclose(3 * plain, jumps(camera(150.0), depth), rtol=1e-4)
    assert np.isfinite(plain).all() and np.isinf(jumps(camera(), np.zeros((SIDE, SIDE)))).all()


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("photo_wide", 1.0, 30.0),
        ("photo_wide", 1.0, np.nan),
        ("apart_mm", 1.0, 40.0),
        ("grain", 0.02, 1.0),
        ("edge_px", 1.4, 2.4),  # blurred pictures
        ("voxel_mm", 2.5, 4.0),
    ],
)
def test_what_contradicts_the_depth_raises_its_bounds(name, good, bad):
    depth = np.full((SIDE, SIDE), 1.0)
    low, high = (wall(depth, **{name: value}).bounds.bound[0] for value in (good, bad))
    assert np.isfinite(high) and high > 1.2 * low


def test_disagreeing_patches_raise_bounds():
    depth = np.full((SIDE, SIDE), 1.0)
    bounds = [wall(depth, agreement).bounds.bound[0] for agreement in (0.9, 0.5, 0.1)]
    assert bounds == sorted(bounds) and bounds[-1] > 1.2 * bounds[0]


def test_the_bound_can_be_computed_from_the_confidence():
    view = wall(np.full((SIDE, SIDE), 1.0))
    stored = np.rint(255 * view.confidence) / 255
    again = SURE_MM * (1 / stored[view.valid] - 1)
    np.testing.assert_allclose(again, view.bounds.bound, rtol=0.05)


def test_errors_that_nobody_sees_are_unknown_and_single_ones_are_averaged():
    errors = np.zeros((SIDE, SIDE), np.float32)
    errors[10, 10] = 25.0
    errors[20:] = np.nan
    valid = np.ones((2 * SIDE, 2 * SIDE), bool)
    found = smoothed_errors(PhotoErrors(errors, 1.0), valid, 5).reshape(valid.shape)
    assert found[20, 20] == pytest.approx(1.5) and found[2, 2] == pytest.approx(0.5)
    assert np.isnan(found[60, 60])


def test_hair_has_grain_and_rough_normals_and_a_wall_has_not():
    rng = np.random.default_rng(0)
    strands = rng.integers(0, 255, (SIDE, SIDE, 3), np.uint8)
    everywhere = np.ones(strands.shape[:2], bool)
    flat = grain(np.full_like(strands, 128), everywhere)
    assert grain(strands, everywhere).mean() > 5 * flat.mean()
    normals = rng.normal(size=(SIDE, SIDE, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    plane = np.broadcast_to(np.float32([0, 0, -1]), normals.shape)
    assert roughness(normals).mean() > 0.3 > 0.01 > roughness(np.ascontiguousarray(plane)).max()
