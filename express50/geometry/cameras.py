"""Project, unproject, distort, crop and triangulate with cameras.

World and camera units are metres, axes are OpenCV's, and pixel coordinates start at the image's
corner. Camera models and the order of their parameters are COLMAP's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial import Polynomial

from express50.geometry.conventions import cell_centres
from express50.geometry.shapes import check_shape
from express50.geometry.transforms import invert_transform, transform_points

# What each COLMAP parameter is; distortion terms have OpenCV's names k1 k2 p1 p2 k3 k4 k5 k6.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
NEAREST_M = 1e-9  # least depth by which undistorted cameras divide
WIDEST = 20.0  # radius on the plane z = 1: no perspective lens sees beyond 87 degrees off its axis
TABLE_SIZE = 4096  # radii in the table that gives the first guess when a lens is inverted
NEWTON_ROUNDS = 20
_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class Camera:
    """One calibrated camera."""

    id: str  # the camera's name in the capture
    width: int  # pixels
    height: int  # pixels
    model: str  # COLMAP's name of the model
    params: tuple[float, ...]  # the model's, in COLMAP's order, in pixels or dimensionless
    cam_from_world: np.ndarray  # (4, 4) rigid transform, OpenCV axes, metres

    def _named(self) -> dict[str, float]:
        return dict(zip(MODELS[self.model], self.params, strict=True))

    @property
    def K(self) -> np.ndarray:
        """Return the intrinsics (3, 3) in pixels, with the origin at the image's corner."""
        p = self._named()
        fx, fy = p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0))
        return np.array([[fx, 0.0, p["cx"]], [0.0, fy, p["cy"]], [0.0, 0.0, 1.0]])

    @property
    def focal(self) -> float:
        """Return the focal length, pixels: the geometric mean of those across and down."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    @property
    def dist(self) -> np.ndarray:
        """Return the distortion (8,) in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6."""
        p = self._named()
        return np.array([p.get(name, 0.0) for name in _DISTORTION])

    @property
    def world_from_cam(self) -> np.ndarray:
        """Return the inverse (4, 4) of ``cam_from_world``."""
        return invert_transform(self.cam_from_world)

    @property
    def center(self) -> np.ndarray:
        """Return the position (3,) in the world, metres."""
        return self.world_from_cam[:3, 3]


def pinhole_camera(
    camera_id: str, K: np.ndarray, width: int, height: int, cam_from_world: np.ndarray
) -> Camera:
    """Return a camera without distortion from K (3, 3) and a pose (4, 4)."""
    check_shape("K", K, (3, 3), camera_id)
    params = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    return Camera(camera_id, int(width), int(height), "PINHOLE", params, np.asarray(cam_from_world))


def pinhole(camera: Camera) -> Camera:
    """Return the same camera without distortion, which undistorted images belong to."""
    return pinhole_camera(camera.id, camera.K, camera.width, camera.height, camera.cam_from_world)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of the image resized to (width, height); ValueError if either is empty."""
    if min(camera.width, camera.height) < 1:
        raise ValueError(
            f"{camera.id}: image is {camera.width}x{camera.height}, expected at least 1x1"
        )
    if (width, height) == (camera.width, camera.height):
        return camera
    return scale_camera(camera, width / camera.width, height / camera.height)


def scale_camera(camera: Camera, sx: float, sy: float) -> Camera:
    """Return the camera of the image scaled by (sx, sy); with a corner origin, K only scales.

    Raises:
        ValueError: no pixel would be left.
    """
    width, height = round(camera.width * sx), round(camera.height * sy)
    if min(width, height) < 1:
        raise ValueError(f"{camera.id}: scaled to {width}x{height}, expected at least 1x1")
    K = np.diag([sx, sy, 1.0]) @ camera.K
    return replace(_with_K(camera, K), width=width, height=height)


def crop_camera(camera: Camera, x0: float, y0: float, width: int, height: int) -> Camera:
    """Return the camera of the crop whose corner is at pixel (x0, y0) of the image."""
    K = camera.K.copy()
    K[:2, 2] -= (x0, y0)
    return replace(_with_K(camera, K), width=int(width), height=int(height))


def cut_about(
    camera: Camera, pixels: np.ndarray, margin: float = 0
) -> tuple[Camera, tuple[slice, slice]]:
    """Return the camera of the part of a picture about pixels (N, 2), and its rows and columns.

    The part reaches `margin` pixels further, and has at least one pixel.
    """
    size = np.array([camera.width, camera.height])
    pixels = pixels.astype(np.float64)
    low = np.clip(np.floor(pixels.min(0) - margin), 0, size - 1).astype(int)
    high = np.clip(np.ceil(pixels.max(0) + margin), low + 1, size).astype(int)
    part = crop_camera(camera, *low.tolist(), *(high - low).tolist())
    return part, np.s_[low[1] : high[1], low[0] : high[0]]


def _with_K(camera: Camera, K: np.ndarray) -> Camera:
    """Return the camera with other intrinsics; a model with one focal length gets one with two."""
    p = camera._named() | {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    model = {"SIMPLE_PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV"}.get(
        camera.model, camera.model
    )
    return replace(camera, model=model, params=tuple(float(p.get(n, 0.0)) for n in MODELS[model]))


def transform_camera(camera: Camera, new_from_old: np.ndarray) -> Camera:
    """Return the camera after the world moved by the rigid transform ``new_from_old`` (4, 4)."""
    return replace(camera, cam_from_world=camera.cam_from_world @ np.linalg.inv(new_from_old))


def distort(camera: Camera, xy: np.ndarray) -> np.ndarray:
    """Return distorted normalised coordinates (N, 2) of ideal ones (N, 2), even beyond a fold.

    Source: OpenCV's rational model, of which COLMAP's OPENCV and RADIAL are special cases.
    """
    p1, p2 = camera.dist[2:4]
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial, _ = _radial_part(camera.dist, r2)
    dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([x * radial + dx, y * radial + dy], axis=1)


def undistort(camera: Camera, xy: np.ndarray) -> np.ndarray:
    """Return ideal normalised coordinates (N, 2) of distorted ones (N, 2).

    They are NaN where the lens forms no such image point, because its distortion folds there.

    Source: Newton's method, started from a table of the radial part, which is monotonic in its
    field.
    """
    xy = np.asarray(xy, dtype=np.float64)
    if not camera.dist.any():
        return xy
    radii = np.linspace(0.0, _field(camera.dist.tobytes()), TABLE_SIZE)
    radial, _ = _radial_part(camera.dist, radii**2)
    size = np.linalg.norm(xy, axis=1)
    ideal = xy * (np.interp(size, radii * radial, radii) / np.maximum(size, NEAREST_M))[:, None]
    todo = np.isfinite(xy).all(axis=1)
    with np.errstate(all="ignore"):  # a point without an inverse may diverge
        for _ in range(NEWTON_ROUNDS):
            error = distort(camera, ideal[todo]) - xy[todo]
            a, b, c = distortion_slopes(camera.dist, ideal[todo])
            step = np.stack([c * error[:, 0] - b * error[:, 1], a * error[:, 1] - b * error[:, 0]])
            ideal[todo] -= (step / (a * c - b * b)).T
            # A Newton step doubles the correct digits, so 1e-9 before it is exact after it.
            todo[todo] = np.abs(error).max(axis=1) > 1e-9
            if not todo.any():
                break
        ideal[todo | ~in_field(camera, ideal)] = np.nan
    return ideal


def in_field(camera: Camera, xy: np.ndarray) -> np.ndarray:
    """Return True (N,) for ideal normalised coordinates (N, 2) that are finite and not folded."""
    if not camera.dist.any():
        return np.isfinite(xy).all(axis=1)
    a, b, c = distortion_slopes(camera.dist, xy)
    near = (xy**2).sum(axis=1) <= _field(camera.dist.tobytes()) ** 2
    return near & (a > 0) & (a * c > b * b)


def distortion_slopes(
    dist: np.ndarray, xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivative of `distort`, symmetric, as (N,) dx/dx, dx/dy and dy/dy."""
    p1, p2 = dist[2:4]
    x, y = xy[:, 0], xy[:, 1]
    radial, slope = _radial_part(dist, x * x + y * y)
    a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    c = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return a, 2 * (x * y * slope + p1 * x + p2 * y), c


def _radial_part(dist: np.ndarray, r2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the radial factor (N,) at squared radii ``r2`` (N,), and its derivative in ``r2``."""
    k1, k2, _, _, k3, k4, k5, k6 = dist
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    slope = k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))
    return radial, slope / below


@lru_cache(maxsize=256)
def _field(dist: bytes) -> float:
    """Return the radius of the radial part's first fold or pole, at most `WIDEST`.

    The derivative of r N / D by r, with N and D polynomials of u = r^2, has the numerator
    N D + 2 u (N' D - N D').
    """
    k1, k2, _, _, k3, k4, k5, k6 = np.frombuffer(dist)
    above, below = Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])
    slope = above * below + Polynomial([0, 2]) * (above.deriv() * below - above * below.deriv())
    ends = [WIDEST**2]
    for part in (slope, below):
        # In units of WIDEST^2, so that trimming small coefficients drops roots far beyond it.
        roots = part(Polynomial([0, WIDEST**2])).trim(1e-12).roots()
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        ends += list(real * WIDEST**2)
    return float(np.sqrt(min(ends))) * (1 - 1e-9)


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points (N, 3), metres, into a camera, including distortion.

    Returns:
        Pixels (N, 2) as (x, y), NaN if depth <= 0 or where the lens folds, and depth (N,), camera
        z in metres. Both are NaN if a point is not finite.

    Raises:
        ValueError: points are not (N, 3).

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., ch. 6.
    """
    points = np.asarray(points, dtype=np.float64)
    check_shape("points", points, (None, 3))
    points = np.where(np.isfinite(points), points, np.nan)  # 0 * inf would be an invalid value
    p = transform_points(camera.cam_from_world, points)
    depth = p[:, 2]
    ahead = depth > 0
    xy = p[:, :2] / np.where(ahead, depth, np.nan)[:, None]
    with np.errstate(all="ignore"):  # outside the lens's field values may overflow
        xy = np.where(in_field(camera, xy)[:, None], xy, np.nan)
    K = camera.K
    return distort(camera, xy) * (K[0, 0], K[1, 1]) + K[:2, 2], depth


def unproject(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return world points (N, 3) at pixels (N, 2) and camera depths (N,), metres."""
    pixels = np.asarray(pixels, dtype=np.float64)
    check_shape("pixels", pixels, (None, 2))
    xy = normalised(camera, pixels)
    p = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) * np.asarray(depth)[:, None]
    return (p - camera.cam_from_world[:3, 3]) @ camera.cam_from_world[:3, :3]


def rays(camera: Camera, stride: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return origin (3,) and directions (H', W', 3) through the centres of every stride-th pixel.

    Directions have a camera z of 1, so that ``origin + depth * direction`` is the point at a depth.
    """
    x, y = cell_centres(camera.width)[::stride], cell_centres(camera.height)[::stride]
    K, R = camera.K, camera.cam_from_world[:3, :3]
    if camera.dist.any():
        pixels = np.stack([part.ravel() for part in np.meshgrid(x, y)], axis=1)
        way = normalised(camera, pixels) @ R[:2] + R[2]
        return camera.center, way.reshape(len(y), len(x), 3)
    # Without distortion, a direction is the sum of a column's part and a row's part.
    across, down = ((x - K[0, 2]) / K[0, 0])[:, None] * R[0], ((y - K[1, 2]) / K[1, 1])[:, None]
    return camera.center, across + (down * R[1] + R[2])[:, None]


def triangulate(
    cameras: Sequence[Camera], pixels: np.ndarray, weights: np.ndarray | None = None
) -> np.ndarray:
    """Triangulate points (N, 3), world, seen by C cameras at distorted pixels (C, N, 2).

    A pixel is NaN where a camera does not see a point; `weights` (C, N) are ones by default. A
    point is NaN if fewer than two cameras see it, or it lies behind all.

    Source: linear triangulation (Hartley and Zisserman, 12.2), then Gauss-Newton on pixels.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    check_shape("pixels", pixels, (len(cameras), None, 2))
    xy = np.stack([normalised(c, p) for c, p in zip(cameras, pixels, strict=True)])
    seen = np.isfinite(xy).all(-1)
    w = np.where(seen, 1.0 if weights is None else np.asarray(weights, dtype=np.float64), 0.0)
    P = np.stack([c.cam_from_world[:3] for c in cameras])  # (C, 3, 4)
    focal = np.array([camera.focal for camera in cameras])
    points = np.full((pixels.shape[1], 3), np.nan)
    enough = (w > 0).sum(0) >= 2
    for n in np.flatnonzero(enough):
        points[n] = _triangulate_one(P, xy[:, n], w[:, n], focal)
    return points


def normalised(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return undistorted coordinates (N, 2) on the plane z = 1 of recorded pixels (N, 2)."""
    K = camera.K
    return undistort(camera, (pixels - K[:2, 2]) / (K[0, 0], K[1, 1]))


def _triangulate_one(P: np.ndarray, xy: np.ndarray, w: np.ndarray, focal: np.ndarray) -> np.ndarray:
    """Return one world point (3,) from normalised observations (C, 2) with weights (C,)."""
    use = w > 0
    P, xy, w = P[use], xy[use], w[use] * focal[use] ** 2
    rows = xy[:, :, None] * P[:, 2:3] - P[:, :2]  # (C, 2, 4)
    homogeneous = np.linalg.svd((rows * np.sqrt(w)[:, None, None]).reshape(-1, 4))[2][-1]
    if abs(homogeneous[3]) < 1e-12:
        return np.full(3, np.nan)
    point = homogeneous[:3] / homogeneous[3]
    for _ in range(5):
        p = P[:, :, :3] @ point + P[:, :, 3]
        if np.any(p[:, 2] <= 1e-9):
            return point if np.any(p[:, 2] > 0) else np.full(3, np.nan)
        residual = p[:, :2] / p[:, 2:] - xy
        J = (P[:, :2, :3] - (p[:, :2] / p[:, 2:])[:, :, None] * P[:, 2:, :3]) / p[:, 2:, None]
        A = np.einsum("cik,cil,c->kl", J, J, w)
        b = np.einsum("cik,ci,c->k", J, residual, w)
        step = np.linalg.solve(A + 1e-12 * np.trace(A) * np.eye(3), b)
        point = point - step
        if np.linalg.norm(step) < 1e-10:
            break
    return point


def nearest_to_lines(
    origins: Iterable[np.ndarray], directions: Iterable[np.ndarray], least: float
) -> np.ndarray | None:
    """Return the point (3,) nearest to lines by origins (N, 3) and unit directions (N, 3).

    None for (nearly) parallel lines: `least` is the least eigenvalue of the sum of the matrices
    (3, 3) that project onto the planes across the lines.
    """
    total, right = np.zeros((3, 3)), np.zeros(3)
    for origin, direction in zip(origins, directions, strict=True):
        across = np.eye(3) - np.outer(direction, direction)
        total += across
        right += across @ origin
    return None if np.linalg.eigvalsh(total)[0] < least else np.linalg.solve(total, right)


def project_pinhole(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (..., 2) and depth (...) of world points (..., 3) in an undistorted camera."""
    ray, depth, _ = _rays(camera, points)
    return ray * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2], depth


def depth_in(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the depth (...), camera z in metres, of world points (..., 3)."""
    return points @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]


def inside_frame(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (S, 2) of world points (S, 3), and True (S,) if a pixel or more inside."""
    pixels, depth = project_pinhole(camera, points)
    size = np.array([camera.width, camera.height])
    return pixels, (depth > 1e-3) & (pixels >= 1.0).all(1) & (pixels <= size - 1.0).all(1)


def project_with_slope(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (..., 2) of world points (..., 3) and d pixel / d point (..., 2, 3)."""
    ray, _, safe = _rays(camera, points)
    rotation, K = camera.cam_from_world[:3, :3], camera.K
    focal = K[[0, 1], [0, 1]]
    slope = (rotation[:2] - ray[..., None] * rotation[2:]) / safe[..., None, None]
    return ray * focal + K[:2, 2], slope * focal[:, None]


def _rays(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return coordinates (..., 2) at unit depth, depth (...), and depth kept away from zero."""
    local = transform_points(camera.cam_from_world, points)
    depth = local[..., 2]
    safe = np.where(np.abs(depth) > NEAREST_M, depth, NEAREST_M)
    return local[..., :2] / safe[..., None], depth, safe
