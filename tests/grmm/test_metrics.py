import math

import numpy as np
import pytest
import torch
from torch import nn

from express50.errors import ConfigError
from grmm.config import MetricsConfig
from grmm.losses import ssim
from grmm.metrics import PerceptualMetrics, alexnet_features, load_lpips, psnr_db, rmse, ssim_score


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Stand-ins of the networks, random, of the same signatures."""
    root = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    state = {f"features.{k}": v for k, v in alexnet_features().state_dict().items()}
    torch.save(state | {"classifier.1.weight": torch.zeros(1)}, root / "alexnet.pth")

    class Inception(nn.Module):
        def __init__(self):
            super().__init__()
            self.mix = nn.Linear(3, 5)

        def forward(self, images: torch.Tensor, return_features: bool = False) -> torch.Tensor:
            features = self.mix(images.float().mean([2, 3]) / 255)
            return features if return_features else features * 0

    torch.jit.script(Inception()).save(str(root / "inception.pt"))
    return root


def images(count=6, size=48):
    generator = torch.Generator().manual_seed(1)
    return torch.rand(count, 3, size, size, generator=generator)


def test_lpips_is_zero_at_equal_images_and_grows(weights):
    judge = PerceptualMetrics(MetricsConfig(alexnet=str(weights / "alexnet.pth")))
    a, noise = images()[:2]
    values = [judge.lpips_of((a + s * (noise - 0.5)).clamp(0, 1), a) for s in (0.0, 0.1, 0.5)]
    assert values[0] == pytest.approx(0, abs=1e-7) and 0 < values[1] < values[2]
    assert math.isnan(judge.lpips_of(a[:, :20, :20], a[:, :20, :20]))
    assert "lpips" not in judge.missing()


def test_lpips_is_zhangs_formula(weights):
    """Worked out by hand: unit features, squared differences, linear weights, spatial means."""
    network = load_lpips(weights / "alexnet.pth")
    a, b = images()[:2]
    shift, scale = network.scaling_layer.shift, network.scaling_layer.scale
    backbone = alexnet_features()
    state = torch.load(weights / "alexnet.pth", weights_only=True)
    backbone.load_state_dict(
        {k.removeprefix("features."): v for k, v in state.items() if k.startswith("features.")}
    )
    total = 0.0
    x, y = ((2 * image[None] - 1 - shift) / scale for image in (a, b))
    layers = iter(network.lins)
    with torch.no_grad():
        for number, layer in enumerate(backbone[:12]):
            x, y = layer(x), layer(y)
            if number in (1, 4, 7, 9, 11):
                u, v = (nn.functional.normalize(z, dim=1) for z in (x, y))
                total += float((next(layers).model[-1].weight * (u - v).square()).sum(1).mean())
    judge = PerceptualMetrics(MetricsConfig(alexnet=str(weights / "alexnet.pth")))
    assert judge.lpips_of(a, b) == pytest.approx(total, rel=1e-4)


def test_fid_is_the_distance_of_gaussians(weights):
    judge = PerceptualMetrics(MetricsConfig(inception=str(weights / "inception.pt")))
    real, fake = images(12), images(12).flip(0) * torch.linspace(0.5, 1, 12)[:, None, None, None]
    for number, (a, b) in enumerate(zip(fake, real, strict=True)):
        judge.remember("even" if number % 2 == 0 else "odd", a, b)
    network = torch.jit.load(str(weights / "inception.pt"))
    rows = [network((255 * x).round().byte(), return_features=True).double() for x in (real, fake)]
    (m1, m2), (c1, c2) = (
        [f(x.detach()) for x in rows] for f in (lambda x: x.mean(0), lambda x: torch.cov(x.T))
    )
    from scipy.linalg import sqrtm

    root = np.trace(sqrtm((c1 @ c2).numpy()).real)
    expected = float((m1 - m2).square().sum() + c1.trace() + c2.trace()) - 2 * root
    assert judge.fid() == pytest.approx(expected, abs=2e-4)
    assert judge.fid("even") is not None and judge.fid("absent") is None


def test_without_weights_the_reason_is_given():
    judge = PerceptualMetrics(MetricsConfig())
    a = images()[0]
    assert math.isnan(judge.lpips_of(a, a))
    judge.remember("x", a, a)
    assert judge.fid() is None
    assert judge.missing().keys() == {"lpips", "fid"}
    assert all(reason.startswith("n/a: metrics.") for reason in judge.missing().values())


def test_wrong_weights_are_named(weights, tmp_path):
    (tmp_path / "noise").write_bytes(b"noise")
    torch.save({"features.0.weight": torch.zeros(3)}, tmp_path / "other.pth")
    torch.jit.script(nn.ReLU()).save(str(tmp_path / "relu.pt"))
    wrong = [
        (MetricsConfig(alexnet=str(tmp_path / "absent")), "no such file"),
        (MetricsConfig(alexnet=str(tmp_path / "noise")), "not a torch state dict"),
        (MetricsConfig(alexnet=str(tmp_path / "other.pth")), "features.0.weight is missing or"),
        (MetricsConfig(inception=str(tmp_path / "absent")), "no such file"),
        (MetricsConfig(inception=str(tmp_path / "noise")), "not FID's Inception"),
        (MetricsConfig(inception=str(tmp_path / "relu.pt")), "not FID's Inception"),
    ]
    for settings, message in wrong:
        with pytest.raises(ConfigError, match=message):
            PerceptualMetrics(settings)


def test_ssim_and_rmse_agree_with_loss_and_psnr():
    a, b = images(2)
    assert ssim_score(a, b) == pytest.approx(float(ssim(a, b)), abs=1e-5)
    mask = torch.zeros(48, 48, dtype=torch.bool)
    mask[10:20, 10:20] = True
    assert rmse(a, b, mask) == pytest.approx(10 ** (-psnr_db(a, b, mask) / 20))
    assert ssim_score(a, a, mask) == pytest.approx(1) and math.isnan(rmse(a, b, ~mask & mask))
