import numpy as np
import pytest
import trimesh

from benchmarks.truth import render_alpha, render_depth
from express50.geometry.cameras import Camera, rays
from express50.geometry.transforms import look_at
from express50.twin import render
from express50.twin.surface import Caster
from tests.balls import meet_ball

RADIUS = 0.1
POSE = look_at(np.array([0.3, 0.1, 0.8]), np.zeros(3))


def camera(width=80, height=60, focal=220.0, dist=(-0.2, 0.1, 1e-3, -1e-3)):
    params = (focal, focal, width / 2, height / 2, *dist)
    return Camera("c", width, height, "OPENCV", params, POSE)


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)


def test_depth_of_a_sphere_is_the_analytic_one(ball):
    view = camera()
    depth, valid = render_depth(Caster(*ball), view)
    origin, directions = rays(view)
    analytic, through = meet_ball(origin, directions, RADIUS)
    sure = through > 2e-3
    assert sure.sum() > 500 and valid[sure].all() and not valid[through < -1e-3].any()
    assert np.abs(depth - analytic)[sure].max() < 2e-5


def test_alpha_of_a_sphere_is_its_area(ball):
    vertices, faces = ball
    view = camera(dist=(0.0, 0.0, 0.0, 0.0))
    alpha = render_alpha(Caster(vertices, faces), np.zeros(len(faces), np.uint8), vertices, view)
    assert alpha.min() == 0.0 and alpha.max() == 1.0
    fine = camera(width=1280, height=960, focal=220.0 * 16, dist=(0.0, 0.0, 0.0, 0.0))
    _, covered = render_depth(Caster(vertices, faces), fine)
    exact = covered.reshape(60, 16, 80, 16).mean((1, 3))
    # 33 rays resolve a straight edge to about two of their steps.
    assert np.abs(alpha - exact).max() < 0.07 and np.abs(alpha - exact).mean() < 2e-3
    assert alpha.sum() == pytest.approx(exact.sum(), rel=1e-3)


def test_bands_do_not_change_the_picture(ball, monkeypatch):
    vertices, faces = ball
    caster, material, view = Caster(vertices, faces), np.zeros(len(faces), np.uint8), camera()
    whole = render_alpha(caster, material, vertices, view)
    depth, _ = render_depth(caster, view)
    monkeypatch.setattr(render, "BAND_PIXELS", view.width * 7)
    assert np.array_equal(render_alpha(caster, material, vertices, view), whole)
    assert np.allclose(render_depth(caster, view)[0], depth, atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 33])
def test_ray_pattern_is_even_and_holds_the_centre(count):
    u, v = render.ray_pattern(count)
    assert u[count // 2] == v[count // 2] == 0.0
    for axis in (u, v):
        assert np.allclose(np.diff(np.sort(axis)), 1.0 / count, atol=1e-6)
        assert np.abs(axis).max() <= 0.5


def test_nothing_in_view_is_empty(ball):
    vertices, faces = ball
    far = vertices + np.float32(50.0)
    alpha = render_alpha(Caster(far, faces), np.zeros(len(faces), np.uint8), far, camera())
    assert not alpha.any()
