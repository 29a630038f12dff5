"""Compute rotations, rigid and similarity transforms in NumPy float64.

Quaternions are wxyz; axis-angle vectors are radians, right-handed. The torch twin of the
rotation part is ``express50.geometry.transforms_torch``; a test holds the two against each other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from express50.geometry.shapes import check_shape

LARGEST_ANGLE = 1e15  # radians; beyond this float64 resolves angles to 0.1 or worse


def _rotations() -> Any:
    # SciPy loads it when it is first used, which few stages do: it takes 0.2 core seconds.
    return scipy.spatial.transform.Rotation


def axis_angle_to_matrix(axis_angle: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of axis-angle vectors (..., 3), radians.

    Raises:
        ValueError: an angle is infinite, or too large for float64 to resolve a fraction of a turn.
    """
    largest = np.abs(axis_angle).max(initial=0.0)
    if largest > LARGEST_ANGLE:
        raise ValueError(f"axis-angle holds {largest:.3g}, expected at most {LARGEST_ANGLE:g} rad")
    return _rotations().from_rotvec(axis_angle).as_matrix()


def quat_to_matrix(quats: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4), wxyz, normalised here.

    Raises:
        ValueError: a quaternion has zero length.
    """
    quats = np.asarray(quats, dtype=np.float64)
    largest = np.abs(quats).max(-1, keepdims=True)  # squares of tiny or huge ones would be lost
    scaled = quats / np.where(largest > 0, largest, 1.0)
    return _rotations().from_quat(scaled, scalar_first=True).as_matrix()


def matrix_to_quat(R: np.ndarray) -> np.ndarray:
    """Return unit quaternions (..., 4), wxyz with w >= 0, of rotation matrices (..., 3, 3)."""
    return _rotations().from_matrix(R).as_quat(canonical=True, scalar_first=True)


def matrix_to_axis_angle(R: np.ndarray) -> np.ndarray:
    """Return axis-angle vectors (..., 3), radians in [0, pi], of rotation matrices (..., 3, 3)."""
    return _rotations().from_matrix(R).as_rotvec()


def slerp(q0: np.ndarray, q1: np.ndarray, t: float | np.ndarray) -> np.ndarray:
    """Interpolate spherically between unit quaternions (..., 4), wxyz, along the shorter arc."""
    start, end = (_rotations().from_quat(q, scalar_first=True) for q in (q0, q1))
    way = _rotations().from_rotvec(np.asarray(t)[..., None] * (start.inv() * end).as_rotvec())
    return (start * way).as_quat(scalar_first=True)


def make_transform(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the rigid transform (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (..., 3) to length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (..., D) under an affine map, whose first D rows are its matrix and shift.

    These are the rows of a transform (4, 4) for points in space, of a map (2, 3) for pixels.
    """
    size = points.shape[-1]
    return points @ matrix[:size, :size].T + matrix[:size, size]


def scale_of(affine: np.ndarray) -> float:
    """Return how much longer an affine map (2, 3) makes lines, in the mean of its directions."""
    return float(np.sqrt(abs(np.linalg.det(affine[:, :2]))))


def invert_transform(T: np.ndarray) -> np.ndarray:
    """Return the inverse (4, 4) of a rigid transform (4, 4)."""
    R, t = T[:3, :3], T[:3, 3]
    return make_transform(R.T, -R.T @ t)


def is_rigid(T: np.ndarray) -> bool:
    """Return True if a transform (4, 4) is finite, and a rotation and translation only."""
    R = T[:3, :3]
    turns = np.isfinite(T).all() and np.abs(R @ R.T - np.eye(3)).max() <= 1e-4
    return bool(turns and np.linalg.det(R) > 0)


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 1.0, 0.0)) -> np.ndarray:
    """Return ``cam_from_world`` (4, 4), OpenCV axes, at ``eye`` (3,) looking at ``target``.

    By default, +y is up.

    Raises:
        ValueError: the eye is at the target, or ``up`` is parallel to the viewing direction.
    """
    forward = np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-12 * max(1.0, float(np.linalg.norm(forward))):
        raise ValueError("look_at: eye equals target or up is parallel to the viewing direction")
    z = forward / np.linalg.norm(forward)
    x = right / np.linalg.norm(right)
    R = np.stack([x, np.cross(z, x), z])
    return make_transform(R, -R @ np.asarray(eye, dtype=np.float64))


def rigid_fit(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Fit R (3, 3) and t (3,) that map ``source`` (N, 3) to ``target`` (N, 3) in least squares."""
    return _procrustes(source, target, weights, with_scale=False)[1:]


def similarity_fit(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit scale, R and t with ``target = scale * R @ source + t`` in least squares."""
    return _procrustes(source, target, None, with_scale=True)


def _procrustes(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None, with_scale: bool
) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit a similarity by weighted least squares (Umeyama 1991)."""
    source = np.asarray(source, dtype=np.float64)
    target = np.asarray(target, dtype=np.float64)
    check_shape("source", source, (None, 3))
    check_shape("target", target, (source.shape[0], 3))
    w = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
    if len(source) < 3 or w.sum() <= 0:
        raise ValueError(f"a rigid fit needs 3 points with weight, got {int((w > 0).sum())}")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError("a rigid fit needs finite points, got NaN or infinity")
    w = w / w.sum()
    mean_s, mean_t = w @ source, w @ target
    centred_s, centred_t = source - mean_s, target - mean_t
    U, singular, Vt = np.linalg.svd((w[:, None] * centred_t).T @ centred_s)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt)) or 1.0])
    R = (U * flip) @ Vt
    variance = float(w @ np.sum(centred_s**2, axis=1))
    if variance <= 0:
        raise ValueError("a rigid fit needs points that are not all the same")
    scale = float(singular @ flip) / variance if with_scale else 1.0
    return scale, R, mean_t - scale * R @ mean_s
