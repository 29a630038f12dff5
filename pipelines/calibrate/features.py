"""Image features: SIFT, matched by looks, along epipolar lines, or by a pair's own geometry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import cv2
import numpy as np
from scipy.spatial import cKDTree

from express50.geometry.cameras import Camera
from express50.geometry.conventions import opencv_pixels_to_corner

Features: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Pixels (N, 2) and descriptors (N, 128)."""
FEATURES = 1500
"""Features kept an image, strongest first."""
RATIO = 0.8
"""A feature's second-best match must differ by so much more than its best (Lowe 2004)."""
PAIR_PX = 1.5
"""Distance from the epipolar line of two pictures' own geometry within which a match counts."""
PAIR_LEAST, PAIR_SHARE = 12, 0.4
"""Matches, and share of all, that two pictures' own geometry must explain to be believed."""
FIXED_PX, FIXED_LIKENESS = 0.75, 0.9
"""Features of several cameras so near in pixels and so alike do not belong to the scene."""


def find_features(image: np.ndarray) -> Features:
    """SIFT features of an image (H, W, 3) uint8: recorded pixels and descriptors of length one.

    Descriptors are compared as square roots (Arandjelovic and Zisserman, CVPR 2012).
    """
    sift = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.01)
    keys, described = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    if not keys:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    pixels = opencv_pixels_to_corner(np.array([key.pt for key in keys]))
    total = np.maximum(described.sum(1, keepdims=True), 1e-9)
    return pixels, np.sqrt(described / total)


def without_fixed(features: Mapping[str, Features]) -> dict[str, Features]:
    """Features of one moment without those that three cameras or more have at the same pixel.

    They belong to sensors and lenses, not to the scene: dust, a watermark, the same noise in all.
    """
    names = sorted(features)
    owner = np.concatenate([np.full(len(features[n][0]), i) for i, n in enumerate(names)])
    pixels = np.concatenate([features[n][0] for n in names])
    described = np.concatenate([features[n][1] for n in names])
    pairs = cKDTree(pixels).query_pairs(FIXED_PX, output_type="ndarray")
    alike = np.einsum("ij,ij->i", described[pairs[:, 0]], described[pairs[:, 1]]) > FIXED_LIKENESS
    first, second = pairs[alike & (owner[pairs[:, 0]] != owner[pairs[:, 1]])].T
    seen = np.zeros((len(owner), len(names)), bool)
    seen[first, owner[second]] = seen[second, owner[first]] = True
    keep = seen.sum(1) < 2
    return {
        name: (features[name][0][keep[owner == i]], features[name][1][keep[owner == i]])
        for i, name in enumerate(names)
    }


def match_features(
    a: Camera,
    b: Camera,
    features_a: Features,
    features_b: Features,
    band: float,
) -> np.ndarray:
    """Pairs (M, 2) of features that are each other's clear best near their epipolar lines.

    `band` is how near, as a share of the image's diagonal.
    """
    (pixels_a, described_a), (pixels_b, described_b) = features_a, features_b
    off = epipolar_distance(a, b, pixels_a, pixels_b)
    return match_looks(described_a, described_b, off < band * np.hypot(b.width, b.height))


def match_looks(
    described_a: np.ndarray, described_b: np.ndarray, allowed: np.ndarray | None = None
) -> np.ndarray:
    """Pairs (M, 2) of features, by descriptors (A, 128) and (B, 128), each the other's clear best.

    Only pairs that are `allowed` (A, B) are compared; None allows all.
    """
    if min(len(described_a), len(described_b)) < 2:
        return np.zeros((0, 2), int)
    likeness = described_a @ described_b.T
    if allowed is not None:
        likeness[~allowed] = -1.0
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


def verified_pairs(
    features: Mapping[int, tuple[Features, Features]],
) -> dict[int, np.ndarray]:
    """Matches (M, 2) by frame that one fundamental matrix of two cameras explains; {} if none.

    `features` are those of both cameras by frame.
    """
    looks = {frame: match_looks(a[1], b[1]) for frame, (a, b) in features.items()}
    counts = [len(pairs) for pairs in looks.values()]
    if sum(counts) < PAIR_LEAST:
        return {}
    p, q = (
        np.concatenate([features[f][i][0][pairs[:, i]] for f, pairs in looks.items()])
        for i in range(2)
    )
    F, mask = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, PAIR_PX, 0.999, 10_000)
    good = np.zeros(len(p), bool) if F is None else mask.ravel() > 0
    if good.sum() < PAIR_LEAST or good.mean() < PAIR_SHARE:
        return {}
    parts = np.split(good, np.cumsum(counts)[:-1])
    return {f: pairs[ok] for (f, pairs), ok in zip(looks.items(), parts, strict=True)}
