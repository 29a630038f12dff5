"""Calibration recovers known rigs, and names what it cannot use."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from express50.errors import CalibrationError, CaptureError
from express50.files.calibration import write_cameras
from express50.geometry.sampling import pictured_share
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.rigs.camera_builder import in_metres
from express50.rigs.world_frame import canonical_from_rig, meeting_point, move_cameras
from pipelines import calibrate
from pipelines.calibrate.board import (
    BoardCorners,
    board_footage,
    board_from_table,
    detect_corners,
    gather,
    make_detector,
    opencv_board,
    read_corners,
)
from pipelines.calibrate.board_adjust import BoardRig, corner_errors
from pipelines.calibrate.board_rig import solve_rig
from pipelines.calibrate.stage import check_given
from tests.pipelines.board_rigs import (
    BOARD,
    POINTS,
    board_motion,
    make_rig,
    observe,
    render_board,
    rig_errors,
    sizes_of,
)
from tests.stages import ingest_captures, run_here
from tests.synth import make_capture, write_video


def solve(rig, observations: BoardCorners, model: str = "auto"):
    """Solve with the default settings."""
    return solve_rig(observations, POINTS, sizes_of(rig), model)


def changed(observations: BoardCorners, camera: str, pixels) -> BoardCorners:
    """The observations with one camera's pixels (N, 2) mapped by a function."""
    mine = observations.camera == observations.cameras.index(camera)
    out = observations.pixels.copy()
    out[mine] = pixels(out[mine])
    return replace(observations, pixels=out)


@pytest.mark.parametrize(("count", "noise"), [(4, 0.1), (6, 0.3)])
def test_a_noisy_rig_is_recovered(count: int, noise: float) -> None:
    rig = make_rig(count, distance=0.85)
    solution = solve(rig, observe(rig, board_motion(40, 1), noise))
    rotation, position, focal = rig_errors(solution.cameras, rig)
    assert rotation < 0.1 and position < 2e-3 and focal < 0.3
    assert not solution.dropped and not solution.weak
    rms = np.sqrt(np.mean(np.sum(solution.errors**2, axis=1)))
    assert 1.25 * noise < rms < 1.45 * noise  # sqrt(2) noise, a little less for fitting


def test_exact_corners_give_the_exact_rig() -> None:
    rig = make_rig(4)
    solution = solve(rig, observe(rig, board_motion(20, 2), 0.0), "OPENCV")
    rotation, position, focal = rig_errors(solution.cameras, rig)
    assert rotation < 1e-3 and position < 1e-5 and focal < 1e-3


def test_scale_is_the_boards() -> None:
    rig = make_rig(3)
    observations = observe(rig, board_motion(20, 3), 0.05)
    once = solve(rig, observations).cameras
    twice = solve_rig(observations, 2 * POINTS, sizes_of(rig)).cameras
    for a, b in (("cam00", "cam01"), ("cam01", "cam02")):
        ratio = np.linalg.norm(twice[a].center - twice[b].center) / np.linalg.norm(
            once[a].center - once[b].center
        )
        assert ratio == pytest.approx(2.0, rel=1e-5)


def test_a_lens_seen_in_its_middle_alone_does_not_fold_further_out() -> None:
    rig = make_rig(3, focal=500.0)
    found = observe(rig, board_motion(30, 0), 0.3)
    off = found.pixels - [320, 240]
    square = np.sum((off / 500) ** 2, axis=1, keepdims=True)
    # The polynomial that fits best turns back at 0.84 of a focal length from the middle.
    bent = [320, 240] + off * (1 + 0.1 * square - 0.8 * square**2)
    mine, wide = found.camera == 0, np.linalg.norm(off, axis=1) > 130
    found = replace(found, pixels=np.where(mine[:, None], bent, found.pixels))
    solution = solve(rig, found.select(~(mine & wide)))
    assert all(pictured_share(camera) == 1 for camera in solution.cameras.values())
    assert np.sqrt(np.mean(np.sum(solution.errors**2, axis=1))) < 0.45


def test_bad_corners_do_not_move_the_rig() -> None:
    rig = make_rig(4)
    observations = observe(rig, board_motion(25, 4), 0.1)
    rng = np.random.default_rng(0)
    bad = rng.random(len(observations.corner)) < 0.02
    pixels = observations.pixels + bad[:, None] * rng.normal(size=(len(bad), 2)) * 15
    solution = solve(rig, replace(observations, pixels=pixels))
    rotation, position, focal = rig_errors(solution.cameras, rig)
    assert rotation < 0.1 and position < 2e-3 and focal < 0.3
    assert np.linalg.norm(solution.errors, axis=1).max() < 2.0


def mirrored(observations: BoardCorners, *cameras: str) -> BoardCorners:
    """The observations with the pictures of some cameras mirrored."""
    for camera in cameras:
        observations = changed(observations, camera, lambda p: p * [-1, 1] + [640, 0])
    return observations


def test_mirrored_images_are_named() -> None:
    rig = make_rig(4)
    solution = solve(rig, mirrored(observe(rig, board_motion(20, 5), 0.1), "cam02"))
    assert "switch mirroring off" in solution.dropped["cam02"]
    assert sorted(solution.cameras) == ["cam00", "cam01", "cam03"]
    assert rig_errors(solution.cameras, rig)[0] < 0.1


def test_a_rig_that_is_mirrored_as_a_whole_is_refused_in_one_line() -> None:
    rig = make_rig(3)
    with pytest.raises(CalibrationError, match="cam00, cam01, cam02 are mirrored") as error:
        solve(rig, mirrored(observe(rig, board_motion(20, 5), 0.1), *rig))
    assert "\n" not in str(error.value)


def test_cameras_behind_a_board_that_is_printed_on_both_sides_are_tied_in() -> None:
    rig = make_rig(6, span_deg=360)
    solution = solve(rig, observe(rig, board_motion(30, 13, span_deg=120), 0.1, both_sides=True))
    assert not solution.dropped and rig_errors(solution.cameras, rig)[0] < 0.1


def test_a_rig_whose_every_camera_is_out_of_step_is_refused_in_one_line() -> None:
    rig = make_rig(4)
    observations = observe(rig, board_motion(24, 7), 0.1)
    late = (observations.frame + 5 * observations.camera) % 24
    with pytest.raises(CalibrationError, match="cam00, .*, cam03: .* synchronise it") as error:
        solve(rig, replace(observations, frame=late))
    assert "\n" not in str(error.value)


def test_a_camera_stays_where_some_of_its_images_fit() -> None:
    rig = make_rig(4)
    observations = observe(rig, board_motion(40, 14), 0.1)
    late = (observations.camera == 1) & (observations.frame % 5 < 3)
    shifts = np.random.default_rng(0).normal(size=(40, 2)) * 12
    pixels = observations.pixels + late[:, None] * shifts[observations.frame]
    solution = solve(rig, replace(observations, pixels=pixels))
    assert not solution.dropped and "corners fit the other cameras" in solution.weak["cam01"]
    assert rig_errors(solution.cameras, rig)[0] < 0.1


def test_random_corners_are_named() -> None:
    rig = make_rig(4)
    observations = observe(rig, board_motion(20, 6), 0.1)
    rng = np.random.default_rng(1)
    garbage = changed(observations, "cam01", lambda p: rng.uniform(0, (640, 480), p.shape))
    solution = solve(rig, garbage)
    assert "cam01" in solution.dropped and len(solution.cameras) == 3
    assert rig_errors(solution.cameras, rig)[0] < 0.1


def test_a_camera_out_of_step_is_named() -> None:
    rig = make_rig(5)
    observations = observe(rig, board_motion(20, 7), 0.1)
    frame = observations.frame.copy()
    late = observations.camera == 1
    frame[late] = (frame[late] + 3) % 20
    solution = solve(rig, replace(observations, frame=frame))
    assert "synchronise it" in solution.dropped["cam01"]
    assert rig_errors(solution.cameras, rig)[0] < 0.1


def test_a_camera_is_dropped_if_the_last_rejection_leaves_it_too_few_corners() -> None:
    rig, rng = make_rig(4), np.random.default_rng(4)
    corners = observe(rig, board_motion(14, 4), 0.1, 4)
    ways = np.exp(1j * rng.uniform(0, 2 * np.pi, 14)).view(float).reshape(-1, 2)
    away = 13.0 * ways[np.searchsorted(np.unique(corners.frame), corners.frame)]
    pixels = corners.pixels + np.where(corners.camera[:, None] == 3, away, 0.0)
    solution = solve_rig(replace(corners, pixels=pixels), POINTS, sizes_of(rig), rounds=2)
    assert sorted(solution.dropped) == ["cam03"] and "cam03" not in solution.cameras
    assert (solution.corners.camera != 3).all()


def test_a_camera_that_sees_no_board_is_dropped_and_the_others_are_solved() -> None:
    rig = make_rig(4)
    observations = observe(rig, board_motion(20, 8), 0.1)
    solution = solve(rig, observations.select(observations.camera != 3))
    assert "in 0 images" in solution.dropped["cam03"] and len(solution.cameras) == 3


def test_a_camera_with_few_corners_is_reported_as_weak() -> None:
    rig = make_rig(4)
    observations = observe(rig, board_motion(30, 9), 0.1)
    rare = (observations.camera != 2) | (observations.frame % 6 == 0)
    solution = solve(rig, observations.select(rare))
    assert "cam02" in solution.weak and "cam02" in solution.cameras


def test_no_board_anywhere_is_one_clear_error() -> None:
    rig = make_rig(2)
    with pytest.raises(
        CalibrationError, match="no camera can be calibrated.*cam01: at least 8 corners"
    ):
        solve(rig, gather([], rig))


def test_the_simplest_lens_that_fits_is_chosen() -> None:
    plain = {n: replace(c, params=(*c.params[:4], 0, 0, 0, 0)) for n, c in make_rig(3).items()}
    plain = {
        n: replace(c, params=(c.params[0], *c.params[:1], *c.params[2:])) for n, c in plain.items()
    }
    skewed = {n: replace(c, params=(*c.params[:6], 3e-3, -3e-3)) for n, c in make_rig(3).items()}
    boards = board_motion(20, 10)
    for rig, model in ((plain, "SIMPLE_RADIAL"), (skewed, "OPENCV")):
        cameras = solve(rig, observe(rig, boards, 0.1)).cameras
        assert {camera.model for camera in cameras.values()} == {model}


def test_residuals_of_the_truth_are_the_noise() -> None:
    rig, boards = make_rig(2), board_motion(6, 11)
    observations = observe(rig, boards, 0.0)
    errors = corner_errors(BoardRig(rig, dict(enumerate(boards))), observations, POINTS)
    assert np.abs(errors).max() < 1e-9


def test_corners_of_an_image_are_found_to_a_fraction_of_a_pixel() -> None:
    rig = make_rig(1, focal=500.0)
    camera = rig["cam00"]
    board = board_motion(1, 12, shift=0.0)[0]
    ids, pixels = detect_corners(render_board(camera, board), make_detector(BOARD), BOARD)
    true = observe(rig, [board], 0.0)
    row = {int(c): p for c, p in zip(true.corner, true.pixels, strict=True)}
    errors = np.array([p - row[int(i)] for i, p in zip(ids, pixels, strict=True) if int(i) in row])
    assert len(errors) >= 50
    # A forgotten half pixel would show as a mean of 0.5.
    assert np.abs(errors.mean(axis=0)).max() < 0.02
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.08


def test_corners_in_a_video_are_those_in_its_frames(tmp_path) -> None:
    """The video lies on its side, as a phone stores it; B-frames put its packets out of order."""
    rig, path = make_rig(1, focal=500.0), tmp_path / "cam00.mp4"
    board, images = board_motion(1, 12, shift=0.0)[0], []
    for _ in range(5):
        images.append(render_board(rig["cam00"], board, 2))
        board = make_transform(board[:3, :3], board[:3, 3] + [0.006, 0.002, 0.0])
    turned = [np.ascontiguousarray(np.rot90(image)) for image in images]
    write_video(path, turned, options={"crf": "1"})
    footage = {"cam00": board_footage([path], orientation=6)}
    found = read_corners(BOARD, footage, sizes_of(rig), limit=3)
    assert found.frames == ("000000", "000002", "000004")
    for frame, image in enumerate(images[::2]):
        ids, pixels = detect_corners(image, make_detector(BOARD), BOARD)
        mine = found.frame == frame
        assert len(ids) > 20 and found.corner[mine].tolist() == ids.tolist()
        assert np.abs(found.pixels[mine] - pixels).max() < 0.1


def test_a_truncated_video_of_the_board_is_one_clear_error(tmp_path) -> None:
    write_video(tmp_path / "cam00.mp4", [np.zeros((48, 64, 3), np.uint8)] * 5)
    data = (tmp_path / "cam00.mp4").read_bytes()
    (tmp_path / "cam00.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(CaptureError, match="cam00.mp4: video") as error:
        board_footage([tmp_path / "cam00.mp4"])
    assert "\n" not in str(error.value)


def test_white_on_black_and_mirrored_boards_are_found() -> None:
    rig = make_rig(1, focal=500.0)
    board = board_motion(1, 12, shift=0.0)[0]
    image, true = render_board(rig["cam00"], board, samples=2), observe(rig, [board], 0.0)
    row = dict(zip(true.corner.tolist(), true.pixels, strict=True))
    for look, flip in ((255 - image, False), (image[:, ::-1], True), (255 - image[:, ::-1], True)):
        ids, pixels = detect_corners(look, make_detector(BOARD), BOARD)
        pixels = pixels * [-1, 1] + [640, 0] if flip else pixels
        off = np.linalg.norm(pixels - [row[i] for i in ids.tolist()], axis=1)
        assert len(ids) >= 50 and np.sqrt(np.mean(off**2)) < 0.15


def test_board_points_are_opencvs() -> None:
    theirs = np.asarray(opencv_board(BOARD).getChessboardCorners())
    assert np.allclose(POINTS, theirs)


def test_the_world_is_canonical_whatever_the_start() -> None:
    rig = make_rig(5)
    moved = move_cameras(
        rig, make_transform(axis_angle_to_matrix(np.array([1.0, 2.0, -0.5])), np.array([3, -2, 9]))
    )
    one, two = (move_cameras(c, canonical_from_rig(c, np.zeros(3))) for c in (rig, moved))
    for name in rig:
        assert np.allclose(one[name].cam_from_world, two[name].cam_from_world, atol=1e-9)
    assert np.allclose(meeting_point(one), 0, atol=1e-9)
    middle = np.mean([camera.center for camera in one.values()], axis=0)
    assert middle[2] > 0.5 and abs(middle[0]) < 0.2
    assert np.mean([camera.cam_from_world[1, 1] for camera in one.values()]) < -0.9  # y is up


def test_given_cameras_must_match_the_footage() -> None:
    rig = make_rig(3)
    check_given(rig, sizes_of(rig), "calibration.json")
    with pytest.raises(CalibrationError, match="cam01 is 640x480, its footage is 1280x960"):
        check_given(rig, sizes_of(rig) | {"cam01": (1280, 960)}, "calibration.json")


def test_inverted_given_cameras_are_refused() -> None:
    rig = make_rig(5)
    inverted = {
        n: replace(c, cam_from_world=np.linalg.inv(c.cam_from_world)) for n, c in rig.items()
    }
    turned = {
        n: replace(c, cam_from_world=np.diag([1, -1, -1, 1.0]) @ c.cam_from_world)
        for n, c in rig.items()
    }
    for wrong in (inverted, turned):
        with pytest.raises(CalibrationError, match="lies behind"):
            check_given(wrong, sizes_of(wrong), "calibration.json")


def test_given_cameras_in_millimetres_are_warned_of(tmp_path) -> None:
    rig = make_capture(tmp_path / "S001")
    write_cameras(tmp_path / "S001" / "calibration.json", in_metres(rig, 1000.0))
    dataset = ingest_captures(tmp_path / "data", tmp_path / "S001")
    assert run_here(calibrate.STAGE, dataset, check_frame_sets=0).ok
    (row,) = json.loads(dataset.cameras_file("S001").with_name("metrics.json").read_text())[
        "warnings"
    ]
    assert row["what"] == "cameras" and "in metres?" in row["why"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"squares_x": 2}, "at least 3 x 3"),
        ({"marker_length_m": 0.06}, "marker < square"),
        ({"square_length_m": float("nan")}, "marker < square"),
        ({"dictionary": "DICT_9X9"}, "DICT_9X9"),
        ({"dictionary": "DICT_4X4_50", "squares_x": 20}, "needs 80 markers"),
        ({"squares_y": "many"}, "wrong kind"),
    ],
)
def test_a_wrong_board_is_refused(change: dict, message: str) -> None:
    table = {
        "squares_x": 11,
        "squares_y": 8,
        "square_length_m": 0.05,
        "marker_length_m": 0.037,
        "dictionary": "DICT_5X5_250",
    }
    with pytest.raises(CalibrationError, match=message):
        board_from_table(table | change, "board.toml")
    del table["dictionary"]
    with pytest.raises(CalibrationError, match="dictionary is missing"):
        board_from_table(table, "board.toml")


@pytest.mark.parametrize("moved", [False, True])
def test_a_board_that_is_never_tilted_is_named(moved):
    """A board that stands still, or is only shifted, leaves focal lengths open (Zhang 2000)."""
    rig = make_rig(3, span_deg=40.0)
    still = board_motion(1, seed=0, span_deg=0.0)[0]
    shifts = np.random.default_rng(0).uniform(-0.1, 0.1, (15, 3)) * moved
    boards = [make_transform(still[:3, :3], still[:3, 3] + shift) for shift in shifts]
    solved = solve_rig(observe(rig, boards, 0.3), POINTS, dict.fromkeys(rig, (640, 480)))
    assert set(solved.weak) == set(rig)
    assert all("tilt" in why and "focal length" in why for why in solved.weak.values())


def test_the_adjuster_leaves_the_handling_of_sigterm_as_it_was():
    code = (
        "import os, signal; signal.signal(signal.SIGTERM, lambda *_: print('ours'))\n"
        "import pipelines.calibrate.board_adjust; os.kill(os.getpid(), signal.SIGTERM)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ours\n", "")
