"""Image metrics as the evaluation reports them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from grmm.losses import ssim_map

PSNR_LIMIT_DB = 100.0  # equal images: a number that averages, where infinity would not

UNAVAILABLE = {
    "lpips": "n/a: needs the weights of its network, which are not distributed with this project",
    "fid": "n/a: needs the weights of its network and thousands of images",
}


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


def ssim_score(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Mean SSIM of (3, H, W) images; with a mask over windows centred on its pixels."""
    values = ssim_map(image.clamp(0, 1), target)
    if mask is None:
        return float(values.mean())
    rows, columns = ((a - b) // 2 for a, b in zip(mask.shape, values.shape[1:], strict=True))
    inner = mask[rows : rows + values.shape[1], columns : columns + values.shape[2]]
    return float(values[:, inner].mean()) if bool(inner.any()) else math.nan
