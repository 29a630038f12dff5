"""Compare imports to the faces that the footage shows."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import partial

import cv2
import numpy as np

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.contract.layout import Dataset
from express50.contract.stage import Note
from express50.errors import CaptureError, StageError
from express50.geometry.cameras import Camera, inside_frame, project_pinhole
from express50.geometry.pixels import disc
from express50.landmarks import EMBEDDED
from pipelines.calibrate.footage_rig import INNER
from pipelines.imports.pictures import PeakFrame, pixels_showing
from pipelines.track.observe import Observation
from pipelines.track.read_inputs import agreed, open_landmarks, search_views

# Share of a face's height. Tracks of the twin are 0.012 to 0.017 off the landmarks found, those of
# another person in the same place 0.04 to 0.15.
LEAST_OFF = 0.035
INSIDE_SHARE = 0.7  # of a face's landmarks that masks must hold
# Contrasts of the twin's mattes are 4 and 5, those of other people's 1.0 to 1.6.
LEAST_CONTRAST, BESIDE, RIM = 2.0, 0.04, 3
LEAST_MARKS = 8
# Depth of the twin is 0.003 m off triangulated landmarks, that of other people 0.01 to 0.02.
DEPTH_OFF_M = 0.008
SEARCH = 0.25  # smallest window searched for a face, as in tracking
NO_FACE = "the footage shows no face on which two cameras agree, so nothing was compared to it"


def observe_peak(
    dataset: Dataset, subject: str, peak: PeakFrame, notes: list[Note]
) -> Observation | None:
    """Find the face of a peak frame in the footage; None, and a note, where cameras see none."""
    source = open_landmarks(dataset, subject, EMBEDDED, SEARCH)
    read, views = partial(read_peak_frame, dataset, subject, peak.expression), []
    with suppress(CaptureError):
        views = search_views(read, read_cameras_of(dataset, subject), peak.frame, source)
    found = agreed(peak.expression, peak.frame, views)
    if found is None:
        notes.append(Note(peak.expression, NO_FACE))
    return found


def check_in_view(cameras: Mapping[str, Camera], vertices: np.ndarray, where: str) -> None:
    """Raise StageError if at most half of the cameras see the middle of a mesh (V, 3), world."""
    middle = vertices.mean(0, dtype=np.float64)[None]
    seen = sum(bool(inside_frame(camera, middle)[1]) for camera in cameras.values())
    if 2 * seen <= len(cameras):
        raise StageError(
            f"{where}: {seen} of {len(cameras)} cameras have the head in their picture: the track"
            " is not in metres, or not in the world of its cameras; name those that"
            " tracked_flame_params_N.npz was made with (--cameras)"
        )


def check_landmarks(observation: Observation | None, marks: np.ndarray, where: str) -> float | None:
    """Return how far landmarks (68, 3), world, are off those seen; None if none are.

    It is the median of their distances over the height of the face.

    Raises:
        StageError: it is not this face in this frame.
    """
    errors = []
    pairs = () if observation is None else zip(observation.views, observation.inliers, strict=True)
    for view, inliers in pairs:
        used = inliers[INNER]
        if used.sum() >= LEAST_MARKS:
            pixels, ahead = project_pinhole(view.camera, marks[INNER])
            away = np.linalg.norm(pixels - view.points[INNER], axis=1)
            away[(ahead <= 0) | ~np.isfinite(away)] = np.inf
            errors.append(np.median(away[used]) / max(float(np.ptp(view.points[:, 1])), 1.0))
    if not errors:
        return None
    error = float(np.median(errors))
    if error > LEAST_OFF:
        raise StageError(
            f"{where}: its landmarks are {100 * min(error, 99):.0f} % of the face's height off"
            f" those that the footage shows, expected under {100 * LEAST_OFF:.0f} %: it is of"
            " another subject, frame or world"
        )
    return round(error, 4)


def check_masks_show_face(
    observation: Observation | None, masks: Mapping[str, np.ndarray], where: str
) -> None:
    """Raise StageError if masks (H, W) uint8 by camera leave out the face that cameras see."""
    shares, covers = [], []
    pairs = () if observation is None else zip(observation.views, observation.inliers, strict=True)
    for view, inliers in pairs:
        alpha = masks[view.camera_id]
        pixels = view.points[INNER][inliers[INNER]].astype(int)
        pixels = pixels[((pixels >= 0) & (pixels < alpha.shape[::-1])).all(1)]
        if len(pixels) >= LEAST_MARKS:
            shares.append((alpha[pixels[:, 1], pixels[:, 0]] > 127).mean())
            covers.append((alpha > 127).mean())
    if not shares or (inside := float(np.median(shares))) >= INSIDE_SHARE:
        return
    why = "they cut into the face"
    if inside < 1 - INSIDE_SHARE:
        most = np.median(covers) > 0.5
        why = "they are inverted" if most else "they are of another subject, frame or camera"
    raise StageError(f"{where}: its masks hold {inside:.0%} of the face's landmarks: {why}")


def edge_contrast(picture: np.ndarray, alpha: np.ndarray) -> float:
    """Return how much steeper a picture (H, W, 3) uint8 is at a mask's outline than beside it.

    ``alpha`` (H, W) is uint8; beside it is 4 % of the mask's size inside and outside.
    """
    smooth = cv2.GaussianBlur(picture, (0, 0), 1.0).astype(np.float32)
    steep = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    steep = np.linalg.norm(steep, axis=2)
    mask = (alpha > 127).astype(np.uint8)
    away = max(2, int(BESIDE * np.sqrt(mask.sum())))

    def level(shape: np.ndarray) -> float:
        line = cv2.dilate(shape, disc(1)) > cv2.erode(shape, disc(1))
        line[:RIM], line[-RIM:], line[:, :RIM], line[:, -RIM:] = False, False, False, False
        return float(steep[line].mean()) if line.any() else 0.0

    beside = level(cv2.dilate(mask, disc(away))) + level(cv2.erode(mask, disc(away)))
    return level(mask) / max(beside / 2, 1e-3)


def check_outlines(
    pictures: Mapping[str, np.ndarray], masks: Mapping[str, np.ndarray], where: str
) -> float:
    """Return the median edge contrast of masks (H, W) uint8 in pictures (H, W, 3) by camera.

    Raises:
        StageError: their outlines are not where the pictures have edges.
    """
    found = float(np.median([edge_contrast(pictures[name], masks[name]) for name in masks]))
    if found < LEAST_CONTRAST:
        raise StageError(
            f"{where}: the pictures change {found:.1f} times as fast at the masks' outlines as"
            f" beside them, expected {LEAST_CONTRAST} or more: the masks are of another subject or"
            " frame, or distorted (--distorted)"
        )
    return round(found, 2)


def check_face_depth(
    observation: Observation | None, cameras: Mapping[str, Camera], depths: Mapping, where: str
) -> float | None:
    """Return the median metres between maps (H, W), metres, and triangulated landmarks.

    None if the footage shows no face that two cameras agree on.

    Raises:
        StageError: they are too far apart.
    """
    if observation is None:
        return None
    names = [view.camera_id for view in observation.views]
    pairs = [pixels_showing(cameras[n], depths[n], observation.points[INNER]) for n in names]
    found, z = np.hstack([np.stack(pair)[:, pair[0] > 0] for pair in pairs])
    if len(found) < LEAST_MARKS:
        return None
    middle, ratio = float(np.median(np.abs(found - z))), float(np.median(z / found))
    if not 0.8 < ratio < 1.25:
        raise StageError(
            f"{where}: the face in the footage is {ratio:.3g} times as far away as this depth"
            f" says: its unit is {ratio:.3g} times the one given"
        )
    if middle > DEPTH_OFF_M:
        raise StageError(
            f"{where}: is {1e3 * middle:.0f} mm (median) off the face that the footage shows,"
            f" expected under {1e3 * DEPTH_OFF_M:.0f} mm: it is of another subject or frame"
        )
    return round(middle, 5)
