"""Derivatives of mesh rendering: exact inside faces, right on average across outlines."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from benchmarks.mesh_raster import gradient_ratio
from express50.geometry import mesh_rows
from express50.geometry.cameras import Camera, resized
from express50.geometry.mesh_raster import rasterize
from express50.geometry.mesh_render import (
    antialias,
    barycentrics,
    compose,
    covered,
    crossings,
    interpolate,
    pixel_rays,
    sample_texture,
    sh_light,
)
from express50.geometry.transforms_torch import axis_angle_to_matrix
from express50.head.builtin import load_builtin
from tests.express50.mesh_scenes import camera, head_camera, sphere

F64 = torch.float64


class View:
    """A mesh before a camera, in torch."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, lens: Camera) -> None:
        self.vertices, self.faces = torch.from_numpy(vertices), torch.from_numpy(faces)
        self.raster = rasterize(vertices, faces, lens)
        self.seen = covered(self.raster)
        self.lens = (torch.from_numpy(lens.K), torch.from_numpy(lens.cam_from_world))

    def weights(self, vertices: torch.Tensor) -> torch.Tensor:
        return barycentrics(self.seen, vertices, self.faces, *self.lens)


@pytest.fixture
def view():
    vertices, faces = sphere(4)
    angle = torch.tensor([0.3, 0.5, 0.2], dtype=F64)
    turned = vertices @ axis_angle_to_matrix(angle).numpy().T
    return View(turned + [0.11, -0.07, 3.2], faces.astype(np.int64), camera(12, 9, 9.0))


def test_weighted_corners_are_where_the_rays_hit(view):
    weights = view.weights(view.vertices)
    points = interpolate(view.seen, weights, view.vertices, view.faces)
    depth = torch.from_numpy(view.raster.depth).reshape(-1, 1)[view.seen.pixels].double()
    torch.testing.assert_close(
        points, depth * pixel_rays(view.seen, view.lens[0]), atol=1e-6, rtol=0
    )
    assert weights.min() > -1e-9
    torch.testing.assert_close(weights.sum(1), torch.ones(len(weights), dtype=F64))


def test_float32_agrees_with_float64(view):
    K, pose = (x.float() for x in view.lens)
    single = barycentrics(view.seen, view.vertices.float(), view.faces, K, pose)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), view.weights(view.vertices), atol=2e-5, rtol=0)


def test_gradcheck_of_barycentrics_and_interpolation(view):
    attributes = torch.randn(len(view.vertices), 2, dtype=F64, generator=seeded()).requires_grad_()
    vertices = view.vertices.clone().requires_grad_()
    K, pose = (x.clone().requires_grad_() for x in view.lens)

    def drawn(vertices, attributes, K, pose):
        weights = barycentrics(view.seen, vertices, view.faces, K, pose)
        return interpolate(view.seen, weights, attributes, view.faces)

    assert torch.autograd.gradcheck(drawn, (vertices, attributes, K, pose), fast_mode=True)


def test_gradcheck_of_texture(view):
    texture = torch.rand(5, 7, 3, dtype=F64, generator=seeded()).requires_grad_()
    uv = torch.rand(20, 2, dtype=F64, generator=seeded()) * 1.2 - 0.1
    assert torch.autograd.gradcheck(sample_texture, (texture, uv.requires_grad_()))


def test_gradcheck_of_antialiasing(view):
    image = torch.rand(9, 12, 2, dtype=F64, generator=seeded()).requires_grad_()
    vertices = view.vertices.clone().requires_grad_()
    assert len(view.seen.pairs) > 15

    def blended(image, vertices):
        return antialias(image, view.seen, vertices, *view.lens)

    assert torch.autograd.gradcheck(blended, (image, vertices), fast_mode=True)
    assert (
        torch.autograd.grad(blended(image, vertices)[..., 0].sum(), vertices)[0].abs().max() > 0.1
    )


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_texture_runs_up_and_its_texels_are_centred():
    texture = torch.arange(12, dtype=F64).reshape(3, 4, 1)
    uv = torch.tensor(
        [[0.125, 5 / 6], [0.875, 1 / 6], [0, 1], [1, 0], [0.25, 5 / 6], [2, -3]], dtype=F64
    )
    got = sample_texture(texture, uv)[:, 0]
    torch.testing.assert_close(got, torch.tensor([0.0, 11, 0, 11, 0.5, 11], dtype=F64))


def test_coverage_is_the_area_of_the_disc():
    """Blended coverage adds up to the area of a sphere's outline, far better than pixels do."""
    vertices, faces = sphere(60)
    for radius in (10.0, 10.3, 10.6):
        focal = radius / math.tan(math.asin(1 / 3))
        lens = Camera("c", 40, 40, "PINHOLE", (focal, focal, 20.13, 19.9), np.eye(4))
        drawn = View(vertices + [0, 0, 3.0], faces.astype(np.int64), lens)
        cover = (torch.from_numpy(drawn.raster.face_id) >= 0).double()[..., None]
        blended = antialias(cover, drawn.seen, drawn.vertices, *drawn.lens)
        assert blended.min() >= -1e-9 and blended.max() <= 1 + 1e-9
        assert float(blended.sum()) == pytest.approx(math.pi * radius**2, rel=4e-3)


@pytest.mark.parametrize("angle", [0.0, 0.8, 2.0])
def test_coverage_of_a_head_is_that_of_many_rays_a_pixel(angle):
    """Where several folds end between two pixels, the last one must count."""
    model = load_builtin()
    mesh = (model.template.double().numpy(), model.faces.numpy())
    lens = head_camera(128, angle)
    drawn = View(*mesh, lens)
    cover = (torch.from_numpy(drawn.raster.face_id) >= 0).double()[..., None]
    blended = antialias(cover, drawn.seen, drawn.vertices, *drawn.lens)[..., 0]
    rays = rasterize(*mesh, resized(lens, 1024, 1024), pairs=False).face_id >= 0
    expected = torch.from_numpy(rays.reshape(128, 8, 128, 8).mean((1, 3)))
    rim = torch.unique(drawn.seen.pairs[:, :2])
    apart = (blended - expected).reshape(-1)[rim]
    assert abs(apart.mean()) < 0.005 and apart.abs().mean() < 0.025 and apart.abs().max() < 0.35


def test_crossings_lie_between_the_centres(view):
    place = crossings(view.seen, view.vertices, *view.lens)
    assert place.min() >= 0 and place.max() <= 1 and place.std() > 0.2


@pytest.mark.parametrize("size", [256, 512])
@pytest.mark.parametrize("motion", ["roll", "shift", "scale"])
def test_outline_gradients_match_finite_differences(size, motion):
    ratio = gradient_ratio(load_builtin(), size, motion)
    assert ratio == pytest.approx(1.0, abs=0.03)


def directions(count: int) -> torch.Tensor:
    """Evenly spread unit vectors (Fibonacci's spiral)."""
    index = torch.arange(count, dtype=F64) + 0.5
    z, around = 1 - 2 * index / count, index * math.pi * (1 + math.sqrt(5))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * around.cos(), ring * around.sin(), z], 1)


def test_light_is_the_cosine_weighted_mean_of_what_comes_in():
    """Against the integral of radiance times cosine over the hemisphere, band by band."""
    from scipy.special import sph_harm_y

    sky, normals = directions(20000), directions(23)
    theta, phi = torch.arccos(sky[:, 2]).numpy(), torch.atan2(sky[:, 1], sky[:, 0]).numpy()
    place = 0
    for band in range(3):
        for order in range(-band, band + 1):
            value = sph_harm_y(band, abs(order), theta, phi)
            part = value.real if order >= 0 else value.imag
            # the common graphics sign: without the Condon-Shortley phase
            radiance = torch.from_numpy(part * (1 if order == 0 else math.sqrt(2) * (-1) ** order))
            coefficients = torch.zeros(9, 1, dtype=F64)
            coefficients[place] = 1.0
            expected = 4 * ((normals @ sky.T).clamp_min(0) * radiance).mean(1)
            got = sh_light(normals, coefficients)[:, 0]
            torch.testing.assert_close(got, expected, atol=1e-3, rtol=0)
            place += 1
    even = torch.zeros(9, 3, dtype=F64)
    even[0] = math.sqrt(4 * math.pi)
    torch.testing.assert_close(sh_light(normals, even), torch.ones(23, 3, dtype=F64))


def test_nothing_seen_is_an_empty_picture():
    vertices, faces = sphere(4)
    drawn = View(vertices + [0, 0, -9.0], faces.astype(np.int64), camera(6, 5, 5.0))
    place = drawn.vertices.clone().requires_grad_()
    values = interpolate(drawn.seen, drawn.weights(place), place, drawn.faces)
    assert values.shape == (0, 3)
    picture = compose(drawn.seen, values, torch.full((5, 6, 3), 0.5, dtype=F64))
    blended = antialias(picture, drawn.seen, place, *drawn.lens)
    assert (blended == 0.5).all()
    assert (torch.autograd.grad(blended.sum() + values.sum(), place)[0] == 0).all()


def test_a_raster_that_is_stale_gives_finite_numbers(view):
    """Weights for vertices that have moved on, or turned a face edge on, are finite."""
    flat = view.vertices * torch.tensor([1.0, 0.0, 1.0], dtype=F64)
    flat = flat.requires_grad_()
    weights = view.weights(flat)
    blended = antialias(torch.rand(9, 12, 1, dtype=F64), view.seen, flat, *view.lens)
    gradient = torch.autograd.grad(weights.clamp(-2, 2).sum() + blended.sum(), flat)[0]
    assert torch.isfinite(weights).all() and torch.isfinite(gradient).all()


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_native_rows_and_torch_rows_agree(view, monkeypatch, dtype):
    def run() -> list[torch.Tensor]:
        rows = torch.randn(len(view.seen.seen), 3, 5, dtype=F64, generator=seeded(1)).to(dtype)
        coefficients = torch.randn(len(view.seen.pixels), 3, dtype=F64, generator=seeded(2)).to(
            dtype
        )
        leaves = [rows.requires_grad_(), coefficients.requires_grad_()]
        out = mesh_rows.weigh_rows(*leaves, view.seen.group, view.seen.counts)
        return [out, *torch.autograd.grad(out.square().sum(), leaves)]

    native = run()
    monkeypatch.setattr(mesh_rows, "_native", lambda rows: False)
    for a, b in zip(native, run(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4 if dtype == torch.float32 else 1e-10, atol=1e-4)


def test_dtypes_and_shapes_that_do_not_fit_are_refused(view):
    weights = view.weights(view.vertices)
    with pytest.raises(ValueError, match="rows are torch.float32 and coefficients torch.float64"):
        interpolate(view.seen, weights, view.vertices.float(), view.faces)
    with pytest.raises(ValueError, match="coefficients has shape"):
        interpolate(view.seen, weights[1:], view.vertices, view.faces)
