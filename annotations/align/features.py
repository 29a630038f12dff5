"""Describe an expression by numbers that can be compared over time: motion and local contrast.

Every feature is in units of its own noise, which is measured from the footage itself. What a face
does at rest (fidgets, sway, the detector's drift) is shrunk, so that the curve of an expression
rises only with the expression.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from annotations.observe.stage import (
    SEEN_SCORE,
    STABLE,
    FaceObservations,
    face_side,
    similarity_2d,
    steady,
)
from express50.capture.expressions import NEUTRAL, Expression
from express50.capture.index import Index
from express50.geometry.shapes import check_finite

LIDS = np.array([37, 38, 40, 41, 43, 44, 46, 47])
_GROUPS = {
    "brow": np.arange(17, 27),
    "eye": LIDS,
    "nose": np.arange(31, 36),
    "mouth": np.concatenate([np.arange(48, 68), np.arange(5, 12)]),
}
_CONTROL_GROUPS = {
    "brow": ("brow",),
    "eye": ("eye",),
    "nose": ("nose", "brow"),
    "nostril": ("nose",),
    "cheek": ("mouth",),
}
CELLS = 24  # cells per side in which the aligned face is compared
CELL_REACH = 0.12  # of the face's side: a cell further from every landmark shows no face
CELL_WEIGHT = 0.5  # of a cell, against a landmark's coordinate: there are more cells
OTHER_WEIGHT = 0.3  # of features that the script does not name: people move more than they should
LEAST_NOISE = 1e-4  # share of a face's side, or local deviations: the effect of rounding alone
REST_DIRECTIONS = 20  # number of leading directions of unrest that are shrunk


@dataclass(frozen=True)
class Features:
    """Features of a subject from C cameras in F observed frames, in units of their own noise."""

    cameras: tuple[str, ...]  # ids of the cameras, the one that sees the face best first
    frames: np.ndarray  # (F,) numbers of the frames
    windows: dict[str, np.ndarray]  # expression id -> rows of ``frames`` of its cue, by time
    values: np.ndarray  # (F, N) zero at the subject's neutral; the same N / C of each camera
    owner: np.ndarray  # (N,) landmark 0 to 67 that a feature belongs to or lies nearest to
    camera: np.ndarray  # (N,) which camera a feature is of, 0 to C - 1
    # (R,) rows of ``values`` in which the face should be at rest: the neutral clip and both ends of
    # every window. A few frames that are not at rest do no harm.
    rest: np.ndarray


def measure_features(index: Index, observations: FaceObservations) -> Features:
    """Measure the features of a subject by cue window.

    Expressions whose window holds no observed frame that shows a face are left out.
    """
    windows = {}
    shown = observations.scores.max(axis=0) >= SEEN_SCORE
    for cue in index.cues:
        seen = (observations.frames >= cue.start_frame) & (observations.frames <= cue.end_frame)
        if (seen & shown).any():
            windows[cue.expression_id] = np.flatnonzero(seen & shown)
    return measure(observations, windows)


def measure(observations: FaceObservations, windows: dict[str, np.ndarray]) -> Features:
    """Measure the features of all frames in which one subject was observed.

    `windows` are rows of the observations by expression, see `Features`; none is empty. Without the
    neutral expression, the windows' first frames are taken for rest.

    Raises:
        ValueError: no window is given, a window is empty, or a landmark is not finite.
    """
    if not windows or not all(map(len, windows.values())):
        raise ValueError(f"windows are {sorted(windows)}, expected one or more, none of them empty")
    check_finite("landmarks", observations.points[:, np.concatenate([*windows.values()])])
    ends = np.concatenate([rows[[0, -1]] for rows in windows.values()])
    rest = windows.get(NEUTRAL, ends[::2])
    values, owner, camera = [], [], []
    for number in range(len(observations.cameras)):
        points = observations.points[number].astype(np.float64)
        middle = np.median(points[rest], axis=0)
        moved = displacements(points, middle, windows).reshape(len(points), -1)
        cells, nearest = local_contrast(observations.faces[number], middle)
        cells -= np.median(cells[rest], axis=0)
        values += [in_noise(moved, windows), CELL_WEIGHT * in_noise(cells, windows)]
        owner += [np.repeat(np.arange(68), 2), nearest]
        camera.append(np.full(moved.shape[1] + cells.shape[1], number))
    return Features(
        cameras=observations.cameras,
        frames=observations.frames,
        windows=windows,
        values=np.concatenate(values, axis=1),
        owner=np.concatenate(owner),
        camera=np.concatenate(camera),
        rest=np.unique(np.concatenate([rest, ends])),
    )


def shared_columns(features: Features, other: Features) -> np.ndarray:
    """Pair the columns (2, K) that measure the same on two subjects.

    Cameras with the same id are paired; if there are none, those that see each face best.
    """
    common = [camera for camera in features.cameras if camera in other.cameras]
    pairs = [(features.cameras.index(c), other.cameras.index(c)) for c in common] or [(0, 0)]
    columns = [
        np.stack([np.flatnonzero(features.camera == a), np.flatnonzero(other.camera == b)])
        for a, b in pairs
    ]
    return np.concatenate(columns, axis=1)


def displacements(
    points: np.ndarray, neutral: np.ndarray, windows: dict[str, np.ndarray]
) -> np.ndarray:
    """Measure landmark motion (F, 68, 2) from neutral (68, 2), in face sides, minus the head's."""
    moved = np.zeros(points.shape)
    for rows in windows.values():
        fits = [similarity_2d(frame[STABLE], neutral[STABLE]) for frame in points[rows]]
        motions = steady(np.stack(fits))
        moved[rows] = points[rows] @ motions[:, :, :2].transpose(0, 2, 1) + motions[:, None, :, 2]
        moved[rows] -= neutral
    return moved / face_side(neutral)


def local_contrast(faces: np.ndarray, neutral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure local contrast (F, N) of aligned faces (F, S, S) uint8; name each cell's landmark.

    Contrast with the surroundings is independent of light and exposure, unlike brightness. Cells
    that show no face are 0.
    """
    cells = np.empty((len(faces), CELLS * CELLS), np.float32)
    wide = faces.shape[1] / 8
    for cell, face in zip(cells, faces, strict=True):
        grey = face.astype(np.float32) / 255.0
        flat = grey - cv2.GaussianBlur(grey, (0, 0), wide)
        spread = np.sqrt(cv2.GaussianBlur(flat**2, (0, 0), wide)) + 0.02  # a local deviation
        fine = cv2.GaussianBlur(flat / spread, (0, 0), 0.8)
        cell[:] = cv2.resize(fine, (CELLS, CELLS), interpolation=cv2.INTER_AREA).reshape(-1)
    centre = (neutral.min(0) + neutral.max(0)) / 2
    layout = (neutral - centre) / face_side(neutral) + 0.5
    places = (np.arange(CELLS) + 0.5) / CELLS
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 1, 2)
    away = np.linalg.norm(grid - layout, axis=-1)
    cells[:, away.min(1) > CELL_REACH] = 0.0
    return cells, away.argmin(1)


def in_noise(values: np.ndarray, windows: dict[str, np.ndarray]) -> np.ndarray:
    """Divide features (F, N) by their noise, which second differences in time show.

    Motion is smooth from frame to frame, so a second difference is mostly noise, with six times the
    variance of a frame's noise. Adding the median feature's noise keeps scales above zero.
    """
    bends = [np.diff(values[rows], n=2, axis=0) for rows in windows.values() if len(rows) > 2]
    if not bends:
        return values / max(float(np.abs(values).mean()), LEAST_NOISE)
    noise = np.median(np.abs(np.concatenate(bends)), axis=0) / (0.6745 * np.sqrt(6.0))
    floor = float(np.median(noise[noise > 0])) if (noise > 0).any() else 1.0
    return values / np.maximum(noise + floor, LEAST_NOISE)


def expression_values(
    features: Features, expression: Expression | None, rows: np.ndarray
) -> np.ndarray:
    """Weight the features (T, N) of T rows by their part in an expression, and shrink unrest."""
    weights = np.maximum(landmark_weights(expression)[features.owner], OTHER_WEIGHT)
    still = features.values[features.rest] * weights
    middle = np.median(still, axis=0)
    still -= middle
    power, modes = np.linalg.eigh(still @ still.T / len(still))
    top = np.argsort(power)[::-1][:REST_DIRECTIONS]
    top = top[power[top] > 1e-9 * max(float(power.max()), 1e-30)]
    directions = modes[:, top].T @ still / np.sqrt(power[top] * len(still))[:, None]
    shrink = 1.0 / np.sqrt(1.0 + power[top]) - 1.0
    moved = features.values[rows] * weights - middle
    return moved + ((moved @ directions.T) * shrink) @ directions


def landmark_weights(expression: Expression | None) -> np.ndarray:
    """Weight the points (68,) that take part in an expression; all when it is unknown."""
    everywhere = np.zeros(68)
    everywhere[17:] = 1.0
    everywhere[LIDS] = 0.5
    if expression is None:
        return everywhere
    weights = np.zeros(68)
    for name in (name for name, value in expression.controls.items() if abs(value) > 0.05):
        prefix = next((p for p in _CONTROL_GROUPS if name.startswith(p)), "")
        for group in _CONTROL_GROUPS.get(prefix, ("mouth",)):
            weights[_GROUPS[group]] = 1.0
    if np.abs(expression.jaw).max() > 0.02:
        weights[_GROUPS["mouth"]] = 1.0
    return weights if weights.any() else everywhere
