"""Build cameras for every importer from K and distortion, names, sizes and scale."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from express50.errors import CalibrationError
from express50.files.calibration import camera_rows, finite_array, parse_cameras
from express50.files.text import identifier, read_bytes
from express50.geometry.cameras import Camera, resized

# Stages and 'express50 import' read rigs too, and have no such option.
NO_SIZE = "does not give the images' size; pass --size WIDTHxHEIGHT to 'express50 cameras'"


def camera_from_K(
    camera_id: str,
    K: np.ndarray,
    dist: Sequence[float] | np.ndarray,
    size: tuple[int, int],
    cam_from_world: np.ndarray,
) -> Camera:
    """Return a camera of the smallest COLMAP model that holds the distortion.

    `K` (3, 3) has pixels with a corner origin; `dist` has OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6,
    and missing terms are 0; `size` is width and height; `cam_from_world` (4, 4) has OpenCV axes.

    Raises:
        CalibrationError: K has skew, or no model holds the distortion (thin prism, tilt).
    """
    K, d = np.asarray(K, dtype=np.float64), np.zeros(14)
    given = np.asarray(dist, dtype=np.float64).ravel()
    if given.size > d.size:
        raise CalibrationError(
            f"camera {camera_id}: has {given.size} distortion terms, expected at most 14"
        )
    d[: given.size] = given
    if K.shape != (3, 3) or abs(K[0, 1]) > 1e-3 * abs(K[0, 0]) or d[8:].any():
        raise CalibrationError(
            f"camera {camera_id}: K {K.tolist()} or distortion {d.tolist()} is beyond COLMAP's"
            " FULL_OPENCV model; expected no skew and at most k1 k2 p1 p2 k3 k4 k5 k6: calibrate"
            " again without thin-prism and tilted models"
        )
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    model, count = "PINHOLE", 0
    if d.any():
        model, count = ("OPENCV", 4) if not d[4:].any() else ("FULL_OPENCV", 8)
    numbers = tuple(float(x) for x in [*params, *d[:count]])
    pose = np.asarray(cam_from_world, dtype=np.float64)
    return Camera(camera_id, int(size[0]), int(size[1]), model, numbers, pose)


def size_from(value: object, what: str) -> tuple[int, int]:
    """Return width and height of pictures, pixels, that a file states.

    Raises:
        CalibrationError: they are not two numbers; the message begins with ``what``.
    """
    width, height = finite_array(value, (2,), what)
    return int(width), int(height)


def names_from_files(files: Sequence[str]) -> list[str]:
    """Name cameras after image files: by folder if each folder holds one file, otherwise by stem.

    ``cam00/000000.jpg, cam01/000000.jpg`` gives ``cam00, cam01``; ``x/a.jpg, x/b.jpg`` gives
    ``a, b``.
    """
    paths = [Path(f) for f in files]
    folders = [path.parent.name for path in paths]
    if all(folders) and len(set(folders)) == len(files) > 1:
        names = folders
    elif len({path.parent for path in paths}) == 1:
        names = [path.stem for path in paths]
    else:
        names = [path.with_suffix("").as_posix() for path in paths]
    return [identifier(name) for name in names]


def at_size(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera with K scaled to the footage's size (width, height).

    Raises:
        CalibrationError: the aspect ratio differs, so the images were cropped, not scaled.
    """
    sx, sy = size[0] / camera.width, size[1] / camera.height
    if abs(sx / sy - 1) > 0.01:
        raise CalibrationError(
            f"camera {camera.id}: calibrated at {camera.width}x{camera.height}, but the footage is"
            f" {size[0]}x{size[1]}; expected the same aspect ratio: was the footage cropped or"
            " rotated?"
        )
    return resized(camera, *size)


def in_metres(cameras: dict[str, Camera], metres_per_unit: float) -> dict[str, Camera]:
    """Return cameras with positions in metres; CalibrationError unless the factor is positive."""
    if not (np.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise CalibrationError(f"scale {metres_per_unit} m per unit; expected a positive number")
    found = {}
    for name, camera in cameras.items():
        pose = camera.cam_from_world.copy()
        pose[:3, 3] *= metres_per_unit
        found[name] = replace(camera, cam_from_world=pose)
    return found


def as_rig(cameras: Iterable[Camera], path: Path) -> dict[str, Camera]:
    """Return the cameras of a file by name, after the checks that our own file must pass.

    Raises:
        CalibrationError: there are no cameras, two share a name, or one has an invalid rotation,
            focal length or number.
    """
    found: dict[str, Camera] = {}
    for camera in cameras:
        if found.setdefault(camera.id, camera) is not camera:
            raise CalibrationError(
                f"{path}: two cameras are called {camera.id}; give each its own name"
            )
    return parse_cameras(camera_rows(found), str(path))


def holds(path: Path, word: str) -> bool:
    """Return whether a file contains a word; CalibrationError if it cannot be read."""
    return word.encode() in read_bytes(path, CalibrationError)
