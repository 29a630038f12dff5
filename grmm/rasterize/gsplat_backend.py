"""Rasterise on CUDA: our projection in torch, gsplat's kernels for sorting and blending.

Projecting here rather than in gsplat gives gradients to K and the pose, which gsplat's projection
lacks, and the three channels from which RaDe depth is built. gsplat is imported on first use only:
on a machine with nvcc but no GPU its import starts a long build.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from express50.geometry.conventions import cell_to_corner
from grmm.rasterize.projection import (
    Pinhole,
    Projection,
    RenderOptions,
    RenderOutput,
    Splats,
    depth_of_rays,
    expected_depth,
    pair_alphas,
    pair_offsets,
    project,
)
from grmm.recorded import Recorded

TILE = 16
CHUNK = 32  # channels of one pass; more would not fit the shared memory of the backward kernel
WIDTHS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32)  # channel counts that every gsplat release compiles


def rasterize_gsplat(
    scene: Splats, camera: Pinhole, background: Tensor | None, options: RenderOptions
) -> RenderOutput:
    """Render; see ``grmm.rasterize``. The tensors must be float32 on a CUDA device."""
    gsplat = _require_gsplat(scene.means)
    width, height, K = camera.width, camera.height, camera.K
    place = camera.K, camera.cam_from_world, camera.width, camera.height
    shapes = scene.means, scene.quats, scene.scales, scene.opacities
    splats = PROJECTIONS[options.antialiased](*shapes, *place)
    tiles = _tiles(gsplat, splats, width, height)
    channels = [plane_channels(splats, K), splats.normals[:, : 3 * options.normals], scene.colors]
    passes = []
    # Zeros pad the last chunk of channels to a width that gsplat has.
    chunks = list(torch.cat(channels, 1).split(CHUNK, dim=1))
    missing = min(w for w in WIDTHS if w >= chunks[-1].shape[1]) - chunks[-1].shape[1]
    chunks[-1] = torch.nn.functional.pad(chunks[-1], (0, missing))
    for values in chunks:
        image, alpha = gsplat.rasterize_to_pixels(
            splats.means2d[None], splats.conics[None].contiguous(), values[None].contiguous(),
            splats.opacities[None], width, height, TILE, *tiles,
        )  # fmt: skip
        passes.append(image[0])
    values, alpha = torch.cat(passes, -1), alpha[0, ..., 0]
    widths = [part.shape[1] for part in channels]
    planes, normals, image = values[..., : sum(widths)].split(widths, -1)
    if background is not None:
        image = image + (1.0 - alpha)[..., None] * background
    median = None
    if options.median_depth:
        median = depth_of_rays(_median_ray_length(gsplat, splats, tiles, width, height), K)
    return RenderOutput(
        colors=image,
        depth=expected_depth(combine_planes(planes, K), alpha, K),
        alpha=alpha,
        median_depth=median,
        normals=normals if options.normals else None,
    )


def _project(
    antialiased: bool,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    width: Any,
    height: Any,
) -> Projection:
    """Call `project` with its arguments one by one."""
    camera = Pinhole(K=K, cam_from_world=cam_from_world, width=width, height=height)
    colors = means[:, :0]  # which no projection reads
    scene = Splats(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors)
    return project(scene, camera, antialiased)


PROJECTIONS = {flag: Recorded(partial(_project, flag)) for flag in (False, True)}


def plane_channels(splats: Projection, K: Tensor) -> Tensor:
    """Return channels (N, 3) of the plane: ray length = a + b (u - cx) + c (v - cy).

    Blended like colours and combined by ``combine_planes`` they give the sum of weight * ray
    length; counting from the principal point keeps float32 exact enough.
    """
    length, slope_u, slope_v = splats.planes.unbind(1)
    offset = splats.means2d - K[:2, 2].to(splats.means2d.dtype)
    a = length - slope_u * offset[:, 0] - slope_v * offset[:, 1]
    return torch.stack([a, slope_u, slope_v], 1)


def combine_planes(blended: Tensor, K: Tensor) -> Tensor:
    """Return the sum of weight * ray length (H, W) from blended plane channels (H, W, 3)."""
    height, width = blended.shape[:2]
    center = K[:2, 2].to(blended.dtype)
    u = cell_to_corner(torch.arange(width, device=blended.device, dtype=blended.dtype)) - center[0]
    v = cell_to_corner(torch.arange(height, device=blended.device, dtype=blended.dtype)) - center[1]
    a, b, c = blended.unbind(-1)
    return a + b * u[None, :] + c * v[:, None]


def _require_gsplat(means: Tensor) -> Any:
    """Return the gsplat module; errors with the remedy where it cannot work on ``means``."""
    if not torch.cuda.is_available():
        raise RuntimeError("backend 'gsplat' needs a CUDA device; use backend='cpu' here")
    try:
        import gsplat
    except ImportError as error:
        raise RuntimeError("backend 'gsplat' needs gsplat >= 1.5: pip install gsplat") from error
    if means.device.type != "cuda" or means.dtype != torch.float32:
        raise ValueError(
            f"backend 'gsplat' got {means.dtype} on {means.device}, expected float32 on cuda"
        )
    return gsplat


@torch.no_grad()
def _tiles(gsplat: Any, splats: Projection, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return the tile offsets of gsplat (1, rows, columns) and sorted Gaussian indices."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    # One pixel more than the exact box; invisible Gaussians have radius 0 and are left out.
    radii = (splats.extents.clamp(max=1e9).ceil() + 1).int() * splats.visible[:, None]
    _, keys, ids = gsplat.isect_tiles(
        splats.means2d[None], radii[None].contiguous(), splats.depths[None], TILE, columns, rows
    )
    return gsplat.isect_offset_encode(keys, 1, columns, rows), ids


def _median_ray_length(
    gsplat: Any, splats: Projection, tiles: tuple[Tensor, Tensor], width: int, height: int
) -> Tensor:
    """Return each pixel's ray length (H, W) where the transmittance falls through one half.

    gsplat's kernels do not report it, but list all pairs of Gaussian and pixel in order.
    """
    offsets, ids = tiles
    ends = torch.cat([offsets.flatten()[1:], offsets.new_tensor([len(ids)])])
    batches = -(-int((ends - offsets.flatten()).max()) // TILE**2)
    through = splats.means2d.new_ones(1, height, width)
    with torch.no_grad():
        gaussians, pixels, _ = gsplat.rasterize_to_indices_in_range(
            0, batches, through, splats.means2d[None], splats.conics[None].contiguous(),
            splats.opacities[None], width, height, TILE, offsets, ids,
        )  # fmt: skip
        alphas = pair_alphas(splats, gaussians, pixels, width).double()
    # One running sum of logarithms over all pixels; float64 keeps its end as exact as its start.
    logs = torch.log1p(-alphas)
    after = torch.cumsum(logs, 0)
    first = torch.searchsorted(pixels, pixels)
    after = torch.exp(after - (after - logs)[first])
    before = after / (1.0 - alphas)
    # Rounding may show two Gaussians at the half; the first of them is the one.
    crosses = ((before > 0.5) & (after <= 0.5)).nonzero()[:, 0]
    crosses = crosses[torch.cat([crosses.new_ones(1), pixels[crosses].diff()])[: len(crosses)] > 0]
    gaussians, pixels = gaussians[crosses], pixels[crosses]
    length, slopes = splats.planes[gaussians, 0], splats.planes[gaussians, 1:]
    length = length + (slopes * pair_offsets(splats, gaussians, pixels, width)).sum(1)
    empty = length.new_zeros(height * width)
    return empty.index_put((pixels,), length).reshape(height, width)
