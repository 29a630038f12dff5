"""What is known of a face before it is seen: priors on the unknowns of one expression."""

from __future__ import annotations

import numpy as np

from express50.head.model import HeadModel
from pipelines.track.config import TrackConfig

NEUTRAL_SHARE = 0.2
# Few muscles act at a time (Bouaziz et al. 2013 have the sum of activations in their fit): up to
# this they count squared, beyond it by their size.
ACTIVE = 0.05
# Of coefficients that are no activations, against the mean of those that are.
SPREAD = 4.5
EYE_SIGMA = 0.3
EYE_DIFFERENCE_SIGMA = 0.03
JAW_SIGMA = (0.3, 0.06, 0.04)
JAW_CLOSED_SIGMA = 0.02
BELOW_SIGMA, ABOVE_SIGMA = 0.04, 0.12


def prior(
    model: HeadModel, own: np.ndarray, neutral: bool, config: TrackConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (r,) and their slope (r, X + 18) by the own unknowns of one expression.

    Activations are few, beyond one-sided walls at 0 and 1 there are none; other coefficients and
    joint angles are in standard deviations; there is a wall at the closed jaw; both eyes look
    alike. Turn and translation of the head are free.
    """
    count = model.expression_dirs.shape[2]
    share = NEUTRAL_SHARE if neutral else 1.0
    size, mean = len(own), share * config.expression_prior
    if model.unit_expressions:
        residual, slope = _few(own[:count], share * ACTIVE, mean)
    else:
        residual, slope = own[:count] / (SPREAD * mean), np.full(count, 1.0 / (SPREAD * mean))
    sigmas = np.r_[
        np.full(3, config.neck_prior),
        np.array(JAW_SIGMA) * [share, 1.0, 1.0],
        np.full(6, EYE_SIGMA),
    ]
    residuals = [np.r_[residual, own[count : count + 12] / sigmas]]
    rows = [np.eye(count + 12, size) * np.r_[slope, 1.0 / sigmas][:, None]]
    eyes = count + 6
    difference = np.zeros((3, size))
    difference[:, eyes : eyes + 3] = np.eye(3) / EYE_DIFFERENCE_SIGMA
    difference[:, eyes + 3 : eyes + 6] = -np.eye(3) / EYE_DIFFERENCE_SIGMA
    rows.append(difference)
    residuals.append(difference @ own)
    walls = [_wall(own, size, np.array([count + 3]), 0.0, -JAW_CLOSED_SIGMA)]
    if model.unit_expressions:
        ids = np.arange(count)
        walls += [_wall(own, size, ids, 0.0, -BELOW_SIGMA), _wall(own, size, ids, 1.0, ABOVE_SIGMA)]
    for residual, slope in walls:
        residuals.append(residual)
        rows.append(slope)
    return np.concatenate(residuals), np.concatenate(rows)


def _few(activations: np.ndarray, active: float, mean: float) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (X,) whose halved squares are |activation| / mean, smooth at 0, and their slopes.

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
    own: np.ndarray, size: int, ids: np.ndarray, limit: float, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Residual of unknowns beyond a limit; a negative sigma is a wall from below."""
    beyond = np.maximum((own[ids] - limit) / sigma, 0.0)
    active = np.flatnonzero(beyond > 0)
    slope = np.zeros((len(active), size))
    slope[np.arange(len(active)), ids[active]] = 1.0 / sigma
    return beyond[active], slope
