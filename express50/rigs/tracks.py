"""Points that several cameras see at one time: facial landmarks and image features.

Landmarks tie cameras that look at the face from any two sides, to a few pixels; features (SIFT, of
skin, hair, cloth and room) tie neighbours, to a fraction of one. Pixels leave this file undistorted
and in units of the camera's `K`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from express50.adapters import opencv_pixels_to_corner
from express50.cameras import Camera, normalised
from express50.landmarks.detector import detect
from express50.landmarks.network import LandmarkNet

FEATURES = 1500
"""Features kept an image, strongest first."""
NEIGHBOURS = 6
"""Cameras whose features a camera's are compared with."""
WIDEST_DEG = 45.0
"""Angle between optical axes beyond which features do not look alike."""
RATIO = 0.8
"""A feature's second-best match must differ by so much more than its best (Lowe 2004)."""
FEATURE_SIGMA_PX = 0.7
FACE_SCORE = 0.9
"""Faces less surely seen are profiles and backs of heads, whose landmarks are guessed."""
LANDMARK_DOUBT = 3.0
"""Landmarks of a view err together, all to one side: so much wider than a single one's error."""


@dataclass(frozen=True)
class Tracks:
    """Observations of points, one row each, by camera and point.

    Attributes:
        names: cameras that `camera` counts.
        camera: (N,) index into `names`.
        point: (N,) number of the point; rows of one number show the same point.
        pixels: (N, 2) undistorted.
        sigma: (N,) expected error, pixels.
    """

    names: tuple[str, ...]
    camera: np.ndarray
    point: np.ndarray
    pixels: np.ndarray
    sigma: np.ndarray

    def select(self, keep: np.ndarray) -> Tracks:
        """The rows where `keep` (N,) is true, of points that two cameras still see, renumbered."""
        twice = np.bincount(self.point[keep], minlength=1 + self.point.max(initial=-1)) >= 2
        keep = keep & twice[self.point]
        columns = (self.camera, self.point, self.pixels, self.sigma)
        camera, point, pixels, sigma = (column[keep] for column in columns)
        number = np.unique(point, return_inverse=True)[1]
        return Tracks(self.names, camera, number, pixels, sigma)


@dataclass(frozen=True)
class Seen:
    """What the cameras saw at one moment, undistorted.

    `landmarks` holds the camera's number, points (68, 2) and sigma (68,) of each view of the face,
    `features` pixels (N, 2) and descriptors (N, 128) a camera.
    """

    landmarks: list[tuple[int, np.ndarray, np.ndarray]]
    features: dict[str, tuple[np.ndarray, np.ndarray]]


def look(
    cameras: Mapping[str, Camera], images: Mapping[str, np.ndarray], net: LandmarkNet | None
) -> Seen:
    """Landmarks (none without a network) and features of one moment's images (H, W, 3) uint8."""
    features = {n: find_features(cameras[n], image) for n, image in images.items()}
    return Seen(_landmarks(cameras, images, net) if net else [], features)


def join_tracks(cameras: Mapping[str, Camera], seen: Mapping[int, Seen], band: float) -> Tracks:
    """Tracks of what was seen, by frame number.

    Args:
        cameras: the rig as it is believed to be; features are only matched where it allows.
        seen: from `look`.
        band: distance from the epipolar line, as a share of the image's diagonal, within which
            a feature may be matched: how far off a camera may be taken to be.
    """
    names = tuple(sorted(cameras))
    neighbours = _neighbours(cameras)
    rows: list[tuple[int, int, np.ndarray, float]] = []
    count = 0
    for moment in seen.values():
        for index, points, sigma in moment.landmarks:
            rows += [(index, count + k, points[k], sigma[k]) for k in range(68)]
        count += 68
        features = moment.features
        matches = {
            (a, b): match_features(cameras[a], cameras[b], features[a], features[b], band)
            for a, b in neighbours
            if a in features and b in features
        }
        for group in _join_matches(matches):
            rows += [(names.index(n), count, features[n][0][k], FEATURE_SIGMA_PX) for n, k in group]
            count += 1
    table = Tracks(
        names,
        np.array([row[0] for row in rows], int),
        np.array([row[1] for row in rows], int),
        np.array([row[2] for row in rows], float).reshape(-1, 2),
        np.array([row[3] for row in rows], float),
    )
    return table.select(np.ones(len(rows), bool))


def ideal_pixels(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Where recorded pixels (N, 2) would be without distortion."""
    K = camera.K
    return normalised(camera, pixels) * K[[0, 1], [0, 1]] + K[:2, 2]


def _landmarks(
    cameras: Mapping[str, Camera], images: Mapping[str, np.ndarray], net: LandmarkNet
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Camera index, points (68, 2) and sigma (68,) of every view in which a face is found."""
    found = []
    for index, name in enumerate(sorted(cameras)):
        if name not in images:
            continue
        seen = detect(net, images[name])
        if seen.score >= FACE_SCORE:
            sigma = LANDMARK_DOUBT * np.maximum(seen.sigma, FEATURE_SIGMA_PX)
            found.append((index, ideal_pixels(cameras[name], seen.points), sigma))
    return found


def find_features(camera: Camera, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """SIFT features of an image: undistorted pixels (N, 2), descriptors (N, 128) of length one.

    Descriptors are compared as square roots (Arandjelovic and Zisserman, CVPR 2012).
    """
    sift = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.01)
    keys, described = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    if not keys:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    pixels = opencv_pixels_to_corner(np.array([key.pt for key in keys]))
    total = np.maximum(described.sum(1, keepdims=True), 1e-9)
    return ideal_pixels(camera, pixels), np.sqrt(described / total)


def _neighbours(cameras: Mapping[str, Camera]) -> list[tuple[str, str]]:
    """Pairs of cameras, in order of name, of which one is among the other's nearest."""
    names = sorted(cameras)
    axes = np.stack([cameras[name].cam_from_world[2, :3] for name in names])
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    pairs = set()
    for i in range(len(names)):
        near = [j for j in np.argsort(angle[i], kind="stable") if j != i][:NEIGHBOURS]
        pairs |= {(min(i, j), max(i, j)) for j in near if angle[i, j] < WIDEST_DEG}
    return [(names[i], names[j]) for i, j in sorted(pairs)]


def match_features(
    a: Camera,
    b: Camera,
    features_a: tuple[np.ndarray, np.ndarray],
    features_b: tuple[np.ndarray, np.ndarray],
    band: float,
) -> np.ndarray:
    """Pairs (M, 2) of features that are each other's clear best near their epipolar lines.

    `band` is how near, as a share of the image's diagonal.
    """
    (pixels_a, described_a), (pixels_b, described_b) = features_a, features_b
    if min(len(pixels_a), len(pixels_b)) < 2:
        return np.zeros((0, 2), int)
    likeness = described_a @ described_b.T
    off = epipolar_distance(a, b, pixels_a, pixels_b)
    likeness[off > band * np.hypot(b.width, b.height)] = -1.0
    distance = np.sqrt(np.maximum(2 - 2 * likeness, 0))
    best = distance.argmin(1)
    rows = np.arange(len(best))
    nearest = np.partition(distance, 1, axis=1)
    good = nearest[:, 0] < RATIO * np.minimum(nearest[:, 1], 1.0)
    good &= distance.argmin(0)[best] == rows
    return np.stack([rows[good], best[good]], axis=1)


def epipolar_distance(
    a: Camera, b: Camera, pixels_a: np.ndarray, pixels_b: np.ndarray
) -> np.ndarray:
    """Distance (A, B), pixels in b, of each pixel in b from the epipolar line of each in a.

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 9.2.
    """
    b_from_a = b.cam_from_world @ a.world_from_cam
    x, y, z = b_from_a[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    F = np.linalg.inv(b.K).T @ cross @ b_from_a[:3, :3] @ np.linalg.inv(a.K)
    lines = np.column_stack([pixels_a, np.ones(len(pixels_a))]) @ F.T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return np.abs(lines @ np.column_stack([pixels_b, np.ones(len(pixels_b))]).T)


def _join_matches(
    matches: Mapping[tuple[str, str], np.ndarray],
) -> list[list[tuple[str, int]]]:
    """Chains of matches as groups of (camera, feature); one camera twice dissolves a group."""
    above: dict[tuple[str, int], tuple[str, int]] = {}

    def root(node: tuple[str, int]) -> tuple[str, int]:
        while above.setdefault(node, node) != node:
            above[node] = above[above[node]]
            node = above[node]
        return node

    for (a, b), pairs in matches.items():
        for i, j in pairs:
            above[root((a, int(i)))] = root((b, int(j)))
    groups: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for node in sorted(above):
        groups.setdefault(root(node), []).append(node)
    return [g for g in groups.values() if len({name for name, _ in g}) == len(g)]
