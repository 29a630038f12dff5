"""Read what tracking needs: landmarks, outlines and head crops, at peaks and in clips."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from express50.capture.frames import FootageReader, read_cameras_of, read_peak_frame
from express50.capture.index import read_peaks
from express50.contract.layout import Dataset
from express50.contract.stage import Note
from express50.errors import CaptureError
from express50.files.images import read_alpha
from express50.geometry.cameras import Camera
from express50.landmarks.sources import Source, open_source
from pipelines.track.eyes_and_jaw import shut_lids
from pipelines.track.observe import LandmarkView, Observation, agree
from pipelines.track.outline import signed_distance
from pipelines.track.surface import CutCrops, FrameSetCrops, cut_crop

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
    dataset: Dataset, subject: str, source: Source, neutral: str, most: int
) -> tuple[list[Observation], list[Note]]:
    """Detect landmarks at every peak, reject outlying views and find shut eyes.

    With `most` above 0 only so many cameras are used: those that see the neutral frame best.
    """
    dropped: list[Note] = []
    peaks, cameras = read_peaks(dataset, subject), read_cameras_of(dataset, subject)
    found = {}
    for expression in sorted(peaks, key=lambda name: name != neutral):
        read = partial(read_peak_frame, dataset, subject, expression)
        try:
            views = _views(read, cameras, peaks[expression], source)
        except CaptureError as error:
            dropped.append(Note(expression, str(error)))
            continue
        if most and len(cameras) > most and len(views) >= most:
            views = sorted(views, key=lambda view: float(np.median(view.sigma)) / view.score)
            views = views[:most]
            cameras = {name: cameras[name] for name in sorted(view.camera_id for view in views)}
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


def read_clip(
    dataset: Dataset,
    subject: str,
    source: Source,
    peaks: list[Observation],
    side: int,
    cue: str,
    frames: Sequence[int],
) -> Iterator[tuple[Observation, CutCrops]]:
    """Yield what the cameras see of a clip, frame set by frame set; each frame is decoded once.

    Frames where the cameras agree on no face are left out. Crops, of at most `side` pixels, have no
    mattes; they can be cut until the next frame set is asked for.
    """
    cameras = read_cameras_of(dataset, subject)
    with FootageReader(dataset, subject) as footage:
        for frame in frames:
            images = {}
            for camera_id in cameras:
                with suppress(CaptureError):  # this camera's footage lacks the frame
                    images[camera_id] = footage.read(camera_id, frame)
            seen = {camera_id: cameras[camera_id] for camera_id in images}
            views = _views(images.__getitem__, seen, frame, source)
            observation = agree(cue, frame, views)[0] if views else None
            if observation is None or observation.inliers.sum(1).max() < MIN_LANDMARKS:
                continue
            # A clip may be one long blink: the peaks show what open eyes look like.
            yield shut_lids([observation], peaks)[0], partial(_frame_crops, seen, images, side)


def _frame_crops(
    cameras: dict[str, Camera], images: dict[str, np.ndarray], side: int, mesh: np.ndarray
) -> FrameSetCrops:
    """Cut the crops of a frame of a clip about its mesh (V, 3)."""
    crops = [cut_crop(cameras[name], image, None, mesh, side) for name, image in images.items()]
    return FrameSetCrops((), tuple(crop for crop in crops if crop))


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
        face = seen.face
        if face.score >= MIN_SCORE and np.isfinite(face.sigma).any():
            view = LandmarkView(
                camera.id, camera, face.points, face.sigma, face.score, seen.irises,
                visible_contour=seen.visible_contour,
            )  # fmt: skip
            views.append(view)
    if missing and len(missing) == len(cameras):
        raise missing[0]
    return views


def peak_pictures(
    dataset: Dataset, subject: str, side: int, expression: str, mesh: np.ndarray
) -> FrameSetCrops:
    """Read a peak's outlines and crops about its mesh (V, 3) from all cameras.

    Cameras behind the head have no landmarks but see the skull.
    """
    distances, crops = [], []
    read = partial(read_peak_frame, dataset, subject, expression)
    for camera_id, camera in read_cameras_of(dataset, subject).items():
        path = dataset.matte_file(subject, expression, camera_id)
        alpha = read_alpha(path) if path.is_file() else None
        if alpha is not None:
            distances.append(signed_distance(alpha, camera))
        with suppress(CaptureError):  # the frames stage left this camera out
            crops.append(cut_crop(camera, read(camera_id), alpha, mesh, side))
    return FrameSetCrops(
        tuple(one for one in distances if one), tuple(crop for crop in crops if crop)
    )
