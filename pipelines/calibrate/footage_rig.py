"""Solve a rig without calibration or board from its footage: structure from motion.

A mean head's 68 landmarks give each camera a first pose towards the head, however far apart the
cameras stand. Cameras that see no face are placed by features of points that the rig knows. Then
everything is adjusted together over several frame sets, between which cameras do not move. The
metre comes from the distance between the eyes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import TypeAlias

import cv2
import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera, pinhole, project, triangulate
from express50.geometry.conventions import MIRROR_X
from express50.geometry.sampling import robust_moments
from express50.geometry.transforms import (
    invert_transform,
    make_transform,
    rigid_fit,
    transform_points,
)
from express50.rigs.camera_builder import in_metres
from express50.rigs.world_frame import canonical_from_rig, move_cameras
from pipelines.calibrate.adjuster import AdjustedRig, RigPriors, adjust_rig, triangulate_tracks
from pipelines.calibrate.board_guess import as_model, join_rig, mean_transform
from pipelines.calibrate.config import AUTO
from pipelines.calibrate.tracks import (
    LEAST_INLIERS,
    LEAST_POINTS,
    FrameSetPoints,
    PairMatches,
    PointTracks,
    candidate_matches,
    join_tracks,
    mirrored_cameras,
)
from pipelines.calibrate.uncertainty import HeadError, footage_uncertainty, head_error_of

FACE_SCALES, FEATURE_SCALES = (6.0, 2.0), (3.0, 1.5)  # of Cauchy's loss, in sigmas
BANDS = (0.04, 0.015)
"""How far features may be from their epipolar lines while the rig is still rough, as a share of
the diagonal."""
KNOWN_FOCAL, GUESSED_FOCAL, FOCAL_SPREAD, SAME_LENS = 0.02, 0.6, 0.03, 0.002
"""Standard deviations of log focal lengths. Known ones come from EXIF in whole millimetres. Guessed
ones assume that faces are `calibrate.distance_m` away: a factor of 1.8 either way. The spread is
that of one rig's focal lengths about the mean of pictures as large, and of lenses said to be the
same."""
CENTRE, BEND = 0.005, 0.02
"""Standard deviations of principal points, as a share of the diagonal, and of how far lenses bend
the image's corner, as a share of half of it: footage alone says little about either."""
LOOSE = 0.02  # share of the diagonal: a camera that may be off by more at the head is not placed
OUTLIER = 4.0  # sigmas; features with larger errors are mismatches and not reported
PERSON_M, LEAST_OWN = 0.35, 4  # distance from the head's middle; fewest features within it
EYES = (slice(36, 42), slice(42, 48))
FRONTAL = 0.75  # cosine between the face's direction and that to a camera that must see the face
NOMINAL = 2.5  # focal length, in longer sides, at which distances are first estimated
INNER = slice(17, 68)  # the jaw's outline is not the same skin from every side
BY_CHANCE = 0.025  # share of wrong points that fit a wrong pose, at most
NEAR_DEG = 25.0  # frame sets whose relative pose is further from the mean are wrong
TURNS, TURNED = 5, 0.75
"""Frame sets in which two cameras must see the face for its turns to be compared, and the share of
the disagreement as recorded that is left if a camera is mirrored. Twin, heads turning by 4 degrees:
0.44 to 0.70 for mirrored cameras, 1.45 to 2.48 for others."""
FacePoses: TypeAlias = dict[str, dict[int, tuple[np.ndarray, float]]]
"""Poses cam_from_head (4, 4) and their weights, by camera and frame."""
LONE = (
    "it sees a face, but never at the same time as the other cameras do: add a camera between it"
    " and the next, board images or calibration.json"
)
BY_ROOM = (
    "it sees no face, and what it shares with other cameras lies in the room, not on the person; if"
    " the person moved between pictures, or parts of the room look alike, it is off by far more"
    " than stated, so look at its matte"
)
BLIND = (
    "it sees no face well, and too few of its features match other cameras: add a camera between"
    " it and the next, board images or calibration.json"
)


@dataclass(frozen=True)
class EyeScale:
    """How many metres a unit is by the distance between the eyes."""

    metres: float
    frame_sets: int  # in which it was measured
    spread: float  # its robust standard deviation, as a share


@dataclass(frozen=True)
class FootageSolution:
    """A rig solved from footage, in metres and in the canonical world."""

    cameras: dict[str, Camera]
    tracks: PointTracks
    errors: np.ndarray  # (N, 2) pixels, of the tracks
    inliers: np.ndarray  # (N,) marks the features that are not mismatches
    dropped: dict[str, str]  # a reason per camera
    weak: dict[str, str]  # a reason per camera held by the face alone, or by the room alone
    uncertainty: dict[str, HeadError]
    eyes: EyeScale


def solve_footage(
    seen: Mapping[int, FrameSetPoints],
    sizes: Mapping[str, tuple[int, int]],
    focals: Mapping[str, float],
    where: str,
    *,
    model: str,
    distance_m: float,
    eye_distance_mm: float,
    same_lens: bool = False,
) -> FootageSolution:
    """Solve a rig from points that its cameras saw at the same instants.

    `seen` holds points by frame number; `sizes` are (width, height), `focals` the known focal
    lengths, pixels; `same_lens` says that pictures of one size have one. The other settings are
    those of `CalibrateConfig`; `where` names the capture in errors.

    Raises:
        CalibrationError: fewer than two cameras see one face at one time, so that nothing starts
            the solution and nothing gives the metre.
    """
    head = mean_landmarks()
    # A landmark is off by much the same in every frame set: more of them make it no surer.
    wider = len(seen) ** 0.5
    seen = {
        frame: replace(points, landmarks=[(n, p, s * wider) for n, p, s in points.landmarks])
        for frame, points in seen.items()
    }
    widths = {name: size[0] for name, size in sizes.items()}
    mirrored = mirrored_cameras(seen, widths, combinations(sorted(sizes), 2))
    seen = {frame: points.without(mirrored) for frame, points in seen.items()}
    sizes = {name: size for name, size in sizes.items() if name not in mirrored}
    share = focal_at(distance_m, seen, sizes, head)
    guesses = {n: focals.get(n, share * max(size)) for n, size in sizes.items()}
    lens = "SIMPLE_RADIAL" if model == AUTO else model
    start = {n: as_model(start_camera(n, sizes[n], focal), lens) for n, focal in guesses.items()}
    poses = face_poses(start, seen, head)
    if turned := mirrored_by_faces(poses):
        mirrored |= turned
        seen = {frame: points.without(turned) for frame, points in seen.items()}
        sizes = {n: size for n, size in sizes.items() if n not in turned}
        start = {n: start[n] for n in sizes}
        poses = {n: found for n, found in poses.items() if n in sizes}
    rig = face_rig(start, poses)
    faces = {name for points in seen.values() for name, _, _ in points.landmarks}
    if len(rig) < 2:
        raise CalibrationError(
            f"{where}: has neither calibration.json nor a board, and solving from footage"
            f" needs two cameras that see a face at the same time; a face is seen by"
            f" {', '.join(sorted(faces)) or 'none'}: add calibration.json, or pictures or videos of"
            " a ChArUco board (docs/FORMAT.md), then run 'express50 ingest' again"
        )
    priors = RigPriors(
        focal=KNOWN_FOCAL if all(name in focals for name in sizes) else GUESSED_FOCAL,
        focal_spread=SAME_LENS if same_lens else FOCAL_SPREAD,
        centre=CENTRE,
        bend=BEND,
    )
    tracks, adjusted, expected = _adjust(rig, start, seen, priors)
    shapes = _landmark_points(adjusted.cameras, seen)
    eyes = eye_scale(shapes, 1e-3 * eye_distance_mm, where)
    metric = in_metres(adjusted.cameras, eyes.metres)
    middle = eyes.metres * np.median([p.mean(0) for p in shapes], axis=0)
    up = np.mean([rigid_fit(head, p)[0] for p in shapes], axis=0)[:, 1]
    sigmas = np.linalg.norm(adjusted.errors, axis=1) / tracks.sigma
    away = {n: float(np.linalg.norm(camera.center - middle)) for n, camera in metric.items()}
    inliers = tracks.features() & (sigmas < OUTLIER)
    near = np.linalg.norm(eyes.metres * adjusted.points - middle, axis=1) < PERSON_M
    own = np.bincount(tracks.camera[inliers & near[tracks.point]], minlength=len(tracks.names))
    by_room = {n for n, count in zip(tracks.names, own, strict=True) if count < LEAST_OWN} - faces
    return FootageSolution(
        cameras=move_cameras(metric, canonical_from_rig(metric, middle, up)),
        tracks=tracks,
        errors=adjusted.errors,
        inliers=inliers,
        dropped=mirrored
        | {n: LONE if n in faces else BLIND for n in sorted(sizes) if n not in metric},
        weak=dict.fromkeys(sorted(by_room), BY_ROOM) | _weak(tracks),
        uncertainty={n: head_error_of(metric[n], px**2, away[n]) for n, px in expected.items()},
        eyes=eyes,
    )


def eye_scale(shapes: Sequence[np.ndarray], eye_distance_m: float, where: str) -> EyeScale:
    """Measure the landmarks' (68, 3) unit by the eyes' distance; CalibrationError without eyes."""
    gaps = np.array([np.linalg.norm(p[EYES[0]].mean(0) - p[EYES[1]].mean(0)) for p in shapes])
    gaps = gaps[gaps > 0]
    if len(gaps) == 0:
        raise CalibrationError(
            f"{where}: the eyes cannot be located in space, so nothing gives the metre; add"
            " calibration.json or board images, then run 'express50 ingest' again"
        )
    eyes, spread = map(float, robust_moments(gaps))
    return EyeScale(eye_distance_m / eyes, len(gaps), spread / eyes)


def _adjust(
    rig: dict[str, Camera],
    start: Mapping[str, Camera],
    seen: Mapping[int, FrameSetPoints],
    priors: RigPriors,
) -> tuple[PointTracks, AdjustedRig, dict[str, float]]:
    """Adjust a rig first to landmarks, then to features, and place cameras without a face.

    The last value is the error, pixels, to be expected of each camera at the head.
    """
    candidates = candidate_matches({frame: points.features for frame, points in seen.items()})

    def with_features(
        rig: dict[str, Camera], bands: Sequence[float]
    ) -> tuple[PointTracks, AdjustedRig]:
        for band in bands:
            for scale in FEATURE_SCALES:
                tracks = join_tracks(rig, seen, band, candidates)  # again, as the rig gets better
                points = triangulate_tracks(rig, tracks)
                fit = adjust_rig(rig, tracks, points, priors, (scale,), expected=start)
                rig = fit.cameras
        return tracks, fit

    bare = {frame: FrameSetPoints(points.landmarks, {}) for frame, points in seen.items()}
    tracks = join_tracks(rig, bare, BANDS[0])
    fit = adjust_rig(rig, tracks, triangulate_tracks(rig, tracks), RigPriors(), FACE_SCALES)
    tracks, fit = with_features(fit.cameras, BANDS)
    refused = set[str]()
    while others := {n: c for n, c in start.items() if n not in fit.cameras and n not in refused}:
        more = place_by_features(fit, tracks, others, seen, candidates)
        if not (more := _showing_head(more, fit.cameras, seen)):
            break
        wider, wide = with_features(fit.cameras | more, BANDS[:1])
        expected = _expected(wide, wider, seen, priors)
        held = set(_showing_head(wide.cameras, wide.cameras, seen)) - set(_weak(wider))
        loose = {
            n: expected[n] / float(np.hypot(start[n].width, start[n].height))
            if n in held
            else np.inf
            for n in more
        }
        worst = max(loose, key=lambda n: (loose[n], n))
        if loose[worst] < LOOSE:
            tracks, fit = with_features(wide.cameras, BANDS)
        else:  # it may be what makes the others loose: they are tried again
            refused.add(worst)
    return tracks, fit, _expected(fit, tracks, seen, priors)


def _showing_head(
    found: Mapping[str, Camera], rig: Mapping[str, Camera], seen: Mapping[int, FrameSetPoints]
) -> dict[str, Camera]:
    """Return the cameras whose pictures show the middle of the head that a rig sees.

    A camera without a face does not stand in front of it: such a pose comes from features that only
    look alike, as on the two walls of a corridor.
    """
    shapes = _landmark_points(rig, seen)
    middle = np.median(shapes, axis=(0, 1))
    head = mean_landmarks()
    forward = np.mean([rigid_fit(head, shape)[0][:, 2] for shape in shapes], axis=0)
    faces = {name for points in seen.values() for name, _, _ in points.landmarks}
    showing = {}
    for name, camera in found.items():
        pixels, _ = project(pinhole(camera), middle[None])
        inside = ((pixels > 0) & (pixels < (camera.width, camera.height))).all()
        towards = camera.center - middle
        frontal = forward @ towards > FRONTAL * np.linalg.norm(forward) * np.linalg.norm(towards)
        if inside and (name in faces or not frontal):
            showing[name] = camera
    return showing


def _expected(
    fit: AdjustedRig, tracks: PointTracks, seen: Mapping[int, FrameSetPoints], priors: RigPriors
) -> dict[str, float]:
    faces = np.stack(_landmark_points(fit.cameras, seen))
    radius = 1.5 * float(np.median(np.linalg.norm(faces - faces.mean(1, keepdims=True), axis=2)))
    middle = np.median(faces.mean(1), axis=0)
    found = footage_uncertainty(fit, tracks, priors, FEATURE_SCALES[-1], middle, radius)
    # Errors that stay the same in every frame set do not average out: all sets count as one.
    return {name: px * len(seen) ** 0.5 for name, px in found.items()}


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
    features = tracks.select(tracks.features())
    return {
        name: f"it shares {count} features with two other cameras, expected {LEAST_POINTS} or more:"
        " its pose depends almost only on the face"
        for name, count in zip(tracks.names, features.shared_points(), strict=True)
        if count < LEAST_POINTS
    }


def mean_landmarks() -> np.ndarray:
    """Return the landmarks (68, 3) of the built-in mean head, metres, head space."""
    # Imported here: only rigs that come without any calibration need a head.
    from express50.head.load import load_builtin
    from express50.head.model import landmarks_of

    return landmarks_of(load_builtin()).astype(np.float64)


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
    """Return the focal length, in longer sides, with which faces stand at a distance (median)."""
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

    The error is infinite if no pose puts the head in front of the camera.
    """
    ideal = (points - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    shape, xy, eye = head[INNER], ideal[INNER], np.eye(3)
    try:
        _, turn, shift = cv2.solvePnP(shape, xy, eye, None, flags=cv2.SOLVEPNP_SQPNP)
        turn, shift = cv2.solvePnPRefineLM(shape, xy, eye, None, turn, shift)
    except cv2.error:  # landmarks on one spot
        return np.eye(4), float("inf")
    pose = make_transform(cv2.Rodrigues(turn)[0], shift.ravel())
    placed = transform_points(pose, shape)
    if not (np.isfinite(pose).all() and placed[:, 2].min() > 0):
        return np.eye(4), float("inf")
    off = np.linalg.norm(placed[:, :2] / placed[:, 2:] - xy, axis=1) * camera.K[0, 0]
    return pose, float(np.sqrt(np.mean((off / sigma[INNER]) ** 2)))


def face_poses(
    cameras: Mapping[str, Camera], seen: Mapping[int, FrameSetPoints], head: np.ndarray
) -> FacePoses:
    """Estimate the faces' poses in each camera that sees any."""
    poses: FacePoses = {}
    for frame, points in seen.items():
        for name, pixels, sigma in points.landmarks:
            pose, error = pose_of_face(pixels, sigma, cameras[name], head)
            if np.isfinite(error):
                poses.setdefault(name, {})[frame] = (pose, 1 / (1 + error**2))
    return poses


def mirrored_by_faces(poses: FacePoses) -> dict[str, str]:
    """Return which cameras see heads turn the other way than others do, with the reason.

    While heads turn, the rotation from one camera to another stays the same only if both or neither
    are mirrored. Nothing is found if heads keep still, or if half of the cameras would be named.
    """
    # By how many degrees (2,) a camera's rotation to others varies over frame sets, for its
    # pictures as recorded and mirrored: medians over two or more cameras.
    varying: dict[str, list[np.ndarray]] = {}
    for name, other in permutations(sorted(poses), 2):
        shared = sorted(set(poses[name]) & set(poses[other]))
        if len(shared) < TURNS:
            continue
        own, theirs = (np.stack([poses[n][frame][0] for frame in shared]) for n in (name, other))
        ways = [own @ np.linalg.inv(theirs), MIRROR_X @ own @ MIRROR_X @ np.linalg.inv(theirs)]
        turns = [_turns(votes, mean_transform(votes, np.ones(len(votes)))) for votes in ways]
        varying.setdefault(name, []).append(np.sqrt(np.mean(np.square(turns), axis=1)))
    spreads = {name: np.median(rows, axis=0) for name, rows in varying.items() if len(rows) >= 2}
    found = {}
    for name, (recorded, turned) in spreads.items():
        usual = np.median([spread[0] for other, spread in spreads.items() if other != name])
        if turned < TURNED * recorded and usual < TURNED * recorded:
            found[name] = (
                "heads turn the other way in its pictures than in other cameras' (they disagree by"
                f" {recorded:.1f} degrees as recorded, by {turned:.1f} if mirrored): switch"
                " mirroring off where they are recorded, or mirror the files"
            )
    return found if 2 * len(found) < len(spreads) else {}


def _turns(transforms: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the angles (N,), degrees, between rotations of transforms (N, 4, 4) and of one."""
    traces = np.trace(transforms[:, :3, :3] @ mean[:3, :3].T, axis1=1, axis2=2)
    return np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


def face_rig(cameras: Mapping[str, Camera], poses: FacePoses) -> dict[str, Camera]:
    """Pose the largest group of cameras that see faces in common frame sets."""
    edges = {}
    for a, b in combinations(sorted(poses), 2):
        shared = sorted(set(poses[a]) & set(poses[b]))
        if not shared:
            continue
        votes = np.stack([poses[b][f][0] @ invert_transform(poses[a][f][0]) for f in shared])
        weights = np.array([poses[a][f][1] * poses[b][f][1] for f in shared])
        mean = mean_transform(votes, weights)
        near = _turns(votes, mean) < NEAR_DEG
        if near.any():
            mean = mean_transform(votes[near], weights[near])
        edges[a, b] = mean, float(max(weights[near].sum(), 1e-9))
    placed = join_rig(sorted(poses), edges) if edges else {}
    return {name: replace(cameras[name], cam_from_world=T) for name, T in placed.items()}


def place_by_features(
    fit: AdjustedRig,
    tracks: PointTracks,
    others: Mapping[str, Camera],
    seen: Mapping[int, FrameSetPoints],
    candidates: PairMatches,
) -> dict[str, Camera]:
    """Place `others`, which see no face, by features that look like points of an adjusted rig.

    Their focal length becomes the rig's median. `candidates` are the matches of all features.
    """
    sure = tracks.features() & (np.linalg.norm(fit.errors, axis=1) < OUTLIER * tracks.sigma)
    place = {
        (tracks.names[tracks.camera[row]], tracks.pixels[row].tobytes()): fit.points[
            tracks.point[row]
        ]
        for row in np.flatnonzero(sure)
    }
    known = {
        (frame, name): np.array(
            [place.get((name, pixel.tobytes()), np.full(3, np.nan)) for pixel in found[0]]
        ).reshape(-1, 3)
        for frame, points in seen.items()
        for name, found in points.features.items()
        if name in fit.cameras
    }
    shares = [c.K[0, 0] / max(c.width, c.height) for c in fit.cameras.values()]
    placed = {}
    for name, camera in sorted(others.items()):
        pairs = [np.zeros((0, 5))]
        for (frame, other), at in known.items():
            first, second = sorted((name, other))
            matches = candidates[first, second].get(frame)
            if matches is not None:
                mine, theirs = matches.T if first == name else matches.T[::-1]
                pairs.append(np.column_stack([seen[frame].features[name][0][mine], at[theirs]]))
        rows = np.concatenate(pairs)
        focal = float(np.median(shares)) * max(camera.width, camera.height)
        lens = as_model(start_camera(name, (camera.width, camera.height), focal), camera.model)
        pose = resect(rows[np.isfinite(rows).all(1)], lens.K)
        if pose is not None:
            placed[name] = replace(lens, cam_from_world=pose)
    return placed


def resect(pairs: np.ndarray, K: np.ndarray) -> np.ndarray | None:
    """Estimate a pose (4, 4) from rows (M, 5) of a pixel and a point; None if too few agree."""
    # A point comes once for every camera that knows it: samples must not repeat it.
    rows = np.unique(pairs, axis=0)
    if len(np.unique(rows[:, :2], axis=0)) < LEAST_INLIERS:
        return None
    pixels, points = np.ascontiguousarray(rows[:, :2]), np.ascontiguousarray(rows[:, 2:])
    try:
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            points, pixels, K, None, iterationsCount=10_000, reprojectionError=4.0,
            confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
    except cv2.error:  # points on a line or on one spot
        return None
    good = inliers[:, 0] if ok and inliers is not None else np.zeros(0, int)
    distinct = min(len(np.unique(column[good], axis=0)) for column in (pixels, points))
    if distinct < LEAST_INLIERS + BY_CHANCE * len(rows):
        return None
    return make_transform(cv2.Rodrigues(turn)[0], shift.ravel())
