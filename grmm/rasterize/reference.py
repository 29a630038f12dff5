"""The rasteriser as plain torch with autograd: slow, any device, any float type; the oracle.

Tile by tile it forms every (Gaussian, pixel) pair. Use it to check the other backends and, where
no compiler was to be had, to render small scenes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from grmm.rasterize.projection import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    Projection,
    expected_depth,
    project,
)

TILE = 32  # pixels; only speed and memory depend on it


def rasterize_reference(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    width: int,
    height: int,
    background: Tensor | None,
    near: float,
    eps2d: float,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours (H, W, C), depth (H, W) and alpha (H, W); arguments as ``grmm.rasterize``."""
    splats = project(
        means, quats, scales, opacities, K, cam_from_world, width, height, near, eps2d, antialiased
    )
    visible = splats.visible.nonzero()[:, 0]
    order = visible[torch.sort(splats.depths[visible].detach(), stable=True).indices]
    rows = []
    for top in range(0, height, TILE):
        h = min(TILE, height - top)
        tiles = [
            _blend(splats, colors, order, left, top, min(TILE, width - left), h)
            for left in range(0, width, TILE)
        ]
        rows.append([torch.cat(parts, 1) for parts in zip(*tiles, strict=True)])
    image, weighted, alpha = (torch.cat(parts, 0) for parts in zip(*rows, strict=True))
    if background is not None:
        image = image + (1.0 - alpha)[..., None] * background
    return image, expected_depth(weighted, alpha, K), alpha


def _blend(
    splats: Projection, colors: Tensor, order: Tensor, left: int, top: int, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Front-to-back blending of one tile: colours (h, w, C), ray length * weight and alpha (h, w).

    Guards as gsplat: alpha capped at 0.99, contributions under 1/255 skipped, and a pixel stops
    before the Gaussian that would bring its transmittance to 1e-4 or less.
    """
    ids = order[_touches(splats, order, left, top, width, height)]
    dtype, device = colors.dtype, colors.device
    u = torch.arange(left, left + width, dtype=dtype, device=device) + 0.5
    v = torch.arange(top, top + height, dtype=dtype, device=device) + 0.5
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)
    delta = pixels[None] - splats.means2d[ids][:, None]  # (n, P, 2)
    dx, dy = delta.unbind(-1)
    xx, xy, yy = splats.conics[ids][:, :, None].unbind(1)
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = splats.opacities[ids][:, None] * torch.exp(-sigma.clamp(min=0.0))
    alpha = alpha.clamp(max=ALPHA_MAX)
    alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1.0 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weights = alpha * before * (after > TRANSMITTANCE_MIN)
    length, slope_u, slope_v = splats.planes[ids][:, :, None].unbind(1)
    weighted = (weights * (length + slope_u * dx + slope_v * dy)).sum(0)
    image = weights.T @ colors[ids]
    return (
        image.reshape(height, width, -1),
        weighted.reshape(height, width),
        weights.sum(0).reshape(height, width),
    )


def _touches(
    splats: Projection, ids: Tensor, left: int, top: int, width: int, height: int
) -> Tensor:
    """Which of the Gaussians ``ids`` can reach a pixel centre of the tile (bool)."""
    low = splats.means2d[ids].detach() - splats.extents[ids]
    high = splats.means2d[ids].detach() + splats.extents[ids]
    corner = low.new_tensor([left, top])
    size = low.new_tensor([width, height])
    return ((high >= corner) & (low <= corner + size)).all(1)
