"""Read what tracking needs: landmarks, outlines and head crops, at peaks and in clips."""

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
from express50.contract.stage import Note
from express50.errors import CaptureError
from express50.files.images import read_alpha
from express50.geometry.cameras import Camera
from express50.landmarks.sources import Source, open_source
from pipelines.track.crops import FrameSetCrops, HeadCrop, cut_crop
from pipelines.track.eyes_and_jaw import shut_lids
from pipelines.track.observe import LandmarkView, Observation, agree, make_view
from pipelines.track.outline import signed_distance

MIN_SCORE = 0.2  # views with a lower face score are left out
MIN_LANDMARKS = 20  # that must agree between the cameras of an expression
Read = Callable[[str], np.ndarray]
"""Read a camera's undistorted image (H, W, 3) uint8 by its id; raises CaptureError."""

DETECTOR_PASSES = 3  # crops after the coarse pass; 1 measures the same on the twin


def open_landmarks(dataset: Dataset, subject: str, landmarks: str, search: float) -> Source:
    """Open the source of landmarks; files of points refer to the footage as recorded."""
    recorded = read_cameras_of(dataset, subject, undistorted=False)
    return open_source(landmarks, recorded, DETECTOR_PASSES, search)


def observe_peaks(
    dataset: Dataset,
    subject: str,
    cameras: dict[str, Camera],
    source: Source,
    neutral: str,
    most: int,
) -> tuple[list[Observation], list[Note]]:
    """Detect landmarks at every peak, reject outlying views and find shut eyes.

    With `most` above 0 only so many cameras are used: those that see the neutral frame best.
    """
    dropped: list[Note] = []
    peaks = read_peaks(dataset, subject)
    order = sorted(peaks, key=lambda name: (name != neutral, list(peaks).index(name)))
    chosen = list(cameras)
    found = {}
    for expression in order:
        now = {name: cameras[name] for name in chosen}
        try:
            read = _peak_reader(dataset, subject, expression)
            views = _views(read, now, peaks[expression], source)
        except CaptureError as error:
            dropped.append(Note(expression, str(error)))
            continue
        if most and len(chosen) > most and len(views) >= most:
            views = sorted(views, key=lambda view: float(np.median(view.sigma)) / view.score)
            views = views[:most]
            chosen = sorted(view.camera_id for view in views)
        if not views:
            dropped.append(Note(expression, "no camera sees a face"))
            continue
        observation, refused = agree(expression, peaks[expression], views)
        why = "its landmarks disagree with the other cameras"
        dropped += [Note(f"{expression}/{camera_id}", why) for camera_id in refused]
        count = int(observation.inliers.sum(1).max())
        if count < MIN_LANDMARKS:
            dropped.append(Note(expression, f"{count} landmarks agree between cameras"))
            continue
        found[expression] = observation
    return shut_lids([found[name] for name in peaks if name in found]), dropped


def observe_frame(
    dataset: Dataset,
    subject: str,
    cameras: dict[str, Camera],
    cue: str,
    frame: int,
    source: Source,
) -> Observation | None:
    """Observe a frame of a clip; None where the cameras agree on no face."""
    try:
        read = _frame_reader(dataset, subject, frame)
        views = _views(read, cameras, frame, source)
    except CaptureError:
        return None
    observation = agree(cue, frame, views)[0] if views else None
    enough = observation and observation.inliers.sum(1).max() >= MIN_LANDMARKS
    return observation if enough else None


def _peak_reader(dataset: Dataset, subject: str, expression: str) -> Read:
    return lambda camera: read_peak_frame(dataset, subject, expression, camera)


def _frame_reader(dataset: Dataset, subject: str, frame: int) -> Read:
    return lambda camera: read_frame(dataset, subject, camera, frame)


def _views(
    read: Read, cameras: dict[str, Camera], frame: int, source: Source
) -> list[LandmarkView]:
    """Return the views with a face; a camera whose footage lacks the frame is skipped.

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
        if seen.face.score >= MIN_SCORE and np.isfinite(seen.face.sigma).any():
            views.append(make_view(camera, seen))
    if missing and len(missing) == len(cameras):
        raise missing[0]
    return views


def peak_pictures(
    dataset: Dataset, subject: str, observation: Observation, mesh: np.ndarray, side: int
) -> FrameSetCrops:
    """Read a peak's outlines and crops about its mesh (V, 3) from all cameras.

    Cameras behind the head have no landmarks but see the skull.
    """
    distances, crops = [], []
    read = _peak_reader(dataset, subject, observation.expression)
    for camera_id, camera in read_cameras_of(dataset, subject).items():
        path = dataset.matte_file(subject, observation.expression, camera_id)
        alpha = read_alpha(path) if path.is_file() else None
        if alpha is not None:
            distances.append(signed_distance(alpha, camera))
        crops.append(_crop(read, camera, alpha, mesh, side))
    return FrameSetCrops(
        tuple(one for one in distances if one), tuple(crop for crop in crops if crop)
    )


def frame_pictures(
    dataset: Dataset, subject: str, frame: int, mesh: np.ndarray, side: int
) -> FrameSetCrops:
    """Read the crops of a frame of a clip about its mesh (V, 3); such frames have no mattes."""
    cameras = read_cameras_of(dataset, subject).values()
    read = _frame_reader(dataset, subject, frame)
    crops = [_crop(read, camera, None, mesh, side) for camera in cameras]
    return FrameSetCrops((), tuple(crop for crop in crops if crop))


def _crop(
    read: Read,
    camera: Camera,
    alpha: np.ndarray | None,
    mesh: np.ndarray,
    side: int,
) -> HeadCrop | None:
    """Cut a camera's crop about the head; None where its footage lacks the frame or the head."""
    try:
        image = read(camera.id)
    except CaptureError:
        return None
    return cut_crop(camera, image, alpha, mesh, side)
