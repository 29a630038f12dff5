"""Ray casting against triangle meshes (Embree through Open3D), and helpers on meshes."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import scipy.sparse

from express50.geometry.conventions import cell_centres, corner_to_cell

MISS = np.uint32(0xFFFFFFFF)


class Caster:
    """A compiled triangle scene; one thread, so that processes do not fight over cores."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(vertices, dtype=np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(faces, dtype=np.uint32)),
        )

    def cast(
        self, origin: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the first hits of rays.

        Args:
            origin: (3,) shared, or (N, 3).
            directions: (N, 3), any length; distances are in units of it.

        Returns:
            distance (N,) float32, inf where nothing is hit; face (N,) uint32, ``MISS`` likewise;
            barycentric weights (N, 2) of the face's second and third vertex.
        """
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = origin
        rays[:, 3:] = directions
        hits = self._scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)
        return (
            hits["t_hit"].numpy(), hits["primitive_ids"].numpy(), hits["primitive_uvs"].numpy(),
        )  # fmt: skip

    def blocked(self, origins: np.ndarray, directions: np.ndarray, far: float) -> np.ndarray:
        """Return (N,) True for rays of unit directions (N, 3) that hit within ``far`` metres."""
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        answer = self._scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=far, nthreads=1)
        return answer.numpy()


def face_to_vertex(faces: np.ndarray, count: int) -> scipy.sparse.csr_matrix:
    """Return sparse (V, F) matrix that sums a quantity of the faces (F, 3) at their vertices."""
    rows = faces.ravel()
    columns = np.repeat(np.arange(len(faces)), 3)
    ones = np.ones(len(rows), dtype=np.float32)
    return scipy.sparse.csr_matrix((ones, (rows, columns)), shape=(count, len(faces)))


def vertex_normals(
    vertices: np.ndarray, faces: np.ndarray, incidence: scipy.sparse.csr_matrix
) -> np.ndarray:
    """Unit normals (V, 3), area weighted; ``incidence`` comes from :func:`face_to_vertex`."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    total = incidence @ np.cross(b - a, c - a)
    return unit(total)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (..., 3) to length 1; zero stays zero."""
    return vectors / np.maximum(np.sqrt(dot(vectors, vectors)), 1e-20)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products (..., 1) of vectors (..., 3); several times quicker than a sum over the axis."""
    return np.einsum("...i,...i->...", a, b)[..., None]


def smooth_over_mesh(values: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """Average values (V,) or (V, C) with their neighbours' a number of times."""
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


class StarMap:
    """Distance of a head's outer surface from its centre, in every direction."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, centre: np.ndarray) -> None:
        self.centre = np.asarray(centre, dtype=np.float64)
        self._rows, self._columns = 192, 384
        az = cell_centres(self._columns) / self._columns * 2 * np.pi - np.pi
        el = cell_centres(self._rows) / self._rows * np.pi - 0.5 * np.pi
        grid_az, grid_el = np.meshgrid(az, el)
        out = spherical_to_unit(grid_az, grid_el).reshape(-1, 3)
        # From outside inwards: the outermost surface counts, not what lies below it.
        distance, _, _ = Caster(vertices, faces).cast(self.centre + 1.0 * out, -out)
        radius = np.where(np.isfinite(distance), 1.0 - distance, np.nan)
        radius = radius.reshape(self._rows, self._columns)
        self._radius = np.where(np.isfinite(radius) & (radius > 0), radius, 0.0)

    def radius(self, directions: np.ndarray) -> np.ndarray:
        """Radius (N,) in unit directions (N, 3), metres, bilinear; 0 where nothing is hit."""
        az, el = unit_to_spherical(directions)
        x = corner_to_cell((az + np.pi) / (2 * np.pi) * self._columns)
        y = corner_to_cell((el + 0.5 * np.pi) / np.pi * self._rows)
        y = np.clip(y, 0, self._rows - 1.001)
        x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
        fx, fy = x - x0, y - y0
        xa, xb = x0 % self._columns, (x0 + 1) % self._columns
        low = self._radius[y0, xa] * (1 - fx) + self._radius[y0, xb] * fx
        high = self._radius[y0 + 1, xa] * (1 - fx) + self._radius[y0 + 1, xb] * fx
        return low * (1 - fy) + high * fy


def spherical_to_unit(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Return unit vectors (..., 3): azimuth from +z towards +x, elevation towards +y, radians."""
    flat = np.cos(elevation)
    return np.stack([np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat], axis=-1)


def unit_to_spherical(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth and elevation (N,) of vectors (N, 3) of any length, radians."""
    x, y, z = directions[:, 0], directions[:, 1], directions[:, 2]
    return np.arctan2(x, z), np.arctan2(y, np.sqrt(x * x + z * z))
