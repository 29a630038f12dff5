"""Solve a rig from board corners: single cameras, their rig, joint adjustment, rejection.

The joint adjustment is COLMAP's. Its world is the board: its points are the board's corners, held
constant, so the scale is the print's and the board stays flat and rigid. COLMAP's rig is the camera
rig, and each board frame is one pose of the rig. There are no 3D points to estimate.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pycolmap

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera, project
from express50.rigs.world_frame import canonical_from_rig, move_cameras
from pipelines.calibrate.board import BoardCorners, even
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

LADDER = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")  # from few to many parameters
WEAK_CORNERS, WEAK_FRAMES = 200, 8  # cameras with less are reported
LEAST_CORNERS = 24  # that must fit the other cameras, or a camera is dropped
REJECT_SIGMA = 4.0
"""Corners further off than this many robust standard deviations are rejected; 3 to 6 gave the same
rig within 0.005 degrees."""
ITERATIONS = 60  # of Levenberg-Marquardt; rigs before boards settle in fewer than 15


@dataclass(frozen=True)
class BoardRig:
    """Cameras in the rig's space (their `cam_from_world`), and rig_from_board (4, 4) a frame."""

    cameras: dict[str, Camera]
    boards: dict[int, np.ndarray]


@dataclass(frozen=True)
class BoardSolution:
    """Cameras and world_from_board (4, 4) by frame in the canonical world, and what they rest on.

    `corners` and their `errors` (N, 2), pixels, were kept of `corners_found`. `dropped` and `weak`
    give a reason per camera.
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

    `points` (P, 3) are the board's corners, metres; `sizes` are (width, height). `model` is a lens
    model of COLMAP's; auto takes the simplest that fits, camera by camera. Each of `rounds` adjusts
    everything and then rejects corners.

    Raises:
        CalibrationError: no camera can be calibrated; the message lists the reasons.
    """
    dropped: dict[str, str] = {}
    lens = "RADIAL" if model == AUTO else model
    lone, views = _single_cameras(corners, points, sizes, lens, dropped)
    _require(lone, dropped)
    rig = _first_rig(lone, views, dropped)
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
                f"the board is seen well (at least {MIN_CORNERS} corners) in {len(good)} "
                f"images, expected at least {MIN_FRAMES}"
            )
            continue
        # Fifteen images are enough to start a lens: 8 to 60 led to the same rig.
        frames = [sorted(good)[i] for i in even(len(good), 15)]
        fitted = fit_intrinsics([good[f] for f in frames], sizes[name], model)
        if fitted is None:
            dropped[name] = (
                f"no lens explains its {len(frames)} board images: wrong corners, or the board "
                "was never tilted"
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
            " where the pictures are recorded; if the print itself is mirrored, print it anew"
        )
    boards = rig_from_boards(placed, cameras, views, poses)
    return BoardRig({n: replace(cameras[n], cam_from_world=T) for n, T in placed.items()}, boards)


def _why_apart(name: str, others: Collection[str], views: Views) -> str:
    """Say why a camera cannot be tied to others."""
    shared = [o for o in others if o != name and set(views[o]) & set(views[name])]
    if not shared:
        return "it shares no board image with the other cameras"
    apart = (
        f"its board poses agree with no other camera's though it shares frames with {len(shared)}: "
    )
    if not any(seen_from_front(view) for view in views[name].values()):
        return apart + "its images are mirrored; switch that off where they are recorded"
    return apart + "not synchronised, or wrong corners"


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
        rig = _drop_cameras(rig, corners, keep, dropped)
        _require(rig.cameras, dropped)
        keep &= np.array([name in rig.cameras for name in corners.cameras])[corners.camera]
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
    alone triple the rotation's error. The lowest Bayesian information criterion wins (Schwarz
    1978), with a robust sum of squares.
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
    rig: BoardRig, corners: BoardCorners, keep: np.ndarray, dropped: dict[str, str]
) -> BoardRig:
    """Drop cameras that the corners left by rejection do not determine."""
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
    return BoardRig(cameras, rig.boards)


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
        if 2 * mine.sum() < of:
            weak[name] = (
                f"only {int(mine.sum())} of its {of} corners fit the other cameras and are used:"
                " not synchronised, moved during the recording, or wrong corners"
            )
        elif mine.sum() < WEAK_CORNERS:
            weak[name] = f"{int(mine.sum())} corners, expected {WEAK_CORNERS} or more"
        elif len(rig.cameras) > 1 and tied < WEAK_FRAMES:
            weak[name] = f"{tied} board images shared, expected {WEAK_FRAMES} or more"
        elif covered < 0.25:
            weak[name] = f"corners cover {covered:.0%} of its image, expected 25 % or more"
    return weak


def corner_errors(rig: BoardRig, corners: BoardCorners, points: np.ndarray) -> np.ndarray:
    """Compute the reprojection errors (N, 2), pixels; `points` (P, 3) are corners on the board.

    Infinite where the rig has no such camera or frame, or the corner lies behind the camera.
    """
    errors = np.full((len(corners.corner), 2), np.inf)
    for index, name in enumerate(corners.cameras):
        for frame in rig.boards if name in rig.cameras else ():
            rows = np.flatnonzero((corners.camera == index) & (corners.frame == frame))
            pose = rig.cameras[name].cam_from_world @ rig.boards[frame]
            placed = replace(rig.cameras[name], cam_from_world=pose)
            pixels, _ = project(placed, points[corners.corner[rows]])
            errors[rows] = pixels - corners.pixels[rows]
    return np.where(np.isfinite(errors), errors, np.inf)


def adjust_board_rig(
    rig: BoardRig,
    corners: BoardCorners,
    points: np.ndarray,
    loss_scale_px: float,
    lenses: bool = True,
    cameras: bool = True,
) -> BoardRig:
    """Refine board poses, and if asked `lenses` and the poses of `cameras`, over the corners.

    Every observed camera and frame must be in `rig`; `points` (P, 3) are corners on the board,
    metres. The Cauchy loss begins to flatten at `loss_scale_px`.
    """
    reconstruction, names, frames = _build(rig, corners, points)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_points3D = False
    options.refine_focal_length = lenses
    options.refine_sensor_from_rig = cameras
    options.refine_principal_point = lenses
    options.refine_extra_params = lenses
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale_px
    # There are no free points to eliminate, so COLMAP's choice by image count (an iterative
    # solver beyond a thousand) loses to the default, factorising the normal equations.
    options.ceres.auto_select_solver_type = False
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-9
    options.ceres.solver_options.num_threads = 1  # sums in one order: the same bytes every run
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    solved = reconstruction.rig(1)
    root = rig.cameras[names[0]].cam_from_world  # the first camera stays where it was
    found = {}
    for i, name in enumerate(names):
        made = reconstruction.camera(i + 1)
        pose = _matrix(solved.sensor_from_rig(made.sensor_id)) @ root if i else root
        params = tuple(float(p) for p in made.params)
        found[name] = replace(rig.cameras[name], params=params, cam_from_world=pose)
    boards = {
        frame: np.linalg.inv(root) @ _matrix(reconstruction.frame(i + 1).rig_from_world)
        for i, frame in enumerate(frames)
    }
    return BoardRig(found, boards)


def _build(
    rig: BoardRig, corners: BoardCorners, points: np.ndarray
) -> tuple[pycolmap.Reconstruction, list[str], list[int]]:
    """Write the rig as a COLMAP reconstruction; camera i and frame i get the id i + 1."""
    reconstruction = pycolmap.Reconstruction()
    names = [n for i, n in enumerate(corners.cameras) if (corners.camera == i).any()]
    frames = sorted({int(f) for f in corners.frame})
    root = rig.cameras[names[0]].cam_from_world
    made_rig = pycolmap.Rig(rig_id=1)  # its own space is that of the first camera
    for i, name in enumerate(names):
        given = rig.cameras[name]
        camera = pycolmap.Camera(
            camera_id=i + 1, model=given.model, width=given.width, height=given.height,
            params=list(given.params),
        )  # fmt: skip
        reconstruction.add_camera(camera)
        if i == 0:
            made_rig.add_ref_sensor(camera.sensor_id)
        else:
            pose = given.cam_from_world @ np.linalg.inv(root)
            made_rig.add_sensor(camera.sensor_id, _rigid(pose))
    reconstruction.add_rig(made_rig)
    for corner, point in enumerate(points):
        reconstruction.add_point3D_with_id(corner + 1, pycolmap.Point3D(xyz=point))
    for i, frame in enumerate(frames):
        made = pycolmap.Frame(frame_id=i + 1, rig_id=1)
        made.rig_from_world = _rigid(root @ rig.boards[frame])
        images = []
        for j, name in enumerate(names):
            index = corners.cameras.index(name)
            rows = np.flatnonzero((corners.camera == index) & (corners.frame == frame))
            if len(rows):
                image = pycolmap.Image(
                    name=f"{name}/{frame}", keypoints=corners.pixels[rows], camera_id=j + 1,
                    image_id=i * len(names) + j + 1,
                )  # fmt: skip
                image.frame_id = i + 1
                made.add_data_id(image.data_id)
                images.append((image, corners.corner[rows]))
        reconstruction.add_frame(made)
        for image, seen in images:
            reconstruction.add_image(image)
            for k, corner in enumerate(seen):
                element = pycolmap.TrackElement(image.image_id, k)
                reconstruction.add_observation(int(corner) + 1, element)
        reconstruction.register_frame(i + 1)
    return reconstruction, names, frames


def _rigid(T: np.ndarray) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.ascontiguousarray(T[:3]))


def _matrix(pose: pycolmap.Rigid3d) -> np.ndarray:
    return np.vstack([pose.matrix(), [0.0, 0.0, 0.0, 1.0]])
