"""Read footage for calibration: frames at a few instants, and the points seen in them.

Landmarks tie any two cameras that see the face, to a few pixels. Features (SIFT, on skin, hair,
cloth and room) tie neighbouring cameras, to a fraction of a pixel. Images are reduced as they are
read, one at a time, which keeps a rig's full-size images out of memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial import cKDTree

from express50.capture.frames import FrameReader
from express50.capture.index import Cue, Index
from express50.capture.raw import RawCamera, check_focals
from express50.capture.readers.read import read_any
from express50.errors import CalibrationError, CaptureError, FormatError
from express50.files.containers import inside, read_picture
from express50.files.images import read_exif, upright
from express50.files.video import iterate_video
from express50.geometry.cameras import Camera, resized
from express50.geometry.conventions import opencv_pixels_to_corner
from express50.geometry.sampling import evenly
from pipelines.calibrate.config import LONG_SIDE
from pipelines.calibrate.tracks import FEATURE_SIGMA_PX, Features, FrameSetPoints

if TYPE_CHECKING:
    from express50.landmarks.detector import Detection

FEATURES = 4000  # kept per image, strongest first
FACE_SCORE = 0.4  # profiles have no more; their landmarks come with a large sigma
LANDMARK_INFLATION = 3.0  # of sigma, as errors within a view are correlated

Images = Iterable[tuple[int, str, np.ndarray]]
"""Frame number, camera and reduced image (H, W, 3) uint8, one by one."""


def reduced_camera(camera: Camera) -> Camera:
    """Return the camera of an image with a long side of `LONG_SIDE` at most."""
    share = min(1.0, LONG_SIDE / max(camera.width, camera.height))
    return resized(camera, round(camera.width * share), round(camera.height * share))


def at_footage_size(small: Camera, camera: Camera) -> Camera:
    """Return a reduced camera at the size of the footage, that of `camera`."""
    return resized(small, camera.width, camera.height)


def _reduced(camera: Camera, image: np.ndarray, frame: int) -> np.ndarray:
    small, shape = reduced_camera(camera), image.shape[:2]
    if shape != (camera.height, camera.width):
        raise CalibrationError(
            f"camera {camera.id}: frame {frame} is {shape[1]}x{shape[0]}, the "
            f"camera is {camera.width}x{camera.height}; scale the intrinsics"
        )
    return cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)


def instants(index: Index, camera: str, count: int) -> list[int]:
    """Choose up to `count` frames of ingested footage.

    They are the middles of cues, or spread over all frames where there are no cues. If a camera has
    a key frame earlier in the cue, that is taken instead. In 4K footage with one key frame per
    second, it is read in a tenth of the time.
    """
    cues = [cue for cue in index.cues if cue.end_frame < index.frames]
    spread = evenly(range(index.frames), count)
    starts = _middles(cues, count) or dict(zip(spread, [0, *(f + 1 for f in spread)], strict=False))
    with closing(FrameReader(index, camera)) as reader:
        keys = {frame: reader.key_frame(frame) for frame in starts}
    return sorted({key if key >= starts[frame] else frame for frame, key in keys.items()})


def read_footage(index: Index, cameras: Mapping[str, Camera], count: int) -> Images:
    """Yield reduced images of ingested footage at up to `count` instants, see `instants`."""
    wanted: list[int] = []
    for name in sorted(cameras):
        wanted = wanted or instants(index, name, count)
        with closing(FrameReader(index, name)) as reader:
            for frame in wanted:
                yield frame, name, _reduced(cameras[name], reader.read(frame), frame)


def read_raw_footage(root: Path, cameras: Mapping[str, Camera], count: int) -> Images:
    """Yield reduced images of a capture of any layout at up to `count` instants.

    These are the middles of cues, or spread over all frames where there are no cues. Only the first
    frame of a video without cues is read, because its length is unknown.

    Raises:
        CaptureError: the capture is unusable, or a camera has no such frame.
    """
    capture = read_any(root)
    lengths = [len(one.names) for one in capture.cameras.values() if one.kind == "frames"]
    wanted = sorted(_middles(capture.cues, count)) or evenly(range(min(lengths, default=1)), count)
    for name in sorted(set(capture.cameras) & set(cameras)):
        for frame, image in _read_raw(capture.cameras[name], wanted):
            yield frame, name, _reduced(cameras[name], image, frame)


def _middles(cues: Iterable[Cue], count: int) -> dict[int, int]:
    """Return the middle frames of up to `count` cues, evenly chosen, each with its cue's start."""
    middles = sorted(((cue.start_frame + cue.end_frame) // 2, cue.start_frame) for cue in cues)
    return dict(evenly(middles, count))


def _read_raw(camera: RawCamera, wanted: list[int]) -> Iterator[tuple[int, np.ndarray]]:
    if camera.kind == "frames":
        length = len(camera.names)
        if max(wanted) < length:
            for frame in wanted:
                yield frame, read_picture(camera.path, camera.names[frame], camera.orientation)
            return
    else:
        videos = [inside(camera.path, name) for name in camera.names] or [camera.path]
        images = chain.from_iterable(map(iterate_video, videos))
        for length, (_, image) in enumerate(images, 1):
            if length - 1 in wanted:
                yield length - 1, upright(image, camera.orientation)
            if length > max(wanted):
                return
    missing = min(frame for frame in wanted if frame >= length)
    raise CaptureError(f"{camera.path}: has {length} frames, expected a frame {missing}")


def find_points(read: Callable[[], Images], small: bool = False) -> dict[int, FrameSetPoints]:
    """Find landmarks and features, in pixels of the images, by frame number.

    With `small`, images are read again and smaller windows searched if most frame sets lack a
    second face.
    """
    # Imported here: given cameras that are not checked need no network.
    from express50.landmarks.detector import SMALL, detect
    from express50.landmarks.network import load_network

    net = load_network()
    faces: dict[int, dict[str, Detection]] = {}
    features: dict[int, dict[str, Features]] = {}
    for frame, name, image in read():
        faces.setdefault(frame, {})[name] = detect(net, image)
        features.setdefault(frame, {})[name] = find_features(image)
    lacking = {frame for frame, seen in faces.items() if len(_with_face(seen)) < 2 <= len(seen)}
    if small and 2 * len(lacking) > len(faces):
        for frame, name, image in read():
            if frame in lacking and faces[frame][name].score < FACE_SCORE:
                faces[frame][name] = detect(net, image, smallest=SMALL)
    # Deviations are enlarged, because the landmarks of a view err together.
    landmarks = {
        frame: [
            (name, face.points, LANDMARK_INFLATION * np.maximum(face.sigma, FEATURE_SIGMA_PX))
            for name, face in _with_face(seen).items()
        ]
        for frame, seen in faces.items()
    }
    return {f: FrameSetPoints(landmarks[f], without_fixed(features[f])) for f in sorted(features)}


def _with_face(faces: Mapping[str, Detection]) -> dict[str, Detection]:
    """Return the cameras that show a face."""
    return {name: face for name, face in faces.items() if face.score >= FACE_SCORE}


def find_features(image: np.ndarray) -> Features:
    """Find SIFT features in an image (H, W, 3) uint8; descriptors are roots (RootSIFT, 2012)."""
    sift = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.004)
    keys, described = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    if not keys:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    pixels = opencv_pixels_to_corner(np.array([key.pt for key in keys]))
    return pixels, np.sqrt(described / np.maximum(described.sum(1, keepdims=True), 1e-9))


def without_fixed(features: Mapping[str, Features]) -> dict[str, Features]:
    """Remove features that three or more cameras of a frame set have at the same pixel.

    They belong to the sensors, not to the scene: dust, a watermark, fixed-pattern noise.
    """
    names = sorted(features)
    owner = np.concatenate([np.full(len(features[n][0]), i) for i, n in enumerate(names)])
    pixels = np.concatenate([features[n][0] for n in names])
    described = np.concatenate([features[n][1] for n in names])
    pairs = cKDTree(pixels).query_pairs(0.75, output_type="ndarray")
    alike = np.einsum("ij,ij->i", described[pairs[:, 0]], described[pairs[:, 1]]) > 0.9
    first, second = pairs[alike & (owner[pairs[:, 0]] != owner[pairs[:, 1]])].T
    seen = np.zeros((len(owner), len(names)), bool)
    seen[first, owner[second]] = seen[second, owner[first]] = True
    keep = seen.sum(1) < 2
    return {n: tuple(c[keep[owner == i]] for c in features[n]) for i, n in enumerate(names)}


def has_one_lens(index: Index) -> bool:
    """Return what capture.toml says of `same_lens`: pictures of one size have one focal length.

    Raises:
        CalibrationError: it is neither true nor false.
    """
    value = index.meta.get("same_lens", False)
    if not isinstance(value, bool):
        raise CalibrationError(
            f"{index.capture / 'capture.toml'}: same_lens is {value!r}, expected true or false"
        )
    return value


def known_focals(index: Index) -> dict[str, float]:
    """Return the focal lengths, pixels of the footage, from capture.toml or the images' EXIF.

    `focal_px` in capture.toml is a number, or a table by camera.

    Raises:
        CalibrationError: `focal_px` is not a positive number.
    """
    given = index.meta.get("focal_px", {})
    check_focals(index.capture / "capture.toml", given)
    table = given if isinstance(given, dict) else dict.fromkeys(index.cameras, given)
    found = {}
    for name, source in index.cameras.items():
        if name in table:
            found[name] = float(table[name])
        elif source.kind == "frames":
            try:
                film_mm = read_exif(index.capture / source.source / source.names[0])[1]
            except FormatError:  # a member of a container
                continue
            if film_mm > 0:
                found[name] = focal_of_film(film_mm, source.width, source.height)
    return found


def focal_of_film(film_mm: float, width: int, height: int) -> float:
    """Return the focal length, pixels, with the diagonal angle of view of one on 35 mm film."""
    return film_mm / math.hypot(36.0, 24.0) * math.hypot(width, height)
