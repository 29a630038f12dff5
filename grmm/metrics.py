"""Image metrics as the evaluation reports them; all but PSNR are torchmetrics'."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.functional.regression import mean_squared_error

PSNR_LIMIT_DB = 100.0  # equal images: a number that averages, where infinity would not
SSIM_SIGMA, SSIM_WINDOW = 1.5, 11  # Wang et al. 2004


def psnr_db(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio of (3, H, W) images in [0, 1], decibels, at most 100.

    ``mask`` (H, W) bool limits it to some pixels; NaN if it selects none.
    """
    squared = (image.clamp(0, 1).double() - target.double()).square()
    if mask is not None:
        squared = squared[:, mask]
        if squared.numel() == 0:
            return math.nan
    return float((-10 * torch.log10(squared.mean())).clamp(max=PSNR_LIMIT_DB))


def rmse(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Root mean squared error of (3, H, W) images in [0, 1]; NaN if the mask selects nothing."""
    a, b = image.clamp(0, 1).double(), target.double()
    if mask is not None:
        a, b = a[:, mask], b[:, mask]
    if a.numel() == 0:
        return math.nan
    return float(mean_squared_error(a.reshape(-1), b.reshape(-1), squared=False))


def ssim_score(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Mean SSIM of (3, H, W) images; with a mask over windows centred on its pixels.

    Windows that reach over the border are left out. NaN where no window fits or is selected.
    """
    reach = SSIM_WINDOW // 2
    if min(image.shape[1:]) < SSIM_WINDOW:
        return math.nan
    _, values = structural_similarity_index_measure(
        image.clamp(0, 1).float()[None],
        target.float()[None],
        sigma=SSIM_SIGMA,
        kernel_size=SSIM_WINDOW,
        data_range=1.0,
        return_full_image=True,
    )
    inner = values[0, :, reach:-reach, reach:-reach]
    if mask is not None:
        inner = inner[:, mask[reach:-reach, reach:-reach]]
    return float(inner.mean()) if inner.numel() else math.nan
