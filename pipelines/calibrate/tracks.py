"""Points that several cameras see at one time: facial landmarks and image features.

Landmarks tie cameras that look at the face from any two sides, to a few pixels; features (SIFT, of
skin, hair, cloth and room) tie neighbours, to a fraction of one. Pixels leave this file undistorted
and in units of the camera's `K`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from express50.geometry.cameras import Camera, normalised
from express50.landmarks.detector import detect
from express50.landmarks.network import LandmarkNet
from pipelines.calibrate.features import (
    Features,
    epipolar_distance,
    find_features,
    match_features,
    verified_pairs,
    without_fixed,
)

NEIGHBOURS = 6
"""Cameras whose features a camera's are compared with."""
WIDEST_DEG = 45.0
"""Angle between optical axes beyond which features do not look alike."""
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

    `landmarks` holds the camera, points (68, 2) and sigma (68,) of each view of the face,
    `features` pixels (N, 2) and descriptors (N, 128) a camera.
    """

    landmarks: list[tuple[str, np.ndarray, np.ndarray]]
    features: dict[str, Features]


def look(
    cameras: Mapping[str, Camera], images: Mapping[str, np.ndarray], net: LandmarkNet | None
) -> Seen:
    """Landmarks (none without a network) and features of one moment's images (H, W, 3) uint8."""
    recorded = without_fixed({name: find_features(image) for name, image in images.items()})
    features = {n: (ideal_pixels(cameras[n], p), d) for n, (p, d) in recorded.items()}
    faces = {name: find_face(images[name], net) for name in sorted(images)} if net else {}
    landmarks = [(n, ideal_pixels(cameras[n], f[0]), f[1]) for n, f in faces.items() if f]
    return Seen(landmarks, features)


def join_tracks(cameras: Mapping[str, Camera], seen: Mapping[int, Seen], band: float) -> Tracks:
    """Tracks of what was seen, by frame number.

    Args:
        cameras: the rig as it is believed to be; features are only matched where it allows.
        seen: from `look`.
        band: distance from the epipolar line, as a share of the image's diagonal, within which
            a feature may be matched: how far off a camera may be taken to be.
    """
    pairs = _neighbours(cameras)
    matches = {
        frame: {
            (a, b): match_features(cameras[a], cameras[b], features[a], features[b], band)
            for a, b in pairs
            if a in features and b in features
        }
        for frame, features in ((frame, moment.features) for frame, moment in seen.items())
    }
    return tracks_of(cameras, seen, matches)


def join_verified(cameras: Mapping[str, Camera], seen: Mapping[int, Seen], band: float) -> Tracks:
    """Tracks of what was seen, features matched by their looks and by each pair's own geometry.

    The matches owe nothing to the rig but that they lie within `band` of its epipolar lines (as
    in `join_tracks`), so they can tell that all its cameras are a little off: matches sought along
    wrong lines would only confirm them. All moments of a pair are judged together.
    """
    matches: dict[int, dict[tuple[str, str], np.ndarray]] = {frame: {} for frame in seen}
    for a, b in _neighbours(cameras):
        both = {
            frame: (moment.features[a], moment.features[b])
            for frame, moment in seen.items()
            if a in moment.features and b in moment.features
        }
        for frame, pairs in verified_pairs(both).items():
            p, q = (seen[frame].features[n][0][pairs[:, i]] for i, n in enumerate((a, b)))
            off = epipolar_distance(cameras[a], cameras[b], p, q).diagonal()
            near = off < band * np.hypot(cameras[b].width, cameras[b].height)
            matches[frame][a, b] = pairs[near]
    return tracks_of(cameras, seen, matches)


def tracks_of(
    cameras: Mapping[str, Camera],
    seen: Mapping[int, Seen],
    matches: Mapping[int, Mapping[tuple[str, str], np.ndarray]],
) -> Tracks:
    """Tracks of the landmarks and of matched features, by frame number and pair of cameras."""
    names = tuple(sorted(cameras))
    rows: list[tuple[int, int, np.ndarray, float]] = []
    count = 0
    for frame, moment in seen.items():
        for name, points, sigma in moment.landmarks:
            if name in cameras:
                rows += [(names.index(name), count + k, points[k], sigma[k]) for k in range(68)]
        count += 68
        features = moment.features
        for group in _join_matches(matches.get(frame, {})):
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


def undistorted(seen: Mapping[int, Seen], cameras: Mapping[str, Camera]) -> dict[int, Seen]:
    """What `cameras` undistort of moments that were looked at without distortion."""
    return {
        frame: Seen(
            [(n, ideal_pixels(cameras[n], p), s) for n, p, s in moment.landmarks if n in cameras],
            {
                name: (ideal_pixels(cameras[name], pixels), described)
                for name, (pixels, described) in moment.features.items()
                if name in cameras
            },
        )
        for frame, moment in seen.items()
    }


def ideal_pixels(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Where recorded pixels (N, 2) would be without distortion."""
    K = camera.K
    return normalised(camera, pixels) * K[[0, 1], [0, 1]] + K[:2, 2]


def find_face(image: np.ndarray, net: LandmarkNet) -> tuple[np.ndarray, np.ndarray] | None:
    """Recorded landmarks (68, 2) and their expected errors (68,), if a face is surely seen."""
    seen = detect(net, image)
    if seen.score < FACE_SCORE:
        return None
    return seen.points, LANDMARK_DOUBT * np.maximum(seen.sigma, FEATURE_SIGMA_PX)


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
