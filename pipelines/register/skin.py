"""Tell skin from hair and cloth on a reconstructed surface, by its colours and its confidence."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from express50.files.images import srgb_to_linear
from express50.head.model import HeadModel
from pipelines.track.basis import in_regions

FACE = ("face", "nose")  # without these, it is bare skin in nearly everybody:
NOT_BARE = (
    "lips", "left_eye_region", "right_eye_region", "mouth_interior", "forehead", "boundary",
)  # fmt: skip
NEAR_M, LIPS_M = 0.004, 0.01  # what lies nearer to the mesh is its skin; its lips
LEAST = 100  # vertices of bare skin, to know its colour
SPREADS = (0.05, 0.05, 0.2)  # least standard deviations: red and blue over green, brightness; logs
ODD = 3.0  # standard deviations at which a colour is half believed
SURE = (0.5, 1.0)  # confidence, over that of bare skin: of nothing and of full trust
AROUND_M, NEIGHBOURS, EVERY = 0.008, 12, 14  # hair's rim is hair: trust what has trusted neighbours


def skin_trust(
    model: HeadModel,
    mesh: np.ndarray,
    vertices: np.ndarray,
    colors: np.ndarray,
    confidence: np.ndarray,
) -> np.ndarray:
    """Weigh a surface's vertices (N,) from 0 to 1: how likely they are skin, and well placed.

    Bare skin is what lies near the middle of the tracked face, the mesh (V, 3); its colours (N, 3),
    uint8 sRGB, and its confidence (N,), 0 to 1, are the measure. Places are in metres.
    """
    bare = in_regions(model, FACE) & ~in_regions(model, NOT_BARE)
    distance, nearest = cKDTree(vertices).query(mesh[bare])
    reference = np.unique(nearest[distance < NEAR_M])
    if len(reference) < LEAST:
        return confidence.astype(np.float64)
    odd = _oddness(colors, reference)
    _, owner = cKDTree(mesh).query(vertices, distance_upper_bound=LIPS_M)
    odd[np.r_[in_regions(model, ("lips",)), False][owner]] = 0.0
    sure = confidence / max(float(np.median(confidence[reference])), 1e-6)
    trust = np.clip((sure - SURE[0]) / (SURE[1] - SURE[0]), 0.0, 1.0) / (1.0 + (odd / ODD) ** 4)
    # What lies among untrusted vertices is not trusted either; some of those nearby will do.
    some = np.arange(0, len(vertices), EVERY)
    distance, nearest = cKDTree(vertices[some]).query(vertices, min(NEIGHBOURS, len(some)))
    near = distance < AROUND_M
    around = (trust[some][nearest] * near).sum(1) / np.maximum(near.sum(1), 1)
    return trust * around**2


def _oddness(colors: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Measure how many standard deviations colours (N, 3) are off those of a reference."""
    log = np.log(srgb_to_linear(colors / 255.0) + 0.01)
    axes = np.stack([log[:, 0] - log[:, 1], log[:, 2] - log[:, 1], log.mean(1)], axis=1)
    middle = np.median(axes[reference], axis=0)
    spread = 1.4826 * np.median(np.abs(axes[reference] - middle), axis=0)
    return np.linalg.norm((axes - middle) / np.maximum(spread, SPREADS), axis=1)
