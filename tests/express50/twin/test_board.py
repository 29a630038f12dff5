import cv2
import numpy as np
import pytest

from express50.geometry.cameras import project
from express50.geometry.conventions import opencv_pixels_to_corner
from express50.twin.render import ray_pattern
from express50.twin.rig import (
    _RAYS,
    board_poses,
    charuco_board,
    expose,
    make_rig,
    make_sensor,
    render_board,
)


def facing(cameras, pose):
    """Cameras that the board faces, frontal ones first."""
    normal = -pose[:3, 2]
    aim = {n: normal @ (c.center - pose[:3, 3]) for n, c in cameras.items()}
    return sorted(aim, key=aim.get, reverse=True)


def test_detected_corners_are_where_the_truth_has_them():
    cameras = make_rig(8, 400, 400, 0)
    board = charuco_board()
    errors, found = [], cv2.aruco.CharucoDetector(board)
    for pose in board_poses(4, 0):
        camera = cameras[facing(cameras, pose)[0]]
        picture = render_board(pose, camera, 0)
        image = expose(make_sensor(0, 0), picture, np.random.default_rng(0), 1.0)
        corners, ids, _, _ = found.detectBoard(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        assert ids is not None and len(ids) >= 12
        points = board.getChessboardCorners()[ids.ravel()] @ pose[:3, :3].T + pose[:3, 3]
        true, _ = project(camera, points)
        errors.append(opencv_pixels_to_corner(corners.reshape(-1, 2)) - true)
    errors = np.concatenate(errors)
    assert np.quantile(np.linalg.norm(errors, axis=1), 0.95) < 0.3
    # A half-pixel slip would show as a common shift.
    assert np.abs(np.median(errors, axis=0)).max() < 0.06


def test_rays_are_spread_about_the_middle_of_a_pixel():
    assert np.abs(np.mean(ray_pattern(_RAYS), axis=1)).max() < 1e-6  # or pictures are shifted


@pytest.mark.parametrize("count", [4, 8, 24])
def test_every_camera_sees_the_board_and_neighbours_share_it(count):
    cameras = list(make_rig(count, 64, 64, 0).values())
    seen = np.array(
        [
            [
                -pose[:3, 2] @ (c.center - pose[:3, 3])
                > 0.5 * np.linalg.norm(c.center - pose[:3, 3])
                for c in cameras
            ]
            for pose in board_poses(24, 0)
        ]
    )
    assert seen.sum(0).min() >= 4
    reached = {0}
    for _ in cameras:
        reached |= {
            j for i in reached for j in range(count) if (seen[:, i] & seen[:, j]).sum() >= 2
        }
    assert len(reached) == count
