"""Read cameras of a COLMAP model (``cameras`` and ``images``, .bin or .txt) and nothing else.

COLMAP's own reader trusts the counts in a binary file and allocates memory for them. The layout is
documented in COLMAP's description of its output format.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from express50.errors import CalibrationError
from express50.files.text import read_bytes, read_text, refusing
from express50.geometry.cameras import Camera
from express50.geometry.transforms import make_transform, quat_to_matrix
from express50.rigs.camera_builder import as_rig, names_from_files

# COLMAP's models that our cameras share, by COLMAP's number: name and number of parameters.
HELD = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5),
        4: ("OPENCV", 8), 6: ("FULL_OPENCV", 12)}  # fmt: skip
SIZE_LIMIT = 1 << 30  # bytes per file; the images file holds every observed point


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
