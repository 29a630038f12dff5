"""Rasteriser at the edges: sizes, distances, opacities, lenses and images nobody plans for.

Every case must give finite images and gradients in float32, and in float64 the same as the
reference.
"""

from __future__ import annotations

import math
from unittest import mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from grmm.rasterize import gsplat_backend, rasterize
from tests.grmm import gsplat_kernels
from tests.grmm.gaussian_scenes import Scene, random_scene, relative_error, render

F64 = torch.float64


def check(scene: Scene, tolerance: float = 1e-9) -> dict[str, torch.Tensor]:
    """Finite in float32, equal to the reference in float64; returns the float64 results.

    The CUDA backend is checked on stand-ins for gsplat's kernels, which run anywhere.
    """
    single = render(scene, "cpu", torch.float32)
    assert all(torch.isfinite(x).all() for x in single.values())
    assert single["alpha"].min() >= 0 and single["alpha"].max() <= 1
    expected, got = render(scene, "reference"), render(scene, "cpu")
    for name in expected:
        assert torch.isfinite(got[name]).all(), name
        assert relative_error(expected[name], got[name]) < tolerance, name
    check_gsplat(scene, expected)
    return got


def check_gsplat(scene: Scene, expected: dict[str, torch.Tensor]) -> None:
    """The CUDA backend's logic in float64: everything finite, images equal to the reference."""
    with mock.patch.object(gsplat_backend, "_require_gsplat", lambda means: gsplat_kernels):
        got = render(scene, "gsplat")
    assert all(torch.isfinite(x).all() for x in got.values())
    for name in ("image", "alpha"):
        assert relative_error(expected[name], got[name]) < 1e-6, name


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-8, 1e-4, 1.0, 1e3])
def test_scales(scale):
    scene = random_scene(20, 4, seed=1)
    # not quite round: the gradient of a round one by its rotation is zero, which compares badly
    scene.tensors["scales"] = scale * torch.tensor([[1.0, 0.8, 0.6]], dtype=F64).repeat(20, 1)
    check(scene)


@pytest.mark.parametrize("axes", [(1e3, 1e-8, 1e-8), (1e-8, 1e3, 1e3), (10.0, 1e-3, 0.0)])
def test_needles_and_sheets(axes):
    scene = random_scene(20, 4, seed=2)
    scene.tensors["scales"] = torch.tensor(axes, dtype=F64).expand(20, 3)
    check(scene, tolerance=1e-8)  # the gradient by a scale of 1e3 is 1e-11 of its terms


def test_thin_needle_in_float32_keeps_its_shape():
    """A needle of 2000 px: one pixel off its axis alpha falls by exp(-1 / 2 / 0.3)."""
    out = rasterize(
        means=torch.tensor([[0.0, 0.0, 1.0]]),
        quats=torch.tensor([[math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]]),
        scales=torch.tensor([[2.0, 0, 0]]),
        opacities=torch.tensor([0.9]),
        colors=torch.zeros(1, 0),
        K=torch.tensor([[1000.0, 0, 256.5], [0, 1000, 256.5], [0, 0, 1]]),
        cam_from_world=torch.eye(4),
        width=513,
        height=513,
    )
    x = torch.arange(20, 500, 7)
    assert torch.allclose(out.alpha[x, x], torch.tensor(0.9), rtol=0.02)
    off = 0.9 * math.exp(-0.5 * 0.5 / 0.3)  # one column aside is sqrt(1/2) px from the axis
    assert torch.allclose(out.alpha[x, x + 1], torch.tensor(off), rtol=0.02)


@pytest.mark.parametrize("z", [-1.0, -1e-9, 0.0, 1e-9, 0.01, 0.01 + 1e-7, 0.011, 0.05, 1e6])
def test_behind_on_and_grazing_the_near_plane(z):
    scene = random_scene(12, 3, seed=3)
    scene.tensors["means"] = torch.cat([scene.tensors["means"][:, :2], torch.full((12, 1), z)], 1)
    scene.tensors["cam_from_world"] = torch.eye(4, dtype=F64)
    got = check(scene)
    if z <= 0.01:
        assert got["alpha"].max() == 0 and got["means"].abs().max() == 0
        assert torch.equal(got["image"], scene.tensors["background"].expand_as(got["image"]))


def test_half_of_the_scene_behind_the_camera():
    scene = random_scene(60, 3, seed=4)
    scene.tensors["cam_from_world"][:3, 3] = 0.0
    got = check(scene)
    assert 0 < (got["means"].abs().sum(1) > 0).sum() < 60


@pytest.mark.parametrize("opacity", [0.0, 1e-30, 1 / 255, 1.0])
def test_opacities(opacity):
    scene = random_scene(40, 3, seed=5)
    scene.tensors["opacities"] = torch.full((40,), opacity, dtype=F64)
    got = check(scene)
    assert (got["alpha"].max() == 0) == (opacity <= 1 / 255)  # 1/255 shows at a mean alone


@pytest.mark.parametrize("focal", [0.01, 20.0, 20_000.0, 1e6])
def test_focal_lengths(focal):
    scene = random_scene(30, 3, seed=6)
    scene.tensors["K"][[0, 1], [0, 1]] = focal
    check(scene)


@pytest.mark.parametrize("center", [-5000.0, 0.0, 5000.0])
def test_principal_point_far_outside_the_crop(center):
    scene = random_scene(30, 3, seed=7)
    scene.tensors["K"][[0, 1], [2, 2]] = center
    check(scene)


@pytest.mark.parametrize("size", [(1, 1), (1, 50), (50, 1), (16, 16), (17, 33)])
def test_image_sizes(size):
    got = check(random_scene(30, 3, *size, seed=8))
    assert got["image"].shape == (size[1], size[0], 3)


@pytest.mark.parametrize("channels", [0, 1, 9])
def test_empty_scene_is_background(channels):
    scene = random_scene(0, channels, seed=9)
    got = check(scene)
    assert torch.equal(got["image"], scene.tensors["background"].expand(47, 61, channels))
    assert got["alpha"].max() == 0 and got["depth"].max() == 0


@pytest.mark.parametrize("quat", [(0, 0, 0, 0), (1e-20, 0, 0, 0), (0, 1e12, -1e12, 3.0)])
def test_quaternions_of_any_length(quat):
    scene = random_scene(10, 3, seed=10)
    scene.tensors["quats"] = torch.tensor(quat, dtype=F64).expand(10, 4)
    expected, got = render(scene, "reference"), render(scene, "cpu")
    assert relative_error(expected["image"], got["image"]) < 1e-12
    assert torch.isfinite(got["quats"]).all()


def test_a_thousand_metres_from_the_origin():
    """A float64 camera keeps float32 Gaussians to their own rounding (0.03 mm at 1000 m)."""
    near_by = random_scene(60, 3, seed=11).tensors
    offset = torch.tensor([1000.0, -1000.0, 500.0], dtype=F64)
    far_off = dict(near_by)
    far_off["means"] = (near_by["means"] + offset).float().double()
    pose = near_by["cam_from_world"].clone()
    pose[:3, 3] -= pose[:3, :3] @ offset
    far_off["cam_from_world"] = pose
    moved = far_off["means"] - offset
    assert (moved - near_by["means"]).abs().max() < 4e-5
    images = []
    for scene, means in ((near_by, moved), (far_off, far_off["means"])):
        scene = {k: v if v.shape in ((3, 3), (4, 4)) else v.float() for k, v in scene.items()}
        images.append(rasterize(**(scene | {"means": means.float()}), width=61, height=47))
    assert (images[0].colors - images[1].colors).abs().max() < 1e-4
    assert (images[0].depth - images[1].depth).abs().max() < 1e-4


def test_many_gaussians_that_cover_everything():
    """2000 splats of 100 image widths over 100 tiles: only those before saturation keep records."""
    scene = random_scene(2000, 3, width=160, height=160, seed=12)
    scene.tensors["scales"] = torch.full((2000, 3), 50.0, dtype=F64)
    got = render(scene, "cpu", torch.float32)
    assert got["alpha"].min() > 0.999
    assert all(torch.isfinite(x).all() for x in got.values())
    nearest = (got["colors"].abs().sum(1) > 0).sum()
    assert 0 < nearest < 100


def test_colours_of_any_magnitude():
    scene = random_scene(20, 5, seed=13)
    scene.tensors["colors"] *= torch.tensor([1e-30, 1.0, 1e6, 1e12, 0.0], dtype=F64)
    check(scene)


@settings(deadline=None, max_examples=40)
@given(
    exponents=st.tuples(*[st.floats(-8, 3)] * 3),
    focal=st.floats(1.3, 4.3),
    distance=st.floats(-2.5, 3),
    opacity=st.floats(0, 1),
    seed=st.integers(0, 1000),
)
def test_anything_finite_gives_finite(exponents, focal, distance, opacity, seed):
    scene = random_scene(6, 3, width=20, height=18, seed=seed)
    scene.tensors["scales"] = (10.0 ** torch.tensor(exponents, dtype=F64)).expand(6, 3)
    scene.tensors["K"][[0, 1], [0, 1]] = 10.0**focal
    scene.tensors["cam_from_world"][2, 3] = 10.0**distance
    scene.tensors["opacities"] = torch.full((6,), opacity, dtype=F64)
    for dtype in (torch.float32, F64):
        assert all(torch.isfinite(x).all() for x in render(scene, "cpu", dtype).values())
    expected, got = render(scene, "reference"), render(scene, "cpu")
    assert (expected["alpha"] - got["alpha"]).abs().max() < 5e-3
