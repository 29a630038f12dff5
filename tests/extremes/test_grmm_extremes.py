"""Where GRMM's formulas could divide by zero, overflow or lose their gradient."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

from grmm import losses
from grmm.config import SCALE_RANGE_MM, LossConfig
from grmm.edit import interpolate_tracked, slerp_axis_angle
from grmm.metrics import psnr_db, ssim_score
from grmm.model import initial_scales
from grmm.networks import normalise_depth
from tests.grmm.synthetic import EllipsoidSource, tiny_config


@pytest.mark.parametrize("value", [0.0, 1e-30, 0.5, 1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
def test_ssim_of_equal_constant_images_is_one(value, dtype):
    image = torch.full((3, 16, 16), value, dtype=dtype)
    assert float(losses.ssim(image, image.clone())) == 1


def test_ssim_of_different_constant_images_is_the_luminance_term():
    a, b = torch.zeros(1, 16, 16, dtype=torch.float64), torch.ones(1, 16, 16, dtype=torch.float64)
    expected = losses.SSIM_C1 / (1 + losses.SSIM_C1)
    assert float(losses.ssim(a, b)) == pytest.approx(expected, rel=1e-9)


def test_ssim_gradient_at_constant_and_equal_images_is_finite():
    for start in (torch.zeros(1, 12, 12), torch.ones(1, 12, 12), torch.rand(1, 12, 12)):
        x = start.clone().requires_grad_(True)
        losses.ssim(x, start).backward()
        assert torch.isfinite(x.grad).all()


@settings(deadline=None, max_examples=25)
@given(
    st.integers(0, 2**31), st.integers(1, 20), st.integers(1, 20), st.floats(0, 1), st.floats(0, 1)
)
def test_ssim_stays_in_its_range_and_is_symmetric(seed, height, width, low, high):
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.rand(2, 1, height, width, generator=generator) * (high - low) + low
    value = float(losses.ssim(a, b))
    assert -1.000001 <= value <= 1.000001
    assert value == pytest.approx(float(losses.ssim(b, a)), abs=1e-5)
    assert float(losses.ssim(a, a)) == pytest.approx(1, abs=1e-6)


def test_reciprocal_scale_is_finite_down_to_zero():
    scales = torch.tensor([[0.0, 1e-12, 1e-7]], requires_grad=True)
    loss = losses.scale_mm(scales)
    loss.backward()
    assert loss.item() == pytest.approx(1e7)
    assert torch.isfinite(scales.grad).all()


def test_scale_term_of_huge_scales_is_finite():
    scales = torch.full((4, 3), 1e6, requires_grad=True)
    losses.scale_mm(scales).backward()
    assert torch.isfinite(scales.grad).all() and (scales.grad > 0).all()


@pytest.mark.parametrize("spacing", [0.0, 1e-9, 1e9])
def test_initial_scales_stay_within_bounds(spacing):
    config = tiny_config().model
    raw = initial_scales(torch.full((2, 2), spacing), config)
    low, high = SCALE_RANGE_MM
    scales = torch.nn.functional.softplus(raw)
    assert (scales >= 0.99 * low).all() and (scales <= high).all()


@pytest.mark.parametrize("depth", [0.0, 1.0, 1e6])
def test_constant_depth_normalises_to_finite_values(depth):
    x = torch.full((4, 4), depth, requires_grad=True)
    out = normalise_depth(x, torch.ones(4, 4))
    out.sum().backward()
    assert torch.isfinite(out).all() and torch.isfinite(x.grad).all()
    assert (out >= 0).all() and (out <= 1).all()


def test_empty_depth_normalises_to_zero():
    for depth in (torch.zeros(4, 4), torch.full((4, 4), float("nan")), torch.full((4, 4), 1e30)):
        out = normalise_depth(depth, torch.zeros(4, 4))
        assert torch.equal(out, torch.zeros(4, 4))


def test_single_covered_pixel_and_stray_nan():
    depth = torch.tensor([[0.7, float("nan")], [float("inf"), 0.0]])
    out = normalise_depth(depth, torch.tensor([[1.0, 1.0], [1.0, 0.0]]))
    assert torch.equal(out, torch.zeros(2, 2))


def test_depth_loss_of_infinite_target_outside_the_mask_has_finite_gradient(monkeypatch):
    monkeypatch.setattr(losses, "DEPTH_ERODE_PX", 0)
    depth = torch.ones(4, 4, requires_grad=True)
    target = torch.full((4, 4), float("inf"))
    target[1, 1] = 1.001
    losses.depth_dm2(depth, torch.ones(4, 4), target, torch.isfinite(target)).backward()
    assert torch.isfinite(depth.grad).all() and float(depth.grad[1, 1]) != 0


def test_laplacian_without_edges_or_displacement_is_zero():
    field = torch.rand(3, 3, requires_grad=True)
    loss = losses.laplacian_mm2(field, torch.zeros(0, 2, dtype=torch.int64))
    loss.backward()
    assert loss.item() == 0 and torch.equal(field.grad, torch.zeros(3, 3))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_images_give_a_close_loss(dtype):
    a, b = torch.rand(3, 24, 24), torch.rand(3, 24, 24)
    expected = float(losses.reconstruction(a, b, LossConfig()))
    got = float(losses.reconstruction(a.to(dtype), b.to(dtype), LossConfig()))
    assert got == pytest.approx(expected, rel=0.02)


def test_metrics_of_equal_and_empty_images():
    image = torch.rand(3, 16, 16)
    assert psnr_db(image, image) == 100
    nothing = torch.zeros(16, 16, dtype=torch.bool)
    assert np.isnan(psnr_db(image, image, nothing)) and np.isnan(ssim_score(image, image, nothing))
    assert psnr_db(torch.zeros(3, 4, 4), torch.ones(3, 4, 4)) == 0


def rotation_gap(a, b):
    """Angle between the rotations of two axis-angle vectors, radians."""
    from express50.geometry.transforms_torch import axis_angle_to_matrix

    A, B = (axis_angle_to_matrix(torch.as_tensor(np.asarray(x)).double()) for x in (a, b))
    return float(torch.linalg.norm(A - B)) / 2**0.5


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ([0.0, 0, 0], [0.0, 0, 0]),
        ([0.4, 0, 0], [0.4, 0, 0]),
        ([1e-9, 0, 0], [0, 1e-9, 0]),
        ([np.pi, 0, 0], [-np.pi, 0, 0]),
        ([np.pi - 1e-9, 0, 0], [0, np.pi - 1e-9, 0]),
        ([0, 0, 0], [np.pi, 0, 0]),
        ([3 * np.pi, 0, 0], [0.1, 0.2, 0.3]),
    ],
)
@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_slerp_of_equal_opposite_and_wound_up_rotations(a, b, t):
    out = slerp_axis_angle(np.array(a), np.array(b), t)
    assert np.isfinite(out).all()
    if t in (0.0, 1.0):
        assert rotation_gap(out, a if t == 0 else b) < 1e-6


def test_slerp_goes_at_constant_speed():
    steps = [slerp_axis_angle(np.zeros(3), np.array([0, 0, 2.0]), t) for t in (0.25, 0.5, 0.75)]
    np.testing.assert_allclose(steps, [[0, 0, 0.5], [0, 0, 1.0], [0, 0, 1.5]], atol=1e-7)


def test_interpolation_of_a_frame_with_itself_is_the_frame():
    tracked = EllipsoidSource(size=8).read(0).place.tracked
    again = interpolate_tracked(tracked, tracked, 0.3)
    np.testing.assert_allclose(again.jaw, tracked.jaw, atol=1e-12)
    np.testing.assert_allclose(again.expression, tracked.expression, atol=1e-12)


def test_refinement_input_gradient_in_float64():
    """The limits are detached, so only depths between them have the numerical gradient."""
    inner = torch.tensor([0.55, 0.7], dtype=torch.float64, requires_grad=True)
    ends = torch.tensor([0.5, 0.9], dtype=torch.float64)
    alpha = torch.ones(2, 2, dtype=torch.float64)
    assert gradcheck(lambda d: normalise_depth(torch.stack([d, ends]), alpha), (inner,))
