"""A rig without calibration or board, solved from its footage: structure from motion.

The face starts it (`faces`), features that look alike in neighbouring cameras make it precise, and
everything is adjusted at once over several moments. Cameras do not move between moments, so points
of all moments tie the same poses. The metre comes from the distance between the eyes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera, triangulate
from express50.geometry.transforms import rigid_fit
from express50.rigs.world_frame import canonical_from_rig, move_cameras
from pipelines.calibrate.adjust import triangulate_tracks
from pipelines.calibrate.adjuster import ITERATIONS, Adjusted, Freedom, adjust_rig
from pipelines.calibrate.camera_moves import LEAST_POINTS, shared_points
from pipelines.calibrate.config import AUTO, CalibrateConfig
from pipelines.calibrate.faces import face_rig, focal_at, mean_landmarks, start_camera
from pipelines.calibrate.intrinsics import as_model
from pipelines.calibrate.placing import LEAST_INLIERS, place_others
from pipelines.calibrate.tracks import (
    FEATURE_SIGMA_PX,
    Seen,
    Tracks,
    join_verified,
    tracks_of,
    undistorted,
)

FACE_SCALES, FEATURE_SCALES = (6.0, 2.0), (3.0, 1.5)
"""Cauchy scales of the adjustments, in expected errors, wide ones first."""
BANDS = (0.04, 0.015)
"""How far from their epipolar lines features may be while the rig is still rough, as a share of
the diagonal."""
KNOWN_FOCAL, GUESSED_FOCAL = 0.02, 0.3
"""How far focal lengths that were told, and that were guessed, may be off."""
CENTRE, BEND = 0.005, 0.02
"""How far principal points are from the middle, and how far lenses bend the image's corner, as
shares of the diagonal and half of it: footage alone hardly tells either."""
OUTLIER = 4.0
"""Errors, in expected ones, that count as mismatches in what is reported."""
EYES = (slice(36, 42), slice(42, 48))


@dataclass(frozen=True)
class Structure:
    """A rig solved from footage, in metres and in the canonical world.

    Attributes:
        cameras: those that could be placed.
        tracks: what they were solved from, undistorted.
        errors: (N, 2) pixels, one row a track's.
        dropped: the other cameras, with the reason.
        weak: cameras that share few features with two others: only the face holds them.
        eye_moments: moments at which the distance of the eyes was measured.
        eye_spread: robust standard deviation of that distance over them, as a share of it.
    """

    cameras: dict[str, Camera]
    tracks: Tracks
    errors: np.ndarray
    dropped: dict[str, str]
    weak: dict[str, str]
    eye_moments: int
    eye_spread: float


def solve_footage(
    seen: Mapping[int, Seen],
    sizes: Mapping[str, tuple[int, int]],
    focals: Mapping[str, float],
    config: CalibrateConfig,
    where: str,
) -> Structure:
    """Solve a rig from what its cameras saw at the same moments.

    Args:
        seen: by frame number, landmarks and features in recorded pixels.
        sizes: (width, height) of each camera, pixels.
        focals: focal lengths in pixels, as told by EXIF or capture.toml, of cameras that have one.
        config: lens model, and what is assumed of distances.
        where: the capture, for messages.

    Raises:
        CalibrationError: fewer than two cameras see one face at one time, so that nothing starts
            the solution and nothing tells the metre.
    """
    head = mean_landmarks()
    start = _start_cameras(seen, sizes, focals, config, head)
    rig = face_rig(start, seen, head)
    if len(rig) < 2:
        _refuse(seen, where)
    dropped = _without_face(sizes, seen, rig)
    told = all(name in focals for name in sizes)
    freedom = Freedom(
        focal=KNOWN_FOCAL if told else GUESSED_FOCAL,
        focal_spread=config.focal_spread,
        centre=CENTRE,
        bend=BEND,
    )
    rig = _settle(rig, seen)
    rig, tracks, adjusted = _sharpen(rig, seen, freedom)
    more = place_others(rig, {n: start[n] for n in dropped}, undistorted(seen, rig), seen)
    if more:
        rig, tracks, adjusted = _sharpen(rig | more, seen, freedom)
        loose = set(_weak(tracks)) & set(more)  # neither a face nor features hold these
        if loose:
            rig = {name: camera for name, camera in rig.items() if name not in loose}
            rig, tracks, adjusted = _sharpen(rig, seen, freedom)
    metric, moments, spread = _metric(rig, seen, config.eye_distance_mm * 1e-3, where)
    return Structure(
        cameras=move_cameras(metric, canonical_from_rig(metric, *_head_pose(metric, seen, head))),
        tracks=tracks,
        errors=adjusted.errors,
        dropped={n: why for n, why in sorted(dropped.items()) if n not in rig},
        weak=_weak(tracks),
        eye_moments=moments,
        eye_spread=spread,
    )


def _start_cameras(
    seen: Mapping[int, Seen],
    sizes: Mapping[str, tuple[int, int]],
    focals: Mapping[str, float],
    config: CalibrateConfig,
    head: np.ndarray,
) -> dict[str, Camera]:
    """Cameras at the origin with focal lengths that are told, or that put faces so far away."""
    share = focal_at(config.distance_m, seen, sizes, head)
    model = "SIMPLE_RADIAL" if config.camera_model == AUTO else config.camera_model
    return {
        name: as_model(start_camera(name, size, focals.get(name, share * max(size))), model)
        for name, size in sizes.items()
    }


def _refuse(seen: Mapping[int, Seen], where: str) -> NoReturn:
    faces = sorted({name for moment in seen.values() for name, _, _ in moment.landmarks})
    raise CalibrationError(
        f"{where}: has neither calibration.json nor board images, and to solve its cameras from"
        f" footage two or more must see a face at the same time; a face is seen by"
        f" {', '.join(faces) or 'none'}: add calibration.json or board/<camera>/*.png with"
        " board.toml, then run 'express50 ingest' again"
    )


def _without_face(
    sizes: Mapping[str, object], seen: Mapping[int, Seen], rig: Mapping[str, Camera]
) -> dict[str, str]:
    faces = {name for moment in seen.values() for name, _, _ in moment.landmarks}
    lone = "it sees a face, but at no moment together with the cameras of the largest group"
    blind = (
        f"it sees no face well, and fewer than {LEAST_INLIERS} of its features fit points that two"
        " other cameras know: add board images or calibration.json"
    )
    return {name: lone if name in faces else blind for name in sizes if name not in rig}


def _settle(rig: dict[str, Camera], seen: Mapping[int, Seen]) -> dict[str, Camera]:
    """Poses that fit the landmarks, with free points and the lenses as they are."""
    bare = {f: Seen(moment.landmarks, {}) for f, moment in undistorted(seen, rig).items()}
    tracks = tracks_of(rig, bare, {})
    points = triangulate_tracks(rig, tracks)
    for scale in FACE_SCALES:
        found = adjust_rig(rig, tracks, points, Freedom(), scale, ITERATIONS)
        rig, points = found.cameras, found.points
    return rig


def _sharpen(
    rig: dict[str, Camera], seen: Mapping[int, Seen], freedom: Freedom
) -> tuple[dict[str, Camera], Tracks, Adjusted]:
    """Poses and lenses that fit landmarks and features, matched anew as the rig gets better."""
    for band in BANDS:
        for scale in FEATURE_SCALES:
            tracks = join_verified(rig, undistorted(seen, rig), band)
            points = triangulate_tracks(rig, tracks)
            adjusted = adjust_rig(rig, tracks, points, freedom, scale, ITERATIONS)
            rig = adjusted.cameras
    return rig, tracks, adjusted


def _landmark_points(
    cameras: Mapping[str, Camera], seen: Mapping[int, Seen]
) -> dict[int, np.ndarray]:
    """Landmarks (68, 3) in the world, of moments at which two cameras see them."""
    found = {}
    for frame, moment in seen.items():
        views = [(cameras[n], p, 1 / s**2) for n, p, s in moment.landmarks if n in cameras]
        if len(views) >= 2:
            rig, pixels, weights = zip(*views, strict=True)
            points = triangulate(rig, np.stack(pixels), np.stack(weights))
            if np.isfinite(points).all():
                found[frame] = points
    return found


def _metric(
    cameras: Mapping[str, Camera], seen: Mapping[int, Seen], eyes_m: float, where: str
) -> tuple[dict[str, Camera], int, float]:
    """The rig in metres, the moments that told the scale, and how far they disagree."""
    gaps = np.array(
        [
            np.linalg.norm(points[EYES[0]].mean(0) - points[EYES[1]].mean(0))
            for points in _landmark_points(cameras, seen).values()
        ]
    )
    gaps = gaps[np.isfinite(gaps) & (gaps > 0)]
    if len(gaps) == 0:
        raise CalibrationError(
            f"{where}: the eyes cannot be located in space, so nothing tells the metre; add"
            " calibration.json or board images, then run 'express50 ingest' again"
        )
    middle = float(np.median(gaps))
    spread = 1.4826 * float(np.median(np.abs(gaps - middle))) / middle
    scale = np.diag([eyes_m / middle] * 3 + [1.0])
    metric = {}
    for name, camera in cameras.items():
        pose = camera.cam_from_world.copy()
        pose[:3, 3] = scale[:3, :3] @ pose[:3, 3]
        metric[name] = replace(camera, cam_from_world=pose)
    return metric, len(gaps), spread


def _head_pose(
    cameras: Mapping[str, Camera], seen: Mapping[int, Seen], head: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Middle of the head (3,) and its upward direction (3,), over all moments."""
    fits = [(p.mean(0), rigid_fit(head, p)[0]) for p in _landmark_points(cameras, seen).values()]
    middles, turns = zip(*fits, strict=True)
    return np.median(middles, axis=0), np.mean(turns, axis=0)[:, 1]


def _weak(tracks: Tracks) -> dict[str, str]:
    features = tracks.select(tracks.sigma == FEATURE_SIGMA_PX)
    return {
        name: f"shares {count} features with two others, expected {LEAST_POINTS} or more: little"
        " but the face holds it, its pose may be off by degrees"
        for name, count in zip(tracks.names, shared_points(features), strict=True)
        if count < LEAST_POINTS
    }


def inliers(structure: Structure) -> np.ndarray:
    """Which features (N,) of a structure are no mismatches."""
    size = np.linalg.norm(structure.errors, axis=1) / structure.tracks.sigma
    return (structure.tracks.sigma == FEATURE_SIGMA_PX) & (size < OUTLIER)
