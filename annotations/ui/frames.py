"""Decode frames at display size ahead of time, in a thread, and crop them for each zoom."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from express50.capture.frames import read_proxy
from express50.contract.layout import Dataset
from express50.errors import AnnotationError, Express50Error, advised

if TYPE_CHECKING:
    from express50.landmarks.network import LandmarkNet

LIMIT_BYTES = 192 << 20
Box = tuple[float, float, float, float]  # left, top, right, bottom as shares of the image's sides


class FrameCrop(NamedTuple):
    """A picture as it is shown: which frame, which part of it, and how many pixels."""

    subject: str
    camera: str
    frame: int
    box: Box
    width: int
    height: int


class FrameCache:
    """A cache of pictures by shot; the least recently used are dropped first.

    Thread-safe. ``get`` returns a cached picture or decodes it (milliseconds); ``want`` names
    the pictures that a background thread should decode next.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._pictures: OrderedDict[FrameCrop, np.ndarray] = OrderedDict()
        self._bytes = 0
        self._wanted: list[FrameCrop] = []
        self._later: list[FrameCrop] = []
        self._open = True
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None

    def get(self, shot: FrameCrop) -> np.ndarray:
        """Return the picture (height, width, 3) uint8; do not write to it.

        Raises:
            AnnotationError: the frame cannot be read, in plain words.
        """
        with self._wake:
            found = self._pictures.get(shot)
            if found is not None:
                self._pictures.move_to_end(shot)
                return found
        return self._read(shot)

    def want(self, shots: Sequence[FrameCrop], *, later: bool = False) -> None:
        """Decode these in the background, in this order; earlier requests of the kind are dropped.

        Requests for ``later`` wait until no other is left.
        """
        with self._wake:
            wanted = [s for s in reversed(shots) if s not in self._pictures]
            if later:
                self._later = wanted
            else:
                self._wanted = wanted
            if self._thread is None and self._open and wanted:
                self._thread = threading.Thread(target=self._work, daemon=True)
                self._thread.start()
            self._wake.notify()

    def idle(self) -> bool:
        """Return whether nothing is left to decode ahead."""
        with self._wake:
            return not self._wanted and not self._later

    def close(self) -> None:
        """Stop the thread."""
        with self._wake:
            self._open = False
            self._wanted = self._later = []
            self._wake.notify()
        if self._thread is not None:
            self._thread.join()

    def _work(self) -> None:
        while True:
            with self._wake:
                while self._open and not self._wanted and not self._later:
                    self._wake.wait()
                if not self._open:
                    return
                shot = (self._wanted or self._later).pop()
                if shot in self._pictures:
                    continue
            try:
                self._read(shot)
            except AnnotationError:
                continue  # get raises it for whoever needs the picture

    def _read(self, shot: FrameCrop) -> np.ndarray:
        try:
            picture = read_shot(self._dataset, shot)
        except (Express50Error, OSError, IndexError, ValueError, cv2.error) as error:
            why = f"cannot be read: {error}"
            if isinstance(error.__cause__ or error, FileNotFoundError):
                ingest = advised("express50 ingest", self._dataset.root)
                why = f"its proxies are missing; run {ingest} again"
            where = f"{shot.subject} {shot.camera} frame {shot.frame}"
            raise AnnotationError(f"{where}: {why}") from error
        picture.setflags(write=False)
        with self._wake:
            if shot not in self._pictures and picture.nbytes <= LIMIT_BYTES:
                self._pictures[shot] = picture
                self._bytes += picture.nbytes
            while self._bytes > LIMIT_BYTES:
                self._bytes -= self._pictures.popitem(last=False)[1].nbytes
        return picture


def read_shot(dataset: Dataset, shot: FrameCrop) -> np.ndarray:
    """Read a frame's proxy and bring the part that is asked for to display size."""
    image = read_proxy(dataset, shot.subject, shot.camera, shot.frame)
    return crop_to(image, shot.box, shot.width, shot.height)


def crop_to(image: np.ndarray, box: Box, width: int, height: int) -> np.ndarray:
    """Crop an image (H, W, 3) uint8 to (height, width, 3); black beyond the image's border."""
    rows, columns = image.shape[:2]
    left, top = round(box[0] * columns), round(box[1] * rows)
    right, bottom = max(left + 1, round(box[2] * columns)), max(top + 1, round(box[3] * rows))
    inside = image[max(0, top) : max(0, bottom), max(0, left) : max(0, right)]
    pads = (max(0, -top), max(0, bottom - rows), max(0, -left), max(0, right - columns))
    if inside.size == 0:
        return np.zeros((height, width, 3), np.uint8)
    if any(pads):
        inside = cv2.copyMakeBorder(inside, *pads, cv2.BORDER_CONSTANT, value=(0, 0, 0))
    shrinks = inside.shape[0] > height
    method = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return cv2.resize(np.ascontiguousarray(inside), (width, height), interpolation=method)


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
    """A face in a picture, in shares of the picture's width."""

    # x and y are the middle of the eyes' corners
    x: float
    y: float
    unit: float  # distance of the outer corners of the eyes as a frontal view would have it


def zoom_box(face: Face | None, zoom: str, pane_aspect: float, image_aspect: float) -> Box:
    """Find the part of a picture that a zoom shows in a pane of that height over width.

    Without a face, or for the zoom ``frame``, it is the full picture.
    """
    if face is None or zoom == "frame":
        height = max(image_aspect, pane_aspect)
        width = height / pane_aspect
        x, y = 0.5, image_aspect / 2
    else:
        below, size = _BOXES[zoom]
        height = size * face.unit
        width = height / pane_aspect
        if zoom in ("mouth", "eyes") and width < 1.25 * face.unit:
            width = 1.25 * face.unit  # a narrow pane must still show both corners
            height = width * pane_aspect
        x, y = face.x, face.y + below * face.unit
    left, top = x - width / 2, (y - height / 2) / image_aspect
    right, bottom = x + width / 2, (y + height / 2) / image_aspect
    return round(left, 4), round(top, 4), round(right, 4), round(bottom, 4)


class FaceFinder:
    """Finds faces once for each frame that is asked for; `load` reads the network it needs."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._network: LandmarkNet | None = None
        self._faces: dict[tuple[str, str, int], Face | None] = {}
        self._lock = threading.Lock()

    @property
    def ready(self) -> bool:
        """Return True once the network is loaded."""
        return self._network is not None

    def load(self) -> None:
        """Load the network; takes seconds, so call it in a thread."""
        import torch  # seconds to load, and only needed here

        from express50.landmarks.network import load_network

        torch.set_num_threads(1)
        self._network = load_network()

    def find(self, subject: str, camera: str, frame: int) -> Face | None:
        """Find the face in a frame; None without a face, or while the network is loading."""
        key = subject, camera, frame
        if self._network is None or key in self._faces:
            return self._faces.get(key)
        with self._lock:
            if key not in self._faces:
                self._faces[key] = self._look(self._network, *key)
        return self._faces[key]

    def _look(self, network: LandmarkNet, subject: str, camera: str, frame: int) -> Face | None:
        from express50.landmarks.detector import detect

        try:
            image = read_proxy(self._dataset, subject, camera, frame)
        except (Express50Error, OSError, IndexError):
            return None  # the picture itself says why it cannot be shown
        found = detect(network, image)
        if found.score < MIN_SCORE or not np.isfinite(found.points).all():
            return None
        points, width = found.points, image.shape[1]
        eyes = points[list(_EYE_CORNERS)].mean(0)
        across = float(np.linalg.norm(points[45] - points[36]))
        nose = float(np.linalg.norm(points[_NOSE_BASE] - points[_BRIDGE])) / _NOSE_SHARE
        # From the side the eyes close up but the nose does not; from above, the other way round.
        unit = max(across, nose, 2.0)
        return Face(eyes[0] / width, eyes[1] / width, unit / width)
