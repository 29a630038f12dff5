"""First guess of a rig without a board: the face, seen by several cameras at once, is the target.

A mean head's 68 landmarks tell each camera its pose towards the head, wide apart though the cameras
may be, where image features no longer look alike. The mean head is only where the solution starts:
the points are free afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import invert_transform, make_transform
from pipelines.calibrate.graph import join, mean_transform
from pipelines.calibrate.tracks import Seen

NOMINAL = 2.5
"""Focal length, in the image's longer side, at which distances are first told."""
FAR_OFF_DEG = 25.0
"""Relative poses of two cameras further than this from their mean do not count."""
INNER = slice(17, 68)
"""Landmarks without the jaw's outline, which is not the same skin from every side."""


def mean_landmarks() -> np.ndarray:
    """Landmarks (68, 3) of the built-in mean head, metres, head space."""
    # Imported here: only rigs that come without any calibration need a head.
    from express50.head.load import load_head
    from express50.head.model import landmarks

    head = load_head("procedural")
    return landmarks(head, head.template[None])[0].double().numpy()


def start_camera(name: str, size: tuple[int, int], focal: float) -> Camera:
    """A camera at the origin of which nothing but the focal length (pixels) is known."""
    params = (focal, size[0] / 2, size[1] / 2, 0.0)
    return Camera(name, size[0], size[1], "SIMPLE_RADIAL", params, np.eye(4))


def focal_at(
    distance_m: float,
    seen: Mapping[int, Seen],
    sizes: Mapping[str, tuple[int, int]],
    head: np.ndarray,
) -> float:
    """Focal length, in longer sides, with which faces stand about so far away (median).

    A face's size in the picture is focal length over distance; its perspective tells the two apart
    only to a factor of two.
    """
    distances = []
    for moment in seen.values():
        for name, points, sigma in moment.landmarks:
            camera = start_camera(name, sizes[name], NOMINAL * max(sizes[name]))
            pose, error = pose_of_face(points, sigma, camera, head)
            if np.isfinite(error):
                distances.append(pose[2, 3])
    return NOMINAL * distance_m / float(np.median(distances)) if distances else NOMINAL


def pose_of_face(
    points: np.ndarray, sigma: np.ndarray, camera: Camera, head: np.ndarray
) -> tuple[np.ndarray, float]:
    """Pose cam_from_head (4, 4) of landmarks (68, 2), and the rms in expected errors (68,).

    The error is infinite where no pose puts the head in front of the camera.
    """
    ideal = (points - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    shape, xy, eye = head[INNER], ideal[INNER], np.eye(3)
    try:
        _, turn, shift = cv2.solvePnP(shape, xy, eye, None, flags=cv2.SOLVEPNP_SQPNP)
        turn, shift = cv2.solvePnPRefineLM(shape, xy, eye, None, turn, shift)
    except cv2.error:  # landmarks on one spot
        return np.eye(4), float("inf")
    pose = make_transform(cv2.Rodrigues(turn)[0], shift.ravel())
    placed = shape @ pose[:3, :3].T + pose[:3, 3]
    if not (np.isfinite(pose).all() and placed[:, 2].min() > 0):
        return np.eye(4), float("inf")
    off = np.linalg.norm(placed[:, :2] / placed[:, 2:] - xy, axis=1) * camera.K[0, 0]
    return pose, float(np.sqrt(np.mean((off / sigma[INNER]) ** 2)))


def face_rig(
    cameras: Mapping[str, Camera], seen: Mapping[int, Seen], head: np.ndarray
) -> dict[str, Camera]:
    """The largest group of cameras that see faces at common moments, posed in one of them."""
    poses: dict[str, dict[int, tuple[np.ndarray, float]]] = {}
    for frame, moment in seen.items():
        for name, points, sigma in moment.landmarks:
            pose, error = pose_of_face(points, sigma, cameras[name], head)
            if np.isfinite(error):
                poses.setdefault(name, {})[frame] = (pose, 1 / (1 + error**2))
    edges = {}
    for a in sorted(poses):
        for b in sorted(poses):
            shared = sorted(set(poses[a]) & set(poses[b])) if a < b else []
            if shared:
                told = [poses[b][f][0] @ invert_transform(poses[a][f][0]) for f in shared]
                weights = np.array([poses[a][f][1] * poses[b][f][1] for f in shared])
                edges[a, b] = _agreed(told, weights)
    placed = join(sorted(poses), edges) if edges else {}
    return {name: replace(cameras[name], cam_from_world=T) for name, T in placed.items()}


def _agreed(told: list[np.ndarray], weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean relative pose over moments, those far off left out, and its weight."""
    mean = mean_transform(told, weights)
    cosines = np.array([(np.trace(T[:3, :3] @ mean[:3, :3].T) - 1) / 2 for T in told])
    near = np.degrees(np.arccos(np.clip(cosines, -1, 1))) < FAR_OFF_DEG
    if near.any():
        mean = mean_transform([T for T, ok in zip(told, near, strict=True) if ok], weights[near])
    return mean, float(max(weights[near].sum(), 1e-9))
