"""Differentiable rendering of meshes in torch, on top of the visibility of mesh_raster.py.

Visibility has no gradient and may be cached for a few steps. Inside a face, barycentric weights are
computed anew from the vertices, which is exact; across an outline, `antialias` blends the two
pixels by the place where the edge crosses between them, which is where outlines get their
gradient. All functions take any float dtype and device; first derivatives only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from express50.geometry.conventions import cell_to_corner
from express50.geometry.mesh_raster import Raster
from express50.geometry.mesh_rows import weigh_rows


@dataclass(frozen=True, eq=False)
class Covered:
    """The covered pixels of a raster, sorted by face so that sums over a face are over a run.

    Attributes:
        height, width: size of the image.
        pixels: (N,) int64, flat indices.
        centres: (N, 2) float32, their centres (x, y).
        seen: (G,) int64, the faces that are seen, ascending.
        counts: (G,) int64, pixels of each.
        group: (N,) int64, which of `seen` a pixel shows.
        pairs: (P, 4) int64, as in Raster; empty where that has none.
    """

    height: int
    width: int
    pixels: Tensor
    centres: Tensor
    seen: Tensor
    counts: Tensor
    group: Tensor
    pairs: Tensor


def covered(raster: Raster, device: torch.device | str = "cpu") -> Covered:
    """The covered pixels of a raster, on a device; keep it for as long as the raster is kept."""
    flat = raster.face_id.reshape(-1)
    pixels = np.flatnonzero(flat >= 0)
    faces = flat[pixels]
    # NumPy sorts 16-bit keys by radix, several times faster than wider ones.
    key = faces.astype(np.uint16) if faces.max(initial=0) < 2**16 else faces
    pixels = pixels[np.argsort(key, kind="stable")]
    counts = np.bincount(faces)
    seen = np.flatnonzero(counts)
    counts = counts[seen]
    group = np.repeat(np.arange(len(seen)), counts)
    pairs = np.zeros((0, 4)) if raster.pairs is None else raster.pairs
    height, width = raster.face_id.shape
    centres = cell_to_corner(np.stack([pixels % width, pixels // width], axis=1))
    centres = centres.astype(np.float32)

    def moved(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array.astype(np.int64)).to(device)

    return Covered(
        height,
        width,
        moved(pixels),
        torch.from_numpy(centres).to(device),
        *(moved(array) for array in (seen, counts, group, pairs)),
    )


def barycentrics(
    seen: Covered, vertices: Tensor, faces: Tensor, K: Tensor, cam_from_world: Tensor
) -> Tensor:
    """Perspective-correct barycentric weights (N, 3) of the covered pixels; rows sum to 1.

    The weight of a corner is the ray times the plane through the camera and the opposite edge,
    normalised. Where the vertices have moved since the raster was made, weights may leave [0, 1].

    Args:
        seen: what the camera sees.
        vertices: (V, 3) world, metres.
        faces: (F, 3) int64.
        K: (3, 3) pixels.
        cam_from_world: (4, 4).
    """
    corners = (vertices @ cam_from_world[:3, :3].T + cam_from_world[:3, 3])[faces[seen.seen]]
    a, b, c = corners.unbind(1)
    planes = torch.stack(
        [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1
    )
    weights = weigh_rows(planes, pixel_rays(seen, K), seen.group, seen.counts)
    total, size = weights.sum(1, keepdim=True), weights.detach().abs().sum(1, keepdim=True)
    # A face seen exactly edge on has no weights; its middle stands in, without a gradient.
    edge_on = total.detach().abs() <= 16 * torch.finfo(total.dtype).eps * size
    total = torch.where(edge_on, torch.ones_like(total), total)
    return torch.where(edge_on, torch.full_like(weights, 1 / 3), weights / total)


def pixel_rays(seen: Covered, K: Tensor) -> Tensor:
    """Rays (N, 3) in camera space through the centres of the covered pixels, z = 1."""
    x, y = seen.centres.to(K.dtype).unbind(1)
    return torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], 1)


def interpolate(seen: Covered, weights: Tensor, attributes: Tensor, index: Tensor) -> Tensor:
    """Attributes (A, C) of corners ``index`` (F, 3) at the covered pixels (N, C).

    `index` is `faces` for what vertices carry and `uv_faces` for texture coordinates.
    """
    rows = attributes[index[seen.seen]]
    return weigh_rows(rows, weights, seen.group, seen.counts)


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Bilinear samples (N, C) of a texture (H, W, C) at uv (N, 2), v up; the rim is extended.

    (0, 0) is the lower left corner of the picture and (1, 1) the upper right one: texel centres
    lie half a texel inside, as pixel centres do.
    """
    place = torch.stack([2 * uv[:, 0] - 1, 1 - 2 * uv[:, 1]], dim=1)
    sampled = torch.nn.functional.grid_sample(
        texture.permute(2, 0, 1)[None],
        place[None, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return sampled[0, :, 0].T


def compose(seen: Covered, values: Tensor, background: Tensor) -> Tensor:
    """Picture (H, W, C) of values (N, C) at the covered pixels before a background (H, W, C)."""
    shape = (seen.height, seen.width, values.shape[1])
    flat = background.to(values.dtype).expand(shape).reshape(-1, shape[2])
    return flat.index_copy(0, seen.pixels, values).reshape(shape)


def antialias(
    image: Tensor, seen: Covered, vertices: Tensor, K: Tensor, cam_from_world: Tensor
) -> Tensor:
    """Blend the pixels beside each outline by where it crosses between their centres.

    An edge that crosses past the middle of the way lends its own side's colour to the far pixel,
    one that crosses before it lets the far side's colour into its own pixel. Sums over the picture
    then change with the vertices as the covered area does.

    Args:
        image: (H, W, C).
        seen: what the camera sees, with pairs.
        vertices: (V, 3) world, metres.
        K: (3, 3) pixels.
        cam_from_world: (4, 4).

    Returns:
        (H, W, C), differentiable by the image and the vertices.
    """
    near, far = seen.pairs[:, 0], seen.pairs[:, 1]
    crossing = crossings(seen, vertices, K, cam_from_world)[:, None]
    flat = image.reshape(-1, image.shape[2])
    step = flat[near] - flat[far]
    gain = (crossing - 0.5).clamp(0, 0.5) * step
    loss = (crossing - 0.5).clamp(-0.5, 0) * step
    blended = flat.index_add(0, torch.cat([far, near]), torch.cat([gain, loss]))
    return blended.reshape(image.shape)


def crossings(seen: Covered, vertices: Tensor, K: Tensor, cam_from_world: Tensor) -> Tensor:
    """Where each pair's edge crosses (P,), from 0 at the near pixel's centre to 1 at the far one's.

    Not clamped: after the vertices have moved it may lie outside.
    """
    ends = vertices[seen.pairs[:, 2:]] @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    focal = torch.stack([K[0, 0], K[1, 1]])
    p, q = (ends[..., :2] / ends[..., 2:] * focal + K[:2, 2]).unbind(1)
    place = torch.stack([seen.pairs[:, :2] % seen.width, seen.pairs[:, :2] // seen.width], dim=-1)
    a, b = cell_to_corner(place.to(p.dtype)).unbind(1)
    horizontal = a[:, 1] == b[:, 1]
    p, q, a, b = (torch.where(horizontal[:, None], x, x.flip(1)) for x in (p, q, a, b))
    # now the step is along the first coordinate and the edge is steep along the second
    rise = q[:, 1] - p[:, 1]
    rise = torch.where(rise == 0, torch.ones_like(rise), rise)
    along = p[:, 0] + (a[:, 1] - p[:, 1]) * (q[:, 0] - p[:, 0]) / rise
    return (along - a[:, 0]) * (b[:, 0] - a[:, 0])


# Real spherical harmonics of order 2 times what a Lambertian surface makes of each band.
_Y0 = 0.5 / math.sqrt(math.pi)
_Y1 = math.sqrt(3 / (4 * math.pi)) * 2 / 3
_Y2 = math.sqrt(15 / (4 * math.pi)) / 4
_Y20 = math.sqrt(5 / (16 * math.pi)) / 4


def sh_light(normals: Tensor, coefficients: Tensor) -> Tensor:
    """Light (N, C) that a matt surface reflects, by unit normals (N, 3) and light (9, C).

    The coefficients are those of the incoming radiance in real spherical harmonics, ordered (0,0),
    (1,-1), (1,0), (1,1), (2,-2) ... (2,2), with y, z, x in the first band. The result is irradiance
    / pi, to be multiplied by albedo: bands are scaled by 1, 2/3 and 1/4 (Ramamoorthi and Hanrahan
    2001, "An efficient representation for irradiance environment maps"). Light of radiance 1 from
    everywhere is coefficient sqrt(4 pi) in the first place and gives 1.
    """
    x, y, z = normals.unbind(1)
    basis = [
        _Y0 * torch.ones_like(x),
        _Y1 * y,
        _Y1 * z,
        _Y1 * x,
        _Y2 * x * y,
        _Y2 * y * z,
        _Y20 * (3 * z * z - 1),
        _Y2 * x * z,
        0.5 * _Y2 * (x * x - y * y),
    ]
    return torch.stack(basis, dim=1) @ coefficients
