"""Levenberg-Marquardt fit of one shape and many expressions to landmarks and outlines.

Per-expression unknowns meet only in the shared shape, so the normal equations are solved by
eliminating them one expression at a time (Schur complement): time and memory grow linearly with
the number of expressions. Residuals are in standard deviations; robust weights are Huber's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from express50.errors import StageError
from express50.geometry.transforms import axis_angle_to_matrix
from pipelines.track.config import TrackConfig
from pipelines.track.observe import Observation
from pipelines.track.offsets import MODE
from pipelines.track.pinhole import project_pinhole, project_with_slope
from pipelines.track.priors import prior
from pipelines.track.sparse_head import Basis, Points
from pipelines.track.state import Pose, State, SurfaceTerm, Target

HUBER = 1.5
KNOWN_BIAS_M = 1e-6
KNOWN_MODE = 1e8
BIAS = 68 * 3
REJECT_SIGMA, REJECT_SHARE = 4.0, 0.12


def fit(
    basis: Basis,
    targets: list[Target],
    state: State,
    config: TrackConfig,
    iterations: int,
    free: tuple[str, ...] = (),
) -> tuple[State, float]:
    """Minimise robust residuals plus priors from a start.

    Pictures of the surface tell what landmarks and outlines do not: that the detector errs on this
    face, and how the surface leaves the model's shapes. `free` names the offset modes they tell of
    (`offsets.OFF`, `offsets.ALONG`); with any of them the detector's bias is free too.

    Returns:
        The fitted state and its cost (half the sum of squared, robustly weighted residuals).

    Raises:
        StageError: the cost is not a finite number.
    """
    points = [Points(basis, target.vertices) for target in targets]
    weights = _shared_weights(basis, len(targets), config, free)
    damping = 1e-3
    cost = _cost(basis, targets, points, state, config, weights)
    for _ in range(iterations):
        system = [
            _normal_equations(basis, *item, state, config)
            for item in zip(targets, points, state.poses, strict=True)
        ]
        improved = False
        for _ in range(6):
            trial = _step(basis, state, system, damping, weights)
            trial_cost = _cost(basis, targets, points, trial, config, weights)
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

    A landmark is contradicted at REJECT_SIGMA standard deviations; a view half of whose landmarks
    are is left out as a whole, unless no other is left. `marks` (68, 3) are the fitted landmarks.
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


def _landmarks(basis: Basis, positions: np.ndarray, state: State, pose: Pose) -> np.ndarray:
    """Where the detector would put the landmarks (68, 3): the head's, plus what it always errs."""
    return positions[:68] + (basis.bias + state.bias) @ pose.rotation.T


def _landmark_blocks(
    target: Target, marks: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Blocks (point index (n,), residual (n, k), d residual / d position (n, k, 3)), one a view."""
    blocks = []
    for index, view in enumerate(target.observation.views):
        used = np.flatnonzero(np.isfinite(target.sigma[index]))
        pixels, slope = project_with_slope(view.camera, marks[used])
        sigma = target.sigma[index, used]
        residual = (pixels - view.points[used]) / sigma[:, None]
        blocks.append((used, residual, slope / sigma[:, None, None]))
    return blocks


def _outline_blocks(
    target: Target, positions: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return [outline.residuals(positions) for outline in target.outlines]


def _robust(residual: np.ndarray) -> np.ndarray:
    """Square roots of Huber weights (n,) for residual vectors (n, k)."""
    length = np.linalg.norm(residual, axis=1)
    return np.sqrt(np.minimum(1.0, HUBER / np.maximum(length, 1e-9)))


def _huber_cost(residual: np.ndarray) -> float:
    length = np.linalg.norm(residual, axis=1)
    inside = length <= HUBER
    return float(np.where(inside, 0.5 * length**2, HUBER * (length - 0.5 * HUBER)).sum())


def _cost(
    basis: Basis,
    targets: list[Target],
    points: list[Points],
    state: State,
    config: TrackConfig,
    weights: np.ndarray,
) -> float:
    """Total cost of a state; `weights` (S + BIAS,) are of the prior on shape and bias."""
    shared = _shared(state) * np.sqrt(weights)
    total = 0.5 * float(shared @ shared)
    for target, model, pose in zip(targets, points, state.poses, strict=True):
        positions = model.evaluate(np.r_[state.shape, pose.own], pose.rotation)
        blocks = _landmark_blocks(target, _landmarks(basis, positions, state, pose))
        blocks += _outline_blocks(target, positions)
        total += sum(_huber_cost(residual) for _, residual, _ in blocks)
        total += sum(term.cost(positions) for term in target.terms)
        residual, _ = prior(basis.model, pose.own, target.neutral, config)
        total += 0.5 * float(residual @ residual)
    return total if np.isfinite(total) else np.inf


def _shared(state: State) -> np.ndarray:
    """Shape, then bias: what all expressions of a face have in common."""
    return np.concatenate([state.shape, state.bias.ravel()])


def _shared_weights(
    basis: Basis, expressions: int, config: TrackConfig, free: tuple[str, ...]
) -> np.ndarray:
    """Inverse variances (S + BIAS,) of the shared unknowns.

    What is read wrongly off a face is read wrongly in all expressions alike, be it by the detector
    or by a search that highlights mislead: more of them are no more evidence of the shape.
    """
    shape = np.full(basis.shape_size, config.shape_prior * expressions)
    known = [
        name.startswith(MODE) and not name.startswith(free) for name in basis.model.shape_names
    ]
    shape[known] = KNOWN_MODE
    bias = np.full((68, 3), config.landmark_bias if free else KNOWN_BIAS_M)
    bias[:17] /= config.contour_weight
    return np.r_[shape, bias.ravel() ** -2]


def _information(
    blocks: list[tuple[np.ndarray, np.ndarray, np.ndarray]], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Robust Gauss-Newton matrices (count, 3, 3) and gradients (count, 3) by the points' positions.

    However many views see a point, the head's parameters meet their sum only.
    """
    matrix, gradient = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for used, residual, slope in blocks:
        weight = _robust(residual)[:, None]
        slope, residual = slope * weight[..., None], residual * weight
        # A block names no point twice.
        matrix[used] += np.swapaxes(slope, 1, 2) @ slope
        gradient[used] += np.einsum("nkc,nk->nc", slope, residual)
    return matrix, gradient


def _normal_equations(
    basis: Basis, target: Target, model: Points, pose: Pose, state: State, config: TrackConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Hessian and gradient of one expression: shape (S), bias (BIAS), own (X + 18)."""
    positions, jacobian = model.linearise(np.r_[state.shape, pose.own], pose.rotation)
    shapes, size = basis.shape_size, jacobian.shape[2] + BIAS
    columns = np.r_[:shapes, shapes + BIAS : size]
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    marks = _landmarks(basis, positions, state, pose)
    matrix, pull = _information(_landmark_blocks(target, marks), 68)
    rows = np.zeros((68, 3, size))
    rows[..., columns] = jacobian[:68]
    for mark in range(68):
        rows[mark, :, shapes + 3 * mark : shapes + 3 * mark + 3] = pose.rotation
    _add(hessian, gradient, rows, matrix, pull)
    blocks = _outline_blocks(target, positions)
    count = max((int(used.max()) + 1 for used, _, _ in blocks if len(used)), default=0)
    terms = [(jacobian[:count], *_information(blocks, count))]
    terms += [_of_samples(term, positions, jacobian) for term in target.terms]
    base, slope = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
    for term in terms:
        _add(base, slope, *term)
    residual, moved = prior(basis.model, pose.own, target.neutral, config)
    base[shapes:, shapes:] += moved.T @ moved
    slope[shapes:] += moved.T @ residual
    hessian[np.ix_(columns, columns)] += base
    gradient[columns] += slope
    return hessian, gradient


def _add(
    hessian: np.ndarray,
    gradient: np.ndarray,
    rows: np.ndarray,
    matrix: np.ndarray,
    pull: np.ndarray,
) -> None:
    """Add points' information (n, 3, 3), (n, 3) through their Jacobian rows (n, 3, D), in place."""
    size = rows.shape[2]
    flat = rows.reshape(-1, size)
    hessian += flat.T @ (matrix @ rows).reshape(-1, size)
    gradient += pull.reshape(-1) @ flat


def _of_samples(
    term: SurfaceTerm, positions: np.ndarray, jacobian: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The samples' Jacobian (S, 3, D) and information (S, 3, 3), (S, 3)."""
    moved = np.zeros((len(term.rows), *jacobian.shape[1:]))
    for corner in range(3):
        share = term.bary[:, corner, None, None]
        moved += share * jacobian[term.rows[:, corner]]
    return moved, *term.normal(positions)


def _step(
    basis: Basis,
    state: State,
    system: list[tuple[np.ndarray, np.ndarray]],
    damping: float,
    weights: np.ndarray,
) -> State:
    """One damped Gauss-Newton step, expressions eliminated."""
    shapes = basis.shape_size
    shared = shapes + BIAS
    reduced, right = np.diag(weights), -weights * _shared(state)
    eliminated = []
    for hessian, gradient in system:
        cross, inner = hessian[:shared, shared:], hessian[shared:, shared:]
        inner = inner + damping * np.diag(np.diag(inner)) + 1e-9 * np.eye(len(inner))
        solved = np.linalg.solve(inner, np.column_stack([cross.T, gradient[shared:]]))
        reduced = reduced + hessian[:shared, :shared] - cross @ solved[:, :-1]
        right = right - gradient[:shared] + cross @ solved[:, -1]
        eliminated.append(solved)
    reduced = reduced + damping * np.diag(np.diag(reduced))
    change = np.linalg.solve(reduced, right)
    poses = tuple(
        _moved(pose, -(solved[:, -1] + solved[:, :-1] @ change))
        for pose, solved in zip(state.poses, eliminated, strict=True)
    )
    return State(state.shape + change[:shapes], poses, state.bias + change[shapes:].reshape(68, 3))


def _moved(pose: Pose, change: np.ndarray) -> Pose:
    """Apply a change of the own unknowns and fold the turn into the rotation."""
    own = pose.own + change
    turn = slice(len(own) - 6, len(own) - 3)
    rotation = axis_angle_to_matrix(own[turn]) @ pose.rotation
    own[turn] = 0.0
    return replace(pose, own=own, rotation=rotation)
