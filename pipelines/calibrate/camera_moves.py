"""Do cameras still fit the footage? A bumped camera is found, named and measured.

Points that several cameras see are triangulated. For every camera it is asked how much better all
would fit if it alone had moved; the one that explains most is taken to have moved, and the rest
are asked again. So a bump is not blamed on the neighbours whose points it bends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import cv2
import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera, pinhole, project, resized
from express50.geometry.transforms import matrix_to_axis_angle
from express50.landmarks.network import LandmarkNet
from pipelines.calibrate.adjust import Fit, cost, fit_poses, lone_steps, triangulate_tracks
from pipelines.calibrate.adjust import with_poses as at_poses
from pipelines.calibrate.tracks import Tracks, join_tracks, look

LONG_SIDE = 1280
"""Images are looked at no larger than this, pixels."""
BANDS = ((0.1, 0.015), (0.02, 0.003))
"""Features are matched this near to where the cameras say, and pictures must have shifted at
least so far for a camera to be named, both as a share of the diagonal; bumps of degrees first."""
LEAST_POINTS = 20
"""Points that a camera must share with two or more others to be checked."""
LEAST_GAIN = 30.0
"""Drop of the robust cost that a moved camera must explain (noise alone: half a chi-square of
six, under 15), and ..."""
GAIN_RATIO = 4.0
"""... how many times that of the median camera left, whose drop tells the rig's own error."""
SUSPECTS = 3
"""Cameras tried in earnest for each that is found."""


@dataclass(frozen=True)
class Move:
    """How a camera seems to have moved since it was calibrated.

    Rotation and translation trade places at a head's distance; the shift of the picture is what is
    measured, and what matters.
    """

    shift_px: float
    turn_deg: float
    move_mm: float


@dataclass(frozen=True)
class FootageVerdict:
    """What footage says of its cameras.

    Attributes:
        points: points seen by two cameras or more.
        error_px: median distance of the features from where the cameras say.
        moved: cameras that have moved, the surest first.
        unchecked: cameras that share too little with others, with the reason.
        cameras: the cameras, those that have moved put right.
    """

    points: int
    error_px: float
    moved: dict[str, Move]
    unchecked: dict[str, str]
    cameras: dict[str, Camera]

    def figures(self) -> dict[str, object]:
        """Everything but the cameras, as plain values."""
        return {
            "points": self.points,
            "error_px": self.error_px if np.isfinite(self.error_px) else None,
            "moved": {name: asdict(move) for name, move in self.moved.items()},
            "unchecked": self.unchecked,
        }


def check_footage(
    cameras: Mapping[str, Camera],
    frames: Mapping[int, Mapping[str, np.ndarray]],
    net: LandmarkNet | None,
) -> FootageVerdict:
    """Check cameras against images taken at the same moments.

    Args:
        cameras: the calibration; at least three cameras.
        frames: by frame number, the image (H, W, 3) uint8 of every camera, as recorded.
        net: landmark network, which ties cameras that are far apart; None to do without.

    Raises:
        CalibrationError: fewer than three cameras, or an image is not of its camera's size.
    """
    if len(cameras) < 3:
        raise CalibrationError(
            f"{len(cameras)} cameras; three or more are needed to say which one has moved"
        )
    small, pictures = reduce_images(cameras, frames)
    now, suspects = small, []
    seen = {frame: look(small, images, net) for frame, images in pictures.items()}
    for band, least in BANDS:
        tracks = join_tracks(now, seen, band)
        now, found = _move_until_quiet(now, tracks, least)
        suspects += [name for name in found if name not in suspects]
    points = triangulate_tracks(now, tracks)
    fit = fit_poses(now, tracks, points, ())
    errors = np.linalg.norm(fit.normal.errors, axis=1)
    corrected = at_poses(
        cameras, tracks, np.stack([now[name].cam_from_world for name in tracks.names])
    )
    return FootageVerdict(
        points=len(points),
        error_px=float(np.median(errors)) if len(errors) else float("nan"),
        moved={n: _move(cameras[n], corrected[n], fit, tracks) for n in suspects},
        unchecked=_unchecked(tracks),
        cameras=corrected,
    )


def reduce_images(
    cameras: Mapping[str, Camera], frames: Mapping[int, Mapping[str, np.ndarray]]
) -> tuple[dict[str, Camera], dict[int, dict[str, np.ndarray]]]:
    """Cameras and images with a long side of `LONG_SIDE` at most."""
    small = {name: reduced_camera(camera) for name, camera in cameras.items()}
    pictures = {
        frame: {
            name: reduce_image(cameras[name], image, f"frame {frame}")
            for name, image in images.items()
        }
        for frame, images in frames.items()
    }
    return small, pictures


def reduced_camera(camera: Camera) -> Camera:
    """The camera of an image with a long side of `LONG_SIDE` at most."""
    share = min(1.0, LONG_SIDE / max(camera.width, camera.height))
    size = round(camera.width * share), round(camera.height * share)
    return camera if share == 1.0 else resized(camera, *size)


def reduce_image(camera: Camera, image: np.ndarray, what: str) -> np.ndarray:
    """A camera's image (H, W, 3) in the size of `reduced_camera`; one already so passes.

    Reducing each image as it is read keeps a rig's full-size images out of memory.
    """
    small = reduced_camera(camera)
    shape = image.shape[:2]
    if shape == (small.height, small.width):
        return image
    if shape != (camera.height, camera.width):
        raise CalibrationError(
            f"camera {camera.id}: {what} is {shape[1]}x{shape[0]}, the "
            f"camera is {camera.width}x{camera.height}; scale the intrinsics"
        )
    return cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)


def _move_until_quiet(
    cameras: Mapping[str, Camera], tracks: Tracks, least_share: float
) -> tuple[dict[str, Camera], list[str]]:
    """Free one camera after the other while that explains enough; at most a third of the rig.

    `least_share` is the least shift of a moved camera's picture, as a share of its diagonal.
    """
    free: tuple[str, ...] = ()
    points = triangulate_tracks(cameras, tracks)
    fit = fit_poses(cameras, tracks, points, free)
    while len(free) < max(1, len(cameras) // 3):
        better = [
            (cost(found, tracks), name, found)
            for name in _suspects(fit, tracks, free)
            if (found := fit_poses(cameras, tracks, points, (*free, name)))
        ]
        if not better:
            break
        least, name, found = min(better, key=lambda row: row[:2])
        camera = cameras[name]
        moved = at_poses(cameras, tracks, found.poses)[name]
        if picture_shift(camera, moved, found, tracks) < least_share * diagonal(camera):
            break
        quiet = float(np.median(gains(found, tracks, (*free, name))))
        if cost(fit, tracks) - least < max(LEAST_GAIN, GAIN_RATIO * quiet):
            break
        free, fit = (*free, name), found
    return at_poses(cameras, tracks, fit.poses), list(free)


def _suspects(fit: Fit, tracks: Tracks, free: tuple[str, ...]) -> list[str]:
    """The cameras that explain most on their own; the neighbours of the right one come close."""
    gain, shared = gains(fit, tracks, free), shared_points(tracks)
    enough = (shared >= LEAST_POINTS) & (gain >= 0.5 * LEAST_GAIN)
    order = [i for i in np.argsort(-gain, kind="stable") if enough[i]]
    return [tracks.names[i] for i in order if tracks.names[i] not in free][:SUSPECTS]


def gains(fit: Fit, tracks: Tracks, free: tuple[str, ...]) -> np.ndarray:
    """How much (C,) the cost would fall if each camera alone were freed, to first order."""
    steps = lone_steps(fit, tuple(tracks.names.index(name) for name in free))
    return 0.5 * np.sum(fit.normal.b.reshape(-1, 6) * steps, axis=1)


def shared_points(tracks: Tracks) -> np.ndarray:
    """How many points (C,) each camera sees together with two others: fewer cannot accuse it."""
    seen = np.bincount(tracks.point, minlength=1)
    return np.bincount(tracks.camera[seen[tracks.point] >= 3], minlength=len(tracks.names))


def _unchecked(tracks: Tracks) -> dict[str, str]:
    return {
        name: f"shares {count} points with two others, expected {LEAST_POINTS} or more"
        for name, count in zip(tracks.names, shared_points(tracks), strict=True)
        if count < LEAST_POINTS
    }


def _move(before: Camera, after: Camera, fit: Fit, tracks: Tracks) -> Move:
    turn = after.cam_from_world[:3, :3] @ before.cam_from_world[:3, :3].T
    return Move(
        shift_px=picture_shift(before, after, fit, tracks),
        turn_deg=float(np.degrees(np.linalg.norm(matrix_to_axis_angle(turn)))),
        move_mm=1e3 * float(np.linalg.norm(after.center - before.center)),
    )


def picture_shift(before: Camera, after: Camera, fit: Fit, tracks: Tracks) -> float:
    """Median length, pixels, by which what a camera sees shifts between two of its poses."""
    seen = fit.points[tracks.point[tracks.camera == tracks.names.index(before.id)]]
    old, new = (project(pinhole(camera), seen)[0] for camera in (before, after))
    length = np.linalg.norm(new - old, axis=1)
    length = length[np.isfinite(length)]
    return float(np.median(length)) if len(length) else 0.0


def diagonal(camera: Camera) -> float:
    """Length of an image's diagonal, pixels."""
    return float(np.hypot(camera.width, camera.height))
