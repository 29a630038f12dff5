"""Compare blocks near the surface with dense arrays and SciPy; count them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from express50.errors import StageError
from pipelines.depth import blocks
from pipelines.depth.blocks import BAND, LevelSet, build, combined, refined, smoothed
from pipelines.depth.surface import advance, extract_mesh, fair, grid_normals
from tests.pipelines.dense_grid import from_dense, is_held, to_dense

VOXEL = 0.004
HIGH = np.array([0.149, 0.16, 0.151])  # no whole number of voxels or blocks


def bumpy(centre, radius=0.09, height=0.006):
    """A function of points: roughly the distance to a ball with bumps."""

    def distance(points: np.ndarray) -> np.ndarray:
        away = points - centre
        waves = np.sin(60 * away[:, 0]) * np.sin(55 * away[:, 1] + 1)
        return (np.linalg.norm(away, axis=1) - radius - height * waves).astype(np.float32)

    return distance


def grid_of(distance, voxel=VOXEL) -> LevelSet:
    return build(np.full(3, -0.15), HIGH, voxel, distance)


def dense_of(grid: LevelSet, distance) -> np.ndarray:
    """The function at every voxel of the box, cut at the band."""
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), -1).reshape(-1, 3)
    values = distance(grid.points(index)).reshape(grid.shape)
    return np.clip(values, -BAND * grid.voxel, BAND * grid.voxel)


SHAPES = st.builds(
    bumpy,
    st.tuples(*[st.floats(-0.02, 0.02)] * 3).map(np.array),
    st.floats(0.03, 0.085),  # the band stays clear of the box's border
    st.floats(0.0, 0.008),
)
few = settings(max_examples=4, deadline=None, derandomize=True)


@few
@given(SHAPES)
def test_no_voxel_differs_from_the_dense_array(distance):
    grid = grid_of(distance)
    np.testing.assert_array_equal(to_dense(grid), dense_of(grid, distance))
    assert grid.blocks[2:].size == 512 * (grid.table > 1).sum()
    again = from_dense(grid.origin, grid.voxel, to_dense(grid))
    assert np.array_equal(again.table, grid.table) and np.array_equal(again.blocks, grid.blocks)


@few
@given(SHAPES, st.integers(0, 100))
def test_samples_and_filters_are_the_dense_ones(distance, seed):
    grid = grid_of(distance)
    dense, held = dense_of(grid, distance), is_held(grid)
    points = np.random.default_rng(seed).uniform(-0.2, 0.2, (5000, 3))
    index = ((points - grid.origin) / VOXEL).T
    expected = map_coordinates(dense, index, order=1, mode="nearest")
    np.testing.assert_allclose(grid.sample(points), expected, atol=1e-7)
    for sigma in (0.6, 1.4, 2.0):
        expected = gaussian_filter(dense, sigma, mode="nearest")
        np.testing.assert_allclose(to_dense(smoothed(grid, sigma))[held], expected[held], atol=1e-7)


@few
@given(SHAPES)
def test_fairing_is_the_dense_one(distance):
    grid = grid_of(distance)
    dense = dense_of(grid, distance)
    smooth = gaussian_filter(dense, 1.4, mode="nearest")
    slope = np.sqrt(sum(g * g for g in np.gradient(smooth, VOXEL)))
    expected = np.where(np.abs(dense) < 3 * VOXEL, smooth / np.clip(slope, 0.4, 2.0), dense)
    np.testing.assert_allclose(to_dense(fair(grid, 1.4 * VOXEL)), expected, atol=1e-6)


@few
@given(SHAPES, st.floats(1.05, 1.6))
def test_a_finer_grid_is_the_dense_cubic_one(distance, ratio):
    coarse = grid_of(distance)
    fine = refined(coarse, VOXEL / ratio)
    index = np.random.default_rng(0).integers(0, fine.shape, (30_000, 3))
    dense = dense_of(coarse, distance)
    expected = map_coordinates(dense, index.T / ratio, order=3, mode="mirror")
    expected = np.clip(expected, -BAND * fine.voxel, BAND * fine.voxel)
    found = to_dense(fine)[tuple(index.T)]
    sure, near = np.abs(expected) > 1e-5, np.abs(expected) < 4 * fine.voxel
    assert np.array_equal(found[sure] < 0, expected[sure] < 0) and near.sum() > 100
    np.testing.assert_allclose(found[near], expected[near], atol=1e-3 * VOXEL)


@few
@given(SHAPES, st.floats(-4.0, 4.0))
def test_the_band_moves_with_the_surface_as_the_dense_one(distance, voxels):
    grid = grid_of(distance)
    vertices = extract_mesh(grid)[0]
    lift = voxels * VOXEL * (1 + 0.3 * np.sin(40 * vertices[:, 2]))
    moved = advance(grid, vertices, lift)
    index = np.rint((vertices - grid.origin) / VOXEL).astype(int)
    flat = np.ravel_multi_index(tuple(index.T), grid.shape)
    pull, weight = (
        gaussian_filter(
            np.bincount(flat, w, np.prod(grid.shape)).reshape(grid.shape).astype(float),
            sigma=1.2, truncate=7.0,
        )
        for w in (lift, None)
    )  # fmt: skip
    known = weight > 1e-9
    expected = dense_of(grid, distance)
    expected[known] -= pull[known] / weight[known]
    near = (np.abs(expected) < 2 * VOXEL) & known
    np.testing.assert_allclose(to_dense(moved)[near], expected[near], atol=1e-5)
    assert is_held(moved)[near].all()
    reach = trimesh.Trimesh(*extract_mesh(moved)[::2], process=False)
    assert reach.is_watertight


def mesh_area(vertices, faces) -> float:
    return trimesh.Trimesh(vertices, faces, process=False).area


@few
@given(SHAPES)
def test_the_mesh_is_the_dense_one(distance):
    grid = grid_of(distance)
    vertices, normals, faces = extract_mesh(grid)
    index, expected, _, _ = marching_cubes(
        dense_of(grid, distance), 0.0, gradient_direction="descent"
    )
    assert len(vertices) == len(index) and len(faces) == len(expected)
    # along the surface a vertex may move: on an edge that lies in it, tiny values decide where
    gap = vertices - grid.points(index)[cKDTree(index).query((vertices - grid.origin) / VOXEL)[1]]
    assert np.abs((gap * normals).sum(1)).max() < 0.02 * VOXEL
    ours, theirs = (mesh_area(*m) for m in ((vertices, faces), (grid.points(index), expected)))
    np.testing.assert_allclose(ours, theirs, rtol=1e-4)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0
    assert (normals * mesh.vertex_normals).sum(1).min() > 0.9
    np.testing.assert_allclose(grid_normals(grid, (vertices - grid.origin) / VOXEL), normals)


def test_halving_the_voxel_takes_four_times_the_memory():
    """Not eight times, as the box would; blocks at the band's edges make it a little less."""
    grids = [grid_of(bumpy(np.zeros(3), 0.1), voxel) for voxel in (0.004, 0.002, 0.001)]
    held = np.array([grid.blocks[2:].size for grid in grids])
    box = np.array([np.prod(grid.shape) for grid in grids])
    assert (np.abs(held[1:] / held[:-1] - 4) < 0.7).all()
    assert (box[1:] / box[:-1] > 7.5).all()
    assert held[-1] < 0.15 * box[-1]
    assert grids[-1].blocks.nbytes + grids[-1].table.nbytes < 1.1 * 4 * held[-1]


def test_more_voxels_than_the_budget_are_refused(monkeypatch):
    monkeypatch.setattr(blocks, "VOXEL_LIMIT", 100_000)
    with pytest.raises(StageError, match=r"depth\.voxel_mm"):
        grid_of(bumpy(np.zeros(3)))


def test_a_distance_that_jumps_leaves_no_hole():
    """Space that no camera sees is a metre outside, right beside space that is far inside."""

    def distance(points: np.ndarray) -> np.ndarray:
        ball = np.linalg.norm(points, axis=1) - 0.13
        return np.where(points @ [0.2, 1.0, 0.1] < -0.03, 1.0, ball).astype(np.float32)

    grid = grid_of(distance)
    assert np.array_equal(to_dense(grid) < 0, dense_of(grid, distance) < 0)
    mesh = trimesh.Trimesh(*extract_mesh(grid)[::2], process=False)
    assert mesh.is_watertight and len(mesh.split()) == 1


def test_a_head_cut_by_the_box_is_closed_there():
    grid = grid_of(lambda points: np.linalg.norm(points[:, :2], axis=1) - 0.08)
    for cut in (grid, fair(grid, 1.4 * VOXEL), refined(grid, 0.7 * VOXEL)):
        mesh = trimesh.Trimesh(*extract_mesh(cut)[::2], process=False)
        assert mesh.is_watertight
        np.testing.assert_allclose(mesh.volume, np.pi * 0.08**2 * 0.3, rtol=0.05)


def test_grids_are_combined_where_either_is_held():
    one, other = bumpy(np.array([0.05, 0, 0]), 0.05), bumpy(np.array([-0.07, 0, 0]), 0.05)
    both = combined(np.minimum, grid_of(one), grid_of(other))
    expected = np.minimum(dense_of(both, one), dense_of(both, other))
    np.testing.assert_array_equal(to_dense(both), expected)
