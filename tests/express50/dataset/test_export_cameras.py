"""Cameras of exports: centred pictures, and readers that know less than all of a camera."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.dataset.export_avatar import centred, seen_by
from express50.geometry.cameras import Camera, pinhole_camera, project
from express50.geometry.transforms import look_at

shift = st.floats(-15.0, 15.0)


@settings(deadline=None, max_examples=30)
@given(dx=shift, dy=shift, ratio=st.floats(0.9, 1.1), x=st.floats(-0.04, 0.04))
def test_a_reader_that_knows_the_angle_of_view_only_sees_the_same_point(dx, dy, ratio, x) -> None:
    K = np.array([[200.0, 0, 32 + dx], [0, 200.0 * ratio, 24 + dy], [0, 0, 1]])
    camera = pinhole_camera("c", K, 64, 48, look_at([0, 0.1, 1.0], [0, 0, 0]))
    target = centred(camera)
    point = np.array([[x, 0.02, 0.01]])
    pixel, _ = project(camera, point)
    seen = naive_project(target, point)
    expected = (np.linalg.inv(camera.K) @ [*pixel[0], 1])[:2] * target.K[0, 0] + [
        target.width / 2, target.height / 2]  # fmt: skip
    np.testing.assert_allclose(seen[0], expected, atol=1e-6)
    corners = np.array([[0, 0, 1], [64, 48, 1.0]]) @ np.linalg.inv(camera.K).T @ target.K.T
    size = (target.width, target.height)
    assert (corners[:, :2] > -0.03).all() and (corners[1, :2] < np.array(size) + 0.03).all()


def naive_project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """As a reader of camera_angle_x and transform_matrix alone does it."""
    angle = 2 * math.atan(camera.width / (2 * camera.K[0, 0]))
    f = camera.width / 2 / math.tan(angle / 2)
    p = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    return p[:, :2] / p[:, 2:] * f + [camera.width / 2, camera.height / 2]


def test_a_dot_moves_to_where_the_centred_camera_sees_it() -> None:
    K = np.array([[300.0, 0, 41.3], [0, 290.0, 30.8], [0, 0, 1]])
    camera = pinhole_camera("c", K, 90, 70, np.eye(4))
    image = np.zeros((70, 90), np.uint8)
    image[30:34, 52:56] = 255  # centre at corner-origin pixel (54, 32)
    target = centred(camera)
    moved = seen_by(image, camera, target).astype(float)
    y, x = np.mgrid[: target.height, : target.width] + 0.5
    found = np.array([(moved * x).sum(), (moved * y).sum()]) / moved.sum()
    ray = np.linalg.inv(K) @ [54, 32, 1]
    np.testing.assert_allclose(found, (target.K @ ray)[:2], atol=0.02)
    right = pinhole_camera("c", np.diag([300.0, 300, 1]) + [[0, 0, 45], [0, 0, 35], [0, 0, 0]],
                           90, 70, np.eye(4))  # fmt: skip
    assert centred(right) is right and seen_by(image, right, right) is image
