"""Matte a person before any background from one picture, without plate or weights.

The face gives the head's pose, and with it roughly where skull, hair and shoulders are. GrabCut
(Rother, Kolmogorov and Blake 2004) finds by colours where they end; there alpha is smooth along
the picture's colours. It works where hair and background differ in colour; elsewhere a network
(`salient`) is better.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from scipy.ndimage import binary_fill_holes

from express50.errors import NoFaceError
from express50.geometry.cameras import Camera
from express50.geometry.conventions import corner_to_cell
from express50.landmarks.detector import detect
from express50.landmarks.network import LandmarkNet
from pipelines.calibrate.footage_rig import mean_landmarks, pose_of_face
from pipelines.matte.learned import refined

FACE_SCORE = 0.3  # heads from behind score up to 0.2, profiles from 0.33 on
SEARCH = 0.08  # smallest windows searched for the face, of the longer side
PIXEL_M = 1e-3  # on the head, to which larger pictures are reduced; edges are refined afterwards
ROUNDS = 6
EDGE_M = 0.007  # half width of the band in which alpha is soft
HOLE_M2 = 1.5e-3  # larger gaps show the background
SURE, LIKELY, HAIR = 0.7, 1.3, 1.6  # skulls: no background in the first, no hair past the last
LEAST_DEPTH = 0.05  # metres before the camera


def person_alpha(net: LandmarkNet, camera: Camera, frame: np.ndarray) -> np.ndarray:
    """Return opacity (H, W) float32 of the person whose face is found in a frame (H, W, 3) uint8.

    Args:
        net: finds the face.
        camera: pinhole, of the frame; only its K counts.
        frame: without lens distortion.

    Raises:
        NoFaceError: no face is found.
    """
    face = detect(net, frame, smallest=SEARCH)
    pose, error = pose_of_face(face.points, face.sigma, camera, mean_landmarks())
    if face.score < FACE_SCORE or not np.isfinite(error):
        raise NoFaceError(
            f"no face found (score {face.score:.2f}, expected {FACE_SCORE} or more), and grabcut"
            " starts from one; set matte.method to salient and matte.weights, or give a plate"
        )
    pixels = float(camera.K[0, 0] / pose[2, 3])  # a metre at the head
    scale = min(1.0, 1 / (PIXEL_M * pixels))
    small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    stretch = np.array(small.shape[1::-1]) / frame.shape[1::-1]
    guess = _guess(small.shape[:2], face.points * stretch, pose, np.diag([*stretch, 1]) @ camera.K)
    inside = _whole(_cut(small, guess), guess == cv2.GC_FGD, HOLE_M2 * (pixels * scale) ** 2)
    height, width = frame.shape[:2]
    alpha = cv2.resize(inside.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    alpha = cv2.GaussianBlur(alpha, (0, 0), max(1.0, 0.5 / scale))  # so that its edge is in doubt
    return refined(frame, alpha, max(2.0, EDGE_M * pixels))


@cache
def _parts() -> dict[int, tuple[np.ndarray, ...]]:
    """Make convex parts (N, 3) of a person in head space, metres, by GrabCut's label."""
    from express50.head.load import load_head

    vertices = load_head("procedural").template.double().numpy()
    chin = float(mean_landmarks()[8, 1])
    bottom = float(vertices[:, 1].min())
    skull = vertices[vertices[:, 1] > chin]
    middle = (skull.min(0) + skull.max(0)) / 2
    back = float(np.median(vertices[vertices[:, 1] < bottom + 0.02, 2]))  # the neck's axis
    neck = _slab((0.03, 0.04), (chin, bottom - 0.05), back, 0.03)
    torso = _slab((0.07, 0.2, 0.24), (bottom, bottom - 0.08, bottom - 0.7), back, 0.1)
    hair = _slab((0.16, 0.18), (middle[1], bottom - 0.1), back, 0.12)
    wide = _slab((0.2, 0.4, 0.45), (chin, bottom - 0.05, bottom - 0.9), back, 0.25)
    sure, likely, reach = (middle + k * (skull - middle) for k in (SURE, LIKELY, HAIR))
    for part in (likely, reach):  # no hair grows before a face
        part[:, 2] = np.minimum(part[:, 2], skull[:, 2].max())
    return {
        cv2.GC_PR_BGD: (reach, hair, wide),
        cv2.GC_PR_FGD: (likely, vertices, torso),
        cv2.GC_FGD: (sure, neck),
    }


def _slab(
    half_widths: tuple[float, ...], heights: tuple[float, ...], back: float, thick: float
) -> np.ndarray:
    """Return corners (N, 3) of a body with these half widths at these heights, about a depth."""
    return np.array([
        (side * width, height, back + face * thick)
        for width, height in zip(half_widths, heights, strict=True)
        for side in (-1, 1)
        for face in (-1, 1)
    ])  # fmt: skip


def _guess(shape: tuple[int, int], face: np.ndarray, pose: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Return GrabCut's mask (H, W) uint8 by where a person may be.

    Args:
        shape: height and width.
        face: (68, 2) landmarks, pixels.
        pose: (4, 4) cam_from_head.
        K: (3, 3).
    """
    mask = np.full(shape, cv2.GC_BGD, np.uint8)
    for value, parts in _parts().items():
        for points in parts:
            placed = points @ pose[:3, :3].T + pose[:3, 3]
            placed = placed[placed[:, 2] > LEAST_DEPTH] @ K.T
            _fill(mask, placed[:, :2] / placed[:, 2:], value)
    sure = np.zeros(shape, np.uint8)
    _fill(sure, face, 1)
    mask[cv2.erode(sure, np.ones((5, 5), np.uint8)) > 0] = cv2.GC_FGD
    return mask


def _fill(mask: np.ndarray, pixels: np.ndarray, value: int) -> None:
    """Set the convex hull of corner-origin pixels (N, 2)."""
    if len(pixels) > 2:
        far = 4 * max(mask.shape)  # OpenCV's polygons are of 16-bit integers
        cells = corner_to_cell(np.clip(pixels, -far, far))
        hull = cv2.convexHull(cells.astype(np.float32))
        cv2.fillConvexPoly(mask, hull.round().astype(np.int32), value)


def _cut(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Run GrabCut; returns the pixels (H, W) bool of the person."""
    if not ((mask == cv2.GC_BGD) | (mask == cv2.GC_PR_BGD)).any():
        return np.ones(mask.shape, bool)  # the face fills the picture
    cv2.setRNGSeed(0)  # its clusters start at random
    found, _, _ = cv2.grabCut(
        np.ascontiguousarray(image[..., ::-1]), mask.copy(), None, np.zeros((1, 65)),
        np.zeros((1, 65)), ROUNDS, cv2.GC_INIT_WITH_MASK,
    )  # fmt: skip
    return (found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD)


def _whole(inside: np.ndarray, face: np.ndarray, hole: float) -> np.ndarray:
    """Return parts (H, W) bool that touch the face (H, W), holes up to an area in pixels filled."""
    _, labels = cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)
    person = np.isin(labels, np.unique(labels[face & inside]))
    holes = binary_fill_holes(person) & ~person
    _, labels, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8), connectivity=4)
    return person | (holes & (stats[:, cv2.CC_STAT_AREA] < hole)[labels])
