"""Compute rotations in torch: any float type, with gradients that stay finite at 0 and pi.

Quaternions are wxyz; axis-angle vectors are radians. The NumPy twin is ``transforms``.
"""

from __future__ import annotations

import torch
from torch import Tensor


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of axis-angle vectors (..., 3), radians.

    Source: Rodrigues' formula; series below 1e-3 rad keep value and gradient smooth through zero.
    """
    # rsub(x, a, alpha=b) is a - b x; forward differentiation of x * b would load torch's compiler,
    # which takes 1 s.
    theta2 = (axis_angle * axis_angle).sum(-1)
    small = theta2 < 1e-6
    safe = torch.where(small, torch.ones_like(theta2), theta2).sqrt()
    series_s = torch.rsub(theta2, 1.0, alpha=1 / 6)
    series_c = torch.rsub(theta2, 0.5, alpha=1 / 24)
    s = torch.where(small, series_s, torch.sin(safe) / safe)
    c = torch.where(small, series_c, (1.0 - torch.cos(safe)) / (safe * safe))
    x, y, z = axis_angle.unbind(-1)
    entries = [
        1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
        c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
        c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, -1).reshape(*axis_angle.shape[:-1], 3, 3)


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4), wxyz, normalised here.

    A quaternion of zero length becomes the identity, with zero gradient.
    """
    largest = quats.detach().abs().amax(-1, keepdim=True)  # squares of tiny or huge ones are lost
    zero = largest == 0
    quats = quats / torch.where(zero, torch.ones_like(largest), largest)
    norm2 = (quats * quats).sum(-1, keepdim=True)
    unit = quats / torch.where(zero, torch.ones_like(norm2), norm2).sqrt()
    identity = torch.zeros_like(quats)
    identity[..., 0] = 1.0
    w, x, y, z = torch.where(zero, identity, unit).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)


def matrix_to_quat(R: Tensor) -> Tensor:
    """Return unit quaternions (..., 4), wxyz with w >= 0, of rotation matrices (..., 3, 3).

    It takes the best conditioned of four branches (Shepperd 1978). The NumPy twin refuses
    reflections; here they are not checked, because each training step would wait for the GPU.
    """
    m = R
    d0, d1, d2 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack(
        [1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2], -1
    )
    x = m[..., 2, 1] - m[..., 1, 2]
    y = m[..., 0, 2] - m[..., 2, 0]
    z = m[..., 1, 0] - m[..., 0, 1]
    xy = m[..., 1, 0] + m[..., 0, 1]
    xz = m[..., 0, 2] + m[..., 2, 0]
    yz = m[..., 2, 1] + m[..., 1, 2]
    branches = torch.stack(
        [
            torch.stack([squares[..., 0], x, y, z], -1),
            torch.stack([x, squares[..., 1], xy, xz], -1),
            torch.stack([y, xy, squares[..., 2], yz], -1),
            torch.stack([z, xz, yz, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    q = branches.gather(-2, best)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)
