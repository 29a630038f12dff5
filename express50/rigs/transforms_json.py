"""Read cameras of ``transforms.json`` (instant-ngp, Nerfstudio, VHAP, GaussianAvatars).

Poses are camera to world with OpenGL axes; intrinsics are given per frame or at the top level.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from express50.errors import CalibrationError
from express50.files.text import read_json_table, refusing
from express50.geometry.cameras import Camera
from express50.geometry.conventions import cam_from_world_from_opengl
from express50.rigs.camera_builder import as_rig, camera_from_K, holds, names_from_files

_HELD = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")


def is_transforms(path: Path) -> bool:
    """Return whether a file, or a folder's transforms.json, has frames with matrices."""
    path = _file(path)
    return path.suffix == ".json" and path.is_file() and holds(path, "transform_matrix")


def _file(path: Path) -> Path:
    return path / "transforms.json" if path.is_dir() else path


def read_transforms(path: Path, size: tuple[int, int] | None) -> dict[str, Camera]:
    """Read one camera per frame, or per camera index if time steps share cameras.

    The path may be the folder of transforms.json; ``size`` is the width and height to use if the
    file gives none.

    Raises:
        CalibrationError: a frame lacks what a camera needs, or a camera moves between frames.
    """
    path = _file(path)
    table = read_json_table(path, CalibrationError)
    frames = table.get("frames")
    tables = isinstance(frames, list) and all(isinstance(frame, dict) for frame in frames)
    if not frames or not tables:
        raise CalibrationError(f"{path}: has no frames; expected [{{transform_matrix, ...}}, ...]")
    with refusing(CalibrationError, f"{path}: camera_index is not a number"):
        names = camera_names(frames)
    found: dict[str, Camera] = {}
    files: dict[str, str] = {}
    for number, (name, frame) in enumerate(zip(names, frames, strict=True)):
        file = str(frame.get("file_path", name))
        if "camera_index" not in frame and files.setdefault(name, file) != file:
            raise CalibrationError(
                f"{path}: {files[name]} and {file} are both camera {name}; rename one"
            )
        where = f"{path}: frame {number} ({name})"
        with refusing(CalibrationError, f"{where}: a value has the wrong type"):
            camera = frame_camera(where, name, table | frame, size)
        earlier = found.setdefault(name, camera)
        if np.abs(earlier.cam_from_world - camera.cam_from_world).max() > 1e-6:
            raise CalibrationError(
                f"{path}: camera {name} moves between frames; expected a fixed rig: give each image"
                " its own name, or export one time step"
            )
    return as_rig(found.values(), path)


def camera_names(frames: list[dict]) -> list[str]:
    """Name the camera of each frame by its index if all have one, otherwise by its file."""
    if all("camera_index" in frame for frame in frames):
        return [f"cam{int(frame['camera_index']):02d}" for frame in frames]
    return names_from_files(
        [str(frame.get("file_path", f"frame{n:04d}")) for n, frame in enumerate(frames)]
    )


def frame_camera(where: str, name: str, row: dict, size: tuple[int, int] | None) -> Camera:
    """Make the camera of one frame's row; ``size`` is used if the row gives no image size.

    Raises:
        CalibrationError: the row lacks what a camera needs.
        TypeError, ValueError, OverflowError, ZeroDivisionError: a value has the wrong type.
    """
    model = str(row.get("camera_model", "OPENCV"))
    if model not in _HELD:
        raise CalibrationError(
            f"{where}: camera_model {model}, expected one of {', '.join(_HELD)}; undistort first"
        )
    matrix = np.asarray(row.get("transform_matrix"), dtype=object)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise CalibrationError(
            f"{where}: transform_matrix has shape {matrix.shape}, expected (4, 4)"
        )
    world_from_cam = np.eye(4)
    world_from_cam[: len(matrix)] = matrix.astype(np.float64)
    if "w" in row and "h" in row:
        size = int(row["w"]), int(row["h"])
    if size is None:
        raise CalibrationError(
            f"{where}: has no w and h (pixels); add them, or pass --size WIDTHxHEIGHT to"
            " 'express50 cameras'"
        )
    fx, fy = _focal(row, "x", size[0]), _focal(row, "y", size[1])
    if fx is None:
        raise CalibrationError(f"{where}: has neither fl_x nor camera_angle_x; add one")
    fy = fx if fy is None else fy
    cx, cy = float(row.get("cx", size[0] / 2)), float(row.get("cy", size[1] / 2))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if row.get("is_fisheye"):
        raise CalibrationError(f"{where}: is_fisheye, expected a perspective lens; undistort first")
    if float(row.get("k4", 0.0)):  # Nerfstudio's fourth power of r^2, which OpenCV's model lacks
        raise CalibrationError(f"{where}: k4 is {row['k4']}, expected 0 or none; undistort first")
    terms = ("k1", "k2", "p1", "p2", "k3") if model == "OPENCV" else ()
    dist = [float(row.get(key, 0.0)) for key in terms]
    return camera_from_K(name, K, dist, size, cam_from_world_from_opengl(world_from_cam))


def _focal(row: dict, axis: str, side: int) -> float | None:
    """Return the focal length along an axis, pixels, or None if it is not given."""
    if f"fl_{axis}" in row:
        return float(row[f"fl_{axis}"])
    if f"camera_angle_{axis}" in row:
        return 0.5 * side / math.tan(0.5 * float(row[f"camera_angle_{axis}"]))
    return None
