"""Define the terms of the objective (paper: Training and Losses), each in the unit in its name.

All return 0-d tensors, which are finite for equal and for constant images and 0 if there is nothing
to compare.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor, nn

from express50.errors import ConfigError
from express50.files.arrays import read_weights
from grmm.config import SCALE_RANGE_MM, LossConfig

L1, PERCEPTUAL = 0.8, 0.04  # weights of colours and of VGG16 features, the paper's (G14)
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
DEPTH_ERODE_PX = 2  # expected depth bleeds across silhouettes (G11)
# Simonyan and Zisserman 2014, configuration D, up to relu4_3; "M" halves the map.
LAYERS: tuple[int | str, ...] = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512)
COMPARED = (3, 8, 15, 22)  # relu1_2, relu2_2, relu3_3, relu4_3 by torchvision's numbering
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet, as torchvision trained it

Perceptual = Callable[[Tensor, Tensor], Tensor]


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Compute the mean structural similarity of two images (C, H, W) with values in [0, 1].

    Gaussian window 11 x 11, sigma 1.5, only where it lies inside the image; it shrinks to the
    largest odd size that fits smaller images. Half precision is computed in float32.

    Source: Wang et al. 2004; the window is separable: two 1D passes in place of one 2D.
    """
    return ssim_map(a, b).mean()


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Compute the SSIM per window (C, H - 10, W - 10); see `ssim`.

    Raises:
        ValueError: the images are empty.
    """
    if not a.numel():
        raise ValueError(f"image has shape {tuple(a.shape)}, expected at least one pixel")
    dtype = a.dtype if a.dtype in (torch.float32, torch.float64) else torch.float32
    a, b = a.to(dtype), b.to(dtype)
    stack = torch.cat([a, b, a * a, b * b, a * b])[None]  # (1, 5 C, H, W)
    # The window slides over one axis after the other, in one channel at a time.
    channels, height, width = stack.shape[1:]
    rows, columns = (_window(n, stack.dtype, stack.device) for n in (height, width))
    across = columns.view(1, 1, 1, -1).expand(channels, -1, -1, -1)
    down = rows.view(1, 1, -1, 1).expand(channels, -1, -1, -1)
    blurred = nn.functional.conv2d(stack, across, groups=channels)
    mean_a, mean_b, aa, bb, ab = nn.functional.conv2d(blurred, down, groups=channels)[0].chunk(5)
    covariance = ab - mean_a * mean_b
    variances = (aa - mean_a * mean_a) + (bb - mean_b * mean_b)
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a * mean_a + mean_b * mean_b + SSIM_C1)
    return luminance * (2 * covariance + SSIM_C2) / (variances + SSIM_C2)


@lru_cache(maxsize=32)
def _window(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the 1D Gaussian window for an axis of ``size`` pixels, sum 1."""
    length = min(SSIM_WINDOW, size - 1 + size % 2)
    offset = torch.arange(length, dtype=torch.float64) - length // 2
    weights = torch.exp(-0.5 * (offset / SSIM_SIGMA) ** 2)
    return (weights / weights.sum()).to(dtype=dtype, device=device)


def reconstruction(
    image: Tensor, target: Tensor, config: LossConfig, perceptual: Perceptual | None = None
) -> Tensor:
    """Compute L_rec of (3, H, W): weighted L1, 1 - SSIM and, with VGG16, perceptual distance."""
    if not image.numel():
        return image.sum()
    loss = L1 * (image - target).abs().mean()
    if config.ssim > 0:
        loss = loss + config.ssim * (1 - ssim(image, target))
    if perceptual is not None:
        loss = loss + PERCEPTUAL * perceptual(image, target)
    return loss


def depth_dm2(depth: Tensor, alpha: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Compute the mean squared depth error, dm^2, over pixels where both depths are known.

    Depths (H, W) are camera z, metres. Rendered ones count where ``alpha`` is over 0.5, targets
    where ``valid``; `DEPTH_ERODE_PX` pixels next to the border of both are left out. In metres the
    term would vanish (5 mm -> 2.5e-5), in millimetres it would dominate (G11).
    """
    mask = valid & (alpha.detach() > 0.5)
    outside = nn.functional.pad((~mask)[None, None].float(), [DEPTH_ERODE_PX] * 4)
    mask = mask & (nn.functional.max_pool2d(outside, 2 * DEPTH_ERODE_PX + 1, 1)[0, 0] == 0)
    # No branch, which would wait for the GPU: an empty mask gives 0 over 1.
    squares = (10.0 * torch.where(mask, depth - target, 0.0)).square()
    return squares.sum() / mask.sum().clamp_min(1)


def scale_mm(scales_mm: Tensor) -> Tensor:
    """Keep scales (N, 3), millimetres, within 0.1 to 10: 1 / s below, (s - 10)^2 above.

    Millimetres as in RGCA, whose constants these are: in metres 1 / s of a 1 mm Gaussian is 1000
    (G2). The reciprocal stops at 1e-7, as the paper has it.
    """
    low, high = SCALE_RANGE_MM
    small = scales_mm < low
    below = 1.0 / torch.where(small, scales_mm.clamp_min(1e-7), torch.ones_like(scales_mm))
    above = (scales_mm - high).clamp_min(0).square()
    return torch.where(small, below, above).sum() / max(1, scales_mm.numel())


def mesh_edges(faces: Tensor) -> Tensor:
    """List the directed edges (E, 2) of faces (F, 3), each once, in both directions."""
    pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return torch.unique(torch.cat([pairs, pairs.flip(1)]), dim=0)


def laplacian_mm2(vertices: Tensor, edges: Tensor) -> Tensor:
    """Average the squared uniform Laplacian of a mesh's vertices (V, 3), metres in, mm^2 out.

    The head's own curvature costs about 2 mm^2 (G12). A vertex without edges costs nothing.
    """
    field = 1e3 * vertices
    source, target = edges.unbind(1)
    # Not bincount, which waits for a GPU to report the largest index.
    ones = field.new_ones(len(source), 1)
    degree = field.new_zeros(len(field), 1).index_add(0, source, ones)
    around = torch.zeros_like(field).index_add(0, source, field[target]) / degree.clamp_min(1)
    return torch.where(degree > 0, around - field, 0.0).square().sum() / max(1, len(field))


def displacement_mm2(displacement: Tensor) -> Tensor:
    """Average the squared length of vertex displacements (V, 3), metres in, mm^2 out (G12)."""
    return (1e3 * displacement).square().sum() / max(1, len(displacement))


def codes(z_id: Tensor, z_exp: Tensor) -> Tensor:
    """Add up the squares of both codes (DeepSDF's form; G13)."""
    return z_id.square().sum() + z_exp.square().sum()


class VGGDistance(nn.Module):
    """Squared distance of channel-normalised VGG16 features, averaged over four layers.

    The paper names the backbone only; layers and normalisation are those of LPIPS (Zhang et al.
    2018) without its learned channel weights. Weights never train.
    """

    def __init__(self, features: nn.Sequential) -> None:
        """Compare the outputs of these layers, `vgg_features` with weights."""
        super().__init__()
        self.features = features
        self.requires_grad_(False)
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None])
        self.register_buffer("std", torch.tensor(STD)[:, None, None])

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """Compute the distance of two (3, H, W) images in [0, 1], at least 16 px per side."""
        x = (torch.stack([image, target]) - self.mean) / self.std
        total = x.new_zeros(())
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in COMPARED:
                unit = nn.functional.normalize(x, dim=1, eps=1e-6)
                total = total + (unit[0] - unit[1]).square().sum(0).mean() / len(COMPARED)
        return total


def vgg_features() -> nn.Sequential:
    """Return the convolutions of VGG16 in torchvision's numbering, untrained."""
    layers: list[nn.Module] = []
    channels = 3
    for entry in LAYERS:
        if isinstance(entry, int):
            layers += [nn.Conv2d(channels, entry, 3, padding=1), nn.ReLU()]
            channels = entry
        else:
            layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers)


def load_vgg(path: str, device: torch.device | str = "cpu") -> VGGDistance | None:
    """Read the state dict of loss.vgg16 as `load_features` does; None if it is empty."""
    if not path:
        return None
    features = load_features(Path(path), "loss.vgg16", "vgg16", vgg_features())
    return VGGDistance(features).to(device)


def load_features(path: Path, setting: str, network: str, layers: nn.Sequential) -> nn.Sequential:
    """Fill layers with the ``features.*`` of torchvision's state dict of a network.

    Nothing in the file is executed.

    Raises:
        ConfigError: no such file, or not that state dict; names the setting.
    """
    where = f"{setting} {path}"
    remedy = "leave it empty to do without"
    weights = read_weights(path, ConfigError, where, "a torch state dict", remedy)
    given = weights if isinstance(weights, dict) else {}
    wanted = layers.state_dict()
    for name, tensor in wanted.items():
        if getattr(given.get(f"features.{name}"), "shape", None) != tensor.shape:
            raise ConfigError(
                f"{where}: features.{name} is missing or of another shape; expected the state "
                f"dict of torchvision's {network}; {remedy}"
            )
    layers.load_state_dict({name: given[f"features.{name}"] for name in wanted})
    return layers
