"""Define the unknowns of tracking, their start from geometry alone, and their prior."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch

from express50.errors import StageError
from express50.geometry.transforms import (
    make_transform,
    matrix_to_axis_angle,
    rigid_fit,
    similarity_fit,
)
from express50.head.model import HeadModel, pose
from pipelines.track.basis import POSE_SIZE, Basis
from pipelines.track.observe import Observation, facing, landmark_sigma
from pipelines.track.terms import Term

# The initial pose. Jaw-line points slide, so a rigid alignment uses brows to mouth only.
INNER = np.arange(17, 68)
MIN_TRIANGULATED = 12
PERSON_M = 0.004  # standard deviation of a person's landmarks from the template's
SCALE_LIMITS = (0.5, 2.0)
MIN_FACING = 0.05  # cosine to the camera below which a view is from behind

# The prior. Few muscles act at a time (Bouaziz et al. 2013 penalise the sum of activations): small
# activations count squared, larger ones by their size.
EXPRESSION_MEAN = 0.2  # expected activation
ACTIVE_WIDTH = 0.05
NEUTRAL_SHARE = 0.2  # factor on both in the neutral frame
# Standard deviation of coefficients that are not activations, over EXPRESSION_MEAN.
COEFFICIENT_SPREAD = 4.5
# Radians. A single view cannot distinguish a bent neck from a shape: it stays nearer to rest.
NECK_SIGMA, SINGLE_VIEW_NECK_SIGMA = 0.2, 0.03
EYE_SIGMA, EYE_DIFFERENCE_SIGMA = 0.3, 0.03
JAW_SIGMA, JAW_CLOSED_SIGMA = (0.3, 0.06, 0.04), 0.02
BELOW_SIGMA, ABOVE_SIGMA = 0.04, 0.12  # of activations below 0 and above 1


@dataclass(frozen=True)
class Pose:
    """Unknowns of one expression: own (X + 18,) = expression, neck, jaw, eyes, turn, t; R (3, 3).

    The turn (axis-angle on the world side of R) is folded into R after every step, so it is zero
    between steps.
    """

    own: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class State:
    """Shape (S,), one pose per expression, and the detector's bias (68, 3), head space.

    A detector makes nearly the same error on a face in every frame and view, so these are not
    independent evidence. With the bias, landmarks determine how a face moves, not its shape.
    """

    shape: np.ndarray
    poses: tuple[Pose, ...]
    bias: np.ndarray = field(default_factory=lambda: np.zeros((68, 3)))


@dataclass(frozen=True)
class Quadratic:
    """Evidence as a quadratic of one expression's own unknowns (X + 18) about a pose.

    `hessian` (X + 18, X + 18) and `gradient` (X + 18,) are those of its cost there.
    """

    pose: Pose
    hessian: np.ndarray
    gradient: np.ndarray

    def at(self, pose: Pose) -> tuple[float, np.ndarray]:
        """Return the cost above that at its own pose, and the gradient (X + 18,)."""
        change = pose.own - self.pose.own
        change[-6:-3] = matrix_to_axis_angle(pose.rotation @ self.pose.rotation.T)
        slope = self.hessian @ change
        return float(change @ (self.gradient + 0.5 * slope)), self.gradient + slope


@dataclass(frozen=True)
class Target:
    """The evidence that one expression is fitted to."""

    observation: Observation  # landmarks in all cameras
    sigma: np.ndarray  # (views, 68) pixels, infinite where a landmark is not used
    neutral: bool  # the expression is the resting face
    terms: tuple[Term, ...] = ()  # residuals beside the landmarks'
    known: Quadratic | None = None  # evidence that was condensed to a quadratic


def rounded(state: State) -> State:
    """Drop digits after the seventh decimal, which may differ with another BLAS or machine."""
    poses = tuple(Pose(pose.own.round(7), pose.rotation.round(7)) for pose in state.poses)
    return State(state.shape.round(7), poses, state.bias.round(7))


def start_state(basis: Basis, poses: list[tuple[np.ndarray, np.ndarray]]) -> State:
    """Start from zero coefficients at given rotations (3, 3) and translations (3,)."""
    made = []
    for rotation, translation in poses:
        own = np.zeros(basis.expression_size + POSE_SIZE)
        own[-3:] = translation
        made.append(Pose(own, rotation))
    return State(np.zeros(basis.shape_size), tuple(made))


def rotations(state: State) -> np.ndarray:
    """Stack the rotations (E, 3, 3), world from head."""
    return np.stack([item.rotation for item in state.poses])


def all_vertices(model: HeadModel, state: State) -> np.ndarray:
    """Pose the mesh of every expression: world vertices (E, V, 3)."""
    own = torch.from_numpy(np.stack([item.own for item in state.poses])).clone()
    count = model.expression_dirs.shape[2]
    shape = torch.from_numpy(state.shape).clone()[None].expand(len(own), -1)
    angles = own[:, count : count + POSE_SIZE - 6]
    with torch.inference_mode():
        head = pose(
            model, shape, own[:, :count], neck=angles[:, :3], jaw=angles[:, 3:6], eyes=angles[:, 6:]
        ).numpy()
    return np.einsum("eij,evj->evi", rotations(state), head) + own[:, None, -3:].numpy()


class RigScaleError(StageError):
    """The calibration's unit is not the metre: no expression can be tracked with it."""


def posed_sigma(
    observation: Observation, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Return `landmark_sigma` without views from behind, where a detector can only guess."""
    sigma = landmark_sigma(observation)
    ahead = [facing(view, rotation, translation) for view in observation.views]
    sigma[np.array(ahead) < MIN_FACING] = np.inf
    return sigma


def initial_pose(observation: Observation, template: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find rotation (3, 3) and translation (3,) with world = R @ head + t.

    Uses triangulated landmarks where enough exist (and checks that their size is that of the head
    model's, `template` (68, 3)), else perspective-n-point in the surest view.

    Raises:
        RigScaleError: the rig's unit is not the metre.
        StageError: too few landmarks.
    """
    seen = INNER[np.isfinite(observation.points[INNER]).all(1)]
    if len(seen) < MIN_TRIANGULATED:
        return _from_one_view(observation, template)
    scale = similarity_fit(template[seen], observation.points[seen])[0]
    if not SCALE_LIMITS[0] < scale < SCALE_LIMITS[1]:
        # Wrong units are off by powers of ten: name one if it is near.
        power = 10.0 ** round(float(np.log10(scale)))
        near = power != 1.0 and 1 / 1.5 < scale / power < 1.5
        unit = f"{power:g}" if near else f"{scale:.3g}"
        raise RigScaleError(
            f"{observation.expression}: the rig seems {unit}x off: the head measures "
            f"{scale:.3g} times a human head in the calibration's units; expected metres, divide "
            f"the camera translations by {unit} and calibrate again"
        )
    spread = np.trace(observation.covariance[seen], axis1=1, axis2=2) / 3.0
    # A point without a covariance is triangulated from all but one direction.
    spread = np.where(np.isfinite(spread), spread, np.inf)
    return rigid_fit(template[seen], observation.points[seen], 1.0 / (PERSON_M**2 + spread))


def _from_one_view(observation: Observation, template: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the pose by the view with the smallest expected error."""
    view = min(observation.views, key=lambda view: view.doubt)
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
    cam_from_head = make_transform(cv2.Rodrigues(turn)[0], shift[:, 0])
    world = np.linalg.inv(view.camera.cam_from_world) @ cam_from_head
    return world[:3, :3], world[:3, 3]


def prior(
    model: HeadModel, own: np.ndarray, neutral: bool, single_view: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the prior: residuals (r,) and their slope (r, X + 18) by one expression's unknowns.

    Activations are sparse and kept between 0 and 1 by one-sided walls; other coefficients and joint
    angles are Gaussian; a wall keeps the jaw from closing further; both eyes look alike. Turn and
    translation of the head are free.
    """
    count = model.expression_dirs.shape[2]
    share = NEUTRAL_SHARE if neutral else 1.0
    size, mean = len(own), share * EXPRESSION_MEAN
    if model.unit_expressions:
        residual, slope = _sparse(own[:count], share * ACTIVE_WIDTH, mean)
    else:
        spread = COEFFICIENT_SPREAD * mean
        residual, slope = own[:count] / spread, np.full(count, 1.0 / spread)
    sigmas = np.r_[
        np.full(3, SINGLE_VIEW_NECK_SIGMA if single_view else NECK_SIGMA),
        np.array(JAW_SIGMA) * [share, 1.0, 1.0],
        np.full(6, EYE_SIGMA),
    ]
    single = np.r_[residual, own[count : count + 12] / sigmas]
    eyes = count + 6
    difference = np.zeros((3, size))
    difference[:, eyes : eyes + 3] = np.eye(3) / EYE_DIFFERENCE_SIGMA
    difference[:, eyes + 3 : eyes + 6] = -np.eye(3) / EYE_DIFFERENCE_SIGMA
    parts = [
        (single, np.eye(count + 12, size) * np.r_[slope, 1.0 / sigmas][:, None]),
        (difference @ own, difference),
        _wall(own, np.array([count + 3]), 0.0, -JAW_CLOSED_SIGMA),
    ]
    if model.unit_expressions:
        ids = np.arange(count)
        parts += [_wall(own, ids, 0.0, -BELOW_SIGMA), _wall(own, ids, 1.0, ABOVE_SIGMA)]
    residuals, slopes = zip(*parts, strict=True)
    return np.concatenate(residuals), np.concatenate(slopes)


def _sparse(activations: np.ndarray, active: float, mean: float) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (X,) whose halved squares are |activation| / mean, smooth at 0; and slopes.

    The cost is the pseudo-Huber of width `active`: that of an exponential distribution far from 0.
    """
    ratio = activations / active
    root = np.sqrt(1.0 + ratio**2)
    # sqrt(2 (root - 1)) without the difference of nearly equal numbers.
    residual = ratio * np.sqrt(2.0 / (1.0 + root))
    slope = np.sqrt((1.0 + root) / 2.0) / (root * active)
    scale = np.sqrt(active / mean)
    return scale * residual, scale * slope


def _wall(
    own: np.ndarray, ids: np.ndarray, limit: float, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Penalise unknowns above a limit, or below it if sigma is negative."""
    beyond = np.maximum((own[ids] - limit) / sigma, 0.0)
    active = np.flatnonzero(beyond > 0)
    slope = np.zeros((len(active), len(own)))
    slope[np.arange(len(active)), ids[active]] = 1.0 / sigma
    return beyond[active], slope
