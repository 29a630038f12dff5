"""Make the scene of ``benchmarks.raster``, and its rival: autograd over explicit pairs."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from express50.geometry.conventions import cell_to_corner, corner_to_cell
from grmm.rasterize.projection import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    Pinhole,
    Projection,
    Splats,
    project,
)


def head(n: int, size: int, channels: int) -> dict[str, Tensor]:
    """Return N flat splats on an ellipsoid as large as a head, 1 m in front of the camera, float64.

    They lie row by row on an equal-area map, as GRMM's lie on its UV map, and cover a third of the
    picture with 14 to 16 blended splats per pixel on average.
    """
    side = math.isqrt(n)
    if side * side != n:
        raise ValueError(f"n is {n}, expected a square: one Gaussian a texel")
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    row, column = torch.arange(n) // side, torch.arange(n) % side
    height = 1 - 2 * (row + uniform(n)) / side
    angle = 2 * math.pi * (column + uniform(n)) / side
    ring = (1 - height.square()).sqrt()
    normal = torch.stack([ring * angle.sin(), height, ring * angle.cos()], 1)
    spacing = math.sqrt(4 * math.pi * 0.1**2 / n)
    jitter = torch.exp(0.3 * torch.randn(n, 3, generator=generator, dtype=torch.float64))
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(n, 3)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 1.0
    f = size * 0.79 / 0.24
    return {
        "means": normal * torch.tensor([0.08, 0.12, 0.1], dtype=torch.float64),
        "quats": torch.cat([1 + normal[:, 2:], torch.linalg.cross(z, normal)], 1),
        "scales": 0.7 * spacing * jitter * torch.tensor([1, 1, 0.3], dtype=torch.float64),
        "opacities": 0.35 + 0.6 * uniform(n),
        "colors": uniform(n, channels),
        "K": torch.tensor([[f, 0, size / 2], [0, f, size / 2], [0, 0, 1]], dtype=torch.float64),
        "cam_from_world": pose,
    }


def records(scene: dict[str, Tensor], size: int) -> tuple[Splats, Pinhole]:
    """Return the scene as the rasteriser's records."""
    camera = {name: scene[name] for name in ("K", "cam_from_world")}
    splats = {name: tensor for name, tensor in scene.items() if name not in camera}
    return Splats(**splats), Pinhole(**camera, width=size, height=size)


@torch.no_grad()
def blended_pairs(scene: dict[str, Tensor], size: int) -> tuple[Tensor, Tensor]:
    """Return Gaussian and pixel numbers (M,) of every blend, by pixel, nearest first."""
    splats = project(*records(scene, size))
    visible = splats.visible.nonzero()[:, 0]
    order = visible[torch.sort(splats.depths[visible], stable=True).indices]
    mean, extent = splats.means2d[order].double(), splats.extents[order]
    low = corner_to_cell(mean - extent).ceil().clamp(min=0).long()
    high = corner_to_cell(mean + extent).floor().clamp(max=size - 1).long() + 1
    wide, tall = (high - low).clamp(min=0).unbind(1)
    ids = torch.repeat_interleave(torch.arange(len(order)), wide * tall)
    place = torch.arange(len(ids)) - (torch.cumsum(wide * tall, 0) - wide * tall)[ids]
    pixels = (low[ids, 1] + place // wide[ids]) * size + low[ids, 0] + place % wide[ids]
    gaussians = order[ids]
    shown = pair_alphas(splats, gaussians, pixels, size) >= ALPHA_MIN
    gaussians, pixels = gaussians[shown], pixels[shown]
    pixels, by_pixel = torch.sort(pixels, stable=True)
    gaussians = gaussians[by_pixel]
    alphas = pair_alphas(splats, gaussians, pixels, size)
    kept = (1 - alphas) * before(alphas, pixels) > TRANSMITTANCE_MIN
    return gaussians[kept], pixels[kept]


def pair_alphas(splats: Projection, gaussians: Tensor, pixels: Tensor, size: int) -> Tensor:
    """Return the opacity (M,) of each Gaussian at its pixel."""
    center = cell_to_corner(
        torch.stack([pixels % size, pixels // size], 1).to(splats.means2d.dtype)
    )
    dx, dy = (center - splats.means2d[gaussians]).unbind(1)
    xx, xy, yy = splats.conics[gaussians].unbind(1)
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    return (splats.opacities[gaussians] * torch.exp(-sigma)).clamp(max=ALPHA_MAX)


def before(alphas: Tensor, pixels: Tensor) -> Tensor:
    """Return transmittance (M,) in front of each pair, its pixel's earlier pairs multiplied up."""
    # One running sum of logarithms over all pixels; float64 keeps its end as exact as its start.
    logs = torch.log1p(-alphas.double())
    running = torch.cumsum(logs, 0) - logs
    starts = torch.searchsorted(pixels, pixels)
    return torch.exp(running - running[starts]).to(alphas.dtype)


def render_pairs(
    scene: dict[str, Tensor], pairs: tuple[Tensor, Tensor], size: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return colours (P, C), sums of weight * ray length (P,) and alpha (P,), by autograd."""
    gaussians, pixels = pairs
    splats = project(*records(scene, size))
    alphas = pair_alphas(splats, gaussians, pixels, size)
    weights = alphas * before(alphas, pixels)
    center = cell_to_corner(torch.stack([pixels % size, pixels // size], 1).to(weights.dtype))
    delta = center - splats.means2d[gaussians]
    length = splats.planes[gaussians, 0] + (splats.planes[gaussians, 1:] * delta).sum(1)
    colors = scene["colors"]
    image = colors.new_zeros(size * size, colors.shape[1])
    image = image.index_add(0, pixels, weights[:, None] * colors[gaussians])
    flat = weights.new_zeros(size * size)
    return image, flat.index_add(0, pixels, weights * length), flat.index_add(0, pixels, weights)
