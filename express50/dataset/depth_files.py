"""Read and write depth and normal maps.

Depth is stored as a 16-bit PNG in steps of 0.05 mm (rounding error at most 0.025 mm), or as a float
EXR in metres if it exceeds the PNG's 3.27 m; 0 means unknown in both. Normal maps are RGB PNGs in
camera axes (x right, y down, z forward): component c is stored as round(127 c) + 128, which leaves
(0, 0, 0) for unknown. A unit normal is restored to within 0.4 degrees.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from express50.errors import FormatError
from express50.files.images import (
    DEPTH_LIMIT_M,
    DEPTH_UNIT_M,
    depth_to_uint16,
    read_image,
    write_image,
)

NORMAL_STEPS = 127  # from 0 to 1 in one component
FARTHEST_M = 1e4  # no rig is this large: beyond this its unit must be wrong


def depth_file(folder: Path, camera_id: str) -> Path | None:
    """Return a camera's depth map in a depth item's folder, or None."""
    paths = (folder / f"{camera_id}{ending}" for ending in (".png", ".exr"))
    return next((path for path in paths if path.is_file()), None)


def encode_depth(depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Encode a depth map (H, W), metres: uint16 steps, or float32 metres if these do not suffice.

    Raises:
        ValueError: a valid depth is not finite, not positive or over 10 km.
    """
    inside = depth[valid]
    if not ((inside > 0) & (inside < FARTHEST_M)).all():
        raise ValueError(f"valid depth must lie in (0, {FARTHEST_M:g}) m; is the rig in metres?")
    if inside.max(initial=0) < DEPTH_LIMIT_M:
        return depth_to_uint16(depth, valid)
    return np.where(valid, depth, 0).astype(np.float32)


def write_depth(folder: Path, camera_id: str, encoded: np.ndarray) -> Path:
    """Write a camera's depth map (H, W) of `encode_depth` as PNG or EXR; returns the file."""
    path = folder / f"{camera_id}{'.png' if encoded.dtype == np.uint16 else '.exr'}"
    write_image(path, encoded)
    return path


def read_depth(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read depth (H, W) float32 metres, 0 where unknown, and its validity (H, W) bool.

    Raises:
        FormatError: the file is not a depth map.
    """
    depth = read_image(path)
    if path.suffix != ".exr":
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise FormatError(f"{path}: {depth.dtype} {depth.shape}, expected 16-bit grey depth")
        return depth * np.float32(DEPTH_UNIT_M), depth > 0
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise FormatError(f"{path}: {depth.dtype} {depth.shape}, expected one channel of floats")
    if not (np.isfinite(depth).all() and depth.min(initial=0) >= 0):
        raise FormatError(
            f"{path}: holds depths that are negative or not finite, expected metres, or 0 if"
            " unknown; run 'express50 depth' again"
        )
    return depth, depth > 0


def encode_normals(normals: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Encode unit normals (H, W, 3), camera axes, as uint8, 0 where not `valid` (H, W).

    Raises:
        ValueError: a valid normal is not finite or not of unit length.
    """
    square = np.einsum("hwi,hwi->hw", normals, normals)[valid]
    if square.size and not np.abs(square - 1).max() < 2e-3:  # NaN fails as well
        raise ValueError("valid normals must be finite and of unit length")
    # It rounds, cuts at 255 and converts in one pass.
    code = cv2.convertScaleAbs(normals, alpha=NORMAL_STEPS, beta=NORMAL_STEPS + 1)
    return cv2.bitwise_and(code, code, mask=valid.astype(np.uint8))


def read_normals(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read unit normals (H, W, 3) float32, camera axes, 0 where unknown, and validity (H, W).

    Raises:
        FormatError: the file is not a normal map.
    """
    code = read_image(path)
    if code.ndim != 3 or code.shape[2] != 3 or code.dtype != np.uint8:
        raise FormatError(f"{path}: {code.dtype} {code.shape}, expected 8-bit RGB")
    valid = np.any(code, axis=-1)
    normals = (code.astype(np.float32) - (NORMAL_STEPS + 1)) / NORMAL_STEPS
    length = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return np.where(np.expand_dims(valid, -1), normals / length, 0).astype(np.float32), valid
