"""What the stage takes from footage: frames at some moments, and what tells of the lenses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from express50.capture.frames import FrameReader
from express50.capture.index import Index
from express50.errors import CalibrationError, FormatError
from express50.files.images import read_exif
from express50.geometry.cameras import Camera
from express50.landmarks.network import load_network
from pipelines.calibrate.camera_moves import reduce_image
from pipelines.calibrate.features import Features, find_features, without_fixed
from pipelines.calibrate.sampling import spread, spread_moments
from pipelines.calibrate.tracks import Seen, find_face

FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)


def read_footage(
    index: Index, names: Iterable[str], moments: int
) -> Iterator[tuple[int, str, np.ndarray]]:
    """Frame, camera and image (H, W, 3) at so many moments, spread over the cues, one by one."""
    cues = [cue for cue in index.cues if cue.end_frame < index.frames]
    wanted = sorted(set(spread_moments(cues, moments)))
    wanted = wanted or spread(range(index.frames), moments)
    for name in names:
        reader = FrameReader(index, name)
        for frame in wanted:
            yield frame, name, reader.read(frame)
        reader.close()


def see_footage(index: Index, cameras: Mapping[str, Camera], moments: int) -> dict[int, Seen]:
    """Landmarks and features of the cameras at so many moments, in recorded pixels.

    Images are reduced as for the look at moved cameras: pixels are those of `reduced_camera`. One
    image is held at a time.
    """
    net = load_network()
    faces: dict[int, list[tuple[str, np.ndarray, np.ndarray]]] = {}
    features: dict[int, dict[str, Features]] = {}
    for frame, name, image in read_footage(index, sorted(cameras), moments):
        small = reduce_image(cameras[name], image, f"frame {frame}")
        face = find_face(small, net)
        faces.setdefault(frame, []).extend([(name, *face)] if face else [])
        features.setdefault(frame, {})[name] = find_features(small)
    return {frame: Seen(faces[frame], without_fixed(features[frame])) for frame in sorted(faces)}


def told_focals(index: Index) -> dict[str, float]:
    """Focal lengths, pixels of the footage, that capture.toml or the images' EXIF tell.

    `focal_px` of capture.toml is a number, or a table by camera; EXIF's focal length is that of 35
    mm film (36 x 24 mm) with the same diagonal angle of view.

    Raises:
        CalibrationError: `focal_px` is no positive number.
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
            film = _film_focal(index.capture / source.source / source.names[0])
            if film > 0:
                diagonal = math.hypot(source.width, source.height)
                found[name] = film / FILM_DIAGONAL_MM * diagonal
    return found


def _film_focal(path: Path) -> float:
    """The 35 mm equivalent focal length in an image's EXIF, 0 where there is none."""
    try:
        return read_exif(path)[1]
    except FormatError:  # a container's member
        return 0.0
