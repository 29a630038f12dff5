"""Cameras of a COLMAP model: ``cameras``, ``images`` (and ``rigs``, ``frames``) as bin or txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from express50.cameras import Camera
from express50.errors import CalibrationError
from express50.rigs.build import checked, names_from_files

# COLMAP's models that our cameras have under the same name and order.
HELD = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


def is_colmap(path: Path) -> bool:
    """Whether a folder holds a COLMAP model."""
    return any((path / f"images.{end}").is_file() for end in ("bin", "txt"))


def read_colmap(path: Path) -> dict[str, Camera]:
    """Every posed image as a camera; its world and unit are the model's own.

    Raises:
        CalibrationError: the model cannot be read, or has a camera model that ours lack.
    """
    return read_colmap_images(path)[0]


def read_colmap_images(path: Path) -> tuple[dict[str, Camera], dict[str, str]]:
    """The cameras as `read_colmap` gives them, and the image file of each.

    Raises:
        CalibrationError: as there.
    """
    try:
        model = pycolmap.Reconstruction(str(path))
    except (ValueError, RuntimeError, OSError) as error:
        raise CalibrationError(
            f"{path}: COLMAP cannot read it ({str(error).strip().splitlines()[0]}); expected"
            " cameras and images as .bin or .txt"
        ) from None
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    names = names_from_files([image.name for image in images])
    if len(set(names)) < len(names):
        raise CalibrationError(
            f"{path}: several images share one camera name ({names[0]}, ...); expected one image a"
            " camera: export the model of a single time step"
        )
    cameras = {n: _camera(path, n, image) for n, image in zip(names, images, strict=True)}
    files = {name: image.name for name, image in zip(names, images, strict=True)}
    return checked(cameras, path), files


def _camera(path: Path, name: str, image: pycolmap.Image) -> Camera:
    camera = image.camera
    model = camera.model.name
    if model not in HELD:
        raise CalibrationError(
            f"{path}: image {image.name} has camera model {model}; expected one of"
            f" {', '.join(HELD)}: undistort with 'colmap image_undistorter' first"
        )
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    params = tuple(float(x) for x in camera.params)
    return Camera(name, int(camera.width), int(camera.height), model, params, pose)
