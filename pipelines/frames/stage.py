"""Decode the peak frames of one expression, or a subject's clean plates, and write them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import (
    FrameReader,
    make_picture,
    read_recorded_cameras,
    read_recorded_plate,
    write_frame,
)
from express50.capture.index import check_peak, read_index, read_peak_rows
from express50.contract.layout import PLATES, Dataset
from express50.contract.stage import Note, Result
from express50.errors import CaptureError, StageError
from express50.files.atomic import write_json
from express50.files.images import write_image
from express50.geometry.cameras import resized
from express50.geometry.pixels import shrink, shrunk_size, tile_sheet
from express50.geometry.sampling import evenly, pictured_share

COLUMNS = 6  # of the contact sheet
LEAST_BLACK = 0.002  # share of a frame: a smaller corner hides nobody
TILE = 240  # pixels
FOLDS = (
    "its lens folds within the image: {:.1%} of the frame stays black;"
    " calibrate again, or check that the coefficients belong to this image size"
)

LEAST_SIDE = 100  # pixels; in smaller pictures no face can be recognised
FIRST_PLATES = 6  # one in 60 degrees of a full ring; a face is seen from 180
FACE_SCORE = 0.4  # plates of an empty set have 0.00, with a person 0.5 to 1 if the face shows
FACE = (
    "its plate shows a face, so the person is missing from mattes: photograph the set without"
    " people, or delete the plate, and run 'express50 ingest' again"
)


def run(dataset: Dataset, item: str, out: Path, side: int) -> Result:
    """Write `<camera>.tif` per calibrated camera; a camera that cannot be read is dropped.

    The item is `subject/expression`, or `subject/_plates`, which also holds the pictures' sizes.
    `side` is their longer side, pixels; 0: as recorded.

    Raises:
        CaptureError: the labelled frame is not the one that was indexed.
        StageError: no camera could be read.
    """
    cv2.setNumThreads(1)  # the runner counts one core per item
    subject, expression = item.split("/")
    cameras = read_recorded_cameras(dataset, subject)
    sizes = {
        name: shrunk_size(c.width, c.height, side or max(c.width, c.height))
        for name, c in cameras.items()
    }
    if plates := expression == PLATES:
        write_json(out / "pictures.json", sizes)
        index = read_index(dataset, subject)
        cameras = {name: camera for name, camera in cameras.items() if name in index.plates}
    read = _reader(dataset, subject, expression)
    dropped: list[Note] = []
    warnings: list[Note] = []
    tiles: dict[str, np.ndarray] = {}
    for name, camera in cameras.items():
        try:
            image = make_picture(read(name), camera, sizes[name])
        except CaptureError as error:
            dropped.append(Note(name, str(error)))
            continue
        write_frame(out / f"{name}.tif", image)
        if (black := 1 - pictured_share(camera)) > LEAST_BLACK:
            warnings.append(Note(name, FOLDS.format(black)))
        tiles[name] = shrink(image, TILE)
    if plates:
        warnings += [Note(name, FACE) for name in _with_face(tiles)]
        _write_walls(dataset, subject, sizes, out)
    if not tiles and not plates:
        why = "; ".join(map(str, dropped[:3]))
        raise StageError(f"{item}: no camera could be read ({why or 'none is calibrated'})")
    if tiles:
        (out / "qc").mkdir()
        sheet = tile_sheet(tiles, COLUMNS, TILE)
        write_image(out / "qc" / "frames.jpg", sheet, quality=88)
    return Result({"frames": len(tiles)}, dropped, warnings)


def _write_walls(
    dataset: Dataset, subject: str, sizes: dict[str, tuple[int, int]], out: Path
) -> None:
    """Write `<camera>.wall.png`, the wall behind the person, of each camera without a plate.

    It is learned from several moments, whatever the labels, so that a changed label does not change
    the mattes of other expressions.
    """
    index, cameras = read_index(dataset, subject), read_recorded_cameras(dataset, subject)
    wanted = [name for name in cameras if name not in index.plates]
    if not wanted or index.frames < 2:
        return
    from pipelines.calibrate.footage import instants
    from pipelines.matte.wall import LEAST_MOMENTS, MOMENTS, learn_walls

    frames: list[int] = []
    with suppress(CaptureError):  # unless this camera's footage is damaged
        frames = instants(index, wanted[0], MOMENTS)
    if len(frames) < LEAST_MOMENTS:  # a few long clips
        frames = evenly(range(index.frames), LEAST_MOMENTS)

    def read(name: str, frame: int) -> np.ndarray:
        with closing(FrameReader(index, name)) as reader:
            return make_picture(reader.read(frame, exact=True), cameras[name], sizes[name])

    pictured = {name: resized(camera, *sizes[name]) for name, camera in cameras.items()}
    for name, wall in learn_walls(pictured, read, frames, wanted):
        write_image(out / f"{name}.wall.png", wall.picture())


def _with_face(images: dict[str, np.ndarray]) -> list[str]:
    """Return the cameras whose picture (H, W, 3) uint8 shows a large face.

    Some pictures are looked at first, as an empty one takes a core second. The others follow only
    if one of them shows a face: who stands in one plate usually stands in all.
    """
    from express50.landmarks.detector import detect_many
    from express50.landmarks.network import load_network

    images = {name: image for name, image in images.items() if max(image.shape) >= LEAST_SIDE}
    first = evenly(list(images), FIRST_PLATES)
    shown: list[str] = []
    for names in (first, [name for name in images if name not in first]):
        tiles = [images[name] for name in names]
        found = detect_many(load_network(), tiles, refinements=1, smallest=0.9) if tiles else []
        shown += [name for name, face in zip(names, found, strict=True) if face.score > FACE_SCORE]
        if not shown:
            break
    return [name for name in images if name in shown]


def _reader(dataset: Dataset, subject: str, expression: str) -> Callable[[str], np.ndarray]:
    """Make the function that reads one camera's recorded frame or plate (H, W, 3)."""
    index = read_index(dataset, subject)
    if expression == PLATES:
        return lambda camera: read_recorded_plate(index, camera)
    peak = read_peak_rows(dataset, subject)[expression]
    check_peak(index, expression, peak)

    def read(camera: str) -> np.ndarray:
        with closing(FrameReader(index, camera)) as reader:
            return reader.read(peak.frame, exact=True)

    return read
