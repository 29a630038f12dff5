"""Where the skin is along itself: landmarks found on the face laid flat.

The relief tells how far the skin lies before or behind the mesh, and colours tell moments from one
another; neither says that a mouth's corner sits a millimetre too far out in all of them. So the
face is laid flat as the pictures show it on the current mesh, and landmarks are found again there:
if a corner of the mouth is seen beside where it belongs, the mesh is to move there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch

from express50.geometry.conventions import corner_to_cell
from express50.head.model import HeadModel, vertex_normals
from express50.landmarks.network import LandmarkNet, load_network
from pipelines.track.chart.layout import HEIGHT, LIPS_APART, WIDTH, Chart, sampled
from pipelines.track.chart.network import FIRST, WEIGHTS, mark_places, read_marks
from pipelines.track.photometry import robust_mean
from pipelines.track.pictures import Moment, see
from pipelines.track.samples import Samples
from pipelines.track.state import Target

# Neighbouring landmarks err together: so many count as one.
CROWD = 2.0
FLOOR_M, OUTLIER_M = 0.0004, 0.004
# Standard deviation of root light between views of one place.
VIEW_NOISE = 0.05
LEAST_SEEN = 0.1
LEAST_VIEWS = 2
# Whole heads tell landmarks more coarsely than the chart, and err otherwise in every expression:
# what a chart tells counts there with so many times its standard deviation. What it does not, as
# the corners of open mouths, stays.
SURPASSED = 6.0
# Texels further apart than this lie on two sides of a gap, as between open lips.
TORN_M = 0.004


@dataclass(frozen=True)
class Slide:
    """Where S landmarks belong along the skin.

    Attributes:
        marks: (S,) which of the 68, which are a fit's first points.
        goals: (S, 3) world.
        normals: (S, 3) world; the distance along them does not count.
        sigma: (S,) metres.
    """

    marks: np.ndarray
    goals: np.ndarray
    normals: np.ndarray
    sigma: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """The landmarks themselves (S, 3), three times each."""
        return np.repeat(self.marks[:, None], 3, axis=1)

    @property
    def bary(self) -> np.ndarray:
        """All shares (S, 3) are the first's."""
        return np.tile([1.0, 0.0, 0.0], (len(self.marks), 1))

    def _off(self, positions: np.ndarray) -> np.ndarray:
        off = positions[self.marks] - self.goals
        return off - (off * self.normals).sum(1, keepdims=True) * self.normals

    def cost(self, positions: np.ndarray) -> float:
        """Half the sum of squared distances over sigma^2, Geman and McClure's beyond a limit."""
        square = (self._off(positions) ** 2).sum(1)
        return 0.5 * float((square / (1.0 + square / OUTLIER_M**2) / self.sigma**2).sum())

    def normal(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton matrix (S, 3, 3) and gradient (S, 3) by the samples' positions, metres."""
        off = self._off(positions)
        weight = 1.0 / (self.sigma * (1.0 + (off**2).sum(1) / OUTLIER_M**2)) ** 2
        flat = np.eye(3) - self.normals[:, :, None] * self.normals[:, None, :]
        return weight[:, None, None] * flat, weight[:, None] * off


def with_slides(targets: list[Target], slides: list[Slide | None]) -> list[Target]:
    """The targets with where the skin belongs, and less trust in the landmarks it tells."""
    return [
        target if slide is None else _with_slide(target, slide)
        for target, slide in zip(targets, slides, strict=True)
    ]


def _with_slide(target: Target, slide: Slide) -> Target:
    sigma = target.sigma.copy()
    sigma[:, slide.marks] *= SURPASSED
    return replace(target, sigma=sigma, terms=(*target.terms, slide))


def read_slide(
    model: HeadModel, chart: Chart, moment: Moment, mesh: np.ndarray, weight: float
) -> Slide | None:
    """Where one moment's skin belongs; None where too little is seen.

    Args:
        model: the head.
        chart: its map.
        moment: pictures.
        mesh: (V, 3) of the fit so far, world.
        weight: trust in the reading.
    """
    colors, mass = read_chart(model, chart, moment, mesh)
    if not (mass > LEAST_SEEN).any():
        return None
    at, error = read_marks(chart_network(), colors)
    rims = LIPS_APART[FIRST:]
    # Single precision is for places about the head, not for those of the world.
    places = chart.image((chart.samples.at(mesh) - mesh.mean(0)).astype(np.float32))
    found, step = _between(places, at + rims)
    home, home_step = _between(places, mark_places() + rims)
    seen = sampled((mass > LEAST_SEEN).astype(np.float32), at + rims)
    good = np.flatnonzero((seen > 0.99) & (np.maximum(step, home_step) < TORN_M))
    if not len(good):
        return None
    samples = landmark_samples(model).some(good + FIRST)
    # The chart rounds off where landmarks lie; by how much it says that they move, it says well.
    goals = samples.at(mesh) + found[good] - home[good]
    normals = samples.at(vertex_normals(torch.from_numpy(mesh)[None], model.faces)[0].numpy())
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    sigma = np.hypot(error[good] * step[good], FLOOR_M) * (CROWD / weight) ** 0.5
    return Slide(good + FIRST, goals, normals, sigma)


def landmark_samples(model: HeadModel) -> Samples:
    """The 68 landmarks' places on the mesh."""
    faces = model.landmark_faces.numpy()
    bary = model.landmark_bary.double().numpy()
    # Shares of single precision that miss 1 by 1e-7 are off by a millimetre 10 km from the origin.
    bary = bary / bary.sum(1, keepdims=True)
    return Samples(faces, model.faces.numpy()[faces], bary)


def read_chart(
    model: HeadModel, chart: Chart, moment: Moment, mesh: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Root light (HEIGHT, WIDTH, 3) on which most views agree, and how well it was seen (H, W).

    What fewer than two views see counts as unseen: one view cannot tell a move along the skin from
    one off it.
    """
    seen = see(model, chart.samples, moment, mesh)
    shared = (seen.weights > 0).sum(0) >= LEAST_VIEWS
    trust = seen.weights**2 * shared
    colors = robust_mean(seen.values, np.ones_like(seen.values), trust, VIEW_NOISE)
    mass = trust.sum(0)[:, None].astype(np.float32)
    return chart.image(colors.astype(np.float32)), chart.image(mass)[..., 0]


def _between(places: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (S, 3) at texels (S, 2), and the longest step (S,) from a texel to the next there."""
    column, row = np.clip(corner_to_cell(at), 0, (WIDTH - 2, HEIGHT - 2)).astype(np.int64).T
    a, b = places[row, column], places[row, column + 1]
    c, d = places[row + 1, column], places[row + 1, column + 1]
    steps = [np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (c, d), (a, c), (b, d))]
    return sampled(places, at).astype(np.float64), np.max(steps, axis=0)


@lru_cache(maxsize=1)
def chart_network() -> LandmarkNet:
    """The shipped network, read once."""
    return load_network(WEIGHTS)
