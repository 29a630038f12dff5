"""Read and write depth and normal maps in all their file formats.

| format | unit | range | rounding error, at most |
|---|---|---|---|
| png16 | steps of 0.05 mm | 3.27 m | 0.025 mm |
| exr16 (half float) | metres | 65 km | 1/2048 of the depth: 0.49 mm from 1 to 2 m |
| exr32 (float) | metres | 65 km | 0.0001 mm under 2 m |

0 is unknown in all of them. Normal maps are RGB PNG in camera axes (x right, y down, z forward):
component c is stored as round(h c) + h + 1, h = 127 or 32767, so that (0, 0, 0) is left for
unknown. A unit normal comes back within 0.4 degrees of 8 bits, 0.0016 of 16.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from express50.errors import FormatError
from express50.files.images import DEPTH_UNIT_M, depth_to_uint16, read_image, write_image

DEPTH_ENDINGS = {"png16": ".png", "exr16": ".exr", "exr32": ".exr"}
NORMAL_STEPS = {"png8": 127, "png16": 32767}  # of a component from 0 to 1
HALF_MAX_M = 65504.0


def depth_file(folder: Path, camera_id: str) -> Path | None:
    """Return a camera's depth map in a depth item's folder, or None."""
    paths = (folder / f"{camera_id}{ending}" for ending in (".png", ".exr"))
    return next((path for path in paths if path.is_file()), None)


def write_depth(
    folder: Path, camera_id: str, depth: np.ndarray, valid: np.ndarray, kind: str
) -> Path:
    """Write a depth map (H, W), metres, in a format of DEPTH_ENDINGS; returns the file.

    Raises:
        ValueError: a valid depth is not finite, not positive, or over what the format holds.
    """
    path = folder / f"{camera_id}{DEPTH_ENDINGS[kind]}"
    if kind == "png16":
        write_image(path, depth_to_uint16(depth, valid))
        return path
    inside = depth[valid]
    if inside.size and not (
        np.isfinite(inside).all() and inside.min() > 0 and inside.max() < HALF_MAX_M
    ):
        raise ValueError(f"valid depth must lie in (0, {HALF_MAX_M:g}) m; is the rig in metres?")
    metres = np.where(valid, depth, 0).astype(np.float32)
    write_image(path, metres, half=kind == "exr16")
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
        return (depth * np.float32(DEPTH_UNIT_M)).astype(np.float32), depth > 0
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise FormatError(f"{path}: {depth.dtype} {depth.shape}, expected one channel of floats")
    if not (np.isfinite(depth).all() and depth.min(initial=0) >= 0):
        raise FormatError(
            f"{path}: holds depths that are negative or not finite, expected metres and 0 where"
            " unknown; run 'express50 depth' again"
        )
    return depth, depth > 0


def write_normals(path: Path, normals: np.ndarray, valid: np.ndarray, kind: str) -> None:
    """Write unit normals (H, W, 3), camera axes, as a PNG of NORMAL_STEPS.

    Raises:
        ValueError: a valid normal is not finite or not of unit length.
    """
    length = np.linalg.norm(normals[valid], axis=-1)
    if length.size and not np.abs(length - 1).max() < 1e-3:  # NaN fails as well
        raise ValueError(f"{path.name}: valid normals must be finite and of unit length")
    half = NORMAL_STEPS[kind]
    code = np.rint(np.where(valid[..., None], normals, -1) * half) + half + 1
    code = np.where(valid[..., None], np.clip(code, 1, 2 * half + 1), 0)
    write_image(path, code.astype(np.uint8 if half < 128 else np.uint16))


def read_normals(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read unit normals (H, W, 3) float32, camera axes, 0 where unknown, and validity (H, W).

    Raises:
        FormatError: the file is not a normal map.
    """
    code = read_image(path)
    if code.ndim != 3 or code.shape[2] != 3 or code.dtype not in (np.uint8, np.uint16):
        raise FormatError(f"{path}: {code.dtype} {code.shape}, expected RGB of 8 or 16 bits")
    half = NORMAL_STEPS["png8" if code.dtype == np.uint8 else "png16"]
    valid = np.any(code, axis=-1)
    normals = (code.astype(np.float32) - (half + 1)) / half
    length = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return np.where(np.expand_dims(valid, -1), normals / length, 0).astype(np.float32), valid
