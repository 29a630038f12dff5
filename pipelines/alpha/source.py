"""Where a camera's plate comes from: the one that was shot, else others' or footage of the rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.capture.frames import FrameReader, read_plate, read_raw_plate
from express50.capture.index import Index, read_index
from express50.contract.layout import Dataset
from express50.errors import StageError
from express50.geometry.cameras import Camera
from express50.geometry.conventions import undistort_image
from pipelines.alpha.config import AlphaConfig
from pipelines.alpha.footage import (
    FootagePlate,
    plate_of_another,
    plate_over_subjects,
    plate_over_time,
    time_median,
)

MOST_SUBJECTS = 8  # of a fixed rig, whose footage stands in for a plate
LEAST_FRAMES = 5  # of a subject, to take a median of


@dataclass(frozen=True)
class Plate:
    """A camera's plate (H, W, 3) uint8, how far off it may be (H, W), and where it is from."""

    image: np.ndarray
    doubt: np.ndarray
    source: str
    warnings: tuple[dict[str, str], ...] = ()


def plate_of(dataset: Dataset, item: str, camera: Camera, config: AlphaConfig) -> Plate:
    """The plate that was shot, or one estimated from footage.

    Raises:
        StageError: it has another size than the footage, or there is none and none can be had.
    """
    subject, camera_id = item.split("/")
    image = read_plate(dataset, subject, camera_id, undistort=False)
    if image is None:
        return _plate_of_the_rig(dataset, item, camera, config)
    if image.shape[:2] != (camera.height, camera.width):
        raise StageError(
            f"{item}: the plate is {image.shape[1]}x{image.shape[0]}, the footage "
            f"{camera.width}x{camera.height}; record the plate with the capture's settings"
        )
    sure = np.zeros(image.shape[:2], np.float32)
    return Plate(undistort_image(image, camera), sure, "given")


def others_of(dataset: Dataset, index: Index, camera_id: str) -> list[str]:
    """Other subjects whose footage has a camera of that name and size, an even choice."""
    mine = index.cameras[camera_id]
    found = []
    for subject in dataset.subjects():
        theirs = read_index(dataset, subject).cameras.get(camera_id)
        if subject == index.subject or theirs is None:
            continue
        if (theirs.width, theirs.height) == (mine.width, mine.height):
            found.append(subject)
    picks = np.linspace(0, len(found) - 1, min(len(found), MOST_SUBJECTS - 1)).round().astype(int)
    return [found[i] for i in np.unique(picks)]


def _plate_of_the_rig(dataset: Dataset, item: str, camera: Camera, config: AlphaConfig) -> Plate:
    """Of another subject before this rig, else over subjects, else over time."""
    subject, camera_id = item.split("/")
    index = read_index(dataset, subject)
    own = _footage(index, camera_id, config.plate_frames)
    median = time_median(own)
    others = [read_index(dataset, other) for other in others_of(dataset, index, camera_id)]
    for other in others:
        if camera_id in other.plates:
            theirs = read_raw_plate(other, camera_id)
            borrowed = plate_of_another(theirs, median) if theirs.shape == median.shape else None
            if borrowed:
                return _undistorted(borrowed, camera, f"the plate of {other.subject}")
    ways: list[tuple[str, FootagePlate | None]] = []
    if others:
        shown = [time_median(_footage(o, camera_id, config.plate_frames)) for o in others]
        over = plate_over_subjects([median, *shown])
        ways.append((f"footage of {len(others) + 1} subjects", over))
    over_time = plate_over_time(own) if len(own) >= LEAST_FRAMES else None
    ways.append((f"footage of {len(own)} frames", over_time))
    flaws = []
    for source, found in ways:
        flaw = found.flaw if found else "the subject moves too little to show what is behind"
        if found and not flaw:
            return _undistorted(found, camera, source)
        flaws.append(f"in {source} {flaw}")
    raise StageError(
        f"{item}: no clean plate, and {'; '.join(flaws)}; photograph the empty set as "
        f"plates/{camera_id}.png and run 'express50 ingest' again, or set alpha.method to salient"
    )


def _footage(index: Index, camera_id: str, count: int) -> list[np.ndarray]:
    """Frames (H, W, 3) uint8 spread over the footage, as recorded."""
    reader = FrameReader(index, camera_id)
    picks = np.linspace(0, reader.source.frames - 1, count).round().astype(int)
    frames = [reader.read(int(frame)) for frame in np.unique(picks)]
    reader.close()
    return frames


def _undistorted(found: FootagePlate, camera: Camera, source: str) -> Plate:
    """An estimated plate in the geometry of undistorted frames, with a word on what it lacks."""
    image = undistort_image(found.plate, camera)
    seen = undistort_image(np.repeat(found.known[..., None] * np.uint8(255), 3, axis=2), camera)
    doubt = np.where(seen[..., 0] == 255, 0, max(found.doubt, 1.0)).astype(np.float32)
    share = 1 - float(found.known.mean())
    why = f"none was shot; taken from {source}"
    if share > 0:
        why += f"; {share:.1%} is always covered and filled in, off by {found.doubt:.1f} of 255"
    return Plate(image, doubt, source, ({"what": "plate", "why": why},))
