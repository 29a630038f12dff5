"""Cameras in OpenCV's YAML: one file a camera, or EasyMocap's pair ``intri.yml``, ``extri.yml``.

OpenCV puts the pixel origin at the first pixel's centre; K is shifted by the adapters.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from express50.errors import CalibrationError
from express50.files.text import TOML_LIMIT, read_text, reason
from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_from_opencv
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.rigs.camera_builder import camera_from_K, checked

# Names in use: OpenCV's calibration sample, its stereo sample, ROS, and hand-written files.
_K = ("camera_matrix", "cameraMatrix", "K", "M", "intrinsics")
_DIST = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "dist", "D")
_ROTATION = ("R", "rotation", "rvec", "Rot")
_TRANSLATION = ("T", "t", "tvec", "translation")
_SIZES = (("image_width", "image_height"), ("width", "height"), ("W", "H"))
YAML = (".yml", ".yaml")
LEVELS, ENTRIES = 16, 64  # of nesting, and in a matrix


def is_opencv_yaml(path: Path) -> bool:
    """Whether a path is a folder of YAML files, or one."""
    if path.is_dir():
        return any(p.suffix in YAML for p in path.iterdir())
    return path.suffix in YAML


def read_opencv_yaml(path: Path, size: tuple[int, int] | None) -> dict[str, Camera]:
    """Cameras of a folder of ``<camera>.yml`` files or of an EasyMocap pair.

    Args:
        path: the folder, or one of EasyMocap's two files.
        size: width and height of the images where the files do not say.

    Raises:
        CalibrationError: a matrix is missing or has the wrong shape, or no size is known.
    """
    folder = path if path.is_dir() else path.parent
    if (folder / "intri.yml").is_file():
        with _damage(folder / "intri.yml"):
            found = _read_easymocap(folder, size)
        return checked(found, folder)
    files = sorted(p for p in folder.iterdir() if p.suffix in YAML) if path.is_dir() else [path]
    return checked({f.stem: _read_one(f, size) for f in files}, path)


def _open(path: Path) -> cv2.FileStorage:
    _check_text(path)
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise CalibrationError(f"{path}: OpenCV cannot read it ({_words(error)})") from None
    if not storage.isOpened():
        raise CalibrationError(f"{path}: OpenCV cannot read it; expected its YAML 1.0 format")
    return storage


def _check_text(path: Path) -> None:
    """Refuse what OpenCV's parser, which calls itself for each level, would fall over."""
    text = read_text(path, CalibrationError, TOML_LIMIT)
    if not text.startswith("%YAML"):
        raise CalibrationError(f"{path}: does not begin with %YAML; expected OpenCV's YAML 1.0")
    level = 0
    for line in text.split("\n"):
        lead = len(line) - len(line.lstrip(" -\t"))
        level = max(0, level + line.count("[") + line.count("{"))
        if level > LEVELS or lead > 4 * LEVELS:
            raise CalibrationError(f"{path}: is nested over {LEVELS} deep, expected matrices")
        level = max(0, level - line.count("]") - line.count("}"))


def _words(error: BaseException) -> str:
    return getattr(error, "err", "") or reason(error)


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """OpenCV looks at a value only when it is asked for it."""
    try:
        yield
    except (cv2.error, SystemError, ValueError, OverflowError, TypeError) as error:
        raise CalibrationError(
            f"{path}: a value is not of its kind ({_words(error)}); write it again"
        ) from None


def _read_one(path: Path, size: tuple[int, int] | None) -> Camera:
    storage = _open(path)
    with _damage(path):
        K = _matrix(storage, _K, path)
        dist = _matrix(storage, _DIST, path, optional=True)
        pose = _pose(storage, path, _ROTATION, _TRANSLATION)
        size = _size(storage, path, size)
        return camera_from_K(path.stem, K_from_opencv(K), dist.ravel(), size, pose)


def _read_easymocap(folder: Path, size: tuple[int, int] | None) -> dict[str, Camera]:
    intrinsics, extrinsics = _open(folder / "intri.yml"), _open(folder / "extri.yml")
    listed = intrinsics.getNode("names")
    names = [listed.at(i).string() for i in range(listed.size())]
    found = {}
    for name in names:
        K = _matrix(intrinsics, (f"K_{name}",), folder / "intri.yml")
        dist = _matrix(intrinsics, (f"dist_{name}", f"D_{name}"), folder, optional=True)
        where = folder / "extri.yml"
        pose = _pose(extrinsics, where, (f"Rot_{name}", f"R_{name}"), (f"T_{name}",))
        own = [intrinsics.getNode(f"{side}_{name}") for side in "WH"]
        known = None if any(n.empty() for n in own) else tuple(int(n.real()) for n in own)
        found[name] = camera_from_K(
            name, K_from_opencv(K), dist.ravel(), _known(known or size, folder / "intri.yml"), pose
        )
    return found


def _matrix(
    storage: cv2.FileStorage, keys: tuple[str, ...], path: Path, optional: bool = False
) -> np.ndarray:
    """The first of the named matrices that is there; a 3 x 3 one unless it is optional."""
    for key in keys:
        node = storage.getNode(key)
        if node.empty():
            continue
        if node.isMap():  # OpenCV would make a matrix of any size, and then see what is there
            rows, columns = (int(node.getNode(side).real()) for side in ("rows", "cols"))
            count = node.getNode("data").size()
            if not 0 < rows * columns <= ENTRIES or rows * columns != count:
                raise CalibrationError(f"{path}: {key} is {rows} x {columns} with {count} numbers")
            value = node.mat()
        else:
            value = _numbers(path, key, node)
        if optional or value.shape == (3, 3):
            return np.asarray(value, dtype=np.float64)
        raise CalibrationError(f"{path}: {key} has shape {value.shape}, expected (3, 3)")
    if optional:
        return np.zeros(0)
    raise CalibrationError(f"{path}: has none of {', '.join(keys)}; expected a 3 x 3 matrix")


def _numbers(path: Path, key: str, node: cv2.FileNode) -> np.ndarray:
    """A list of numbers, or a list of rows of them."""
    entries = [node.at(i) for i in range(min(node.size(), ENTRIES))]
    if not any(entry.isSeq() for entry in entries):
        return np.array([entry.real() for entry in entries])
    if len({entry.size() if entry.isSeq() else -1 for entry in entries}) != 1:
        raise CalibrationError(f"{path}: {key} has rows of several lengths, expected a matrix")
    width = min(entries[0].size(), ENTRIES)
    return np.array([[entry.at(i).real() for i in range(width)] for entry in entries])


def _pose(
    storage: cv2.FileStorage, path: Path, rotation: tuple[str, ...], translation: tuple[str, ...]
) -> np.ndarray:
    """World to camera (4, 4); a rotation is a matrix or Rodrigues' vector."""
    R = _matrix(storage, rotation, path, optional=True)
    t = _matrix(storage, translation, path, optional=True)
    if R.size == 3:
        R = axis_angle_to_matrix(R.ravel())
    if R.shape != (3, 3) or t.size != 3:
        raise CalibrationError(
            f"{path}: no pose; expected {' or '.join(rotation)} (3 x 3 or a Rodrigues vector) and"
            f" {' or '.join(translation)} (3), world to camera"
        )
    return make_transform(R, t.ravel())


def _size(storage: cv2.FileStorage, path: Path, size: tuple[int, int] | None) -> tuple[int, int]:
    for keys in _SIZES:
        nodes = [storage.getNode(key) for key in keys]
        if not any(node.empty() for node in nodes):
            return int(nodes[0].real()), int(nodes[1].real())
    return _known(size, path)


def _known(size: tuple[int, ...] | None, path: Path) -> tuple[int, int]:
    if size is None:
        raise CalibrationError(f"{path}: does not say the images' size; give --size WIDTHxHEIGHT")
    return size[0], size[1]
