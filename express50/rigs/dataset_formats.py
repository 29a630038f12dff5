"""Cameras of two published head datasets: NeRSemble's camera_params.json, RenderMe-360's .smc.

Layouts as their own readers have them: NeRSemble's ``world_2_cam`` is world to camera with OpenCV
axes, metres, and K belongs to 2200 x 3208 images (nersemble-data 0.0.6); RenderMe-360's ``RT`` is
camera to world with OpenCV axes, metres, and K belongs to the stored resolution.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from express50.errors import CalibrationError, CaptureError
from express50.files.containers import attribute, child, members, open_hdf5, read_array
from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_from_opencv
from express50.rigs.camera_builder import camera_from_K, checked, holds, read_table

NERSEMBLE_SIZE = (2200, 3208)


def is_nersemble(path: Path) -> bool:
    """Whether a file is NeRSemble's camera_params.json."""
    return path.is_file() and path.suffix == ".json" and holds(path, '"world_2_cam"')


def read_nersemble(path: Path) -> dict[str, Camera]:
    """Cameras by serial number, at the release's full size.

    Raises:
        CalibrationError: world_2_cam or intrinsics are missing or have another shape.
    """
    table = read_table(path)
    poses, intrinsics = table.get("world_2_cam"), table.get("intrinsics")
    if not isinstance(poses, dict) or intrinsics is None:
        raise CalibrationError(
            f"{path}: expected world_2_cam {{serial: 4 x 4}} and intrinsics (3 x 3 or a serial)"
        )
    found = {}
    for serial, pose in poses.items():
        own = intrinsics.get(serial) if isinstance(intrinsics, dict) else intrinsics
        K, matrix = _array(path, serial, own, (3, 3)), _array(path, serial, pose, (4, 4))
        found[serial] = camera_from_K(serial, K_from_opencv(K), [], NERSEMBLE_SIZE, matrix)
    return checked(found, path)


def is_renderme(path: Path) -> bool:
    """Whether a file is a RenderMe-360 SMC."""
    return path.is_file() and path.suffix == ".smc"


def read_renderme(path: Path) -> dict[str, Camera]:
    """Cameras of an SMC that has a Calibration group (in full releases the ``_anno`` one).

    Raises:
        CalibrationError: the file has no calibration or no resolution, or an array's shape is off.
    """
    try:
        file = open_hdf5(path)
        group = child(file, "Calibration", str(path))
        if not isinstance(group, h5py.Group):
            raise CalibrationError(
                f"{path}: has no Calibration; expected it in the anno file of the same performance"
                f" ({path.name.replace('_raw', '_anno')})"
            )
        height, width = _resolution(path, file)
        found = {}
        for name in members(group, str(path)):
            rows = {key: f"Calibration/{name}/{key}" for key in ("K", "RT", "D")}
            K = _array(path, name, read_array(file, rows["K"], str(path)), (3, 3))
            pose = _array(path, name, read_array(file, rows["RT"], str(path)), (4, 4))
            has_dist = child(file, rows["D"], str(path)) is not None
            dist = np.ravel(read_array(file, rows["D"], str(path))) if has_dist else np.zeros(0)
            camera_id = _camera_id(path, name)
            found[camera_id] = camera_from_K(
                camera_id, K_from_opencv(K), dist[:14], (width, height), _inverse(path, name, pose)
            )
    except CaptureError as error:
        raise CalibrationError(str(error)) from None
    return checked(found, path)


def _camera_id(path: Path, name: str) -> str:
    if not name.isdecimal() or len(name) > 4:
        raise CalibrationError(f"{path}: camera {name!r}, expected a number such as 07")
    return f"cam{int(name):02d}"


def _inverse(path: Path, name: str, pose: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.inv(pose)
    except np.linalg.LinAlgError:
        raise CalibrationError(f"{path}: RT of camera {name} cannot be inverted") from None


def _resolution(path: Path, file: h5py.File) -> tuple[int, int]:
    """Height and width, stored in this order; the release's full frame where they are absent."""
    group = child(file, "Camera", str(path))
    usual = np.array((2048, 2448))
    size = usual
    if isinstance(group, h5py.Group):
        size = attribute(group, "resolution", usual, str(path))
    if size.shape != (2,) or size.dtype.kind not in "ui":
        raise CalibrationError(f"{path}: resolution {size.tolist()}, expected height and width")
    return int(size[0]), int(size[1])


def _array(path: Path, name: str, value: object, shape: tuple[int, int]) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise CalibrationError(
            f"{path}: camera {name} has an array of shape {array.shape}, expected {shape}, finite"
        )
    return array
