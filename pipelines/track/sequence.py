"""Every frame of a clip, with the shape of the peaks: windows that run apart, smoothed both ways.

The shape is folded into the head model's rest, so the same fit as of the peaks serves. A window is
first tracked frame by frame, each starting from its neighbour; then every frame is fitted again,
pulled towards the mean of its two neighbours. A sweep takes every second frame, then the others, so
that neither direction of time comes first (all at once, the two halves would only swap their
errors). The first and the last frame, which have one neighbour, are treated alike. Windows overlap
by more frames than sweeps reach, and what overlaps is dropped: where a window ends does not show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pipelines.track.config import TrackConfig
from pipelines.track.fit import fit
from pipelines.track.lids import lid_terms
from pipelines.track.marks import Eyes, with_marks
from pipelines.track.observe import Observation
from pipelines.track.sparse_head import POSE_SIZE, Basis, Points
from pipelines.track.start import initial_pose, posed_sigma
from pipelines.track.state import Pose, State, Target, start_state

# Vertices beside the landmarks that neighbours are compared by, and how many of all count.
SPREAD_VERTICES, EFFECTIVE_POINTS = 40, 20
# Frames further apart than so many strides know nothing of each other.
MAX_GAP = 3
Closer = Callable[[Basis, Target, Pose], tuple[Target, Pose]]


@dataclass(frozen=True)
class Window:
    """A run of frames: all that are fitted, and which of them are kept."""

    frames: tuple[int, ...]
    kept: slice


@dataclass(frozen=True)
class Neighbours:
    """Pulls points towards where the neighbouring frames have them.

    Attributes:
        index: (n,) positions among the fit's points.
        middle: (n, 3) world.
        sigma: metres.
    """

    index: np.ndarray
    middle: np.ndarray
    sigma: float

    def residuals(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Block (index (n,), residual (n, 3), slope (n, 3, 3)) of all points' positions (P, 3)."""
        residual = (positions[self.index] - self.middle) / self.sigma
        slope = np.broadcast_to(np.eye(3) / self.sigma, (len(self.index), 3, 3))
        return self.index, residual, slope


def freeze_shape(basis: Basis, shape: np.ndarray, bias: np.ndarray) -> Basis:
    """The basis of one person: shape (S,) is part of the rest, no shape coefficient is left.

    `bias` (68, 3) is what the detector errs on this person.
    """
    coefficients, size = torch.from_numpy(np.asarray(shape, dtype=np.float64)), basis.shape_size
    model = replace(
        basis.model,
        template=basis.model.template + basis.model.shape_dirs @ coefficients,
        shape_dirs=basis.model.shape_dirs[..., :0],
        shape_names=(),
    )
    return replace(
        basis,
        model=model,
        directions=basis.directions[..., size:],
        joints=basis.joints + basis.joint_directions[..., :size] @ coefficients,
        joint_directions=basis.joint_directions[..., size:],
        bias=bias,
    )


def make_windows(frames: Sequence[int], config: TrackConfig) -> list[Window]:
    """Windows over consecutive frames; every frame is kept by exactly one."""
    overlap = 2 * config.sweeps + 2
    windows = []
    for first in range(0, len(frames), config.window):
        last = min(first + config.window, len(frames))
        low, high = max(0, first - overlap), min(len(frames), last + overlap)
        windows.append(Window(tuple(frames[low:high]), slice(first - low, last - low)))
    return windows


def track_window(
    basis: Basis,
    observations: list[Observation],
    config: TrackConfig,
    eyes: Eyes | None = None,
    closer: Closer | None = None,
) -> list[Pose]:
    """Poses of the frames of one window.

    Args:
        basis: of one person, from `freeze_shape`.
        observations: F of them, in order of their frames.
        config: of the fit.
        eyes: what relates the subject's irises to the model's, from `measure_eyes`.
        closer: holds a frame to more than its landmarks, as to its pictures.

    Raises:
        StageError: a frame cannot be fitted.
    """
    template = _template(basis)
    spread = _spread_vertices(basis)
    targets: list[Target] = []
    poses: list[Pose] = []
    for observation in observations:
        start = start_state(basis, [initial_pose(observation, template)])
        if poses:
            own = poses[-1].own.copy()
            own[-3:] = start.poses[0].own[-3:]
            start = State(start.shape, (Pose(own, start.poses[0].rotation),))
        target = _target(observation, start.poses[0], config, spread)
        state, _ = fit(basis, [target], start, config, config.iterations)
        marked = _marked(basis, target, state.poses[0], eyes)
        state, _ = fit(basis, [marked], state, config, config.round_iterations)
        found = state.poses[0]
        if closer is not None:
            marked, found = closer(basis, marked, found)
        targets.append(marked)
        poses.append(found)
    frames = [observation.frame for observation in observations]
    for half in range(2 * config.sweeps):
        poses = _sweep(basis, targets, poses, frames, config, half % 2)
    return poses


def _target(
    observation: Observation, pose: Pose, config: TrackConfig, spread: np.ndarray
) -> Target:
    """What a frame is fitted to; views from behind are left out as at the peaks."""
    sigma = posed_sigma(observation, config, pose.rotation, pose.own[-3:])
    return Target(observation, sigma, False, terms=lid_terms(observation), vertices=spread)


def _marked(basis: Basis, target: Target, pose: Pose, eyes: Eyes | None) -> Target:
    """The target with irises and jaw lines where the first fit shows them."""
    everything = np.arange(len(basis.model.template))
    mesh = Points(basis, everything).evaluate(pose.own, pose.rotation)[68:]
    return with_marks(basis.model, target, mesh, pose.rotation, eyes)


def _sweep(
    basis: Basis,
    targets: list[Target],
    poses: list[Pose],
    frames: list[int],
    config: TrackConfig,
    parity: int,
) -> list[Pose]:
    """Every second frame once more, towards where its neighbours are."""
    index = np.arange(68 + SPREAD_VERTICES)
    crowd = (len(index) / EFFECTIVE_POINTS) ** 0.5
    points = [
        Points(basis, target.vertices).evaluate(pose.own, pose.rotation)[index]
        for target, pose in zip(targets, poses, strict=True)
    ]
    swept = list(poses)
    for number, frame in enumerate(frames):
        # By the frame, not by its place: it is the same in every window that it is in.
        if frame // config.stride % 2 != parity:
            continue
        middle, spread = _expected(points, frames, number, MAX_GAP * config.stride)
        if middle is None:
            continue
        pull = Neighbours(index, middle, 1e-3 * config.smooth_mm * crowd * spread)
        pulled = replace(targets[number], outlines=(*targets[number].outlines, pull))
        start = State(np.zeros(0), (poses[number],))
        state, _ = fit(basis, [pulled], start, config, config.round_iterations)
        swept[number] = state.poses[0]
    return swept


def _expected(
    points: list[np.ndarray], frames: list[int], number: int, gap: int
) -> tuple[np.ndarray | None, float]:
    """Where a frame's points (n, 3) lie by its neighbours, and how much vaguer than between two.

    Between two neighbours it is the point in the line at the frame's time. A first or last frame
    goes on as the two beside it do: held to its one neighbour it would lag behind any motion.
    """
    order = [(number - 1, number + 1), (number + 1, number + 2), (number - 1, number - 2)]
    for near, far in order:
        if not (0 <= near < len(frames) and 0 <= far < len(frames)):
            continue
        if np.diff(sorted((frames[near], frames[number], frames[far]))).max() > gap:
            continue
        share = (frames[number] - frames[near]) / (frames[far] - frames[near])
        expected = (1 - share) * points[near] + share * points[far]
        # Of independent errors, over what the mean of two has.
        return expected, float(np.hypot(np.hypot(1 - share, share), 1.0) / 1.5**0.5)
    return None, 0.0


def _template(basis: Basis) -> np.ndarray:
    """Landmarks (68, 3) of the person at rest."""
    corners = basis.model.template[basis.landmark_vertices]
    return (corners * basis.model.landmark_bary[..., None]).sum(1).numpy()


def _spread_vertices(basis: Basis) -> np.ndarray:
    """Vertices (SPREAD_VERTICES,) all over the head, each the furthest from those before it."""
    places = basis.model.template.numpy()
    chosen = [0]
    nearest = np.linalg.norm(places - places[0], axis=1)
    for _ in range(SPREAD_VERTICES - 1):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return np.array(chosen)


def sequence_arrays(
    basis: Basis, frames: list[int], cues: list[str], poses: list[Pose]
) -> dict[str, np.ndarray]:
    """Arrays of sequence.npz, with the meaning they have in track.npz."""
    own, count = np.stack([pose.own for pose in poses]), basis.expression_size
    return {
        "frames": np.array(frames, dtype=np.int64),
        "cues": np.array(cues),
        "expression": own[:, :count],
        "neck": own[:, count : count + 3],
        "jaw": own[:, count + 3 : count + 6],
        "eyes": own[:, count + 6 : count + POSE_SIZE - 6],
        "R": np.stack([pose.rotation for pose in poses]),
        "t": own[:, -3:],
    }


def jitter_mm(vertices: np.ndarray) -> float:
    """Mean length of the second difference in time of vertices (F, V, 3), millimetres."""
    if len(vertices) < 3:
        return 0.0
    return 1e3 * float(np.linalg.norm(np.diff(vertices, n=2, axis=0), axis=2).mean())
