"""What the regions stage reads: tracked heads, frames with their mattes, depth maps."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from express50.capture.frames import read_peak_frame
from express50.contract.layout import Dataset
from express50.dataset.depth_files import depth_file, read_depth
from express50.dataset.tracks import read_track, track_file
from express50.errors import FormatError, StageError
from express50.files.images import read_alpha
from express50.geometry.cameras import Camera
from express50.head.load import load_head
from pipelines.regions.config import RegionsConfig
from pipelines.regions.labels import HeadLabels, head_labels
from pipelines.regions.mesh import TrackedHead, make_head


def read_head(dataset: Dataset, subject: str, expression: str) -> TrackedHead:
    """The tracked mesh of one expression.

    Raises:
        StageError: the subject or the expression is not tracked.
        FormatError: the track does not fit its head model, or is not finite.
    """
    path = track_file(dataset, subject)
    track = read_track(path)
    row, labels = track.row(expression), _labels_of(track.head)
    vertices = track.vertices[row].astype(np.float64)
    if vertices.shape != (len(labels.vertices), 3):
        raise FormatError(
            f"{path}: vertices {vertices.shape}, expected ({len(labels.vertices)}, 3) of its head"
            " model; run 'express50 track' again"
        )
    return make_head(vertices, track.R[row], labels)


@lru_cache(maxsize=2)
def _labels_of(head: str) -> HeadLabels:
    return head_labels(load_head(head))


def read_pair(dataset: Dataset, item: str, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Undistorted frame (H, W, 3) uint8 and alpha (H, W) float32 of one camera.

    Raises:
        StageError: it has no matte.
        FormatError: the matte is no 8-bit grey image of the camera's size.
        CaptureError: the frame cannot be read.
    """
    subject, expression = item.split("/")
    path = dataset.matte_file(subject, expression, camera.id)
    if not path.is_file():
        raise StageError("it has no matte")
    matte = read_alpha(path)
    if matte.shape != (camera.height, camera.width):
        raise FormatError(
            f"{path}: {matte.shape[1]}x{matte.shape[0]}, expected the camera's"
            f" {camera.width}x{camera.height}; run 'express50 matte' again"
        )
    image = read_peak_frame(dataset, subject, expression, camera.id)
    return image, matte.astype(np.float32) / 255


def read_depth_of(
    dataset: Dataset, item: str, camera: Camera, config: RegionsConfig
) -> np.ndarray | None:
    """Depth (H, W) metres, 0 where unknown, if there is any and it is wanted.

    Raises:
        FormatError: it is no depth map of the camera's size.
    """
    path = depth_file(dataset.item_dir("depth", item), camera.id)
    if not config.depth or path is None:
        return None
    depth, _ = read_depth(path)
    if depth.shape != (camera.height, camera.width):
        raise FormatError(
            f"{path}: {depth.shape}, expected the camera's {camera.width}x{camera.height}; run"
            " 'express50 depth' again"
        )
    return depth
