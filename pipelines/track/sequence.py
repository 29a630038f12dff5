"""Track clips with the peaks' shape: frame by frame, then smoothed both ways, window by window.

docs/TRACKING.md, section Schedule, describes the steps. The shape is folded into the head model's
rest, so that the peaks' solver serves here too. Sweeps treat both directions of time alike. Windows
overlap by more frames than the sweeps reach, and the overlap is dropped, so that ends of windows do
not show.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from express50.capture.index import Cue
from express50.contract.stage import Note
from express50.dataset.tracks import SEQUENCE_SCHEMA
from express50.errors import FormatError, StageError
from express50.files.arrays import read_arrays
from express50.files.atomic import write_bytes
from express50.files.digests import text_digest
from pipelines.track.basis import POSE_SIZE, Basis, Points
from pipelines.track.config import VERSION
from pipelines.track.eyes_and_jaw import EyeOffsets, shut_terms, with_irises_and_jaw
from pipelines.track.face_uv import FaceUvMap, slide_term, with_slide
from pipelines.track.fit import condensed, fit
from pipelines.track.observe import Observation
from pipelines.track.photo_consistency import SkinSamples, patch_terms
from pipelines.track.read_inputs import FindFace
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
from pipelines.track.surface import CutCrops
from pipelines.track.terms import MeshPlaces, PointTerm, landmark_anchors

WINDOW = 48  # frames tracked in one piece, and kept if the run is stopped
SWEEP_STEPS = 2  # of a frame's fit in a sweep, whose evidence is a quadratic
SWEEPS = 2  # 1 leaves a third more jitter, 4 changes little
SMOOTH_M = 0.001  # standard deviation of a point about the middle of the neighbouring frames'
# Vertices beside the landmarks that neighbours are compared by, and the effective number of all.
SPREAD_VERTICES, EFFECTIVE_POINTS = 40, 20
MAX_GAP = 3  # strides beyond which frames do not constrain each other
# A start from landmarks and the frame before is a millimetre or two off: half of the peaks' reach.
REACH_SHARE, FIRST_TRUST = 0.5, 0.3

Observed = tuple[FindFace, CutCrops]
"""How to find a frame's face and to cut its crops, until the next frame is asked for."""
ReadClip = Callable[[str, Sequence[int]], Iterable[Observed]]
"""Read frames of a cue, one after the other."""


@dataclass(frozen=True)
class ClipTracker:
    """Settings and helpers for tracking windows of one person, whose basis is of `freeze_shape`.

    Every `stride`-th frame is tracked. `eyes`, `skin` and `uv_map` are those of the peaks' rounds;
    the surface is searched for in `rounds` rounds per frame, and motion is smoothed in `sweeps`.
    """

    person: Basis
    stride: int = 1
    eyes: EyeOffsets | None = None
    skin: SkinSamples | None = None
    uv_map: FaceUvMap | None = None
    rounds: int = 0
    sweeps: int = SWEEPS


def make_windows(
    frames: Sequence[int], sweeps: int, size: int = WINDOW
) -> list[tuple[Sequence[int], Sequence[int]]]:
    """Cut frames into overlapping windows to fit, each with the frames that it alone keeps."""
    overlap = 2 * sweeps + 2
    return [
        (frames[max(0, first - overlap) : first + size + overlap], frames[first : first + size])
        for first in range(0, len(frames), size)
    ]


def track_window(tracker: ClipTracker, clip: Iterable[Observed]) -> dict[int, Pose]:
    """Find the pose of every frame of one window, read in their order; some may have none."""
    targets: list[Target] = []
    poses: list[Pose] = []
    marks, lost = None, True
    anchors = landmark_anchors(tracker.person.model)
    for look, cut_crops in clip:
        observation = look(None if lost else marks)
        lost = observation is None
        if observation is None:
            continue
        before = poses[-1] if poses else None
        try:
            target, pose = _track_frame(tracker, observation, cut_crops, before)
        except StageError:  # its landmarks fit no head: one frame must not cost all of them
            lost = True
            continue
        targets.append(condensed(tracker.person, target, pose))
        poses.append(pose)
        marks = anchors.at(_mesh(tracker.person, pose))
    for half in range(2 * tracker.sweeps):
        poses = _sweep(tracker, targets, poses, half % 2)
    return {target.observation.frame: pose for target, pose in zip(targets, poses, strict=True)}


def _track_frame(
    tracker: ClipTracker, observation: Observation, cut_crops: CutCrops, before: Pose | None
) -> tuple[Target, Pose]:
    """Fit one frame, from the pose of the one before where there is one."""
    person, model = tracker.person, tracker.person.model
    # The face of the frame before, or a face at rest, is moved to where the landmarks are.
    anchors = landmark_anchors(model)
    if before is None:
        template = anchors.at(model.template.numpy())
        pose = start_state(person, [initial_pose(observation, template)]).poses[0]
    else:
        own, marks = before.own.copy(), anchors.at(_mesh(person, before))
        rotation, own[-3:] = initial_pose(observation, (marks - own[-3:]) @ before.rotation)
        pose = Pose(own, rotation)
    # Views from behind are left out as at the peaks.
    sigma = posed_sigma(observation, pose.rotation, pose.own[-3:])
    target = Target(observation, sigma, False, shut_terms(model, observation))
    if before is None:
        pose = _fitted(person, target, pose, LANDMARK_STEPS)
    mesh = _mesh(person, pose)
    target = with_irises_and_jaw(model, target, mesh, pose.rotation, tracker.eyes)
    pose = _fitted(person, target, pose, ROUND_STEPS)
    return fit_to_pictures(tracker, target, pose, cut_crops)


def _mesh(person: Basis, pose: Pose) -> np.ndarray:
    return all_vertices(person.model, State(np.zeros(0), (pose,)))[0]


def _fitted(person: Basis, target: Target, pose: Pose, steps: int) -> Pose:
    return fit(person, [target], State(np.zeros(0), (pose,)), steps)[0].poses[0]


def fit_to_pictures(
    tracker: ClipTracker, target: Target, pose: Pose, cut_crops: CutCrops
) -> tuple[Target, Pose]:
    """Fit a frame to the surface its pictures agree on; returns the target with that surface."""
    person, seen = tracker.person, target
    if tracker.skin is None or not tracker.rounds:
        return target, pose
    mesh = _mesh(person, pose)
    pictures = cut_crops(mesh)
    if not pictures.crops:
        return target, pose
    for done in range(tracker.rounds):
        reach = REACH_SHARE * PATCH_REACH_M * 0.6**done
        trust = FIRST_TRUST ** (tracker.rounds - 1 - done)
        found = patch_terms(person.model, tracker.skin, pictures, mesh, reach, trust)
        seen = replace(target, terms=(*target.terms, *found))
        if tracker.uv_map is not None:
            seen = with_slide(seen, slide_term(person.model, tracker.uv_map, pictures, mesh))
        pose = _fitted(person, seen, pose, ROUND_STEPS)
        mesh = _mesh(person, pose)
    return seen, pose


def _sweep(
    tracker: ClipTracker, targets: list[Target], poses: list[Pose], parity: int
) -> list[Pose]:
    """Fit every second frame once more, towards where its neighbours are."""
    person, stride = tracker.person, tracker.stride
    marks = landmark_anchors(person.model)
    places, chosen = person.model.template.numpy(), [0]
    nearest = np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < SPREAD_VERTICES:  # all over the head, each the furthest from the others
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[-1]], axis=1))
    spread = MeshPlaces.of_vertices(np.array(chosen))
    redundancy = ((len(marks.vertices) + SPREAD_VERTICES) / EFFECTIVE_POINTS) ** 0.5
    frames = [target.observation.frame for target in targets]
    meshes = [_mesh(person, pose) for pose in poses]
    swept = list(poses)
    for number, frame in enumerate(frames):
        # By the frame's number, which is the same in every window that holds the frame.
        if frame // stride % 2 != parity:
            continue
        expected, vagueness = _expected(meshes, frames, number, MAX_GAP * stride)
        if expected is None:
            continue
        sigma = SMOOTH_M * redundancy * vagueness
        pull = tuple(PointTerm(one, one.at(expected), sigma) for one in (marks, spread))
        target = replace(targets[number], terms=(*targets[number].terms, *pull))
        swept[number] = _fitted(person, target, poses[number], SWEEP_STEPS)
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


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays without pickled objects; StageError if one of them is not finite."""
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StageError(f"{path.name}: {name} holds NaN or infinity; the fit diverged")
    np.savez(path, **arrays)  # type: ignore[arg-type]  # numpy types its options


def pose_arrays(poses: Sequence[Pose], expressions: int) -> dict[str, np.ndarray]:
    """Make the arrays of F poses that track.npz and sequence.npz share; X `expressions`."""
    own = np.stack([pose.own for pose in poses])
    return {
        "expression": own[:, :expressions],
        "neck": own[:, expressions : expressions + 3],
        "jaw": own[:, expressions + 3 : expressions + 6],
        "eyes": own[:, expressions + 6 : expressions + 12],
        "R": np.stack([pose.rotation for pose in poses]),
        "t": own[:, -3:],
    }


def write_clips(
    out: Path,
    tracker: ClipTracker,
    head: str,
    shape: np.ndarray,
    cues: tuple[Cue, ...],
    fps: float,
    read: ReadClip,
    keep: Path,
    identity: str,
) -> tuple[dict, list[Note]]:
    """Track every frame of every cue window and write out/sequence.npz (docs/FORMAT.md).

    Finished windows lie in `keep` under a digest of everything they depend on, so a run after a
    crash continues where the last one stopped; they go once the sequence is written.

    `head` names the head model, `shape` (S,) are its own coefficients; `fps` is the footage's
    rate; `identity` says which inputs, settings and fit of the peaks the windows are of.

    Returns:
        Metrics (`frames`, `jitter_mm` per cue), and dropped frames.

    Raises:
        StageError: no frame of any cue shows a face.
    """
    folder = keep / text_digest(f"{VERSION} {identity}")[:16]
    rows: list[tuple[str, int, Pose]] = []
    dropped: list[Note] = []
    for cue in cues:
        frames = list(range(cue.start_frame, cue.end_frame + 1, tracker.stride))
        found: dict[int, Pose] = {}
        windows = make_windows(frames, tracker.sweeps)
        for number, (fitted, kept) in enumerate(windows):
            file = folder / f"{cue.expression_id}_{number:04d}.npz"
            done = _read_window(file)
            if done is None:
                all_fitted = track_window(tracker, read(cue.expression_id, fitted))
                done = {frame: pose for frame, pose in all_fitted.items() if frame in kept}
                _write_window(file, done, tracker.person.expression_size)
            found |= done
        rows += [(cue.expression_id, frame, found[frame]) for frame in sorted(found)]
        lost = len(frames) - len(found)
        if lost:
            why = f"{lost} of {len(frames)} frames show no face that cameras agree on"
            dropped.append(Note(f"{cue.expression_id} (clip)", why))
    if not rows:
        raise StageError("no frame of any clip shows a face; check the peaks' overlays")
    names, numbers, poses = zip(*rows, strict=True)
    arrays = {"frames": np.array(numbers, dtype=np.int64), "cues": np.array(names)}
    arrays |= pose_arrays(poses, tracker.person.expression_size)
    arrays |= {"schema": np.array(SEQUENCE_SCHEMA), "head": np.array(head), "shape": shape}
    arrays["rate"] = np.array(fps / tracker.stride)
    write_npz(out / "sequence.npz", arrays)
    # Only publishing is left; a run that ends before that tracks the clips again.
    shutil.rmtree(keep, ignore_errors=True)
    return {"frames": len(rows), "jitter_mm": _jitter(tracker, rows)}, dropped


def _write_window(file: Path, poses: dict[int, Pose], expressions: int) -> None:
    buffer = io.BytesIO()
    rows = [poses[frame] for frame in sorted(poses)]
    np.savez(
        buffer,
        frames=np.array(sorted(poses), dtype=np.int64),
        own=np.array([pose.own for pose in rows]).reshape(-1, expressions + POSE_SIZE),
        rotation=np.array([pose.rotation for pose in rows]).reshape(-1, 3, 3),
    )
    write_bytes(file, buffer.getvalue())


def _read_window(file: Path) -> dict[int, Pose] | None:
    """Read a window that a former run finished; None if it did not."""
    if not file.is_file():
        return None
    try:
        data = read_arrays(file, FormatError, "a window", ("frames", "own", "rotation"))
        rows = zip(data["frames"].tolist(), data["own"], data["rotation"], strict=True)
        return {frame: Pose(own, rotation) for frame, own, rotation in rows}
    except (FormatError, ValueError, TypeError):
        return None  # damaged: tracked again


def _jitter(tracker: ClipTracker, rows: list[tuple[str, int, Pose]]) -> dict[str, float]:
    """Return the mean second difference of vertices, mm, per cue; runs with gaps are skipped."""
    person = tracker.person
    points = Points(person, np.arange(0, len(person.model.template), 7))
    found = {}
    for cue in sorted({row[0] for row in rows}):
        frames, poses = zip(*(row[1:] for row in rows if row[0] == cue), strict=True)
        if len(frames) < 3 or (np.diff(frames) != tracker.stride).any():
            continue
        meshes = np.stack([points.evaluate(pose.own, pose.rotation) for pose in poses])
        found[cue] = round(jitter_mm(meshes), 4)
    return found


def jitter_mm(vertices: np.ndarray) -> float:
    """Return the mean second difference in time of vertices (F, V, 3), millimetres."""
    return 1e3 * float(np.linalg.norm(np.diff(vertices, n=2, axis=0), axis=2).mean())
