import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torch.autograd import gradcheck

from grmm import losses
from grmm.config import LossConfig


def images(seed=0, size=(3, 24, 20)):
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(*size, generator=generator, dtype=torch.float64) for _ in range(2)]


@pytest.mark.parametrize("seed", range(3))
def test_ssim_equals_scikit_image(seed):
    a, b = images(seed, (3, 32, 40))
    b = 0.6 * a + 0.4 * b
    expected = structural_similarity(
        np.moveaxis(a.numpy(), 0, 2),
        np.moveaxis(b.numpy(), 0, 2),
        channel_axis=2,
        data_range=1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert float(losses.ssim(a, b)) == pytest.approx(expected, abs=1e-12)


def test_terms_vanish_at_equal_images_with_finite_gradient():
    a, _ = images()
    x = a.clone().requires_grad_(True)
    loss = losses.reconstruction(x, a, LossConfig())
    loss.backward()
    assert loss.item() == 0
    assert torch.isfinite(x.grad).all() and x.grad.abs().max() < 1e-9


def test_reconstruction_has_the_papers_weights():
    a, b = images()
    expected = 0.8 * (a - b).abs().mean() + 0.2 * (1 - losses.ssim(a, b))
    assert torch.equal(losses.reconstruction(a, b, LossConfig()), expected)
    perceptual = losses.reconstruction(a, b, LossConfig(), lambda x, y: torch.tensor(2.0))
    assert float(perceptual - expected) == pytest.approx(0.08)


def test_ssim_gradient():
    a, b = images(1, (1, 13, 12))
    assert gradcheck(losses.ssim, (a.requires_grad_(True), b.requires_grad_(True)))


def test_depth_is_in_decimetres_and_masked(monkeypatch):
    monkeypatch.setattr(losses, "DEPTH_ERODE_PX", 0)
    depth = torch.full((8, 8), 1.005, dtype=torch.float64)
    target = torch.ones(8, 8, dtype=torch.float64)
    valid = torch.ones(8, 8, dtype=torch.bool)
    alpha = torch.ones(8, 8, dtype=torch.float64)
    assert float(losses.depth_dm2(depth, alpha, target, valid)) == pytest.approx(0.05**2)
    valid[:, :4] = False
    spoiled = depth.clone()
    spoiled[:, :4] = 50.0
    assert float(losses.depth_dm2(spoiled, alpha, target, valid)) == pytest.approx(0.05**2)
    spoiled[:, 4:6] = 50.0  # next to the border of the mask
    monkeypatch.setattr(losses, "DEPTH_ERODE_PX", 2)
    assert float(losses.depth_dm2(spoiled, alpha, target, valid)) == pytest.approx(0.05**2)


def test_depth_without_a_common_pixel_is_zero_with_zero_gradient():
    depth = torch.rand(6, 6, requires_grad=True)
    loss = losses.depth_dm2(
        depth, torch.zeros(6, 6), torch.ones(6, 6), torch.ones(6, 6, dtype=torch.bool)
    )
    loss.backward()
    assert loss.item() == 0 and torch.equal(depth.grad, torch.zeros(6, 6))


def test_depth_gradient(monkeypatch):
    monkeypatch.setattr(losses, "DEPTH_ERODE_PX", 0)
    depth = torch.rand(7, 7, dtype=torch.float64, requires_grad=True)
    target, alpha = torch.rand(7, 7, dtype=torch.float64), torch.ones(7, 7)
    valid = torch.rand(7, 7) > 0.2
    assert gradcheck(lambda d: losses.depth_dm2(d, alpha, target, valid), (depth,))


def test_scale_term_follows_the_papers_cases_in_millimetres():
    scales = torch.tensor([[0.05, 1.0, 10.0], [12.0, 0.1, 9.9]], dtype=torch.float64)
    assert float(losses.scale_mm(scales)) == pytest.approx((1 / 0.05 + 4.0) / 6)


def test_scale_gradient():
    scales = torch.tensor([[0.05, 1.0, 12.0]], dtype=torch.float64, requires_grad=True)
    assert gradcheck(losses.scale_mm, (scales,))


def test_laplacian_is_zero_for_shifts_and_by_hand_for_a_spike():
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1]])  # vertex 0 in the middle of three
    edges = losses.mesh_edges(faces)
    assert len(edges) == 12
    assert float(losses.laplacian_mm2(torch.full((4, 3), 0.3), edges)) < 1e-6
    spike = torch.zeros(4, 3, dtype=torch.float64)
    spike[0, 2] = 1e-3  # 1 mm: itself 1, its three neighbours a third each
    assert float(losses.laplacian_mm2(spike, edges)) == pytest.approx((1 + 3 / 9) / 4)


def test_displacement_term_is_the_mean_square_in_millimetres():
    field = torch.tensor([[0.003, 0.004, 0.0], [0.0, 0.0, 0.0]])
    assert float(losses.displacement_mm2(field)) == pytest.approx(12.5)


def test_laplacian_gradient():
    edges = losses.mesh_edges(torch.tensor([[0, 1, 2], [1, 2, 3]]))
    field = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda x: losses.laplacian_mm2(1e-3 * x, edges), (field,))


def test_terms_without_evidence_are_zero():
    none = torch.zeros(0, 3)
    assert float(losses.scale_mm(none)) == float(losses.displacement_mm2(none)) == 0.0
    assert float(losses.laplacian_mm2(none, torch.zeros(0, 2, dtype=torch.int64))) == 0.0


def test_code_term_is_the_sum_of_squares():
    assert float(losses.codes(torch.tensor([3.0]), torch.tensor([0.0, 4.0]))) == 25
