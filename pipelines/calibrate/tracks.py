"""Join points that several cameras saw at one instant into tracks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TypeAlias

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from express50.geometry.cameras import Camera, normalised
from express50.geometry.conventions import mirror_pixels

Features: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Recorded pixels (N, 2) and descriptors (N, 128) of length one."""
PairMatches: TypeAlias = dict[tuple[str, str], dict[int, np.ndarray]]
"""Matches (M, 2), rows of `Features`, by two cameras in order of name and by frame."""
LEAST_INLIERS, CHANCE = 12, 0.125
"""Matches that must agree on one geometry: a number, plus a share of all of them."""
RATIO = 0.8
"""A match counts if its distance is below this share of the second-best one's (Lowe 2004)."""
FEATURE_SIGMA_PX = 0.7
NEIGHBOURS, WIDEST_DEG = 6, 45.0
"""Features are compared between each camera and this many neighbours, if their axes differ by less
than the angle: beyond it features no longer look alike."""
ON_PLANE = 0.005  # share of the width: matches this close to a homography lie on its plane
LEAST_MIRRORED = 100  # matches; faces that are their own mirror image give up to 46
LEAST_POINTS = 20  # that a camera must share with two others to be judged by them


@dataclass(frozen=True)
class PointTracks:
    """Observations of points, one row per camera and point; no camera sees a point twice."""

    names: tuple[str, ...]
    camera: np.ndarray  # (N,) index of `names`
    point: np.ndarray  # (N,) rows with the same number show the same point
    pixels: np.ndarray  # (N, 2) as recorded
    sigma: np.ndarray  # (N,) their expected errors

    def select(self, keep: np.ndarray) -> PointTracks:
        """Keep the rows where `keep` (N,) is true, of points that two cameras still see."""
        twice = np.bincount(self.point[keep], minlength=1 + self.point.max(initial=-1)) >= 2
        keep = keep & twice[self.point]
        columns = (self.camera, self.point, self.pixels, self.sigma)
        camera, point, pixels, sigma = (column[keep] for column in columns)
        number = np.unique(point, return_inverse=True)[1]
        return PointTracks(self.names, camera, number, pixels, sigma)

    def of_cameras(self, names: tuple[str, ...]) -> PointTracks:
        """Keep the observations of some cameras, which are renumbered."""
        number = np.array([names.index(n) if n in names else -1 for n in self.names], int)
        kept = self.select(number[self.camera] >= 0)
        return replace(kept, names=names, camera=number[kept.camera])

    def features(self) -> np.ndarray:
        """Mark the rows (N,) that are features, not landmarks."""
        return self.sigma == FEATURE_SIGMA_PX

    def shared_points(self) -> np.ndarray:
        """Count the points (C,) that each camera sees together with two others."""
        views = np.bincount(self.point, minlength=1)
        rows = views[self.point] >= 3
        return np.bincount(self.camera[rows], minlength=len(self.names))


@dataclass(frozen=True)
class FrameSetPoints:
    """The points that the cameras of one frame set saw, in recorded pixels."""

    landmarks: list[tuple[str, np.ndarray, np.ndarray]]  # camera, (68, 2), sigma (68,)
    features: dict[str, Features]

    def without(self, names: Container[str]) -> FrameSetPoints:
        """Leave out what some cameras saw."""
        views = [view for view in self.landmarks if view[0] not in names]
        return FrameSetPoints(views, {n: f for n, f in self.features.items() if n not in names})


def join_tracks(
    cameras: Mapping[str, Camera],
    seen: Mapping[int, FrameSetPoints],
    band: float,
    candidates: PairMatches | None = None,
    verified: bool = True,
) -> PointTracks:
    """Join landmarks and matched features of frames into tracks.

    A match is at most `band` off its epipolar line, as a share of the image's diagonal.
    `candidates` are those of `candidate_matches`, if they are known already. `verified` matches
    agree on a fundamental matrix of their pair of cameras over all frames. They can show that a
    whole rig is a little off, whereas matches found along its wrong lines would confirm it. Where
    no matrix is found, candidates are searched along the lines, and a matrix must explain them.
    Unverified matches come from the lines alone: there are more if most cameras are right.
    """
    names = tuple(sorted(cameras))
    ideal = {f: {n: _undistorted(cameras[n], p.features[n]) for n in names if n in p.features}
             for f, p in seen.items()}  # fmt: skip
    matches: dict[int, list[tuple[str, str, np.ndarray]]] = {frame: [] for frame in seen}
    for a, b in neighbours(cameras):
        both = {f: (views[a], views[b]) for f, views in ideal.items() if a in views and b in views}
        rig, reach = (cameras[a], cameras[b]), band * np.hypot(cameras[b].width, cameras[b].height)
        found = (
            verified_pairs(both, None if candidates is None else candidates[a, b])
            if verified
            else {}
        )
        if not found:  # fewer mistakes are possible where only features near the lines are compared
            found = {
                f: match_descriptors(p[1], q[1], epipolar_distance(*rig, p[0], q[0]) < reach)
                for f, (p, q) in both.items()
            }
            found = verified_pairs(both, found) if verified else found
        for frame, pairs in found.items():
            ends = (both[frame][i][0][pairs[:, i]] for i in (0, 1))
            near = epipolar_distance(*rig, *ends).diagonal() < reach
            matches[frame].append((a, b, pairs[near]))
    rows: list[tuple[int, int, np.ndarray, float]] = []
    count = 0
    for frame, points in seen.items():
        for name, pixels, sigma in points.landmarks:
            if name in cameras:
                rows += [(names.index(name), count + k, pixels[k], sigma[k]) for k in range(68)]
        count += 68
        for group in _chain(names, matches[frame]):
            rows += [(c, count, points.features[names[c]][0][k], FEATURE_SIGMA_PX)
                     for c, k in group]  # fmt: skip
            count += 1
    table = PointTracks(
        names,
        np.array([row[0] for row in rows], int),
        np.array([row[1] for row in rows], int),
        np.array([row[2] for row in rows], float).reshape(-1, 2),
        np.array([row[3] for row in rows], float),
    )
    return table.select(np.ones(len(rows), bool))


def _undistorted(camera: Camera, features: Features) -> Features:
    """Return features in the pixels of the undistorted image.

    Where a trial lens folds there is no such pixel: descriptors of zeros match nothing.
    """
    K, (pixels, described) = camera.K, features
    xy = normalised(camera, pixels)
    valid = np.isfinite(xy).all(axis=1, keepdims=True)
    return np.where(valid, xy, 0) * K[[0, 1], [0, 1]] + K[:2, 2], described * valid


def neighbours(cameras: Mapping[str, Camera]) -> list[tuple[str, str]]:
    """List the pairs of cameras, in order of name, of which one is among the other's nearest."""
    names = sorted(cameras)
    axes = np.stack([cameras[name].cam_from_world[2, :3] for name in names])
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    pairs = set()
    for i in range(len(names)):
        near = [j for j in np.argsort(angle[i], kind="stable") if j != i][:NEIGHBOURS]
        pairs |= {(min(i, j), max(i, j)) for j in near if angle[i, j] < WIDEST_DEG}
    return [(names[i], names[j]) for i, j in sorted(pairs)]


def _chain(
    names: tuple[str, ...], matches: list[tuple[str, str, np.ndarray]]
) -> list[list[tuple[int, int]]]:
    """Chain pairwise matches into groups of (camera, feature).

    A group that holds two features of one camera contradicts itself and is left out.
    """
    ends = [
        np.concatenate([np.full((len(pairs), 1), names.index(n)), pairs[:, i : i + 1]], axis=1)
        for i in range(2)
        for n, pairs in ((match[i], match[2]) for match in matches)
    ]
    if not ends:
        return []
    nodes, number = np.unique(np.concatenate(ends), axis=0, return_inverse=True)
    first, second = number.reshape(2, -1)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(nodes),) * 2)
    label = connected_components(graph, directed=False)[1]
    groups: dict[int, list[tuple[int, int]]] = {}
    for (camera, feature), group in zip(nodes.tolist(), label.tolist(), strict=True):
        groups.setdefault(group, []).append((camera, feature))
    return [g for g in groups.values() if len({camera for camera, _ in g}) == len(g)]


def match_descriptors(
    a: np.ndarray, b: np.ndarray, allowed: np.ndarray | None = None
) -> np.ndarray:
    """Match descriptors (A, 128), (B, 128): `allowed` pairs (M, 2), each other's clear best."""
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), int)
    likeness = a @ b.T
    if allowed is not None:
        np.copyto(likeness, -1.0, where=~allowed)
    rows, best = np.arange(len(a)), likeness.argmax(1)
    first = likeness[rows, best]
    good = first == likeness.max(0)[best]  # `argmax(0)` takes 30 times as long
    likeness[rows, best] = -1.0  # leaves the second best as the largest
    nearest, second = (np.sqrt(np.maximum(2 - 2 * v, 0)) for v in (first, likeness.max(1)))
    good &= nearest < RATIO * np.minimum(second, 1.0)
    return np.stack([rows[good], best[good]], axis=1)


def epipolar_distance(
    a: Camera, b: Camera, pixels_a: np.ndarray, pixels_b: np.ndarray
) -> np.ndarray:
    """Measure (A, B), pixels in b, how far each pixel in b is from the epipolar line of each in a.

    Pixels are undistorted. Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 9.2.
    """
    b_from_a = b.cam_from_world @ a.world_from_cam
    x, y, z = b_from_a[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    F = np.linalg.inv(b.K).T @ cross @ b_from_a[:3, :3] @ np.linalg.inv(a.K)
    lines = np.column_stack([pixels_a, np.ones(len(pixels_a))]) @ F.T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return np.abs(lines @ np.column_stack([pixels_b, np.ones(len(pixels_b))]).T)


def candidate_matches(features: Mapping[int, Mapping[str, Features]]) -> PairMatches:
    """Match the features of all pairs of cameras, by name, in each frame by descriptors alone."""
    names = sorted({name for found in features.values() for name in found})
    return {
        (a, b): {
            frame: match_descriptors(found[a][1], found[b][1])
            for frame, found in features.items()
            if a in found and b in found
        }
        for a, b in combinations(names, 2)
    }


def mirrored_cameras(
    seen: Mapping[int, FrameSetPoints], widths: Mapping[str, int], pairs: Iterable[tuple[str, str]]
) -> dict[str, str]:
    """Return which cameras record mirrored pictures, with the reason to believe it.

    In the fullest frame set their features match those of other cameras only if mirrored. `pairs`
    of cameras are compared. Where they stand far apart nothing is found: a face is nearly its own
    mirror image. Matches on one plane prove nothing: the back of a board that is printed on both
    sides is the front's mirror image.
    """
    frame = max(sorted(seen), key=lambda number: len(seen[number].features))
    features = seen[frame].features
    pairs = [pair for pair in pairs if set(pair) <= set(features)]
    turned, straight = Counter[str](), Counter[str]()
    for a, b in pairs:
        mine, there = mirror_features(features[a], widths[a]), features[b]
        found = verified_pairs({frame: (mine, there)}).get(frame, np.zeros((0, 2), int))
        off_plane = 0
        if len(found) >= LEAST_INLIERS:
            p, q = mine[0][found[:, 0]], there[0][found[:, 1]]
            H, mask = cv2.findHomography(p, q, cv2.USAC_MAGSAC, ON_PLANE * widths[b])
            off_plane = len(p) if H is None else int((mask == 0).sum())
        turned.update(dict.fromkeys((a, b), off_plane))
    suspects = {name for name in features if turned[name] > LEAST_MIRRORED}
    for a, b in (pair for pair in pairs if suspects & set(pair)):
        agreed = verified_pairs({frame: (features[a], features[b])}).values()
        straight.update(dict.fromkeys((a, b), sum(map(len, agreed))))
    return {
        name: f"{turned[name]} features of its pictures match other cameras if mirrored,"
        f" {straight[name]} as recorded: switch mirroring off where they are recorded, or mirror"
        " the files"
        for name in sorted(suspects)
        if turned[name] > 2 * straight[name] + LEAST_MIRRORED
    }


def mirror_features(features: Features, width: int) -> Features:
    """Return features as the mirrored picture has them.

    A SIFT descriptor has four rows of four cells with eight directions each. Rows and directions
    change sides.
    """
    pixels, described = features
    cells = described.reshape(-1, 4, 4, 8)[:, ::-1, :, -np.arange(8) % 8]
    return mirror_pixels(pixels, width), cells.reshape(-1, 128)


def verified_pairs(
    features: Mapping[int, tuple[Features, Features]],
    candidates: dict[int, np.ndarray] | None = None,
) -> dict[int, np.ndarray]:
    """Return the matches (M, 2) by frame that one fundamental matrix of two cameras explains.

    `candidates` are matches by descriptors. The result is empty where the matrix explains fewer
    than 12 plus an eighth of them: it explains about 8 plus a twentieth of false ones.
    """
    if candidates is None:
        candidates = {frame: match_descriptors(a[1], b[1]) for frame, (a, b) in features.items()}
    candidates = {frame: candidates[frame] for frame in features}
    counts = [len(pairs) for pairs in candidates.values()]
    if sum(counts) < LEAST_INLIERS:
        return {}
    p, q = (
        np.concatenate([features[f][i][0][pairs[:, i]] for f, pairs in candidates.items()])
        for i in range(2)
    )
    F, mask = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, 1.5, 0.999, 10_000)
    good = np.zeros(len(p), bool) if F is None else mask.ravel() > 0
    if good.sum() < LEAST_INLIERS + CHANCE * len(good):
        return {}
    parts = np.split(good, np.cumsum(counts)[:-1])
    return {f: pairs[ok] for (f, pairs), ok in zip(candidates.items(), parts, strict=True)}
