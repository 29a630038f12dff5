"""The observe stage's work: which cameras watch a face, and what they see of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from annotations.observe import NEUTRAL, SCHEMA, SEEN_SCORE, ObserveConfig
from annotations.observe.faces import align_faces, find_points
from express50.capture.frames import read_proxy
from express50.capture.index import Cue, Index, read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.errors import StageError
from express50.files.images import contact_sheet, write_image
from express50.landmarks.detector import detect
from express50.landmarks.network import LandmarkNet, load_network

TRIES = 8  # frames all over the clips in which a face is searched for, should rest show none
RANKED_SHARE = 0.8  # of the best camera's score: one that sees less adds more noise than news


def run(dataset: Dataset, item: str, config: ObserveConfig, out: Path) -> Result:
    """Write ``observations.npz`` and a picture of the watching cameras at rest."""
    index = read_index(dataset, item)
    windows = {c.expression_id: cue_frames(index, c, config.stride) for c in index.cues}
    if not any(len(frames) for frames in windows.values()):
        raise StageError(f"{item}: cues.csv names no expression in the footage; add its timing")
    net = load_network()
    rest = windows.get(NEUTRAL)
    if rest is None or not len(rest):
        rest = np.array([frames[0] for frames in windows.values() if len(frames)])
    frames = np.unique(np.concatenate(list(windows.values())))

    def score(camera: str, frame: int) -> float:
        return detect(net, read_proxy(dataset, item, camera, frame), smallest=config.search).score

    tries = frames_to_try(rest, frames)
    middle, ranked = choose_cameras(index, score, tries, config.min_score)
    cameras = ranked[: config.cameras]
    rest = np.union1d(rest, [middle])
    seen = [c for c in windows.values() if len(c)]
    views = [_watch(dataset, item, net, camera, seen, rest, config.search) for camera in cameras]
    points, scores, faces = (np.stack(part) for part in zip(*views, strict=True))
    np.savez_compressed(
        out / "observations.npz", schema=SCHEMA, cameras=np.array(cameras), frames=frames,
        points=points.astype(np.float32), scores=scores.astype(np.float32), faces=faces,
    )  # fmt: skip
    (out / "qc").mkdir()
    row = [read_proxy(dataset, item, camera, middle) for camera in cameras]
    write_image(out / "qc" / "cameras.jpg", contact_sheet([row], [", ".join(cameras)]), quality=85)
    metrics = {
        "frames": len(frames),
        "watching_cameras": list(cameras),
        "score_median": round(float(np.median(scores)), 4),
    }
    beyond = [e for e, window in windows.items() if not len(window)]
    return Result(metrics, [Note(e, "its cue lies beyond the footage") for e in beyond])


def cue_frames(index: Index, cue: Cue, stride: int = 1) -> np.ndarray:
    """List every stride-th frame of a cue window that the footage has."""
    return np.arange(cue.start_frame, min(cue.end_frame, index.frames - 1) + 1, stride)


def frames_to_try(rest: np.ndarray, frames: np.ndarray) -> list[int]:
    """List the frames in which to search for the face: at rest, then all over the clips."""
    spread = [*np.linspace(0, len(rest) - 1, 3)[[1, 0, 2]].astype(int)]
    others = np.linspace(0, len(frames) - 1, TRIES).astype(int)
    return list(dict.fromkeys([*(int(rest[i]) for i in spread), *(int(frames[i]) for i in others)]))


def choose_cameras(
    index: Index,
    score: Callable[[str, int], float],
    frames: list[int],
    min_score: float,
) -> tuple[int, list[str]]:
    """Find the first of the frames that shows a face, and rank the cameras that see it best.

    Raises:
        StageError: no camera sees a face in any.
    """
    best = 0.0
    for frame in frames:
        scores = {camera: score(camera, frame) for camera in index.cameras}
        ranked = sorted(scores, key=lambda c: (-scores[c], c))
        best = max(best, scores[ranked[0]])
        if scores[ranked[0]] >= min_score:
            enough = max(min_score, RANKED_SHARE * scores[ranked[0]])
            return frame, [c for c in ranked if scores[c] >= enough]
    raise StageError(
        f"{index.subject}: no camera sees a face in frames {', '.join(map(str, sorted(frames)))}"
        f" (best score {best:.2f}, expected {min_score}); check that the face is in view, label it"
        " with 'express50 annotate mark', or lower observe.min_score"
    )


def _watch(
    dataset: Dataset,
    subject: str,
    net: LandmarkNet,
    camera: str,
    windows: list[np.ndarray],
    rest: np.ndarray,
    smallest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Watch windows of frames with one camera.

    Returns:
        Points (F, 68, 2), scores (F,) and aligned faces (F, FACE, FACE) of all frames of the
        windows in increasing order. Windows may overlap: a frame keeps what its last window saw.
    """

    def read(numbers: np.ndarray) -> list[np.ndarray]:
        return [read_proxy(dataset, subject, camera, int(n)) for n in numbers]

    places, sure = find_points(net, read(rest), smallest)
    neutral = np.median(places[sure >= min(SEEN_SCORE, sure.max())], axis=0)
    seen: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    for window in windows:
        images = read(window)
        points, scores = find_points(net, images, smallest)
        faces = align_faces(images, points, neutral)
        seen |= dict(zip(window.tolist(), zip(points, scores, faces, strict=True), strict=True))
    rows = [seen[number] for number in sorted(seen)]
    points, scores, faces = (np.stack(part) for part in zip(*rows, strict=True))
    return points, scores, faces
