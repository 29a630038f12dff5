"""Choose the cameras that see the face best, and write its landmarks and pictures in every frame.

The network uses one window per clip, and head motion is averaged over time. Both keep the jitter of
single detections out of the curves in which expressions are searched for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from express50.capture.expressions import NEUTRAL
from express50.capture.frames import read_proxy
from express50.capture.index import Cue, Index, nearest_decoded, read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.errors import FormatError, StageError, advised, rounded_down
from express50.files.arrays import read_arrays
from express50.files.images import write_image
from express50.files.text import refusing
from express50.geometry.pixels import contact_sheet
from express50.geometry.transforms import scale_of, similarity_fit, transform_points

if TYPE_CHECKING:
    from express50.landmarks.network import LandmarkNet

SCHEMA = "express50.observations/1"
SEEN_SCORE = 0.15  # least score of a frame that shows the face
OTHER_FRAMES = 8  # number of other frames to search for a face if the frames at rest show none
SMALL_FACE_FRAMES = 3  # number of frames to search for a small face, those at rest first
CACHED_FRAMES = 256  # frames of a camera kept in memory; those of longer windows are decoded twice
RANKED_SHARE = 0.8  # share of the best camera's score: worse cameras add mostly noise


@dataclass(frozen=True)
class FaceObservations:
    """The faces that C cameras saw of a subject in F frames."""

    cameras: tuple[str, ...]  # ids, the one that sees the face best first
    frames: np.ndarray  # (F,) frame numbers, increasing
    points: np.ndarray  # (C, F, 68, 2) landmarks in proxy pixels
    scores: np.ndarray  # (C, F) face scores, 0 to 1
    faces: np.ndarray  # (C, F, S, S) uint8 grey, head motion removed


def read_observations(dataset: Dataset, subject: str) -> FaceObservations:
    """Read a subject's observations.

    Raises:
        StageError: the subject was not observed.
        FormatError: the file is damaged or of another version.
    """
    path = dataset.observations_file(subject)
    fix = f"run {advised('express50 align', dataset.root)}"
    if not path.is_file():
        raise StageError(f"{path}: {subject!r} is not observed; {fix}")
    with refusing(FormatError, f"{path}: not observations", fix):
        table = read_arrays(path, FormatError, "observations", fix=fix)
        if str(table["schema"]) != SCHEMA:
            raise ValueError(f"schema is {table['schema']}, expected {SCHEMA}")
        rest = (table[key] for key in ("frames", "points", "scores", "faces"))
        return FaceObservations(tuple(map(str, table["cameras"])), *rest)


def run(
    dataset: Dataset,
    item: str,
    out: Path,
    *,
    cameras: int,
    stride: int,
    min_score: float,
    search: float,
) -> Result:
    """Write ``observations.npz`` and a picture of the watching cameras at rest."""
    from express50.landmarks.detector import SMALL, detect
    from express50.landmarks.network import load_network

    index = read_index(dataset, item)
    cues = {c.expression_id: cue_frames(index, c, stride) for c in index.cues}
    windows = {expression: frames for expression, frames in cues.items() if len(frames)}
    if not windows:
        raise StageError(
            f"{item}: cues.csv names no expression in the footage; add rows"
            " expression_id,start_frame,end_frame, then run"
            f" {advised('express50 ingest', dataset.root)} again"
        )
    net = load_network()
    rest = windows.get(NEUTRAL, np.array([frames[0] for frames in windows.values()]))
    seen = list(windows.values())
    frames = np.unique(np.concatenate(seen))

    def score(camera: str, frame: int, smallest: float) -> float:
        # A frame nearby shows as well whether the camera sees the face, and has been decoded.
        image = read_proxy(dataset, item, camera, nearest_decoded(index.cameras[camera], frame))
        return detect(net, image, smallest=smallest).score

    frames_tried = frames_to_try(rest, frames)
    attempts = [(search, frame) for frame in frames_tried]
    if search > SMALL:  # which takes four times as long, so in fewer frames
        attempts += [(SMALL, frame) for frame in frames_tried[:SMALL_FACE_FRAMES]]
    search, middle, ranked = choose_cameras(index, score, attempts, min_score)
    watching = ranked[:cameras]
    rest = np.union1d(rest, [middle])
    views = [_observe_camera(dataset, item, net, camera, seen, rest, search) for camera in watching]
    points, scores, faces = (np.stack(part) for part in zip(*views, strict=True))
    np.savez_compressed(
        out / "observations.npz", schema=SCHEMA, cameras=np.array(watching), frames=frames,
        points=points.astype(np.float32), scores=scores.astype(np.float32), faces=faces,
    )  # fmt: skip
    (out / "qc").mkdir()
    row = [read_proxy(dataset, item, camera, middle) for camera in watching]
    write_image(out / "qc" / "cameras.jpg", contact_sheet([row], [watching]), quality=85)
    metrics = {
        "frames": len(frames),
        "watching_cameras": watching,
        "score_median": round(float(np.median(scores)), 4),
    }
    beyond = (e for e in cues if e not in windows)
    return Result(metrics, [Note(e, "its cue window is outside the footage") for e in beyond])


def cue_frames(index: Index, cue: Cue, stride: int = 1) -> np.ndarray:
    """List every stride-th frame of a cue window that the footage has."""
    return np.arange(cue.start_frame, min(cue.end_frame, index.frames - 1) + 1, stride)


def frames_to_try(rest: np.ndarray, frames: np.ndarray) -> list[int]:
    """List the frames in which to search for the face: at rest, then all over the clips."""
    spread = np.linspace(0, len(rest) - 1, 3)[[1, 0, 2]].astype(int)
    others = np.linspace(0, len(frames) - 1, OTHER_FRAMES).astype(int)
    return list(dict.fromkeys([*rest[spread].tolist(), *frames[others].tolist()]))


def choose_cameras(
    index: Index,
    score: Callable[[str, int, float], float],
    attempts: Sequence[tuple[float, int]],
    min_score: float,
) -> tuple[float, int, list[str]]:
    """Find the first attempt that shows a face, and rank the cameras that see it best.

    An attempt is the size of the smallest windows to search, and a frame; `score` rates the face
    that a camera shows. Returns the size that was enough, the frame and the cameras.

    Raises:
        StageError: no camera sees a face in any attempt.
    """
    best = 0.0
    for smallest, frame in attempts:
        scores = {camera: score(camera, frame, smallest) for camera in index.cameras}
        ranked = sorted(scores, key=lambda c: (-scores[c], c))
        best = max(best, scores[ranked[0]])
        if scores[ranked[0]] >= min_score:
            enough = max(min_score, RANKED_SHARE * scores[ranked[0]])
            return smallest, frame, [c for c in ranked if scores[c] >= enough]
    frames = sorted({frame for _, frame in attempts})
    raise StageError(
        f"{index.subject}: no camera sees a face in frames {', '.join(map(str, frames))}"
        f" (best score {rounded_down(best)}, expected {min_score}); check that the"
        " face is in view, label it with 'express50 annotate mark', or lower observe.min_score"
    )


def _observe_camera(
    dataset: Dataset,
    subject: str,
    net: LandmarkNet,
    camera: str,
    windows: list[np.ndarray],
    rest: np.ndarray,
    smallest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Watch windows of frames with one camera.

    Points (F, 68, 2), scores (F,) and aligned faces (F, FACE, FACE) are those of all frames of the
    windows, in order. In overlapping windows, the last one counts.
    """

    @lru_cache(maxsize=CACHED_FRAMES)
    def read(number: int) -> np.ndarray:
        return read_proxy(dataset, subject, camera, number)

    places, sure = find_points(net, read, rest.tolist(), smallest)
    neutral = np.median(places[sure >= min(SEEN_SCORE, sure.max())], axis=0)
    seen: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    for window in windows:
        numbers = window.tolist()
        points, scores = find_points(net, read, numbers, smallest)
        faces = align_faces(map(read, numbers), points, neutral)
        seen |= dict(zip(numbers, zip(points, scores, faces, strict=True), strict=True))
    rows = [seen[number] for number in sorted(seen)]
    points, scores, faces = (np.stack(part) for part in zip(*rows, strict=True))
    return points, scores, faces


FACE = 48  # side of the aligned face, pixels
# iBUG-68 points that expressions move least: the nose's bridge and the corners of the eyes.
STABLE = np.array([27, 28, 29, 30, 36, 39, 42, 45])
BATCH = 32
LEAST_SIDE = 1e-9  # pixels: a face whose points all coincide still has a finite answer
STRAY_SHARE = 0.1  # of the window: a face further from its centre gets a window of its own
STRAY_SCORE = 0.7  # of the middle frame's score
STEADY_FRAMES = 1.0  # heads turn slowly: their motion is averaged over this many frames (sigma)


def find_points(
    net: LandmarkNet, read: Callable[[int], np.ndarray], frames: Sequence[int], smallest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Find landmarks (T, 68, 2), corner-origin pixels, and scores (T,) in T frames.

    `read` returns the image (H, W, 3) uint8 of a frame: not all of a long clip fit in memory.
    The face is searched for in the middle frame only, in windows from ``smallest`` on (`detect`).
    All frames and their mirror images are then looked at through the same window, except those
    where the face has left it.
    """
    import torch

    from express50.landmarks.detector import detect, window_about
    from express50.landmarks.network import CROP, MIRROR, as_input, face_box

    middle = detect(net, read(frames[len(frames) // 2]), smallest=smallest)
    centre, side = face_box(middle.points)
    window = window_about(middle.points)
    points, scores = np.zeros((len(frames), 68, 2)), np.zeros(len(frames))
    for start in range(0, len(frames), BATCH):
        part = frames[start : start + BATCH]
        crops = np.stack([_cut(read(frame), window, CROP) for frame in part])
        both = np.concatenate([crops, crops[:, :, ::-1]])
        with torch.inference_mode():
            output = net(as_input(both))
        direct, mirrored = output.points.double().numpy().reshape(2, len(crops), -1, 2)
        mirrored = np.stack([CROP - mirrored[:, MIRROR, 0], mirrored[:, MIRROR, 1]], axis=-1)
        batch = slice(start, start + len(crops))
        points[batch] = transform_points(window, 0.5 * (direct + mirrored))
        scores[batch] = torch.sigmoid(output.logit).double().numpy().reshape(2, -1).mean(0)
    for row, frame in enumerate(frames):
        away = np.linalg.norm(face_box(points[row])[0] - centre)
        if away > STRAY_SHARE * side or scores[row] < STRAY_SCORE * middle.score:
            own = detect(net, read(frame), smallest=smallest)
            points[row], scores[row] = own.points, own.score
    return points, scores


def align_faces(
    images: Iterable[np.ndarray], points: np.ndarray, neutral: np.ndarray
) -> np.ndarray:
    """Cut grey faces (T, FACE, FACE) uint8 of a clip, moved onto neutral landmarks (68, 2)."""
    low, high = neutral.min(0), neutral.max(0)
    side = face_side(neutral)
    layout = (neutral[STABLE] - ((low + high) / 2 - side / 2)) * (FACE / side)
    motions = steady(np.stack([similarity_2d(frame[STABLE], layout) for frame in points]))
    faces = [
        _cut(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.invertAffineTransform(motion), FACE)
        for image, motion in zip(images, motions, strict=True)
    ]
    return np.stack(faces)


def face_side(neutral: np.ndarray) -> float:
    """Return the side, pixels, of the square that an aligned face with landmarks (68, 2) shows."""
    return 1.1 * max(float((neutral.max(0) - neutral.min(0)).max()), LEAST_SIDE)


def similarity_2d(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Fit the similarity (2, 3) that takes points (N, 2) onto others.

    Points that all coincide are moved, not scaled.
    """
    if np.ptp(source, axis=0).max() < LEAST_SIDE:
        return np.concatenate([np.eye(2), (target.mean(0) - source.mean(0))[:, None]], axis=1)
    lift = np.zeros((len(source), 1))
    s, R, t = similarity_fit(np.hstack([source, lift]), np.hstack([target, lift]))
    return np.concatenate([s * R[:2, :2], t[:2, None]], axis=1)


def steady(values: np.ndarray) -> np.ndarray:
    """Average values (T, ...) over neighbouring frames with Gaussian weights."""
    reach = {"sigma": STEADY_FRAMES, "axis": 0, "mode": "constant", "truncate": 8.0}
    weights = gaussian_filter1d(np.ones(len(values)), **reach)  # below 1 near both ends
    total = gaussian_filter1d(np.asarray(values, np.float64), **reach)
    return total / weights.reshape(-1, *[1] * (values.ndim - 1))


def _cut(image: np.ndarray, window: np.ndarray, size: int) -> np.ndarray:
    """Cut a square through an affine (2, 3) from its pixels to the image's, corner origin."""
    from express50.landmarks.detector import cut_crop

    step = scale_of(window)
    height, width = image.shape[:2]
    if step > 1.5:  # blurred first, because fine detail would alias
        small = (max(1, round(width / step)), max(1, round(height / step)))
        image = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
    scale = np.array([[image.shape[1] / width], [image.shape[0] / height]])
    return cut_crop(image, window * scale, size)
