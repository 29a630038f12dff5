"""Where the head is, from geometry alone, before any optimisation."""

from __future__ import annotations

import cv2
import numpy as np

from express50.errors import StageError
from express50.geometry.transforms import rigid_fit, similarity_fit
from pipelines.track.config import TrackConfig
from pipelines.track.fit import landmark_sigma
from pipelines.track.observe import Observation, facing

# Jaw-line points slide; brows to mouth are what a rigid alignment may trust.
INNER = np.arange(17, 68)
MIN_TRIANGULATED = 12
# How far, one by one, people's landmarks lie from the template's.
PERSON_M = 0.004
SCALE_LIMITS = (0.5, 2.0)
# Cosine to the camera under which a view is one from behind.
MIN_FACING = 0.05


def posed_sigma(
    observation: Observation, config: TrackConfig, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """`landmark_sigma` without the views from behind, where a detector can only guess."""
    sigma = landmark_sigma(observation, config)
    ahead = [facing(view, rotation, translation) for view in observation.views]
    sigma[np.array(ahead) < MIN_FACING] = np.inf
    return sigma


class RigScaleError(StageError):
    """The calibration's unit is not the metre: no expression can be tracked with it."""


def initial_pose(observation: Observation, template: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3,) with world = R @ head + t.

    Uses triangulated landmarks where enough exist (and checks that their size is a head's), else
    perspective-n-point in the surest view.

    Args:
        observation: Views of one expression.
        template: (68, 3) landmarks of the head model, metres.

    Raises:
        RigScaleError: the rig's unit is not the metre.
        StageError: too few landmarks.
    """
    seen = INNER[np.isfinite(observation.points[INNER]).all(1)]
    if len(seen) < MIN_TRIANGULATED:
        return _from_one_view(observation, template)
    scale = similarity_fit(template[seen], observation.points[seen])[0]
    if not SCALE_LIMITS[0] < scale < SCALE_LIMITS[1]:
        unit = _unit(scale)
        raise RigScaleError(
            f"{observation.expression}: the rig seems {unit}x off: the head measures "
            f"{scale:.3g} times a human head in the calibration's units; expected metres, divide "
            f"the camera translations by {unit} and calibrate again"
        )
    spread = np.trace(observation.covariance[seen], axis1=1, axis2=2) / 3.0
    # A point without a covariance is triangulated from all but one direction.
    spread = np.where(np.isfinite(spread), spread, np.inf)
    return rigid_fit(template[seen], observation.points[seen], 1.0 / (PERSON_M**2 + spread))


def _unit(scale: float) -> str:
    """What to divide by: a power of ten (heads differ, units do not) if one is near, or `scale`."""
    power = 10.0 ** round(float(np.log10(scale)))
    return f"{power:g}" if power != 1.0 and 1 / 1.5 < scale / power < 1.5 else f"{scale:.3g}"


def _from_one_view(observation: Observation, template: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose from the view with the smallest expected error."""
    view = min(observation.views, key=lambda view: float(np.median(view.sigma)) / view.score)
    best = np.argsort(view.sigma[INNER])[:36]
    best = best[np.isfinite(view.sigma[INNER[best]])]
    if len(best) < MIN_TRIANGULATED:
        raise StageError(
            f"{observation.expression}: {len(best)} points between brows and mouth are known in "
            f"{view.camera_id}, expected {MIN_TRIANGULATED} or more"
        )
    points, pixels = template[INNER[best]], view.points[INNER[best]]
    # EPnP needs no start; refined by Levenberg-Marquardt. OpenCV's K is given corner-origin pixels
    # together with a corner-origin principal point, so no shift is due.
    arguments = (np.ascontiguousarray(points), np.ascontiguousarray(pixels), view.camera.K, None)
    found, turn, shift = cv2.solvePnP(*arguments, flags=cv2.SOLVEPNP_EPNP)
    if not found:
        raise StageError(
            f"{observation.expression}: no pose explains the landmarks of {view.camera_id}; "
            "look at its overlay, the face may be hidden"
        )
    turn, shift = cv2.solvePnPRefineLM(*arguments, turn, shift)
    cam_from_head = np.eye(4)
    cam_from_head[:3, :3], cam_from_head[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    world = np.linalg.inv(view.camera.cam_from_world) @ cam_from_head
    return world[:3, :3], world[:3, 3]
