"""One picture that shows a single-view track: the photo, the fit over it, and the head turned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.contract.layout import Dataset
from express50.files.images import write_image
from express50.head.load import load_head
from express50.head.preview import render_preview
from express50.landmarks.sources import open_source
from pipelines.track.config import TrackConfig
from pipelines.track.read_inputs import DETECTOR_PASSES
from pipelines.track.report import draw_column

TILE, TURNED = 512, 60.0


def write_panel(dataset: Dataset, subject: str, config: TrackConfig, path: Path) -> None:
    """Write frame, overlay and turned head side by side, of the first frame that was tracked.

    From the side shows what a single view cannot: whether the depth is a head's.
    """
    with np.load(dataset.track_file(subject)) as track:
        frame, mesh = int(track["frames"][0]), track["vertices"][0].astype(np.float64)
        expression = str(track["expressions"][0])
        rotation, translation = track["R"][0], track["t"][0]
    model = load_head(config.head)
    ((camera_id, camera),) = read_cameras_of(dataset, subject).items()
    image = read_peak_frame(dataset, subject, expression, camera_id)
    recorded = read_cameras_of(dataset, subject, undistorted=False)
    source = open_source(config.landmarks, recorded, DETECTOR_PASSES, config.search)
    seen = source(image, camera_id, frame)
    dots = [seen.face.points, seen.irises.centres[seen.irises.confidence > 0]]
    column = draw_column(image, camera, model.to(dtype=torch.float64), mesh, dots, TILE)
    head = (mesh - translation) @ rotation
    turned = render_preview(model, head, yaw=TURNED, size=TILE)
    write_image(path, np.concatenate([column[:TILE], column[TILE:], turned], axis=1), quality=90)
