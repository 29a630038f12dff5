"""What a photograph's EXIF tells: how its pixels lie, and the lens.

A rig's cameras are taken as they are stored, since a calibration belongs to stored pixels. Bare
photographs have none: they are turned upright before anything is measured in them, so that width,
height and principal point are those of the upright picture. The focal length of 35 mm film is that
of the same diagonal, which turning does not change.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from express50.files.images import open_image

# Orientation -> quarter turns counter-clockwise after an optional left-right flip (EXIF 2.3).
TURNS = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (1, True), 6: (3, False),
         7: (3, True), 8: (1, False)}  # fmt: skip


# Quarter turns counter-clockwise without a flip -> orientation.
ORIENTATION = {turns: number for number, (turns, flipped) in TURNS.items() if not flipped}


def read_exif(path: Path) -> tuple[int, float]:
    """Orientation, 1 to 8, and focal length on 35 mm film, 0 for none; what cannot be is not told.

    Raises:
        FormatError: the file is no image.
    """
    image = open_image(path)
    try:
        spec = image.spec()
        told = [spec.getattribute(name) for name in ("Orientation", "Exif:FocalLengthIn35mmFilm")]
    except UnicodeDecodeError:  # text in the place of a number, and none at that
        told = [1, 0.0]
    finally:
        image.close()
    orientation, film = (value if isinstance(value, int | float) else 0 for value in told)
    usable = math.isfinite(film) and 0 < film < 1e5
    return (int(orientation) if orientation in TURNS else 1), (float(film) if usable else 0.0)


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """An image (H, W, 3), or (W, H, 3) as stored, turned as its orientation says."""
    turns, flipped = TURNS[orientation]
    if (turns, flipped) == (0, False):
        return image
    return np.ascontiguousarray(np.rot90(image[:, ::-1] if flipped else image, turns))
