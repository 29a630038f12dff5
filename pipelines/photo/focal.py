"""Estimate the focal length of one camera from a face, with the range that fits as well.

Only perspective distinguishes a near face under a wide lens from a far one under a long lens: at
arm's length the nose is a twentieth nearer than the ears. The head model is fitted at a ladder of
focal lengths; the fit's cost shows which explain the landmarks as well as the best one does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from express50.errors import StageError
from express50.geometry.cameras import Camera, pinhole_camera
from express50.head.model import landmarks
from express50.landmarks.detector import Detection
from pipelines.track.basis import Basis
from pipelines.track.fit import fit
from pipelines.track.observe import LandmarkView, agree, landmark_sigma
from pipelines.track.schedule import LANDMARK_STEPS
from pipelines.track.state import Target, initial_pose, start_state

LADDER = 2.0 ** np.arange(-2.0, 2.5, 0.5)
# Two thirds of unknown lenses lie within this factor of the guess.
GUESS_FACTOR = 1.5
# The landmarks of one detection err together: they count as a quarter of their number.
INDEPENDENT = 0.25
# Focal lengths whose cost is this much above the least (two standard deviations) are as good.
AS_GOOD = 2.0
CONSTRAINED_FACTOR = 1.6
# World of a single camera: at the camera, y up, the camera looks along -z.
CAM_FROM_WORLD = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Focal:
    """A focal length and its evidence.

    Attributes:
        pixels: the focal length.
        source: `given`, `exif`, `guess`, or `fit` where the face moved the guess.
        low, high: the face is explained as well by any focal length between, pixels; the ends are
            those of the ladder where even these are as good.
    """

    pixels: float
    source: str
    low: float
    high: float


def single_camera(camera_id: str, width: int, height: int, focal: float) -> Camera:
    """Make a pinhole camera at the world's origin with the principal point in the middle."""
    K = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    return pinhole_camera(camera_id, K, width, height, CAM_FROM_WORLD)


def weigh_focal(
    basis: Basis,
    detections: list[Detection],
    size: tuple[int, int],
    start: tuple[float, str],
) -> Focal:
    """Move a guessed focal length to where the fit is best, if the fit constrains it.

    A known focal length (`given`, `exif`) is kept; the range is measured all the same.

    Args:
        basis: the head model.
        detections: faces of the same person in the same camera.
        size: image width and height.
        start: focal length in pixels and its source.

    Raises:
        StageError: no focal length of the ladder explains the landmarks.
    """
    focals = start[0] * LADDER
    costs = np.array([_cost(basis, detections, size, focal) for focal in focals])
    if not np.isfinite(costs).any():
        raise StageError("no pose of a head explains the landmarks; the face may be hidden")
    evidence = INDEPENDENT * costs / len(detections)
    as_good = focals[evidence <= evidence.min() + AS_GOOD]
    low, high = float(as_good.min()), float(as_good.max())
    constrained = high / low <= CONSTRAINED_FACTOR**2
    if start[1] != "guess" or not constrained:
        return Focal(*start, low, high)
    prior = 0.5 * (np.log(LADDER) / math.log(GUESS_FACTOR)) ** 2
    return Focal(start[0] * _lowest(np.log(LADDER), evidence + prior), "fit", low, high)


def _cost(
    basis: Basis,
    detections: list[Detection],
    size: tuple[int, int],
    focal: float,
) -> float:
    """Compute the cost of the landmark fit with a focal length; infinite where no fit starts."""
    camera = single_camera("photo", *size, focal)
    template = landmarks(basis.model, basis.model.template[None])[0].numpy()
    targets, poses = [], []
    for number, seen in enumerate(detections):
        view = LandmarkView(camera.id, camera, seen.points, seen.sigma, seen.score)
        observation, _ = agree(f"frame {number}", number, [view])
        try:
            poses.append(initial_pose(observation, template))
        except StageError:
            return math.inf
        targets.append(Target(observation, landmark_sigma(observation), False))
    return fit(basis, targets, start_state(basis, poses), LANDMARK_STEPS)[1]


def _lowest(x: np.ndarray, y: np.ndarray) -> float:
    """Return exp of where a parabola through the lowest sample and its neighbours is lowest."""
    best = int(np.argmin(y))
    if not 0 < best < len(x) - 1 or not np.isfinite(y[best - 1 : best + 2]).all():
        return math.exp(x[best])
    bend = y[best - 1] - 2 * y[best] + y[best + 1]
    shift = 0.5 * (y[best - 1] - y[best + 1]) / max(float(bend), 1e-12)
    return math.exp(x[best] + shift * (x[best + 1] - x[best]))
