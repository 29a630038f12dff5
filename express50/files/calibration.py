"""Read and write calibration files: cameras by id as JSON, with every value checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from express50.errors import CalibrationError
from express50.files.atomic import write_bytes
from express50.files.text import ID, identifier, read_json
from express50.geometry.cameras import MODELS, Camera
from express50.geometry.shapes import PIXEL_LIMIT
from express50.geometry.transforms import is_rigid

LARGEST = 1e12  # absolute value in parameters (pixels) and poses (metres)


def read_cameras(path: Path) -> dict[str, Camera]:
    """Read a calibration file: ``{id: {model, width, height, params, world_to_camera}}``.

    Raises:
        CalibrationError: the file is missing, or a camera has a field of the wrong shape or value.
    """
    if not Path(path).exists():
        raise CalibrationError(f"{path}: the file is missing; run 'express50 calibrate'")
    return parse_cameras(read_json(path, CalibrationError, "write it again"), str(path))


def parse_cameras(table: object, where: str) -> dict[str, Camera]:
    """Make cameras of a calibration file's content; CalibrationError if it is malformed."""
    if not isinstance(table, dict) or not table:
        got = "an empty one" if isinstance(table, dict) else type(table).__name__
        raise CalibrationError(f"{where}: expected a table of cameras, got {got}")
    return {camera_id: _parse_camera(where, camera_id, row) for camera_id, row in table.items()}


def _parse_camera(path: str, camera_id: str, row: object) -> Camera:
    where = f"{path}: camera {camera_id}"
    if not ID.fullmatch(camera_id):  # it becomes a file name
        raise CalibrationError(
            f"{where}: expected an id of at most 120 letters, digits, '_' and '-'; call it"
            f" {identifier(camera_id)[:120]!r} here and in the names of its folder and plate"
        )
    if not isinstance(row, Mapping):
        raise CalibrationError(f"{where}: expected a table, got {type(row).__name__}")
    missing = [k for k in ("model", "width", "height", "params", "world_to_camera") if k not in row]
    if missing:
        raise CalibrationError(f"{where}: has no {', '.join(missing)}; see docs/FORMAT.md")
    model = row["model"]
    if not isinstance(model, str) or model not in MODELS:
        raise CalibrationError(f"{where}: model {model!r} is unknown; expected {', '.join(MODELS)}")
    params = finite_array(row["params"], (len(MODELS[model]),), f"{where} has params")
    pose = finite_array(row["world_to_camera"], (4, 4), f"{where} has world_to_camera")
    R = pose[:3, :3]
    if not is_rigid(pose):
        raise CalibrationError(
            f"{where}: world_to_camera is not a rotation (R R^T differs from identity by"
            f" {np.abs(R @ R.T - np.eye(3)).max():.2g}, det {np.linalg.det(R):.3f});"
            " expected an orthonormal matrix with det 1 (-1: an axis has the wrong sign; see"
            " docs/CONVENTIONS.md)"
        )
    focals = params[: 2 if "fx" in MODELS[model] else 1]
    if not (focals > 0).all():
        raise CalibrationError(
            f"{where}: focal length {focals.min():g} px, expected a positive number"
        )
    size = [row["width"], row["height"]]
    if not all(type(n) is int and n > 0 for n in size) or size[0] * size[1] > PIXEL_LIMIT:
        raise CalibrationError(
            f"{where}: size {size}, expected a positive integer width and height, and at most"
            f" {PIXEL_LIMIT} pixels"
        )
    return Camera(camera_id, size[0], size[1], model, tuple(map(float, params)), pose)


def finite_array(value: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Convert a value to a float array of the given shape, with numbers of less than LARGEST.

    Raises:
        CalibrationError: it is not such an array; the message begins with ``what``.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    largest = np.abs(array).max(initial=0.0)  # NaN if one is
    if array.shape != shape or not largest < LARGEST:
        got = "nothing" if value is None else f"shape {array.shape}"
        got = f"{largest:.3g}" if array.shape == shape else got
        raise CalibrationError(
            f"{what}: got {got}, expected {shape}, finite and below {LARGEST:g}; export it again"
        )
    return array


def write_cameras(path: Path, cameras: Mapping[str, Camera]) -> None:
    """Write a calibration file that :func:`read_cameras` reads."""
    write_bytes(Path(path), (json.dumps(camera_rows(cameras), indent=1) + "\n").encode())


def camera_rows(cameras: Mapping[str, Camera]) -> dict[str, dict]:
    """Make the content of a calibration file, as :func:`parse_cameras` takes it."""
    return {
        camera_id: {
            "model": camera.model,
            "width": camera.width,
            "height": camera.height,
            "params": list(camera.params),
            "world_to_camera": camera.cam_from_world.tolist(),
        }
        for camera_id, camera in sorted(cameras.items())
    }
