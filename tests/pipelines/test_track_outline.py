"""Outlines of mattes and meshes: distances, rims, exact slopes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from pipelines.track.outline import OutlineTerm, matte_distance, outline_vertices, sample_distance
from tests.pipelines.test_track import make_camera


def disc_alpha() -> np.ndarray:
    grid = np.arange(300) + 0.5 - 150
    return np.where(np.hypot(grid[:, None], grid) < 80.0, 255, 0).astype(np.uint8)


def test_signed_distance_of_a_disc() -> None:
    distance = matte_distance(disc_alpha(), make_camera(0.0, 300))
    assert distance is not None
    angle = np.linspace(0, 6, 40)
    for radius in (60.0, 80.0, 110.0):
        pixels = 150 + radius * np.stack([np.cos(angle), np.sin(angle)], 1)
        value, gradient = sample_distance(distance, pixels)
        np.testing.assert_allclose(value, radius - 80.0, atol=0.8)
        np.testing.assert_allclose((gradient * (pixels - 150)).sum(1), radius, rtol=0.2)


@pytest.mark.parametrize("axis", [0, 1])
def test_both_directions_of_a_shrunk_matte_keep_their_scale(axis: int) -> None:
    """2448 x 2048 at 640 x 535.4 cells, which are 535: a pixel and a half at the lower end."""
    size, errors = np.array([2448, 2048]), []
    for edge in range(size[axis] - 160, size[axis] - 120, 3):  # edges are known to a cell
        alpha = np.full(size[::-1], 255, np.uint8)
        alpha[(slice(None), slice(edge, None)) if axis == 0 else slice(edge, None)] = 0
        distance = matte_distance(alpha, make_camera(0.0, 300))
        assert distance is not None and distance.values.shape == (535, 640)
        pixels = np.tile(size / 2, (41, 1))
        pixels[:, axis] = edge + np.linspace(-10, 10, 41)
        errors.append(np.interp(0.0, sample_distance(distance, pixels)[0], pixels[:, axis]) - edge)
    assert abs(np.mean(errors)) < 0.4


@pytest.mark.parametrize("fill", [0, 255])
def test_a_matte_without_an_edge_has_no_distance(fill: int) -> None:
    assert matte_distance(np.full((40, 40), fill, np.uint8), make_camera(0.0, 40)) is None


def test_outline_of_a_sphere_is_its_rim() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces)
    camera = make_camera(0.4)
    allowed = vertices[:, 1] > -0.05
    chosen = outline_vertices(vertices, faces, camera, allowed)
    assert len(chosen) >= 20
    assert allowed[chosen].all()
    towards = camera.center / np.linalg.norm(camera.center)
    # Rim of a sphere seen from distance d: cosine to the camera is r / d.
    cosine = vertices[chosen] @ towards / 0.1
    np.testing.assert_allclose(cosine, 0.1 / np.linalg.norm(camera.center), atol=0.06)


def test_outline_residual_slope_matches_finite_differences() -> None:
    camera = make_camera(0.3, 300)
    distance = matte_distance(disc_alpha(), camera)
    positions = np.random.default_rng(0).normal(size=(12, 3)) * 0.1
    outline = OutlineTerm.of(
        distance, np.arange(12), positions, np.arange(12) % 2 == 0, 3, bald=False
    )
    _, residual, slope = outline.residuals(positions)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-6
        ahead = outline.residuals(positions + step)[1]
        numeric = (ahead - residual) / 1e-6
        close = np.isclose(slope[:, :, axis], numeric, rtol=0.02, atol=1.0)
        assert close.mean() > 0.9
