"""The observe stage: landmarks and aligned faces of every frame in a cue window.

This is the heavy half of ``express50 align``, which runs it first. Suggesting and matching read
only what is written here, so that a new label or another reference costs no second look at the
footage.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from annotations.config import ObserveConfig
from annotations.watch import align_faces, find_points
from express50.capture.frames import read_proxy
from express50.capture.index import Cue, Index, read_index
from express50.contract.layout import Dataset
from express50.errors import FormatError, StageError
from express50.files.arrays import read_arrays
from express50.files.images import contact_sheet, write_image
from express50.landmarks.detector import detect
from express50.landmarks.network import WEIGHTS, LandmarkNet, load_network

SCHEMA = "express50.observations/1"
NEUTRAL = "neutral"
TRIES = 8  # frames all over the clips in which a face is looked for, should rest show none
SEEN_SCORE = 0.15  # of a frame that shows the face at all
RANKED_SHARE = 0.8  # of the best camera's score: one that sees less adds more noise than news


@dataclass(frozen=True)
class FaceObservations:
    """What C cameras saw of a subject in F frames.

    Attributes:
        cameras: ids, the one that sees the face best first.
        frames: (F,) frame numbers, increasing.
        points: (C, F, 68, 2) landmarks in proxy pixels.
        scores: (C, F) how surely a face was seen, 0 to 1.
        faces: (C, F, FACE, FACE) uint8 grey, head motion removed.
    """

    cameras: tuple[str, ...]
    frames: np.ndarray
    points: np.ndarray
    scores: np.ndarray
    faces: np.ndarray


def observations_path(dataset: Dataset, subject: str) -> Path:
    """File of a subject's observations."""
    return dataset.item_dir("observe", subject) / "observations.npz"


def read_observations(dataset: Dataset, subject: str) -> FaceObservations:
    """Read what the stage wrote.

    Raises:
        StageError: the subject was not observed.
        FormatError: the file is damaged or of another version.
    """
    path = observations_path(dataset, subject)
    if not path.is_file():
        raise StageError(f"{path}: {subject!r} is not observed; run 'express50 align' on it")
    try:
        table = read_arrays(path, FormatError, "observations", mend="run 'express50 align'")
        if str(table["schema"]) != SCHEMA:
            raise ValueError(f"schema is {table['schema']}, expected {SCHEMA}")
        rest = (table[key] for key in ("frames", "points", "scores", "faces"))
        return FaceObservations(tuple(map(str, table["cameras"])), *rest)
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path}: no observations ({error}); run 'express50 align'") from None


def item_inputs(dataset: Dataset, item: str, config: ObserveConfig) -> dict[str, Path | str]:
    """The subject's index and proxies, and the landmark network's weights."""
    return {"ingest": dataset.item_dir("ingest", item), "weights": WEIGHTS}


def run_item(dataset: Dataset, item: str, config: ObserveConfig, out: Path) -> dict:
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
    middle, cameras = choose_cameras(dataset, index, net, _tries(rest, frames), config)
    rest = np.union1d(rest, [middle])
    find = partial(find_points, net, smallest=config.search)
    views = [_watch(dataset, item, find, camera, windows, rest, frames) for camera in cameras]
    points, scores, faces = (np.stack(part) for part in zip(*views, strict=True))
    np.savez_compressed(
        out / "observations.npz", schema=SCHEMA, cameras=np.array(cameras), frames=frames,
        points=points.astype(np.float32), scores=scores.astype(np.float32), faces=faces,
    )  # fmt: skip
    (out / "qc").mkdir()
    row = [read_proxy(dataset, item, camera, middle) for camera in cameras]
    write_image(out / "qc" / "cameras.jpg", contact_sheet([row], [", ".join(cameras)]), quality=85)
    return {
        "frames": len(frames),
        "watching_cameras": list(cameras),
        "score_median": round(float(np.median(scores)), 4),
        "dropped": [
            {"what": expression, "why": "its cue lies beyond the footage"}
            for expression, frames in windows.items()
            if not len(frames)
        ],
    }


def cue_frames(index: Index, cue: Cue, stride: int = 1) -> np.ndarray:
    """Frames of a cue window that the footage has, every stride-th."""
    return np.arange(cue.start_frame, min(cue.end_frame, index.frames - 1) + 1, stride)


def _tries(rest: np.ndarray, frames: np.ndarray) -> list[int]:
    """Frames in which to look for the face until it is there: at rest, then all over the clips."""
    spread = [*np.linspace(0, len(rest) - 1, 3)[[1, 0, 2]].astype(int)]
    others = np.linspace(0, len(frames) - 1, TRIES).astype(int)
    return list(dict.fromkeys([*(int(rest[i]) for i in spread), *(int(frames[i]) for i in others)]))


def choose_cameras(
    dataset: Dataset, index: Index, net: LandmarkNet, frames: list[int], config: ObserveConfig
) -> tuple[int, list[str]]:
    """The first of the frames that shows a face, and the cameras that see it best, best first.

    Raises:
        StageError: no camera sees a face in any.
    """
    best = 0.0
    for frame in frames:
        scores = {
            camera: detect(
                net, read_proxy(dataset, index.subject, camera, frame), smallest=config.search
            ).score
            for camera in index.cameras
        }
        ranked = sorted(scores, key=lambda c: (-scores[c], c))
        best = max(best, scores[ranked[0]])
        if scores[ranked[0]] >= config.min_score:
            enough = max(config.min_score, RANKED_SHARE * scores[ranked[0]])
            return frame, [c for c in ranked[: config.cameras] if scores[c] >= enough]
    raise StageError(
        f"{index.subject}: no camera sees a face in frames {', '.join(map(str, sorted(frames)))}"
        f" (best score {best:.2f}, expected {config.min_score}); is the face in view? else label"
        " by 'express50 annotate mark', or lower observe.min_score"
    )


def _watch(
    dataset: Dataset,
    subject: str,
    find: Callable[[Sequence[np.ndarray]], tuple[np.ndarray, np.ndarray]],
    camera: str,
    windows: dict[str, np.ndarray],
    rest: np.ndarray,
    frames: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (F, 68, 2), scores (F,) and aligned faces (F, FACE, FACE) of one camera."""

    def read(numbers: np.ndarray) -> list[np.ndarray]:
        return [read_proxy(dataset, subject, camera, int(n)) for n in numbers]

    places, sure = find(read(rest))
    neutral = np.median(places[sure >= min(SEEN_SCORE, sure.max())], axis=0)
    parts = []
    for window in windows.values():
        if not len(window):
            continue
        images = read(window)
        points, scores = find(images)
        parts.append((points, scores, align_faces(images, points, neutral)))
    # Windows may overlap: a frame keeps what its last window saw.
    order = np.concatenate([window for window in windows.values() if len(window)])
    rows = np.searchsorted(frames, order)
    out = []
    for part in zip(*parts, strict=True):
        whole = np.concatenate(part)
        placed = np.zeros((len(frames), *whole.shape[1:]), whole.dtype)
        placed[rows] = whole
        out.append(placed)
    return out[0], out[1], out[2]
