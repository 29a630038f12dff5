"""Compare one picture with another: PSNR, RMSE, SSIM; LPIPS and FID with the user's networks.

Neither network is distributed with this project: where a path is missing the metric is ``n/a``
and says why. LPIPS takes torchvision's AlexNet (``alexnet-owt-7be5be79.pth``, a state dict) under
the linear layers that torchmetrics ships. FID takes the Inception of the original FID as
TorchScript (``inception-2015-12-05.pt``), called as ``net(images, return_features=True)`` with
(B, 3, H, W) uint8 images, as StyleGAN's and EG3D's evaluations do.
"""

from __future__ import annotations

import math
from pathlib import Path
from unittest import mock

import torch
from torch import Tensor, nn

from express50.errors import ConfigError
from express50.files.arrays import DAMAGE
from express50.files.text import no_file
from grmm.config import MetricsConfig
from grmm.losses import SSIM_WINDOW, load_features, ssim_map

PSNR_LIMIT_DB = 100.0  # for equal images: infinity could not be averaged
SMALLEST_PX = 32  # five layers of AlexNet leave nothing of smaller images
FID_LEAST_IMAGES = 2  # a covariance needs two; a trustworthy one needs thousands


def psnr_db(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio of (3, H, W) images in [0, 1], decibels, at most 100.

    ``mask`` (H, W) bool limits it to some pixels; NaN if it selects none.
    """
    return float((-10 * torch.log10(_mse(image, target, mask))).clamp(max=PSNR_LIMIT_DB))


def rmse(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Compute the RMSE of (3, H, W) images in [0, 1]; NaN if the mask selects nothing."""
    return float(_mse(image, target, mask).sqrt())


def _mse(image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    _check_same(image, target)
    squared = (image.clamp(0, 1).double() - target.double()).square()
    return (squared if mask is None else squared[:, mask]).mean()


def _check_same(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape:
        raise ValueError(f"target has shape {tuple(target.shape)}, expected {tuple(image.shape)}")


def ssim_score(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the mean SSIM of (3, H, W) images; with a mask over windows centred on its pixels.

    Windows that reach over the border are left out. NaN where no window fits or is selected.
    """
    _check_same(image, target)
    if min(image.shape[1:]) < SSIM_WINDOW:
        return math.nan
    values, reach = ssim_map(image.clamp(0, 1).float(), target.float()), SSIM_WINDOW // 2
    if mask is not None:
        values = values[:, mask[reach:-reach, reach:-reach]]
    return float(values.mean())


class PerceptualMetrics:
    """The networks of one evaluation, and the features (footage, rendering) it saw, by group."""

    def __init__(self, settings: MetricsConfig) -> None:
        """Load what the settings name; a ConfigError refuses other files."""
        self.lpips = load_lpips(Path(settings.alexnet)) if settings.alexnet else None
        self.inception = load_inception(Path(settings.inception)) if settings.inception else None
        self.features: dict[str, list[tuple[Tensor, Tensor]]] = {}

    @torch.no_grad()
    def lpips_of(self, image: Tensor, target: Tensor) -> float:
        """Compute LPIPS of (3, H, W) images in [0, 1]; NaN without weights or under 32 px."""
        if self.lpips is None or min(image.shape[1:]) < SMALLEST_PX:
            return math.nan
        pair = (x.clamp(0, 1).float().cpu()[None] for x in (image, target))
        return float(self.lpips(*pair, normalize=True))

    @torch.no_grad()
    def remember(self, group: str, image: Tensor, target: Tensor) -> None:
        """Keep the Inception features of a pair (3, H, W) in [0, 1] for `fid`."""
        if self.inception is None:
            return
        pair = torch.stack([target.clamp(0, 1), image.clamp(0, 1)]).cpu()
        found = self.inception((255 * pair).round().byte(), return_features=True)
        self.features.setdefault(group, []).append((found[0].double(), found[1].double()))

    def fid(self, group: str | None = None) -> float | None:
        """Return the FID of a group, or of all images; None if there are fewer than two."""
        groups = self.features.values() if group is None else [self.features.get(group, [])]
        pairs = [pair for rows in groups for pair in rows]
        if len(pairs) < FID_LEAST_IMAGES:
            return None
        # Imported where it is needed: it takes seconds, and few have these networks.
        from torchmetrics.image.fid import FrechetInceptionDistance

        features = nn.Identity()  # ready ones pass through, where torchmetrics expects a network
        features.num_features = len(pairs[0][0])
        metric = FrechetInceptionDistance(feature=features)
        metric.update(torch.stack([real for real, _ in pairs]), real=True)
        metric.update(torch.stack([fake for _, fake in pairs]), real=False)
        return round(float(metric.compute()), 4)

    def missing(self) -> dict[str, str]:
        """Return the metrics that cannot be measured, with the reason."""
        absent = {}
        if self.lpips is None:
            absent["lpips"] = "n/a: metrics.alexnet names no weights (torchvision's alexnet)"
        if self.inception is None:
            absent["fid"] = "n/a: metrics.inception names no network (inception-2015-12-05.pt)"
        return absent


def alexnet_features() -> nn.Sequential:
    """Return convolutions of AlexNet (Krizhevsky 2014) in torchvision's numbering, untrained."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2),
    )  # fmt: skip


def load_lpips(path: Path) -> nn.Module:
    """Build torchmetrics' LPIPS on the AlexNet of a torchvision state dict; see `load_features`."""
    from torchmetrics.functional.image import lpips

    backbone = load_features(path, "metrics.alexnet", "alexnet", alexnet_features())
    # Torchmetrics asks torchvision for the layers alone; not every build of torch has one.
    with mock.patch.object(lpips, "_get_tv_model_features", lambda *_: backbone):
        return lpips._NoTrainLpips(net="alex", pnet_rand=True)


def load_inception(path: Path) -> torch.jit.ScriptModule:
    """Load FID's Inception as TorchScript, which reaches neither files nor Python.

    Raises:
        ConfigError: no such file, not TorchScript, or a network with another call signature.
    """
    if not path.is_file():
        why = f"{no_file(path)}; leave it empty to do without"
        raise ConfigError(f"metrics.inception {path}: {why}")
    try:
        network = torch.jit.load(str(path), map_location="cpu").eval()
        found = network(torch.zeros(1, 3, 64, 64, dtype=torch.uint8), return_features=True)
    except (*DAMAGE, torch.jit.Error) as error:
        raise ConfigError(
            f"metrics.inception {path}: not FID's Inception as TorchScript, which is called "
            "net(uint8 images, return_features=True)"
        ) from error
    if found.ndim != 2 or len(found) != 1:
        raise ConfigError(
            f"metrics.inception {path}: gives {tuple(found.shape)} for one image, expected (1, N)"
        )
    return network
