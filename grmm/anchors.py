"""Anchor the Gaussians: rasterise the head's UV map once into face and barycentrics per texel.

Texels that no triangle covers have no surface, so they get no Gaussian; the paper counts all N_g^2
of them (G19).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from express50.errors import HeadModelError
from express50.geometry.conventions import cell_to_corner, corner_to_cell
from express50.head.model import HeadModel

NEEDLE_AREA = 1e-14  # of a UV or 3D triangle; smaller ones have no reliable directions


@dataclass(frozen=True, kw_only=True, eq=False)
class Anchors:
    """N covered texels of an n_g x n_g map, in row-major order; row 0 is the top (v = 1)."""

    texels: Tensor  # (N,) flat index row * n_g + column
    faces: Tensor  # (N,) face under the texel's centre
    barycentrics: Tensor  # (N, 3) of the centre, non-negative, rows sum to 1


def make_anchors(head: HeadModel, n_g: int, mouth: bool = True) -> Anchors:
    """Rasterise the UV map of a head at the centres of n_g x n_g texels.

    Without ``mouth``, faces of teeth, tongue and the inside of the mouth get no Gaussians.

    Raises:
        HeadModelError: no triangle covers any texel's centre.
    """
    corners = head.uv.double()[head.uv_faces].cpu()  # (F, 3, 2)
    grid = torch.stack([corners[..., 0] * n_g, (1 - corners[..., 1]) * n_g], -1)
    # Candidates are the texels whose centres lie in a triangle's bounding box.
    low = torch.ceil(corner_to_cell(grid.amin(1))).clamp(0, n_g).long()  # (F, 2) as (column, row)
    high = torch.floor(corner_to_cell(grid.amax(1))).clamp(-1, n_g - 1).long()
    size = (high - low + 1).clamp_min(0)
    count = size[:, 0] * size[:, 1]
    face = torch.repeat_interleave(torch.arange(len(grid)), count)
    offset = torch.arange(len(face)) - (count.cumsum(0) - count)[face]
    width = size[face, 0]
    column, row = low[face, 0] + offset % width, low[face, 1] + offset // width
    centre = cell_to_corner(torch.stack([column, row], -1).double())
    a, b, c = grid[face].unbind(1)
    ab, ac, ap = b - a, c - a, centre - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    v = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
    w = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
    weights = torch.stack([1 - v - w, v, w], 1)
    inside = (area.abs() >= NEEDLE_AREA) & (weights >= 0).all(1)
    if not mouth:
        solid = (head.regions["teeth"] | head.regions["tongue"])[head.faces].any(1)
        hollow = head.regions["mouth_interior"][head.faces].all(1)
        inside &= ~(solid | hollow).cpu()[face]
    # Candidates come in ascending order of faces: where charts overlap, the lowest index wins.
    texels, first = np.unique((row * n_g + column)[inside].numpy(), return_index=True)
    if not len(texels):
        raise HeadModelError(
            f"head model {head.name!r}: no triangle of its UV map covers a texel's centre at "
            f"n_g = {n_g}; expected UV coordinates in [0, 1]. Raise model.n_g or check the UV map"
        )
    return Anchors(
        texels=torch.from_numpy(texels),
        faces=face[inside][first],
        barycentrics=weights[inside][first].float(),
    )


def uv_gradients(head: HeadModel) -> Tensor:
    """Compute G (F, 2, 2): [dP/du dP/dv] = [P1 - P0, P2 - P0] @ G; zero without UV area."""
    corners = head.uv.double()[head.uv_faces]
    edges = torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)
    determinant = torch.linalg.det(edges)
    flat = determinant.abs() < NEEDLE_AREA
    eye = torch.eye(2, dtype=edges.dtype, device=edges.device)
    inverse = torch.linalg.inv(torch.where(flat[:, None, None], eye, edges))
    return torch.where(flat[:, None, None], 0.0, inverse).to(head.dtype)


def tangent_frames(vertices: Tensor, faces: Tensor, gradients: Tensor) -> tuple[Tensor, Tensor]:
    """Compute right-handed frames of triangles (F, 3), and metres per unit of UV along them.

    `gradients` (F, 2, 2) are those of `uv_gradients`.

    Returns:
        (F, 3, 3) rotations, columns = tangent (along dP/du), bitangent, normal; (F, 2) metres per
        unit of UV along tangent and bitangent. A triangle without area gets the identity and 0.

    Source: the tangent basis of TexAvatars and GaussianAvatars; the bitangent's reach is the area a
    unit of UV area covers over the tangent's, so that sheared charts keep their area.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    edges = torch.stack([b - a, c - a], -1)  # (F, 3, 2)
    along = edges @ gradients
    tangent, cross = along[..., 0], torch.linalg.cross(edges[..., 0], edges[..., 1])
    reach_u = tangent.norm(dim=1)
    area = torch.linalg.cross(along[..., 0], along[..., 1]).norm(dim=1)
    good = (reach_u > 1e-9) & (cross.norm(dim=1) > NEEDLE_AREA)
    normal = torch.nn.functional.normalize(cross, dim=1, eps=1e-30)
    tangent = torch.nn.functional.normalize(tangent, dim=1, eps=1e-30)
    frame = torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], -1)
    eye = torch.eye(3, dtype=vertices.dtype, device=vertices.device)
    frame = torch.where(good[:, None, None], frame, eye)
    reach = torch.stack([reach_u, area / reach_u.clamp_min(1e-9)], 1)
    return frame, torch.where(good[:, None], reach, 0.0)


def interpolate(values: Tensor, corners: Tensor, weights: Tensor) -> Tensor:
    """Interpolate vertex values (V, C) in triangles (N, 3) by barycentrics (N, 3) to (N, C)."""
    return (values[corners] * weights[..., None]).sum(1)
