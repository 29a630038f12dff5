"""First guess of a rig without a board: the face, seen by several cameras at once, is the target.

A mean head's 68 landmarks give each camera a pose towards the head, however far apart the cameras
stand, where image features no longer look alike. Cameras that see no face are placed by features
of points that the rig knows. The mean head only starts the solution; its points are free later.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import invert_transform, make_transform
from pipelines.calibrate.adjuster import triangulate_tracks
from pipelines.calibrate.intrinsics import as_model
from pipelines.calibrate.rig_graph import join_rig, mean_transform
from pipelines.calibrate.tracks import FrameSetPoints, join_tracks, match_descriptors

NOMINAL = 2.5
"""Focal length, in the image's longer side, at which distances are first estimated."""
INNER = slice(17, 68)
"""Landmarks without the jaw's outline, which is not the same skin from every side."""
LEAST_INLIERS, LEAST_SHARE = 12, 0.4
"""A camera without a face is placed if so many known points, and such a share of those it seems
to see, agree on a pose within 4 pixels. Twelve alone were wrong by up to 16 degrees."""


def mean_landmarks() -> np.ndarray:
    """Return the landmarks (68, 3) of the built-in mean head, metres, head space."""
    # Imported here: only rigs that come without any calibration need a head.
    from express50.head.load import load_head
    from express50.head.model import landmarks

    head = load_head("procedural")
    return landmarks(head, head.template[None])[0].double().numpy()


def start_camera(name: str, size: tuple[int, int], focal: float) -> Camera:
    """Make a camera at the origin from nothing but a focal length, pixels."""
    params = (focal, size[0] / 2, size[1] / 2, 0.0)
    return Camera(name, size[0], size[1], "SIMPLE_RADIAL", params, np.eye(4))


def focal_at(
    distance_m: float,
    seen: Mapping[int, FrameSetPoints],
    sizes: Mapping[str, tuple[int, int]],
    head: np.ndarray,
) -> float:
    """Return the focal length, in longer sides, with which faces stand at a distance (median).

    A face's size in the picture is focal length over distance; its perspective separates the two
    only to a factor of two.
    """
    distances = []
    for points in seen.values():
        for name, pixels, sigma in points.landmarks:
            camera = start_camera(name, sizes[name], NOMINAL * max(sizes[name]))
            pose, error = pose_of_face(pixels, sigma, camera, head)
            if np.isfinite(error):
                distances.append(pose[2, 3])
    return NOMINAL * distance_m / float(np.median(distances)) if distances else NOMINAL


def pose_of_face(
    points: np.ndarray, sigma: np.ndarray, camera: Camera, head: np.ndarray
) -> tuple[np.ndarray, float]:
    """Estimate the pose cam_from_head (4, 4) of landmarks (68, 2), and its rms error in sigmas.

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
    cameras: Mapping[str, Camera], seen: Mapping[int, FrameSetPoints], head: np.ndarray
) -> dict[str, Camera]:
    """Pose the largest group of cameras that see faces in common frame sets."""
    poses: dict[str, dict[int, tuple[np.ndarray, float]]] = {}
    for frame, points in seen.items():
        for name, pixels, sigma in points.landmarks:
            pose, error = pose_of_face(pixels, sigma, cameras[name], head)
            if np.isfinite(error):
                poses.setdefault(name, {})[frame] = (pose, 1 / (1 + error**2))
    edges = {}
    for a in sorted(poses):
        for b in sorted(poses):
            shared = sorted(set(poses[a]) & set(poses[b])) if a < b else []
            if not shared:
                continue
            votes = np.stack([poses[b][f][0] @ invert_transform(poses[a][f][0]) for f in shared])
            weights = np.array([poses[a][f][1] * poses[b][f][1] for f in shared])
            mean = mean_transform(votes, weights)
            traces = np.trace(votes[:, :3, :3] @ mean[:3, :3].T, axis1=1, axis2=2)
            # Frame sets whose pose is further than 25 degrees from the mean are wrong.
            near = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))) < 25.0
            if near.any():
                mean = mean_transform(votes[near], weights[near])
            edges[a, b] = mean, float(max(weights[near].sum(), 1e-9))
    placed = join_rig(sorted(poses), edges) if edges else {}
    return {name: replace(cameras[name], cam_from_world=T) for name, T in placed.items()}


def place_by_features(
    rig: Mapping[str, Camera],
    others: Mapping[str, Camera],
    seen: Mapping[int, FrameSetPoints],
) -> dict[str, Camera]:
    """Place cameras that see no face by features that look like points the rig knows.

    `others` give the sizes and lens models of the cameras to place; their focal length becomes the
    rig's median.
    """
    if not others:
        return {}
    tracks = join_tracks(rig, seen, 0.015)
    points = triangulate_tracks(rig, tracks)
    known: list[tuple[int, np.ndarray, np.ndarray]] = []  # frame, points (M, 3), descriptors
    for index, name in enumerate(tracks.names):
        mine = np.flatnonzero((tracks.camera == index) & tracks.features())
        place = {tracks.pixels[row].tobytes(): points[tracks.point[row]] for row in mine}
        for frame, found in seen.items():
            if name in found.features:
                pixels, described = found.features[name]
                rows = [i for i, p in enumerate(pixels) if p.tobytes() in place]
                at = np.array([place[pixels[i].tobytes()] for i in rows]).reshape(-1, 3)
                known.append((frame, at, described[rows]))
    shares = [c.K[0, 0] / max(c.width, c.height) for c in rig.values()]
    placed = {}
    for name, camera in sorted(others.items()):
        pairs = [np.zeros((0, 5))]
        for frame, at, described in known:
            if name in seen[frame].features:
                pixels, mine = seen[frame].features[name]
                matches = match_descriptors(mine, described)
                pairs.append(np.column_stack([pixels[matches[:, 0]], at[matches[:, 1]]]))
        focal = float(np.median(shares)) * max(camera.width, camera.height)
        lens = as_model(start_camera(name, (camera.width, camera.height), focal), camera.model)
        pose = resect(np.concatenate(pairs), lens.K)
        if pose is not None:
            placed[name] = replace(lens, cam_from_world=pose)
    return placed


def resect(pairs: np.ndarray, K: np.ndarray) -> np.ndarray | None:
    """Estimate a camera's pose (4, 4) from rows (M, 5) of a pixel and a known point.

    Returns None unless enough distinct rows agree.
    """
    # A point comes once for every camera that knows it: samples must not repeat it.
    rows = np.unique(pairs, axis=0)
    if len(np.unique(rows[:, :2], axis=0)) < LEAST_INLIERS:
        return None
    pixels, points = np.ascontiguousarray(rows[:, :2]), np.ascontiguousarray(rows[:, 2:])
    try:
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            points, pixels, K, None, iterationsCount=2000, reprojectionError=4.0,
            confidence=0.999, flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
    except cv2.error:  # points on a line or on one spot
        return None
    good = inliers[:, 0] if ok and inliers is not None else np.zeros(0, int)
    distinct = min(len(np.unique(column[good], axis=0)) for column in (pixels, points))
    if distinct < LEAST_INLIERS or len(good) < LEAST_SHARE * len(rows):
        return None
    return make_transform(cv2.Rodrigues(turn)[0], shift.ravel())
