"""The colours that a sample holds: the subject's own, and alike between the rig's cameras."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from express50.capture.frames import read_plate_image
from express50.contract.layout import Dataset
from express50.files.images import scale_light
from pipelines.matte.plates import exposed, exposure_gain
from pipelines.pack.crop import Crop, cut_image
from pipelines.pack.foreground import own_colours


def own_picture(
    dataset: Dataset,
    place: tuple[str, str],
    frame: np.ndarray,
    matte: np.ndarray,
    crop: Crop,
    size: int,
) -> np.ndarray:
    """The crop (size, size, 3) of a frame with the subject's own colour in soft pixels.

    Args:
        dataset: holds the camera's plate, if there is one.
        place: subject and camera.
        frame: (H, W, 3) uint8 sRGB.
        matte: (H, W) uint8 of all that stands before the plate, torso included.
        crop: where to cut.
        size: side of the result, pixels.
    """
    plate = _plate(dataset, *place, _versions(dataset, *place))
    behind = None
    if plate is not None:
        behind = exposed(cut_image(plate, crop, size), exposure_gain(frame, plate))
    return own_colours(cut_image(frame, crop, size), cut_image(matte, crop, size), behind)


def _versions(dataset: Dataset, subject: str, camera_id: str) -> tuple[int, ...]:
    """Times of what the plate is made from: a worker may outlive several of them."""
    path = dataset.plate_file(subject, camera_id)
    return (path.stat().st_mtime_ns,) if path.is_file() else ()


@lru_cache(maxsize=32)  # 25 MB each at 4K; every expression asks for those of all cameras
def _plate(
    dataset: Dataset, subject: str, camera_id: str, versions: tuple[int, ...]
) -> np.ndarray | None:
    return read_plate_image(dataset, subject, camera_id)


def evened(picture: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3) uint8 without its camera's gain (3,) of linear light."""
    return picture if (gain == 1).all() else scale_light(picture, 1.0 / gain)
