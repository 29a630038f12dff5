"""Find cameras that have moved since they were calibrated, from footage.

Points that several cameras see are triangulated. For every camera the fit is repeated with that
camera free; the one that explains most has moved, and the rest are tried again. So a bump is not
blamed on the neighbours whose points it bends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera, pinhole, project
from express50.geometry.transforms import matrix_to_axis_angle
from express50.landmarks.network import LandmarkNet
from pipelines.calibrate.adjuster import (
    AdjustedRig,
    RigPriors,
    adjust_rig,
    single_camera_gains,
    triangulate_tracks,
)
from pipelines.calibrate.footage import reduce_image, reduced_camera
from pipelines.calibrate.tracks import LEAST_POINTS, PointTracks, find_points, join_tracks

BANDS = ((0.1, 0.015), (0.02, 0.003))
"""Two passes, bumps of degrees first: how far matches may be from their epipolar lines, and how far
a camera's picture must have shifted, both as shares of the diagonal."""
LEAST_GAIN, GAIN_RATIO = 30.0, 4.0
"""Freeing a moved camera must lower the robust cost by this much (noise alone: half a chi-square
of six, under 15), and by so many times what the median other camera would."""
PRIORS = RigPriors(turn_rad=np.radians(1.0), move_m=0.01)
SCALES, ITERATIONS = (6.0, 3.0, 1.5), 4
"""Residuals flatten at this many sigmas. A camera that is off by a few pixels bends the points it
shares, and must not be rejected together with the mismatches. Four iterations per scale separate
a moved camera; running to convergence costs thirty times as long and names the same ones."""


@dataclass(frozen=True)
class CameraMove:
    """The estimated motion of a camera since it was calibrated.

    Rotation and translation trade places at a head's distance; the shift of the picture is what is
    measured.
    """

    shift_px: float
    turn_deg: float
    move_mm: float


@dataclass(frozen=True)
class FootageCheck:
    """The result of checking cameras against footage.

    Attributes:
        points: points seen by two cameras or more.
        error_px: median reprojection error; None without points.
        moved: cameras that have moved, the surest first.
        unchecked: cameras that share too few points with others, with the reason.
        cameras: the cameras, with corrected poses of those that have moved.
    """

    points: int
    error_px: float | None
    moved: dict[str, CameraMove]
    unchecked: dict[str, str]
    cameras: dict[str, Camera]


def check_footage(
    cameras: Mapping[str, Camera],
    frames: Mapping[int, Mapping[str, np.ndarray]],
    net: LandmarkNet | None,
) -> FootageCheck:
    """Check cameras against images taken at the same instants.

    Args:
        cameras: the calibration; at least three cameras.
        frames: by frame number, the image (H, W, 3) uint8 of every camera, as recorded or reduced.
        net: landmark network, which ties cameras that are far apart; None to do without.

    Raises:
        CalibrationError: fewer than three cameras, or an image is not of its camera's size.
    """
    if len(cameras) < 3:
        raise CalibrationError(
            f"{len(cameras)} cameras; three or more are needed to say which one has moved"
        )
    now = {name: reduced_camera(camera) for name, camera in cameras.items()}
    moved: list[str] = []
    seen = {}
    for frame, images in frames.items():
        small = {n: reduce_image(cameras[n], i, f"frame {frame}") for n, i in images.items()}
        seen[frame] = find_points(small, net)
    for band, least_shift in BANDS:
        tracks = join_tracks(now, seen, band, verified=False)
        now, found = _free_moved_cameras(now, tracks, least_shift)
        moved += [name for name in found if name not in moved]
    fit = _fit(now, tracks, triangulate_tracks(now, tracks), ())
    errors = np.linalg.norm(fit.errors, axis=1)
    corrected = {n: replace(c, cam_from_world=now[n].cam_from_world) for n, c in cameras.items()}
    moves = {}
    for name in moved:
        before, after = cameras[name], corrected[name]
        turn = after.cam_from_world[:3, :3] @ before.cam_from_world[:3, :3].T
        moves[name] = CameraMove(
            shift_px=_picture_shift(before, after, fit, tracks),
            turn_deg=float(np.degrees(np.linalg.norm(matrix_to_axis_angle(turn)))),
            move_mm=1e3 * float(np.linalg.norm(after.center - before.center)),
        )
    return FootageCheck(
        points=len(fit.points),
        error_px=float(np.median(errors)) if len(errors) else None,
        moved=moves,
        unchecked={
            name: f"shares {count} points with two others, expected {LEAST_POINTS} or more"
            for name, count in zip(tracks.names, tracks.shared_points(), strict=True)
            if count < LEAST_POINTS
        },
        cameras=corrected,
    )


def _free_moved_cameras(
    cameras: Mapping[str, Camera], tracks: PointTracks, least_shift: float
) -> tuple[dict[str, Camera], list[str]]:
    """Free one camera after the other while that explains enough; at most a third of the rig.

    The first-order gain does not tell a moved camera from its neighbours where few cameras see
    each other. So the three with the largest gain are each freed in a fit of their own.
    """
    points = triangulate_tracks(cameras, tracks)
    free: tuple[str, ...] = ()
    fit = _fit(cameras, tracks, points, free)
    while len(free) < max(1, len(cameras) // 3):
        gain = single_camera_gains(fit, tracks, PRIORS, SCALES[-1], free)
        enough = (tracks.shared_points() >= LEAST_POINTS) & (gain >= 0.5 * LEAST_GAIN)
        likely = [tracks.names[i] for i in np.argsort(-gain, kind="stable") if enough[i]]
        tried = {
            name: _fit(cameras, tracks, points, (*free, name))
            for name in [n for n in likely if n not in free][:3]
        }
        if not tried:
            break
        name = min(tried, key=lambda name: (tried[name].cost, name))
        found, camera = tried[name], cameras[name]
        shift = _picture_shift(camera, found.cameras[name], found, tracks)
        others = single_camera_gains(found, tracks, PRIORS, SCALES[-1], (*free, name))
        needed = max(LEAST_GAIN, GAIN_RATIO * float(np.median(others)))
        if shift < least_shift * np.hypot(camera.width, camera.height):
            break
        if fit.cost - found.cost < needed:
            break
        free, fit = (*free, name), found
    return fit.cameras, list(free)


def _fit(
    cameras: Mapping[str, Camera], tracks: PointTracks, points: np.ndarray, free: tuple[str, ...]
) -> AdjustedRig:
    return adjust_rig(cameras, tracks, points, PRIORS, SCALES, free, ITERATIONS)


def _picture_shift(before: Camera, after: Camera, fit: AdjustedRig, tracks: PointTracks) -> float:
    """Median length, pixels, by which a camera's picture shifts between two of its poses."""
    seen = fit.points[tracks.point[tracks.camera == tracks.names.index(before.id)]]
    old, new = (project(pinhole(camera), seen)[0] for camera in (before, after))
    length = np.linalg.norm(new - old, axis=1)
    length = length[np.isfinite(length)]
    return float(np.median(length)) if len(length) else 0.0
