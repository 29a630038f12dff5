"""Read a bare photograph or video: upright pixels, and the focal length that EXIF tells."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.capture.raw import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from express50.errors import CaptureError, FormatError
from express50.files.containers import read_srgb8
from express50.files.images import ORIENTATION, read_exif, upright
from express50.files.video import iterate_video, video_turn

# Read as photographs; a rig's cameras write none of the last two.
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, ".webp", ".bmp")
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class Picture:
    """What is known of a photograph or video before any face was looked for.

    Attributes:
        path: the file.
        video: whether it is a video.
        orientation: EXIF's, 1 to 8, or what a video's container says in its terms; 1 where its
            pixels lie upright.
        film_mm: focal length on 35 mm film with the same diagonal angle of view; 0 where EXIF
            tells none.
    """

    path: Path
    video: bool
    orientation: int = 1
    film_mm: float = 0.0


def open_picture(path: Path) -> Picture:
    """Look at a file's name and EXIF.

    Raises:
        CaptureError: no such file, or neither an image nor a video.
    """
    path = Path(path)
    if path.is_dir():
        raise CaptureError(
            f"{path}: is a folder, expected a photograph or a video; the pictures of several "
            "cameras are read by 'express50 ingest'"
        )
    if not path.is_file():
        raise CaptureError(f"{path}: no such file; expected a photograph or a video")
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        turns = video_turn(path)
        return Picture(path, video=True, orientation=ORIENTATION[turns])
    if suffix not in PHOTO_SUFFIXES:
        raise CaptureError(
            f"{path}: is no photograph or video by its name; expected one of "
            f"{' '.join(PHOTO_SUFFIXES + VIDEO_SUFFIXES)}"
        )
    try:
        orientation, film = read_exif(path)
    except FormatError as error:
        raise CaptureError(str(error)) from error
    return Picture(path, video=False, orientation=orientation, film_mm=film)


def read_upright(picture: Picture) -> np.ndarray:
    """The photograph (H, W, 3) uint8 sRGB as it should be looked at.

    Raises:
        CaptureError: it is damaged.
    """
    return upright(read_srgb8(picture.path), picture.orientation)


def upright_frames(picture: Picture) -> Iterator[np.ndarray]:
    """Decode a whole video (H, W, 3) uint8 sRGB as it should be looked at."""
    for _, image in iterate_video(picture.path):
        yield upright(image, picture.orientation)


def spread_frames(picture: Picture, count: int) -> tuple[list[np.ndarray], int]:
    """Up to `count` frames spread over a picture, and how many frames it has.

    A video is decoded twice, so that not all of its frames are held.
    """
    if not picture.video:
        return [read_upright(picture)], 1
    frames = sum(1 for _ in upright_frames(picture))
    wanted = set(np.unique(np.linspace(0, frames - 1, count).round().astype(int)).tolist())
    return [image for n, image in enumerate(upright_frames(picture)) if n in wanted], frames


def guess_focal(picture: Picture, width: int, height: int, film_mm: float) -> tuple[float, str]:
    """Focal length in pixels and where it is from: `exif`, else `guess` by `film_mm`."""
    diagonal = math.hypot(width, height)
    if picture.film_mm > 0:
        return picture.film_mm / FILM_DIAGONAL_MM * diagonal, "exif"
    return film_mm / FILM_DIAGONAL_MM * diagonal, "guess"
