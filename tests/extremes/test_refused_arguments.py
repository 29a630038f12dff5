"""Arguments that mean nothing are refused in words, before a library fails or NaN comes out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from annotations.align.features import measure
from annotations.align.suggest import suggest
from express50.errors import CalibrationError, FormatError, StageError
from express50.files.images import encode_png
from express50.geometry.cameras import pinhole_camera, resized, scale_camera
from express50.geometry.pixels import resize_area
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.head.model import pose
from express50.rigs.world_frame import check_meeting
from grmm.config import LossConfig
from grmm.losses import reconstruction, ssim
from grmm.metrics import psnr_db, rmse, ssim_score
from grmm.rasterize import rasterize
from pipelines.calibrate.board_rig import solve_rig
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.views import make_view
from tests.annotations.test_features import observations, still, windows_of
from tests.express50.head.tiny_head import tiny_head
from tests.grmm.gaussian_scenes import random_scene
from tests.pipelines.board_rigs import POINTS, board_motion, make_rig, observe, sizes_of
from tests.pipelines.bump_head import render, ring

K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
CAMERA = pinhole_camera("front", K, 320, 240, np.eye(4))
NOT_RIGID = {"mirrored": np.diag([-1.0, 1, 1, 1]), "nan": make_transform(np.eye(3), [np.nan] * 3)}


def test_board_corners_that_are_not_finite_are_counted() -> None:
    rig = make_rig(3, span_deg=80)
    corners = observe(rig, board_motion(15, 1, span_deg=80), 0.05)
    corners.pixels[::50, 0] = np.nan
    with pytest.raises(ValueError, match="pixels of board corners has .* not finite"):
        solve_rig(corners, POINTS, sizes_of(rig), rounds=2)


@pytest.mark.parametrize("angle", [1e200, np.inf])
def test_an_angle_without_a_meaning(angle) -> None:
    with pytest.raises(ValueError, match=r"expected at most 1e\+15 rad"):
        axis_angle_to_matrix(np.array([angle, 0.0, 0.0]))


def test_features_beyond_all_faces() -> None:
    with pytest.raises(ValueError, match=r"all finite and below 1e\+100"):
        suggest(np.full((20, 6), 1e300), np.arange(6) // 2, None)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_landmarks_that_are_not_finite(value) -> None:
    points = still(2)
    points[3, 5] = value
    with pytest.raises(ValueError, match="landmarks has 2 values that are not finite"):
        measure(observations(points), windows_of("neutral", "smile"))


@pytest.mark.parametrize("windows", [{}, {"smile": np.array([], int)}])
def test_no_window_to_measure(windows) -> None:
    with pytest.raises(ValueError, match="expected one or more, none of them empty"):
        measure(observations(still(1)), windows)


@pytest.mark.parametrize("kind", NOT_RIGID)
def test_poses_that_are_not_rigid(kind) -> None:
    front, *others = ring(3, 64)
    wrong = replace(front, cam_from_world=NOT_RIGID[kind] @ front.cam_from_world)
    with pytest.raises(CalibrationError, match=f"rig.json: the pose of {front.id} is not a rot"):
        check_meeting({camera.id: camera for camera in (wrong, *others)}, "rig.json")
    views = [make_view(camera, *render(camera)[:2], 1024) for camera in (front, *others)]
    with pytest.raises(StageError, match=f"camera {front.id}: its pose is not a rotation"):
        reconstruct([replace(views[0], camera=wrong), *views[1:]])


def test_pictures_without_pixels() -> None:
    with pytest.raises(FormatError, match="PNG: 5x0 pixels, expected sides of 1 to"):
        encode_png(np.zeros((0, 5), np.uint8))
    with pytest.raises(ValueError, match="resize of 5x4 to 0x0 pixels"):
        resize_area(np.zeros((4, 5, 3), np.uint8), 0, 0)
    empty = torch.zeros(3, 0, 5)
    assert reconstruction(empty, empty, LossConfig()) == 0
    with pytest.raises(ValueError, match=r"\(3, 0, 5\), expected at least one pixel"):
        ssim(empty, empty)


@pytest.mark.parametrize("metric", [psnr_db, rmse, ssim_score])
def test_pictures_of_two_sizes(metric) -> None:
    with pytest.raises(ValueError, match=r"target has shape \(3, 1, 1\), expected \(3, 14, 14\)"):
        metric(torch.zeros(3, 14, 14), torch.zeros(3, 1, 1))


def test_batches_of_two_sizes() -> None:
    head = tiny_head()
    two, three = torch.zeros(2, 1, dtype=torch.float64), torch.zeros(3, 1, dtype=torch.float64)
    with pytest.raises(ValueError, match="expression has 3 rows, expected 2"):
        pose(head, two, three)
    with pytest.raises(ValueError, match=r"offsets has shape \(3, .*, expected \(2, "):
        pose(head, two, two, offsets=two.new_zeros(3, len(head.template), 3))


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_images_too_wide_for_memory(backend) -> None:
    with pytest.raises(ValueError, match="2147483653 x 1, expected at most 200000000 pixels"):
        rasterize(**random_scene(3, 3).tensors, width=2**31 + 5, height=1, backend=backend)


def test_cameras_without_pixels() -> None:
    with pytest.raises(ValueError, match="front: scaled to 0x0, expected at least 1x1"):
        scale_camera(CAMERA, 0.0, 0.0)
    with pytest.raises(ValueError, match="front: image is 0x240"):
        resized(replace(CAMERA, width=0), 10, 10)
