"""Solve a rig from board corners: single cameras, pose graph, joint adjustment, rejection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera
from express50.rigs.world_frame import canonical_from_rig, move_cameras
from pipelines.calibrate.board import BoardCorners, even
from pipelines.calibrate.board_adjust import BoardRig, adjust_board_rig, corner_errors
from pipelines.calibrate.config import AUTO
from pipelines.calibrate.intrinsics import (
    MIN_CORNERS,
    BoardView,
    as_model,
    board_poses,
    board_views,
    camera_params,
    fit_intrinsics,
    seen_from_front,
    with_ideal,
)
from pipelines.calibrate.rig_graph import NEAR, join_rig, pair_edges, rig_from_board

LADDER = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""From few to many parameters: a focal length and one radial term, two terms, two focal lengths
and tangential terms."""
MIN_FRAMES = 4
"""Board images a camera needs; one with fewer is dropped."""
WEAK_CORNERS, WEAK_FRAMES = 200, 8
"""Cameras with fewer accepted corners, or that share fewer board images, are reported as weak."""
REJECT_SIGMA = 4.0
"""Corners further off than this many robust standard deviations are rejected; 3 to 6 gave the same
rig within 0.005 degrees."""


@dataclass(frozen=True)
class BoardSolution:
    """A calibrated rig: cameras in the canonical world, and the observations behind it.

    `boards[frame]` is world_from_board (4, 4). `corners` and their `errors` (N, 2), pixels, are
    those that were kept, of `corners_found`. `dropped` and `weak` give a reason per camera.
    """

    cameras: dict[str, Camera]
    boards: dict[int, np.ndarray]
    corners: BoardCorners
    errors: np.ndarray
    corners_found: int
    dropped: dict[str, str]
    weak: dict[str, str]


def solve_rig(
    corners: BoardCorners,
    points: np.ndarray,
    sizes: Mapping[str, tuple[int, int]],
    model: str = AUTO,
    rounds: int = 3,
) -> BoardSolution:
    """Calibrate every camera that the corners of one board tie together.

    Args:
        corners: corners of a rigid board, moved about in front of the rig.
        points: (P, 3) the board's corners, metres.
        sizes: (width, height) of each camera, pixels.
        model: COLMAP lens model; auto takes the simplest that fits, camera by camera.
        rounds: joint adjustments, each followed by rejection of corners.

    Raises:
        CalibrationError: no camera can be calibrated; the message lists the reasons.
    """
    dropped: dict[str, str] = {}
    views = _views(corners, points, sizes, dropped)
    lone, views = _single_cameras(views, sizes, "RADIAL" if model == AUTO else model, dropped)
    rig = _first_rig(lone, views, dropped)
    _require(rig.cameras, dropped)
    rig, kept, errors = _refine(rig, corners, points, model, rounds, dropped)
    middles = [pose[:3, :3] @ points.mean(0) + pose[:3, 3] for pose in rig.boards.values()]
    world_from_rig = canonical_from_rig(rig.cameras, np.median(middles, axis=0))
    return BoardSolution(
        cameras=move_cameras(rig.cameras, world_from_rig),
        boards={f: world_from_rig @ pose for f, pose in rig.boards.items()},
        corners=kept,
        errors=errors,
        corners_found=len(corners.corner),
        dropped=dict(sorted(dropped.items())),
        weak=_weak(rig, kept),
    )


def _require(cameras: Mapping[str, object], dropped: Mapping[str, str]) -> None:
    if not cameras:
        reasons = "; ".join(f"{name}: {why}" for name, why in sorted(dropped.items()))
        raise CalibrationError(
            f"no camera can be calibrated from the board ({reasons}); record the board again, "
            "large in view, tilted in turn to all sides, before neighbouring cameras at once"
        )


def _views(
    corners: BoardCorners,
    points: np.ndarray,
    sizes: Mapping[str, tuple[int, int]],
    dropped: dict[str, str],
) -> dict[str, dict[int, BoardView]]:
    """Split the corners into usable views per camera; name cameras that have too few."""
    views: dict[str, dict[int, BoardView]] = {}
    for name in corners.cameras:
        large = board_views(corners, name, points, sizes[name])
        good = {view.frame: view for view in large if seen_from_front(view)}
        if len(large) - len(good) > len(good):
            dropped[name] = (
                f"its corners run the wrong way round in {len(large) - len(good)} of {len(large)} "
                "board images: the images are mirrored or the board is not this one"
            )
        elif len(good) < MIN_FRAMES:
            dropped[name] = (
                f"the board is seen well (at least {MIN_CORNERS} corners) in {len(good)} "
                f"images, expected at least {MIN_FRAMES}"
            )
        else:
            views[name] = good
    return views


def _single_cameras(
    views: Mapping[str, dict[int, BoardView]],
    sizes: Mapping[str, tuple[int, int]],
    model: str,
    dropped: dict[str, str],
) -> tuple[dict[str, Camera], dict[str, dict[int, BoardView]]]:
    """Fit each camera's intrinsics on its own; return the cameras and the views each one kept."""
    cameras, kept = {}, {}
    for name, mine in views.items():
        # Fifteen images are enough to start a lens: 8 to 60 led to the same rig.
        frames = [sorted(mine)[i] for i in even(len(mine), 15)]
        fitted = fit_intrinsics([mine[f] for f in frames], sizes[name], model, MIN_FRAMES)
        if fitted is None:
            dropped[name] = (
                f"no lens explains its {len(frames)} board images: wrong corners, or the board "
                "was never tilted"
            )
            continue
        K, dist, used = fitted
        camera = Camera(name, *sizes[name], model, camera_params(K, dist, model), np.eye(4))
        bad = {frames[i] for i in range(len(frames))} - {frames[i] for i in used}
        cameras[name] = camera
        kept[name] = {f: with_ideal(camera, v) for f, v in mine.items() if f not in bad}
    return cameras, kept


def _first_rig(
    cameras: Mapping[str, Camera],
    views: Mapping[str, dict[int, BoardView]],
    dropped: dict[str, str],
) -> BoardRig:
    """Join single cameras over shared frames; name those that agree with no other."""
    if not cameras:
        return BoardRig({}, {})
    poses = {
        name: {f: found for f, view in views[name].items() if (found := board_poses(view))}
        for name in cameras
    }
    edges = pair_edges(cameras, views, poses)
    placed = join_rig(sorted(cameras), edges)
    for name in sorted(set(cameras) - set(placed)):
        shared = {o for o in placed if set(poses[name]) & set(poses[o])}
        dropped[name] = (
            f"its board poses agree with no other camera's though it shares frames with "
            f"{len(shared)}: not synchronised, or wrong corners"
            if shared
            else "it shares no board image with the other cameras"
        )
    boards = {}
    for frame in sorted({f for name in placed for f in poses[name]}):
        pose = rig_from_board(frame, placed, cameras, views, poses)
        if pose is not None:
            boards[frame] = pose
    return BoardRig({n: replace(cameras[n], cam_from_world=T) for n, T in placed.items()}, boards)


def _refine(
    rig: BoardRig,
    corners: BoardCorners,
    points: np.ndarray,
    model: str,
    rounds: int,
    dropped: dict[str, str],
) -> tuple[BoardRig, BoardCorners, np.ndarray]:
    """Adjust, drop bad corners, images and cameras, and adjust again."""
    errors = corner_errors(rig, corners, points)
    keep = np.ones(len(errors), bool)
    limit = max(NEAR * float(np.hypot(c.width, c.height)) for c in rig.cameras.values())
    loss_scale = limit / 3
    for number in range(rounds):
        keep = np.linalg.norm(errors, axis=1) < limit
        # An image with fewer than six kept corners does not hold a board pose.
        image = corners.camera * len(corners.frames) + corners.frame
        keep &= np.bincount(image[keep], minlength=image.max(initial=0) + 1)[image] >= 6
        rig = _drop_cameras(rig, corners, keep, number, dropped)
        _require(rig.cameras, dropped)
        keep &= np.isin(
            corners.camera,
            [i for i, name in enumerate(corners.cameras) if name in rig.cameras],
        )
        kept = corners.select(keep)
        if model == AUTO and number == min(1, rounds - 1):
            rig = _simplest_models(rig, kept, points, loss_scale)
        rig = adjust_board_rig(rig, kept, points, loss_scale)
        errors = corner_errors(rig, corners, points)
        # The length of a 2D normal error is Rayleigh distributed; its median is 1.1774 sigma.
        sigma = max(float(np.median(np.linalg.norm(errors[keep], axis=1))) / 1.1774, 1e-3)
        limit, loss_scale = max(REJECT_SIGMA * sigma, 0.05), 2 * sigma
    # Corners that only the last adjustment shows to be wrong are not reported as accepted.
    keep &= np.linalg.norm(errors, axis=1) < 2 * limit
    return rig, corners.select(keep), errors[keep]


def _simplest_models(
    rig: BoardRig, kept: BoardCorners, points: np.ndarray, loss_scale: float
) -> BoardRig:
    """Give each camera the simplest lens model that its corners do not contradict.

    Superfluous distortion terms trade with the principal point and the rotation: tangential terms
    alone triple the rotation's error. The model with the lowest Bayesian information criterion
    wins, camera by camera (Schwarz 1978), with a robust sum of squares.
    """
    rigs: list[BoardRig] = []
    costs: list[np.ndarray] = []
    for model in LADDER:
        start = rigs[-1] if rigs else rig
        start = BoardRig({n: as_model(c, model) for n, c in start.cameras.items()}, start.boards)
        solved = adjust_board_rig(start, kept, points, loss_scale)
        squared = np.sum(corner_errors(solved, kept, points) ** 2, axis=1)
        robust = loss_scale**2 * np.log1p(np.minimum(squared, 1e6) / loss_scale**2)
        rigs.append(solved)
        costs.append(np.bincount(kept.camera, robust, minlength=len(kept.cameras)))
    cameras = {}
    for name in rig.cameras:
        index = kept.cameras.index(name)
        count = 2 * int((kept.camera == index).sum())
        scores = [
            count * np.log(cost[index] / count) + len(solved.cameras[name].params) * np.log(count)
            for solved, cost in zip(rigs, costs, strict=True)
        ]
        cameras[name] = rigs[int(np.argmin(scores))].cameras[name]
    return BoardRig(cameras, rigs[-1].boards)


def _drop_cameras(
    rig: BoardRig, corners: BoardCorners, keep: np.ndarray, number: int, dropped: dict[str, str]
) -> BoardRig:
    """Drop cameras that lost most of their corners to rejection."""
    cameras = {}
    for index, name in enumerate(corners.cameras):
        if name not in rig.cameras:
            continue
        mine = corners.camera == index
        share = keep[mine].mean()
        # Before the first adjustment the guess is coarse: only cameras with hardly any corner go.
        if share < (0.5 if number else 0.05) or keep[mine].sum() < 24:
            dropped[name] = (
                f"only {keep[mine].sum()} of its {mine.sum()} corners fit the other cameras: "
                "wrong corners, not synchronised, or moved during the recording"
            )
        else:
            cameras[name] = rig.cameras[name]
    return BoardRig(cameras, rig.boards)


def _weak(rig: BoardRig, kept: BoardCorners) -> dict[str, str]:
    """Name cameras whose corners are few, cover little of the image or tie to few others."""
    weak = {}
    seen = {name: set(kept.frame[kept.camera == kept.cameras.index(name)]) for name in rig.cameras}
    for name, camera in sorted(rig.cameras.items()):
        mine = kept.camera == kept.cameras.index(name)
        cells = np.floor(kept.pixels[mine] / (camera.width, camera.height) * 4).clip(0, 3)
        covered = len(np.unique(cells, axis=0)) / 16
        shared = {f for other, frames in seen.items() if other != name for f in frames}
        tied = len(seen[name] & shared)
        if mine.sum() < WEAK_CORNERS:
            weak[name] = f"{int(mine.sum())} corners, expected {WEAK_CORNERS} or more"
        elif len(rig.cameras) > 1 and tied < WEAK_FRAMES:
            weak[name] = f"{tied} board images shared, expected {WEAK_FRAMES} or more"
        elif covered < 0.25:
            weak[name] = f"corners cover {covered:.0%} of its image, expected 25 % or more"
    return weak
