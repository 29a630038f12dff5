"""Solve a rig without calibration or board from its footage: structure from motion.

The face starts the solution, features make it precise, and everything is adjusted together over
several frame sets. Cameras do not move between them, so all points tie the same poses. The metre
comes from the distance between the eyes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera, triangulate
from express50.geometry.transforms import rigid_fit
from express50.rigs.camera_builder import in_metres
from express50.rigs.world_frame import canonical_from_rig, move_cameras
from pipelines.calibrate.adjuster import AdjustedRig, RigPriors, adjust_rig, triangulate_tracks
from pipelines.calibrate.config import AUTO
from pipelines.calibrate.first_guess import (
    LEAST_INLIERS,
    face_rig,
    focal_at,
    mean_landmarks,
    place_by_features,
    start_camera,
)
from pipelines.calibrate.intrinsics import as_model
from pipelines.calibrate.tracks import LEAST_POINTS, FrameSetPoints, PointTracks, join_tracks

FACE_SCALES, FEATURE_SCALES = (6.0, 2.0), (3.0, 1.5)
"""Cauchy scales of the adjustments, in sigmas."""
BANDS = (0.04, 0.015)
"""How far features may be from their epipolar lines while the rig is still rough, as a share of
the diagonal."""
KNOWN_FOCAL, GUESSED_FOCAL, FOCAL_SPREAD = 0.02, 0.6, 0.03
"""Standard deviations of focal lengths that are known, that are guessed, and of one rig's focal
lengths about their mean, as shares. A guess of 0.3 pulled the focal lengths of synthetic rigs 1 to
2 % further from the truth."""
CENTRE, BEND = 0.005, 0.02
"""Standard deviations of principal points, as a share of the diagonal, and of how far lenses bend
the image's corner, as a share of half of it: footage alone says little about either."""
OUTLIER = 4.0
"""Features with larger errors, in sigmas, are mismatches and left out of reported figures."""
EYES = (slice(36, 42), slice(42, 48))


@dataclass(frozen=True)
class FootageSolution:
    """A rig solved from footage, in metres and in the canonical world.

    Attributes:
        cameras: those that could be placed.
        tracks: the observations they were solved from.
        errors: (N, 2) pixels, one row per observation.
        inliers: (N,) bool, the features that are not mismatches.
        dropped: the other cameras, with the reason.
        weak: cameras that only the face holds, with the reason.
        eye_frames: frame sets in which the distance between the eyes was measured.
        eye_spread: robust standard deviation of that distance over them, as a share of it.
    """

    cameras: dict[str, Camera]
    tracks: PointTracks
    errors: np.ndarray
    inliers: np.ndarray
    dropped: dict[str, str]
    weak: dict[str, str]
    eye_frames: int
    eye_spread: float


def solve_footage(
    seen: Mapping[int, FrameSetPoints],
    sizes: Mapping[str, tuple[int, int]],
    focals: Mapping[str, float],
    where: str,
    *,
    model: str,
    distance_m: float,
    eye_distance_mm: float,
) -> FootageSolution:
    """Solve a rig from points that its cameras saw at the same instants.

    Args:
        seen: points by frame number.
        sizes: (width, height) of each camera, pixels.
        focals: known focal lengths, pixels, by camera.
        where: the capture, for messages.
        model: COLMAP lens model; auto is SIMPLE_RADIAL.
        distance_m: assumed distance of faces, where focal lengths start that are not known.
        eye_distance_mm: assumed distance between the pupils, which gives the metre.

    Raises:
        CalibrationError: fewer than two cameras see one face at one time, so that nothing starts
            the solution and nothing gives the metre.
    """
    head = mean_landmarks()
    share = focal_at(distance_m, seen, sizes, head)
    lens = "SIMPLE_RADIAL" if model == AUTO else model
    start = {
        name: as_model(start_camera(name, size, focals.get(name, share * max(size))), lens)
        for name, size in sizes.items()
    }
    rig = face_rig(start, seen, head)
    faces = {name for points in seen.values() for name, _, _ in points.landmarks}
    if len(rig) < 2:
        raise CalibrationError(
            f"{where}: has neither calibration.json nor board images, and to solve its cameras from"
            f" footage two or more must see a face at the same time; a face is seen by"
            f" {', '.join(sorted(faces)) or 'none'}: add calibration.json or board/<camera>/*.png"
            " with board.toml, then run 'express50 ingest' again"
        )
    without = {name: camera for name, camera in start.items() if name not in rig}
    priors = RigPriors(
        focal=KNOWN_FOCAL if all(name in focals for name in sizes) else GUESSED_FOCAL,
        focal_spread=FOCAL_SPREAD,
        centre=CENTRE,
        bend=BEND,
    )
    bare = {frame: FrameSetPoints(points.landmarks, {}) for frame, points in seen.items()}
    tracks = join_tracks(rig, bare, BANDS[0])
    rig = adjust_rig(rig, tracks, triangulate_tracks(rig, tracks), RigPriors(), FACE_SCALES).cameras
    tracks, adjusted = _adjust_with_features(rig, seen, priors, start)
    more = place_by_features(adjusted.cameras, without, seen)
    if more:
        tracks, adjusted = _adjust_with_features(adjusted.cameras | more, seen, priors, start)
        loose = set(_weak(tracks)) & set(more)  # held by neither a face nor features
        if loose:
            rig = {name: c for name, c in adjusted.cameras.items() if name not in loose}
            tracks, adjusted = _adjust_with_features(rig, seen, priors, start)
    shapes = _landmark_points(adjusted.cameras, seen)
    gaps = np.array([np.linalg.norm(p[EYES[0]].mean(0) - p[EYES[1]].mean(0)) for p in shapes])
    if not (gaps > 0).any():
        raise CalibrationError(
            f"{where}: the eyes cannot be located in space, so nothing gives the metre; add"
            " calibration.json or board images, then run 'express50 ingest' again"
        )
    eyes = float(np.median(gaps[gaps > 0]))
    scale = eye_distance_mm * 1e-3 / eyes
    metric = in_metres(adjusted.cameras, scale)
    middle = scale * np.median([p.mean(0) for p in shapes], axis=0)
    up = np.mean([rigid_fit(head, p)[0] for p in shapes], axis=0)[:, 1]
    lone = "it sees a face, but never together with the cameras of the largest group"
    blind = (
        f"it sees no face well, and fewer than {LEAST_INLIERS} of its features fit points that two"
        " other cameras know: add board images or calibration.json"
    )
    sizes_in_sigmas = np.linalg.norm(adjusted.errors, axis=1) / tracks.sigma
    return FootageSolution(
        cameras=move_cameras(metric, canonical_from_rig(metric, middle, up)),
        tracks=tracks,
        errors=adjusted.errors,
        inliers=tracks.features() & (sizes_in_sigmas < OUTLIER),
        dropped={n: lone if n in faces else blind for n in sorted(without) if n not in metric},
        weak=_weak(tracks),
        eye_frames=int((gaps > 0).sum()),
        eye_spread=1.4826 * float(np.median(np.abs(gaps[gaps > 0] - eyes))) / eyes,
    )


def _adjust_with_features(
    rig: Mapping[str, Camera],
    seen: Mapping[int, FrameSetPoints],
    priors: RigPriors,
    expected: Mapping[str, Camera],
) -> tuple[PointTracks, AdjustedRig]:
    """Fit poses and lenses to landmarks and features, matched anew as the rig gets better."""
    for band in BANDS:
        for scale in FEATURE_SCALES:
            tracks = join_tracks(rig, seen, band)
            points = triangulate_tracks(rig, tracks)
            adjusted = adjust_rig(rig, tracks, points, priors, (scale,), expected=expected)
            rig = adjusted.cameras
    return tracks, adjusted


def _landmark_points(
    cameras: Mapping[str, Camera], seen: Mapping[int, FrameSetPoints]
) -> list[np.ndarray]:
    """Triangulate landmarks (68, 3) of the frame sets in which two cameras see them."""
    found = []
    for points in seen.values():
        views = [(cameras[n], p, 1 / s**2) for n, p, s in points.landmarks if n in cameras]
        if len(views) >= 2:
            rig, pixels, weights = zip(*views, strict=True)
            shape = triangulate(rig, np.stack(pixels), np.stack(weights))
            if np.isfinite(shape).all():
                found.append(shape)
    return found


def _weak(tracks: PointTracks) -> dict[str, str]:
    """Name the cameras that share too few features with two others."""
    features = tracks.select(tracks.features())
    return {
        name: f"shares {count} features with two others, expected {LEAST_POINTS} or more: little"
        " but the face holds it, its pose may be off by degrees"
        for name, count in zip(tracks.names, features.shared_points(), strict=True)
        if count < LEAST_POINTS
    }
