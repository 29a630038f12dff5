"""Lenses at and beyond what they can picture: inverses are exact, or there are none."""

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.geometry.cameras import MODELS, Camera, project, rays, undistort, unproject

DEPTH_SENSOR = (252, 252, 256, 256, 5.2, 3.4, -2e-5, 3e-5, 0.17, 5.5, 5.0, 0.9)
INVERTIBLE = [
    ("OPENCV", (960, 960, 960, 540, 0.5, 0, 0, 0), (1920, 1080)),
    ("OPENCV", (864, 864, 960, 540, 0.1, 0.2, 0, 0), (1920, 1080)),
    ("OPENCV", (960, 960, 960, 540, -0.32, 0.11, 1e-3, -1e-3), (1920, 1080)),
    ("FULL_OPENCV", DEPTH_SENSOR, (512, 512)),
    ("SIMPLE_RADIAL", (300, 160, 120, 5), (320, 240)),
]
FOLDED = [
    ("SIMPLE_RADIAL", (300, 160, 120, -2), (320, 240)),
    ("SIMPLE_RADIAL", (50, 160, 120, -0.4), (320, 240)),
]


def lens(model, params, size):
    return Camera("c", *size, model, tuple(map(float, params)), np.eye(4))


def grid(camera):
    x, y = np.meshgrid(np.linspace(0, camera.width, 41), np.linspace(0, camera.height, 31))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def there_and_back(camera, pixels):
    ideal = unproject(camera, pixels, np.ones(len(pixels)))
    return ideal, np.abs(project(camera, ideal)[0] - pixels).max(axis=1)


@pytest.mark.parametrize(("model", "params", "size"), INVERTIBLE)
def test_every_pixel_of_an_invertible_lens_has_its_ray(model, params, size):
    camera = lens(model, params, size)
    assert there_and_back(camera, grid(camera))[1].max() < 1e-9


@pytest.mark.parametrize(("model", "params", "size"), INVERTIBLE)
def test_the_inverse_is_that_of_opencv_and_of_colmap(model, params, size):
    camera = lens(model, params, size)
    middle = size * np.array([0.5, 0.5])
    pixels = middle + 0.4 * (grid(camera) - middle)  # both libraries iterate, and fail far out
    ours = unproject(camera, pixels, np.ones(len(pixels)))[:, :2]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    theirs = cv2.undistortPoints(pixels[:, None], camera.K, camera.dist, criteria=criteria)[:, 0]
    again = project(camera, np.insert(theirs, 2, 1, axis=1).astype(np.float64))[0]
    converged = np.abs(again - pixels).max(axis=1) < 1e-9
    np.testing.assert_allclose(ours[converged], theirs[converged], atol=1e-9)
    colmap = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)
    np.testing.assert_allclose(ours, colmap.cam_from_img(pixels), atol=1e-6)
    assert converged.mean() > 0.5


@pytest.mark.parametrize(("model", "params", "size"), FOLDED)
def test_pixels_that_a_folding_lens_never_reaches_have_no_ray(model, params, size):
    camera = lens(model, params, size)
    ideal, error = there_and_back(camera, grid(camera))
    known = np.isfinite(ideal).all(axis=1)
    assert 0 < known.sum() < len(known)
    assert error[known].max() < 1e-9
    assert np.isnan(rays(camera, 8)[1]).any()


def test_a_point_beyond_the_fold_is_not_in_view():
    camera = lens("SIMPLE_RADIAL", (300, 160, 120, -0.3), (320, 240))
    angles = np.radians([0.0, 40.0, 60.0])  # the lens folds at 46 degrees
    points = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    assert np.isnan(project(camera, points)[0]).any(axis=1).tolist() == [False, False, True]


def test_points_far_outside_the_field_overflow_nothing():
    camera = lens("FULL_OPENCV", DEPTH_SENSOR, (512, 512))
    points = np.array([[1e200, 0, 1], [1e155, 1e155, 1e-3], [0, 0, 1e-300], [0, 0, 1.0]])
    assert np.isfinite(project(camera, points)[0]).all(axis=1).tolist() == [
        False,
        False,
        True,
        True,
    ]


def test_single_precision_pixels_give_the_same_rays():
    camera = lens(*INVERTIBLE[2])
    pixels = grid(camera).astype(np.float32)
    one = np.ones(len(pixels), np.float32)
    expected = unproject(camera, pixels.astype(np.float64), np.ones(len(pixels)))
    np.testing.assert_array_equal(unproject(camera, pixels, one), expected)


def number(low, high):
    return st.floats(low, high, allow_subnormal=False)


@settings(max_examples=200, deadline=None)
@given(
    model=st.sampled_from([name for name in MODELS if "PINHOLE" not in name]),
    focal=number(20, 20000),
    radial=st.tuples(*[number(-6, 6)] * 6),
    tangential=st.tuples(*[number(-0.1, 0.1)] * 2),
)
def test_any_lens_gives_rays_that_meet_their_pixels_or_none(model, focal, radial, tangential):
    values = dict(zip(("k1", "k2", "k3", "k4", "k5", "k6"), radial, strict=True))
    values |= {"p1": tangential[0], "p2": tangential[1], "f": focal, "fx": focal, "fy": focal}
    values |= {"cx": 320.0, "cy": 240.0}
    camera = lens(model, [values[name] for name in MODELS[model]], (640, 480))
    ideal, error = there_and_back(camera, grid(camera))
    known = np.isfinite(ideal).all(axis=1)
    assert (error[known] < 1e-6).all()
    centre = np.array([[320.0, 240.0]])
    assert np.allclose(undistort(camera, (centre - (320, 240)) / focal), 0)
