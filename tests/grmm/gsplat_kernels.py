"""The gsplat kernels that the CUDA backend calls, as dense torch: for machines without CUDA."""

from __future__ import annotations

import torch

from grmm.rasterize.gsplat_backend import WIDTHS
from grmm.rasterize.projection import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN


def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
    """Stand-in: one list for the whole image, nearest first."""
    shown = (radii[0] > 0).all(1).nonzero()[:, 0]
    order = shown[torch.sort(depths[0, shown], stable=True).indices]
    return None, (tile_height, tile_width), order.int()


def isect_offset_encode(keys, n, columns, rows):
    """Stand-in: that list is the first tile's."""
    offsets = torch.full((n, rows, columns), 1 << 20, dtype=torch.int32)
    offsets[0, 0, 0] = 0
    return offsets


def dense(means2d, conics, opacities, width, height, ids):
    """Weights (n, H * W) of the listed Gaussians by gsplat's rules."""
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx = u.reshape(1, -1) - means2d[0, ids, :1]
    dy = v.reshape(1, -1) - means2d[0, ids, 1:]
    a, b, c = conics[0, ids][..., None].unbind(1)
    alpha = opacities[0, ids, None] * torch.exp(-0.5 * (a * dx**2 + c * dy**2) - b * dx * dy)
    alpha = alpha.clamp(max=ALPHA_MAX) * (alpha >= ALPHA_MIN)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    return alpha * before * (after > TRANSMITTANCE_MIN)


def rasterize_to_pixels(means2d, conics, colors, opacities, width, height, tile, offsets, ids):
    """Stand-in: dense blending."""
    assert colors.shape[-1] in WIDTHS
    assert offsets.shape == (1, -(-height // tile), -(-width // tile))
    ids = ids.long()
    weights = dense(means2d, conics, opacities, width, height, ids)
    image = (weights.T @ colors[0, ids]).reshape(1, height, width, -1)
    return image, weights.sum(0).reshape(1, height, width, 1)


def rasterize_to_indices_in_range(
    first, last, through, means2d, conics, opacities, width, height, tile, offsets, ids
):
    """Stand-in: all pairs that were blended, by pixel and nearest first."""
    assert first == 0 and last * tile**2 >= len(ids) and through.shape == (1, height, width)
    weights = dense(means2d, conics, opacities, width, height, ids.long())
    pixels, places = (weights > 0).T.nonzero().unbind(1)
    return ids.long()[places], pixels, torch.zeros_like(pixels)
