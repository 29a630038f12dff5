"""Where landmarks come from: the embedded network, the user's own FAN weights, or a file of points.

A source is called with an image, its camera's id and its frame, and answers with a `Marked` face:
the frozen `Detection` that all share, the irises, and which convention its jaw line follows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.errors import ConfigError
from express50.geometry.cameras import Camera
from express50.landmarks.detector import SMALLEST, Detection, detect
from express50.landmarks.fan import find_with_fan, load_fan
from express50.landmarks.iris import Irises, find_irises
from express50.landmarks.lips import open_lips
from express50.landmarks.network import WEIGHTS, load_network
from express50.landmarks.points_file import IRISES, POINTS, read_points

EMBEDDED, FAN = "embedded", "fan:"


@dataclass(frozen=True)
class Marked:
    """A face in an image.

    Attributes:
        face: the 68 landmarks.
        irises: iris centres, the subject's left eye first.
        visible_contour: points 0..16 follow the visible edge of the jaw; see `pipelines.track`.
    """

    face: Detection
    irises: Irises
    visible_contour: bool


Source = Callable[[np.ndarray, str, int], Marked]


def source_files(landmarks: str) -> dict[str, Path]:
    """Files that a source reads, by name: they belong to what a stage's output depends on.

    Args:
        landmarks: `embedded`, `fan:PATH` or the path of a file of points.
    """
    if landmarks == EMBEDDED:
        return {"weights": WEIGHTS}
    if landmarks.startswith(FAN):
        path = Path(landmarks.removeprefix(FAN)).expanduser()
        return {"weights": WEIGHTS, "fan": path}
    return {"landmarks": Path(landmarks).expanduser()}


def open_source(
    landmarks: str, cameras: Mapping[str, Camera], refinements: int = 3, smallest: float = SMALLEST
) -> Source:
    """Make a source ready.

    Args:
        landmarks: `embedded`, `fan:PATH` (TorchScript weights) or the path of a file of points
            (.npz or .json, see docs/FORMAT.md).
        cameras: as recorded, by id; points of a file are undistorted with them.
        refinements: looks of the embedded network.
        smallest: windows that it searches, see `detect`.

    Raises:
        ConfigError: the file is not there, or is no such file.
        FormatError: the file of points is malformed.
    """
    for path in source_files(landmarks).values():
        if not path.is_file():
            raise ConfigError(
                f"landmarks {landmarks!r}: no file {path}; expected 'embedded', 'fan:' and the "
                "path of FAN's TorchScript weights, or the path of a file of points"
            )
    if landmarks == EMBEDDED:
        return _embedded(refinements, smallest)
    if landmarks.startswith(FAN):
        return _fan(source_files(landmarks)["fan"], refinements, smallest)
    return _given(source_files(landmarks)["landmarks"], cameras)


def _embedded(refinements: int, smallest: float) -> Source:
    net = load_network()

    def find(image: np.ndarray, camera_id: str, frame: int) -> Marked:
        face = open_lips(image, detect(net, image, refinements, smallest))
        return Marked(face, find_irises(image, face), visible_contour=False)

    return find


def _fan(path: Path, refinements: int, smallest: float) -> Source:
    net, fan = load_network(), load_fan(path)

    def find(image: np.ndarray, camera_id: str, frame: int) -> Marked:
        face = find_with_fan(fan, image, detect(net, image, refinements, smallest))
        return Marked(face, find_irises(image, face), visible_contour=True)

    return find


def _given(path: Path, cameras: Mapping[str, Camera]) -> Source:
    table = read_points(path, cameras)

    def find(image: np.ndarray, camera_id: str, frame: int) -> Marked:
        rows = table.get((camera_id, frame))
        if rows is None:
            return _nothing(image)
        face = given_detection(rows[:POINTS])
        irises = given_irises(rows, face) if len(rows) > POINTS else find_irises(image, face)
        return Marked(face, irises, visible_contour=True)

    return find


def given_detection(rows: np.ndarray) -> Detection:
    """A detection of given points.

    Args:
        rows: (68, 3) pixels x, y and confidence 0..1; NaN in x or y where a point is unknown.

    Unknown points stand at the middle of the known ones, with an infinite sigma. A sure point is
    taken to be right within 0.6 % of the face's size, one of confidence c within that over c.
    """
    known = np.isfinite(rows[:, :2]).all(1) & (rows[:, 2] > 0)
    if not known.any():
        return Detection(np.zeros((POINTS, 2)), np.full(POINTS, np.inf), np.zeros(POINTS), 0.0)
    points = np.where(known[:, None], rows[:, :2], rows[known, :2].mean(0))
    confidence = np.where(known, rows[:, 2], 0.0)
    size = max(float(np.ptp(rows[known, :2], axis=0).max()), 1.0)
    with np.errstate(divide="ignore"):
        sigma = np.where(known, 0.006 * size / confidence, np.inf)
    return Detection(points, sigma, confidence, float(confidence[known].mean()))


def given_irises(rows: np.ndarray, face: Detection) -> Irises:
    """Irises of given points (70, 3): the subject's left one, then the right."""
    found = rows[POINTS : POINTS + IRISES]
    known = np.isfinite(found[:, :2]).all(1) & (found[:, 2] > 0)
    width = [np.linalg.norm(face.points[a] - face.points[b]) for a, b in ((45, 42), (39, 36))]
    confidence = np.where(known, found[:, 2], 0.0)
    with np.errstate(divide="ignore"):
        sigma = np.where(known, 0.03 * np.array(width) / confidence, np.inf)
    centres = np.where(known[:, None], found[:, :2], face.points[[42, 36]])
    return Irises(centres, np.where(sigma > 0, sigma, np.inf), confidence)


def _nothing(image: np.ndarray) -> Marked:
    """No face: the score is 0."""
    middle = np.array([image.shape[1], image.shape[0]]) / 2
    face = Detection(np.tile(middle, (POINTS, 1)), np.full(POINTS, np.inf), np.zeros(POINTS), 0.0)
    irises = Irises(np.tile(middle, (2, 1)), np.full(2, np.inf), np.zeros(2))
    return Marked(face, irises, visible_contour=True)
