"""Shut eyes: the lids meet where cameras find no iris that they find at other times.

Whether there is an iris is a matter of contrast, and found or not in some twenty pixels. How far
apart the lids are is a matter of one or two pixels of a landmark network's crop, which puts shut
lids nearly as far apart as open ones. Only shut eyes are told; half shut ones stay as seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from express50.landmarks.iris import EYES
from pipelines.track.observe import Observation, View, agree
from pipelines.track.state import SurfaceTerm

# A camera tells of an eye if it finds the iris at more than this share of the other times, and the
# eye is now at least this much of its usual width there: it has not turned away.
USUAL, WIDE = 0.5, 0.75
LEAST_CAMERAS = 2
# Lashes and folds are taken for irises now and then, with little confidence. Its squares over the
# cameras are at most this share of what they are at other times if the eye is shut.
CHANCE = 0.3
# What is left of the gap between the lids.
GAP = 0.1
# Standard deviation of the way between the landmarks of shut lids, which is nothing.
TOUCHING_M = 0.0005


@dataclass(frozen=True)
class ShutLids:
    """A term of the fit: these eyes' lids touch, wherever that is."""

    shut: tuple[int, ...]

    @property
    def rows(self) -> np.ndarray:
        """A sample (S, 3) is made of two landmarks, which are a fit's first points."""
        pairs = [pair for side in self.shut for pair in zip(*EYES[side][2:], strict=True)]
        return np.array([(upper, lower, lower) for upper, lower in pairs])

    @property
    def bary(self) -> np.ndarray:
        """Shares (S, 3) that sum to nothing: it is the way from the lower one to the upper."""
        return np.tile([1.0, -1.0, 0.0], (len(self.rows), 1))

    def _way(self, positions: np.ndarray) -> np.ndarray:
        return (positions[self.rows[:, 0]] - positions[self.rows[:, 1]]) / TOUCHING_M

    def cost(self, positions: np.ndarray) -> float:
        """Half the sum of squared standard deviations."""
        return 0.5 * float((self._way(positions) ** 2).sum())

    def normal(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton matrix (S, 3, 3) and gradient (S, 3) by the ways, metres."""
        way = self._way(positions)
        return np.tile(np.eye(3) / TOUCHING_M**2, (len(way), 1, 1)), way / TOUCHING_M


def lid_terms(observation: Observation) -> tuple[SurfaceTerm, ...]:
    """What a fit is to know of the observation's shut eyes, if there are any."""
    return (ShutLids(observation.shut),) if observation.shut else ()


def shut_lids(
    observations: list[Observation], others: Sequence[Observation] | None = None
) -> list[Observation]:
    """One person's observations with the upper lids of shut eyes brought down to the lower ones.

    Args:
        observations: to be looked at.
        others: the times to compare each with, in most of which eyes are open; by default those of
            the observations that it is not itself.
    """
    shut = np.zeros((len(observations), 2), dtype=bool)
    for side in range(2):
        seen = [_irises(observation, side) for observation in observations]
        usual = None if others is None else [_irises(other, side) for other in others]
        shut[:, side] = [
            _is_shut(now, seen[:k] + seen[k + 1 :] if usual is None else usual)
            for k, now in enumerate(seen)
        ]
    return [
        _shut(observation, sides) if sides.any() else observation
        for observation, sides in zip(observations, shut, strict=True)
    ]


def _irises(observation: Observation, side: int) -> dict[str, tuple[float, float]]:
    """By camera the confidence of one eye's iris, 0 where none was found, and its width, pixels."""
    first, last = EYES[side][:2]
    return {
        view.camera_id: (
            float(view.irises.confidence[side]),
            float(np.linalg.norm(view.points[last] - view.points[first])),
        )
        for view in observation.views
        if view.irises is not None
    }


def _is_shut(
    now: dict[str, tuple[float, float]], others: list[dict[str, tuple[float, float]]]
) -> bool:
    usual = []
    for camera, (_, width) in now.items():
        then = [other[camera] for other in others if camera in other]
        found = np.array([pair for pair in then if pair[0] > 0]).reshape(-1, 2)
        if len(found) > USUAL * len(then) and width > WIDE * np.median(found[:, 1]):
            usual.append(np.median(found[:, 0]))
    if len(usual) < max(1, min(LEAST_CAMERAS, len(now))):
        return False
    # Any camera counts here: a head that turned shows its irises to others.
    return sum(sure**2 for sure, _ in now.values()) <= CHANCE * np.square(usual).sum()


def _shut(observation: Observation, sides: np.ndarray) -> Observation:
    views = [_with_lids(view, sides) for view in observation.views]
    found, _ = agree(observation.expression, observation.frame, views)
    refused = observation.refused + found.refused
    return replace(found, refused=refused, shut=tuple(np.flatnonzero(sides).tolist()))


def _with_lids(view: View, sides: np.ndarray) -> View:
    points = view.points.copy()
    for side in np.flatnonzero(sides):
        upper, lower = (list(lid) for lid in EYES[side][2:])
        points[upper] = points[lower] + GAP * (points[upper] - points[lower])
    return replace(view, points=points)
