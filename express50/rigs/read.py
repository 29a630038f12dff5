"""Read a rig in any known format, at the footage's size, in metres.

Most formats have modules of their own. OpenCV's YAML is read here, a file per camera or EasyMocap's
two files; its pixel origin is the first pixel's centre, so K is shifted.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from express50.errors import CalibrationError, advised
from express50.files.calibration import read_cameras
from express50.files.text import identifier, read_json, read_yaml, refusing
from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_from_opencv
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.rigs.camera_builder import (
    NO_SIZE,
    as_rig,
    at_size,
    camera_from_K,
    holds,
    in_metres,
    size_from,
)
from express50.rigs.other_tools import (
    read_calibration_toml,
    read_facescape,
    read_idr,
    read_kalibr,
    read_metashape,
    read_nersemble,
    read_panoptic,
    read_qualisys,
    read_reality_capture,
    read_renderme,
    read_vggt,
)
from express50.rigs.per_picture import is_colmap, is_transforms, read_colmap_images, read_transforms

# Names in use: OpenCV's calibration sample, its stereo sample, ROS, and hand-written files.
_K = ("camera_matrix", "cameraMatrix", "K", "M", "intrinsics")
_DIST = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "dist", "D")
_ROTATION = ("R", "rotation", "rvec", "Rot")
_TRANSLATION = ("T", "t", "tvec", "translation")
_SIZES = (("image_width", "image_height"), ("width", "height"), ("W", "H"))
YAML = (".yml", ".yaml")


class RigFormat(NamedTuple):
    """A format's title, test and reader."""

    title: str
    fits: Callable[[Path], bool]
    read: Callable[..., dict[str, Camera]]
    sized: bool = False  # whether the reader also takes the footage's size, or None


def _file(*ends: str, word: str = "") -> Callable[[Path], bool]:
    """Return a test for a file with one of the endings that holds a word."""
    return lambda path: path.is_file() and path.suffix in ends and (not word or holds(path, word))


def _files(*ends: str) -> Callable[[Path], bool]:
    """Return a test for a file with one of the endings, or a folder with such a file."""
    return lambda path: any(
        file.suffix in ends for file in (path.iterdir() if path.is_dir() else [path])
    )


# In the order in which they are tried.
FORMATS = {
    "renderme360": RigFormat("an .smc", _file(".smc"), read_renderme),
    "nersemble": RigFormat(
        "NeRSemble's camera_params.json", _file(".json", word='"world_2_cam"'), read_nersemble
    ),
    "colmap": RigFormat("a COLMAP model", is_colmap, lambda path: read_colmap_images(path)[0]),
    "transforms": RigFormat("transforms.json", is_transforms, read_transforms, sized=True),
    "toml": RigFormat(
        "caliscope's or aniposelib's TOML",
        _file(".toml", word="distortions"),
        read_calibration_toml,
    ),
    "kalibr": RigFormat("Kalibr's camchain", _file(*YAML, word="camera_model"), read_kalibr),
    "qualisys": RigFormat(
        "Qualisys' .qca.txt", _file(".txt", ".xml", word="focalLengthU"), read_qualisys
    ),
    "metashape": RigFormat("Metashape's XML", _file(".xml", word="<chunk"), read_metashape),
    "realitycapture": RigFormat(
        "RealityCapture's .xmp files", _files(".xmp"), read_reality_capture, sized=True
    ),
    "idr": RigFormat(
        "IDR's or NeuS' .npz", _file(".npz", word="world_mat_0"), read_idr, sized=True
    ),
    "facescape": RigFormat(
        "FaceScape's params.json", _file(".json", word='"0_Rt"'), read_facescape
    ),
    "panoptic": RigFormat(
        "Panoptic Studio's .json", _file(".json", word='"distCoef"'), read_panoptic
    ),
    "vggt": RigFormat("VGGT's .npz", _file(".npz"), read_vggt, sized=True),
    "opencv": RigFormat(
        "OpenCV YAML", _files(*YAML), lambda *given: read_opencv_yaml(*given), sized=True
    ),
    "express50": RigFormat(
        "our calibration.json",
        lambda path: path.is_file() and holds(path, '"world_to_camera"'),
        read_cameras,
    ),
}


def guess_format(path: Path) -> str:
    """Return the format of a file or folder; CalibrationError if none fits."""
    if not path.exists():
        raise CalibrationError(f"{path}: no such file or folder; expected a calibration")
    found = next((name for name, known in FORMATS.items() if known.fits(path)), None)
    if found is None:
        if path.suffix == ".json":
            read_json(path, CalibrationError)  # reports what is wrong if it is not JSON
        if (path / "calibration.json").is_file():
            raise CalibrationError(f"{path}: a capture; give its calibration.json")
        titles = [known.title for known in FORMATS.values()]
        raise CalibrationError(
            f"{path}: is not a known calibration; expected {', '.join(titles[:-1])} or"
            f" {titles[-1]}; {advised('express50 cameras check', path, '--format NAME')} says why"
            " it is not one"
        )
    return found


def read_rig(
    path: Path,
    kind: str | None = None,
    size: tuple[int, int] | None = None,
    metres_per_unit: float = 1.0,
) -> dict[str, Camera]:
    """Read the cameras of a calibration file or folder that another tool wrote.

    ``kind`` is one of FORMATS, or None to detect it; K is scaled to ``size``, the footage's width
    and height; the file's unit is ``metres_per_unit`` long.

    Raises:
        CalibrationError: no format fits, or the content does not fit the format.
    """
    known = FORMATS[kind or guess_format(path)]
    found = known.read(path, size) if known.sized else known.read(path)
    if size is not None:
        found = {name: at_size(camera, size) for name, camera in found.items()}
    return in_metres(found, metres_per_unit)


def read_opencv_yaml(path: Path, size: tuple[int, int] | None) -> dict[str, Camera]:
    """Read the cameras of a folder of ``<camera>.yml`` files, of one such file, or of EasyMocap.

    ``size`` is the width and height of the images, used if the files do not give them.

    Raises:
        CalibrationError: a matrix is missing or has the wrong shape, or no size is known.
    """
    found = []
    for name, where, table in _opencv_cameras(path):
        K, dist = _matrix(table, _K, where), _matrix(table, _DIST, where)
        R, t = _matrix(table, _ROTATION, where), _matrix(table, _TRANSLATION, where)
        if K.shape != (3, 3):
            raise CalibrationError(f"{where}: expected a 3 x 3 matrix called {' or '.join(_K)}")
        if R.size == 3:
            R = axis_angle_to_matrix(R.ravel())
        if R.shape != (3, 3) or t.size != 3:
            raise CalibrationError(
                f"{where}: no pose; expected {' or '.join(_ROTATION)} (3 x 3 or a Rodrigues vector)"
                f" and {' or '.join(_TRANSLATION)} (3), world to camera"
            )
        pair = next((pair for pair in _SIZES if table.keys() >= {*pair}), None)
        shape = size
        if pair is not None:
            shape = size_from([table[side] for side in pair], f"{where} has {' and '.join(pair)}")
        if shape is None:
            raise CalibrationError(f"{where}: {NO_SIZE}")
        pose = make_transform(R, t.ravel())
        found.append(camera_from_K(name, K_from_opencv(K), dist, shape, pose))
    return as_rig(found, path)


def _opencv_cameras(path: Path) -> list[tuple[str, Path | str, dict]]:
    """Return name, place and values of each camera.

    EasyMocap has all cameras in ``intri.yml`` and ``extri.yml``, where values are named ``K_01``,
    ``dist_01``, ``R_01``, ``Rot_01``, ``T_01``, after the camera. Others have a file per camera.
    """
    folder = path if path.is_dir() else path.parent
    both = [folder / "intri.yml", folder / "extri.yml"]
    files = both if path in (folder, *both) and all(file.is_file() for file in both) else []
    values = {key: value for file in files for key, value in _named_values(file).items()}
    found: list[tuple[str, Path | str, dict]] = []
    for camera in (key.removeprefix("K_") for key in values if key.startswith("K_")):
        end = f"_{camera}"
        own = {key.removesuffix(end): value for key, value in values.items() if key.endswith(end)}
        found.append((identifier(camera), f"{folder}: camera {camera}", own))
    if found:
        return found
    files = sorted(p for p in path.iterdir() if p.suffix in YAML) if path.is_dir() else [path]
    if not files:
        raise CalibrationError(f"{path}: holds no {' or '.join(YAML)} file; name OpenCV's folder")
    return [(identifier(file.stem), file, _named_values(file)) for file in files]


def _named_values(path: Path) -> dict:
    table = read_yaml(path, CalibrationError)
    if not isinstance(table, dict):
        raise CalibrationError(f"{path}: holds no named values, expected OpenCV's matrices")
    return table


def _matrix(table: dict, keys: tuple[str, ...], path: Path | str) -> np.ndarray:
    """Read the first matrix found, as rows of numbers or in OpenCV's form; empty if none is."""
    name = next((key for key in keys if key in table), "")
    value = table.get(name, [])
    with refusing(CalibrationError, f"{path}: {name} cannot be read as a matrix"):
        if isinstance(value, dict):
            numbers = np.array(value["data"], np.float64)
            return numbers.reshape(int(value["rows"]), int(value["cols"]))
        return np.array(value, np.float64)
