"""What the stage reads of the footage: landmarks, outlines and crops, at peaks and in clips."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from express50.capture.frames import (
    read_cameras_of,
    read_frame,
    read_peak_frame,
    read_peaks,
)
from express50.contract.layout import Dataset
from express50.errors import CaptureError
from express50.files.images import read_alpha
from express50.geometry.cameras import Camera
from express50.landmarks.sources import Source, open_source
from pipelines.track.config import TrackConfig
from pipelines.track.lids import shut_lids
from pipelines.track.observe import Observation, View, agree, make_view
from pipelines.track.outline import signed_distance
from pipelines.track.pictures import Moment
from pipelines.track.shots import Shot, cut_shot
from pipelines.track.state import Target

Read = Callable[[str], np.ndarray]
"""Camera id to its undistorted image (H, W, 3) uint8; raises CaptureError."""


def open_landmarks(dataset: Dataset, subject: str, config: TrackConfig) -> Source:
    """The source of landmarks; files of points are of the footage as recorded."""
    recorded = read_cameras_of(dataset, subject, undistorted=False)
    return open_source(config.landmarks, recorded, config.refinements, config.search)


def observe_peaks(
    dataset: Dataset,
    subject: str,
    cameras: dict[str, Camera],
    source: Source,
    config: TrackConfig,
    dropped: list[dict[str, str]],
) -> list[Observation]:
    """Detect landmarks at every peak in every camera, reject what does not agree, shut eyes."""
    peaks = read_peaks(dataset, subject)
    # The neutral frame shows which cameras see the face; the others need not look again.
    order = sorted(peaks, key=lambda name: (name != config.neutral, list(peaks).index(name)))
    chosen = list(cameras)
    found = {}
    for expression in order:
        now = {name: cameras[name] for name in chosen}
        try:
            read = _peak_reader(dataset, subject, expression)
            views = _views(read, now, peaks[expression], source, config)
        except CaptureError as error:
            dropped.append({"what": expression, "why": str(error)})
            continue
        if config.cameras and len(chosen) > config.cameras and len(views) >= config.cameras:
            views = sorted(views, key=lambda view: float(np.median(view.sigma)) / view.score)
            views = views[: config.cameras]
            chosen = sorted(view.camera_id for view in views)
        if not views:
            dropped.append({"what": expression, "why": "no camera sees a face"})
            continue
        observation, refused = agree(expression, peaks[expression], views)
        for camera_id in refused:
            why = "its landmarks disagree with the other cameras"
            dropped.append({"what": f"{expression}/{camera_id}", "why": why})
        if observation.inliers.sum(1).max() < config.min_landmarks:
            count = int(observation.inliers.sum(1).max())
            dropped.append({"what": expression, "why": f"{count} landmarks agree between cameras"})
            continue
        found[expression] = observation
    return shut_lids([found[name] for name in peaks if name in found])


def _peak_reader(dataset: Dataset, subject: str, expression: str) -> Read:
    return lambda camera: read_peak_frame(dataset, subject, expression, camera)


def _views(
    read: Read,
    cameras: dict[str, Camera],
    frame: int,
    source: Source,
    config: TrackConfig,
) -> list[View]:
    """Views with a face in them; a camera whose footage lacks the frame is skipped.

    Raises:
        CaptureError: no camera's footage has it.
    """
    views, missing = [], []
    for camera_id, camera in cameras.items():
        try:
            image = read(camera_id)
        except CaptureError as error:
            missing.append(error)
            continue
        seen = source(image, camera_id, frame)
        if seen.face.score >= config.min_score and np.isfinite(seen.face.sigma).any():
            views.append(make_view(camera, seen))
    if missing and len(missing) == len(cameras):
        raise missing[0]
    return views


def observe_frame(
    dataset: Dataset,
    subject: str,
    cameras: dict[str, Camera],
    cue: str,
    frame: int,
    source: Source,
    config: TrackConfig,
) -> Observation | None:
    """What the cameras see at a frame of a clip; None where that is no face they agree on."""
    try:
        views = _views(
            lambda camera: read_frame(dataset, subject, camera, frame),
            cameras, frame, source, config,
        )  # fmt: skip
    except CaptureError:
        return None
    observation = agree(cue, frame, views)[0] if views else None
    enough = observation and observation.inliers.sum(1).max() >= config.min_landmarks
    return observation if enough else None


def peak_moments(
    dataset: Dataset, subject: str, targets: list[Target], meshes: np.ndarray, config: TrackConfig
) -> list[Moment]:
    """Outlines and crops of every expression, of all cameras: those behind it see the skull."""
    cameras = read_cameras_of(dataset, subject)
    moments = []
    for target, mesh in zip(targets, meshes, strict=True):
        observation = target.observation
        distances, shots = [], []
        for camera_id, camera in cameras.items():
            path = dataset.matte_file(subject, observation.expression, camera_id)
            alpha = read_alpha(path) if path.is_file() else None
            if alpha is not None and config.silhouette_rounds:
                distances.append(signed_distance(alpha, camera))
            if config.photo_rounds or config.relief_rounds:
                read = _peak_reader(dataset, subject, observation.expression)
                shots.append(_shot(read, camera, alpha, mesh, config))
        moments.append(
            Moment(tuple(d for d in distances if d), tuple(shot for shot in shots if shot))
        )
    return moments


def frame_moment(
    dataset: Dataset,
    subject: str,
    cameras: dict[str, Camera],
    frame: int,
    mesh: np.ndarray,
    config: TrackConfig,
) -> Moment:
    """Crops of a frame of a clip about its mesh (V, 3); such frames have no mattes."""

    def read(camera: str) -> np.ndarray:
        return read_frame(dataset, subject, camera, frame)

    shots = [_shot(read, camera, None, mesh, config) for camera in cameras.values()]
    return Moment((), tuple(shot for shot in shots if shot))


def _shot(
    read: Read,
    camera: Camera,
    alpha: np.ndarray | None,
    mesh: np.ndarray,
    config: TrackConfig,
) -> Shot | None:
    """A camera's crop about the head; None where its footage lacks the frame or the head."""
    try:
        image = read(camera.id)
    except CaptureError:
        return None
    return cut_shot(camera, image, alpha, mesh, config.photo_side)
