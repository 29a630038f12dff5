"""Define the residuals that tracking minimises, in one form for all evidence.

A term concerns *places*, which are weighted sums of mesh vertices. For places (n, 3) it returns
residual vectors in standard deviations and their slope by the place; its loss turns squared lengths
into cost and weight. The solver (`fit`) needs nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from express50.geometry.cameras import Camera, project_with_slope
from express50.head.model import HeadModel

HUBER = 1.5  # standard deviations beyond which a residual counts by its length, not its square
SHUT_GAP_M = 0.0005  # standard deviation of the gap between lids or lips that are shut
SLIDE_OUTLIER_M = 0.004

Residuals = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Which place each residual is about (m,), the residuals (m, k), their slope by it (m, k, 3)."""


@dataclass(frozen=True)
class MeshPlaces:
    """Places on a mesh: sums of its `vertices` (n, k), ids, with weights (n, k).

    Weights are barycentric for a point of a face, and of both signs for a difference.
    """

    vertices: np.ndarray
    weights: np.ndarray

    @classmethod
    def of_vertices(cls, ids: np.ndarray) -> MeshPlaces:
        """Return vertices (n,) themselves."""
        return cls(ids[:, None], np.ones((len(ids), 1)))

    def some(self, ids: np.ndarray | slice) -> MeshPlaces:
        """Choose places by index, mask or slice."""
        return MeshPlaces(self.vertices[ids], self.weights[ids])

    def minus(self, other: MeshPlaces) -> MeshPlaces:
        """Return differences between these places and as many others."""
        return MeshPlaces(
            np.concatenate([self.vertices, other.vertices], axis=1),
            np.concatenate([self.weights, -other.weights], axis=1),
        )

    def at(self, vertices: np.ndarray) -> np.ndarray:
        """Place (n, 3) on vertices (V, 3)."""
        return np.einsum("nk,nkc->nc", self.weights, vertices[self.vertices])


def landmark_anchors(model: HeadModel) -> MeshPlaces:
    """Return the 68 landmarks' places on a head model."""
    bary = model.landmark_bary.double().numpy()
    # Single-precision weights miss 1 by 1e-7, which is a millimetre 10 km from the origin.
    bary = bary / bary.sum(1, keepdims=True)
    return MeshPlaces(model.faces.numpy()[model.landmark_faces.numpy()], bary)


class Term(Protocol):
    """Residuals about some places of one expression's mesh."""

    @property
    def anchors(self) -> MeshPlaces:
        """Return the places that the residuals are about."""

    def residuals(self, places: np.ndarray) -> Residuals:
        """Evaluate at places (n, 3), world."""

    def loss(self, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return cost (m,) and weight (m,) of squared residuals (m,)."""


def huber(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate Huber's loss: outliers keep a constant pull."""
    length = np.sqrt(square)
    far = HUBER * (length - 0.5 * HUBER)
    weight = np.minimum(1.0, HUBER / np.maximum(length, 1e-9))
    return np.where(length <= HUBER, 0.5 * square, far), weight


def geman_mcclure(square: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the loss of Geman and McClure.

    Residuals well beyond `scale` (m,) lose their pull.
    """
    fade = 1.0 + square / scale**2
    return 0.5 * square / fade, fade**-2


def cost(term: Term, places: np.ndarray) -> float:
    """Sum a term's cost at places (n, 3)."""
    _, value, _ = term.residuals(places)
    return float(term.loss((value**2).sum(1))[0].sum())


def information(term: Term, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss-Newton matrices (n, 3, 3) and gradients (n, 3) of a term by its places."""
    rows, value, slope = term.residuals(places)
    weight = term.loss((value**2).sum(1))[1][:, None, None]
    matrix, gradient = np.zeros((len(places), 3, 3)), np.zeros((len(places), 3))
    weighted = np.swapaxes(weight * slope, 1, 2)
    np.add.at(matrix, rows, weighted @ slope)
    np.add.at(gradient, rows, (weighted @ value[..., None])[..., 0])
    return matrix, gradient


@dataclass(frozen=True)
class Sighting:
    """Pixels (m, 2) and sigmas (m,) at which a pinhole camera sees places `rows` (m,) of a term."""

    camera: Camera
    rows: np.ndarray
    pixels: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class PixelTerm:
    """Reprojection errors: places should be seen at given pixels."""

    anchors: MeshPlaces
    sightings: tuple[Sighting, ...]

    def residuals(self, places: np.ndarray) -> Residuals:
        """Return the pixels off, over sigma."""
        rows, values, slopes = [np.zeros(0, int)], [np.zeros((0, 2))], [np.zeros((0, 2, 3))]
        for seen in self.sightings:
            pixels, slope = project_with_slope(seen.camera, places[seen.rows])
            rows.append(seen.rows)
            values.append((pixels - seen.pixels) / seen.sigma[:, None])
            slopes.append(slope / seen.sigma[:, None, None])
        return np.concatenate(rows), np.concatenate(values), np.concatenate(slopes)

    loss = staticmethod(huber)


@dataclass(frozen=True)
class PointTerm:
    """Places should lie at goals (n, 3), world, as neighbouring frames expect; sigma in metres."""

    anchors: MeshPlaces
    goals: np.ndarray
    sigma: float

    def residuals(self, places: np.ndarray) -> Residuals:
        """Return the metres off, over sigma."""
        slope = np.broadcast_to(np.eye(3) / self.sigma, (len(places), 3, 3))
        return np.arange(len(places)), (places - self.goals) / self.sigma, slope

    loss = staticmethod(huber)


@dataclass(frozen=True)
class NormalTerm:
    """Places should lie on the surface: only the distance along a normal counts."""

    anchors: MeshPlaces
    goals: np.ndarray  # (n, 3) world
    normals: np.ndarray  # (n, 3) unit, world
    sigma: np.ndarray  # (n,) metres
    outlier: float  # metres off, beyond which a point is more likely wrong than the mesh

    def residuals(self, places: np.ndarray) -> Residuals:
        """Return the distance along the normal, over sigma."""
        slope = (self.normals / self.sigma[:, None])[:, None]
        value = ((places - self.goals) * slope[:, 0]).sum(1, keepdims=True)
        return np.arange(len(places)), value, slope

    def loss(self, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the loss of Geman and McClure."""
        return geman_mcclure(square, self.outlier / self.sigma)


@dataclass(frozen=True)
class SlideTerm:
    """Places should slide along the skin to where it belongs; the distance off it does not count.

    The rest is as in NormalTerm.
    """

    anchors: MeshPlaces
    marks: np.ndarray  # landmarks of the 68 among them; none where the skin's texture is followed
    goals: np.ndarray
    normals: np.ndarray
    sigma: np.ndarray

    def residuals(self, places: np.ndarray) -> Residuals:
        """Return the metres off along the skin, over sigma."""
        flat = np.eye(3) - self.normals[:, :, None] * self.normals[:, None, :]
        slope = flat / self.sigma[:, None, None]
        value = (slope @ (places - self.goals)[..., None])[..., 0]
        return np.arange(len(places)), value, slope

    def loss(self, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the loss of Geman and McClure."""
        return geman_mcclure(square, SLIDE_OUTLIER_M / self.sigma)


@dataclass(frozen=True)
class ShutTerm:
    """Differences between lids or lips that are shut should vanish, wherever these are."""

    anchors: MeshPlaces

    def residuals(self, places: np.ndarray) -> Residuals:
        """Return the metres apart, over sigma."""
        slope = np.broadcast_to(np.eye(3) / SHUT_GAP_M, (len(places), 3, 3))
        return np.arange(len(places)), places / SHUT_GAP_M, slope

    def loss(self, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate least squares."""
        return 0.5 * square, np.ones_like(square)
