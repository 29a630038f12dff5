"""Compute rotations, rigid and similarity transforms in NumPy float64.

Quaternions are wxyz; axis-angle vectors are radians, right-handed. The torch twin of the
rotation part is ``express50.geometry.transforms_torch``; a test holds the two against each other.
"""

from __future__ import annotations

import numpy as np

from express50.geometry.shapes import check_shape


def axis_angle_to_matrix(axis_angle: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of axis-angle vectors (..., 3), radians.

    Source: Rodrigues' formula, with the series of sin(x)/x and (1-cos x)/x^2 near zero.
    """
    a = np.asarray(axis_angle, dtype=np.float64)
    theta2 = np.sum(a * a, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    small = theta2 < 1e-8
    safe = np.where(small, 1.0, theta)
    s = np.where(small, 1.0 - theta2 / 6.0, np.sin(safe) / safe)
    c = np.where(small, 0.5 - theta2 / 24.0, (1.0 - np.cos(safe)) / (safe * safe))
    x, y, z = np.moveaxis(a, -1, 0)
    zero = np.zeros_like(x)
    k = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*a.shape[:-1], 3, 3)
    return np.eye(3) + s * k + c * (k @ k)


def quat_to_matrix(quats: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4), wxyz, normalised here.

    Raises:
        ValueError: a quaternion has zero length.
    """
    q = np.asarray(quats, dtype=np.float64)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if np.any(norm == 0.0):
        raise ValueError("quats holds a quaternion of zero length, expected non-zero")
    w, x, y, z = np.moveaxis(q / norm, -1, 0)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(entries, -1).reshape(*q.shape[:-1], 3, 3)


def matrix_to_quat(R: np.ndarray) -> np.ndarray:
    """Return unit quaternions (..., 4), wxyz with w >= 0, of rotation matrices (..., 3, 3).

    Takes the best conditioned of the four branches (Shepperd 1978), so that half turns are exact.
    """
    m = np.asarray(R, dtype=np.float64)
    d0, d1, d2 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = [1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2]
    x = m[..., 2, 1] - m[..., 1, 2]
    y = m[..., 0, 2] - m[..., 2, 0]
    z = m[..., 1, 0] - m[..., 0, 1]
    xy = m[..., 1, 0] + m[..., 0, 1]
    xz = m[..., 0, 2] + m[..., 2, 0]
    yz = m[..., 2, 1] + m[..., 1, 2]
    entries = [
        squares[0], x, y, z,
        x, squares[1], xy, xz,
        y, xy, squares[2], yz,
        z, xz, yz, squares[3],
    ]  # fmt: skip
    branches = np.stack(entries, -1).reshape(*m.shape[:-2], 4, 4)
    best = np.argmax(squares, axis=0)[..., None, None]
    q = np.take_along_axis(branches, best, axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def matrix_to_axis_angle(R: np.ndarray) -> np.ndarray:
    """Return axis-angle vectors (..., 3), radians in [0, pi], of rotation matrices (..., 3, 3)."""
    q = matrix_to_quat(R)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    scale = np.where(sine < 1e-12, 2.0, angle / np.where(sine < 1e-12, 1.0, sine))
    return scale * q[..., 1:]


def slerp(q0: np.ndarray, q1: np.ndarray, t: float | np.ndarray) -> np.ndarray:
    """Interpolate spherically between unit quaternions (..., 4), along the shorter arc.

    Source: Shoemake 1985; falls back to normalised linear interpolation for nearly equal ends.
    """
    q0 = np.asarray(q0, dtype=np.float64)
    q1 = np.asarray(q1, dtype=np.float64)
    t = np.asarray(t, dtype=np.float64)[..., None]
    cosine = np.sum(q0 * q1, axis=-1, keepdims=True)
    q1 = np.where(cosine < 0, -q1, q1)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    w0 = np.where(near, 1.0 - t, np.sin((1.0 - t) * angle) / safe)
    w1 = np.where(near, t, np.sin(t * angle) / safe)
    q = w0 * q0 + w1 * q1
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def make_transform(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the rigid transform (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def invert_transform(T: np.ndarray) -> np.ndarray:
    """Return the inverse (4, 4) of a rigid transform (4, 4)."""
    R, t = T[:3, :3], T[:3, 3]
    return make_transform(R.T, -R.T @ t)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return ``cam_from_world`` (4, 4), OpenCV axes, at ``eye`` (3,) looking at ``target``.

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
    """Fit R (3, 3) and t (3,) that take ``source`` (N, 3) to ``target`` (N, 3), least squares."""
    return _procrustes(source, target, weights, with_scale=False)[1:]


def similarity_fit(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit scale, R and t with ``target = scale * R @ source + t`` in least squares."""
    return _procrustes(source, target, None, with_scale=True)


def _procrustes(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None, with_scale: bool
) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit the similarity of least weighted squares (Umeyama 1991)."""
    source = np.asarray(source, dtype=np.float64)
    target = np.asarray(target, dtype=np.float64)
    check_shape("source", source, (None, 3))
    check_shape("target", target, (source.shape[0], 3))
    w = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
    if len(source) < 3 or w.sum() <= 0:
        raise ValueError(f"a rigid fit needs 3 weighted points, got {int((w > 0).sum())}")
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
