"""Levenberg-Marquardt fit of one shape and many expressions to landmarks and outlines.

Per-expression unknowns meet only in the shared shape, so the normal equations are solved by
eliminating them one expression at a time (Schur complement): time and memory grow linearly with
the number of expressions. Residuals are in standard deviations; robust weights are Huber's.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from express50.cameras import Camera
from express50.errors import StageError
from express50.transforms import axis_angle_to_matrix
from pipelines.track.config import TrackConfig
from pipelines.track.observe import Observation, Terms, pixel_slope, project_pinhole
from pipelines.track.priors import prior
from pipelines.track.sparse_head import POSE_SIZE, Basis, Points

HUBER = 1.5
REJECT_SIGMA, REJECT_SHARE = 4.0, 0.12


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
    """Shape (S,) and a pose an expression."""

    shape: np.ndarray
    poses: tuple[Pose, ...]


@dataclass(frozen=True)
class Target:
    """What one expression is fitted to."""

    observation: Observation
    sigma: np.ndarray
    neutral: bool
    outlines: tuple[Terms, ...] = ()
    vertices: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def fit(
    basis: Basis, targets: list[Target], state: State, config: TrackConfig, iterations: int
) -> tuple[State, float]:
    """Minimise robust residuals plus priors from a start.

    Returns:
        The fitted state and its cost (half the sum of squared, robustly weighted residuals).

    Raises:
        StageError: the cost is not a finite number.
    """
    points = [Points(basis, target.vertices) for target in targets]
    damping = 1e-3
    cost = _cost(basis, targets, points, state, config)
    for _ in range(iterations):
        system = [
            _normal_equations(basis, *item, state.shape, config)
            for item in zip(targets, points, state.poses, strict=True)
        ]
        improved = False
        for _ in range(6):
            trial = _step(state, system, basis.shape_size, damping, config)
            trial_cost = _cost(basis, targets, points, trial, config)
            if trial_cost < cost:
                improved = True
                break
            damping = min(damping * 8.0, 1e8)
        if not improved:
            break
        gain = (cost - trial_cost) / max(cost, 1e-12)
        state, cost, damping = trial, trial_cost, max(damping * 0.25, 1e-7)
        if gain < 1e-5:
            break
    if not np.isfinite(cost):
        raise StageError("the fit diverged; check the calibration and the landmark overlays")
    return state, cost


def landmark_sigma(observation: Observation, config: TrackConfig) -> np.ndarray:
    """Standard deviations (views, 68) in pixels; infinite where a landmark is not used."""
    sigma = np.empty((len(observation.views), 68))
    for index, view in enumerate(observation.views):
        height = np.ptp(view.points[17:], axis=0).max()
        floor = config.landmark_floor_px * height / 128.0
        sigma[index] = np.hypot(view.sigma, floor) * view.crowd**0.5
    sigma[:, :17] /= config.contour_weight
    return np.where(observation.inliers, sigma, np.inf)


def consistent_sigma(target: Target, marks: np.ndarray) -> np.ndarray:
    """The target's standard deviations with what the fit contradicts made infinite.

    A landmark is contradicted at REJECT standard deviations; a view half of whose landmarks are is
    left out as a whole, unless no other is left. `marks` (68, 3) are the fitted landmarks.
    """
    sigma = target.sigma.copy()
    for index, view in enumerate(target.observation.views):
        pixels, _ = project_pinhole(view.camera, marks)
        used = np.isfinite(sigma[index])
        limit = REJECT_SHARE * float(np.ptp(view.points, axis=0).max())
        allowed = np.minimum(REJECT_SIGMA * sigma[index], limit)
        far = used & (np.linalg.norm(pixels - view.points, axis=1) > allowed)
        sigma[index, far] = np.inf
        if far.sum() > 0.5 * used.sum():
            sigma[index] = np.inf
    return sigma if np.isfinite(sigma).any() else target.sigma


def _parameters(state_shape: np.ndarray, pose: Pose) -> np.ndarray:
    return np.concatenate([state_shape, pose.own])


def _residuals(
    target: Target, positions: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Blocks (point index (n,), residual (n, k), d residual / d position (n, k, 3))."""
    blocks = []
    for index, view in enumerate(target.observation.views):
        used = np.flatnonzero(np.isfinite(target.sigma[index]))
        pixels, slope = project_with_slope(view.camera, positions[used])
        sigma = target.sigma[index, used]
        residual = (pixels - view.points[used]) / sigma[:, None]
        blocks.append((used, residual, slope / sigma[:, None, None]))
    for outline in target.outlines:
        blocks.append(outline.residuals(positions, project_with_slope))
    return blocks


def project_with_slope(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of world points (N, 3) and d pixel / d point (N, 2, 3), pinhole."""
    return project_pinhole(camera, points)[0], pixel_slope(camera, points)


def _robust(residual: np.ndarray) -> np.ndarray:
    """Square roots of Huber weights (n,) for residual vectors (n, k)."""
    length = np.linalg.norm(residual, axis=1)
    return np.sqrt(np.minimum(1.0, HUBER / np.maximum(length, 1e-9)))


def _huber_cost(residual: np.ndarray) -> float:
    length = np.linalg.norm(residual, axis=1)
    inside = length <= HUBER
    return float(np.where(inside, 0.5 * length**2, HUBER * (length - 0.5 * HUBER)).sum())


def _cost(
    basis: Basis, targets: list[Target], points: list[Points], state: State, config: TrackConfig
) -> float:
    """Total cost of a state."""
    total = 0.5 * _shape_weight(config, len(targets)) * float(state.shape @ state.shape)
    for target, model, pose in zip(targets, points, state.poses, strict=True):
        positions = model.evaluate(_parameters(state.shape, pose), pose.rotation)
        total += sum(_huber_cost(block[1]) for block in _residuals(target, positions))
        residual, _ = prior(basis.model, pose.own, target.neutral, config)
        total += 0.5 * float(residual @ residual)
    return total if np.isfinite(total) else np.inf


def _shape_weight(config: TrackConfig, expressions: int) -> float:
    """Weight of the shape prior: what a detector gets wrong on a face it gets wrong in every frame.

    More expressions of the same face are therefore no independent evidence of its shape.
    """
    return config.shape_prior * expressions


def _normal_equations(
    basis: Basis,
    target: Target,
    model: Points,
    pose: Pose,
    shape: np.ndarray,
    config: TrackConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Hessian (D, D) and gradient (D,) of one expression, D = S + X + 18."""
    positions, jacobian = model.linearise(_parameters(shape, pose), pose.rotation)
    size = jacobian.shape[2]
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    for used, residual, slope in _residuals(target, positions):
        weight = _robust(residual)[:, None]
        rows = (slope * weight[..., None]) @ jacobian[used]
        rows = rows.reshape(-1, size)
        hessian += rows.T @ rows
        gradient += rows.T @ (residual * weight).reshape(-1)
    residual, slope = prior(basis.model, pose.own, target.neutral, config)
    own = slice(basis.shape_size, size)
    hessian[own, own] += slope.T @ slope
    gradient[own] += slope.T @ residual
    return hessian, gradient


def _step(
    state: State,
    system: list[tuple[np.ndarray, np.ndarray]],
    shapes: int,
    damping: float,
    config: TrackConfig,
) -> State:
    """One damped Gauss-Newton step, expressions eliminated."""
    weight = _shape_weight(config, len(system))
    reduced = weight * np.eye(shapes)
    right = -weight * state.shape
    eliminated = []
    for hessian, gradient in system:
        shared, cross = hessian[:shapes, :shapes], hessian[:shapes, shapes:]
        inner = hessian[shapes:, shapes:]
        inner = inner + damping * np.diag(np.diag(inner)) + 1e-9 * np.eye(len(inner))
        solved = np.linalg.solve(inner, np.column_stack([cross.T, gradient[shapes:]]))
        reduced = reduced + shared - cross @ solved[:, :-1]
        right = right - gradient[:shapes] + cross @ solved[:, -1]
        eliminated.append(solved)
    reduced = reduced + damping * np.diag(np.diag(reduced))
    change = np.linalg.solve(reduced, right)
    poses = tuple(
        _moved(pose, -(solved[:, -1] + solved[:, :-1] @ change))
        for pose, solved in zip(state.poses, eliminated, strict=True)
    )
    return State(state.shape + change, poses)


def _moved(pose: Pose, change: np.ndarray) -> Pose:
    """Apply a change of the own unknowns and fold the turn into the rotation."""
    own = pose.own + change
    turn = slice(len(own) - 6, len(own) - 3)
    rotation = axis_angle_to_matrix(own[turn]) @ pose.rotation
    own[turn] = 0.0
    return replace(pose, own=own, rotation=rotation)


def start_state(basis: Basis, poses: list[tuple[np.ndarray, np.ndarray]]) -> State:
    """Zero coefficients at given rotations (3, 3) and translations (3,)."""
    made = []
    for rotation, translation in poses:
        own = np.zeros(basis.expression_size + POSE_SIZE)
        own[-3:] = translation
        made.append(Pose(own, rotation))
    return State(np.zeros(basis.shape_size), tuple(made))
