"""Stated uncertainties are the true errors' size; cameras out of step are brought into step."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from express50.geometry.cameras import project
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.rigs.world_frame import meeting_point
from pipelines.calibrate.board import BoardCorners, gather
from pipelines.calibrate.board_rig import BoardSolution, solve_rig
from pipelines.calibrate.stage import _out_of_step
from pipelines.calibrate.timing import CameraTiming, corner_motion
from pipelines.calibrate.uncertainty import camera_errors, head_points, state_uncertainty
from tests.pipelines.board_rigs import POINTS, board_motion, make_rig, observe, sizes_of


def true_errors(solution: BoardSolution, rig) -> dict[str, float]:
    """Errors in the head's place of the solved cameras, pixels."""
    return camera_errors(solution.cameras, rig, head_points() + meeting_point(rig))


def solved(rig, boards: int, noise: float, seed: int = 0) -> BoardSolution:
    """A rig solved from boards all over its arc."""
    corners = observe(rig, board_motion(boards, seed), noise, seed)
    return solve_rig(corners, POINTS, sizes_of(rig), "OPENCV")


def test_stated_errors_have_the_size_of_true_ones() -> None:
    rig, stated, true = make_rig(3), [], []
    for seed in range(5):
        solution = solved(rig, 24, 0.2, seed)
        stated += [error.px for error in state_uncertainty(solution, POINTS).values()]
        true += true_errors(solution, rig).values()
    assert 0.7 < np.sqrt(np.mean(np.square(stated)) / np.mean(np.square(true))) < 1.4


def test_stated_errors_grow_with_the_noise_and_with_missing_images() -> None:
    rig = make_rig(4)
    one, four = (state_uncertainty(solved(rig, 24, noise), POINTS) for noise in (0.05, 0.2))
    assert all(3 < four[name].px / one[name].px < 5 for name in rig)
    corners = observe(rig, board_motion(24, 0), 0.05)
    rare = corners.select((corners.camera != 2) | (corners.frame % 4 == 0))
    fewer = state_uncertainty(solve_rig(rare, POINTS, sizes_of(rig), "OPENCV"), POINTS)
    assert fewer["cam02"].px > 1.5 * one["cam02"].px
    focal = rig["cam00"].K[0, 0]
    assert one["cam00"].mm == pytest.approx(1100 * one["cam00"].px / focal, rel=0.1)


def test_a_single_camera_has_no_stated_error() -> None:
    rig = make_rig(1)
    boards = board_motion(12, 3, span_deg=20)
    solution = solve_rig(observe(rig, boards, 0.05), POINTS, sizes_of(rig))
    assert state_uncertainty(solution, POINTS) == {}


def hand_held(
    rig, late: Mapping[str, float], readout: Mapping[str, float], digits: int = 4
) -> BoardCorners:
    """Corners of a board that is moved about smoothly before cameras that are late by so much."""
    rng = np.random.default_rng(1)
    size, phase = rng.normal(size=(6, 4)), rng.uniform(0, 7, (6, 4))

    def seen(camera, time: float) -> np.ndarray:
        way = (size * np.sin(np.array([0.31, 0.53, 0.77, 1.1]) * 0.15 * time + phase)).sum(1)
        R = np.diag([1.0, -1.0, -1.0]) @ axis_angle_to_matrix(0.15 * way[:3])
        pose = make_transform(R, 0.04 * way[3:] - R @ POINTS.mean(0))
        return project(camera, POINTS @ pose[:3, :3].T + pose[:3, 3])[0]

    rows = []
    for name, camera in rig.items():
        for frame in range(40):
            time = frame + late.get(name, 0.0)
            pixels, step = seen(camera, time), seen(camera, time + 0.5) - seen(camera, time - 0.5)
            row = pixels[:, 1:] / camera.height - 0.5
            pixels = pixels + readout.get(name, 0.0) * row * step + rng.normal(size=(70, 2)) * 0.1
            ids = np.flatnonzero(((pixels > 0) & (pixels < (640, 480))).all(axis=1))
            rows.append((name, f"take2_{frame + 7:0{digits}d}", ids, pixels[ids]))
    return gather(rows, rig)


def test_cameras_that_are_late_by_part_of_a_frame_are_brought_into_step() -> None:
    rig = make_rig(3, span_deg=80)
    late, readout = {"cam01": 0.4}, {"cam02": 0.5}
    solution = solve_rig(hand_held(rig, late, readout), POINTS, sizes_of(rig))
    for name in rig:
        found = solution.timing[name]
        assert found.late == pytest.approx(late.get(name, 0.0), abs=0.03)
        assert found.readout == pytest.approx(readout.get(name, 0.0), abs=0.05)
    assert not solution.dropped and max(true_errors(solution, rig).values()) < 0.2


def test_frames_are_in_the_order_of_their_numbers_with_and_without_zeros() -> None:
    rig = make_rig(2, span_deg=40)
    padded, plain = (corner_motion(hand_held(rig, {}, {}, digits)) for digits in (4, 1))
    assert padded[0].any(axis=1).mean() > 0.5
    np.testing.assert_array_equal(plain, padded)


def test_cameras_in_step_are_left_as_they_are() -> None:
    rig = make_rig(3, span_deg=80)
    solution = solve_rig(hand_held(rig, {}, {}), POINTS, sizes_of(rig))
    assert sorted(solution.timing) == sorted(rig)
    assert all(found.late == 0 == found.readout for found in solution.timing.values())


def test_a_board_that_jumps_gives_no_timing() -> None:
    rig = make_rig(3, span_deg=80)
    corners = observe(rig, board_motion(30, 7), 0.1)
    assert np.mean(corner_motion(corners)[0].any(axis=1)) < 0.1
    assert not solve_rig(corners, POINTS, sizes_of(rig)).timing


def test_late_and_rolling_cameras_are_named() -> None:
    timing = {
        "a": CameraTiming(0.25, 0.0, 0.01, 0.01),
        "b": CameraTiming(-0.1, 0.5, 0.01, 0.01),
        "c": CameraTiming(0.0, 0.0, 0.01, 0.01),
    }
    found = _out_of_step(timing)
    assert sorted(found) == ["a", "b"]
    assert "0.25 frames late" in found["a"] and "rolling shutter" not in found["a"]
    assert "0.10 frames early" in found["b"] and "rolling shutter" in found["b"]
