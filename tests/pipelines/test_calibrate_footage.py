"""A rig is solved from its footage, and given cameras are refined, only for the better."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from express50.__main__ import main
from express50.contract.layout import Dataset
from express50.errors import CalibrationError, ConfigError
from express50.files.calibration import camera_rows
from express50.files.images import write_image
from express50.geometry.cameras import project
from express50.geometry.conventions import MIRROR_X
from express50.geometry.transforms import axis_angle_to_matrix, make_transform, similarity_fit
from express50.rigs.camera_builder import in_metres
from pipelines.calibrate.config import CalibrateConfig
from pipelines.calibrate.footage import has_one_lens
from pipelines.calibrate.footage_rig import (
    _showing_head,
    mirrored_by_faces,
    pose_of_face,
    resect,
    solve_footage,
    start_camera,
)
from pipelines.calibrate.given_rig import refine_by_footage
from pipelines.calibrate.tracks import FrameSetPoints
from pipelines.calibrate.uncertainty import camera_errors, head_points
from tests.pipelines.board_rigs import rig_errors
from tests.pipelines.face_rigs import SIZE, face, face_cameras, perturbed, see


@pytest.fixture(autouse=True)
def head(monkeypatch):
    monkeypatch.setattr("pipelines.calibrate.footage_rig.mean_landmarks", face)


def solve(rig, seen, focals=None, **settings):
    sizes = dict.fromkeys(rig, SIZE)
    given = {"model": "auto", "distance_m": 1.0, "eye_distance_mm": 63.0} | settings
    return solve_footage(seen, sizes, focals or {}, "capture", **given)


def scale_to(cameras, true):
    names = sorted(cameras)
    centers = [np.stack([rig[n].center for n in names]) for rig in (cameras, true)]
    return similarity_fit(*centers)[0]


@pytest.fixture(scope="module")
def solved():
    rig = face_cameras()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipelines.calibrate.footage_rig.mean_landmarks", face)
        return rig, solve(rig, see(rig))


def test_a_rig_is_solved_in_metres_from_faces_and_features(solved):
    rig, structure = solved
    assert set(structure.cameras) == set(rig) and not structure.dropped and not structure.weak
    assert scale_to(structure.cameras, rig) == pytest.approx(1.0, abs=0.03)
    rotation, position, focal = rig_errors(structure.cameras, rig)
    assert rotation < 0.8 and position < 0.04 and focal < 4
    kept = structure.errors[structure.inliers]
    assert 0.2 < np.sqrt(np.mean(np.sum(kept**2, axis=1))) < 0.8


def test_the_stated_error_at_the_head_is_about_the_true_one(solved):
    rig, structure = solved
    scaled = in_metres(structure.cameras, scale_to(structure.cameras, rig))
    off = camera_errors(scaled, rig, head_points())
    stated = [structure.uncertainty[name].px for name in rig]
    assert 0.4 < np.linalg.norm(stated) / np.linalg.norm(list(off.values())) < 2.5
    for name, camera in rig.items():
        error = structure.uncertainty[name]
        assert error.mm == pytest.approx(1100 * error.px / camera.K[0, 0], rel=0.1)


@pytest.mark.parametrize(("value", "one"), [(None, False), (True, True), (False, False)])
def test_capture_toml_states_whether_lenses_are_the_same(value, one):
    meta = {} if value is None else {"same_lens": value}
    assert has_one_lens(SimpleNamespace(meta=meta, capture=Path("cap"))) is one


@pytest.mark.parametrize("value", ["yes", 1, ["cam00"]])
def test_a_wrong_same_lens_is_one_clear_error(value):
    index = SimpleNamespace(meta={"same_lens": value}, capture=Path("cap"))
    with pytest.raises(CalibrationError, match="same_lens is .*expected true or false"):
        has_one_lens(index)


def test_cameras_said_to_have_the_same_lens_have_nearly_one_focal_length():
    rig = face_cameras()
    focals = [c.K[0, 0] for c in solve(rig, see(rig), same_lens=True).cameras.values()]
    assert np.ptp(np.log(focals)) < 0.004


def test_known_focal_lengths_are_kept_and_other_eyes_scale_the_rig(solved):
    rig, structure = solved
    known = solve(rig, see(rig), {n: c.K[0, 0] for n, c in rig.items()}, eye_distance_mm=126.0)
    assert rig_errors(known.cameras, rig)[2] < 2
    assert scale_to(known.cameras, rig) == pytest.approx(0.5, abs=0.02)
    again = solve(rig, see(rig))
    assert json.dumps(camera_rows(again.cameras)) == json.dumps(camera_rows(structure.cameras))


def test_the_world_is_upright_and_cameras_on_their_side_follow_the_head(solved):
    rig, structure = solved
    ups = -np.mean([c.cam_from_world[1, :3] for c in structure.cameras.values()], axis=0)
    assert ups[1] > 0.95
    quarter = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    turned = {}
    for name, c in rig.items():
        turned[name] = replace(c, cam_from_world=quarter @ c.cam_from_world)
    sideways = solve(turned, see(turned)).cameras
    down = np.mean([c.cam_from_world[1, :3] for c in sideways.values()], axis=0)
    assert abs(down[1]) < 0.3  # their rows do not run along the head's up, and the world's is that


def test_a_camera_without_a_face_is_placed_by_features_or_dropped_with_the_reason():
    rig = face_cameras(7, 150.0)
    seen = see(rig, blind=("cam05", "cam06"))
    for points in seen.values():
        points.features["cam06"] = (np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    structure = solve(rig, seen)
    assert list(structure.dropped) == ["cam06"] and "no face" in structure.dropped["cam06"]
    assert rig_errors(structure.cameras, rig)[0] < 1.0


def test_of_two_groups_without_a_common_frame_set_the_larger_stays():
    rig = face_cameras(5)
    seen = see(rig, sets=2)
    lone = {"cam03", "cam04"}
    parts = {
        k: FrameSetPoints([row for row in m.landmarks if (row[0] in lone) == bool(k)],
                {n: f for n, f in m.features.items() if (n in lone) == bool(k)})
        for k, m in seen.items()
    }  # fmt: skip
    structure = solve(rig, parts)
    assert set(structure.cameras) == {"cam00", "cam01", "cam02"}
    assert set(structure.dropped) == lone and "at the same time" in structure.dropped["cam03"]


def test_no_common_face_is_refused_in_one_line():
    rig = face_cameras(3)
    seen = see(rig, sets=1, blind=("cam01", "cam02"))
    with pytest.raises(CalibrationError, match="a face is seen by cam00: add calibration") as error:
        solve(rig, seen)
    assert "\n" not in str(error.value)
    with pytest.raises(CalibrationError, match="a face is seen by none"):
        solve(rig, see(rig, sets=1, blind=tuple(rig)))


POSES = {"turn_deg": 0.2, "move_mm": 3.0, "lenses": False}


def refined(given, true, **settings):
    return refine_by_footage(given, see(true, sets=4), **(POSES | settings))


def test_footage_puts_a_perturbed_rig_right():
    true = face_cameras()
    given = perturbed(true, 0.3, 5e-3)
    found = refined(given, true)
    assert not found.kept and found.after_px < 0.6 * found.before_px
    before, after = rig_errors(given, true), rig_errors(found.cameras, true)
    assert after[0] < 0.8 * before[0] and after[1] < before[1]
    figures = found.figures(given)
    assert set(figures["moves"]) == set(true) and figures["moves"]["cam00"]["turn_deg"] > 0


def test_a_rig_that_is_right_stays_to_the_bit():
    true = face_cameras()
    found = refined(true, true)
    assert found.kept and found.cameras == true and found.figures(true)["moves"] == {}
    blank = {0: FrameSetPoints([], {n: (np.zeros((0, 2)), np.zeros((0, 128))) for n in true})}
    nothing = refine_by_footage(true, blank, **POSES)
    assert nothing.kept and nothing.figures(true)["held_out_before_px"] is None


def test_lenses_are_refined_where_all_may_move():
    true = face_cameras()
    given = {
        n: replace(c, params=(c.params[0] * (1 + 0.02 * (-1) ** i), *c.params[1:]))
        for i, (n, c) in enumerate(true.items())
    }
    found = refined(given, true, lenses=True)
    assert not found.kept
    assert rig_errors(found.cameras, true)[2] < 0.7 * rig_errors(given, true)[2]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"refine": "some"}, "refine is 'some'; expected none, poses, all"),
        ({"board_frames": -3}, "board_frames is -3, expected 0 or more"),
        ({"rounds": 0}, "rounds is 0"),
        ({"eye_distance_mm": 0.0}, "eye_distance_mm is 0.0"),
        ({"distance_m": float("nan")}, "distance_m is nan"),
    ],
)
def test_settings_that_are_none_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        CalibrateConfig(**settings)


def test_one_image_a_camera_without_faces_is_refused_by_the_stage(tmp_path, capsys, no_faces):
    root = tmp_path / "capture"
    for name in ("a", "b", "c"):
        (root / "cameras" / name / "frames").mkdir(parents=True)
        image = np.full((64, 64, 3), 120, np.uint8)
        write_image(root / "cameras" / name / "frames" / "000000.jpg", image)
    (root / "capture.toml").write_text('subject = "S001"\nfps = 1\nfocal_px = -3\n')
    dataset = Dataset(tmp_path / "data")
    assert main(["ingest", str(dataset.root), str(root), "--workers", "0"]) == 1
    assert "focal_px of all cameras is -3, expected a positive" in capsys.readouterr().out
    (root / "capture.toml").write_text('subject = "S001"\nfps = 1\n')
    assert main(["ingest", str(dataset.root), str(root), "--workers", "0"]) == 0
    assert main(["calibrate", str(dataset.root), "--workers", "0"]) == 1
    assert "a face is seen by none" in capsys.readouterr().out


def test_degenerate_faces_and_matches_give_no_pose():
    camera = start_camera("a", SIZE, 900.0)
    spot = np.full((68, 2), 200.0)
    pose, error = pose_of_face(spot, np.ones(68), camera, np.zeros((68, 3)))
    assert np.isfinite(pose).all() and (error == np.inf or np.isfinite(error))
    same = np.array([[10.0 + i, 20.0, 0, 0, 0] for i in range(40)])
    once = np.array([[10.0, 20.0, 1, 1, 1]] * 40)
    assert resect(same, camera.K) is None and resect(once, camera.K) is None
    assert resect(np.zeros((0, 5)), camera.K) is None


def test_a_camera_that_looks_away_from_the_head_is_not_placed():
    rig = face_cameras()
    turned = make_transform(axis_angle_to_matrix(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    away = replace(rig["cam02"], cam_from_world=turned @ rig["cam02"].cam_from_world)
    assert set(_showing_head(rig, rig, see(rig))) == set(rig)
    assert set(_showing_head({**rig, "cam02": away}, rig, see(rig))) == set(rig) - {"cam02"}


def test_a_camera_without_a_face_is_not_placed_in_front_of_it():
    rig = face_cameras(7, 150.0)
    blind = see(rig, blind=("cam02", "cam06"))
    assert set(_showing_head(rig, rig, blind)) == set(rig) - {"cam02"}


def test_a_camera_that_shares_only_the_room_with_others_is_named():
    rig, last = face_cameras(12, 99.0), "cam11"
    seen, rng = see(rig, sets=1, blind=(last,)), np.random.default_rng(5)
    room = rng.normal(size=(6000, 3)) * [1.0, 0.3, 1.0]
    room *= rng.uniform(2.0, 4.0, (6000, 1)) / np.linalg.norm(room, axis=1, keepdims=True)
    looks = rng.normal(size=(6000, 128)).astype(np.float32)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    for points in seen.values():
        for name, camera in rig.items():
            pixels, _ = project(camera, room)
            shown = ((pixels > 0) & (pixels < SIZE)).all(1)
            own = [np.zeros((0, 2)), np.zeros((0, 128), np.float32)]
            own = own if name == last else points.features[name]
            rows = pixels[shown] + rng.normal(size=(shown.sum(), 2)) * 0.3, looks[shown]
            points.features[name] = tuple(map(np.concatenate, zip(own, rows, strict=True)))
    solved = solve(rig, seen)
    assert last in solved.cameras
    assert list(solved.weak) == [last] and "lies in the room" in solved.weak[last]


@pytest.mark.parametrize(("turn_rad", "mirrored", "named"), [
    (0.05, ("cam01",), {"cam01"}),
    (0.05, (), set()),
    (0.05, ("cam00", "cam01"), set()),  # which half is mirrored cannot be told
    (0.0, ("cam01",), set()),
])  # fmt: skip
def test_a_mirrored_camera_is_named_where_heads_turn(turn_rad, mirrored, named):
    rng = np.random.default_rng(0)

    def turned(scale):
        return make_transform(axis_angle_to_matrix(rng.normal(size=3) * scale), np.zeros(3))

    heads = [turned(turn_rad) for _ in range(6)]
    poses = {}
    for name, camera in face_cameras(count=4).items():
        seen = [camera.cam_from_world @ head @ turned(0.01) for head in heads]
        ways = [MIRROR_X @ pose @ MIRROR_X if name in mirrored else pose for pose in seen]
        poses[name] = {frame: (pose, 1.0) for frame, pose in enumerate(ways)}
    assert set(mirrored_by_faces(poses)) == named
