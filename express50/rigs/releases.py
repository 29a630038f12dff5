"""Cameras of two published head datasets: NeRSemble's camera_params.json, RenderMe-360's .smc.

Layouts as their own readers have them: NeRSemble's ``world_2_cam`` is world to camera with OpenCV
axes, metres, and K belongs to 2200 x 3208 images (nersemble-data 0.0.6); RenderMe-360's ``RT`` is
camera to world with OpenCV axes, metres, and K belongs to the stored resolution.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from express50.adapters import K_from_opencv
from express50.cameras import Camera
from express50.errors import CalibrationError
from express50.rigs.build import camera_from_K, checked, read_table

NERSEMBLE_SIZE = (2200, 3208)


def is_nersemble(path: Path) -> bool:
    """Whether a file is NeRSemble's camera_params.json."""
    return path.is_file() and path.suffix == ".json" and '"world_2_cam"' in path.read_text()


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
    import h5py

    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise CalibrationError(f"{path}: not an HDF5 file ({error})") from None
    with file:
        if "Calibration" not in file:
            raise CalibrationError(
                f"{path}: has no Calibration; expected it in the anno file of the same performance"
                f" ({path.name.replace('_raw', '_anno')})"
            )
        height, width = _resolution(path, file)
        found = {}
        for name, group in file["Calibration"].items():
            K = _array(path, name, group["K"][()], (3, 3))
            pose = _array(path, name, group["RT"][()], (4, 4))
            dist = np.ravel(group["D"][()]) if "D" in group else np.zeros(0)
            camera_id = f"cam{int(name):02d}"
            found[camera_id] = camera_from_K(
                camera_id, K_from_opencv(K), dist, (width, height), np.linalg.inv(pose)
            )
    return checked(found, path)


def _resolution(path: Path, file: object) -> tuple[int, int]:
    """Height and width, stored in this order; the release's full frame where they are absent."""
    attributes = dict(file["Camera"].attrs) if "Camera" in file else {}  # type: ignore[operator,index]
    size = np.ravel(attributes.get("resolution", (2048, 2448)))
    if size.shape != (2,):
        raise CalibrationError(f"{path}: resolution {size.tolist()}, expected height and width")
    return int(size[0]), int(size[1])


def _array(path: Path, name: str, value: object, shape: tuple[int, int]) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise CalibrationError(
            f"{path}: camera {name} has an array of shape {array.shape}, expected {shape}, finite"
        )
    return array
