"""Calibration from 20 to 20,000 px of focal length; mattes of frames without subject or plate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from express50.errors import CalibrationError
from express50.files.containers import read_picture
from express50.files.images import write_image
from express50.geometry.pixels import linear_to_srgb, srgb_to_linear
from express50.rigs.world_frame import canonical_from_rig, move_cameras
from pipelines.calibrate.board import gather, refine_corners, square_sides
from pipelines.calibrate.board_rig import solve_rig
from pipelines.calibrate.stage import check_given
from pipelines.matte import MatteConfig
from pipelines.matte.key import key_alpha
from pipelines.matte.plates import exposure_gain
from tests.pipelines.board_rigs import POINTS, board_motion, make_rig, observe, rig_errors, sizes_of
from tests.pipelines.matte_scenes import make_scene


def solved(rig, boards, noise: float):
    """Calibrate a rig from its observations of boards."""
    return solve_rig(observe(rig, boards, noise), POINTS, sizes_of(rig), rounds=2)


def test_a_corner_that_was_seen_once_does_no_harm() -> None:
    rig = make_rig(3, span_deg=80)
    corners = observe(rig, board_motion(15, 1, span_deg=80), 0.05)
    keep = corners.corner != 40
    keep[np.flatnonzero(~keep)[0]] = True
    solution = solve_rig(corners.select(keep), POINTS, sizes_of(rig), rounds=2)
    rotation, _, error = rig_errors(solution.cameras, rig)
    assert len(solution.cameras) == 3 and rotation < 0.1 and error < 0.3


@pytest.mark.parametrize(
    ("focal", "size", "distance"),
    [(20.0, (32, 24), 0.7), (900.0, (640, 480), 1.1), (20_000.0, (4096, 3072), 3.0)],
)
def test_focal_lengths_from_20_to_20000_pixels(focal, size, distance) -> None:
    rig = make_rig(3, focal=focal, size=size, distance=distance, span_deg=80)
    solution = solved(rig, board_motion(25, 1, span_deg=80), 1e-4 * size[0] / 6)
    rotation, position, error = rig_errors(solution.cameras, rig)
    assert len(solution.cameras) == 3
    assert rotation < 0.1 and position < 2e-3 * distance and error < 0.3


def test_a_rig_1000_m_from_the_origin_is_solved_as_well() -> None:
    near = solved(make_rig(3), board_motion(15, 2), 0.05)
    far = solved(make_rig(3, far=1000.0), board_motion(15, 2, far=1000.0), 0.05)
    for name, camera in near.cameras.items():
        assert np.allclose(camera.cam_from_world, far.cameras[name].cam_from_world, atol=1e-3)


def test_one_camera_has_a_world_too() -> None:
    solution = solved(make_rig(1), board_motion(12, 3, span_deg=20), 0.05)
    assert np.isfinite(solution.cameras["cam00"].cam_from_world).all()
    assert solution.cameras["cam00"].center[2] > 0.5


def test_one_frame_is_an_error_not_a_guess() -> None:
    rig = make_rig(2)
    with pytest.raises(CalibrationError, match="expected at least 4"):
        solved(rig, board_motion(1, 4), 0.0)


def test_a_board_never_tilted_gives_no_silent_nan() -> None:
    """All views parallel to the image: focal length and distance cannot be told apart."""
    rig = make_rig(1)
    view = observe(rig, [board_motion(1, 5, shift=0.0)[0]], 0.0)
    rows = [("cam00", f"{i}", view.corner, view.pixels + 2.0 * i) for i in range(8)]
    try:
        solution = solve_rig(gather(rows, rig), POINTS, sizes_of(rig), rounds=2)
    except CalibrationError as error:
        assert "no camera can be calibrated" in str(error)
    else:
        assert np.isfinite(solution.cameras["cam00"].params).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 6))
def test_the_canonical_world_is_a_rigid_motion(seed: int, count: int) -> None:
    from express50.geometry.cameras import Camera
    from express50.geometry.transforms import axis_angle_to_matrix, make_transform

    rng = np.random.default_rng(seed)
    cameras = {
        str(i): Camera(
            str(i),
            64,
            64,
            "PINHOLE",
            (60.0, 60.0, 32.0, 32.0),
            make_transform(axis_angle_to_matrix(rng.normal(size=3) * 2), rng.normal(size=3)),
        )
        for i in range(count)
    }
    T = canonical_from_rig(cameras, rng.normal(size=3))
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    moved = move_cameras(cameras, T)
    assert np.allclose(T @ cameras["0"].world_from_cam, moved["0"].world_from_cam)


def test_parallel_and_single_given_cameras_pass() -> None:
    from dataclasses import replace

    camera = make_rig(1)["cam00"]
    beside = replace(camera, id="b", cam_from_world=camera.cam_from_world.copy())
    beside.cam_from_world[0, 3] += 0.3
    check_given({"cam00": camera, "b": beside}, {"cam00": (640, 480), "b": (640, 480)}, "x")
    check_given({"cam00": camera}, {"cam00": (640, 480)}, "x")


def test_refinement_on_a_flat_image_finds_nothing() -> None:
    refined, found = refine_corners(
        np.full((40, 40), 128, np.uint8),
        np.array([[20.0, 20.0], [0.0, 0.0]]),
        np.array([20.0, 0.0]),
    )
    assert not found.any() and np.isfinite(refined).all()
    assert np.array_equal(square_sides(np.zeros((5, 2)), np.zeros((5, 2)), 0.05) > 0, [False] * 5)


def alpha(frame: np.ndarray, plate: np.ndarray, **changes) -> np.ndarray:
    """Alpha of a frame with the default settings, changed."""
    out = key_alpha(frame, plate, np.ones(plate.shape[:2], bool), MatteConfig(**changes).shadow)
    assert np.isfinite(out).all() and out.min() >= 0 and out.max() <= 1
    return out


def test_an_all_background_frame_is_empty() -> None:
    rng = np.random.default_rng(0)
    plate = rng.integers(60, 200, (96, 96, 3)).astype(np.uint8)
    assert alpha(plate, plate).max() == 0
    noisy = np.clip(plate + rng.normal(size=plate.shape) * 4, 0, 255).astype(np.uint8)
    assert alpha(noisy, plate).mean() < 1e-3


def test_an_all_foreground_frame_is_full() -> None:
    rng = np.random.default_rng(1)
    plate = rng.integers(120, 250, (96, 96, 3)).astype(np.uint8)
    assert alpha(np.full_like(plate, 20), plate).mean() > 0.99


@pytest.mark.parametrize("value", [0, 255])
def test_black_and_white_frames_and_plates(value: int) -> None:
    flat = np.full((64, 64, 3), value, np.uint8)
    assert alpha(flat, flat).max() == 0
    assert alpha(255 - flat, flat).min() == 1
    assert np.isfinite(exposure_gain(255 - flat, flat)).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (8, 3), (9, 200)])
def test_tiny_images(shape: tuple[int, int]) -> None:
    plate = np.full((*shape, 3), 100, np.uint8)
    assert alpha(plate, plate).max() == 0
    assert alpha(np.full_like(plate, 220), plate).shape == shape


def test_a_shirt_in_the_colour_of_the_plate_does_not_harm_the_head() -> None:
    """Where it reaches the image's border nothing shows it; enclosed by collar and arms it does."""
    scene = make_scene(30, "dark")
    open_below, enclosed = scene.frame.copy(), scene.frame.copy()
    open_below[210:, 112:144] = scene.plate[210:, 112:144]
    folds = 1 + 0.1 * np.sin(np.arange(20) / 2)[:, None]
    enclosed[205:230, 118:138] = np.clip(scene.plate[205:230, 118:138] * folds, 0, 255)
    assert np.abs(alpha(open_below, scene.plate) - scene.alpha)[:200].mean() < 0.01
    assert alpha(enclosed, scene.plate)[205:230, 118:138].min() > 0.95


@pytest.mark.parametrize("gain", [0.5, 0.8, 1.25])
def test_a_plate_of_another_exposure(gain: float) -> None:
    scene = make_scene(31, "dark")
    light = srgb_to_linear(scene.frame / 255.0) * gain
    frame = np.rint(255 * linear_to_srgb(np.clip(light, 0, 1))).astype(np.uint8)
    assert np.abs(alpha(frame, scene.plate) - scene.alpha).mean() < 0.02


def test_blown_highlights_on_skin_before_a_blown_lamp() -> None:
    """Where both are 255 nothing tells them apart: inside the outline it is the subject."""
    scene = make_scene(32, "fair")
    frame, plate = scene.frame.copy(), scene.plate.copy()
    frame[140:165, 105:150] = 255
    plate[130:175, 95:160] = 255
    found = alpha(frame, plate)
    assert found[142:163, 107:148].min() > 0.95
    assert np.abs(found - scene.alpha).mean() < 0.012


def test_a_shadow_that_moves_from_frame_to_frame() -> None:
    scene = make_scene(33, "dark")
    y, x = np.mgrid[0:256, 0:256] / 256
    for place in (0.12, 0.5, 0.9):
        dark = 1 - 0.2 * np.exp(-(((x - place) / 0.08) ** 2) - ((y - 0.2) / 0.1) ** 2)
        behind = np.where(scene.alpha < 0.5, dark, 1.0)[..., None]
        found = alpha(np.rint(scene.frame * behind).astype(np.uint8), scene.plate)
        assert found[:30].mean() < 0.01
        assert np.abs(found - scene.alpha).mean() < 0.012


def test_sixteen_bits_key_as_eight(tmp_path) -> None:
    scene = make_scene(34, "dark")
    read = []
    for name, image in (("frame", scene.frame), ("plate", scene.plate)):
        write_image(tmp_path / f"{name}.png", image.astype(np.uint16) * 257)
        read.append(read_picture(tmp_path, f"{name}.png"))
    assert np.array_equal(alpha(*read), alpha(scene.frame, scene.plate))


def test_nothing_valid_is_empty() -> None:
    plate = np.full((40, 40, 3), 100, np.uint8)
    nothing = np.zeros((40, 40), bool)
    assert key_alpha(np.full_like(plate, 250), plate, nothing, MatteConfig().shadow).max() == 0


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**31), st.integers(4, 60), st.integers(4, 60))
def test_random_frames_give_finite_alpha(seed: int, height: int, width: int) -> None:
    rng = np.random.default_rng(seed)
    frame, plate = rng.integers(0, 256, (2, height, width, 3)).astype(np.uint8)
    alpha(frame, plate)
