"""Files of given landmarks, from any tool: .npz for many, .json by hand. See docs/FORMAT.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from express50.errors import FormatError
from express50.files.arrays import read_arrays
from express50.files.text import read_json
from express50.geometry.cameras import Camera, normalised

SCHEMA = "express50.landmarks/1"
NAMES = ("schema", "cameras", "frames", "points")
POINTS, IRISES = 68, 2
# Points may lie this share of the image outside of it: a chin below the frame is still a chin.
OUTSIDE = 0.5
Table = dict[tuple[str, int], np.ndarray]


def read_points(path: Path, cameras: Mapping[str, Camera]) -> Table:
    """Points by camera and frame, undistorted.

    Args:
        path: .npz or .json.
        cameras: as recorded, by id; cameras of the file that are not among them are left out.

    Returns:
        (68 or 70, 3) rows x, y in pixels of the undistorted image and confidence 0..1; x and y are
        NaN where a point is unknown.

    Raises:
        FormatError: another format, shape, an infinite number, a confidence out of range, or points
            far outside the image.
    """
    path = Path(path)
    try:
        raw = _read_npz(path) if path.suffix.lower() == ".npz" else _read_json(path)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise FormatError(
            f"{path}: no file of landmarks ({type(error).__name__}: {error}); expected the layout "
            "of docs/FORMAT.md"
        ) from error
    if not any(camera_id in cameras for camera_id, _ in raw):
        names = sorted({camera_id for camera_id, _ in raw})
        raise FormatError(
            f"{path}: is of cameras {', '.join(names[:6]) or 'none'}; expected some of "
            f"{', '.join(list(cameras)[:6])}"
        )
    return {
        key: _undistorted(cameras[key[0]], _checked(rows, cameras[key[0]], path, key))
        for key, rows in raw.items()
        if key[0] in cameras
    }


def _read_npz(path: Path) -> Table:
    data = read_arrays(path, FormatError, "a file of landmarks", NAMES)
    if str(data["schema"]) != SCHEMA:
        raise ValueError(f"schema is {data['schema']}, expected {SCHEMA}")
    cameras, frames = [str(name) for name in data["cameras"]], data["frames"].tolist()
    points = np.asarray(data["points"], dtype=np.float64)
    shape = (len(cameras), len(frames), points.shape[2] if points.ndim == 4 else POINTS, 2)
    if points.shape != shape:
        raise ValueError(f"points have shape {points.shape}, expected {shape}")
    sure = np.isfinite(points).all(-1).astype(np.float64)
    confidence = np.asarray(data.get("confidence", sure), dtype=np.float64)
    if confidence.shape != shape[:3]:
        raise ValueError(f"confidence has shape {confidence.shape}, expected {shape[:3]}")
    rows = np.concatenate([points, np.asarray(confidence)[..., None]], axis=-1)
    return {(c, int(f)): rows[i, j] for i, c in enumerate(cameras) for j, f in enumerate(frames)}


def _read_json(path: Path) -> Table:
    content = read_json(path, FormatError)
    if content.get("schema") != SCHEMA:
        raise ValueError(f"schema is {content.get('schema')!r}, expected {SCHEMA!r}")
    table: Table = {}
    for camera_id, frames in content["cameras"].items():
        for frame, points in frames.items():
            rows = [[np.nan, np.nan, 0.0] if p is None else [*p, 1.0][:3] for p in points]
            table[camera_id, int(frame)] = np.array(rows, dtype=np.float64)
    return table


def _checked(rows: np.ndarray, camera: Camera, path: Path, key: tuple[str, int]) -> np.ndarray:
    """The rows, if they can be used."""
    where = f"{path}: camera {key[0]}, frame {key[1]}"
    if rows.ndim != 2 or rows.shape[0] not in (POINTS, POINTS + IRISES) or rows.shape[1] != 3:
        raise FormatError(
            f"{where}: points have shape {rows.shape}, expected {POINTS} or {POINTS + IRISES} "
            "of x, y, confidence"
        )
    known = np.isfinite(rows[:, :2]).all(1)
    if np.isinf(rows).any() or not np.isfinite(rows[known, 2]).all():
        raise FormatError(
            f"{where}: holds infinite numbers or a confidence that is none; say NaN (null in JSON) "
            "for an unknown point"
        )
    if ((rows[known, 2] < 0) | (rows[known, 2] > 1)).any():
        raise FormatError(f"{where}: confidence is out of range, expected 0 to 1")
    size = np.array([camera.width, camera.height])
    far = (rows[known, :2] < -OUTSIDE * size) | (rows[known, :2] > (1 + OUTSIDE) * size)
    if far.any():
        worst = rows[known, :2][far.any(1)][0]
        raise FormatError(
            f"{where}: a point is at {worst[0]:.0f}, {worst[1]:.0f} of a {camera.width}x"
            f"{camera.height} image; expected pixels of the footage as recorded"
        )
    return rows


def _undistorted(camera: Camera, rows: np.ndarray) -> np.ndarray:
    """The rows with pixels of the undistorted image."""
    rows = rows.copy()
    known = np.isfinite(rows[:, :2]).all(1)
    rows[~known] = (np.nan, np.nan, 0.0)
    rows[known, :2] = (
        normalised(camera, rows[known, :2]) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    )
    return rows
