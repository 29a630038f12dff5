"""Given cameras put right: adjusted to the board, or to the footage, where that makes them better.

What part of the observations is held out judges: cameras are only replaced where points that the
adjustment never saw fit clearly better.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import (
    invert_transform,
    make_transform,
    matrix_to_axis_angle,
    rigid_fit,
)
from express50.rigs.world_frame import move_cameras
from pipelines.calibrate import graph
from pipelines.calibrate.adjust import triangulate_tracks
from pipelines.calibrate.adjuster import ITERATIONS, Freedom, adjust_rig, recorded_pixels
from pipelines.calibrate.board import Observations
from pipelines.calibrate.board_adjust import Rig, adjust, residuals
from pipelines.calibrate.camera_moves import LEAST_POINTS, shared_points
from pipelines.calibrate.config import CalibrateConfig
from pipelines.calibrate.intrinsics import View, board_poses, usable, with_ideal
from pipelines.calibrate.tracks import FEATURE_SIGMA_PX, Seen, Tracks, ideal_pixels, join_verified

HELD = 5
"""Every fifth point, or board image, judges and is not adjusted to."""
CLEARLY = 0.8
"""Held-out errors must fall to this share of what they were: tracks of footage follow a rig that
is bent to them a little even where it was right."""
BAND = 0.03
"""How far features may be from the given rig's epipolar lines, as a share of the diagonal."""
SCALES = (3.0, 1.5)
LENS = {"focal": 0.005, "focal_spread": 0.005, "centre": 0.002, "bend": 0.005}
"""What given lenses may be off when they, too, are refined (as `Freedom` has it)."""


@dataclass(frozen=True)
class Refined:
    """Cameras after refinement, and what is reported of it.

    `before_px` and `after_px` are the median errors of held-out points in the given and in the
    adjusted rig; `kept` tells that the given cameras stayed, and `why`.
    """

    cameras: dict[str, Camera]
    by: str
    before_px: float
    after_px: float
    kept: bool
    why: str

    def figures(self, given: Mapping[str, Camera]) -> dict[str, object]:
        """As metrics."""
        moves = {} if self.kept else {n: _move(given[n], c) for n, c in self.cameras.items()}
        return {
            "by": self.by,
            "held_out_before_px": _number(self.before_px),
            "held_out_after_px": _number(self.after_px),
            "kept_given": self.kept,
            "why": self.why,
            "moves": moves,
        }


def refine_by_footage(
    given: Mapping[str, Camera],
    start: Mapping[str, Camera],
    seen: Mapping[int, Seen],
    config: CalibrateConfig,
) -> Refined:
    """Refine cameras by what they saw at the same moments.

    Args:
        given: the calibration.
        start: the same with those cameras put right that have clearly moved.
        seen: by frame number, undistorted by `given`.
        config: how far cameras may be off.
    """
    tracks = join_verified(start, seen, BAND)
    enough = shared_points(tracks) >= LEAST_POINTS
    names = tuple(n for n, ok in zip(tracks.names, enough, strict=True) if ok)
    tracks = _of(tracks, names)
    held = tracks.select(tracks.point % HELD == 0)
    if len(names) < 3 or len(held.camera) < LEAST_POINTS:
        return Refined(dict(given), "footage", np.nan, np.nan, True, "cameras share too few points")
    fit = tracks.select(tracks.point % HELD != 0)
    points, rig = triangulate_tracks(start, fit), {n: start[n] for n in names}
    freedom = Freedom(
        turn_rad=np.radians(config.refine_turn_deg),
        move_m=config.refine_move_mm * 1e-3,
        **(LENS if config.refine == "all" else {}),
    )
    for scale in SCALES:
        # Always from the start: the spreads are about where the cameras were, not a step further.
        found = adjust_rig(rig, fit, points, freedom, scale, ITERATIONS)
        points = found.points
    before, before_px = _judge({n: given[n] for n in names}, held, given)
    after, after_px = _judge(found.cameras, held, given)
    if not after < CLEARLY * before:
        return Refined(
            dict(given), "footage", before_px, after_px, True, "held-out points fit no better"
        )
    return Refined({**given, **found.cameras}, "footage", before_px, after_px, False, "")


def _of(tracks: Tracks, names: tuple[str, ...]) -> Tracks:
    """The tracks of some of the cameras, which are numbered anew."""
    number = {tracks.names.index(name): i for i, name in enumerate(names)}
    kept = tracks.select(np.isin(tracks.camera, list(number)))
    return replace(kept, names=names, camera=np.array([number[c] for c in kept.camera], int))


def _judge(
    cameras: Mapping[str, Camera], held: Tracks, lenses: Mapping[str, Camera]
) -> tuple[float, float]:
    """Mean robust cost and median feature error, pixels, of held-out tracks in a rig.

    Their points are free and the cameras are not. `lenses` undistorted the tracks.
    """
    recorded = recorded_pixels([lenses[name] for name in held.names], held)
    pixels = recorded.copy()
    for index, name in enumerate(held.names):
        mine = held.camera == index
        pixels[mine] = ideal_pixels(cameras[name], recorded[mine])
    tracks = replace(held, pixels=pixels)
    fixed = Freedom(turn_rad=0.0, move_m=0.0)
    points = triangulate_tracks(cameras, tracks)
    errors = np.linalg.norm(
        adjust_rig(cameras, tracks, points, fixed, SCALES[-1], 15).errors, axis=1
    )
    features = errors[held.sigma == FEATURE_SIGMA_PX]
    cost = np.log1p((errors / held.sigma / SCALES[-1]) ** 2).mean()
    return float(cost), float(np.median(features if len(features) else errors))


def refine_by_board(
    given: Mapping[str, Camera],
    observations: Observations,
    points: np.ndarray,
    config: CalibrateConfig,
) -> Refined:
    """Refine cameras by a ChArUco board seen by several at once; `points` (P, 3) are its corners.

    The scale becomes the print's; where the rig stands is kept, by a rigid motion.
    """
    held = observations.frame % HELD == 0
    fit, judge = observations.select(~held), observations.select(held)
    start = _with_boards(given, fit, points, config)
    fit = fit.select(_placed(start, fit, points))
    if len(set(fit.camera)) < 2 or len(start.boards) < config.min_frames:
        return Refined(dict(given), "board", np.nan, np.nan, True, "cameras share too few corners")
    loss = max(2 * _median(start, fit, points), 0.1)
    solved = start
    for _ in range(max(config.rounds, 2)):
        solved = adjust(
            solved, fit, points, loss,
            refine_distortion=config.refine == "all", refine_focal=config.refine == "all",
        )  # fmt: skip
        loss = max(2 * _median(solved, fit, points), 0.02)
    found = _over(solved.cameras, given)
    before = _median(_with_boards(given, judge, points, config), judge, points)
    after = _median(_with_boards({**given, **found}, judge, points, config), judge, points)
    if not after < CLEARLY * before:
        return Refined(dict(given), "board", before, after, True, "held-out corners fit no better")
    return Refined({**given, **found}, "board", before, after, False, "")


def _with_boards(
    cameras: Mapping[str, Camera],
    observations: Observations,
    points: np.ndarray,
    config: CalibrateConfig,
) -> Rig:
    """The cameras with the board's poses that fit them best, adjusted with the cameras held."""
    views: dict[str, dict[int, View]] = {}
    for index, name in enumerate(observations.cameras):
        for frame in sorted(set(observations.frame[observations.camera == index])):
            rows = (observations.camera == index) & (observations.frame == frame)
            view = View(int(frame), points[observations.corner[rows]], observations.pixels[rows])
            size = (cameras[name].width, cameras[name].height) if name in cameras else (1, 1)
            if name in cameras and usable(view, size, config.min_corners):
                views.setdefault(name, {})[int(frame)] = with_ideal(cameras[name], view)
    poses = {
        name: {f: found for f, view in mine.items() if (found := board_poses(view))}
        for name, mine in views.items()
    }
    placed = {name: cameras[name].cam_from_world for name in views}
    boards = {}
    for frame in sorted({f for mine in poses.values() for f in mine}):
        pose = graph.rig_from_board(frame, placed, cameras, views, poses)
        if pose is not None:
            boards[frame] = pose
    rig = Rig({name: cameras[name] for name in views}, boards)
    kept = observations.select(_placed(rig, observations, points))
    if len(kept.camera) == 0:
        return rig
    loss = max(2 * _median(rig, kept, points), 0.1)
    held = adjust(rig, kept, points, loss, False, False, refine_cameras=False)
    return Rig(rig.cameras, {**rig.boards, **held.boards})


def _placed(rig: Rig, observations: Observations, points: np.ndarray) -> np.ndarray:
    """Rows (N,) of cameras and frames that the rig has, that are not far off."""
    errors = np.linalg.norm(residuals(rig, observations, points), axis=1)
    widths = [np.hypot(c.width, c.height) for c in rig.cameras.values()]
    return errors < 2 * graph.NEAR * max(widths, default=0.0)


def _median(rig: Rig, observations: Observations, points: np.ndarray) -> float:
    errors = np.linalg.norm(residuals(rig, observations, points), axis=1)
    errors = errors[np.isfinite(errors)]
    return float(np.median(errors)) if len(errors) else float("nan")


def _over(solved: Mapping[str, Camera], given: Mapping[str, Camera]) -> dict[str, Camera]:
    """Solved cameras laid over the given ones by the rigid motion that most of them agree on."""
    names = sorted(solved)
    new, old = (np.stack([rig[n].center for n in names]) for rig in (solved, given))
    if len(names) < 3:
        motion = given[names[0]].world_from_cam @ solved[names[0]].cam_from_world
        return move_cameras(solved, motion)
    weights = np.ones(len(names))
    for _ in range(10):  # a camera that was bumped must not drag the others along
        R, t = rigid_fit(new, old, weights)
        off = np.linalg.norm(new @ R.T + t - old, axis=1)
        weights = 1 / (1 + (off / max(float(np.median(off)), 1e-6)) ** 2)
    return move_cameras(solved, make_transform(R, t))


def _move(before: Camera, after: Camera) -> dict[str, float]:
    turn = (after.cam_from_world @ invert_transform(before.cam_from_world))[:3, :3]
    return {
        "turn_deg": round(float(np.degrees(np.linalg.norm(matrix_to_axis_angle(turn)))), 4),
        "move_mm": round(1e3 * float(np.linalg.norm(after.center - before.center)), 3),
    }


def _number(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
