"""Solve a rig from board corners: single cameras, their rig, joint adjustment, rejection."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera
from express50.geometry.sampling import evenly, pictured_share
from express50.geometry.shapes import check_finite
from express50.rigs.world_frame import canonical_from_rig, move_cameras
from pipelines.calibrate.board import BoardCorners
from pipelines.calibrate.board_adjust import BoardRig, adjust_board_rig, corner_errors
from pipelines.calibrate.board_guess import (
    MIN_CORNERS,
    MIN_FRAMES,
    NEAR,
    BoardView,
    Views,
    all_board_poses,
    as_model,
    board_views,
    camera_params,
    fit_intrinsics,
    join_rig,
    relative_pose,
    rig_from_boards,
    seen_from_front,
    with_ideal,
)
from pipelines.calibrate.config import AUTO
from pipelines.calibrate.timing import CameraTiming, estimate_timing, in_step

LADDER = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")  # from few to many parameters
WEAK_CORNERS, WEAK_FRAMES = 200, 8  # cameras with less are reported
WEAK_TILTS_DEG = 10.0  # at 3 degrees about each axis, focal lengths were off by 1.3 %
FITTING = 0.75
"""Least share of a camera's corners that fit; cameras that moved have less. If half of the cameras
have less, there is no rig: wrong ones have up to 0.59 in the median camera, a real one 0.87."""
LEAST_CORNERS = 24  # that must fit the other cameras, or a camera is dropped
STEADY = 1.5  # times the least cost that a lens model may have instead of one that folds
REJECT_SIGMA = 4.0
"""Corners further off than this many robust standard deviations are rejected; 3 to 6 gave the same
rig within 0.005 degrees."""


@dataclass(frozen=True)
class BoardSolution:
    """Cameras and world_from_board (4, 4) by frame in the canonical world, and what they rest on.

    `corners` and their `errors` (N, 2), pixels, were kept of `corners_found`; corners are brought
    into step by `timing`, of cameras that saw the board move. `dropped` and `weak` give a reason
    per camera.
    """

    cameras: dict[str, Camera]
    boards: dict[int, np.ndarray]
    corners: BoardCorners
    errors: np.ndarray
    corners_found: int
    timing: dict[str, CameraTiming]
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

    `points` (P, 3) are the board's corners, metres; `sizes` are (width, height). `model` is a lens
    model of COLMAP's; auto takes the simplest that fits, camera by camera. Each of `rounds` adjusts
    everything and then rejects corners.

    Raises:
        CalibrationError: no camera can be calibrated; the message lists the reasons.
        ValueError: a corner is not finite.
    """
    check_finite("pixels of board corners", corners.pixels)
    dropped: dict[str, str] = {}
    lens = "RADIAL" if model == AUTO else model
    lone, views = _single_cameras(corners, points, sizes, lens, dropped)
    _require(lone, dropped)
    rig = _first_rig(lone, views, dropped)
    joined = sorted(rig.cameras)
    rig, kept, errors, timing = _refine(rig, corners, points, model, rounds, dropped)
    rows = [corners.cameras.index(name) for name in joined]
    every, fit = (np.bincount(c.camera, minlength=max(rows) + 1)[rows] for c in (corners, kept))
    usual = float(np.median(fit / every))
    if len(joined) > 1 and usual < FITTING:
        raise CalibrationError(
            f"{', '.join(joined)} contradict each other: in the median camera only {usual:.0%} of"
            f" the board's corners fit one rig, expected {FITTING:.0%} or more; synchronise the"
            " cameras and record the board again, or rename its images so that those of one moment"
            " have the same name"
        )
    middles = [pose[:3, :3] @ points.mean(0) + pose[:3, 3] for pose in rig.boards.values()]
    world_from_rig = canonical_from_rig(rig.cameras, np.median(middles, axis=0))
    return BoardSolution(
        cameras=move_cameras(rig.cameras, world_from_rig),
        boards={f: world_from_rig @ pose for f, pose in rig.boards.items()},
        corners=kept,
        errors=errors,
        corners_found=len(corners.corner),
        timing=timing,
        dropped=dict(sorted(dropped.items())),
        weak=_weak(rig, corners, kept),
    )


def _require(cameras: Mapping[str, object], dropped: Mapping[str, str]) -> None:
    if not cameras:
        of = {why: sorted(n for n in dropped if dropped[n] == why) for why in dropped.values()}
        reasons = "; ".join(f"{', '.join(names)}: {why}" for why, names in of.items())
        raise CalibrationError(
            f"no camera can be calibrated from the board ({reasons}); record the board again: "
            "fill much of the picture, tilt it to every side, and show it to neighbouring cameras"
            " at the same time"
        )


def _single_cameras(
    corners: BoardCorners,
    points: np.ndarray,
    sizes: Mapping[str, tuple[int, int]],
    model: str,
    dropped: dict[str, str],
) -> tuple[dict[str, Camera], dict[str, dict[int, BoardView]]]:
    """Fit each camera's intrinsics on its own; returns the cameras and the views each one kept."""
    cameras, kept = {}, {}
    for name in corners.cameras:
        good = {view.frame: view for view in board_views(corners, name, points, sizes[name])}
        if len(good) < MIN_FRAMES:
            dropped[name] = (
                f"at least {MIN_CORNERS} corners of the board are seen in {len(good)} images,"
                f" expected at least {MIN_FRAMES}: show it to this camera and a neighbour at the"
                " same time"
            )
            continue
        # Fifteen images are enough to start a lens: 8 to 60 led to the same rig.
        frames = evenly(sorted(good), 15)
        fitted = fit_intrinsics([good[f] for f in frames], sizes[name], model)
        if fitted is None:
            dropped[name] = (
                f"no lens explains its {len(frames)} board images: tilt the board to every side,"
                " and check that board.toml describes the printed board"
            )
            continue
        K, dist, used = fitted
        camera = Camera(name, *sizes[name], model, camera_params(K, dist, model), np.eye(4))
        bad = set(frames) - {frames[i] for i in used}
        cameras[name] = camera
        kept[name] = {f: with_ideal(camera, v) for f, v in good.items() if f not in bad}
    return cameras, kept


def _first_rig(
    cameras: Mapping[str, Camera],
    views: Mapping[str, dict[int, BoardView]],
    dropped: dict[str, str],
) -> BoardRig:
    """Join single cameras over shared frames; names those that agree with no other."""
    poses = all_board_poses(views)
    edges = {
        (a, b): found
        for a, b in combinations(sorted(cameras), 2)
        if (found := relative_pose(cameras[b], views[b], poses[a], poses[b])) is not None
    }
    placed = join_rig(sorted(cameras), edges) if edges or len(cameras) == 1 else {}
    for name in sorted(set(cameras) - set(placed)):
        dropped[name] = _why_apart(name, placed or cameras, views)
    _require(placed, dropped)
    if not any(seen_from_front(view) for name in placed for view in views[name].values()):
        raise CalibrationError(
            f"all board images of {', '.join(sorted(placed))} are mirrored: switch mirroring off"
            " where the pictures are recorded; if the print itself is mirrored, print it again"
        )
    boards = rig_from_boards(placed, cameras, views, poses)
    return BoardRig({n: replace(cameras[n], cam_from_world=T) for n, T in placed.items()}, boards)


def _why_apart(name: str, others: Collection[str], views: Views) -> str:
    """Say why a camera cannot be tied to others."""
    shared = [o for o in others if o != name and set(views[o]) & set(views[name])]
    if not shared:
        return (
            "it shares no board image with the other cameras: show the board to it and a neighbour"
            " at the same time"
        )
    apart = (
        f"it shares board images with {len(shared)} other cameras, but agrees with none on where"
        " the board was: "
    )
    if not any(seen_from_front(view) for view in views[name].values()):
        return apart + "its images are mirrored; switch mirroring off where they are recorded"
    return apart + "synchronise it with the others and record the board again"


def _refine(
    rig: BoardRig,
    corners: BoardCorners,
    points: np.ndarray,
    model: str,
    rounds: int,
    dropped: dict[str, str],
) -> tuple[BoardRig, BoardCorners, np.ndarray, dict[str, CameraTiming]]:
    """Adjust, drop bad corners, images and cameras, bring cameras into step, and adjust again."""
    seen, errors = corners, corner_errors(rig, corners, points)
    limit = max(NEAR * float(np.hypot(c.width, c.height)) for c in rig.cameras.values())
    loss_scale, timing = limit / 3, dict[str, CameraTiming]()
    for number in range(rounds):
        keep = np.linalg.norm(errors, axis=1) < limit
        # Frames in which no image has six kept corners are left out: nothing holds the board there.
        counts = np.zeros((len(corners.cameras), len(corners.frames)), int)
        np.add.at(counts, (corners.camera[keep], corners.frame[keep]), 1)
        keep &= (counts.max(0) >= 6)[corners.frame]
        rig, keep = _drop_cameras(rig, corners, keep, dropped)
        if number:
            timing = estimate_timing(rig, seen, keep, points, loss_scale, timing)
            corners = in_step(seen, timing, {n: c.height for n, c in rig.cameras.items()})
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
    rig, keep = _drop_cameras(rig, corners, keep, dropped)
    timing = {name: found for name, found in timing.items() if name in rig.cameras}
    return rig, corners.select(keep), errors[keep], timing


def _simplest_models(
    rig: BoardRig, kept: BoardCorners, points: np.ndarray, loss_scale: float
) -> BoardRig:
    """Give each camera the simplest lens model that its corners do not contradict.

    Superfluous distortion terms trade with the principal point and the rotation: tangential terms
    alone triple the rotation's error. The lowest Bayesian information criterion wins (Schwarz
    1978), with a robust sum of squares. No lens folds within its image, but polynomials do where
    corners are missing, so a model that does not fold and fits nearly as well comes first.
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
        least, rows = min(cost[index] for cost in costs), []
        for solved, cost in zip(rigs, costs, strict=True):
            camera = solved.cameras[name]
            sound = cost[index] <= STEADY * least and pictured_share(camera) == 1
            score = count * np.log(cost[index] / count) + len(camera.params) * np.log(count)
            rows.append((not sound, score, camera))
        cameras[name] = min(rows, key=lambda row: row[:2])[2]
    return BoardRig(cameras, rigs[-1].boards)


def _drop_cameras(
    rig: BoardRig, corners: BoardCorners, keep: np.ndarray, dropped: dict[str, str]
) -> tuple[BoardRig, np.ndarray]:
    """Drop cameras that the corners left by rejection do not determine, with these corners."""
    cameras = {}
    for index, name in enumerate(corners.cameras):
        if name not in rig.cameras:
            continue
        mine = corners.camera == index
        used, images = int(keep[mine].sum()), len(set(corners.frame[mine & keep]))
        if used < LEAST_CORNERS or images < MIN_FRAMES:
            dropped[name] = (
                f"only {used} of its {mine.sum()} corners, in {images} images, fit the other"
                f" cameras, expected {LEAST_CORNERS} in {MIN_FRAMES}: wrong corners, not"
                " synchronised, or moved during the recording"
            )
        else:
            cameras[name] = rig.cameras[name]
    _require(cameras, dropped)
    held = np.array([name in cameras for name in corners.cameras])
    return BoardRig(cameras, rig.boards), keep & held[corners.camera]


def _weak(rig: BoardRig, found: BoardCorners, kept: BoardCorners) -> dict[str, str]:
    """Name cameras whose corners are few or bad, cover little of the image or tie to few others."""
    weak = {}
    seen = {name: set(kept.frame[kept.camera == kept.cameras.index(name)]) for name in rig.cameras}
    for name, camera in sorted(rig.cameras.items()):
        mine = kept.camera == kept.cameras.index(name)
        cells = np.floor(kept.pixels[mine] / (camera.width, camera.height) * 4).clip(0, 3)
        covered = len(np.unique(cells, axis=0)) / 16
        shared = {f for other, frames in seen.items() if other != name for f in frames}
        tied = len(seen[name] & shared)
        of = int((found.camera == found.cameras.index(name)).sum())
        if mine.sum() < FITTING * of:
            weak[name] = (
                f"only {int(mine.sum())} of its {of} corners fit the other cameras and are used:"
                " it is out of step or moved during the recording; record the board again"
            )
        elif mine.sum() < WEAK_CORNERS:
            weak[name] = (
                f"{int(mine.sum())} corners, expected {WEAK_CORNERS} or more: show it the board"
                " more often"
            )
        elif len(rig.cameras) > 1 and tied < WEAK_FRAMES:
            weak[name] = (
                f"it shares {tied} board images with other cameras, expected {WEAK_FRAMES} or more:"
                " show the board to it and a neighbour at the same time"
            )
        elif (tilts := _tilt_spread(rig, seen[name])) < WEAK_TILTS_DEG:
            weak[name] = (
                f"the board's tilt differs by {tilts:.1f} degrees in its {len(seen[name])} images,"
                f" expected {WEAK_TILTS_DEG:.0f} or more: its focal length cannot be known well;"
                " tilt the board to every side"
            )
        elif covered < 0.25:
            weak[name] = (
                f"corners cover {covered:.0%} of its image, expected 25 % or more: move the board"
                " through the whole image"
            )
    return weak


def _tilt_spread(rig: BoardRig, frames: Collection[int]) -> float:
    """Return the largest angle between the board's normals in these frames, degrees.

    Parallel boards together determine a lens no better than one of them does.

    Source: Zhang 2000, "A flexible new technique for camera calibration", section 4.
    """
    normals = np.stack([rig.boards[frame][:3, 2] for frame in frames])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))
