"""Static offsets of a head's vertices: how smooth they should be, and how to step so that they are.

Everything is sparse, over the edges of the mesh.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from express50.head.model import HeadModel
from pipelines.track.offsets import movable_vertices

# Offsets of vertices a centimetre or two apart go together: about a hundred are one unknown.
INDEPENDENT = 0.01


class OffsetSpace:
    """The mesh's graph Laplacian, the prior on offsets and smooth steps.

    Attributes:
        movable: (V,) bool.
    """

    def __init__(self, model: HeadModel, sigma: float, bend: float, smoothing: float) -> None:
        """Take the priors' standard deviations in metres and the smoothing of steps."""
        faces, count = model.faces.numpy(), len(model.template)
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        edges = np.unique(np.sort(edges, axis=1), axis=0)
        both = np.concatenate([edges, edges[:, ::-1]])
        ones = np.ones(len(both))
        adjacency = sparse.csr_matrix((ones, (both[:, 0], both[:, 1])), shape=(count, count))
        degree = np.asarray(adjacency.sum(axis=1)).ravel()
        # each vertex against the mean of those around it
        self._bend = sparse.identity(count) - sparse.diags(1 / np.maximum(degree, 1)) @ adjacency
        laplacian = sparse.diags(degree) - adjacency
        self._smooth = splu((sparse.identity(count) + smoothing * laplacian).tocsc())
        self._sigma, self._bend_sigma = sigma, bend
        self.movable = movable_vertices(model)

    def prior(self, offsets: np.ndarray) -> tuple[float, np.ndarray]:
        """Energy of offsets (V, 3) and its gradient (V, 3).

        Half the squared sum of offsets and of their bends in standard deviations, for as many
        vertices as are independent of one another.
        """
        bends = self._bend @ offsets / self._bend_sigma
        lengths = offsets / self._sigma
        energy = 0.5 * INDEPENDENT * float((bends**2).sum() + (lengths**2).sum())
        gradient = self._bend.T @ bends / self._bend_sigma + lengths / self._sigma
        return energy, INDEPENDENT * gradient

    def smooth(self, field: np.ndarray) -> np.ndarray:
        """(1 + smoothing * Laplacian)^-1 of a field (V, 3).

        Applied to gradients and again to steps it makes the descent one over smooth fields first
        (Nicolet et al. 2021, "Large steps in inverse rendering of geometry").
        """
        return self._smooth.solve(field)
