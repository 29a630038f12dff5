"""The mesh rasteriser at the edges: near planes, needles, lenses and places nobody plans for.

Every case is held against an oracle that solves each ray against each triangle.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.geometry.cameras import Camera
from express50.geometry.mesh_raster import Raster, rasterize
from express50.geometry.mesh_render import antialias, barycentrics, covered
from express50.geometry.transforms import look_at
from tests.express50.mesh_scenes import camera, oracle, sphere

ONE = np.array([[0, 1, 2]])


def check(vertices, faces, view: Camera, near: float = 0.01) -> Raster:
    """Equal to the oracle wherever that is sure; finite; pairs that lie side by side."""
    vertices, faces = np.asarray(vertices, float), np.asarray(faces)
    face_id, depth, clear = oracle(vertices, faces, view, near)
    got = rasterize(vertices, faces, view, near=near)
    np.testing.assert_array_equal(got.face_id[clear], face_id[clear])
    np.testing.assert_allclose(got.depth[clear], depth[clear], rtol=1e-5)
    assert np.isfinite(got.depth).all()
    assert ((got.face_id >= 0) == (got.depth >= near * (1 - 1e-6))).all()
    step = np.abs(got.pairs[:, 0] - got.pairs[:, 1])
    assert np.isin(step, [1, view.width]).all()
    assert got.pairs.size == 0 or got.pairs[:, 2:].max() < len(vertices)
    return got


def test_through_behind_and_beside_the_near_plane():
    view = camera(32, 24, 16.0)
    floor = np.array([[-3.0, 0.4, -2], [3, 0.4, -2], [3, 0.4, 6], [-3, 0.4, 6]])
    got = check(floor, [[0, 1, 2], [0, 2, 3]], view)
    assert (got.face_id[-1] >= 0).all() and (got.face_id[0] < 0).all()
    cut = check(floor, [[0, 1, 2], [0, 2, 3]], view, near=2.0)
    assert 0 < (cut.face_id >= 0).sum() < (got.face_id >= 0).sum()
    assert cut.depth[cut.face_id >= 0].min() >= 2.0
    behind = floor - [0, 0, 6.5]
    assert (check(behind, [[0, 1, 2], [0, 2, 3]], view).face_id < 0).all()


def test_on_the_near_plane_and_through_the_centre_of_the_camera():
    view = camera(16, 16, 8.0)
    flat = np.array([[-5.0, -5, 1], [5, -5, 1], [0, 9, 1]])
    assert (rasterize(flat, ONE, view, near=1.0).face_id >= 0).any()
    assert (rasterize(flat, ONE, view, near=1.0 + 1e-9).face_id < 0).all()
    through = np.array([[0.0, 0, 0], [1, 0.2, 2], [-1, 0.2, 2]])  # edge on, a corner at the centre
    assert np.isfinite(rasterize(through, ONE, view).depth).all()
    straddling = np.array([[0.0, -1, -1], [2, 1.5, 3], [-2, 1.5, 3]])
    check(straddling, ONE, view)


@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-7, 1e-3])
def test_seen_edge_on(tilt):
    view = camera(33, 33, 40.0)
    y = tilt * np.array([1.0, 1.0, -1.0])
    card = np.stack([[-1.0, 1.0, 0.0], y, [2.0, 2.0, 4.0]], 1)
    got = check(card, ONE, view)
    hit = got.face_id >= 0
    assert not hit.any() or (got.depth[hit].min() >= 2.0 and got.depth[hit].max() <= 4.0)


def test_needles_and_faces_without_area():
    view = camera(64, 64, 60.0)
    needle = np.array([[-1.0, -0.7, 2], [1, 0.8, 2], [1, 0.8 + 1e-9, 2]])
    got = check(needle, ONE, view)
    assert (got.face_id >= 0).sum() <= 64
    wide = np.array([[-1e4, 0, 2], [1e4, 0.01, 2], [0, 0.2, 2.0]])
    check(wide, ONE, view)
    dots = np.array([[0.0, 0, 2], [0, 0, 2], [0, 0, 2], [0.1, 0.1, 2], [0.2, 0.2, 2]])
    empty = rasterize(dots, [[0, 1, 2], [0, 0, 3], [0, 3, 4], [3, 3, 3]], view)
    assert (empty.face_id < 0).all() and len(empty.pairs) == 0
    # amid sound faces they change nothing but the ids
    vertices, faces = sphere(6)
    vertices = np.concatenate([vertices + [0, 0, 4.0], dots])
    degenerate = np.array([[0, 0, 1], [len(vertices) - 1] * 3])
    mixed = rasterize(vertices, np.concatenate([degenerate, faces]), view)
    plain = rasterize(vertices, faces, view)
    np.testing.assert_array_equal(mixed.face_id, np.where(plain.face_id < 0, -1, plain.face_id + 2))


@pytest.mark.parametrize(("focal", "distance"), [(20.0, 1.4), (60.0, 3.0), (8000.0, 400.0)])
def test_focal_lengths(focal, distance):
    vertices, faces = sphere(5)
    got = check(vertices + [0, 0, distance], faces, camera(48, 40, focal))
    assert (got.face_id >= 0).sum() > 200 and len(got.pairs) > 20


def test_a_kilometre_from_the_origin():
    vertices, faces = sphere(5, 0.12)
    place = np.array([800.0, -20.0, 600.0])
    up = np.array([0.0, 1.0, 0.0])
    near_by = camera(48, 48, 150.0, look_at(np.array([0.3, 0.2, 1.0]), np.zeros(3), up))
    far = camera(48, 48, 150.0, look_at(place + [0.3, 0.2, 1.0], place, up))
    here, there = rasterize(vertices, faces, near_by), rasterize(vertices + place, faces, far)
    assert (here.face_id != there.face_id).sum() <= 2 and (here.face_id >= 0).sum() > 500
    np.testing.assert_allclose(
        here.depth, there.depth, atol=1e-3 if (here.face_id != there.face_id).any() else 1e-6
    )
    assert abs(len(here.pairs) - len(there.pairs)) <= 2


def test_a_head_of_micrometres_and_one_of_kilometres():
    vertices, faces = sphere(5)
    seen = [
        rasterize(s * (vertices + [0, 0, 3.0]), faces, camera(40, 40, 40.0), near=0.1 * s).face_id
        for s in (1e-6, 1.0, 1e3)
    ]
    assert all((ids != seen[1]).sum() <= 2 for ids in seen) and (seen[1] >= 0).any()


def test_off_screen_empty_and_one_pixel():
    vertices, faces = sphere(5)
    view = camera(16, 16, 20.0)
    for shift in ([50.0, 0, 3], [0, -50.0, 3], [1e12, 0, 3], [0, 0, 1e9]):
        got = rasterize(vertices + shift, faces, view)
        assert (got.face_id < 0).all() and len(got.pairs) == 0
    for points, index in (
        (np.zeros((0, 3)), np.zeros((0, 3), int)),
        (vertices, np.zeros((0, 3), int)),
    ):
        got = rasterize(points, index, view)
        assert (got.face_id < 0).all() and got.pairs.shape == (0, 4)
        assert (rasterize(points, index, view, backend="open3d").face_id < 0).all()
    one = rasterize(vertices + [0, 0, 3], faces, camera(1, 1, 20.0))
    assert one.face_id.shape == (1, 1) and one.face_id[0, 0] >= 0 and len(one.pairs) == 0
    line = rasterize(vertices + [0, 0, 3], faces, camera(64, 1, 20.0))
    assert (np.abs(line.pairs[:, 0] - line.pairs[:, 1]) == 1).all() and len(line.pairs) == 2


def test_coordinates_that_overflow_are_harmless():
    huge = np.array([[-1e200, -1e200, 1], [1e200, -1e200, 1], [0, 1e200, 1.0]])
    assert np.isfinite(rasterize(huge, ONE, camera(8, 8, 8.0)).depth).all()


@pytest.mark.parametrize(("focal", "distance"), [(20.0, 1.4), (8000.0, 400.0)])
def test_derivatives_in_float32_are_finite_and_near_those_of_float64(focal, distance):
    vertices, faces = sphere(5)
    vertices, view = vertices + [0, 0, distance], camera(48, 40, focal)
    seen = covered(rasterize(vertices, faces, view))
    results = []
    for dtype in (torch.float32, torch.float64):
        place = torch.tensor(vertices, dtype=dtype).requires_grad_()
        lens = [torch.tensor(x, dtype=dtype) for x in (view.K, view.cam_from_world)]
        weights = barycentrics(seen, place, torch.tensor(faces), *lens)
        cover = torch.zeros(40 * 48, 1, dtype=dtype)
        cover[seen.pixels] = 1
        blended = antialias(cover.reshape(40, 48, 1), seen, place, *lens)
        loss = blended.square().sum() + (weights[:, 0] * torch.arange(len(weights))).mean() * 1e-3
        results.append([weights, blended, torch.autograd.grad(loss, place)[0]])
    for single, double in zip(*results, strict=True):
        assert torch.isfinite(single).all()
        scale = float(double.detach().abs().max())
        torch.testing.assert_close(single.double(), double, atol=5e-3 * scale, rtol=0)


coordinates = st.floats(-1.5, 1.5, width=32)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(coordinates, coordinates, st.floats(-0.5, 3.0, width=32)), min_size=3, max_size=9
    ),
    st.integers(0, 2**32 - 1),
    st.sampled_from([5.0, 20.0, 90.0]),
)
def test_any_soup_of_triangles(points, seed, focal):
    vertices = np.array(points)
    faces = np.random.default_rng(seed).integers(0, len(vertices), (6, 3))
    check(vertices, faces, camera(17, 13, focal), near=0.05)
