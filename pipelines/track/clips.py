"""Tracks whole clips window by window, keeps what is finished, and writes sequence.npz."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from express50.capture.index import Cue
from express50.dataset.tracks import SEQUENCE_SCHEMA
from express50.errors import FormatError, StageError
from express50.files.arrays import read_arrays
from express50.files.atomic import write_bytes
from express50.files.digests import path_digest, text_digest, value_digest
from pipelines.track.config import VERSION, TrackConfig
from pipelines.track.marks import Eyes
from pipelines.track.observe import Observation
from pipelines.track.offsets import split_shape
from pipelines.track.sequence import (
    Closer,
    Window,
    freeze_shape,
    jitter_mm,
    make_windows,
    sequence_arrays,
    track_window,
)
from pipelines.track.sparse_head import Basis, Points
from pipelines.track.state import Pose, State

Observe = Callable[[str, int], Observation | None]


def write_clips(
    out: Path,
    basis: Basis,
    state: State,
    cues: tuple[Cue, ...],
    observe: Observe,
    config: TrackConfig,
    keep: Path,
    inputs: dict[str, Path | str],
    eyes: Eyes | None,
    closer: Closer | None = None,
) -> dict:
    """Track clips, write out/sequence.npz and return the metrics; see `track_clips`.

    `inputs` is what the stage reads: windows kept by a run with other inputs are not used. The
    head's own shape coefficients (S,) are written beside the frames.
    """
    digests = {name: path_digest(p) if isinstance(p, Path) else p for name, p in inputs.items()}
    arrays, account = track_clips(
        basis, state, cues, observe, config, keep, value_digest(digests), eyes, closer
    )
    arrays |= {"shape": split_shape(basis.model, state.shape)[0]}
    np.savez(out / "sequence.npz", **arrays)  # type: ignore[arg-type]  # numpy types its options
    # Only publishing is left; what ends the run before that costs the clips.
    shutil.rmtree(keep, ignore_errors=True)
    return account


def track_clips(
    basis: Basis,
    state: State,
    cues: tuple[Cue, ...],
    observe: Observe,
    config: TrackConfig,
    keep: Path,
    identity: str,
    eyes: Eyes | None = None,
    closer: Closer | None = None,
) -> tuple[dict[str, np.ndarray], dict]:
    """Track every frame of every cue window.

    Finished windows lie in `keep` under a digest of all that they depend on, so that a run after a
    crash goes on where the last one stopped; `write_clips` removes them when all is written.

    Args:
        basis: the head model.
        state: of the peaks' fit; its shape and the detector's bias are kept.
        cues: windows of frames, both ends inside.
        observe: what the cameras see at a frame of a cue; None where that is no face.
        config: of the fit.
        keep: folder for finished windows.
        identity: digest of the inputs (footage, cameras, landmarks, head model).
        eyes: from `measure_eyes`.
        closer: see `track_window`.

    Returns:
        Arrays of sequence.npz, and metrics: `frames`, `jitter_mm` a cue and `dropped`.

    Raises:
        StageError: no frame of any cue shows a face.
    """
    person = freeze_shape(basis, state.shape, state.bias)
    known = (VERSION, identity, state.shape.tobytes(), state.bias.tobytes(), asdict(config))
    key = text_digest(repr((*known, eyes and vars(eyes))))
    rows: list[tuple[str, int, Pose]] = []
    dropped: list[dict[str, str]] = []
    for cue in cues:
        frames = list(range(cue.start_frame, cue.end_frame + 1, config.stride))
        found: dict[int, Pose] = {}
        for number, window in enumerate(make_windows(frames, config)):
            file = keep / key[:16] / f"{cue.expression_id}_{number:04d}.npz"
            done = _read_window(file)
            if done is None:
                done = _track(person, cue.expression_id, window, observe, config, eyes, closer)
                _write_window(file, done, person)
            found |= done
        rows += [(cue.expression_id, frame, found[frame]) for frame in sorted(found)]
        lost = len(frames) - len(found)
        if lost:
            why = f"{lost} of {len(frames)} frames show no face that cameras agree on"
            dropped.append({"what": f"{cue.expression_id} (clip)", "why": why})
    if not rows:
        raise StageError("no frame of any clip shows a face; look at the peaks' overlays")
    arrays = sequence_arrays(person, *_columns(rows))
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StageError(f"sequence: {name} holds NaN or infinite values; the fit diverged")
    arrays |= {"schema": np.array(SEQUENCE_SCHEMA), "head": np.array(config.head)}
    return arrays, {
        "frames": len(rows),
        "jitter_mm": _jitter(person, rows, config.stride),
        "dropped": dropped,
    }


def _columns(rows: list[tuple[str, int, Pose]]) -> tuple[list[int], list[str], list[Pose]]:
    cues, frames, poses = zip(*rows, strict=True)
    return list(frames), list(cues), list(poses)


def _track(
    person: Basis,
    cue: str,
    window: Window,
    observe: Observe,
    config: TrackConfig,
    eyes: Eyes | None,
    closer: Closer | None,
) -> dict[int, Pose]:
    """Poses of the kept frames of a window that show a face."""
    seen = [found for frame in window.frames if (found := observe(cue, frame)) is not None]
    poses = track_window(person, seen, config, eyes, closer) if seen else []
    kept = set(window.frames[window.kept])
    pairs = zip(seen, poses, strict=True)
    return {observation.frame: pose for observation, pose in pairs if observation.frame in kept}


def _write_window(file: Path, poses: dict[int, Pose], person: Basis) -> None:
    size = person.expression_size + 18
    buffer = io.BytesIO()
    np.savez(
        buffer,
        frames=np.array(sorted(poses), dtype=np.int64),
        own=np.array([poses[frame].own for frame in sorted(poses)]).reshape(-1, size),
        rotation=np.array([poses[frame].rotation for frame in sorted(poses)]).reshape(-1, 3, 3),
    )
    write_bytes(file, buffer.getvalue())


def _read_window(file: Path) -> dict[int, Pose] | None:
    """What a former run finished; None where it did not."""
    if not file.is_file():
        return None
    try:
        data = read_arrays(file, FormatError, "a window", ("frames", "own", "rotation"))
        rows = zip(data["frames"].tolist(), data["own"], data["rotation"], strict=True)
        return {frame: Pose(own, rotation) for frame, own, rotation in rows}
    except (FormatError, ValueError, TypeError):
        return None  # damaged: tracked anew


def _jitter(person: Basis, rows: list[tuple[str, int, Pose]], stride: int) -> dict[str, float]:
    """Mean second difference of all vertices, mm, by cue; runs with gaps are passed over."""
    points = Points(person, np.arange(0, len(person.model.template), 7))
    found = {}
    for cue in sorted({row[0] for row in rows}):
        own = [(frame, pose) for name, frame, pose in rows if name == cue]
        if len(own) < 3 or any(b[0] - a[0] != stride for a, b in zip(own, own[1:], strict=False)):
            continue
        meshes = np.stack([points.evaluate(pose.own, pose.rotation)[68:] for _, pose in own])
        found[cue] = round(jitter_mm(meshes), 4)
    return found
