"""Adjust a rig and the poses of a board to its corners, and derive the corners' errors.

The adjustment is COLMAP's. Its world is the board: its points are the board's corners, held
constant, so the scale is the print's and the board stays flat and rigid. COLMAP's rig is the camera
rig, and each board frame is one pose of the rig. There are no 3D points to estimate.
"""

from __future__ import annotations

import ctypes
import signal
from dataclasses import dataclass, replace

import numpy as np

from express50.geometry.cameras import Camera, project
from pipelines.calibrate.adjuster import Normal, move_pose
from pipelines.calibrate.board import BoardCorners

_ACTION = ctypes.create_string_buffer(512)  # a struct sigaction and more
ctypes.CDLL(None).sigaction(signal.SIGTERM, None, _ACTION)
import pycolmap  # noqa: E402 (its logging takes SIGTERM over, and would print a stack trace)

# Python's own function works in the main thread alone, and workers import this in another.
ctypes.CDLL(None).sigaction(signal.SIGTERM, _ACTION, None)

ITERATIONS = 60  # of Levenberg-Marquardt; rigs before boards settle in fewer than 15
POSE, LENS = 6, 8  # unknowns of a camera: of its pose, and of the lens with the most parameters


@dataclass(frozen=True)
class BoardRig:
    """Cameras in the rig's space (their `cam_from_world`), and rig_from_board (4, 4) by frame."""

    cameras: dict[str, Camera]
    boards: dict[int, np.ndarray]


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
    rig: BoardRig, corners: BoardCorners, points: np.ndarray, loss_scale_px: float
) -> BoardRig:
    """Refine the cameras' lenses and poses, and the board's poses, over the corners.

    Every observed camera and frame must be in `rig`; `points` (P, 3) are corners on the board,
    metres. The Cauchy loss begins to flatten at `loss_scale_px`.
    """
    reconstruction, names, frames = _build(rig, corners, points)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_points3D = False
    options.refine_principal_point = True
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
    often = np.bincount(corners.corner, minlength=len(points)) > 1  # COLMAP refuses the others
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
                if often[corner]:
                    element = pycolmap.TrackElement(image.image_id, k)
                    reconstruction.add_observation(int(corner) + 1, element)
        reconstruction.register_frame(i + 1)
    return reconstruction, names, frames


def _rigid(T: np.ndarray) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.ascontiguousarray(T[:3]))


def _matrix(pose: pycolmap.Rigid3d) -> np.ndarray:
    return np.vstack([pose.matrix(), [0.0, 0.0, 0.0, 1.0]])


def derive(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derive pixels of points (N, 3) by the camera's unknowns (N, 2, 14), and by them (N, 2, 3).

    The unknowns are a rotation and a translation in the camera's axes, then the lens's parameters;
    columns that a lens has no use for are zero.
    """
    start, step = project(camera, points)[0], 1e-6
    by_camera = np.zeros((len(points), 2, POSE + LENS))
    for i, d in enumerate(step * np.eye(POSE)):
        moved = replace(camera, cam_from_world=move_pose(camera.cam_from_world, d))
        by_camera[..., i] = (project(moved, points)[0] - start) / step
    for i, value in enumerate(camera.params):
        changed = replace(
            camera, params=(*camera.params[:i], value + step, *camera.params[i + 1 :])
        )
        by_camera[..., POSE + i] = (project(changed, points)[0] - start) / step
    by_point = [(project(camera, points + d)[0] - start) / step for d in step * np.eye(3)]
    return by_camera, np.stack(by_point, axis=-1)


def rigid_steps(points: np.ndarray) -> np.ndarray:
    """Derive points (N, 3) by a small rotation and translation of all of them: (N, 3, 6)."""
    turns = np.cross(np.eye(3), points[:, None]).transpose(0, 2, 1)
    return np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], axis=2)


def derive_corners(
    rig: BoardRig, corners: BoardCorners, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Derive the corners' errors by their cameras' unknowns (N, 2, 14) and boards' poses (N, 2, 6).

    Every observed camera and frame must be in `rig`; `points` (P, 3) are corners on the board.
    """
    by_camera = np.zeros((len(corners.corner), 2, POSE + LENS))
    by_board = np.zeros((len(corners.corner), 2, POSE))
    frames, index = np.unique(corners.frame, return_inverse=True)
    pose = np.stack([rig.boards[int(f)] for f in frames])[index]
    placed = np.einsum("nij,nj->ni", pose[:, :3, :3], points[corners.corner]) + pose[:, :3, 3]
    for i in np.unique(corners.camera):
        mine = corners.camera == i
        by_camera[mine], by_point = derive(rig.cameras[corners.cameras[i]], placed[mine])
        by_board[mine] = by_point @ rigid_steps(placed[mine])
    return by_camera, by_board


def rig_covariance(normal: Normal, held: np.ndarray | float = 0.0) -> np.ndarray:
    """Invert normal equations (K, K) of cameras, for errors of one pixel.

    `held` is added; the first camera holds the rig. Unknowns that nothing depends on get zeros.
    """
    H = normal.cameras + held
    H[:POSE, :POSE] += np.diag(normal.diagonal[:POSE])
    free = np.flatnonzero(normal.diagonal > 1e-9)
    unit = 1 / np.sqrt(normal.diagonal[free])
    inverse = np.linalg.pinv(H[np.ix_(free, free)] * unit * unit[:, None], hermitian=True)
    covariance = np.zeros_like(H)
    covariance[np.ix_(free, free)] = inverse * unit * unit[:, None]
    return covariance
