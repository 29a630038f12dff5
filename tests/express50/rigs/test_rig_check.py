"""A misread rig is found out, and the right reading named."""

import json
from dataclasses import replace

import numpy as np
import pytest

from express50.__main__ import main
from express50.files.calibration import read_cameras, write_cameras
from express50.geometry.conventions import FLIP_YZ
from express50.geometry.transforms import look_at
from express50.rigs.world_frame import judge
from tests.express50.rigs.test_read import make_rig, write_transforms


def changed(rig, change):
    return {n: replace(c, cam_from_world=change(c.cam_from_world)) for n, c in rig.items()}


def test_a_good_rig_has_no_problem():
    verdict = judge(make_rig())
    assert verdict.problem == "" and verdict.remedy == "" and verdict.warnings == ()
    assert verdict.distance_m == pytest.approx(1.0, abs=0.05) and verdict.miss_mm < 20
    np.testing.assert_allclose(verdict.meeting, [0, 1.25, 0], atol=0.01)


def rig_around_the_origin():
    rig = make_rig()
    places = zip(list(rig), (-0.9, -0.2, 0.3, 1.2), (0.1, -0.1, 0.2, 0.0), strict=True)
    for camera, angle, lift in places:
        eye = 1.1 * np.array([np.sin(angle), lift, np.cos(angle)])
        rig[camera] = replace(rig[camera], cam_from_world=look_at(eye, np.zeros(3)))
    return rig


@pytest.mark.parametrize("make", [make_rig, rig_around_the_origin])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda T: np.linalg.inv(T), "camera to world: invert"),
        (lambda T: FLIP_YZ @ T, "OpenGL's: flip"),
        (lambda T: np.linalg.inv(T) @ FLIP_YZ, "camera to world with OpenGL"),
    ],
)
def test_misread_matrices_are_named(make, change, words):
    """Inverted, the second rig's point lies in front of all cameras, but the axes miss it."""
    rig = make()
    assert judge(rig).problem == ""
    verdict = judge(changed(rig, change))
    assert verdict.problem and words in verdict.remedy


def test_millimetres_and_a_stray_camera_are_warned_of():
    rig = make_rig()

    def in_mm(T):
        out = T.copy()
        out[:3, 3] *= 1000
        return out

    assert any("metres" in w for w in judge(changed(rig, in_mm)).warnings)
    turned = rig["cam02"].cam_from_world.copy()
    turned[:3] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]]) @ turned[:3]
    rig["cam02"] = replace(rig["cam02"], cam_from_world=turned)
    verdict = judge(rig)
    assert verdict.problem or any("cam02" in w for w in verdict.warnings)


def test_one_camera_has_no_meeting_point():
    verdict = judge(make_rig(count=1))
    assert verdict.meeting is None and verdict.warnings == ()


def test_import_writes_a_calibration_that_is_read_again(tmp_path, capsys):
    write_transforms(tmp_path / "transforms.json", make_rig())
    out = tmp_path / "calibration.json"
    assert main(["cameras", "import", str(tmp_path / "transforms.json"), str(out)]) == 0
    assert "4 cameras (transforms)" in capsys.readouterr().out
    assert len(read_cameras(out)) == 4
    again = ["cameras", "import", str(tmp_path / "transforms.json"), str(out)]
    assert main(again) == 0, "the same cameras may be written again"
    out.write_text("{}")
    assert main(again) == 2 and out.read_text() == "{}"
    assert "--overwrite" in capsys.readouterr().err
    assert main([*again, "--overwrite"]) == 0
    video = tmp_path / "cam0.mp4"
    video.write_text("footage")
    assert main([*again[:-1], str(video), "--overwrite"]) == 2 and video.read_text() == "footage"
    capsys.readouterr()
    assert main(["cameras", "import", str(out), str(out), "--scale", "2", "--overwrite"]) == 2
    assert "both SOURCE and OUT" in capsys.readouterr().err
    assert main(["cameras", "check", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["format"] == "express50"


def test_check_of_an_inverted_rig_fails_and_import_writes_nothing(tmp_path, capsys):
    write_cameras(tmp_path / "bad.json", changed(make_rig(), np.linalg.inv))
    assert main(["cameras", "check", str(tmp_path / "bad.json")]) == 1
    assert "remedy: the matrices are camera to world" in capsys.readouterr().out
    assert main(["cameras", "import", str(tmp_path / "bad.json"), str(tmp_path / "o.json")]) == 1
    assert not (tmp_path / "o.json").exists()


def test_check_prints_the_common_point_without_negative_zeros(tmp_path, capsys):
    write_cameras(tmp_path / "c.json", rig_around_the_origin())
    assert main(["cameras", "check", str(tmp_path / "c.json")]) == 0
    printed = capsys.readouterr().out
    assert "they look at (" in printed and "-0.000" not in printed


def test_wrong_size_is_one_line(tmp_path, capsys):
    write_cameras(tmp_path / "c.json", make_rig())
    assert main(["cameras", "check", str(tmp_path / "c.json"), "--size", "big"]) == 2
    assert "WIDTHxHEIGHT" in capsys.readouterr().err
