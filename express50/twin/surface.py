"""Provide materials, ray casting (Embree), vectors, meshes and smooth random fields."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
import scipy.sparse

from express50.geometry.conventions import cell_centres, corner_to_cell
from express50.geometry.raycast import join_rays, mesh_scene

MISS = np.uint32(0xFFFFFFFF)
LATTICE = 32


class Material(IntEnum):
    """Materials of triangles."""

    SKIN = 0
    EYE = 1
    TEETH = 2
    MOUTH = 3
    TONGUE = 4
    HAIR = 5
    CLOTH = 6
    HIDDEN = 7
    HAND = 8
    APPAREL = 9
    LENS = 10


class Caster:
    """A compiled triangle scene; it uses one thread, as other processes use the other cores."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._scene = mesh_scene(vertices, faces)

    def cast(
        self, origin: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the first hits of rays from an origin (3,) that they share, or from origins (N, 3).

        Directions (N, 3) may have any length; the distance (N,) float32 is measured in it, and inf
        where nothing is hit. The face (N,) is uint32, ``MISS`` likewise, with barycentric weights
        (N, 2) of its second and third vertex.
        """
        hits = self._scene.cast_rays(join_rays(origin, directions), nthreads=1)
        return (
            hits["t_hit"].numpy(), hits["primitive_ids"].numpy(), hits["primitive_uvs"].numpy(),
        )  # fmt: skip

    def blocked(self, origins: np.ndarray, directions: np.ndarray, far: float) -> np.ndarray:
        """Mark (N,) the rays of unit directions (N, 3) that hit something within ``far`` metres."""
        rays = join_rays(origins, directions)
        return self._scene.test_occlusions(rays, tnear=0.0, tfar=far, nthreads=1).numpy()


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (..., 3) to length 1; zero stays zero."""
    return vectors / np.maximum(np.sqrt(dot(vectors, vectors)), 1e-20)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return dot products (..., 1) of vectors (..., 3), much faster than a sum over the axis."""
    return np.einsum("...i,...i->...", a, b)[..., None]


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit vertex normals (V, 3), weighted by area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    where = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    ones = np.ones(faces.size, dtype=np.float32)
    # A product with it sums values of faces at their vertices.
    incidence = scipy.sparse.csr_matrix((ones, where), shape=(len(vertices), len(faces)))
    return unit(incidence @ np.cross(b - a, c - a))


def joined_arrays(meshes: Sequence[Any]) -> dict[str, np.ndarray]:
    """Join the arrays of meshes, by name; faces then count all vertices."""
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + count for mesh, count in zip(meshes, counts, strict=True)]
    arrays = {
        name: np.concatenate([vars(mesh)[name] for mesh in meshes]) for name in vars(meshes[0])
    }
    return arrays | {"faces": np.concatenate(faces).astype(np.int32)}


def smooth_over_mesh(values: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """Average values (V,) or (V, C) with their neighbours', ``rounds`` times."""
    count = len(values)
    edges = faces[:, [0, 1, 1, 2, 2, 0, 1, 0, 2, 1, 0, 2]].reshape(-1, 2)
    matrix = scipy.sparse.coo_matrix(
        (np.ones(len(edges), dtype=np.float32), (edges[:, 0], edges[:, 1])), shape=(count, count)
    ).tocsr()
    matrix = matrix + scipy.sparse.eye(count, dtype=np.float32, format="csr")
    weight = np.asarray(matrix.sum(1)).ravel().astype(np.float32)
    scale = weight if values.ndim == 1 else weight[:, None]
    for _ in range(rounds):
        values = (matrix @ values) / scale
    return values


def spherical_to_unit(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Return unit vectors (..., 3): azimuth from +z towards +x, elevation towards +y, radians."""
    flat = np.cos(elevation)
    return np.stack([np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat], axis=-1)


def unit_to_spherical(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth and elevation (N,) of vectors (N, 3) of any length, radians."""
    x, y, z = directions[:, 0], directions[:, 1], directions[:, 2]
    return np.arctan2(x, z), np.arctan2(y, np.sqrt(x * x + z * z))


def sample_panorama(panorama: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate a panorama (H, W, C), periodic in x, at cells x and y < H - 1 (N,)."""
    height, width = panorama.shape[:2]
    left, top = np.floor(x), np.floor(y)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    column, row = left.astype(np.int32), top.astype(np.int32) * width
    a, b = column % width, (column + 1) % width
    flat = panorama.reshape(height * width, -1)
    low = flat[row + a] * (1 - fx) + flat[row + b] * fx
    row = row + width
    high = flat[row + a] * (1 - fx) + flat[row + b] * fx
    return low * (1 - fy) + high * fy


class StarMap:
    """The distance of a head's outer surface from its centre, by direction."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, centre: np.ndarray) -> None:
        self.centre = np.asarray(centre, dtype=np.float64)
        rows, columns = 192, 384
        az = cell_centres(columns) / columns * 2 * np.pi - np.pi
        el = cell_centres(rows) / rows * np.pi - 0.5 * np.pi
        out = spherical_to_unit(*np.meshgrid(az, el)).reshape(-1, 3)
        # Rays come from outside, because the outermost surface counts.
        distance, _, _ = Caster(vertices, faces).cast(self.centre + 1.0 * out, -out)
        radius = np.where(distance < 1.0, 1.0 - distance, 0.0)
        self._radius = radius.reshape(rows, columns, 1)

    def radius(self, directions: np.ndarray) -> np.ndarray:
        """Return the radius (N,) in unit directions (N, 3), metres; 0 where nothing is hit."""
        az, el = unit_to_spherical(directions)
        rows, columns, _ = self._radius.shape
        x = corner_to_cell((az + np.pi) / (2 * np.pi) * columns)
        y = np.clip(corner_to_cell((el + 0.5 * np.pi) / np.pi * rows), 0, rows - 1.001)
        return sample_panorama(self._radius, x, y)[:, 0]


def spot(points: np.ndarray, centre: np.ndarray | float, radius: float) -> np.ndarray:
    """Return a round Gaussian spot (N,) at points (N, D): 1 at its centre."""
    return np.exp(-((points - centre) ** 2).sum(1) / (2 * radius**2))


def make_lattice(rng: np.random.Generator) -> np.ndarray:
    """Return random values (32, 32, 32) in [-1, 1], float32, that `noise` interpolates."""
    return rng.uniform(-1.0, 1.0, (LATTICE,) * 3).astype(np.float32)


def noise(points: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Return value noise (N,), about -1 to 1, at points (N, 3) in lattice cells; periodic."""
    p = np.asarray(points, dtype=np.float32)
    cell = np.floor(p)
    f = p - cell
    f = f * f * (3.0 - 2.0 * f)
    i0 = cell.astype(np.int32) & (LATTICE - 1)
    i1 = (i0 + 1) & (LATTICE - 1)
    flat = lattice.ravel()
    x0, x1 = i0[:, 0] * LATTICE * LATTICE, i1[:, 0] * LATTICE * LATTICE
    y0, y1 = i0[:, 1] * LATTICE, i1[:, 1] * LATTICE
    z0, z1 = i0[:, 2], i1[:, 2]
    fx, fy, fz = f.T
    near, far = (
        _mix(_mix(flat[x0 + y0 + z], flat[x1 + y0 + z], fx),
             _mix(flat[x0 + y1 + z], flat[x1 + y1 + z], fx), fy)
        for z in (z0, z1)
    )  # fmt: skip
    return _mix(near, far, fz)


def _mix(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    return a + (b - a) * t


def fractal(
    points: np.ndarray, lattice: np.ndarray, wavelength: float, octaves: int, gain: float = 0.5
) -> np.ndarray:
    """Sum (N,) octaves of `noise` at points (N, 3); ``wavelength`` in their unit."""
    total = np.zeros(len(points), dtype=np.float32)
    for octave in range(octaves):
        # The shift keeps the octaves' lattice points, where extremes are, apart.
        scaled = np.asarray(points) * (2.0**octave / wavelength) + 7.31 * octave
        total += gain**octave * noise(scaled, lattice)
    return total
