"""Where the face is in a picture, and the part of the picture that each zoom shows.

The crop follows points that expressions hardly move (eye corners, bridge and base of the nose), so
that a dropped jaw does not change the framing, and it is the same for subject and reference.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from annotations.ui.frames import Box
from express50.capture.frames import read_proxy
from express50.contract.layout import Dataset
from express50.errors import Express50Error

ZOOMS = ("face", "mouth", "eyes", "head", "frame")
# Centre below the line of the eyes, and height, in face units; see Face.unit.
_BOXES = {"face": (0.48, 2.25), "mouth": (0.78, 0.85), "eyes": (-0.06, 0.75), "head": (0.3, 3.3)}
_EYE_CORNERS = (36, 39, 42, 45)
_BRIDGE, _NOSE_BASE = 27, 33
# The bridge-to-base length of a nose is this share of the outer eye corners' distance.
_NOSE_SHARE = 0.55
MIN_SCORE = 0.25


@dataclass(frozen=True)
class Face:
    """A face in a picture, in shares of the picture's width.

    Attributes:
        x, y: middle of the eyes' corners.
        unit: distance of the outer corners of the eyes as a frontal view would have it.
        aspect: height of the picture over its width.
    """

    x: float
    y: float
    unit: float
    aspect: float


def face_of_points(points: np.ndarray, width: int, height: int) -> Face:
    """The face of landmarks (68, 2), pixels, in a picture of that size."""
    eyes = points[list(_EYE_CORNERS)].mean(0)
    across = float(np.linalg.norm(points[45] - points[36]))
    nose = float(np.linalg.norm(points[_NOSE_BASE] - points[_BRIDGE])) / _NOSE_SHARE
    # From the side the eyes close up but the nose does not; seen from above, the other way round.
    return Face(eyes[0] / width, eyes[1] / width, max(across, nose, 2.0) / width, height / width)


def zoom_box(face: Face | None, zoom: str, pane_aspect: float, image_aspect: float) -> Box:
    """The part of a picture that a zoom shows in a pane of that height over width.

    Without a face, or for the zoom ``frame``, it is the whole picture.
    """
    if face is None or zoom == "frame":
        height = max(image_aspect, pane_aspect)
        width = height / pane_aspect
        x, y = 0.5, image_aspect / 2
        aspect = image_aspect
    else:
        below, size = _BOXES[zoom]
        height = size * face.unit
        width = height / pane_aspect
        if zoom in ("mouth", "eyes") and width < 1.25 * face.unit:
            width = 1.25 * face.unit  # a narrow pane must still show both corners
            height = width * pane_aspect
        x, y, aspect = face.x, face.y + below * face.unit, face.aspect
    left, top = x - width / 2, (y - height / 2) / aspect
    right, bottom = x + width / 2, (y + height / 2) / aspect
    return round(left, 4), round(top, 4), round(right, 4), round(bottom, 4)


Detect = Callable[[np.ndarray], tuple[np.ndarray, float]]


def load_detector() -> Detect:
    """The landmark network as a function of a picture: points (68, 2) and score 0 to 1."""
    import torch  # seconds to load, and only needed here

    from express50.landmarks.detector import detect
    from express50.landmarks.network import load_network

    torch.set_num_threads(1)
    network = load_network()

    def find(image: np.ndarray) -> tuple[np.ndarray, float]:
        found = detect(network, image)
        return found.points, found.score

    return find


class FaceFinder:
    """Finds faces once for each frame that is asked for; loads its network in the background."""

    def __init__(self, dataset: Dataset, load: Callable[[], Detect] = load_detector) -> None:
        self._dataset = dataset
        self._load = load
        self._detect: Detect | None = None
        self._faces: dict[tuple[str, str, int], Face | None] = {}
        self._lock = threading.Lock()

    @property
    def ready(self) -> bool:
        """Whether the network is loaded."""
        return self._detect is not None

    def load(self) -> None:
        """Load the network; takes seconds, so call it in a thread."""
        self._detect = self._load()

    def find(self, subject: str, camera: str, frame: int) -> Face | None:
        """The face in a frame; None where there is none or the network is still loading."""
        key = subject, camera, frame
        if self._detect is None or key in self._faces:
            return self._faces.get(key)
        with self._lock:
            if key not in self._faces:
                self._faces[key] = self._look(*key)
        return self._faces[key]

    def _look(self, subject: str, camera: str, frame: int) -> Face | None:
        if self._detect is None:
            return None
        try:
            image = read_proxy(self._dataset, subject, camera, frame)
        except (Express50Error, OSError, IndexError):
            return None  # the picture itself says why it cannot be shown
        points, score = self._detect(image)
        if score < MIN_SCORE or not np.isfinite(points).all():
            return None
        return face_of_points(points, image.shape[1], image.shape[0])
