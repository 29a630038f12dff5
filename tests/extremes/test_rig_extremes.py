"""Rigs and rooms that cannot work: each is named in one line that says what to do."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from express50.__main__ import main
from express50.errors import CalibrationError
from express50.files.calibration import write_cameras
from express50.files.images import read_image, write_image
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from pipelines.calibrate.board_rig import solve_rig
from pipelines.calibrate.footage_rig import solve_footage
from pipelines.calibrate.given_rig import check_footage
from pipelines.calibrate.tracks import mirror_features
from pipelines.calibrate.uncertainty import state_uncertainty
from pipelines.matte.stage import _plate
from tests.pipelines import test_calibrate_moves, test_ingest_quality
from tests.pipelines.board_rigs import (
    BOARD,
    POINTS,
    board_motion,
    make_rig,
    observe,
    render_board,
    sizes_of,
)
from tests.pipelines.face_rigs import SIZE, face, face_cameras, see
from tests.pipelines.test_board_uncertainty import hand_held
from tests.pipelines.test_calibrate_moves import write_capture
from tests.pipelines.test_matte_stage import make_dataset, run
from tests.synth import write_frames

pytestmark = pytest.mark.usefixtures("no_faces")
balls = test_calibrate_moves.footage
clips = test_ingest_quality.footage


def calibrated(root: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Ingest root/capture, calibrate, and return the account's lines after the first."""
    data = str(root / "data")
    assert main(["ingest", data, str(root / "capture"), "--workers", "0"]) == 0
    capsys.readouterr()
    main(["calibrate", data, "--workers", "0"])
    return capsys.readouterr().out.splitlines()[1:]


def test_a_board_that_two_cameras_see(tmp_path, capsys) -> None:
    rig, poses = make_rig(4, span_deg=80), board_motion(8, 7, span_deg=80)
    blank = np.random.default_rng(0).integers(0, 90, (480, 640, 3), np.uint8)
    write_capture(tmp_path / "capture", rig, dict.fromkeys(rig, blank))
    board = tmp_path / "capture" / "board"
    for name in ("cam01", "cam02"):
        write_frames(board / name, [render_board(rig[name], pose, 1) for pose in poses])
    table = [f"{name} = {json.dumps(value)}" for name, value in asdict(BOARD).items()]
    (board / "board.toml").write_text("\n".join(table))
    lines = [row for row in calibrated(tmp_path, capsys) if "dropped" in row]
    assert len(lines) == 1 and lines[0].startswith("  dropped cam00, cam03 of S001: ")
    assert "in 0 images, expected at least 4: show it to this camera and a neighbour" in lines[0]


def test_every_camera_out_of_step_by_frames_of_a_moving_board() -> None:
    """Neighbouring frames look alike, so a wrong rig keeps half of the corners."""
    rig = make_rig(3, span_deg=80)
    corners = hand_held(rig, {"cam01": 5.0, "cam02": 10.0}, {})
    with pytest.raises(CalibrationError, match="contradict each other.*synchronise") as error:
        solve_rig(corners, POINTS, sizes_of(rig))
    assert "\n" not in str(error.value)


def test_all_footage_is_out_of_step(clips, tmp_path, capsys) -> None:
    for i, (name, images) in enumerate(sorted(clips.items())):
        write_frames(tmp_path / "capture" / "cameras" / name / "frames", images[9 * i :][:50])
    (tmp_path / "capture" / "capture.toml").write_text('subject = "S001"\nfps = 24\n')
    cues = "expression_id,start_frame,end_frame\nneutral,0,20\n"
    (tmp_path / "capture" / "cues.csv").write_text(cues)
    command = ["ingest", str(tmp_path / "data"), str(tmp_path / "capture"), "--workers", "0"]
    assert main(command) == 0
    (line,) = [row for row in capsys.readouterr().out.splitlines() if "warning" in row]
    assert "warning S001: sync:" in line and "begin at the same moment" in line


def test_one_mirrored_camera_of_a_given_rig(balls, tmp_path, capsys) -> None:
    rig, images = balls
    turned = images | {"cam03": np.ascontiguousarray(images["cam03"][:, ::-1])}
    write_capture(tmp_path / "capture", rig, turned)
    write_cameras(tmp_path / "capture" / "calibration.json", rig)
    (line,) = calibrated(tmp_path, capsys)
    assert line.startswith("  warning S001: cam03: ") and "switch mirroring off" in line


def test_one_mirrored_camera_without_any_calibration(monkeypatch) -> None:
    monkeypatch.setattr("pipelines.calibrate.footage_rig.mean_landmarks", face)
    rig, seen = face_cameras(), {}
    for frame, points in see(rig, features=300).items():
        turned = mirror_features(points.features["cam03"], SIZE[0])
        seen[frame] = replace(points, features=points.features | {"cam03": turned})
    solved = solve_footage(
        seen, dict.fromkeys(rig, SIZE), {}, "capture",
        model="auto", distance_m=1.0, eye_distance_mm=63.0,
    )  # fmt: skip
    assert "switch mirroring off" in solved.dropped["cam03"]
    assert set(solved.cameras) == set(rig) - {"cam03"}


def test_footage_without_features_leaves_a_rig_unchecked(balls) -> None:
    rig, images = balls
    grey = {name: np.full_like(image, 90) for name, image in images.items()}
    found = check_footage(rig, test_calibrate_moves.features_of(grey))
    assert found.points == 0 and found.error_px is None
    assert not found.moved and sorted(found.unchecked) == sorted(rig)


def test_a_plate_of_another_room(capture, tmp_path) -> None:
    dataset = make_dataset(tmp_path, [capture])
    plate = dataset.plate_file("S001", "cam01")
    tiles = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    write_image(plate, np.kron(tiles, np.ones((8, 8, 1), np.uint8)))
    assert read_image(plate).shape == (64, 64, 3)
    for outcome in run(dataset).outcomes:
        (why,) = [note.why for note in outcome.warnings if "plate" in note.why]
        assert "expected 90%: it shows another set or place" in why
        assert why.endswith("photograph the plate again")
        assert [n.what for n in outcome.warnings if n.why == why] == ["cam01"]
    frame, valid = read_image(plate), np.ones((64, 64), bool)
    write_image(plate, np.full((64, 64, 3), 255, np.uint8))
    why = _plate(dataset, "S001", "cam01", frame, valid, "key")[1]
    assert why.startswith("100% of its plate's top and sides is white: the plate is overexposed")


def test_a_camera_that_has_the_head_behind_it_spoils_no_stated_error() -> None:
    rig = make_rig(3)
    solution = solve_rig(observe(rig, board_motion(24, 0), 0.1), POINTS, sizes_of(rig))
    away = make_transform(axis_angle_to_matrix(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    odd = replace(
        solution.cameras["cam02"], cam_from_world=away @ solution.cameras["cam02"].cam_from_world
    )
    stated = state_uncertainty(replace(solution, cameras=solution.cameras | {"cam02": odd}), POINTS)
    assert sorted(stated) == ["cam00", "cam01"]
    assert all(np.isfinite([error.px, error.mm]).all() for error in stated.values())
