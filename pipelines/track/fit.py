"""Fit one shape and many expressions to the residuals of `terms` (Levenberg-Marquardt).

The unknowns are x = (shape, bias, own_1, ..., own_E). The cost sums the losses of all terms of all
expressions and half the squared residuals of the priors. docs/TRACKING.md, section Solver, explains
how an expression's terms are summed over vertices and how its own unknowns are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from express50.errors import StageError
from express50.geometry.cameras import project_pinhole
from express50.geometry.transforms import axis_angle_to_matrix
from pipelines.track.basis import MODE, Basis, Points
from pipelines.track.observe import JAW_LINE_WEIGHT
from pipelines.track.state import Pose, Quadratic, State, Target, prior
from pipelines.track.terms import (
    MeshPlaces,
    PixelTerm,
    Sighting,
    Term,
    cost,
    information,
    landmark_anchors,
)

LANDMARK_BIAS_M = 0.003  # standard deviation of the detector's constant error on a face
KNOWN_BIAS_M, KNOWN_MODE = 1e-6, 1e8  # hold the bias and modes that are not free
BIAS = 68 * 3
REJECT_SIGMA, REJECT_SHARE = 4.0, 0.12


def fit(
    basis: Basis, targets: list[Target], state: State, steps: int, free: tuple[str, ...] = ()
) -> tuple[State, float]:
    """Minimise the targets' cost plus priors in at most `steps` steps; return state and cost.

    `free` are the offset modes that the terms can determine (`basis.OFF`, `basis.ALONG`). With any
    of them the detector's bias is free too: the surface then shows how landmarks err.

    Raises:
        StageError: the cost is not a finite number.
    """
    expressions = [_Expression.of(basis, target) for target in targets]
    weights = _shared_weights(basis, len(targets), free)
    damping = 1e-3
    least = _cost(basis, expressions, state, weights)
    for _ in range(steps):
        system = [
            _normal_equations(basis, *item, state)
            for item in zip(expressions, state.poses, strict=True)
        ]
        improved = False
        for _ in range(6):
            trial = _step(basis, state, system, damping, weights)
            trial_cost = _cost(basis, expressions, trial, weights)
            if trial_cost < least:
                improved = True
                break
            damping = min(damping * 8.0, 1e8)
        if not improved:
            break
        gain = (least - trial_cost) / max(least, 1e-12)
        state, least, damping = trial, trial_cost, max(damping * 0.25, 1e-7)
        if gain < 1e-5:
            break
    if not np.isfinite(least):
        raise StageError("the fit diverged; check the calibration and the landmark overlays")
    return state, least


def vertex_sigma(
    basis: Basis, targets: list[Target], state: State, free: tuple[str, ...]
) -> np.ndarray:
    """Return standard deviations (E, V), metres, of all vertices under the fit's covariance.

    Residuals are taken to be independent and the terms' deviations to be true. So the values only
    compare vertices; `express50.error_model` turns them into errors.
    """
    shared = basis.shape_size + BIAS
    precision, own = np.diag(_shared_weights(basis, len(targets), free)), []
    for target, pose in zip(targets, state.poses, strict=True):
        hessian, _ = _normal_equations(basis, _Expression.of(basis, target), pose, state)
        inner = hessian[shared:, shared:]
        inverse = np.linalg.inv(inner + 1e-9 * np.trace(inner) / len(inner) * np.eye(len(inner)))
        follow = -inverse @ hessian[shared:, :shared]  # change of its own unknowns per shared one
        precision += hessian[:shared, :shared] + hessian[:shared, shared:] @ follow
        own.append((inverse, follow))
    values, axes = np.linalg.eigh(precision)
    root = axes / np.sqrt(np.maximum(values, 1e-9 * values[-1]))  # of the shared covariance
    every, found = Points(basis, np.arange(len(basis.model.template))), []
    for pose, (inverse, follow) in zip(state.poses, own, strict=True):
        spread = np.concatenate([root[:-BIAS], follow @ root])
        covariance = spread @ spread.T
        covariance[basis.shape_size :, basis.shape_size :] += inverse
        jacobian = every.linearise(np.r_[state.shape, pose.own], pose.rotation)[1]
        slope = jacobian.reshape(-1, len(covariance))
        variance = np.einsum("vi,vi->v", slope @ covariance, slope).reshape(-1, 3).sum(1)
        found.append(np.sqrt(np.maximum(variance, 0)))
    return np.stack(found)


def condensed(basis: Basis, target: Target, pose: Pose) -> Target:
    """Return a target whose evidence is a quadratic about a pose that was fitted to it.

    Fitting it again, with other terms, takes a small part of the time. The basis is one of
    `freeze_shape`.
    """
    one = _Expression.of(basis, target)
    hessian, gradient = _normal_equations(basis, one, pose, State(np.zeros(0), (pose,)))
    residual, moved = prior(basis.model, pose.own, one.neutral, one.single_view)
    inner = hessian[BIAS:, BIAS:] - moved.T @ moved
    known = Quadratic(pose, inner, gradient[BIAS:] - moved.T @ residual)
    unused = np.full_like(target.sigma, np.inf)
    return replace(target, sigma=unused, terms=(), known=known)


def consistent_sigma(target: Target, marks: np.ndarray) -> np.ndarray:
    """Return the target's standard deviations with landmarks that contradict the fit left out.

    A landmark contradicts at REJECT_SIGMA standard deviations; a view with more than half of its
    landmarks contradicting is left out as a whole, unless no other remains. `marks` (68, 3) are the
    fitted landmarks.
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


@dataclass(frozen=True)
class _Expression:
    """One expression's terms, the landmarks' first, on the vertices that they are about."""

    terms: tuple[Term, ...]
    anchors: tuple[MeshPlaces, ...]  # the terms', of vertices counted among those of `points`
    points: Points
    neutral: bool
    single_view: bool
    known: Quadratic | None

    @classmethod
    def of(cls, basis: Basis, target: Target) -> _Expression:
        sightings = []
        for view, sigma in zip(target.observation.views, target.sigma, strict=True):
            rows = np.flatnonzero(np.isfinite(sigma))
            if len(rows):
                sightings.append(Sighting(view.camera, rows, view.points[rows], sigma[rows]))
        terms = (PixelTerm(landmark_anchors(basis.model), tuple(sightings)), *target.terms)
        ids = np.unique(np.concatenate([term.anchors.vertices.ravel() for term in terms]))
        anchors = tuple(
            MeshPlaces(np.searchsorted(ids, term.anchors.vertices), term.anchors.weights)
            for term in terms
        )
        single = len(target.observation.views) == 1
        return cls(terms, anchors, Points(basis, ids), target.neutral, single, target.known)

    def places(self, basis: Basis, positions: np.ndarray, state: State, pose: Pose) -> list:
        """Return the terms' places (n, 3); the landmarks' are where the detector would put them."""
        found = [anchors.at(positions) for anchors in self.anchors]
        found[0] = found[0] + (basis.bias + state.bias) @ pose.rotation.T
        return found


def _shared(state: State) -> np.ndarray:
    """Concatenate the unknowns that all expressions share: shape, then bias."""
    return np.concatenate([state.shape, state.bias.ravel()])


def _shared_weights(basis: Basis, expressions: int, free: tuple[str, ...]) -> np.ndarray:
    """Return inverse variances (S + BIAS,) of the shared unknowns.

    Systematic errors of the detector or the patch search recur in every expression, so more
    expressions are not more evidence of the shape.
    """
    shape = np.full(basis.shape_size, float(expressions))
    held = [name.startswith(MODE) and not name.startswith(free) for name in basis.model.shape_names]
    shape[held] = KNOWN_MODE
    bias = np.full((68, 3), LANDMARK_BIAS_M if free else KNOWN_BIAS_M)
    bias[:17] /= JAW_LINE_WEIGHT
    return np.r_[shape, bias.ravel() ** -2]


def _cost(basis: Basis, expressions: list[_Expression], state: State, weights: np.ndarray) -> float:
    shared = _shared(state) * np.sqrt(weights)
    total = 0.5 * float(shared @ shared)
    for one, pose in zip(expressions, state.poses, strict=True):
        positions = one.points.evaluate(np.r_[state.shape, pose.own], pose.rotation)
        places = one.places(basis, positions, state, pose)
        total += sum(cost(*pair) for pair in zip(one.terms, places, strict=True))
        residual, _ = prior(basis.model, pose.own, one.neutral, one.single_view)
        total += 0.5 * float(residual @ residual)
        total += one.known.at(pose)[0] if one.known else 0.0
    return total if np.isfinite(total) else np.inf


def _normal_equations(
    basis: Basis, one: _Expression, pose: Pose, state: State
) -> tuple[np.ndarray, np.ndarray]:
    """Return Hessian and gradient of one expression: shape (S), bias (BIAS), own (X + 18)."""
    positions, jacobian = one.points.linearise(np.r_[state.shape, pose.own], pose.rotation)
    places = one.places(basis, positions, state, pose)
    found = [information(*pair) for pair in zip(one.terms, places, strict=True)]
    W, pull = _over_vertices(one.anchors, found, len(positions))
    flat = jacobian.reshape(3 * len(positions), -1)
    shapes, size = basis.shape_size, flat.shape[1] + BIAS
    columns = np.r_[:shapes, shapes + BIAS : size]
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    base, slope = flat.T @ (W @ flat), flat.T @ pull
    residual, moved = prior(basis.model, pose.own, one.neutral, one.single_view)
    base[shapes:, shapes:] += moved.T @ moved
    slope[shapes:] += moved.T @ residual
    if one.known:
        base[shapes:, shapes:] += one.known.hessian
        slope[shapes:] += one.known.at(pose)[1]
    hessian[np.ix_(columns, columns)] = base
    gradient[columns] = slope
    # A landmark's bias b moves its place by R b.
    matrix, towards = found[0][0] @ pose.rotation, found[0][1] @ pose.rotation
    marks = np.einsum("nk,nkcd->ncd", one.anchors[0].weights, jacobian[one.anchors[0].vertices])
    cross = np.einsum("ncd,nce->dne", marks, matrix).reshape(flat.shape[1], BIAS)
    bias = np.arange(shapes, shapes + BIAS)
    hessian[np.ix_(columns, bias)] = cross
    hessian[np.ix_(bias, columns)] = cross.T
    hessian[np.ix_(bias, bias)] = sparse.block_diag(list(pose.rotation.T @ matrix)).toarray()
    gradient[bias] = towards.ravel()
    return hessian, gradient


def _over_vertices(
    anchors: tuple[MeshPlaces, ...], found: list[tuple[np.ndarray, np.ndarray]], count: int
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Sum the terms over M vertices: information W (3 M, 3 M) and gradient (3 M,)."""
    axes, gradient = np.arange(3), np.zeros((count, 3))
    rows, columns, values = [], [], []
    for places, (matrix, pull) in zip(anchors, found, strict=True):
        ids, weights = places.vertices, places.weights
        np.add.at(gradient, ids, weights[..., None] * pull[:, None])
        block = weights[:, :, None, None, None] * weights[:, None, :, None, None]
        value = block * matrix[:, None, None]
        row = 3 * ids[:, :, None, None, None] + axes[:, None]
        column = 3 * ids[:, None, :, None, None] + axes
        rows.append(np.broadcast_to(row, value.shape).ravel())
        columns.append(np.broadcast_to(column, value.shape).ravel())
        values.append(value.ravel())
    index = (np.concatenate(rows), np.concatenate(columns))
    shape = (3 * count, 3 * count)
    return sparse.csr_matrix((np.concatenate(values), index), shape=shape), gradient.ravel()


def _step(
    basis: Basis,
    state: State,
    system: list[tuple[np.ndarray, np.ndarray]],
    damping: float,
    weights: np.ndarray,
) -> State:
    """Take one damped Gauss-Newton step, expressions eliminated."""
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
    poses = []
    for pose, solved in zip(state.poses, eliminated, strict=True):
        own = pose.own - (solved[:, -1] + solved[:, :-1] @ change)
        # The turn is folded into the rotation.
        poses.append(Pose(own, axis_angle_to_matrix(own[-6:-3]) @ pose.rotation))
        own[-6:-3] = 0.0
    bias = state.bias + change[shapes:].reshape(68, 3)
    return State(state.shape + change[:shapes], tuple(poses), bias)
