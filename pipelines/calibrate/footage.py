"""Footage for calibration: frames at a few instants, reduced, and hints about focal lengths."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import FrameReader
from express50.capture.index import Cue, Index
from express50.capture.raw import RawCamera, read_capture
from express50.errors import CalibrationError, CaptureError, FormatError
from express50.files.containers import read_picture
from express50.files.images import read_exif
from express50.files.video import iterate_video
from express50.geometry.cameras import Camera, resized
from express50.landmarks.network import load_network
from pipelines.calibrate.tracks import (
    Features,
    FrameSetPoints,
    find_face,
    find_features,
    without_fixed,
)

LONG_SIDE = 1280
"""Images are reduced to this long side, pixels, before points are searched in them."""
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)


def reduced_camera(camera: Camera) -> Camera:
    """Return the camera of an image with a long side of `LONG_SIDE` at most."""
    share = min(1.0, LONG_SIDE / max(camera.width, camera.height))
    size = round(camera.width * share), round(camera.height * share)
    return camera if share == 1.0 else resized(camera, *size)


def reduce_image(camera: Camera, image: np.ndarray, what: str) -> np.ndarray:
    """Reduce a camera's image (H, W, 3) to the size of `reduced_camera`; a reduced one passes.

    Reducing each image as it is read keeps a rig's full-size images out of memory.
    """
    small = reduced_camera(camera)
    shape = image.shape[:2]
    if shape == (small.height, small.width):
        return image
    if shape != (camera.height, camera.width):
        raise CalibrationError(
            f"camera {camera.id}: {what} is {shape[1]}x{shape[0]}, the "
            f"camera is {camera.width}x{camera.height}; scale the intrinsics"
        )
    return cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)


def read_footage(
    index: Index, cameras: Mapping[str, Camera], frames: int
) -> Iterator[tuple[int, str, np.ndarray]]:
    """Yield frame number, camera and reduced image (H, W, 3) at so many instants, one by one."""
    cues = [cue for cue in index.cues if cue.end_frame < index.frames]
    wanted = sorted(set(_middles(cues, frames))) or _spread(range(index.frames), frames)
    for name in sorted(cameras):
        reader = FrameReader(index, name)
        for frame in wanted:
            yield frame, name, reduce_image(cameras[name], reader.read(frame), f"frame {frame}")
        reader.close()


def find_footage_points(
    index: Index, cameras: Mapping[str, Camera], frames: int
) -> dict[int, FrameSetPoints]:
    """Find landmarks and features at so many instants, in pixels of `reduced_camera`."""
    net = load_network()
    faces: dict[int, list[tuple[str, np.ndarray, np.ndarray]]] = {}
    features: dict[int, dict[str, Features]] = {}
    for frame, name, image in read_footage(index, cameras, frames):
        face = find_face(image, net)
        faces.setdefault(frame, []).extend([(name, *face)] if face else [])
        features.setdefault(frame, {})[name] = find_features(image)
    return {
        frame: FrameSetPoints(faces[frame], without_fixed(features[frame]))
        for frame in sorted(faces)
    }


def read_capture_frames(
    root: Path, count: int, reduce: Callable[[str, np.ndarray], np.ndarray | None]
) -> dict[int, dict[str, np.ndarray]]:
    """Read images (H, W, 3) uint8 of a raw capture at up to `count` instants, by frame number.

    The instants are the middles of cues, or spread over the images where there are no cues; of a
    video without cues only the first frame is read, as its length is unknown. Each image is kept
    as `reduce(camera, image)` returns it, and left out where that is None.

    Raises:
        CaptureError: the capture is unusable, or a camera has no such frame.
    """
    capture = read_capture(root)
    lengths = [len(camera.names) for camera in capture.cameras.values() if camera.names]
    wanted = _middles(capture.cues, count) or _spread(range(min(lengths, default=1)), count)
    found: dict[int, dict[str, np.ndarray]] = {frame: {} for frame in wanted}
    for name, camera in sorted(capture.cameras.items()):
        for frame, image in _read_raw(camera, wanted):
            kept = reduce(name, image)
            if kept is not None:
                found[frame][name] = kept
    return found


def _middles(cues: Iterable[Cue], count: int) -> list[int]:
    """Middle frames of up to `count` cues, evenly chosen."""
    return _spread(sorted((cue.start_frame + cue.end_frame) // 2 for cue in cues), count)


def _spread(frames: Sequence[int], count: int) -> list[int]:
    """Choose up to `count` frames, evenly."""
    picks = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [frames[i] for i in picks]


def _read_raw(camera: RawCamera, wanted: list[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Yield wanted frames one by one, so that only one full-size image is held."""
    if camera.kind == "frames":
        length = len(camera.names)
        if max(wanted) < length:
            for frame in wanted:
                yield frame, read_picture(camera.path, camera.names[frame], camera.orientation)
            return
    else:
        for length, (_, image) in enumerate(iterate_video(camera.path), 1):
            if length - 1 in wanted:
                yield length - 1, image
            if length > max(wanted):
                return
    missing = min(frame for frame in wanted if frame >= length)
    raise CaptureError(f"{camera.path}: has {length} frames, frame {missing} was expected")


def known_focals(index: Index) -> dict[str, float]:
    """Return the focal lengths, pixels of the footage, from capture.toml or the images' EXIF.

    `focal_px` in capture.toml is a number, or a table by camera. EXIF gives the focal length on
    35 mm film (36 x 24 mm) that has the same diagonal angle of view.

    Raises:
        CalibrationError: `focal_px` is not a positive number.
    """
    given = index.meta.get("focal_px", {})
    table = given if isinstance(given, dict) else dict.fromkeys(index.cameras, given)
    found = {}
    for name, source in index.cameras.items():
        if name in table:
            value = table[name]
            usable = isinstance(value, int | float) and not isinstance(value, bool)
            if not (usable and math.isfinite(value) and value > 0):
                raise CalibrationError(
                    f"{index.capture / 'capture.toml'}: focal_px of {name} is {value!r}, expected a"
                    " positive number of pixels"
                )
            found[name] = float(value)
        elif source.kind == "frames":
            film = film_focal_mm(index.capture / source.source / source.names[0])
            if film > 0:
                diagonal = math.hypot(source.width, source.height)
                found[name] = film / FILM_DIAGONAL_MM * diagonal
    return found


def film_focal_mm(path: Path) -> float:
    """Read the 35 mm equivalent focal length from an image's EXIF, 0 where there is none."""
    try:
        return read_exif(path)[1]
    except FormatError:  # a member of a container
        return 0.0
