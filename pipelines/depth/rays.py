"""Rays of pixels that meet the band, and the samples along them.

A mesh pushed outwards tells where a ray enters the band and where it leaves again without a hit;
the surface's own mesh tells where it is hit. The samples cover both stretches, so that an outline
that a ray misses by little hides what lies behind it by as much as it should.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
import torch

from express50.geometry.cameras import rays
from express50.geometry.raycast import camera_rays, mesh_scene
from pipelines.depth.grid import View

MARGIN = 2.0  # voxels from the surface to where samples begin
OPAQUE = 0.98  # alpha from which a pixel shows nothing of the background


@dataclass(frozen=True)
class Rays:
    """R rays of K samples, in voxels from the grid's origin.

    Attributes:
        camera: (R,) int64 index of the view.
        start: (R, 3) float32 where the ray enters; way: (R, 3) unit vector away from the camera.
        along: (R, K) float32 rising places of the samples, voxels along ``way`` from ``start``.
        normal: (R, 3) outward normal of the surface where it is hit, 0 where it is missed.
        rgb: (R, 3) in [0, 1], sRGB. alpha: (R,) in [0, 1].
        weight: (R,) of the colour: 0 where background may show, less at grazing angles.
    """

    camera: torch.Tensor
    start: torch.Tensor
    way: torch.Tensor
    along: torch.Tensor
    normal: torch.Tensor
    rgb: torch.Tensor
    alpha: torch.Tensor
    weight: torch.Tensor

    def points(self) -> torch.Tensor:
        """Places (R, K, 3) of the samples."""
        return self.start[:, None] + self.along[..., None] * self.way[:, None]

    def take(self, rows: torch.Tensor) -> Rays:
        """Some of the rays."""
        return Rays(**{name: value[rows] for name, value in vars(self).items()})


@dataclass(frozen=True)
class Sight:
    """Every ray that meets the band, in a fixed random order, ready to be sampled.

    Attributes:
        table: NumPy arrays of R rows: camera, way, normal, rgb, alpha, weight as in :class:`Rays`;
            start (R, 3) voxels, where the ray enters; and near, split, second, far (R,), the two
            stretches to sample, voxels along the ray from there.
        samples: K of a ray.
    """

    table: dict[str, np.ndarray]
    samples: int

    @property
    def count(self) -> int:
        """Rays R."""
        return len(self.table["camera"])

    def batch(self, rows: slice, device: torch.device) -> Rays:
        """These of the rays, their samples placed."""
        table = {key: value[rows] for key, value in self.table.items()}
        near, split, second, far = (table.pop(k) for k in ("near", "split", "second", "far"))
        table["along"] = _places(near, split, second, far, self.samples)
        return Rays(**{key: torch.from_numpy(value).to(device) for key, value in table.items()})


def make_sight(
    views: Sequence[View],
    origin: np.ndarray,
    voxel: float,
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray],
    samples: int,
    budget: int,
) -> Sight:
    """Rays of pixels that see the band: all, or about ``budget`` of them at random.

    Args:
        views: C views.
        origin: (3,) world, metres, where voxels are counted from.
        voxel: metres.
        mesh: vertices (V, 3), outward normals (V, 3) and faces (F, 3) of the surface, metres.
        samples: K of a ray.
        budget: rays wanted.
    """
    vertices, normals, faces = mesh
    scene = mesh_scene(vertices, faces)
    shell = mesh_scene(vertices + MARGIN * voxel * normals, faces)
    random = np.random.default_rng(0)
    found = [np.isfinite(_struck(shell, view)) for view in views]
    share = budget / max(1, sum(int(mask.sum()) for mask in found))
    chosen = [mask & (random.random(mask.shape) < share) for mask in found]
    rows = [
        _of_view(view, k, mask, scene, shell, mesh, voxel)
        for k, (view, mask) in enumerate(zip(views, chosen, strict=True))
    ]
    table = {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
    near = table["near"]
    table["start"] = (table.pop("origin") + near[:, None] * table["way"] - origin) / voxel
    for key in ("split", "second", "far", "near"):
        table[key] = (table[key] - near) / voxel
    order = random.permutation(len(near))
    return Sight(
        {
            key: value[order] if key == "camera" else value[order].astype(np.float32)
            for key, value in table.items()
        },
        samples,
    )


def _places(
    near: np.ndarray, split: np.ndarray, second: np.ndarray, far: np.ndarray, samples: int
) -> np.ndarray:
    """Rising places (R, K) that cover [near, split] and [second, far] in equal shares."""
    part = np.linspace(0, 1, samples, dtype=np.float32)
    share = part * (split - near + far - second)[:, None]
    jump = np.where(share > (split - near)[:, None], (second - split)[:, None], 0)
    return near[:, None] + share + jump


def _struck(scene: o3d.t.geometry.RaycastingScene, view: View) -> np.ndarray:
    return scene.cast_rays(camera_rays(view.camera), nthreads=1)["t_hit"].numpy()


def _of_view(
    view: View,
    index: int,
    chosen: np.ndarray,
    scene: o3d.t.geometry.RaycastingScene,
    shell: o3d.t.geometry.RaycastingScene,
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray],
    voxel: float,
) -> dict[str, np.ndarray]:
    """Rays of the chosen (H, W) pixels, which enter the shell; metres along unit vectors."""
    _, normals, faces = mesh
    y, x = np.nonzero(chosen)
    origin, ways = rays(view.camera)
    way = ways[y, x] / np.linalg.norm(ways[y, x], axis=-1, keepdims=True)
    row = o3d.core.Tensor(
        np.concatenate([np.broadcast_to(origin, way.shape), way], 1).astype(np.float32)
    )
    near = shell.cast_rays(row, nthreads=1)["t_hit"].numpy().astype(np.float64)
    near = np.where(np.isfinite(near), near, 0.0)  # a ray along an edge may miss the second time
    hit = scene.cast_rays(row, nthreads=1)
    full = hit["t_hit"].numpy()
    out = near + _exit(shell, origin + near[:, None] * way, way, voxel)
    normal = np.zeros((len(x), 3))
    struck = np.isfinite(full)
    corner = faces[hit["primitive_ids"].numpy()[struck]]
    u, v = hit["primitive_uvs"].numpy()[struck].T
    bary = np.stack([1 - u - v, u, v], axis=1)
    normal[struck] = (normals[corner] * bary[..., None]).sum(1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    cosine = -(normal * way).sum(1)
    deeper = MARGIN * voxel / np.clip(cosine, 0.4, 1)
    full = np.where(struck, full, 0.0)
    before = np.where(struck, full - deeper, out)
    apart = struck & (out < before)  # it leaves the shell before it hits what lies behind
    far = np.where(struck, np.maximum(full, near) + deeper, out)
    alpha = view.alpha[y, x]
    return {
        "camera": np.full(len(x), index),
        "origin": np.broadcast_to(origin, way.shape),
        "way": way,
        "near": near,
        "split": np.where(apart, out, far),
        "second": np.where(apart, before, far),
        "far": far,
        "normal": normal,
        "rgb": view.rgb[y, x] / 255.0,
        "alpha": alpha,
        "weight": np.where(
            struck & (near > 0) & (alpha > OPAQUE), np.clip(cosine / 0.4, 0, 1), 0.0
        ),
    }


def _exit(
    shell: o3d.t.geometry.RaycastingScene, points: np.ndarray, ways: np.ndarray, voxel: float
) -> np.ndarray:
    """Metres (R,) from entering the shell to leaving it; a voxel where it is not left."""
    lift = 1e-2 * voxel
    row = np.concatenate([points + lift * ways, ways], axis=1).astype(np.float32)
    found = shell.cast_rays(o3d.core.Tensor(row), nthreads=1)["t_hit"].numpy()
    return np.where(np.isfinite(found), found + lift, voxel)
