"""Read the files of calibrators of several cameras: caliscope, aniposelib, Kalibr, Qualisys.

- caliscope's camera_array.toml and aniposelib's calibration.toml (FreeMoCap, Pose2Sim): world to
  camera; axes, pixels and distortion are OpenCV's; a rotation is a matrix or Rodrigues' vector. The
  unit is the board's, metres in caliscope, whose ``rotation_count`` is how pictures are turned for
  display: the calibration is of pictures as recorded.
- Kalibr's camchain: ``T_cn_cnm1`` takes points from the camera before to this one. The world is the
  first camera's; metres, OpenCV's pixels.
- Qualisys' .qca.txt: camera to world, OpenGL's axes, each row of ``r`` an axis of the camera;
  millimetres. Intrinsics count in 64ths of a pixel from the corner of the whole sensor, of which
  ``fov_video`` is recorded, its last row and column included.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from express50.errors import CalibrationError
from express50.files.text import read_toml, read_xml, read_yaml
from express50.geometry.cameras import Camera
from express50.geometry.conventions import FLIP_YZ, K_from_opencv
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.rigs.camera_builder import as_rig, camera_from_K, finite_array

SUBPIXELS = 64  # of Qualisys in a pixel


def read_calibration_toml(path: Path) -> dict[str, Camera]:
    """Read the cameras of caliscope or aniposelib that have a pose, in the file's unit.

    caliscope's are called ``cam_0`` and so on, as its videos are; aniposelib's have names.

    Raises:
        CalibrationError: there are none, a value is missing, or a lens is a fisheye.
    """
    table = read_toml(path, CalibrationError)
    rows = table.get("cameras", table)
    if not isinstance(rows, dict):
        raise CalibrationError(f"{path}: cameras is not a table, expected [cameras.0] and so on")
    prefix = "cam_" if rows is not table else ""
    return as_rig(
        (
            _toml_camera(f"{path}: [{key}]", str(row.get("name", f"{prefix}{key}")), row)
            for key, row in rows.items()
            if isinstance(row, dict) and {"rotation", "translation"} <= row.keys()
        ),
        path,
    )


def _toml_camera(where: str, name: str, row: dict[str, Any]) -> Camera:
    if row.get("fisheye"):
        raise CalibrationError(f"{where}: fisheye, expected a perspective lens; undistort first")
    rotation = row["rotation"]
    if isinstance(rotation, list) and not any(isinstance(entry, list) for entry in rotation):
        R = axis_angle_to_matrix(finite_array(rotation, (3,), f"{where} has rotation"))
    else:
        R = finite_array(rotation, (3, 3), f"{where} has rotation")
    t = finite_array(row["translation"], (3,), f"{where} has translation")
    width, height = finite_array(row.get("size"), (2,), f"{where} has size")
    K = K_from_opencv(finite_array(row.get("matrix"), (3, 3), f"{where} has matrix"))
    dist = row.get("distortions", [])
    count = len(dist) if isinstance(dist, list) else 0
    dist = finite_array(dist, (count,), f"{where} has distortions")
    return camera_from_K(name, K, dist, (int(width), int(height)), make_transform(R, t))


def read_kalibr(path: Path) -> dict[str, Camera]:
    """Read the cameras of a camchain, metres; the world is that of ``cam0``.

    Raises:
        CalibrationError: the chain has a gap, a value is missing, or a lens is not pinhole-radtan.
    """
    table = read_yaml(path, CalibrationError)
    names = [f"cam{n}" for n in range(len(table))] if isinstance(table, dict) else []
    if not names or not all(isinstance(table.get(name), dict) for name in names):
        raise CalibrationError(f"{path}: expected tables cam0, cam1 and so on without a gap")
    cameras, pose = [], np.eye(4)
    for name in names:
        row, where = table[name], f"{path}: {name}"
        model = f"{row.get('camera_model')}-{row.get('distortion_model')}"
        if model not in ("pinhole-radtan", "pinhole-none"):
            raise CalibrationError(
                f"{where}: model {model[:60]}, expected pinhole-radtan; calibrate again with"
                " --models pinhole-radtan, or undistort first"
            )
        if name != names[0]:
            step = row.get("T_cn_cnm1")
            pose = finite_array(step, (4, 4), f"{where} has T_cn_cnm1") @ pose
        fx, fy, cx, cy = finite_array(row.get("intrinsics"), (4,), f"{where} has intrinsics")
        width, height = finite_array(row.get("resolution"), (2,), f"{where} has resolution")
        K = K_from_opencv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        dist = np.zeros(0)
        if model.endswith("radtan"):
            terms = row.get("distortion_coeffs")
            dist = finite_array(terms, (4,), f"{where} has distortion_coeffs")
        cameras.append(camera_from_K(name, K, dist, (int(width), int(height)), pose))
    return as_rig(cameras, path)


def read_qualisys(path: Path) -> dict[str, Camera]:
    """Read the active cameras of a calibration that QTM exported, by serial number, metres.

    Raises:
        CalibrationError: there are none, or one lacks a value.
    """
    cameras = read_xml(path, CalibrationError).iter("camera")
    kept = [c for c in cameras if c.get("active") != "0" and c.get("calibrated") != "false"]
    return as_rig((_qualisys_camera(path, camera) for camera in kept), path)


def _qualisys_camera(path: Path, camera: Element) -> Camera:
    serial = camera.get("serial", "")
    where = f"{path}: camera {serial}"

    def numbers(child: str, keys: str) -> np.ndarray:
        element, names = camera.find(child), keys.split()
        values = None if element is None else [element.get(name) for name in names]
        return finite_array(values, (len(names),), f"{where} has {keys} of {child}")

    left, top, right, bottom = numbers("fov_video", "left top right bottom")
    lens = numbers("intrinsic", "focalLengthU focalLengthV centerPointU centerPointV skew")
    fx, fy, cx, cy, skew = lens / SUBPIXELS
    K = np.array([[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1]])
    terms = "radialDistortion1 radialDistortion2 tangentalDistortion1 tangentalDistortion2"
    dist = numbers("intrinsic", f"{terms} radialDistortion3")
    axes = numbers("transform", "r11 r12 r13 r21 r22 r23 r31 r32 r33").reshape(3, 3)
    place = 1e-3 * numbers("transform", "x y z")
    size = int(right - left) + 1, int(bottom - top) + 1
    pose = FLIP_YZ @ make_transform(axes, -axes @ place)
    return camera_from_K(serial, K, dist, size, pose)
