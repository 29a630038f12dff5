"""Depth and normals cast at a meshed ball are those of the ball."""

from __future__ import annotations

import numpy as np
import pytest

from express50.geometry.cameras import rays
from express50.geometry.raycast import mesh_scene
from pipelines.depth.blocks import build
from pipelines.depth.maps import cast_maps
from pipelines.depth.surface import HeadSurface, extract_mesh
from tests.balls import meet_ball
from tests.pipelines.bump_head import ring

RADIUS, VOXEL = 0.09, 0.003


@pytest.fixture(scope="module")
def surface() -> HeadSurface:
    side = np.full(3, 0.15)
    grid = build(-side, side, VOXEL, lambda points: np.linalg.norm(points, axis=1) - RADIUS)
    vertices, normals, faces = extract_mesh(grid)
    ones = np.ones(len(vertices), np.float32)
    colors, figures = np.zeros((len(vertices), 3), np.uint8), {"voxel_mm": 1e3 * VOXEL}
    return HeadSurface(vertices, normals, faces, ones, colors, grid, figures)


@pytest.mark.parametrize("camera", ring(3, 160), ids=lambda camera: camera.id)
def test_a_ball_is_found_where_it_is(surface, camera):
    alpha = np.ones((camera.height, camera.width), np.float32)
    found = cast_maps(surface, mesh_scene(surface.vertices, surface.faces), camera, alpha)
    origin, way = rays(camera)
    true, through = meet_ball(origin, way, RADIUS)
    both = found.valid & (through > 0)
    assert both.sum() > 500
    assert (found.valid != (through > 0)).sum() < 0.02 * both.sum()  # the very rim
    off = np.abs(found.depth - true)[both]
    assert np.median(off) < 0.02 * VOXEL and np.percentile(off, 99) < 0.25 * VOXEL
    outward = (origin + true[..., None] * way) / RADIUS @ camera.cam_from_world[:3, :3].T
    assert np.median((found.normals * outward).sum(-1)[both]) > 0.999
