"""From board corners to a calibrated rig: single cameras, pose graph, joint adjustment, rejection.

Everything here works on numbers (no files, no images), so that any detector can feed it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera
from express50.rigs.world_frame import canonical_from_rig, move_cameras
from pipelines.calibrate import graph
from pipelines.calibrate.board import Observations, even
from pipelines.calibrate.board_adjust import Rig, adjust, residuals
from pipelines.calibrate.config import AUTO, CalibrateConfig
from pipelines.calibrate.intrinsics import (
    View,
    as_model,
    board_poses,
    camera_params,
    fit_intrinsics,
    seen_from_front,
    usable,
    with_ideal,
)

# From few to many parameters: a focal length and one radial term, two terms, two focal lengths
# and tangential terms.
LADDER = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")

# Images that start one camera's lens; the joint adjustment uses all, whatever this is.
SINGLE_FRAMES = 15


@dataclass(frozen=True)
class Solution:
    """A calibrated rig: cameras in the canonical world, and what the figures are made of.

    `boards[frame]` is world_from_board (4, 4); `observations` and their `errors` (N, 2) pixels
    are those that were kept; `dropped` and `weak` give a reason a camera.
    """

    cameras: dict[str, Camera]
    boards: dict[int, np.ndarray]
    observations: Observations
    errors: np.ndarray
    corners_found: int
    dropped: dict[str, str]
    weak: dict[str, str]


def solve_rig(
    observations: Observations,
    points: np.ndarray,
    sizes: Mapping[str, tuple[int, int]],
    config: CalibrateConfig,
) -> Solution:
    """Calibrate every camera that the observations of one board tie together.

    Args:
        observations: corners of a rigid board, moved about in front of the rig.
        points: (P, 3) the board's corners, metres.
        sizes: (width, height) of each camera, pixels.
        config: camera model, thresholds and rounds.

    Raises:
        CalibrationError: no camera can be calibrated; the message lists the reasons.
    """
    dropped: dict[str, str] = {}
    views = _views(observations, points, sizes, config, dropped)
    start_model = "RADIAL" if config.camera_model == AUTO else config.camera_model
    lone, views = _single_cameras(views, sizes, start_model, config, dropped)
    rig = _first_rig(lone, views, dropped)
    _require(rig.cameras, dropped)
    rig, kept, errors = _refine(rig, observations, points, config, dropped)
    middles = [pose[:3, :3] @ points.mean(0) + pose[:3, 3] for pose in rig.boards.values()]
    world_from_rig = canonical_from_rig(rig.cameras, np.median(middles, axis=0))
    return Solution(
        cameras=move_cameras(rig.cameras, world_from_rig),
        boards={f: world_from_rig @ pose for f, pose in rig.boards.items()},
        observations=kept,
        errors=errors,
        corners_found=len(observations.corner),
        dropped=dict(sorted(dropped.items())),
        weak=_weak(rig, kept, config),
    )


def _require(cameras: Mapping[str, object], dropped: Mapping[str, str]) -> None:
    if not cameras:
        reasons = "; ".join(f"{name}: {why}" for name, why in sorted(dropped.items()))
        raise CalibrationError(
            f"no camera can be calibrated from the board ({reasons}); record the board again, "
            "large in view, tilted in turn to all sides, before neighbouring cameras at once"
        )


def _views(
    observations: Observations,
    points: np.ndarray,
    sizes: Mapping[str, tuple[int, int]],
    config: CalibrateConfig,
    dropped: dict[str, str],
) -> dict[str, dict[int, View]]:
    """Split the observations into usable views a camera; name cameras that have too few."""
    views: dict[str, dict[int, View]] = {}
    for index, name in enumerate(observations.cameras):
        mine = observations.camera == index
        found = [
            _view(observations, mine & (observations.frame == frame), int(frame), points)
            for frame in np.unique(observations.frame[mine])
        ]
        large = [v for v in found if usable(v, sizes[name], config.min_corners)]
        good = {view.frame: view for view in large if seen_from_front(view)}
        if len(large) - len(good) > len(good):
            dropped[name] = (
                f"its corners run the wrong way round in {len(large) - len(good)} of {len(large)} "
                "board images: the images are mirrored or the board is not this one"
            )
        elif len(good) < config.min_frames:
            dropped[name] = (
                f"the board is seen well (at least {config.min_corners} corners) in {len(good)} "
                f"images, expected at least {config.min_frames}"
            )
        else:
            views[name] = good
    return views


def _view(observations: Observations, rows: np.ndarray, frame: int, points: np.ndarray) -> View:
    return View(frame, points[observations.corner[rows]], observations.pixels[rows])


def _single_cameras(
    views: Mapping[str, dict[int, View]],
    sizes: Mapping[str, tuple[int, int]],
    model: str,
    config: CalibrateConfig,
    dropped: dict[str, str],
) -> tuple[dict[str, Camera], dict[str, dict[int, View]]]:
    """Intrinsics a camera on its own; returns the cameras and the views each one kept."""
    cameras, kept = {}, {}
    for name, mine in views.items():
        frames = [sorted(mine)[i] for i in even(len(mine), SINGLE_FRAMES)]
        fitted = fit_intrinsics([mine[f] for f in frames], sizes[name], model, config.min_frames)
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
    cameras: Mapping[str, Camera], views: Mapping[str, dict[int, View]], dropped: dict[str, str]
) -> Rig:
    """Join single cameras over shared frames; name those that agree with no other."""
    if not cameras:
        return Rig({}, {})
    poses = {
        name: {f: found for f, view in views[name].items() if (found := board_poses(view))}
        for name in cameras
    }
    edges = graph.pair_edges(cameras, views, poses)
    placed = graph.join(sorted(cameras), edges)
    for name in sorted(set(cameras) - set(placed)):
        shared = {o for o in placed if set(poses[name]) & set(poses[o])}
        dropped[name] = (
            f"its board poses agree with no other camera's though it shares frames with "
            f"{len(shared)}: out of step, or wrong corners"
            if shared
            else "it shares no board image with the other cameras"
        )
    boards = {}
    for frame in sorted({f for name in placed for f in poses[name]}):
        pose = graph.rig_from_board(frame, placed, cameras, views, poses)
        if pose is not None:
            boards[frame] = pose
    return Rig({n: replace(cameras[n], cam_from_world=T) for n, T in placed.items()}, boards)


def _refine(
    rig: Rig,
    observations: Observations,
    points: np.ndarray,
    config: CalibrateConfig,
    dropped: dict[str, str],
) -> tuple[Rig, Observations, np.ndarray]:
    """Adjust, drop bad corners, images and cameras, and adjust again; `config.rounds` times."""
    errors = residuals(rig, observations, points)
    keep = np.ones(len(errors), bool)
    limit = max(graph.NEAR * float(np.hypot(c.width, c.height)) for c in rig.cameras.values())
    loss_scale = limit / 3
    for number in range(config.rounds):
        keep = np.linalg.norm(errors, axis=1) < limit
        keep &= _in_full_images(observations, keep)
        rig = _drop_cameras(rig, observations, keep, number, dropped)
        _require(rig.cameras, dropped)
        keep &= np.isin(
            observations.camera,
            [i for i, name in enumerate(observations.cameras) if name in rig.cameras],
        )
        kept = observations.select(keep)
        if config.camera_model == AUTO and number == min(1, config.rounds - 1):
            rig = _simplest_models(rig, kept, points, loss_scale)
        rig = adjust(rig, kept, points, loss_scale)
        errors = residuals(rig, observations, points)
        sigma = _sigma(errors[keep])
        limit, loss_scale = max(config.reject_sigma * sigma, 0.05), 2 * sigma
    # Corners that only the last adjustment unmasked are not reported as accepted.
    keep &= np.linalg.norm(errors, axis=1) < 2 * limit
    return rig, observations.select(keep), errors[keep]


def _simplest_models(rig: Rig, kept: Observations, points: np.ndarray, loss_scale: float) -> Rig:
    """Give each camera the simplest lens model that its corners do not contradict.

    Distortion that is not there takes the principal point and the rotation with it: tangential
    terms alone triple the rotation's error. The model with the lowest Bayesian information
    criterion wins, camera by camera (Schwarz 1978), with a robust sum of squares.
    """
    rigs: list[Rig] = []
    costs: list[np.ndarray] = []
    for model in LADDER:
        start = rigs[-1] if rigs else rig
        start = Rig({n: as_model(c, model) for n, c in start.cameras.items()}, start.boards)
        solved = adjust(start, kept, points, loss_scale)
        squared = np.sum(residuals(solved, kept, points) ** 2, axis=1)
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
    return Rig(cameras, rigs[-1].boards)


def _sigma(errors: np.ndarray) -> float:
    """Standard deviation of one coordinate of (N, 2) errors, from their median length."""
    # The length of a 2D normal error is Rayleigh; its median is 1.1774 sigma.
    return max(float(np.median(np.linalg.norm(errors, axis=1))) / 1.1774, 1e-3)


def _in_full_images(observations: Observations, keep: np.ndarray, least: int = 6) -> np.ndarray:
    """Rows (N,) whose image still has `least` kept corners: fewer do not hold a board pose."""
    image = observations.camera * len(observations.frames) + observations.frame
    return np.bincount(image[keep], minlength=image.max(initial=0) + 1)[image] >= least


def _drop_cameras(
    rig: Rig, observations: Observations, keep: np.ndarray, number: int, dropped: dict[str, str]
) -> Rig:
    """Drop cameras that lost most of their corners to rejection, and frames nobody sees."""
    cameras = {}
    for index, name in enumerate(observations.cameras):
        if name not in rig.cameras:
            continue
        mine = observations.camera == index
        share = keep[mine].mean()
        # Before the first adjustment the guess is coarse: only a camera with next to nothing goes.
        if share < (0.5 if number else 0.05) or keep[mine].sum() < 24:
            dropped[name] = (
                f"only {keep[mine].sum()} of its {mine.sum()} corners fit the other cameras: "
                "wrong corners, out of step, or moved during the recording"
            )
        else:
            cameras[name] = rig.cameras[name]
    return Rig(cameras, rig.boards)


def _weak(rig: Rig, kept: Observations, config: CalibrateConfig) -> dict[str, str]:
    """Name cameras whose corners are few, cover little of the image or tie to few others."""
    weak = {}
    seen = {name: set(kept.frame[kept.camera == kept.cameras.index(name)]) for name in rig.cameras}
    for name, camera in sorted(rig.cameras.items()):
        mine = kept.camera == kept.cameras.index(name)
        cells = np.floor(kept.pixels[mine] / (camera.width, camera.height) * 4).clip(0, 3)
        covered = len(np.unique(cells, axis=0)) / 16
        shared = {f for other, frames in seen.items() if other != name for f in frames}
        tied = len(seen[name] & shared)
        if mine.sum() < config.weak_corners:
            weak[name] = f"{int(mine.sum())} corners, expected {config.weak_corners} or more"
        elif len(rig.cameras) > 1 and tied < config.weak_frames:
            weak[name] = f"{tied} board images shared, expected {config.weak_frames} or more"
        elif covered < 0.25:
            weak[name] = f"corners cover {covered:.0%} of its image, expected 25 % or more"
    return weak
