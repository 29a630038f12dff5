"""One frame of a clip held to its pictures: the surface where views agree, the skin of the peaks.

A clip has many frames and the subject's shape and colours are known from the peaks, so a frame
needs few rounds, and its pictures need not be kept: what they said is kept as a quadratic.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.track.config import TrackConfig
from pipelines.track.fit import fit
from pipelines.track.pictures import Moment, Skin, see, with_relief, with_skin
from pipelines.track.sparse_head import Basis, Points
from pipelines.track.state import Pose, State, SurfaceTerm, Target, all_vertices

# Landmarks and the frame before leave a millimetre or two: half of what the peaks' search spans.
REACH_SHARE = 0.5
FIRST_TRUST = 0.3


@dataclass(frozen=True)
class Held:
    """A term of the fit as it was about some positions: cost + gradient d + d matrix d / 2.

    Attributes:
        rows: (S, 3) the samples' corners among the fit's points.
        bary: (S, 3).
        places: (S, 3) world, where the samples were.
        matrix: (S, 3, 3).
        gradient: (S, 3).
        base: the cost there.
    """

    rows: np.ndarray
    bary: np.ndarray
    places: np.ndarray
    matrix: np.ndarray
    gradient: np.ndarray
    base: float

    @classmethod
    def of(cls, term: SurfaceTerm, positions: np.ndarray) -> Held:
        """A term about the fit's points (P, 3)."""
        places = np.einsum("sk,skc->sc", term.bary, positions[term.rows])
        matrix, gradient = term.normal(positions)
        return cls(term.rows, term.bary, places, matrix, gradient, term.cost(positions))

    def cost(self, positions: np.ndarray) -> float:
        """The quadratic's value."""
        moved, slope = self._slope(positions)
        return self.base + 0.5 * float((moved * (slope + self.gradient)).sum())

    def normal(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Its matrix (S, 3, 3) and gradient (S, 3) by the samples' positions, metres."""
        return self.matrix, self._slope(positions)[1]

    def _slope(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = np.einsum("sk,skc->sc", self.bary, positions[self.rows]) - self.places
        return moved, np.einsum("sij,sj->si", self.matrix, moved) + self.gradient


def held_to_pictures(
    person: Basis, target: Target, pose: Pose, moment: Moment, skin: Skin, config: TrackConfig
) -> tuple[Target, Pose]:
    """A frame's pose by its pictures, and the target with what they said.

    Args:
        person: basis with the subject's shape, from `freeze_shape`.
        target: of the frame's landmarks.
        pose: fitted to them.
        moment: the frame's crops.
        skin: from the peaks.
        config: of the stage.
    """
    if not moment.shots or not config.clip_rounds:
        return target, pose
    state, seen = State(np.zeros(0), (pose,)), target
    for left in reversed(range(config.clip_rounds)):
        mesh = all_vertices(person.model, state)[0]
        sight = see(person.model, skin.samples, moment, mesh)
        seen = target
        if config.relief_rounds:
            reach = REACH_SHARE * config.relief_reach * 0.6 ** (config.clip_rounds - 1 - left)
            trust = config.relief_weight * FIRST_TRUST**left
            (seen,) = with_relief(
                person.model, skin.samples, [seen], [moment], [sight], mesh[None], reach, trust
            )
        seen = with_skin(seen, skin, moment, sight, mesh, config)
        state, _ = fit(person, [seen], state, config, config.round_iterations)
    pose = state.poses[0]
    positions = Points(person, seen.vertices).evaluate(pose.own, pose.rotation)
    return replace(seen, terms=tuple(Held.of(term, positions) for term in seen.terms)), pose
