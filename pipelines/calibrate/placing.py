"""Cameras that see no face, placed by features of points that the rest of the rig knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import make_transform
from pipelines.calibrate.adjust import triangulate_tracks
from pipelines.calibrate.faces import start_camera
from pipelines.calibrate.features import match_looks
from pipelines.calibrate.intrinsics import as_model
from pipelines.calibrate.tracks import Seen, join_verified

LEAST_INLIERS, LEAST_SHARE, INLIER_PX = 12, 0.4, 4.0
"""Known points, and share of those it seems to see, by which a camera without a face is placed."""
BAND = 0.015
"""How far from its epipolar lines a known feature may be, as a share of the diagonal."""


def place_others(
    rig: Mapping[str, Camera],
    others: Mapping[str, Camera],
    ideal: Mapping[int, Seen],
    seen: Mapping[int, Seen],
) -> dict[str, Camera]:
    """Cameras without a face, placed by features that look like points the rig knows.

    `seen` holds recorded pixels, by frame number, `ideal` the rig's own undistorted. `others` say
    the sizes and lens model of the cameras to place; their focal length becomes the rig's median.
    """
    known = _known_features(rig, ideal) if others else {}
    shares = [c.K[0, 0] / max(c.width, c.height) for c in rig.values()]
    placed = {}
    for name, camera in sorted(others.items()):
        found: list[tuple[np.ndarray, np.ndarray]] = []
        for (frame, _), (where, described) in known.items():
            if name in seen[frame].features:
                pixels, mine = seen[frame].features[name]
                found += [(pixels[i], where[j]) for i, j in match_looks(mine, described)]
        focal = float(np.median(shares)) * max(camera.width, camera.height)
        lens = as_model(start_camera(name, (camera.width, camera.height), focal), camera.model)
        pose = _resection(found, lens)
        if pose is not None:
            placed[name] = replace(lens, cam_from_world=pose)
    return placed


def _known_features(
    rig: Mapping[str, Camera], ideal: Mapping[int, Seen]
) -> dict[tuple[int, str], tuple[np.ndarray, np.ndarray]]:
    """World points (M, 3) and descriptors (M, 128) of the features in tracks, by frame, camera."""
    tracks = join_verified(rig, ideal, BAND)
    points = triangulate_tracks(rig, tracks)
    known = {}
    for index, name in enumerate(tracks.names):
        mine = np.flatnonzero(tracks.camera == index)
        number = {p.tobytes(): n for p, n in
                  zip(tracks.pixels[mine], tracks.point[mine], strict=True)}  # fmt: skip
        for frame, moment in ideal.items():
            if name in moment.features:
                pixels, described = moment.features[name]
                rows = [i for i, p in enumerate(pixels) if p.tobytes() in number]
                at = [number[pixels[i].tobytes()] for i in rows]
                known[frame, name] = (points[at], described[rows])
    return known


def _resection(found: list[tuple[np.ndarray, np.ndarray]], camera: Camera) -> np.ndarray | None:
    """Pose (4, 4) of a camera from pixels of known points; None without enough that agree."""
    # One point is met once for every camera that knows it: samples must not repeat it.
    rows = np.unique([np.concatenate(pair) for pair in found] or np.zeros((0, 5)), axis=0)
    if len(np.unique(rows[:, :2], axis=0)) < LEAST_INLIERS:
        return None
    pixels, where = np.ascontiguousarray(rows[:, :2]), np.ascontiguousarray(rows[:, 2:])
    try:
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            where, pixels, camera.K, None, iterationsCount=2000, reprojectionError=INLIER_PX,
            confidence=0.999, flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
    except cv2.error:  # points on a line or on one spot
        return None
    good = inliers[:, 0] if ok and inliers is not None else np.zeros(0, int)
    alike = min(len(np.unique(column[good], axis=0)) for column in (pixels, where))
    if alike < LEAST_INLIERS or len(good) < LEAST_SHARE * len(rows):
        return None
    return make_transform(cv2.Rodrigues(turn)[0], shift.ravel())
