"""Frames at display size: decoded ahead in a thread, kept in memory up to a number of bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from express50.capture.frames import read_proxy
from express50.contract.layout import Dataset
from express50.errors import AnnotationError, Express50Error

LIMIT_BYTES = 192 << 20
Box = tuple[float, float, float, float]  # left, top, right, bottom as shares of the image's sides


class Shot(NamedTuple):
    """A picture as it is shown: which frame, which part of it, and how many pixels."""

    subject: str
    camera: str
    frame: int
    box: Box
    width: int
    height: int


class FrameCache:
    """Pictures by shot; the least recently used leave first.

    Thread-safe. ``get`` answers at once from memory, else decodes (milliseconds); ``want`` names
    what a background thread should decode next.
    """

    def __init__(
        self,
        dataset: Dataset,
        limit_bytes: int = LIMIT_BYTES,
        decode: Callable[[Dataset, Shot], np.ndarray] | None = None,
    ) -> None:
        self._dataset = dataset
        self._limit = limit_bytes
        self._decode = decode or read_shot
        self._pictures: OrderedDict[Shot, np.ndarray] = OrderedDict()
        self._bytes = 0
        self._wanted: list[Shot] = []
        self._later: list[Shot] = []
        self._open = True
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None
        self.misses = 0

    def get(self, shot: Shot) -> np.ndarray:
        """The picture (height, width, 3) uint8; do not write to it.

        Raises:
            AnnotationError: the frame cannot be read, in plain words.
        """
        with self._wake:
            found = self._pictures.get(shot)
            if found is not None:
                self._pictures.move_to_end(shot)
                return found
        self.misses += 1
        return self._read(shot)

    def want(self, shots: Sequence[Shot], *, later: bool = False) -> None:
        """Decode these in the background, in this order; earlier wishes of the kind are forgotten.

        What is wanted later waits until nothing else is wanted.
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

    @property
    def used_bytes(self) -> int:
        """Bytes of the pictures in memory."""
        return self._bytes

    def idle(self) -> bool:
        """Whether nothing is left to decode ahead."""
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
                continue  # whoever asks for it with get is told

    def _read(self, shot: Shot) -> np.ndarray:
        try:
            picture = self._decode(self._dataset, shot)
        except (Express50Error, OSError, IndexError, ValueError, cv2.error) as error:
            raise AnnotationError(_plain(shot, error)) from error
        picture.setflags(write=False)
        with self._wake:
            if shot not in self._pictures and picture.nbytes <= self._limit:
                self._pictures[shot] = picture
                self._bytes += picture.nbytes
            while self._bytes > self._limit:
                self._bytes -= self._pictures.popitem(last=False)[1].nbytes
        return picture


def _plain(shot: Shot, error: Exception) -> str:
    where = f"{shot.subject} {shot.camera} frame {shot.frame}"
    if isinstance(error, FileNotFoundError) or isinstance(error.__cause__, FileNotFoundError):
        return f"{where}: its proxies are missing; run 'express50 ingest' again"
    return f"{where} cannot be read: {error}"


def read_shot(dataset: Dataset, shot: Shot) -> np.ndarray:
    """Read a frame's proxy and bring the part that is asked for to display size."""
    image = read_proxy(dataset, shot.subject, shot.camera, shot.frame)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return crop_to(image, shot.box, shot.width, shot.height)


def crop_to(image: np.ndarray, box: Box, width: int, height: int) -> np.ndarray:
    """Part of an image (H, W, 3) uint8 as (height, width, 3); black beyond the image's border."""
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
