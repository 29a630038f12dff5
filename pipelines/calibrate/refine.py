"""Refine given cameras by the board or the footage, and keep the result only if it is better.

Part of the observations is held out and judges: cameras are only replaced if points that the
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
from pipelines.calibrate.adjuster import RigPriors, adjust_rig, triangulate_tracks
from pipelines.calibrate.board import BoardCorners
from pipelines.calibrate.board_adjust import BoardRig, adjust_board_rig, corner_errors
from pipelines.calibrate.intrinsics import board_poses, board_views, with_ideal
from pipelines.calibrate.rig_graph import NEAR, rig_from_board
from pipelines.calibrate.tracks import LEAST_POINTS, FrameSetPoints, PointTracks, join_tracks

HELD = 5
"""Every fifth point, or board image, judges and is not adjusted to."""
CLEARLY = 0.8
"""Held-out errors must fall to this share of what they were. Tracks of footage follow a rig that
is bent to them a little even where it was right: true rigs gain up to 6 %."""
BAND = 0.03
"""How far features may be from the given rig's epipolar lines, as a share of the diagonal."""
SCALES = (3.0, 1.5)
LENS = RigPriors(focal=0.005, focal_spread=0.005, centre=0.002, bend=0.005)
"""How far given lenses may be off if they, too, are refined."""


@dataclass(frozen=True)
class RefinedRig:
    """Cameras after refinement, and what is reported about it.

    `before_px` and `after_px` are the median errors of held-out points in the given and in the
    adjusted rig. `kept` says that the given cameras stayed, and `why` gives the reason.
    """

    cameras: dict[str, Camera]
    by: str
    before_px: float
    after_px: float
    kept: bool
    why: str

    def figures(self, given: Mapping[str, Camera]) -> dict[str, object]:
        """Return metrics, including how far each camera was turned and moved."""
        moves = {}
        for name, after in {} if self.kept else self.cameras.items():
            before = given[name]
            turn = (after.cam_from_world @ invert_transform(before.cam_from_world))[:3, :3]
            moves[name] = {
                "turn_deg": round(float(np.degrees(np.linalg.norm(matrix_to_axis_angle(turn)))), 4),
                "move_mm": round(1e3 * float(np.linalg.norm(after.center - before.center)), 3),
            }
        errors = {"before": self.before_px, "after": self.after_px}
        return {
            "by": self.by,
            **{f"held_out_{k}_px": round(v, 4) if np.isfinite(v) else None
               for k, v in errors.items()},
            "kept_given": self.kept,
            "why": self.why,
            "moves": moves,
        }  # fmt: skip


def refine_by_footage(
    given: Mapping[str, Camera],
    start: Mapping[str, Camera],
    seen: Mapping[int, FrameSetPoints],
    *,
    turn_deg: float,
    move_mm: float,
    lenses: bool,
) -> RefinedRig:
    """Refine cameras by points they saw at the same instants.

    Args:
        given: the calibration.
        start: the same, with corrected poses of cameras that have clearly moved.
        seen: points by frame number.
        turn_deg: how far cameras may be turned (a standard deviation).
        move_mm: how far cameras may have moved (a standard deviation).
        lenses: also refine lenses.
    """
    tracks = join_tracks(start, seen, BAND)
    enough = tracks.shared_points() >= LEAST_POINTS
    names = tuple(n for n, ok in zip(tracks.names, enough, strict=True) if ok)
    tracks = tracks.of_cameras(names)
    held, fit = (tracks.select((tracks.point % HELD == 0) == side) for side in (True, False))
    if len(names) < 3 or len(held.camera) < LEAST_POINTS:
        why = "cameras share too few points"
        return RefinedRig(dict(given), "footage", np.nan, np.nan, True, why)
    priors = replace(
        LENS if lenses else RigPriors(), turn_rad=np.radians(turn_deg), move_m=move_mm * 1e-3
    )
    found = adjust_rig(start, fit, triangulate_tracks(start, fit), priors, SCALES).cameras
    before, before_px = _judge(given, held)
    after, after_px = _judge(found, held)
    if not after < CLEARLY * before:
        why = "held-out points fit no better"
        return RefinedRig(dict(given), "footage", before_px, after_px, True, why)
    return RefinedRig({**given, **found}, "footage", before_px, after_px, False, "")


def _judge(cameras: Mapping[str, Camera], held: PointTracks) -> tuple[float, float]:
    """Mean robust cost and median feature error, pixels, of held-out tracks in a fixed rig."""
    points = triangulate_tracks(cameras, held)
    fit = adjust_rig(cameras, held, points, RigPriors(), SCALES[-1:], free=(), iterations=15)
    errors = np.linalg.norm(fit.errors, axis=1)
    features = errors[held.features()]
    median = float(np.median(features if len(features) else errors))
    return fit.cost / len(errors), median


def refine_by_board(
    given: Mapping[str, Camera],
    corners: BoardCorners,
    points: np.ndarray,
    *,
    rounds: int,
    lenses: bool,
) -> RefinedRig:
    """Refine cameras by a ChArUco board that several see at once.

    The scale becomes the print's; where the rig stands is kept, by a rigid motion.

    Args:
        given: the calibration.
        corners: the board's corners in the images.
        points: (P, 3) corners on the board, metres.
        rounds: adjustments, each with a loss scale from the errors before.
        lenses: also refine lenses.
    """
    held = corners.frame % HELD == 0
    fit, judge = corners.select(~held), corners.select(held)
    start = _with_boards(given, fit, points)
    fit = fit.select(_near(start, fit, points))
    if len(set(fit.camera)) < 2 or len(start.boards) < 4:
        why = "cameras share too few corners"
        return RefinedRig(dict(given), "board", np.nan, np.nan, True, why)
    loss = max(2 * _median_error(start, fit, points), 0.1)
    solved = start
    for _ in range(max(rounds, 2)):
        solved = adjust_board_rig(solved, fit, points, loss, distortion=lenses, focal=lenses)
        loss = max(2 * _median_error(solved, fit, points), 0.02)
    found = _over(solved.cameras, given)
    before = _median_error(_with_boards(given, judge, points), judge, points)
    after = _median_error(_with_boards({**given, **found}, judge, points), judge, points)
    if not after < CLEARLY * before:
        why = "held-out corners fit no better"
        return RefinedRig(dict(given), "board", before, after, True, why)
    return RefinedRig({**given, **found}, "board", before, after, False, "")


def _with_boards(
    cameras: Mapping[str, Camera], corners: BoardCorners, points: np.ndarray
) -> BoardRig:
    """Add the board poses that fit the cameras best, with the cameras held."""
    views = {}
    for name in sorted(set(corners.cameras) & set(cameras)):
        size = (cameras[name].width, cameras[name].height)
        mine = board_views(corners, name, points, size)
        if mine:
            views[name] = {v.frame: with_ideal(cameras[name], v) for v in mine}
    poses = {
        name: {f: found for f, view in mine.items() if (found := board_poses(view))}
        for name, mine in views.items()
    }
    placed = {name: cameras[name].cam_from_world for name in views}
    boards = {}
    for frame in sorted({f for mine in poses.values() for f in mine}):
        pose = rig_from_board(frame, placed, cameras, views, poses)
        if pose is not None:
            boards[frame] = pose
    rig = BoardRig({name: cameras[name] for name in views}, boards)
    kept = corners.select(_near(rig, corners, points))
    if len(kept.camera) == 0:
        return rig
    loss = max(2 * _median_error(rig, kept, points), 0.1)
    held = adjust_board_rig(rig, kept, points, loss, distortion=False, focal=False, cameras=False)
    return BoardRig(rig.cameras, {**rig.boards, **held.boards})


def _near(rig: BoardRig, corners: BoardCorners, points: np.ndarray) -> np.ndarray:
    """Mark the rows (N,) of cameras and frames in the rig that are not far off."""
    errors = np.linalg.norm(corner_errors(rig, corners, points), axis=1)
    widths = [np.hypot(c.width, c.height) for c in rig.cameras.values()]
    return errors < 2 * NEAR * max(widths, default=0.0)


def _median_error(rig: BoardRig, corners: BoardCorners, points: np.ndarray) -> float:
    errors = np.linalg.norm(corner_errors(rig, corners, points), axis=1)
    errors = errors[np.isfinite(errors)]
    return float(np.median(errors)) if len(errors) else float("nan")


def _over(solved: Mapping[str, Camera], given: Mapping[str, Camera]) -> dict[str, Camera]:
    """Lay solved cameras over the given ones by the rigid motion that most of them agree on."""
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
