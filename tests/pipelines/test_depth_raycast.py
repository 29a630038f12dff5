"""Compare depth cast at the mesh with depth traced through distances, and both with a ball."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.depth import trace
from express50.geometry.cameras import Camera, rays
from express50.geometry.raycast import mesh_scene
from pipelines.depth.blocks import LevelSet, build
from pipelines.depth.maps import cast_maps
from pipelines.depth.surface import HeadSurface, extract_mesh, grid_normals
from tests.balls import meet_ball
from tests.pipelines.bump_head import ring

RADIUS, VOXEL = 0.09, 0.003


def ball(centre=0.0, radius=RADIUS) -> LevelSet:
    side = np.full(3, 0.15)
    return build(-side, side, VOXEL, lambda p: np.linalg.norm(p - centre, axis=1) - radius)


def surface_of(grid: LevelSet) -> HeadSurface:
    vertices, normals, faces = extract_mesh(grid)
    ones = np.ones(len(vertices), np.float32)
    colors, figures = np.zeros((len(vertices), 3), np.uint8), {"voxel_mm": 1e3 * grid.voxel}
    return HeadSurface(vertices, normals, faces, ones, colors, grid, figures)


def true_depth(camera: Camera) -> np.ndarray:
    """Depth of the ball, infinite beside it."""
    depth, through = meet_ball(*rays(camera), RADIUS)
    return np.where(through > 0, depth, np.inf)


@pytest.mark.parametrize("camera", ring(3, 160), ids=lambda camera: camera.id)
def test_a_ball_is_found_where_it_is(camera):
    found, true = trace(ball(), camera), true_depth(camera)
    both = np.isfinite(found) & np.isfinite(true)
    assert both.sum() > 500
    assert (np.isfinite(found) != np.isfinite(true)).sum() < 0.02 * both.sum()  # the very rim
    off = np.abs(found[both] - true[both])
    assert np.median(off) < 0.01 * VOXEL and np.percentile(off, 99) < 0.25 * VOXEL


def test_mesh_and_distances_agree():
    camera, surface = ring(1, 160)[0], surface_of(ball())
    alpha = np.ones((camera.height, camera.width), np.float32)
    meshed = cast_maps(surface, mesh_scene(surface.vertices, surface.faces), camera, alpha)
    traced = trace(surface.grid, camera)
    both = meshed.valid & np.isfinite(traced)
    assert (meshed.valid != np.isfinite(traced)).sum() < 0.02 * both.sum()
    assert np.median(np.abs(meshed.depth - traced)[both]) < 0.02 * VOXEL
    origin, way = rays(camera)
    points = (origin + traced[..., None] * way)[both]
    normals = grid_normals(surface.grid, (points - surface.grid.origin) / VOXEL)
    turned = normals @ camera.cam_from_world[:3, :3].T
    assert np.median((meshed.normals[both] * turned).sum(-1)) > 0.999


def test_rays_miss_an_empty_box_and_a_ball_behind_the_camera():
    camera = ring(1, 160)[0]
    side = np.full(3, 0.15)
    empty = build(-side, side, VOXEL, lambda points: np.full(len(points), VOXEL))
    assert not np.isfinite(trace(empty, camera)).any()
    away = replace(camera, cam_from_world=np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.cam_from_world)
    assert not np.isfinite(trace(ball(), away)).any()
