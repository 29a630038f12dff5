"""Find the 68 landmarks of the one head in a frame, without knowing where it is.

A coarse pass looks at the whole frame (then at turned and smaller windows, only where that finds no
face); crops about the points found so far are then refined, levelled by the line of the eyes.
Points are the projections of the 3D landmarks, also where the head hides them: views of several
cameras can be triangulated. Hidden points come with a low confidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from express50.adapters import affine_to_opencv
from express50.landmarks.augment import MIRROR, face_box
from express50.landmarks.network import CROP, LandmarkNet

# A point whose error scale is this share of the face box has half the confidence.
HALF_CONFIDENCE_SHARE = 0.025
# Points of a place that is no face are vague: at this share the score is halved.
VAGUE_SHARE = 0.06
FOUND_SCORE = 0.5
KEEP_SHARE = 0.8


@dataclass(frozen=True)
class Detection:
    """Landmarks of one image.

    Attributes:
        points: (68, 2) pixels, corner origin, iBUG-68 order.
        sigma: (68,) expected error in pixels (the scale of a Laplace distribution).
        confidence: (68,) in 0..1, the score included.
        score: in 0..1, how surely a face looks towards the camera: the network's probability,
            lowered where the points are vague. Low for backs of heads and where there is no head.
    """

    points: np.ndarray
    sigma: np.ndarray
    confidence: np.ndarray
    score: float


def detect(net: LandmarkNet, image: np.ndarray, refinements: int = 3) -> Detection:
    """Detect the landmarks of the most face-like place in an image.

    Args:
        net: From `load_network`.
        image: (H, W, 3) uint8 RGB; any size.
        refinements: Crops in sequence after the coarse pass; the last is taken twice, mirrored.

    Raises:
        ValueError: another shape or type.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
        raise ValueError(f"image is {image.dtype} {image.shape}, expected uint8 (H, W, 3)")
    pyramid = _pyramid(image)
    points, sigma, score = _coarse(net, pyramid)
    for step in range(refinements):
        window = window_about(points)
        last = step == refinements - 1
        views = [window, _mirrored(window)] if last else [window]
        refined = _mean_view(*_run(net, pyramid, views))
        if refined[2] < KEEP_SHARE * score:
            # The crop went astray, as it may on a profile: the wider view knew better.
            break
        points, sigma, score = refined
    relative = sigma / (HALF_CONFIDENCE_SHARE * max(face_box(points)[1], 1e-6))
    return Detection(points, sigma, score / (1.0 + relative**2), score)


def _coarse(net: LandmarkNet, pyramid: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Best of the whole frame; failing that, of quarter turns and of nine smaller windows."""
    height, width = pyramid[0].shape[:2]
    centre, side = np.array([width, height]) / 2, float(max(width, height))
    groups = [[_window(centre, side, 0.0)]]
    groups.append([_window(centre, side, turn * np.pi / 2) for turn in (1, 2, 3)])
    offsets = np.array([-0.2, 0.0, 0.2]) * side
    groups[1] += [_window(centre + [x, y], 0.6 * side, 0.0) for y in offsets for x in offsets]
    best: tuple[np.ndarray, np.ndarray, float] | None = None
    for group in groups:
        points, sigma, score = _run(net, pyramid, group)
        top = int(np.argmax(score))
        if best is None or score[top] > best[2]:
            best = points[top], sigma[top], float(score[top])
        if best[2] >= FOUND_SCORE:
            break
    return best  # type: ignore[return-value]


def _window(centre: np.ndarray, side: float, angle: float) -> np.ndarray:
    """Affine (2, 3) from crop pixels to image pixels, corner origin."""
    scale = side / CROP
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.concatenate([turn, (centre - turn @ [CROP / 2, CROP / 2])[:, None]], axis=1)


def window_about(points: np.ndarray) -> np.ndarray:
    """The window the network was trained on, about landmarks (68, 2), the eyes level.

    Affine (2, 3) from crop pixels to image pixels, corner origin.
    """
    eyes = points[42:48].mean(0) - points[36:42].mean(0)
    down = points[8] - points[27]
    # The face's own down direction also holds in profile, where the eyes coincide.
    axis = eyes + np.array([down[1], -down[0]])
    angle = float(np.arctan2(axis[1], axis[0]))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centre, side = face_box(points @ turn.T)
    return _window(centre @ turn, max(side, 8.0), angle)


def _mirrored(window: np.ndarray) -> np.ndarray:
    """The same window seen in a mirror: crop x runs the other way."""
    flip = np.array([[-1.0, 0.0, CROP], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return window @ flip


def _pyramid(image: np.ndarray) -> list[np.ndarray]:
    """The image and its halvings down to about the crop's size."""
    levels = [image]
    while max(levels[-1].shape[:2]) > 2 * CROP and min(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        size = (max(1, width // 2), max(1, height // 2))
        levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))
    return levels


def _sample(pyramid: list[np.ndarray], window: np.ndarray) -> np.ndarray:
    """Crop (128, 128, 3) uint8 of the level whose resolution fits the window."""
    step = np.sqrt(abs(np.linalg.det(window[:, :2])))
    level = int(np.clip(np.floor(np.log2(max(step, 1e-6)) + 0.5), 0, len(pyramid) - 1))
    height, width = pyramid[0].shape[:2]
    shape = pyramid[level].shape
    scale = np.array([[shape[1] / width], [shape[0] / height]])
    return cv2.warpAffine(
        pyramid[level],
        affine_to_opencv(window * scale),
        (CROP, CROP),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _run(
    net: LandmarkNet, pyramid: list[np.ndarray], windows: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 68, 2) and sigma (N, 68) in image pixels, scores (N,) of windows."""
    crops = torch.from_numpy(np.stack([_sample(pyramid, window) for window in windows]))
    crops = crops.permute(0, 3, 1, 2).contiguous(memory_format=torch.channels_last)
    with torch.inference_mode():
        output = net(crops.float() / 255.0)
    found, sigma = output.points.double().numpy(), output.log_scale.double().exp().numpy()
    points = np.empty_like(found)
    for index, window in enumerate(windows):
        points[index] = found[index] @ window[:, :2].T + window[:, 2]
        determinant = np.linalg.det(window[:, :2])
        sigma[index] *= np.sqrt(abs(determinant))
        if determinant < 0:
            points[index], sigma[index] = points[index][MIRROR], sigma[index][MIRROR]
    sides = np.array([max(face_box(place)[1], 1e-6) for place in points])
    vague = np.median(sigma, axis=1) / (VAGUE_SHARE * sides)
    return points, sigma, torch.sigmoid(output.logit).double().numpy() / (1.0 + vague**2)


def _mean_view(
    points: np.ndarray, sigma: np.ndarray, score: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean of several views of the same place; their spread adds to the expected error."""
    mean = points.mean(0)
    spread = np.linalg.norm(points - mean, axis=2).mean(0)
    return mean, np.hypot(sigma.mean(0), spread), float(score.mean())
