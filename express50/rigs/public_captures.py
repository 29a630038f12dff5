"""Read the rigs of two public collections of captures.

- NeRSemble's camera_params.json, as nersemble-data 0.0.6 reads it: ``world_2_cam`` is world to
  camera with OpenCV axes, metres; K belongs to 2200 x 3208 images.
- RenderMe-360's .smc: ``RT`` is camera to world with OpenCV axes, metres; K belongs to the stored
  resolution.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from express50.errors import CalibrationError, CaptureError
from express50.files.containers import attribute, child, members, open_hdf5, read_array
from express50.files.text import read_json_table
from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_from_opencv
from express50.rigs.camera_builder import camera_from_K, checked, finite_array

NERSEMBLE_SIZE = (2200, 3208)


def read_nersemble(path: Path) -> dict[str, Camera]:
    """Read cameras by serial number, at the release's full size.

    Raises:
        CalibrationError: world_2_cam or intrinsics are missing or have the wrong shape.
    """
    table = read_json_table(path, CalibrationError)
    poses, intrinsics = table.get("world_2_cam"), table.get("intrinsics")
    if not isinstance(poses, dict) or intrinsics is None:
        raise CalibrationError(
            f"{path}: expected world_2_cam {{serial: 4 x 4}} and intrinsics (3 x 3, or a table by"
            " serial)"
        )
    found = {}
    for serial, pose in poses.items():
        own = intrinsics.get(serial) if isinstance(intrinsics, dict) else intrinsics
        what = f"{path}: camera {serial} has an array"
        K, matrix = finite_array(own, (3, 3), what), finite_array(pose, (4, 4), what)
        found[serial] = camera_from_K(serial, K_from_opencv(K), [], NERSEMBLE_SIZE, matrix)
    return checked(found, path)


def read_renderme(path: Path) -> dict[str, Camera]:
    """Read the cameras of an SMC with a Calibration group (in full releases the ``_anno`` one).

    Raises:
        CalibrationError: the file has no calibration, or its resolution or an array is malformed.
    """
    try:
        file = open_hdf5(path)
        group = child(file, "Calibration")
        if not isinstance(group, h5py.Group):
            raise CalibrationError(
                f"{path}: has no Calibration group; use the anno file of the same performance"
                f" ({path.name.replace('_raw', '_anno')})"
            )
        size = _smc_size(path, file)
        found = {}
        for name in members(group):
            if not name.isdecimal() or len(name) > 4:
                raise CalibrationError(f"{path}: camera {name!r}, expected a number such as 07")
            rows = {key: f"Calibration/{name}/{key}" for key in ("K", "RT", "D")}
            what = f"{path}: camera {name} has an array"
            K = finite_array(read_array(file, rows["K"]), (3, 3), what)
            pose = finite_array(read_array(file, rows["RT"]), (4, 4), what)
            has_dist = child(file, rows["D"]) is not None
            dist = np.ravel(read_array(file, rows["D"])) if has_dist else np.zeros(0)
            if np.linalg.matrix_rank(pose) < 4:
                raise CalibrationError(f"{path}: RT of camera {name} cannot be inverted")
            camera_id = f"cam{int(name):02d}"
            found[camera_id] = camera_from_K(
                camera_id, K_from_opencv(K), dist[:14], size, np.linalg.inv(pose)
            )
    except CaptureError as error:
        raise CalibrationError(str(error)) from None
    return checked(found, path)


def _smc_size(path: Path, file: h5py.File) -> tuple[int, int]:
    """Read the size, stored as height and width; return width and height, or the release's size."""
    group = child(file, "Camera")
    size = np.array((2048, 2448))
    if isinstance(group, h5py.Group):
        size = attribute(group, "resolution", size)
    if size.shape != (2,) or size.dtype.kind not in "ui":
        raise CalibrationError(f"{path}: resolution {size.tolist()}, expected height and width")
    return int(size[1]), int(size[0])
