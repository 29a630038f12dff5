"""Read what tracking needs: landmarks, outlines and head crops, at peaks and in clips."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from express50.capture.frames import (
    FootageReader,
    read_cameras_of,
    read_peak_frame,
    read_recorded_cameras,
)
from express50.capture.index import read_peaks
from express50.contract.layout import Dataset
from express50.contract.stage import Note
from express50.errors import CaptureError
from express50.files.images import read_alpha
from express50.geometry.cameras import Camera, project_pinhole
from express50.landmarks import EMBEDDED
from express50.landmarks.detector import SMALL, Detection, detect_at, follow, window_about
from express50.landmarks.irises import find_irises
from express50.landmarks.network import LandmarkNet, face_box, load_network
from express50.landmarks.sources import Marked, Source, open_source
from pipelines.calibrate.footage_rig import mean_landmarks
from pipelines.track.eyes_and_jaw import shut_lids
from pipelines.track.observe import LandmarkView, Observation, place_head, triangulate_views
from pipelines.track.outline import matte_distance
from pipelines.track.surface import CutCrops, FrameSetCrops, cut_crop, root_light

MIN_SCORE = 0.2  # views with a lower face score are left out
MIN_LANDMARKS = 20  # that must agree between the cameras of an expression
Read = Callable[[str], np.ndarray]
"""Read a camera's undistorted image (H, W, 3) uint8 by its id; raises CaptureError."""

DETECTOR_PASSES = 3  # crops after the coarse pass; 1 measures the same on the twin
FOLLOWED_VIEWS = 10  # the most frontal ones, in which a clip's face is followed; more add nothing
LEAST_FACING = 0.1  # cosine between the face's direction and that to a camera in which to look
RECENTRE_SHARE = 0.12  # share of a crop: a face further from its middle is looked at again
# A followed face is lost unless more than this share of its views has at least this score.
FOLLOWED_SHARE, FOLLOWED_SCORE = 0.5, 0.5

Follow = Callable[[np.ndarray, np.ndarray], Marked]
"""Look at an image (H, W, 3) where landmarks (68, 2), pixels, are expected."""
FindFace = Callable[[np.ndarray | None], Observation | None]
"""Find a frame set's face near expected landmarks (68, 3), or anywhere; None if there is none."""


def open_landmarks(dataset: Dataset, subject: str, landmarks: str, search: float) -> Source:
    """Open the source of landmarks; files of points refer to the footage as recorded."""
    recorded, seen = read_recorded_cameras(dataset, subject), read_cameras_of(dataset, subject)
    return open_source(landmarks, recorded, DETECTOR_PASSES, search, seen)


def open_follower(
    landmarks: str, detector: Callable[[LandmarkNet, np.ndarray, np.ndarray], Detection] = follow
) -> Follow | None:
    """Return the function that follows a face through a clip; None for sources that have none.

    `detector` is `follow`, or `detect_at`, which takes longer and scores as `detect` does.
    """
    if landmarks != EMBEDDED:
        return None
    net = load_network()

    def look(image: np.ndarray, expected: np.ndarray) -> Marked:
        window = window_about(expected)
        face = detector(net, image, window)
        middle, side = face_box(face.points)
        if np.linalg.norm(middle - face_box(expected)[0]) > RECENTRE_SHARE * side:
            face = detector(net, image, window_about(face.points))
        return Marked(face, find_irises(image, face), visible_contour=False)

    return look


def observe_peaks(
    dataset: Dataset, subject: str, landmarks: str, search: float, neutral: str, max_cameras: int
) -> tuple[list[Observation], list[Note]]:
    """Detect landmarks at every peak, reject outlying views and find shut eyes.

    If `max_cameras` is above 0, only the cameras that see the neutral frame best are used.
    """
    follow = open_follower(landmarks, detect_at)
    searches = (search, SMALL) if search > SMALL and follow else (search,)
    sources = [open_landmarks(dataset, subject, landmarks, smallest) for smallest in searches]
    dropped: list[Note] = []
    peaks, cameras = read_peaks(dataset, subject), read_cameras_of(dataset, subject)
    found = {}
    for expression in sorted(peaks, key=lambda name: name != neutral):
        read = partial(read_peak_frame, dataset, subject, expression)
        try:
            views = search_all_views(read, cameras, peaks[expression], sources, follow)
        except CaptureError as error:
            dropped.append(Note(expression, str(error)))
            continue
        if max_cameras and len(cameras) > max_cameras and len(views) >= max_cameras:
            views = sorted(views, key=lambda view: view.doubt)[:max_cameras]
            cameras = {name: cameras[name] for name in sorted(view.camera_id for view in views)}
        if not views:
            dropped.append(Note(expression, "no camera sees a face"))
            continue
        observation, refused = triangulate_views(expression, peaks[expression], views)
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
    follow: Follow | None,
    peaks: list[Observation],
    side: int,
    cue: str,
    frames: Sequence[int],
) -> Iterator[tuple[FindFace, CutCrops]]:
    """Yield, per frame set of a clip, functions that find its face and cut its crops.

    Each frame is decoded once. Faces are searched for by the source, or followed from where they
    are expected. Crops have at most `side` pixels and no mattes. The functions work until the next
    frame set is taken.
    """
    cameras = read_cameras_of(dataset, subject)
    with FootageReader(dataset, subject) as footage:
        for frame in frames:
            images = {}
            for camera_id in cameras:
                with suppress(CaptureError):  # this camera's footage lacks the frame
                    images[camera_id] = footage.read(camera_id, frame)
            seen = {camera_id: cameras[camera_id] for camera_id in images}
            read = images.__getitem__
            look = partial(_find_face, read, seen, source, follow, peaks, cue, frame)
            yield look, partial(_frame_crops, seen, images, side)


def _find_face(
    read: Read,
    cameras: dict[str, Camera],
    source: Source,
    follow: Follow | None,
    peaks: list[Observation],
    cue: str,
    frame: int,
    expected: np.ndarray | None,
) -> Observation | None:
    """Find a face near expected landmarks (68, 3), else where it was at the peak, else anywhere."""
    places = [] if expected is None else [expected]
    places += [peak.points for peak in peaks if peak.expression == cue]
    found = None
    for place in places:
        if follow is not None and found is None and np.isfinite(place).all():
            near = [
                _near(read, cameras[name], follow, place)
                for name in _facing_cameras(cameras, place)
            ]
            views = [view for view in near if view is not None]
            sure = sum(view.score >= FOLLOWED_SCORE for view in views)
            found = agreed(cue, frame, views if sure > FOLLOWED_SHARE * len(near) else [])
    if found is None:
        found = agreed(cue, frame, search_views(read, cameras, frame, source))
    # A clip may be one long blink: the peaks show what open eyes look like.
    return None if found is None else shut_lids([found], peaks)[0]


def agreed(cue: str, frame: int, views: list[LandmarkView]) -> Observation | None:
    """Return what the views agree on; None if that is not a face."""
    observation = triangulate_views(cue, frame, views)[0] if views else None
    if observation is None or observation.inliers.sum(1).max() < MIN_LANDMARKS:
        return None
    return observation


def _near(read: Read, camera: Camera, follow: Follow, expected: np.ndarray) -> LandmarkView | None:
    """Look for a face near expected landmarks (68, 3) in one camera; None if it is not there."""
    seen = follow(read(camera.id), project_pinhole(camera, expected)[0])
    return _landmark_view(camera, seen) if seen.face.score >= MIN_SCORE else None


def _facing_cameras(cameras: Mapping[str, Camera], marks: np.ndarray) -> list[str]:
    """Choose the cameras that a face with landmarks (68, 3) is turned to and that picture it."""
    across, up = marks[45] - marks[36], marks[27] - marks[8]
    forward, middle = np.cross(across, up), marks.mean(0)
    facing = {}
    for name, camera in cameras.items():
        towards = camera.center - middle
        pixels, depth = project_pinhole(camera, middle)
        inside = (pixels > 0).all() and (pixels < (camera.width, camera.height)).all()
        if depth > 0 and inside:
            length = np.linalg.norm(forward) * np.linalg.norm(towards)
            facing[name] = float(forward @ towards) / max(float(length), 1e-12)
    best = sorted(facing, key=lambda name: (-facing[name], name))[:FOLLOWED_VIEWS]
    return sorted(name for name in best if facing[name] > LEAST_FACING)


def _landmark_view(camera: Camera, seen: Marked) -> LandmarkView:
    face = seen.face
    return LandmarkView(
        camera, face.points, face.sigma, face.score, seen.irises,
        visible_contour=seen.visible_contour,
    )  # fmt: skip


def _frame_crops(
    cameras: dict[str, Camera], images: dict[str, np.ndarray], side: int, mesh: np.ndarray
) -> FrameSetCrops:
    """Cut the crops of a frame of a clip about its mesh (V, 3)."""
    found = [cut_crop(cameras[name], image, None, mesh, side) for name, image in images.items()]
    crops = tuple(crop for crop in found if crop)
    return FrameSetCrops((), crops, tuple(root_light(crop) for crop in crops))


def search_views(
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
            views.append(_landmark_view(camera, seen))
    if missing and len(missing) == len(cameras):
        raise missing[0]
    return views


def search_all_views(
    read: Read, cameras: dict[str, Camera], frame: int, sources: Sequence[Source],
    follow: Follow | None,
) -> list[LandmarkView]:  # fmt: skip
    """Return the views with a face, searching harder where cameras do not show one.

    While fewer than two cameras show a face, the next of `sources` searches the other cameras. Then
    the other cameras are searched where the rig says that the face must be, so that small faces and
    faces on their side are found.

    Raises:
        CaptureError: no camera's footage has the frame.
    """
    views: dict[str, LandmarkView] = {}
    for source in sources:
        if len(views) < min(2, len(cameras)):
            rest = {name: cameras[name] for name in cameras if name not in views}
            try:
                seen = search_views(read, rest, frame, source)
            except CaptureError:
                if not views:
                    raise
                break  # none of the rest has the frame
            views |= {view.camera_id: view for view in seen}
    place = place_head(list(views.values()))
    if follow is not None and place is not None:
        scale, rotation, shift = place
        expected = scale * mean_landmarks() @ rotation.T + shift
        rest = {name: cameras[name] for name in cameras if name not in views}
        for name in _facing_cameras(rest, expected):
            with suppress(CaptureError):  # this camera's footage lacks the frame
                if (view := _near(read, cameras[name], follow, expected)) is not None:
                    views[name] = view
    return [views[name] for name in cameras if name in views]


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
            distances.append(matte_distance(alpha, camera))
        with suppress(CaptureError):  # the frames stage left this camera out
            crops.append(cut_crop(camera, read(camera_id), alpha, mesh, side))
    return FrameSetCrops(
        tuple(one for one in distances if one), tuple(crop for crop in crops if crop)
    )
