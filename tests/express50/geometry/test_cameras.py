"""Cameras against OpenCV and against themselves."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.errors import CalibrationError
from express50.files import calibration as calibration_file
from express50.geometry import cameras, conventions, sampling, transforms
from express50.geometry.cameras import Camera

POSE = transforms.look_at(np.array([0.1, 0.2, 1.0]), np.zeros(3))
OPENCV = Camera("a", 64, 48, "OPENCV", (80, 82, 31, 25, 0.1, -0.05, 0.001, 0.002), POSE)
POINTS = np.random.default_rng(0).normal(size=(20, 3)) * 0.1


def test_project_agrees_with_opencv():
    R, t = POSE[:3, :3], POSE[:3, 3]
    theirs = cv2.projectPoints(
        POINTS, cv2.Rodrigues(R)[0], t, conventions.K_to_opencv(OPENCV.K), OPENCV.dist
    )[0][:, 0]
    ours, depth = cameras.project(OPENCV, POINTS)
    np.testing.assert_allclose(ours, conventions.opencv_pixels_to_corner(theirs), atol=1e-9)
    assert (depth > 0).all()


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", (80, 31, 25)),
        ("PINHOLE", (80, 82, 31, 25)),
        ("SIMPLE_RADIAL", (80, 31, 25, 0.1)),
        ("RADIAL", (80, 31, 25, 0.1, -0.02)),
        ("OPENCV", OPENCV.params),
        ("FULL_OPENCV", (80, 82, 31, 25, 0.1, -0.05, 0.001, 0.002, 0.01, 0.0, 0.0, 0.0)),
    ],
)
def test_unproject_inverts_project_for_every_model(model, params):
    camera = Camera("a", 64, 48, model, params, POSE)
    pixels, depth = cameras.project(camera, POINTS)
    np.testing.assert_allclose(cameras.unproject(camera, pixels, depth), POINTS, atol=1e-9)


def test_a_point_behind_the_camera_has_no_pixel():
    behind = OPENCV.center + OPENCV.world_from_cam[:3, :3] @ np.array([[0.0, 0.0, -1.0]]).T.ravel()
    pixels, depth = cameras.project(OPENCV, behind[None])
    assert np.isnan(pixels).all()
    assert depth[0] == pytest.approx(-1.0)


def test_infinite_points_have_no_pixel_and_give_no_warning():
    camera = Camera("a", 320, 240, "PINHOLE", (300.0, 300.0, 160.0, 120.0), np.eye(4))
    points = [[np.inf, 0, 1], [0, 0, np.inf], [np.nan, 0, 1], [0, 0, 1]]
    pixels, depth = cameras.project(camera, points)
    assert np.isfinite(pixels).all(1).tolist() == [False, False, False, True] and depth[3] == 1


def test_convention_first_pixel_centre_is_half():
    camera = cameras.pinhole_camera(
        "p", np.array([[10.0, 0, 2], [0, 10, 2], [0, 0, 1]]), 4, 4, np.eye(4)
    )
    origin, directions = cameras.rays(camera)
    np.testing.assert_allclose(directions[0, 0], [(0.5 - 2) / 10, (0.5 - 2) / 10, 1.0])
    np.testing.assert_allclose(origin, 0.0)


@settings(max_examples=30, deadline=None)
@given(
    x0=st.floats(-20, 20), y0=st.floats(-20, 20), scale=st.floats(0.2, 4.0), seed=st.integers(0, 99)
)
def test_crop_and_scale_commute_with_projection(x0, y0, scale, seed):
    points = np.random.default_rng(seed).normal(size=(5, 3)) * 0.1
    pixels, _ = cameras.project(OPENCV, points)
    moved = cameras.scale_camera(cameras.crop_camera(OPENCV, x0, y0, 40, 40), scale, scale)
    np.testing.assert_allclose(
        cameras.project(moved, points)[0], (pixels - (x0, y0)) * scale, atol=1e-8
    )


@pytest.mark.parametrize(
    ("ends", "window"),
    [
        ([(3.2, 5.0), (9.0, 7.5)], np.s_[3:10, 1:11]),
        ([(-9.0, 40.0), (70.0, 60.0)], np.s_[38:48, 0:64]),
        ([(90.0, -9.0), (95.0, -5.0)], np.s_[0:1, 63:64]),  # beside the picture
    ],
)
def test_a_part_of_a_picture_has_its_margin_and_a_pixel_at_least(ends, window):
    picture = np.arange(48 * 64).reshape(48, 64)
    camera, found = cameras.cut_about(OPENCV, np.array(ends), 2)
    assert picture[found].shape == (camera.height, camera.width)
    np.testing.assert_array_equal(picture[found], picture[window])
    shift = (window[1].start, window[0].start)
    pixels = cameras.project(OPENCV, POINTS)[0]
    np.testing.assert_allclose(cameras.project(camera, POINTS)[0], pixels - shift, atol=1e-9)
    np.testing.assert_allclose(
        cameras.depth_in(OPENCV, POINTS), cameras.project(OPENCV, POINTS)[1], atol=1e-12
    )


def test_scaling_a_one_focal_model_keeps_it_right():
    camera = Camera("a", 64, 48, "SIMPLE_RADIAL", (80, 31, 25, 0.1), POSE)
    moved = cameras.resized(camera, 32, 24)
    assert (moved.width, moved.height) == (32, 24)
    np.testing.assert_allclose(
        cameras.project(moved, POINTS)[0], cameras.project(camera, POINTS)[0] / 2, atol=1e-9
    )


def test_a_camera_of_the_wanted_size_is_unchanged():
    camera = Camera("a", 64, 48, "SIMPLE_PINHOLE", (80, 31, 25), POSE)
    assert cameras.resized(camera, 64, 48) is camera


def test_rays_that_part_meet_nowhere():
    left = cameras.pinhole_camera("l", np.diag([300.0, 300.0, 1.0]), 320, 240, np.eye(4))
    pose = np.eye(4)
    pose[0, 3] = -0.1
    right = cameras.pinhole_camera("r", left.K, 320, 240, pose)
    assert np.isnan(cameras.triangulate([left, right], np.array([[[-20.0, 0]], [[20.0, 0]]]))).all()


def test_triangulate_recovers_points_and_says_nan_for_one_view():
    other_pose = transforms.look_at(np.array([0.8, 0.2, 0.6]), np.zeros(3))
    other = Camera("b", 64, 48, "PINHOLE", (80, 80, 31, 25), other_pose)
    pixels = np.stack([cameras.project(c, POINTS)[0] for c in (OPENCV, other)])
    np.testing.assert_allclose(cameras.triangulate([OPENCV, other], pixels), POINTS, atol=1e-8)
    pixels[1, 3] = np.nan
    got = cameras.triangulate([OPENCV, other], pixels)
    assert np.isnan(got[3]).all()
    assert np.isfinite(np.delete(got, 3, axis=0)).all()


def test_moving_the_world_moves_nothing_in_the_image():
    T = transforms.make_transform(
        transforms.axis_angle_to_matrix(np.array([0.3, -1, 0.2])), [1, 2, 3]
    )
    moved = cameras.transform_camera(OPENCV, T)
    points = POINTS @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(
        cameras.project(moved, points)[0], cameras.project(OPENCV, POINTS)[0]
    )


def test_undistort_image_moves_features_to_the_pinhole_projection():
    camera = Camera("a", 200, 160, "OPENCV", (180, 182, 101, 79, -0.3, 0.1, 0.0, 0.0), POSE)
    point = np.array([[0.2, -0.15, 0.0]])
    image = np.zeros((160, 200), np.float32)
    y, x = np.mgrid[:160, :200] + 0.5
    spot = cameras.project(camera, point)[0][0]
    image[:] = np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / 8)
    flat = sampling.undistort_image(image, camera)
    centroid = np.array([(flat * x).sum(), (flat * y).sum()]) / flat.sum()
    np.testing.assert_allclose(
        centroid, cameras.project(cameras.pinhole(camera), point)[0][0], atol=0.15
    )


@pytest.mark.parametrize("size", [(3840, 2160), (1917, 1081), (50, 40)])
def test_interpolated_maps_are_close_to_the_lens(size):
    width, height = size
    params = (0.6 * width, 0.6 * width, 0.51 * width, 0.48 * height, -0.3, 0.1, 0.001, -0.001)
    camera = Camera("a", width, height, "OPENCV", params, POSE)
    x, y = sampling.undistort_maps(camera)
    assert x.shape == y.shape == (height, width)
    rows, columns = np.arange(0, height, 7), np.arange(0, width, 7)
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2) + 0.5
    xy = (pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    exact = cameras.distort(camera, xy) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2] - 0.5
    found = np.stack([m[np.ix_(rows, columns)].ravel() for m in (x, y)], axis=1)
    assert np.abs(found - exact).max() < 0.005


def test_calibration_file_round_trip(tmp_path):
    path = tmp_path / "calibration.json"
    calibration_file.write_cameras(path, {"a": OPENCV})
    back = calibration_file.read_cameras(path)["a"]
    assert back.params == OPENCV.params
    np.testing.assert_array_equal(back.cam_from_world, OPENCV.cam_from_world)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"params": [1, 2, 3]}, "has params: got shape"),
        ({"world_to_camera": [[1, 0], [0, 1]]}, r"shape \(2, 2\), expected \(4, 4\)"),
        ({"world_to_camera": (2 * np.eye(4)).tolist()}, "is not a rotation"),
        ({"world_to_camera": np.full((4, 4), 1e300).tolist()}, "got 1e.300, expected"),
        ({"model": "FISHY"}, "is unknown"),
        ({"params": [-1, 82, 31, 25, 0, 0, 0, 0]}, "focal length -1"),
        ({"width": 0}, "positive integer"),
    ],
)
def test_a_bad_camera_is_named(tmp_path, change, message):
    import json

    path = tmp_path / "calibration.json"
    calibration_file.write_cameras(path, {"cam07": OPENCV})
    table = json.loads(path.read_text())
    table["cam07"] |= change
    path.write_text(json.dumps(table))
    with pytest.raises(CalibrationError, match=message) as caught:
        calibration_file.read_cameras(path)
    assert "cam07" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_point_nearest_to_lines_is_where_they_meet():
    point, directions = np.array([0.1, -0.2, 0.3]), np.eye(3)
    origins = point - directions * [[2.0], [3.0], [-1.0]]
    assert np.allclose(cameras.nearest_to_lines(origins, directions, 1e-6), point)
    beside = cameras.nearest_to_lines([[0, 0, 0], [0, 0, 1]], [[1.0, 0, 0], [0, 1.0, 0]], 1e-6)
    assert np.allclose(beside, [0, 0, 0.5])
    assert cameras.nearest_to_lines(origins, np.tile(directions[0], (3, 1)), 1e-6) is None
