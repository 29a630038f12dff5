"""What the fit solves for, and what it is fitted to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch

from express50.head.model import HeadModel, pose
from pipelines.track.observe import Observation, Terms
from pipelines.track.sparse_head import POSE_SIZE, Basis


@dataclass(frozen=True)
class Pose:
    """Unknowns of one expression: own (X + 18,) = expression, neck, jaw, eyes, turn, t; R (3, 3).

    The turn (axis-angle on the world side of R) is folded into R after every step, so it is zero
    between steps.
    """

    own: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class State:
    """Shape (S,), a pose an expression, and the detector's bias (68, 3) on this face, head space.

    What a detector gets wrong on a face it gets wrong in every frame and much alike in every view:
    more of them are no independent evidence. The bias says so; landmarks then tell how a face moves
    rather than what it is.
    """

    shape: np.ndarray
    poses: tuple[Pose, ...]
    bias: np.ndarray = field(default_factory=lambda: np.zeros((68, 3)))


class SurfaceTerm(Protocol):
    """What is known of S samples of the surface, each between three of the fit's points (P, 3)."""

    @property
    def rows(self) -> np.ndarray:
        """The points (S, 3) that a sample lies between."""

    @property
    def bary(self) -> np.ndarray:
        """Their shares (S, 3)."""

    def cost(self, positions: np.ndarray) -> float:
        """Half the sum of squared, robustly weighted residuals."""

    def normal(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrices (S, 3, 3) and gradients (S, 3) of the cost by the samples' positions."""


@dataclass(frozen=True)
class Target:
    """What one expression is fitted to."""

    observation: Observation
    sigma: np.ndarray
    neutral: bool
    outlines: tuple[Terms, ...] = ()
    terms: tuple[SurfaceTerm, ...] = ()
    vertices: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def rounded(state: State, decimals: int) -> State:
    """The state without its last digits, which may differ with another BLAS or machine."""
    poses = tuple(
        Pose(pose.own.round(decimals), pose.rotation.round(decimals)) for pose in state.poses
    )
    return State(state.shape.round(decimals), poses, state.bias.round(decimals))


def start_state(basis: Basis, poses: list[tuple[np.ndarray, np.ndarray]]) -> State:
    """Zero coefficients at given rotations (3, 3) and translations (3,)."""
    made = []
    for rotation, translation in poses:
        own = np.zeros(basis.expression_size + POSE_SIZE)
        own[-3:] = translation
        made.append(Pose(own, rotation))
    return State(np.zeros(basis.shape_size), tuple(made))


def rotations(state: State) -> np.ndarray:
    """World from head (E, 3, 3)."""
    return np.stack([item.rotation for item in state.poses])


def all_vertices(model: HeadModel, state: State) -> np.ndarray:
    """World vertices (E, V, 3) of every expression."""
    own = torch.from_numpy(np.stack([item.own for item in state.poses])).clone()
    count = model.expression_dirs.shape[2]
    shape = torch.from_numpy(state.shape).clone()[None].expand(len(own), -1)
    angles = own[:, count : count + POSE_SIZE - 6]
    with torch.inference_mode():
        head = pose(
            model, shape, own[:, :count], neck=angles[:, :3], jaw=angles[:, 3:6], eyes=angles[:, 6:]
        ).numpy()
    rotation = np.stack([item.rotation for item in state.poses])
    return np.einsum("eij,evj->evi", rotation, head) + own[:, None, -3:].numpy()
