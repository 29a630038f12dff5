"""The rasteriser as plain torch with autograd: slow, any device, any float type; the oracle.

Tile by tile it forms every (Gaussian, pixel) pair. Use it to check the other backends and, where
no compiler was to be had, to render small scenes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from express50.geometry.conventions import cell_to_corner
from grmm.rasterize.interface import Pinhole, RenderOptions, RenderOutput, Splats
from grmm.rasterize.projection import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    Projection,
    depth_of_rays,
    expected_depth,
    project,
)

TILE = 32  # pixels; only speed and memory depend on it


def rasterize_reference(
    scene: Splats, camera: Pinhole, background: Tensor | None, options: RenderOptions
) -> RenderOutput:
    """Render; see ``grmm.rasterize``."""
    width, height, K, colors = camera.width, camera.height, camera.K, scene.colors
    splats = project(scene, camera, options.near, options.eps2d, options.antialiased)
    visible = splats.visible.nonzero()[:, 0]
    order = visible[torch.sort(splats.depths[visible].detach(), stable=True).indices]
    channels = torch.cat([colors, splats.normals], 1) if options.normals else colors
    rows = []
    for top in range(0, height, TILE):
        h = min(TILE, height - top)
        tiles = [
            _blend(splats, channels, order, left, top, min(TILE, width - left), h)
            for left in range(0, width, TILE)
        ]
        rows.append([torch.cat(parts, 1) for parts in zip(*tiles, strict=True)])
    image, weighted, alpha, median = (torch.cat(parts, 0) for parts in zip(*rows, strict=True))
    image, normals = image.split([colors.shape[1], image.shape[2] - colors.shape[1]], 2)
    if background is not None:
        image = image + (1.0 - alpha)[..., None] * background
    return RenderOutput(
        colors=image,
        depth=expected_depth(weighted, alpha, K),
        alpha=alpha,
        median_depth=depth_of_rays(median, K) if options.median_depth else None,
        normals=normals if options.normals else None,
    )


def _blend(
    splats: Projection, colors: Tensor, order: Tensor, left: int, top: int, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blend one tile front to back.

    Returns colours (h, w, C), and (h, w) each: ray length * weight, alpha, median ray length.

    Guards as gsplat: alpha capped at 0.99, contributions under 1/255 skipped, and a pixel stops
    before the Gaussian that would bring its transmittance to 1e-4 or less.
    """
    # Only Gaussians that can reach a pixel centre of the tile.
    low = splats.means2d[order].detach() - splats.extents[order]
    high = splats.means2d[order].detach() + splats.extents[order]
    corner, size = low.new_tensor([left, top]), low.new_tensor([width, height])
    ids = order[((high >= corner) & (low <= corner + size)).all(1)]
    dtype, device = colors.dtype, colors.device
    u = cell_to_corner(torch.arange(left, left + width, dtype=dtype, device=device))
    v = cell_to_corner(torch.arange(top, top + height, dtype=dtype, device=device))
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
    kept = after > TRANSMITTANCE_MIN
    weights = alpha * before * kept
    length, slope_u, slope_v = splats.planes[ids][:, :, None].unbind(1)
    lengths = length + slope_u * dx + slope_v * dy
    weighted = (weights * lengths).sum(0)
    # At most one Gaussian per pixel takes the transmittance through one half.
    crosses = kept & (before > 0.5) & (after <= 0.5)
    median = torch.where(crosses, lengths, torch.zeros_like(lengths)).sum(0)
    image = weights.T @ colors[ids]
    return (
        image.reshape(height, width, -1),
        weighted.reshape(height, width),
        weights.sum(0).reshape(height, width),
        median.reshape(height, width),
    )
