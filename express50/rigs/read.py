"""Read a rig in any known format, at the footage's size, in metres."""

from __future__ import annotations

from pathlib import Path

from express50.errors import CalibrationError
from express50.files.calibration import read_cameras
from express50.geometry.cameras import Camera
from express50.rigs.camera_builder import at_size, holds, in_metres
from express50.rigs.colmap import is_colmap, read_colmap
from express50.rigs.dataset_formats import is_nersemble, is_renderme, read_nersemble, read_renderme
from express50.rigs.opencv_yaml import is_opencv_yaml, read_opencv_yaml
from express50.rigs.transforms_json import is_transforms, read_transforms

FORMATS = ("express50", "colmap", "opencv", "transforms", "nersemble", "renderme360")


def guess_format(path: Path) -> str:
    """The format of a file or folder.

    Raises:
        CalibrationError: it does not exist or fits none.
    """
    if not path.exists():
        raise CalibrationError(f"{path}: does not exist")
    tests = {
        "renderme360": is_renderme,
        "nersemble": is_nersemble,
        "colmap": is_colmap,
        "transforms": is_transforms,
        "opencv": is_opencv_yaml,
        "express50": lambda p: p.is_file() and holds(p, '"world_to_camera"'),
    }
    found = next((name for name, fits in tests.items() if fits(path)), None)
    if found is None:
        raise CalibrationError(
            f"{path}: no known calibration; expected a COLMAP model, OpenCV YAML, transforms.json,"
            " NeRSemble's camera_params.json, an .smc or our calibration.json: name --format"
        )
    return found


def read_rig(
    path: Path,
    kind: str | None = None,
    size: tuple[int, int] | None = None,
    metres_per_unit: float = 1.0,
) -> dict[str, Camera]:
    """Cameras of a calibration that another tool wrote.

    Args:
        path: file or folder.
        kind: one of FORMATS; None guesses.
        size: width and height of the footage; K is scaled to it.
        metres_per_unit: what one unit of the file's world is, metres.

    Raises:
        CalibrationError: the format is unknown or the content does not fit it.
    """
    kind = kind or guess_format(path)
    if kind == "opencv":
        found = read_opencv_yaml(path, size)
    elif kind == "transforms":
        found = read_transforms(path, size)
    else:
        readers = {
            "express50": read_cameras,
            "colmap": read_colmap,
            "nersemble": read_nersemble,
            "renderme360": read_renderme,
        }
        if kind not in readers:
            raise CalibrationError(f"format {kind!r}, expected one of {', '.join(FORMATS)}")
        found = readers[kind](path)
    return in_metres(at_size(found, size), metres_per_unit)
