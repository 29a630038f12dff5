"""Track one window of a clip with the peaks' shape: frame by frame, then smoothed both ways.

The shape is folded into the head model's rest, so the fit of the peaks serves here too. Each frame
starts from its neighbour and is fitted to its landmarks, then to the surface that its pictures
agree on. Sweeps then fit every frame again, pulled towards the mean of its two neighbours: every
second frame first, then the others, so that neither direction of time comes first. The first and
the last frame, which have one neighbour, are treated alike. Windows overlap by more frames than the
sweeps reach, and the overlap is dropped, so window ends do not show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pipelines.track.basis import POSE_SIZE, Basis
from pipelines.track.crops import FrameSetCrops
from pipelines.track.eyes_and_jaw import EyeOffsets, lid_terms, with_irises_and_jaw
from pipelines.track.face_uv import slide_term, with_slide
from pipelines.track.face_uv_map import FaceUvMap
from pipelines.track.fit import fit
from pipelines.track.observe import Observation
from pipelines.track.photo_consistency import SkinSamples, patch_terms
from pipelines.track.schedule import LANDMARK_STEPS, PATCH_REACH_M, ROUND_STEPS
from pipelines.track.state import (
    Pose,
    State,
    Target,
    all_vertices,
    initial_pose,
    posed_sigma,
    start_state,
)
from pipelines.track.terms import MeshPlaces, PointTerm, landmark_anchors

WINDOW = 48  # frames tracked in one piece, and kept if the run is stopped
SWEEPS = 2  # 1 leaves a third more jitter, 4 changes little
SMOOTH_M = 0.001  # standard deviation of a point about the middle of the neighbouring frames'
# Vertices beside the landmarks that neighbours are compared by, and the effective number of all.
SPREAD_VERTICES, EFFECTIVE_POINTS = 40, 20
MAX_GAP = 3  # strides beyond which frames do not constrain each other
# Landmarks and the frame before leave a millimetre or two: half of what the peaks' search spans.
REACH_SHARE, FIRST_TRUST = 0.5, 0.3

Pictures = Callable[[int, np.ndarray], FrameSetCrops]
"""Crops of a frame about its mesh (V, 3)."""


@dataclass(frozen=True)
class ClipTracker:
    """Settings and helpers for tracking windows of one person.

    Attributes:
        person: basis of one person, from `freeze_shape`.
        stride: frames between tracked frames.
        eyes: from `measure_eyes`.
        skin: where the surface is searched for.
        uv_map: of the face, on which landmarks are found anew; None for none.
        pictures: reads a frame's crops; None fits landmarks alone.
        rounds: of searching for the surface per frame.
        sweeps: of smoothing.
    """

    person: Basis
    stride: int = 1
    eyes: EyeOffsets | None = None
    skin: SkinSamples | None = None
    uv_map: FaceUvMap | None = None
    pictures: Pictures | None = None
    rounds: int = 0
    sweeps: int = SWEEPS


@dataclass(frozen=True)
class ClipWindow:
    """A run of frames to fit, and the slice of them to keep."""

    frames: tuple[int, ...]
    kept: slice


def freeze_shape(basis: Basis, shape: np.ndarray, bias: np.ndarray) -> Basis:
    """Fold a person's shape (S,) and detector bias (68, 3) into the basis; poses are left."""
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


def make_windows(
    frames: Sequence[int], size: int = WINDOW, sweeps: int = SWEEPS
) -> list[ClipWindow]:
    """Cut frames into overlapping windows; every frame is kept by exactly one."""
    overlap = 2 * sweeps + 2
    windows = []
    for first in range(0, len(frames), size):
        last = min(first + size, len(frames))
        low, high = max(0, first - overlap), min(len(frames), last + overlap)
        windows.append(ClipWindow(tuple(frames[low:high]), slice(first - low, last - low)))
    return windows


def track_window(tracker: ClipTracker, observations: list[Observation]) -> list[Pose]:
    """Find the poses of the frames of one window.

    Args:
        tracker: person and settings.
        observations: F of them, in order of their frames.

    Raises:
        StageError: a frame cannot be fitted.
    """
    person = tracker.person
    anchors = landmark_anchors(person.model)
    template = anchors.at(person.model.template.numpy())
    targets: list[Target] = []
    poses: list[Pose] = []
    for observation in observations:
        start = start_state(person, [initial_pose(observation, template)])
        pose = start.poses[0]
        # Views from behind are left out as at the peaks.
        sigma = posed_sigma(observation, pose.rotation, pose.own[-3:])
        terms = lid_terms(person.model, observation)
        target = Target(observation, sigma, False, terms)
        if poses:
            own = poses[-1].own.copy()
            own[-3:] = pose.own[-3:]
            start = State(start.shape, (Pose(own, pose.rotation),))
        state, _ = fit(person, [target], start, LANDMARK_STEPS)
        mesh = all_vertices(person.model, state)[0]
        rotation = state.poses[0].rotation
        target = with_irises_and_jaw(person.model, target, mesh, rotation, tracker.eyes)
        state, _ = fit(person, [target], state, ROUND_STEPS)
        target, found = fit_to_pictures(tracker, target, state.poses[0])
        targets.append(target)
        poses.append(found)
    for half in range(2 * tracker.sweeps):
        poses = _sweep(tracker, targets, poses, half % 2)
    return poses


def fit_to_pictures(tracker: ClipTracker, target: Target, pose: Pose) -> tuple[Target, Pose]:
    """Fit a frame to the surface its pictures agree on; returns the target with that surface."""
    person, seen = tracker.person, target
    if tracker.pictures is None or tracker.skin is None or not tracker.rounds:
        return target, pose
    state = State(np.zeros(0), (pose,))
    pictures = tracker.pictures(target.observation.frame, all_vertices(person.model, state)[0])
    if not pictures.crops:
        return target, pose
    for done in range(tracker.rounds):
        mesh = all_vertices(person.model, state)[0]
        reach = REACH_SHARE * PATCH_REACH_M * 0.6**done
        trust = FIRST_TRUST ** (tracker.rounds - 1 - done)
        found = patch_terms(person.model, tracker.skin, pictures, mesh, reach, trust)
        seen = replace(target, terms=(*target.terms, *found))
        if tracker.uv_map is not None:
            seen = with_slide(seen, slide_term(person.model, tracker.uv_map, pictures, mesh))
        state, _ = fit(person, [seen], state, ROUND_STEPS)
    return seen, state.poses[0]


def _sweep(
    tracker: ClipTracker, targets: list[Target], poses: list[Pose], parity: int
) -> list[Pose]:
    """Fit every second frame once more, towards where its neighbours are."""
    person, stride = tracker.person, tracker.stride
    marks = landmark_anchors(person.model)
    spread = MeshPlaces.of_vertices(_spread_vertices(person))
    redundancy = ((len(marks.vertices) + SPREAD_VERTICES) / EFFECTIVE_POINTS) ** 0.5
    frames = [target.observation.frame for target in targets]
    meshes = [all_vertices(person.model, State(np.zeros(0), (pose,)))[0] for pose in poses]
    swept = list(poses)
    for number, frame in enumerate(frames):
        # By the frame, not by its place: it is the same in every window that it is in.
        if frame // stride % 2 != parity:
            continue
        expected, vagueness = _expected(meshes, frames, number, MAX_GAP * stride)
        if expected is None:
            continue
        sigma = SMOOTH_M * redundancy * vagueness
        pull = tuple(PointTerm(one, one.at(expected), sigma) for one in (marks, spread))
        target = replace(targets[number], terms=(*targets[number].terms, *pull))
        state, _ = fit(person, [target], State(np.zeros(0), (poses[number],)), ROUND_STEPS)
        swept[number] = state.poses[0]
    return swept


def _expected(
    points: list[np.ndarray], frames: list[int], number: int, gap: int
) -> tuple[np.ndarray | None, float]:
    """Predict a frame's points (n, 3) from its neighbours; also how much vaguer than between two.

    Between two neighbours the points are interpolated at the frame's time. A first or last frame
    is extrapolated from the two beside it: held to its one neighbour it would lag behind a motion.
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


def _spread_vertices(basis: Basis) -> np.ndarray:
    """Choose vertices all over the head, each the furthest from those before it."""
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
    """Make the arrays of sequence.npz, with the meaning they have in track.npz."""
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
    """Return the mean second difference in time of vertices (F, V, 3), millimetres."""
    if len(vertices) < 3:
        return 0.0
    return 1e3 * float(np.linalg.norm(np.diff(vertices, n=2, axis=0), axis=2).mean())
