"""Track whole clips window by window, keep finished windows, and write sequence.npz."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from express50.capture.index import Cue
from express50.contract.stage import Note
from express50.dataset.tracks import SEQUENCE_SCHEMA
from express50.errors import FormatError, StageError
from express50.files.arrays import read_arrays
from express50.files.atomic import write_bytes
from express50.files.digests import text_digest
from pipelines.track.basis import POSE_SIZE, Points
from pipelines.track.config import VERSION
from pipelines.track.observe import Observation
from pipelines.track.sequence import (
    ClipTracker,
    ClipWindow,
    jitter_mm,
    make_windows,
    sequence_arrays,
    track_window,
)
from pipelines.track.state import Pose

Observe = Callable[[str, int], Observation | None]


def write_clips(
    out: Path,
    tracker: ClipTracker,
    head: str,
    shape: np.ndarray,
    cues: tuple[Cue, ...],
    observe: Observe,
    keep: Path,
    identity: str,
) -> tuple[dict, list[Note]]:
    """Track clips, write out/sequence.npz and return the metrics; see `track_clips`.

    `head` names the head model; its own shape coefficients (S,) are written beside the frames.
    """
    arrays, metrics, dropped = track_clips(tracker, cues, observe, keep, identity)
    arrays |= {"head": np.array(head), "shape": shape}
    np.savez(out / "sequence.npz", **arrays)  # type: ignore[arg-type]  # numpy types its options
    # Only publishing is left; a run that ends before that tracks the clips again.
    shutil.rmtree(keep, ignore_errors=True)
    return metrics, dropped


def track_clips(
    tracker: ClipTracker,
    cues: tuple[Cue, ...],
    observe: Observe,
    keep: Path,
    identity: str,
) -> tuple[dict[str, np.ndarray], dict, list[Note]]:
    """Track every frame of every cue window.

    Finished windows lie in `keep` under a digest of everything they depend on, so a run after a
    crash continues where the last one stopped; `write_clips` removes them at the end.

    Args:
        tracker: the person and the settings.
        cues: windows of frames, both ends inside.
        observe: observes a frame of a cue; None where the cameras agree on no face.
        keep: folder for finished windows.
        identity: digest of the inputs, the settings and the peaks' fit.

    Returns:
        Arrays of sequence.npz, metrics (`frames`, `jitter_mm` per cue), and dropped frames.

    Raises:
        StageError: no frame of any cue shows a face.
    """
    folder = keep / text_digest(f"{VERSION} {identity}")[:16]
    rows: list[tuple[str, int, Pose]] = []
    dropped: list[Note] = []
    for cue in cues:
        frames = list(range(cue.start_frame, cue.end_frame + 1, tracker.stride))
        found: dict[int, Pose] = {}
        for number, window in enumerate(make_windows(frames, sweeps=tracker.sweeps)):
            file = folder / f"{cue.expression_id}_{number:04d}.npz"
            done = _read_window(file)
            if done is None:
                done = _track(tracker, cue.expression_id, window, observe)
                _write_window(file, done, tracker.person.expression_size)
            found |= done
        rows += [(cue.expression_id, frame, found[frame]) for frame in sorted(found)]
        lost = len(frames) - len(found)
        if lost:
            why = f"{lost} of {len(frames)} frames show no face that cameras agree on"
            dropped.append(Note(f"{cue.expression_id} (clip)", why))
    if not rows:
        raise StageError("no frame of any clip shows a face; check the peaks' overlays")
    names, numbers, poses = (list(column) for column in zip(*rows, strict=True))
    arrays = sequence_arrays(tracker.person, numbers, names, poses)
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StageError(f"sequence: {name} holds NaN or infinite values; the fit diverged")
    arrays |= {"schema": np.array(SEQUENCE_SCHEMA)}
    return arrays, {"frames": len(rows), "jitter_mm": _jitter(tracker, rows)}, dropped


def _track(tracker: ClipTracker, cue: str, window: ClipWindow, observe: Observe) -> dict[int, Pose]:
    """Track the kept frames of a window that show a face."""
    seen = [found for frame in window.frames if (found := observe(cue, frame)) is not None]
    poses = track_window(tracker, seen) if seen else []
    kept = set(window.frames[window.kept])
    pairs = zip(seen, poses, strict=True)
    return {observation.frame: pose for observation, pose in pairs if observation.frame in kept}


def _write_window(file: Path, poses: dict[int, Pose], expressions: int) -> None:
    size = expressions + POSE_SIZE
    buffer = io.BytesIO()
    np.savez(
        buffer,
        frames=np.array(sorted(poses), dtype=np.int64),
        own=np.array([poses[frame].own for frame in sorted(poses)]).reshape(-1, size),
        rotation=np.array([poses[frame].rotation for frame in sorted(poses)]).reshape(-1, 3, 3),
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
        return None  # damaged: tracked anew


def _jitter(tracker: ClipTracker, rows: list[tuple[str, int, Pose]]) -> dict[str, float]:
    """Return the mean second difference of vertices, mm, per cue; runs with gaps are skipped."""
    person, stride = tracker.person, tracker.stride
    points = Points(person, np.arange(0, len(person.model.template), 7))
    found = {}
    for cue in sorted({row[0] for row in rows}):
        own = [(frame, pose) for name, frame, pose in rows if name == cue]
        if len(own) < 3 or any(b[0] - a[0] != stride for a, b in zip(own, own[1:], strict=False)):
            continue
        meshes = np.stack([points.evaluate(pose.own, pose.rotation) for _, pose in own])
        found[cue] = round(jitter_mm(meshes), 4)
    return found
