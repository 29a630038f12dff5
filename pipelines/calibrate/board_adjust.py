"""Joint bundle adjustment in pycolmap: all cameras, all board poses, one rigid board.

COLMAP's world is the board: its points are the board's corners, held constant, so the scale is
the print's and the board stays flat and rigid. COLMAP's rig is the camera rig, and each board frame
is one pose of the rig. There are no 3D points to estimate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from express50.geometry.cameras import Camera, project
from pipelines.calibrate.board import BoardCorners

ITERATIONS = 60
"""Of Levenberg-Marquardt at most; rigs before boards settle in fewer than 15."""


@dataclass(frozen=True)
class BoardRig:
    """Cameras in the rig's space (their `cam_from_world`), and rig_from_board (4, 4) a frame."""

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
            if len(rows) == 0:
                continue
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
    distortion: bool = True,
    focal: bool = True,
    cameras: bool = True,
) -> BoardRig:
    """Refine intrinsics, camera poses and board poses over the corners.

    Args:
        rig: where to start; every observed camera and frame must be in it.
        corners: board corners.
        points: (P, 3) corners on the board, metres.
        loss_scale_px: residual at which the Cauchy loss begins to flatten.
        distortion: also refine distortion and principal points.
        focal: also refine focal lengths.
        cameras: also refine the cameras' poses in the rig.
    """
    reconstruction, names, frames = _build(rig, corners, points)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_points3D = False
    options.refine_focal_length = focal
    options.refine_sensor_from_rig = cameras
    options.refine_principal_point = distortion
    options.refine_extra_params = distortion
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
    for i, name in enumerate(names):
        camera = rig.cameras[name]
        reconstruction.add_camera(
            pycolmap.Camera(
                camera_id=i + 1,
                model=camera.model,
                width=camera.width,
                height=camera.height,
                params=list(camera.params),
            )
        )
    root = rig.cameras[names[0]].cam_from_world
    made_rig = pycolmap.Rig(rig_id=1)  # its own space is that of the first camera
    made_rig.add_ref_sensor(reconstruction.camera(1).sensor_id)
    for i, name in enumerate(names[1:]):
        pose = rig.cameras[name].cam_from_world @ np.linalg.inv(root)
        made_rig.add_sensor(reconstruction.camera(i + 2).sensor_id, _rigid(pose))
    reconstruction.add_rig(made_rig)
    for corner, point in enumerate(points):
        reconstruction.add_point3D_with_id(corner + 1, pycolmap.Point3D(xyz=point))
    image_id = 0
    for i, frame in enumerate(frames):
        made = pycolmap.Frame(frame_id=i + 1, rig_id=1)
        made.rig_from_world = _rigid(root @ rig.boards[frame])
        images, rows_of = [], []
        for j, name in enumerate(names):
            index = corners.cameras.index(name)
            rows = np.flatnonzero((corners.camera == index) & (corners.frame == frame))
            if len(rows) == 0:
                continue
            image_id += 1
            image = pycolmap.Image(
                name=f"{name}/{frame}",
                keypoints=corners.pixels[rows],
                camera_id=j + 1,
                image_id=image_id,
            )
            image.frame_id = i + 1
            made.add_data_id(image.data_id)
            images.append(image)
            rows_of.append(rows)
        reconstruction.add_frame(made)
        for image, rows in zip(images, rows_of, strict=True):
            reconstruction.add_image(image)
            for k, corner in enumerate(corners.corner[rows]):
                element = pycolmap.TrackElement(image.image_id, k)
                reconstruction.add_observation(int(corner) + 1, element)
        reconstruction.register_frame(i + 1)
    return reconstruction, names, frames


def _rigid(T: np.ndarray) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.ascontiguousarray(T[:3]))


def _matrix(pose: pycolmap.Rigid3d) -> np.ndarray:
    return np.vstack([pose.matrix(), [0.0, 0.0, 0.0, 1.0]])
