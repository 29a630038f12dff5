import csv
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from express50 import __version__
from express50.errors import FormatError
from express50.files.atomic import alone_in
from express50.files.images import read_image
from express50.files.video import BT601, EXACT, LIMITED
from express50.shards.writer import PackedSample, ShardWriter
from grmm.checkpoint import load_checkpoint, read_content, redact, write_content
from grmm.cli import build_parser, main
from grmm.cli.commands import _edited_head, train_config
from grmm.edit import trained_head
from grmm.evaluate import IDS, NUMBERS, compare, summarise, summary_lines
from grmm.render import write_video
from grmm.shard_source import ShardSource, seen_window
from tests.grmm.packed import TINY, packed, write_shards
from tests.grmm.synthetic import EllipsoidSource


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Three subjects, the last of them in the test split."""
    root = tmp_path_factory.mktemp("shards")
    return write_shards(root, EllipsoidSource(subjects=3, size=32))


@pytest.fixture(scope="module")
def checkpoint(shards, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    assert main(["train", str(shards), str(out), *TINY, "--holdout-cameras=*1"]) == 0
    return out / "checkpoint.pt"


def test_source_gives_back_what_was_packed(shards):
    source, truth = ShardSource(shards, "*"), EllipsoidSource(subjects=3, size=32)
    index = next(i for i, k in enumerate(source.keys) if k == truth.keys[7])
    got, expected = source.read(index), truth.read(7)
    assert np.abs(got.image.astype(int) - expected.image).mean() < 8  # JPEG
    np.testing.assert_array_equal(got.alpha, expected.alpha)
    np.testing.assert_allclose(got.depth, expected.depth, atol=2.6e-5)
    np.testing.assert_array_equal(got.place.K, expected.place.K)
    for name, value in vars(expected.place.tracked).items():
        np.testing.assert_array_equal(getattr(got.place.tracked, name), value)


def test_what_the_camera_did_not_see_is_left_out():
    meta = {"width": 100, "height": 100, "source_size": [320, 300]}
    whole = seen_window(meta, "x")
    assert whole == (slice(0, 100), slice(0, 100), (100, 100))
    below = meta | {"crop": {"x0": -20, "y0": 250, "side": 100}}
    assert seen_window(below, "x") == (slice(0, 48), slice(22, 100), (100, 100))
    inside = meta | {"crop": {"x0": 50, "y0": 60, "side": 200}}
    assert seen_window(inside, "x") == whole
    with pytest.raises(FormatError, match="outside the footage"):
        seen_window(meta | {"crop": {"x0": 400, "y0": 0, "side": 50}}, "x")


def test_train_sees_the_training_split_only(checkpoint):
    metrics = json.loads((checkpoint.parent / "metrics.json").read_text())
    assert metrics["subjects"] == ["S000", "S001"]
    assert metrics["heldout_cameras"] == ["cam01"] and metrics["iterations"] == 3
    lines = (checkpoint.parent / "log.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["iteration"] == 3


def test_training_again_goes_on_and_refuses_what_differs(shards, tmp_path, capsys, monkeypatch):
    train = ["train", str(shards), str(tmp_path), *TINY]
    assert main(train) == 0
    former, written = capsys.readouterr().out, (tmp_path / "metrics.json").read_bytes()
    assert "PSNR held-out view, dB: n/a\n" in former
    with monkeypatch.context() as patch:
        patch.setattr("grmm.train.evaluate", None)  # takes minutes
        assert main(train) == 0
    said = capsys.readouterr()
    assert "its budget is used up, after 3 iterations in " in said.err
    assert said.out == former and (tmp_path / "metrics.json").read_bytes() == written
    assert main([*train, "--set=train.evaluate_images=1"]) == 0
    assert "measured before" not in capsys.readouterr().err
    assert main([*train, "--set=train.iterations=4"]) == 0
    assert "resuming at iteration 3" in capsys.readouterr().err
    steps = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [step["iteration"] for step in steps] == [3, 4]

    before = (tmp_path / "checkpoint.pt").read_bytes()
    assert main([*train, "--set=train.lr=0.003"]) == 2
    printed = capsys.readouterr().err
    assert "train.lr 0.002 -> 0.003" in printed and "--overwrite" in printed
    write_shards(tmp_path / "others", EllipsoidSource(subjects=3, size=24))
    assert main(["train", str(tmp_path / "others"), str(tmp_path), *TINY]) == 2
    assert "the samples of the shards" in capsys.readouterr().err
    write_shards(tmp_path / "fewer", EllipsoidSource(subjects=3, size=32), ("S001", "S002"))
    assert main(["train", str(tmp_path / "fewer"), str(tmp_path), *TINY]) == 2
    words = "the subjects of the shards (S001 only before or only now); the samples of the shards."
    assert words in capsys.readouterr().err
    assert (tmp_path / "checkpoint.pt").read_bytes() == before

    assert main([*train, "--overwrite", "--set=train.lr=0.003"]) == 0
    assert "resuming" not in capsys.readouterr().err
    assert json.loads((tmp_path / "metrics.json").read_text())["iterations"] == 3


def test_fit_reports_held_out_views_and_writes_over_nothing(checkpoint, shards, tmp_path, capsys):
    fit = ["fit", str(checkpoint), str(shards), str(tmp_path / "fit"), "--subject=S002"]
    assert main([*fit, "--expression=e0", "--cameras=cam00,cam01", "--seconds=30"]) == 0
    metrics = json.loads((tmp_path / "fit" / "metrics.json").read_text())
    stages = metrics["stages"]
    assert metrics["held_out_cameras"] == ["cam02"]
    assert metrics["psnr_db"] == stages["stage2"]["psnr_held_out_db"]
    assert stages["stage2"]["psnr_given_db"] > stages["mean_code"]["psnr_given_db"]
    made = tmp_path / "fit" / "checkpoint.pt"
    before = made.read_bytes()
    assert main(fit) == 2 and main([fit[0], str(made), *fit[2:], "--overwrite"]) == 2
    assert made.read_bytes() == before, "neither a former fit nor the checkpoint read is replaced"
    trained = checkpoint.read_bytes()
    onto = [fit[0], str(made), fit[2], str(checkpoint.parent), *fit[4:]]
    assert main([*onto, "--overwrite"]) == 2
    assert checkpoint.read_bytes() == trained, "--overwrite replaces fits, not trainings"
    capsys.readouterr()
    assert main(onto) == 2 and "is of a training, not of a fit" in capsys.readouterr().err


def test_a_stopped_fit_goes_on_and_another_is_refused(
    checkpoint, shards, tmp_path, monkeypatch, capsys
):
    fit = ["fit", str(checkpoint), str(shards), str(tmp_path), "--subject=S002"]
    with monkeypatch.context() as patch:
        patch.setattr("grmm.fit._finite", lambda loss, *_: os.kill(os.getpid(), 2) or loss)
        assert main(fit) == 130
        assert "the same command makes the rest" in capsys.readouterr().err
        for name in ("metrics.json", "given.jpg", "held_out.jpg"):
            (tmp_path / name).write_text("of an earlier fit")
        assert main([*fit, "--overwrite"]) == 130
        assert "the same command without --overwrite makes the rest" in capsys.readouterr().err
        assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
    assert main([*fit, "--set=fit.stage2_lr=0.5"]) == 2
    assert "cannot resume, these differ: fit.stage2_lr " in capsys.readouterr().err
    assert main(fit) == 0
    assert "resuming stage 1 at iteration 1\n" in capsys.readouterr().err
    assert main(fit) == 2
    assert "checkpoint.pt exists; name another folder" in capsys.readouterr().err


def test_the_figure_of_a_held_out_expression_is_printed(shards, tmp_path, capsys):
    train = ["train", str(shards), str(tmp_path), *TINY, "--holdout-expressions"]
    assert main([*train, "S000/e0"]) == 0
    said = capsys.readouterr()
    assert re.search(r"^PSNR held-out expression, dB: \d", said.out, re.MULTILINE)
    assert "cannot be measured" not in said.err and "measuring the model" in said.err


def test_held_out_expressions_without_a_code_are_named(shards, tmp_path, capsys):
    train = ["train", str(shards), str(tmp_path), *TINY, "--holdout-expressions=*/e0"]
    assert main(train) == 0
    line = "2 frames cannot be measured, because nothing of the person or the expression was"
    assert f"{line} trained or fitted: S000/e0, S001/e0\n" in capsys.readouterr().err
    checkpoint, out = str(tmp_path / "checkpoint.pt"), str(tmp_path / "e")
    assert main(["evaluate", checkpoint, str(shards), out, "--subjects=S000"]) == 0
    assert "1 frame cannot be measured" in capsys.readouterr().err
    fitted = ["--subjects=S002", "--fit-cameras=cam00", "--fit-expression=e1"]
    assert main(["evaluate", checkpoint, str(shards), out, *fitted]) == 0
    said = capsys.readouterr().err
    assert said.count("cannot be measured") == 1 and "trained or fitted: S002/e0\n" in said
    evaluate = ["evaluate", checkpoint, str(shards), out, "--subjects=S000", "--expressions=e0"]
    for more in ([], ["--fit-cameras=cam00"]):  # which fits only people without codes
        assert main([*evaluate, *more]) == 2
        words = "the checkpoint has no codes of e0; choose among the expressions that were trained"
        assert f"{words}: e1" in capsys.readouterr().err


def test_render_writes_a_picture_per_frame_and_pair(checkpoint, tmp_path, capsys):
    assert main(["render", str(checkpoint), str(tmp_path), "--turntable", "--frames=2"]) == 0
    with av.open(str(tmp_path / "turntable.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 2
    said = capsys.readouterr().err  # before what may take minutes
    assert said == "".join(
        f"drawing {name}, 32 x 32 px{more}\n"
        for name, more in (("grid.jpg", " per picture"), ("turntable.mp4", ""))
    )
    picture, grid = (read_image(tmp_path / name) for name in ("picture.png", "grid.jpg"))
    assert picture.std() > 10, "a head, not one grey"
    assert grid.shape[0] >= 2 * picture.shape[0] and grid.shape[1] >= 2 * picture.shape[1]


def test_render_sets_aside_what_an_earlier_call_drew(checkpoint, tmp_path, capsys):
    """A sheet of another head stayed beside the new picture."""
    render = ["render", str(checkpoint), str(tmp_path)]
    assert main([*render, "--views", "--controls"]) == 0
    views = (tmp_path / "views.jpg").read_bytes()
    (tmp_path / "notes.txt").write_text("mine")
    capsys.readouterr()
    assert main([*render, "--subject=S001", "--controls"]) == 0
    shown = {"picture.png", "grid.jpg", "controls.jpg", "notes.txt", "earlier"}
    assert {path.name for path in tmp_path.iterdir()} == shown
    assert [path.name for path in (tmp_path / "earlier").iterdir()] == ["views.jpg"]
    assert (tmp_path / "earlier" / "views.jpg").read_bytes() == views
    assert "an earlier call drew it: views.jpg\n" in capsys.readouterr().err


def test_render_writes_its_sheets_before_a_video_that_is_stopped(checkpoint, tmp_path, monkeypatch):
    """They were lost, after minutes of drawing, and an earlier grid.jpg stayed."""

    def stop(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("grmm.render.write_video", stop)
    render = ["render", str(checkpoint), str(tmp_path), "--views", "--turntable"]
    assert main(render) == 130
    assert {p.name for p in tmp_path.iterdir()} == {"picture.png", "grid.jpg", "views.jpg"}


def test_residual_codes_of_others_leave_the_mesh_as_it_is(checkpoint, tmp_path):
    loaded, given = load_checkpoint(checkpoint), ["render", str(checkpoint), str(tmp_path)]
    given += ["--subject=S000", "--expression=e0"]
    plain = _edited_head(loaded, build_parser().parse_args(given))
    edited = [*given, "--z-id-of=S001", "--z-exp-of=e1"]
    head = _edited_head(loaded, build_parser().parse_args(edited))
    donor = trained_head(loaded, "S001", "e1")
    assert torch.equal(head.z_id, donor.z_id) and not torch.equal(head.z_id, plain.z_id)
    assert torch.equal(head.z_exp, donor.z_exp) and not torch.equal(head.z_exp, plain.z_exp)
    assert head.tracked is plain.tracked


@pytest.mark.parametrize(("size", "drawn"), [((1, 1), (2, 2)), ((5, 8), (6, 8))])
def test_a_video_has_even_sides(size, drawn, tmp_path):
    write_video(tmp_path / "a.mp4", [np.full((*size, 3), 90, np.uint8)] * 2)
    with av.open(str(tmp_path / "a.mp4")) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert [picture.shape[:2] for picture in pictures] == [drawn] * 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_a_video_states_how_its_colours_are_read(tmp_path):
    """Players took those of 720 lines and more for BT.709: seven levels off here."""
    write_video(tmp_path / "a.mp4", [np.full((720, 64, 3), (200, 60, 40), np.uint8)])
    with av.open(str(tmp_path / "a.mp4")) as video:
        frame = next(video.decode(video=0))
    assert (frame.colorspace, frame.color_range) == (BT601, LIMITED)
    read = frame.to_ndarray(format="rgb24", interpolation=EXACT).astype(int)
    assert np.abs(read - (200, 60, 40)).max() <= 2


def test_a_video_that_cannot_be_written_leaves_no_part_of_it(tmp_path):
    (tmp_path / "a.mp4").mkdir()
    with pytest.raises(IsADirectoryError):
        write_video(tmp_path / "a.mp4", [np.zeros((8, 8, 3), np.uint8)] * 2)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_evaluate_counts_its_images_on_standard_output(checkpoint, shards, tmp_path, capsys):
    evaluate = ["evaluate", str(checkpoint), str(shards), str(tmp_path / "e"), "--json"]
    assert main([*evaluate, "--cameras=cam01"]) == 0
    assert json.loads(capsys.readouterr().out)["images"] == 4
    assert main([*evaluate, "--subjects=S002", "--fit-cameras=cam00", "--fit-expression=e0"]) == 0
    assert json.loads(capsys.readouterr().out)["images"] == 4, "two kinds by two cameras"


def test_people_who_are_known_or_left_out_are_named(checkpoint, shards, tmp_path, capsys):
    fit = ["fit", str(checkpoint), str(shards), str(tmp_path / "f"), "--subject=S001"]
    short = ["--set=fit.stage1_iterations=0", "--set=fit.stage2_iterations=0"]
    assert main([*fit, "--cameras=cam00", *short]) == 0
    assert "S001 was trained on" in capsys.readouterr().err
    metrics = json.loads((tmp_path / "f" / "metrics.json").read_text())
    assert metrics["held_out_cameras"] == ["cam01"], "training saw the person in cam02"
    evaluate = ["evaluate", str(checkpoint), str(shards), str(tmp_path / "e"), "--images=1"]
    assert main(evaluate) == 0
    said = capsys.readouterr()
    assert "left out S002, of whom the checkpoint has no codes" in said.err
    header, row, *_ = said.out.splitlines()
    assert header.split()[:4] == ["views", "images", "PSNR,", "dB"] and row.split()[2] == "1"
    assert "will be replaced" not in said.err
    evaluate[1] = str(tmp_path / "f" / "checkpoint.pt")
    assert main(evaluate) == 0
    said = capsys.readouterr().err
    assert "left out S000, S002" in said and "training did not see" not in said
    kinds = ["--json", "--images=0"]
    capsys.readouterr()
    assert main([*evaluate, *kinds]) == 0
    summary = json.loads(capsys.readouterr().out)["by_kind"]
    assert {kind: row["images"] for kind, row in summary.items()} == {
        "seen view": 4, "held-out view": 2,
    }  # fmt: skip
    assert "e: its evaluation will be replaced; to keep it, stop and name" in said
    before = (tmp_path / "e" / "evaluation.csv").read_bytes()
    assert main([*evaluate, "--fit-cameras=cam00", "--fit-expression=e0"]) == 2
    assert "checkpoint.pt is a fit of S001: it does not hold whom" in capsys.readouterr().err
    assert (tmp_path / "e" / "evaluation.csv").read_bytes() == before


def test_a_training_that_one_person_is_left_of_is_not_taken_for_a_fit(checkpoint, shards, tmp_path):
    copied = shutil.copy(checkpoint, tmp_path / "checkpoint.pt")
    assert redact(copied, "S000")
    evaluate = ["evaluate", str(copied), str(shards), str(tmp_path / "e"), "--subjects=S002"]
    assert main([*evaluate, "--fit-cameras=cam00", "--fit-expression=e0"]) == 0


def test_whether_a_checkpoint_is_of_a_fit_is_recorded(checkpoint, shards, tmp_path, capsys):
    """Trainings with cameras of such names were taken for fits once a person was withdrawn."""
    source = EllipsoidSource(subjects=3, size=32)
    source.cameras = {f"training_{name}": pose for name, pose in source.cameras.items()}
    source.keys = [replace(key, camera=f"training_{key.camera}") for key in source.keys]
    write_shards(tmp_path / "s", source)
    trained = tmp_path / "run" / "checkpoint.pt"
    assert main(["train", str(tmp_path / "s"), str(trained.parent), *TINY]) == 0
    assert redact(trained, "S000") and load_checkpoint(trained).seen_before is None
    before = trained.read_bytes()
    fit = ["fit", str(checkpoint), str(shards), str(trained.parent), "--subject=S002"]
    assert main([*fit, "--overwrite"]) == 2
    assert "is of a training, not of a fit" in capsys.readouterr().err
    assert trained.read_bytes() == before

    made = tmp_path / "fit" / "checkpoint.pt"
    fit[3] = str(made.parent)
    assert main(fit) == 0 and load_checkpoint(made).seen_before == frozenset()
    for path, expected in ((made, frozenset()), (checkpoint, None)):
        content = read_content(path)
        del content["seen_before"]  # as earlier versions wrote it
        write_content(tmp_path / "old.pt", content)
        assert load_checkpoint(tmp_path / "old.pt").seen_before == expected


def test_a_summary_names_a_metric_that_is_missing_once():
    row = dict.fromkeys(NUMBERS, 1.0) | dict.fromkeys(IDS, "")
    lines = summary_lines(summarise([row]))
    assert lines[0] == "views  images  PSNR, dB  PSNR head, dB  SSIM  RMSE"
    assert lines[1].split() == ["all", "1", *["1.0"] * 4] and len(lines) == 4
    assert [line.split(": n/a: ")[0] for line in lines[2:]] == ["LPIPS", "FID"]


def test_export_writes_the_same_gaussians_as_ply_and_npz(checkpoint, tmp_path):
    for name in ("head.ply", "head.npz"):
        assert main(["export", str(checkpoint), str(tmp_path / name)]) == 0
    arrays = np.load(tmp_path / "head.npz")
    body = (tmp_path / "head.ply").read_bytes().partition(b"end_header\n")[2]
    table = np.frombuffer(body, "<f4").reshape(len(arrays["means"]), 17)
    np.testing.assert_array_equal(table[:, :3], arrays["means"])
    np.testing.assert_allclose(np.exp(table[:, 10:13]), arrays["scales"], rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["train", "{shards}", "{out}", "--preset=dmeo"], 2, "paper, paper-plus, small, demo"),
        (["train", "{out}", "{out}", "--budget=9s"], 1, "the index is missing"),
        (["train", "{out}", "{out}"], 1, "the index is missing"),
        (["train", "{out}/absent", "{out}"], 1, "absent: no such folder; name the folder that"),
        (["train", "{checkpoint}", "{out}"], 1, "checkpoint.pt: is a file, not a folder; name"),
        (["score", "{checkpoint}", "{shards}", "{out}"], 1, "checkpoint.pt: is a file, not a"),
        (["train", "{shards}", "{out}", *TINY, "--holdout-cameras=x"], 2,
         "data.holdout_cameras names x; expected some of cam00, cam01, cam02"),
        (["fit", "{checkpoint}", "{shards}", "{out}", "--subject=S9"], 2, "no subject is"),
        (["fit", "{checkpoint}", "{shards}", "{out}/fit", "--subject=*"], 2,
         "got views of 3 subjects (S000, S001, S002), expected one; choose one with --subject"),
        (["fit", "{checkpoint}", "{shards}", "{out}", "--subject=S002", "--set=train.lr=1"], 2,
         "expected fit, metrics, loss"),
        (["fit", "{checkpoint}", "{shards}", "{out}", "--subject=S002", "--cameras=cam00,cam9"], 2,
         "no camera is 'cam9'; the shards have cam00, cam01, cam02"),
        (["score", "{shards}", "{shards}", "{out}", "--cameras=cam00,,cam01"], 2,
         "no camera is ''; the shards have cam00"),
        (["train", "{checkpoint}", "{checkpoint}"], 2, "is a file, expected a folder"),
        (["train", "{shards}", "{out}", *TINY, "--set=loss.ssim=-1"], 2, "loss.ssim is -1"),
        (["train", "{shards}", "{out}", *TINY, "--set=train.lr=-1"], 2, "train.lr is -1"),
        (["evaluate", "{checkpoint}", "{shards}", "{out}", "--subjects=S002"], 2,
         "--fit-cameras"),
        (["evaluate", "{checkpoint}", "{shards}", "{out}", "--heldout", "--cameras=cam00"], 2,
         "training saw every"),
        (["evaluate", "{checkpoint}", "{shards}", "{out}", "--subjects=S002", "--cameras=cam00",
          "--fit-cameras=cam00", "--fit-expression=e0"], 2, "no view is left to measure"),
        (["ablate", "{shards}", "{out}", *TINY, "--fit-subjects=S9,S001"], 2,
         "--fit-subjects: no person 'S9'; expected one of S000, S001, S002"),
        (["config", "trian"], 2, "'trian'"),
        (["score", "{shards}", "{shards}", "{checkpoint}"], 2, "is a file, expected a folder"),
        (["render", "{out}/absent.pt", "{out}"], 1, "absent.pt: no such file"),
        (["render", "{shards}", "{out}"], 1, "is a folder, not a file"),
        (["render", "{checkpoint}", "{out}", "--subject=S9"], 2, "no subject 'S9'"),
        (["render", "{checkpoint}", "{out}", "--samples=3000"], 2,
         "3000 x 2 pictures of 32 x 32 px is larger than 65000 px; lower --size, --samples"),
        (["render", "{checkpoint}", "{out}", "--to=S000/e9"], 2, "e9"),
        (["render", "{checkpoint}", "{out}", "--expression-of=e1"], 2,
         "'e1': expected SUBJECT/EXPRESSION: S000/e1"),
        (["render", "{checkpoint}", "{out}", "--control=z_id.0=1e30"], 2,
         "control z_id.0: got 1e+30, expected -1000 to 1000"),
        (["export", "{checkpoint}", "{out}/head.obj"], 2, "expected one of .html, .ply, .spz"),
        (["export", "{checkpoint}", "{out}/head.html", "--format=splats"], 2,
         "--format splats needs a name that ends in .glb"),
        (["export", "{checkpoint}", "{out}/head.html", "--camera=cam00"], 2,
         "--camera is not for .html pages"),
        (["export", "{checkpoint}", "{out}/head.ply", "--control=jaw=3"], 2,
         "got 1 number, expected 3 with commas between, or jaw.0 to jaw.2 with one"),
    ],
)  # fmt: skip
def test_errors_are_one_line_and_set_the_exit_code(
    arguments, code, message, checkpoint, shards, tmp_path, capsys
):
    names = {"shards": shards, "out": tmp_path, "checkpoint": checkpoint}
    assert main([a.format(**names) if "{" in a else a for a in arguments]) == code
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in error and error.startswith("grmm: ") and "(unexpected, in" not in error
    assert list(tmp_path.iterdir()) == [], "nothing is left half made"


def test_a_file_that_cannot_be_written_is_named_as_it_was_given(checkpoint, tmp_path, capsys):
    (tmp_path / "head.ply").mkdir()
    assert main(["export", str(checkpoint), str(tmp_path / "head.ply")]) == 1
    assert f"IsADirectoryError: {tmp_path / 'head.ply'}: " in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [["render", "--columns=0"], ["render", "--frames=0"], ["render", "--samples=-1"],
     ["render", "--size=100000"], ["view", "--port=99999"], ["view", "--size=0"],
     ["view", "--size=100000"], ["view", "--still=100000"],
     ["render", "--yaw=nan"], ["render", "--seed=-1"]],
)  # fmt: skip
def test_numbers_that_cannot_be_are_refused_at_once(arguments, capsys):
    command, option = arguments
    positional = ["x"] if command == "view" else ["x", "y"]
    with pytest.raises(SystemExit, match="2"):
        build_parser().parse_args([command, *positional, option])
    said = capsys.readouterr().err
    assert "expected a whole number, " in said or "'nan', expected a number, -36000" in said


def test_unseen_people_are_measured_in_the_views_that_are_named(checkpoint, shards, tmp_path):
    arguments = ["evaluate", str(checkpoint), str(shards), str(tmp_path), "--subjects=S002"]
    arguments += ["--fit-cameras=cam00", "--fit-expression=e0", "--cameras=cam02"]
    assert main([*arguments, "--expressions=e1"]) == 0
    rows = list(csv.DictReader((tmp_path / "evaluation.csv").read_text().splitlines()))
    assert {(row["subject"], row["expression"], row["camera"]) for row in rows} == {
        ("S002", "e1", "cam02")
    }


def test_a_stopped_evaluation_keeps_the_people_it_has_fitted(
    checkpoint, shards, tmp_path, monkeypatch
):
    def stop(*arguments):
        raise KeyboardInterrupt

    arguments = ["evaluate", str(checkpoint), str(shards), str(tmp_path), "--subjects=S002"]
    arguments += ["--fit-cameras=cam00", "--fit-expression=e0"]
    with monkeypatch.context() as patch:
        patch.setattr("grmm.fit.evaluate", stop)
        assert main(arguments) == 130
    assert len(list(tmp_path.glob("unfinished_fits/*/checkpoint.pt"))) == 1
    with monkeypatch.context() as patch:
        patch.setattr("grmm.fit._finite", stop)  # no step is taken again
        assert main(arguments) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["evaluation.csv", "evaluation.json"]


def test_a_stopped_evaluation_keeps_what_it_has_measured(checkpoint, shards, tmp_path, monkeypatch):
    def evaluation(name: str) -> list[str]:
        fitted = ["--fit-cameras=cam00", "--fit-expression=e0"]
        saved = f"--save={tmp_path / name / 'pictures'}"
        return ["evaluate", str(checkpoint), str(shards), str(tmp_path / name), *fitted, saved]

    measured = []

    def counted(image, item, *rest):
        if len(measured) == stop_after:
            raise KeyboardInterrupt
        measured.append(item.key)
        return compare(image, item, *rest)

    monkeypatch.setattr("grmm.evaluate.compare", counted)
    stop_after = 1000
    assert main(evaluation("whole")) == 0
    count, stop_after = len(measured), len(measured) + 14  # two of the fitted person's four
    assert main(evaluation("stopped")) == 130
    journal = next(tmp_path.glob("stopped/*/rows.jsonl"))
    journal.write_text(journal.read_text()[:-9])  # the last line was cut short
    stop_after = 1000
    assert main(evaluation("stopped")) == 0
    assert len(measured) == 2 * count + 1
    files = [tmp_path / name / "evaluation.csv" for name in ("whole", "stopped")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert not journal.exists()


def test_a_stopped_evaluation_that_measures_fid_replaces_its_own_pictures(
    checkpoint, shards, tmp_path, monkeypatch, capsys
):
    """The same command refused them as another method's."""

    class Inception(torch.nn.Module):
        def forward(self, images: torch.Tensor, return_features: bool = False) -> torch.Tensor:
            return images.float().mean([2, 3])

    torch.jit.script(Inception()).save(str(tmp_path / "inception.pt"))
    arguments = ["evaluate", str(checkpoint), str(shards), str(tmp_path / "e"), "--cameras=cam01"]
    arguments += [f"--save={tmp_path / 'e/pictures'}", f"--inception={tmp_path / 'inception.pt'}"]
    measured = []

    def stopped(*given):
        measured.append(given)
        if len(measured) == 3:
            raise KeyboardInterrupt
        return compare(*given)

    monkeypatch.setattr("grmm.evaluate.compare", stopped)
    assert main(arguments) == 130
    assert main([*arguments, "--json"]) == 0
    assert len(measured) == 3 + 4, "FID needs all pictures"
    assert json.loads(capsys.readouterr().out)["fid"] > 0
    assert main(arguments) == 2, "a finished evaluation's pictures are not replaced"


def test_config_prints_settings_that_train_takes(tmp_path, capsys):
    assert main(["config", "train", "fit", "--preset=demo", "--set=train.lr=0.003"]) == 0
    printed = capsys.readouterr().out
    assert "# Adam's rate." in printed and "[fit]" in printed
    file = tmp_path / "settings.toml"
    file.write_text(printed)
    args = build_parser().parse_args(["train", "x", "y", "--preset=demo", f"--config={file}"])
    assert train_config(args).train.lr == 0.003


def test_training_saves_by_time_and_reports_that_it_diverged(shards, tmp_path, capsys, monkeypatch):
    import grmm.train

    saved, save = [], grmm.train.save

    def spy(run, *rest):
        saved.append(run.iteration)
        save(run, *rest)

    monkeypatch.setattr(grmm.train, "save", spy)
    monkeypatch.setattr(grmm.train, "GREY_DB", 99.0)
    assert main(["train", str(shards), str(tmp_path), *TINY, "--set=train.save_seconds=1e-6"]) == 1
    assert saved == [1, 2, 3]
    assert "lower train.lr and start over with --overwrite" in capsys.readouterr().err
    assert (tmp_path / "metrics.json").exists()


def test_flags_stand_above_assignments():
    parser = build_parser()
    args = parser.parse_args(
        ["train", "a", "b", "--preset=demo", "--set=train.seconds=5", "--seconds=7"]
    )
    config = train_config(args)
    assert config.train.seconds == 7


def test_both_commands_run_as_modules():
    for name in ("express50", "grmm"):
        command = [sys.executable, "-m", name, "--version"]
        shown = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        assert shown == f"{name} {__version__}\n"


def test_the_guides_python_runs(checkpoint, tmp_path, monkeypatch):
    guide = (Path(__file__).resolve().parents[2] / "docs" / "GUIDE.md").read_text(encoding="utf-8")
    block = guide.split("A trained model:\n\n```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "OUT").symlink_to(checkpoint.parent)
    exec(block.replace('"smile"', '"e0"'), made := {})
    assert made["image"].shape == (32, 32, 3)


def test_help_needs_no_torch():
    code = "import sys, grmm.cli as c; c.build_parser(); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def shards_whose_meta_has(folder: Path, **changes) -> Path:
    """Write one sample whose meta differs; a change to None removes the key."""
    sample = packed(EllipsoidSource(size=32), 0)
    meta = json.loads(sample.members["meta.json"]) | changes
    meta = {name: value for name, value in meta.items() if value is not None}
    members = dict(sample.members) | {"meta.json": json.dumps(meta).encode()}
    writer = ShardWriter(folder, 1 << 24)
    writer.add_group("train", [PackedSample("S000", "e0", "cam00", members)])
    writer.close()
    return folder


def test_shards_without_people_to_train_on_are_refused(tmp_path, capsys):
    source = EllipsoidSource(subjects=1, size=32)
    shards = write_shards(tmp_path / "shards", source, test_subjects=("S000",))
    assert main(["train", str(shards), str(tmp_path / "out"), *TINY]) == 1
    words = "shards: no train samples, only of other splits; rerun 'express50 pack' with more"
    assert words in capsys.readouterr().err


def test_samples_without_a_head_model_are_refused(tmp_path):
    with pytest.raises(FormatError, match="meta names no head model"):
        ShardSource(shards_whose_meta_has(tmp_path, head=None))


@pytest.mark.parametrize(
    "K",
    [np.zeros((3, 3)), np.eye(3), -np.eye(3), np.diag([40.0, 1e30, 1.0]), np.diag([40.0, 40, 2])],
    ids=["zero", "unit", "negative", "huge", "scaled"],
)
def test_impossible_camera_matrices_are_named(tmp_path, K):
    shards = shards_whose_meta_has(tmp_path, K=K.tolist())
    words = rf"train-000000.tar: S000_e0_cam00: K is {re.escape(str(K.tolist()))}, expected"
    with pytest.raises(FormatError, match=words):
        ShardSource(shards).place(0)


@pytest.mark.parametrize(
    "T",
    [np.zeros((4, 4)), np.diag([1.0, 1, -1, 1]), np.diag([1000.0, 1000, 1000, 1])],
    ids=["zero", "mirrored", "in millimetres"],
)
def test_poses_that_are_not_rigid_are_named(tmp_path, T):
    words = "train-000000.tar: S000_e0_cam00: cam_from_world is not a rotation and a translation"
    with pytest.raises(FormatError, match=words):
        ShardSource(shards_whose_meta_has(tmp_path, cam_from_world=T.tolist())).place(0)


def test_mixed_head_models_are_refused(tmp_path, monkeypatch):
    source = EllipsoidSource(size=16)
    samples = [packed(source, 0), packed(source, 1)]
    meta = json.loads(samples[1].members["meta.json"]) | {"head": "/elsewhere/ellipsoid"}
    members = dict(samples[1].members) | {"meta.json": json.dumps(meta).encode()}
    samples[1] = PackedSample("S000", "e0", "cam01", members)
    writer = ShardWriter(tmp_path, 1 << 24)
    writer.add_group("train", samples)
    writer.close()
    with pytest.raises(FormatError, match="'/elsewhere/ellipsoid'"):
        ShardSource(tmp_path).read(1)
    # Two machines may name one model by different paths.
    (tmp_path / "ellipsoid").touch()
    monkeypatch.setenv("EXPRESS50_HEADS", str(tmp_path))
    assert ShardSource(tmp_path).read(1).image.any()


def test_a_head_is_driven_by_tracked_clips(checkpoint, tmp_path, capsys):
    from grmm.checkpoint import load_checkpoint
    from grmm.edit import trained_head, with_expression
    from grmm.render import driven, frontal, picture

    loaded = load_checkpoint(checkpoint)
    frames = [loaded.gallery.frames["S001", name] for name in ("e1", "e0")]
    arrays = {
        name: np.stack([getattr(frame, name) for frame in frames])
        for name in ("expression", "neck", "jaw", "eyes", "R", "t")
    }
    arrays |= {"shape": frames[0].shape, "frames": np.array([3, 4]), "cues": np.array(["a", "b"])}
    arrays["rate"] = np.array(29.97)
    path = tmp_path / "sequence.npz"
    np.savez(path, schema="express50.sequence/1", head=loaded.head_spec, **arrays)
    render = ["render", str(checkpoint), str(tmp_path / "out"), f"--drive={path}"]
    assert main([*render, "--size=32"]) == 0
    with av.open(str(tmp_path / "out" / "driven.mp4")) as video:
        assert float(video.streams.video[0].average_rate) == pytest.approx(29.97, abs=0.01)

    from express50.dataset.tracks import read_sequence

    head, view = trained_head(loaded, "S000", "e0"), frontal(loaded)
    first, _ = driven(loaded, head, read_sequence(path), view)
    donor = with_expression(head, trained_head(loaded, "S001", "e1"))
    donor = type(head)(z_id=head.z_id, z_exp=head.z_exp, tracked=donor.tracked)
    np.testing.assert_array_equal(first, picture(loaded, donor, view))

    assert main([*render[:2], str(tmp_path / "c"), *render[3:], "--drive-cue=c"]) == 2
    assert not (tmp_path / "c").exists()
    assert "expected one of a, b" in capsys.readouterr().err
    np.savez(path, schema="express50.sequence/1", head="flame2023.pkl", **arrays)
    assert main(render) == 2
    assert "head model 'flame2023.pkl'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "a", "b", "--budget", "-4m"], "'-4m' is not a time; expected a number of"),
        (["train", "a", "b", "--budget", "4ch"], "'4ch' is not a time; expected a number of"),
        (["trian"], "unknown 'trian' (did you mean 'train'?)"),
        (["render", "a", "b", "--to", ""], "argument --to: got '', expected a value; is a"),
        (["train", "a", "b", "--holdout-cameras=,"], "argument --holdout-cameras: got ','"),
    ],
)
def test_wrong_usage_is_an_error_that_quotes_the_arguments(arguments, message, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2 and message in capsys.readouterr().err


def test_only_the_first_process_reports(shards, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("grmm.train.train", lambda *unused, **also: {})
    assert main(["train", str(shards), str(tmp_path), *TINY, "--json"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ["export", "{0}", "head.ply", "--drive=clips.npz"],
        ["export", "{0}", "head.glb", "--shards=somewhere"],
        ["export", "{0}", "head.html", "--drive-cue=smile"],
        ["render", "{0}", "pictures", "--drive-cue=smile"],
        ["render", "{0}", "pictures", "--degrees=90"],
        ["render", "{0}", "pictures", "--spread=2"],
        ["render", "{0}", "pictures", "--seed=0"],
        ["render", "{0}", "pictures", "--frames=9"],
        ["render", "{0}", "pictures", "--expression=e1", "--expression-of=S001/e0"],
        ["export", "{0}", "head.ply", "--expression=e1", "--expression-of=S001/e0"],
        ["evaluate", "{0}", "{1}", "out", "--fit-budget=5s"],
        ["evaluate", "{0}", "{1}", "out", "--fit-expression=e0"],
        ["config", "train", "--paper-diff"],
    ],
)
def test_options_that_would_do_nothing_are_refused(
    arguments, shards, checkpoint, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main([text.format(checkpoint, shards) for text in arguments]) == 2
    assert arguments[-1].partition("=")[0] in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_saved_pictures_do_not_go_among_a_datasets_own_files(checkpoint, tmp_path, capsys):
    (tmp_path / "ledger.sqlite").touch()
    evaluate = ["evaluate", str(checkpoint), "shards", str(tmp_path / "grmm")]
    assert main([*evaluate, "--save", str(tmp_path / "labels")]) == 2
    assert "belongs to the dataset" in capsys.readouterr().err


def test_nobody_is_fitted_if_somebody_lacks_the_views(checkpoint, tmp_path, monkeypatch, capsys):
    source = EllipsoidSource(subjects=4, size=32)
    source.keys = [key for key in source.keys if (key.subject, key.expression) != ("S003", "e0")]
    root = write_shards(tmp_path / "shards", source, ("S002", "S003"))
    monkeypatch.setattr("grmm.fit.run_stages", lambda *unused: pytest.fail("fits"))
    evaluate = ["evaluate", str(checkpoint), str(root), str(tmp_path / "out")]
    assert main([*evaluate, "--fit-cameras=cam00", "--fit-expression=e0"]) == 2
    assert "S003" in capsys.readouterr().err


def test_the_command_reads_its_own_arguments(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["grmm", "config", "--preset", "demo"])
    assert main() == 0
    assert "[model]" in capsys.readouterr().out


@pytest.mark.parametrize("command", [["train"], ["evaluate", "{}"]])
def test_two_commands_into_one_folder_are_refused(command, checkpoint, shards, tmp_path, capsys):
    """The first evaluation to end deleted the other's fits."""
    given = [part.format(checkpoint) for part in command] + [str(shards), str(tmp_path / "out")]
    with alone_in(tmp_path / "out"):
        assert main([*given, *(TINY if command == ["train"] else [])]) == 2
    assert "another process writes into this folder" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
