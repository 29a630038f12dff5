"""Test depth at the edges: constant and empty maps, one camera, other units, far worlds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from express50.errors import StageError
from express50.files.images import depth_to_uint16
from express50.geometry.cameras import transform_camera
from express50.geometry.transforms import make_transform
from express50.shards.reader import sample_picture
from pipelines.depth.reconstruct import patch_scores, reconstruct, view_weights
from pipelines.depth.surface import (
    HeadMesh,
    extract_mesh,
    fair,
    graph_laplacian,
    rim_targets,
    smooth_displacement,
)
from pipelines.depth.views import (
    head_box,
    hull_distance,
    make_view,
    project_fast,
    silhouette_distance,
)
from pipelines.pack.sample import Crop, cut_depth, cut_image
from tests.pipelines.bump_head import render, ring
from tests.pipelines.dense_grid import from_dense

COARSE = 6.0  # millimetres per voxel
FLAT = from_dense(np.zeros(3), 1.0, np.zeros((2, 2, 2), np.float32))


def views_of(cameras):
    made = []
    for camera in cameras:
        rgb, alpha, _ = render(camera)
        made.append(make_view(camera, rgb, alpha, 1024))
    return made


@pytest.fixture(scope="module")
def views():
    return views_of(ring(5, 80))


def finite(surface) -> bool:
    arrays = (surface.vertices, surface.normals, surface.confidence, surface.grid.blocks)
    return all(np.isfinite(array).all() for array in arrays)


def test_one_camera_and_parallel_cameras_are_refused(views):
    for count in (0, 1):
        with pytest.raises(StageError, match=f"two cameras with a matte, got {count}"):
            head_box(views[:count])
    with pytest.raises(StageError, match="one line"):
        head_box([views[0], views[0]])


@pytest.mark.parametrize("value", [0, 128, 255])
def test_textureless_images_leave_the_hull(views, value):
    flat = [replace(view, rgb=np.full_like(view.rgb, value)) for view in views]
    surface = reconstruct(flat, voxel_mm=COARSE)
    assert finite(surface)
    off = hull_distance(views, surface.vertices)
    assert np.abs(np.median(off)) < 1e-3 and np.percentile(np.abs(off), 95) < 6e-3
    assert surface.figures["photo_agreement_median"] < 1e-6  # rounding alone
    assert surface.confidence.max() <= 0.3 + 1e-6


def test_pure_noise_neither_breaks_nor_counts_as_agreement(views):
    rng = np.random.default_rng(0)
    noisy = [replace(v, rgb=rng.integers(0, 255, v.rgb.shape, np.uint8)) for v in views]
    surface = reconstruct(noisy, voxel_mm=COARSE)
    assert finite(surface) and surface.figures["photo_agreement_median"] < 0.3


@pytest.mark.parametrize("far", [1.0, 1000.0])
def test_a_head_far_from_the_origin_is_the_same_head(views, far):
    move = make_transform(np.eye(3), np.array([far, -far / 2, far / 3]))
    moved = [replace(view, camera=transform_camera(view.camera, move)) for view in views]
    near, there = reconstruct(views, voxel_mm=COARSE), reconstruct(moved, voxel_mm=COARSE)
    assert finite(there)
    gap = cKDTree(near.vertices).query(there.vertices - move[:3, 3])[0]
    assert np.percentile(gap, 99) < 2e-3  # half a voxel: the grids lie differently over the head
    center = np.array([0.02, -0.01, 0.03])
    for before, after in zip(views, moved, strict=True):
        pixels = [project_fast(v.camera, p[None])[0] for v, p in
                  ((before, center), (after, center + move[:3, 3]))]  # fmt: skip
        np.testing.assert_allclose(pixels[0], pixels[1], atol=1e-3)


def test_a_hundred_and_fifty_views_are_as_good_as_few(views):
    many = [views[k % len(views)] for k in range(150)]
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
    np.testing.assert_array_equal(hull_distance(many, points), hull_distance(views, points))


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_millimetres_and_kilometres_are_refused(views, factor):
    scaled = []
    for view in views:
        pose = view.camera.cam_from_world.copy()
        pose[:3, 3] *= factor
        scaled.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))
    with pytest.raises(StageError, match="in metres"):
        reconstruct(scaled, voxel_mm=COARSE)


def test_silhouettes_that_share_nothing_are_refused(views):
    upper = np.arange(80)[:, None] < 38
    halves = [np.where(upper if k % 2 else ~upper, v.alpha, 0).astype(np.float32)
              for k, v in enumerate(views)]  # fmt: skip
    gone = [make_view(v.camera, v.rgb, a, 1024) for v, a in zip(views, halves, strict=True)]
    with pytest.raises(StageError, match="mattes"):
        reconstruct(gone, voxel_mm=COARSE)


@pytest.mark.parametrize("alpha", [np.zeros((9, 7)), np.ones((9, 7)), np.eye(1)])
def test_silhouette_distance_of_constant_and_tiny_mattes_is_finite(alpha):
    assert np.isfinite(silhouette_distance(alpha.astype(np.float32))).all()


@pytest.mark.parametrize("value", [0.0, 1e-9, 1.0, np.inf])
def test_constant_grids_have_no_surface(value):
    grid = from_dense(np.zeros(3), 0.01, np.full((5, 6, 7), value, np.float32))
    vertices, _, faces = extract_mesh(grid)
    assert len(vertices) == len(faces) == 0
    assert np.isfinite(fair(grid, 0.01).blocks).all()


def test_no_silhouettes_give_no_targets():
    grid = from_dense(np.zeros(3), 0.01, np.ones((5, 5, 5), np.float32))
    assert rim_targets([], grid, 0.1).shape == (0, 3)


def test_constant_scores_do_not_move_the_surface():
    faces = np.array([[0, 1, 2], [1, 2, 3]])
    zero = np.zeros(4)
    for level in (0.0, 1.0, -1.0):
        moved = smooth_displacement(
            np.full((4, 9), level), np.linspace(-4e-3, 4e-3, 9), graph_laplacian(faces, 4),
            zero, zero,
        )  # fmt: skip
        assert np.allclose(moved, 0)


def test_a_vertex_that_no_view_sees_scores_zero(views):
    vertices = np.array([[0, 0, 50.0], [0, 0, -50.0], [0.01, 0, 50.0]])
    normals = np.array([[0, 0, 1.0], [0, 0, 0.0], [0, 0, 1.0]])
    mesh = HeadMesh(vertices, normals, np.array([[0, 1, 2]]))
    weights, offsets = view_weights(views, mesh, FLAT.voxel), np.array([-0.01, 0, 0.01])
    assert (patch_scores(views, weights, FLAT, mesh, offsets, 1.0) == 0).all()


def test_scores_are_correlations_wherever_a_vertex_lies(views):
    vertices = np.array([[0, 0, 0.09], [0.01, 0, 0.09], [0, 0, 50.0]])
    mesh = HeadMesh(vertices, np.array([[0, 0, 1.0]] * 3), np.array([[0, 1, 2]]))
    weights, offsets = view_weights(views, mesh, FLAT.voxel), np.array([-0.01, 0, 0.01])
    scores = patch_scores(views, weights, FLAT, mesh, offsets, 1.0)
    assert np.isfinite(scores).all() and np.abs(scores).max() <= 1 + 1e-5


def test_depth_units_reject_millimetres_nan_and_negatives():
    valid = np.ones((2, 2), bool)
    for bad in (1100.0, np.nan, np.inf, -1.0, 0.0):
        with pytest.raises(ValueError, match="metres"):
            depth_to_uint16(np.full((2, 2), bad), valid)
    empty = depth_to_uint16(np.full((2, 2), np.nan), ~valid)
    assert (empty == 0).all()


@pytest.mark.parametrize("crop", [Crop(0, 0, 1), Crop(-50, -50, 20), Crop(-5, -5, 30)])
@pytest.mark.parametrize("valid", [True, False])
def test_depth_crops_outside_the_image_are_unknown_not_zero_metres(crop, valid):
    depth, known = cut_depth(np.full((8, 8), 1.1), np.full((8, 8), valid), crop, 16)
    assert np.isfinite(depth).all() and known.sum() == (depth > 0).sum()
    assert known.any() == (valid and crop.x0 > -8)
    if known.any():
        np.testing.assert_allclose(depth[known], 1.1)
    assert cut_image(np.zeros((8, 8, 3), np.uint8), crop, 16).shape == (16, 16, 3)


@pytest.mark.parametrize("depth", [0.0, 1.1])
def test_pictures_of_empty_and_constant_depth(depth):
    flat = np.full((16, 16), depth, np.float32)
    sample = {"rgb": np.zeros((16, 16, 3), np.uint8), "alpha": flat * 0, "depth": flat,
              "valid": flat > 0, "parts": None}  # fmt: skip
    assert sample_picture(sample).shape == (16, 48, 3)
