"""Render the head, compare it with every picture, follow the gradient: the slow, last refinement.

Each step takes one expression with all its views, poses the mesh once and changes only that
expression's own parameters and the shared shape. Every expression has an optimiser of
its own, so one that is not looked at does not drift on stale momentum. Visibility is found once a
visit and kept for its few steps. Coarse to fine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from express50.errors import StageError
from express50.geometry.cameras import transform_camera
from express50.geometry.mesh_raster import face_neighbors, rasterize
from express50.geometry.mesh_render import Covered, covered
from express50.geometry.transforms import axis_angle_to_matrix as axis_angle_to_array
from express50.geometry.transforms import make_transform
from express50.geometry.transforms_torch import axis_angle_to_matrix
from express50.head.model import HeadModel
from express50.head.model import pose as pose_head
from pipelines.track.adam import Adam
from pipelines.track.config import TrackConfig
from pipelines.track.priors import prior
from pipelines.track.render_config import RenderConfig
from pipelines.track.render_loss import (
    Appearance,
    Look,
    Shot,
    Target,
    make_look,
    make_target,
    outline,
    photometric,
    vertex_light,
)
from pipelines.track.state import Pose, State


@dataclass(frozen=True, eq=False)
class Refined:
    """What came out.

    Attributes:
        state: shape and poses.
        before, after: mean data term of the expressions at the last level.
    """

    state: State
    before: float
    after: float


class Problem:
    """The unknowns, their optimisers and what stays the same through all steps.

    `poses` and `shape` (S,) hold the current values; `look` is set for the level.
    """

    def __init__(
        self,
        model: HeadModel,
        state: State,
        look: Look,
        track: TrackConfig,
        config: RenderConfig,
    ) -> None:
        self.model, self.look, self.track, self.config = model, look, track, config
        self.shape, self.poses = state.shape.copy(), list(state.poses)
        self.faces = np.ascontiguousarray(model.faces.numpy(), dtype=np.int32)
        self.neighbors = face_neighbors(self.faces)
        count = model.expression_dirs.shape[2]
        self.rates = np.repeat(
            [config.expression_rate, config.joint_rate, config.turn_rate, config.move_rate],
            [count, 12, 3, 3],
        )
        self.own_steps = [Adam(pose.own.shape) for pose in self.poses]
        self.shape_step = Adam(self.shape.shape)

    def leaves(self, index: int) -> tuple[Tensor, Tensor]:
        """Shape and own parameters of an expression as leaves of a graph."""
        arrays = (self.shape, self.poses[index].own)
        shape, own = (torch.from_numpy(a).float().requires_grad_() for a in arrays)
        return shape, own

    def vertices(self, index: int, shape: Tensor, own: Tensor) -> Tensor:
        """World vertices (V, 3) of an expression."""
        rotation = torch.from_numpy(self.poses[index].rotation).float()
        return posed_vertices(self.model, shape, own, rotation)

    def see(self, index: int, targets: list[Target]) -> list[Covered]:
        """What every camera sees of an expression now."""
        with torch.inference_mode():
            vertices = self.vertices(index, *self.leaves(index)).numpy()
        if not np.isfinite(vertices).all():
            raise StageError("render refinement diverged; lower its rates or start nearer")

        def look(target: Target) -> Covered:
            seen = rasterize(vertices, self.faces, target.camera, neighbors=self.neighbors)
            if seen.pairs is None:
                raise StageError(
                    "render refinement needs the native library for outlines; build it with"
                    " `python -m express50.native.build`"
                )
            return covered(seen)

        return [look(target) for target in targets]

    def data_term(self, vertices: Tensor, targets: list[Target], views: list[Covered]) -> Tensor:
        """How far the views of one expression are from their pictures."""
        config, light = self.config, vertex_light(self.look, vertices)
        colour, shares, outlines = vertices.new_zeros(()), 0.0, vertices.new_zeros(())
        for target, seen in zip(targets, views, strict=True):
            if config.photometric > 0:
                apart, share = photometric(
                    self.look, target, seen, vertices, light, config.softness
                )
                colour, shares = colour + share * apart, shares + share
            if config.outline > 0:
                outlines = outlines + outline(self.look, target, seen, vertices)
        return config.photometric * colour / max(shares, 1e-9) + config.outline * outlines / len(
            views
        )

    def measure(self, index: int, targets: list[Target]) -> float:
        """The data term of an expression as it stands."""
        views = self.see(index, targets)
        with torch.no_grad():
            vertices = self.vertices(index, *self.leaves(index))
            return float(self.data_term(vertices, targets, views))

    def step(
        self, index: int, neutral: bool, targets: list[Target], views: list[Covered], rate: float
    ) -> None:
        """One step of an expression and the shape."""
        leaves = self.leaves(index)
        loss = self.data_term(self.vertices(index, *leaves), targets, views)
        if not torch.isfinite(loss):
            raise StageError("render refinement diverged; lower its rates or start nearer")
        # nothing that is trusted or known may be in view
        seen = loss.requires_grad
        found = torch.autograd.grad(loss, leaves, allow_unused=True) if seen else (None,) * 2
        data = [
            np.zeros(leaf.shape) if gradient is None else gradient.double().numpy()
            for gradient, leaf in zip(found, leaves, strict=True)
        ]
        config, weight = self.config, self.config.prior
        pose = self.poses[index]
        residual, slope = prior(self.model, pose.own, neutral, self.track)
        change = self.own_steps[index].step(data[1] + weight * slope.T @ residual)
        self.poses[index] = _moved(pose, rate * self.rates * change)
        if config.shape_rate > 0:
            gradient = data[0] + weight * self.track.shape_prior * self.shape
            self.shape += rate * config.shape_rate * self.shape_step.step(gradient)


def posed_vertices(model: HeadModel, shape: Tensor, own: Tensor, rotation: Tensor) -> Tensor:
    """World vertices (V, 3) of one expression's parameters, laid out as in `fit.Pose`."""
    count = model.expression_dirs.shape[2]
    expression, joints, turn, place = own.split([count, 12, 3, 3])
    neck, jaw, eyes = joints[None].split([3, 3, 6], dim=1)
    head = pose_head(model, shape[None], expression[None], neck, jaw, eyes)[0]
    return head @ (axis_angle_to_matrix(turn) @ rotation).T + place


def refine(
    model: HeadModel,
    state: State,
    appearance: Appearance,
    shots: Sequence[Sequence[Shot]],
    neutral: Sequence[bool],
    track: TrackConfig,
    config: RenderConfig,
) -> Refined:
    """Refine a fitted head so that its renderings match the pictures. Deterministic.

    Args:
        model: the head model.
        state: shape and one pose an expression.
        appearance: albedo, light and gains; they are not changed.
        shots: for every pose its pictures; an expression without any stays as it is.
        neutral: which poses are the resting face.
        track: the priors' settings.
        config: steps, weights and rates.

    Raises:
        StageError: the fit diverged, or the native library is missing.
        ValueError: lengths do not fit.
    """
    model = model.to("cpu", torch.float32)
    if not len(state.poses) == len(shots) == len(neutral):
        raise ValueError(
            f"render refinement: {len(state.poses)} poses, {len(shots)} lists of shots and"
            f" {len(neutral)} neutral flags; expected as many of each"
        )
    # Far from the origin float32 is too coarse for tenths of a millimetre.
    origin = np.mean([pose.own[-3:] for pose in state.poses], axis=0) if shots else np.zeros(3)
    looks = {d: make_look(model, appearance, d) for d in config.levels}
    finest = config.levels[-1]
    problem = Problem(model, _shifted(state, -origin), looks[finest], track, config)
    looked_at = [index for index, views in enumerate(shots) if views]

    def targets(index: int, divisor: int) -> list[Target]:
        return [target_of(shot, appearance, divisor, origin) for shot in shots[index]]

    def data_term() -> float:
        terms = (problem.measure(i, targets(i, finest)) for i in looked_at)
        return sum(terms) / max(1, len(looked_at))

    before = data_term()
    for place, divisor in enumerate(config.levels):
        problem.look = looks[divisor]
        for visit in range(config.rounds):
            done = (place + visit / config.rounds) / len(config.levels)
            # there and back, so that the shape is not always left to the last expression
            for index in looked_at[:: 1 if visit % 2 == 0 else -1]:
                views = targets(index, divisor)
                seen = problem.see(index, views)
                for _ in range(config.steps):
                    problem.step(index, neutral[index], views, seen, 0.1**done)
    after = data_term()
    return Refined(_shifted(State(problem.shape, tuple(problem.poses)), origin), before, after)


def target_of(shot: Shot, appearance: Appearance, divisor: int, origin: np.ndarray) -> Target:
    """A shot at one resolution in the world whose origin is `origin`."""
    move = make_transform(np.eye(3), -origin)
    near_by = replace(shot, camera=transform_camera(shot.camera, move))
    return make_target(near_by, appearance.gains.get(shot.camera.id, np.ones(3)), divisor)


def _shifted(state: State, by: np.ndarray) -> State:
    """The state with its heads moved."""
    poses = []
    for pose in state.poses:
        own = pose.own.copy()
        own[-3:] += by
        poses.append(replace(pose, own=own))
    return State(state.shape.copy(), tuple(poses))


def _moved(pose: Pose, change: np.ndarray) -> Pose:
    """The pose after a change of its own parameters, the turn folded into the rotation."""
    own = pose.own + change
    rotation = axis_angle_to_array(own[-6:-3]) @ pose.rotation
    own[-6:-3] = 0.0
    return Pose(own, rotation)
