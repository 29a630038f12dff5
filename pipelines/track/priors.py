"""What is known of a face before it is seen: priors on the unknowns of one expression."""

from __future__ import annotations

import numpy as np

from express50.head.model import HeadModel
from pipelines.track.config import TrackConfig

NEUTRAL_SHARE = 0.2
EYE_SIGMA = 0.3
EYE_DIFFERENCE_SIGMA = 0.03
JAW_SIGMA = (0.3, 0.06, 0.04)
JAW_CLOSED_SIGMA = 0.02
BELOW_SIGMA, ABOVE_SIGMA = 0.04, 0.12


def prior(
    model: HeadModel, own: np.ndarray, neutral: bool, config: TrackConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (r,) and their slope (r, X + 18) by the own unknowns of one expression.

    Tikhonov terms on every coefficient and joint angle, in standard deviations; one-sided walls at
    0 and 1 where coefficients are activations, and at the closed jaw; both eyes look alike. Turn
    and translation of the head are free.
    """
    count = model.expression_dirs.shape[2]
    share = NEUTRAL_SHARE if neutral else 1.0
    sigma = config.expression_prior if model.unit_expressions else 2.0 * config.expression_prior
    sigmas = np.concatenate(
        [
            np.full(count, sigma * share),
            np.full(3, config.neck_prior),
            np.array(JAW_SIGMA) * [share, 1.0, 1.0],
            np.full(6, EYE_SIGMA),
        ]
    )
    size = len(own)
    rows = [np.eye(len(sigmas), size) / sigmas[:, None]]
    residuals = [own[: len(sigmas)] / sigmas]
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


def _wall(
    own: np.ndarray, size: int, ids: np.ndarray, limit: float, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Residual of unknowns beyond a limit; a negative sigma is a wall from below."""
    beyond = np.maximum((own[ids] - limit) / sigma, 0.0)
    active = np.flatnonzero(beyond > 0)
    slope = np.zeros((len(active), size))
    slope[np.arange(len(active)), ids[active]] = 1.0 / sigma
    return beyond[active], slope
