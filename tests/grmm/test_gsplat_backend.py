"""The CUDA backend: its logic on a stand-in for gsplat's kernels, and the real thing on CUDA."""

from __future__ import annotations

import pytest
import torch

from grmm.rasterize import gsplat_backend, rasterize
from grmm.rasterize.projection import Pinhole, Splats, project
from tests.grmm import gsplat_kernels
from tests.grmm.gaussian_scenes import random_scene, relative_error, render


@pytest.mark.parametrize("channels", [0, 3, 35, 70])
@pytest.mark.parametrize("antialiased", [False, True])
def test_plane_channels_chunks_and_camera_gradients(channels, antialiased, monkeypatch):
    monkeypatch.setattr(gsplat_backend, "_require_gsplat", lambda means: gsplat_kernels)
    scene = random_scene(60, channels, width=40, height=33, seed=2, antialiased=antialiased)
    expected, got = render(scene, "reference"), render(scene, "gsplat")
    errors = {name: relative_error(expected[name], got[name]) for name in expected}
    assert max(errors.values()) < 1e-10, errors


def test_three_affine_channels_are_the_ray_length_in_float32():
    scene = random_scene(50, 0, seed=8).tensors
    camera = Pinhole(K=scene["K"], cam_from_world=scene["cam_from_world"], width=61, height=47)
    gaussians = {k: scene[k] for k in ("means", "quats", "scales", "opacities", "colors")}
    splats = project(Splats(**gaussians), camera)
    channels = gsplat_backend.plane_channels(splats, scene["K"]).float()
    pixel = torch.tensor([20.5, 30.5], dtype=torch.float64)
    blended = channels[:, None, :].expand(-1, 61, 3).contiguous()
    got = gsplat_backend.combine_planes(blended, scene["K"])[:, 20]
    # combine_planes takes rows as v, so only row r of Gaussian r is at v = r + 0.5
    v = torch.arange(50, dtype=torch.float64) + 0.5
    delta_u, delta_v = pixel[0] - splats.means2d[:, 0], v - splats.means2d[:, 1]
    length, slope_u, slope_v = splats.planes.unbind(1)
    expected = length + slope_u * delta_u + slope_v * delta_v
    shown = splats.visible
    assert (got - expected)[shown].abs().max() < 2e-6


@pytest.mark.skipif(torch.cuda.is_available(), reason="says what is missing where CUDA is missing")
def test_without_cuda_it_says_what_to_use():
    scene = random_scene(3, 3).tensors
    with pytest.raises(RuntimeError, match="CUDA"):
        rasterize(**scene, width=8, height=8, backend="gsplat")


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("channels", [3, 35])
def test_gsplat_matches_the_reference(channels):
    """Boundary-band metric: a few pixels may flip at alpha = 1/255, the others agree closely."""
    scene = random_scene(400, channels, width=128, height=96, seed=6)
    leaves = {k: v.float().cuda().requires_grad_() for k, v in scene.tensors.items()}
    extra = {"width": 128, "height": 96, "median_depth": True, "normals": True}
    got = rasterize(**leaves, **extra, backend="gsplat")
    expected = rasterize(**scene.tensors, **extra, backend="reference")
    for name in ("colors", "depth", "alpha", "median_depth", "normals"):
        difference = (getattr(got, name).cpu() - getattr(expected, name)).abs()
        assert (difference < 1e-4).double().mean() > 0.999, name
    got.colors.square().mean().backward()
    assert all(
        torch.isfinite(leaves[k].grad).all() and leaves[k].grad.abs().sum() > 0
        for k in ("means", "quats", "scales", "opacities", "colors", "K", "cam_from_world")
    )
