"""Gradients of any term of the fit, by the positions of the mesh's vertices."""

from __future__ import annotations

import numpy as np

from pipelines.track.terms import Term, cost, information


def cost_at(term: Term, vertices: np.ndarray) -> float:
    return cost(term, term.anchors.at(vertices))


def gradient_at(term: Term, vertices: np.ndarray) -> np.ndarray:
    """The gradient (V, 3) of a term's cost."""
    _, pull = information(term, term.anchors.at(vertices))
    full = np.zeros_like(vertices)
    np.add.at(full, term.anchors.vertices, term.anchors.weights[..., None] * pull[:, None])
    return full


def slope_along(term: Term, vertices: np.ndarray, way: np.ndarray, step: float = 1e-7) -> float:
    return (cost_at(term, vertices + step * way) - cost_at(term, vertices - step * way)) / (
        2 * step
    )
