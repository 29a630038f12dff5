"""Read cameras that are listed picture by picture: COLMAP's models, and ``transforms.json``.

A COLMAP model is ``cameras`` and ``images``, .bin or .txt; nothing else of it is read. COLMAP's own
reader trusts the counts in a binary file and allocates memory for them. The layout is documented in
COLMAP's description of its output format.

``transforms.json`` is that of instant-ngp, Nerfstudio, VHAP and GaussianAvatars. Poses are camera
to world with OpenGL axes; intrinsics are given per frame or at the top level.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from express50.errors import CalibrationError
from express50.files.text import read_bytes, read_json_table, read_text, refusing
from express50.geometry.cameras import Camera
from express50.geometry.conventions import cam_from_world_from_opengl
from express50.geometry.transforms import make_transform, quat_to_matrix
from express50.rigs.camera_builder import as_rig, camera_from_K, holds, names_from_files

# COLMAP's models that our cameras share, by COLMAP's number: name and number of parameters.
HELD = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5),
        4: ("OPENCV", 8), 6: ("FULL_OPENCV", 12)}  # fmt: skip
SIZE_LIMIT = 1 << 30  # bytes per file; the images file holds every observed point
# camera_model of transforms.json that our cameras share.
LENSES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")


class Lens(NamedTuple):
    """A camera without pose."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class Shot(NamedTuple):
    """A posed image."""

    name: str  # of its file
    camera: int  # its camera's number
    pose: tuple[float, ...]  # world to camera: quaternion (wxyz), then translation


def is_colmap(path: Path) -> bool:
    """Return whether a folder holds a COLMAP model."""
    return any((path / f"images.{end}").is_file() for end in ("bin", "txt"))


def read_colmap_images(path: Path) -> tuple[dict[str, Camera], dict[str, str]]:
    """Return every posed image as a camera, and the image files by camera.

    World and unit are the model's own.

    Raises:
        CalibrationError: the model cannot be read, or has an unsupported camera model.
    """
    binary = (path / "images.bin").is_file()
    fix = "expected cameras and images as .bin or .txt: export it again"
    with refusing(CalibrationError, f"{path}: not a COLMAP model", fix):
        lenses, shots = _read_binary(path) if binary else _read_text(path)
    shots = sorted(shots)
    names = names_from_files([shot.name for shot in shots])
    if len(set(names)) < len(names):
        raise CalibrationError(
            f"{path}: several images share one camera name ({names[0]}, ...); expected one image"
            " per camera: export the model of a single time step"
        )
    cameras = []
    for name, shot in zip(names, shots, strict=True):
        lens, turn = lenses.get(shot.camera), np.array(shot.pose[:4])
        length = math.hypot(*turn)  # a damaged file's may be huge
        if lens is None or not (np.isfinite(shot.pose).all() and 0 < length < 1e6):
            raise CalibrationError(
                f"{path}: image {shot.name} has no pose or no camera; export it again"
            )
        pose = make_transform(quat_to_matrix(turn / length), np.array(shot.pose[4:]))
        cameras.append(Camera(name, lens.width, lens.height, lens.model, lens.params, pose))
    return as_rig(cameras, path), {n: s.name for n, s in zip(names, shots, strict=True)}


def _refuse(path: Path, model: str) -> CalibrationError:
    held = ", ".join(name for name, _ in HELD.values())
    return CalibrationError(
        f"{path}: a camera has model {model}; expected one of {held}: undistort with"
        " 'colmap image_undistorter' first"
    )


def _read_text(path: Path) -> tuple[dict[int, Lens], list[Shot]]:
    lenses, shots, counts = {}, [], dict(HELD.values())
    for line in read_text(path / "cameras.txt", CalibrationError, SIZE_LIMIT).split("\n"):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[1] not in counts:
            raise _refuse(path, words[1][:40])
        params = tuple(map(float, words[4:]))
        if len(params) != counts[words[1]]:
            raise ValueError(f"camera {words[0][:20]} has {len(params)} parameters")
        lenses[int(words[0])] = Lens(words[1], int(words[2]), int(words[3]), params)
    lines = iter(read_text(path / "images.txt", CalibrationError, SIZE_LIMIT).split("\n"))
    for line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        shots.append(Shot(words[9].strip(), int(words[8]), tuple(map(float, words[1:8]))))
        next(lines, None)  # its points
    return lenses, shots


def _read_binary(path: Path) -> tuple[dict[int, Lens], list[Shot]]:
    data = read_bytes(path / "cameras.bin", CalibrationError, SIZE_LIMIT)
    lenses, shots, place = {}, [], 8
    # A wrong count does no harm: unpacking past the end raises.
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, kind, width, height = struct.unpack_from("<IiQQ", data, place)
        if kind not in HELD:
            raise _refuse(path, f"number {kind}")
        model, count = HELD[kind]
        params = struct.unpack_from(f"<{count}d", data, place + 24)
        lenses[number] = Lens(model, width, height, params)
        place += 24 + 8 * count
    data, place = read_bytes(path / "images.bin", CalibrationError, SIZE_LIMIT), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *pose, camera = struct.unpack_from("<I7dI", data, place)
        end = data.index(b"\0", place + 64)
        shots.append(Shot(data[place + 64 : end].decode(), camera, tuple(pose)))
        place = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
        if place > len(data):
            raise ValueError(f"points of image {shots[-1].name} are missing")
    return lenses, shots


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
    if model not in LENSES:
        raise CalibrationError(
            f"{where}: camera_model {model}, expected one of {', '.join(LENSES)}; undistort first"
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
