import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.ablate import differences, earned
from express50.errors import ConfigError, DivergedError, FormatError
from express50.files.images import read_image, write_image
from grmm import ablate as ablate_module
from grmm.ablate import VARIANTS
from grmm.anchors import make_anchors
from grmm.checkpoint import load_checkpoint
from grmm.cli import main
from grmm.shard_source import open_shards
from tests.grmm.packed import TINY, write_shards
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config

STEADY = [*TINY, "--set=train.lr=1e-4"]  # three steps at the preset's rate are worse than grey


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    """Two data sets: S000, S001 and the unseen S002; and S003, S004."""
    source = EllipsoidSource(subjects=5, size=32)
    base = tmp_path_factory.mktemp("sets")
    return [
        write_shards(base / "one", source, subjects=("S000", "S001", "S002")),
        write_shards(base / "two", source, subjects=("S003", "S004")),
    ]


@pytest.fixture(scope="module")
def table(roots, tmp_path_factory):
    out = tmp_path_factory.mktemp("ablation")
    assert main(command(roots, out)) == 0
    return out


def command(roots, out):
    return [
        "ablate", str(roots[0]), str(out), f"--also={roots[1]}", *STEADY, "--fit-expression=e0",
        "--holdout-cameras=cam01", "--holdout-expressions=S001/e1", "--fit-cameras=cam00",
    ]  # fmt: skip


def test_every_ablation_of_the_paper_is_a_row(table):
    rows = json.loads((table / "ablation.json").read_text())["rows"]
    assert set(rows) == {*VARIANTS, "without_one", "without_two"}
    full = rows["full"]["groups"]
    # Camera cam01 of 4 subjects x 2 expressions, less the held-out frame.
    assert full["view"]["images"] == 7 and full["expression"]["images"] == 3
    assert full["unseen"]["images"] == 2 and full["unseen_expression"]["images"] == 2
    assert set(rows["without_one"]["groups"]) == {"unseen", "unseen_expression"}
    assert rows["no_locality"]["groups"]["view"] == full["view"]
    for name, row in rows.items():
        got, other = row["difference_db"]["unseen"], rows[row["against"]]["groups"]
        assert got == pytest.approx(
            row["groups"]["unseen"]["psnr_db"] - other["unseen"]["psnr_db"], abs=2e-3
        ), name
    settings = load_checkpoint(table / "no_residuals" / "checkpoint.pt").config.model
    assert settings.identity_modes == 0 and rows["no_residuals"]["against"] == "no_modes"
    assert rows["no_mouth_uv"]["gaussians"] < rows["full"]["gaussians"]
    assert rows["no_refinement"]["parameters"] < rows["full"]["parameters"]
    assert not (table / "no_locality" / "checkpoint.pt").exists()


def test_the_table_is_the_papers(table):
    lines = (table / "ablation.md").read_text().splitlines()
    assert lines[0].startswith("| Method | held-out view: PSNR | SSIM | LPIPS | dB over full |")
    assert any(line.startswith("| W/o residuals, ") and "| -1.63 |" in line for line in lines)
    assert lines[-1].startswith("FID: n/a:") or lines[-3].startswith("LPIPS: n/a:")


def test_finished_rows_are_kept_and_changed_ones_measured_again(table, roots, monkeypatch, capsys):
    before = {p: p.stat().st_mtime_ns for p in table.rglob("checkpoint.pt")}
    trained = []
    monkeypatch.setattr(ablate_module, "train", lambda *a, **k: trained.append(a[2].name))
    assert main(command(roots, table)) == 0
    assert trained == [] and all(p.stat().st_mtime_ns == t for p, t in before.items())
    assert capsys.readouterr().err.count("is measured") == 9
    (table / "no_residuals" / "row.json").unlink()
    assert main(command(roots, table)) == 0
    assert trained == ["no_residuals"]


def test_rows_measured_earlier_stay_in_the_table(table, roots, monkeypatch):
    monkeypatch.delattr(ablate_module, "train")
    written = [(table / name).read_bytes() for name in ("ablation.json", "ablation.md")]
    assert main([*command(roots, table), "--rows=no_mesh_decoder"]) == 0
    assert [(table / name).read_bytes() for name in ("ablation.json", "ablation.md")] == written


def test_a_row_that_diverged_is_marked_and_has_no_figures(roots, tmp_path, monkeypatch, capsys):
    asked = []

    def second(metrics):
        asked.append(metrics["gaussians"])
        return len(asked) == 2

    monkeypatch.setattr(ablate_module, "diverged", second)
    assert main([*command(roots, tmp_path), "--rows=no_mesh_decoder"]) == 1
    said = capsys.readouterr()
    assert "no_mesh_decoder diverged; lower train.lr for all rows, and name" in said.err
    lines = said.out.splitlines()
    assert lines[3].startswith("| W/o mesh decoder (diverged) | n/a | n/a |")
    assert "n/a | n/a | +0.00 |" not in lines[2] and "| +0.00 |" in lines[2]
    rows = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert rows["no_mesh_decoder"]["groups"] == {} and rows["full"]["groups"]["unseen"]


def test_a_row_whose_training_is_not_finite_does_not_stop_the_others(
    roots, tmp_path, monkeypatch, capsys
):
    real = ablate_module.train

    def train(source, head, folder, *rest, **options):
        if folder.name == "full":
            raise DivergedError("iteration 1: the objective is not finite")
        return real(source, head, folder, *rest, **options)

    monkeypatch.setattr(ablate_module, "train", train)
    assert main([*command(roots, tmp_path), "--rows=no_locality,no_mesh_decoder"]) == 1
    said = capsys.readouterr().err
    assert "iteration 1: the objective is not finite" in said
    assert "full diverged" in said and "no_locality diverged" in said
    rows = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert rows["no_locality"]["groups"] == rows["full"]["groups"] == {}
    assert rows["no_mesh_decoder"]["groups"]["unseen"]


def test_a_stopped_ablation_keeps_the_people_it_has_fitted(roots, tmp_path, monkeypatch):
    def stop(*arguments):
        raise KeyboardInterrupt

    arguments = [*command(roots, tmp_path), "--rows=full"]
    with monkeypatch.context() as patch:
        patch.setattr("grmm.fit.evaluate", stop)
        assert main(arguments) == 130
    assert len(list(tmp_path.glob("full/unfinished_fits/*/checkpoint.pt"))) == 1
    with monkeypatch.context() as patch:
        patch.setattr("grmm.fit._finite", stop)  # no step is taken again
        assert main(arguments) == 0
    assert (tmp_path / "full" / "row.json").exists() and not (
        tmp_path / "full" / "unfinished_fits"
    ).exists()


def test_rows_of_other_samples_are_not_replaced(tmp_path, monkeypatch):
    gone_on, real = [], ablate_module.train

    def counted(*arguments, resume):
        gone_on.append(resume)
        real(*arguments, resume=resume)

    monkeypatch.setattr(ablate_module, "train", counted)
    config, row = tiny_config(train={"iterations": 1}), tmp_path / "row"
    packed = [
        write_shards(tmp_path / str(size), EllipsoidSource(subjects=3, size=size))
        for size in (32, 24)
    ]
    for _ in range(2):
        ablate_module._train([packed[0]], row, config)
    before = (row / "checkpoint.pt").read_bytes()
    with pytest.raises(ConfigError, match=r"row: was trained .* \(the samples of the shards\);"):
        ablate_module._train([packed[1]], row, config)
    longer = tiny_config(train={"iterations": 1, "seconds": 9.0})
    with pytest.raises(ConfigError, match=r"row: was trained .* \(train.seconds 0.0 -> 9.0\);"):
        ablate_module._train([packed[0]], row, longer)
    assert gone_on == [False, True] and (row / "checkpoint.pt").read_bytes() == before


def test_what_cannot_be_measured_is_refused_before_training(roots, tmp_path, monkeypatch, capsys):
    monkeypatch.delattr(ablate_module, "train")
    assert main([*command(roots, tmp_path), "--fit-subjects=S001,S002"]) == 2
    assert "training also sees S001; expected people that" in capsys.readouterr().err
    assert main([*command(roots, tmp_path), "--fit-cameras=cam*"]) == 2
    assert "S002: no view is left to measure" in capsys.readouterr().err


def test_every_folder_of_shards_has_a_row_whatever_it_is_called(tmp_path, monkeypatch):
    """Of two folders of one name only the last had one; a relative path gave no name."""
    monkeypatch.chdir(tmp_path)
    roots = [Path("pack/shards"), tmp_path / "a/data/pack/shards", tmp_path / "b/data/pack/shards"]
    rows = ablate_module.variants_of(roots, ())
    added = {name: row.without for name, row in rows.items() if name not in VARIANTS}
    names = [f"without_{name}" for name in (tmp_path.name, "data", "data_3")]
    assert added == dict(zip(names, roots, strict=True))


def test_unknown_rows_are_named(roots, tmp_path, capsys):
    assert main([*command(roots, tmp_path), "--rows=no_residual"]) == 2
    assert "did you mean 'no_residuals'" in capsys.readouterr().err


def test_faces_of_the_mouth_lose_their_gaussians_only():
    head = ellipsoid_head()
    whole, without = make_anchors(head, 32), make_anchors(head, 32, mouth=False)
    gone = sorted(set(whole.texels.tolist()) - set(without.texels.tolist()))
    faces = {int(f) for t, f in zip(whole.texels, whole.faces, strict=True) if int(t) in set(gone)}
    inner = head.regions["mouth_interior"][head.faces].all(1)
    teeth = head.regions["teeth"][head.faces].any(1)
    assert faces and all(inner[f] or teeth[f] for f in faces)
    assert not (inner | teeth)[without.faces].any()


def test_mixed_data_sets_share_expressions_and_refuse_common_subjects(roots):
    mixed = open_shards(roots, "train")
    assert {key.subject for key in mixed.keys} == {"S000", "S001", "S003", "S004"}
    alone = open_shards(roots[1:], "train")
    index = next(i for i, key in enumerate(mixed.keys) if key == alone.keys[4])
    np.testing.assert_array_equal(mixed.read(index).image, alone.read(4).image)
    with pytest.raises(FormatError, match="S000"):
        open_shards([roots[0], roots[0]], "train")


@pytest.fixture(scope="module")
def evaluated(table, roots, tmp_path_factory):
    out = tmp_path_factory.mktemp("evaluated")
    arguments = [
        "evaluate", str(table / "full" / "checkpoint.pt"), str(roots[0]), str(out),
        "--fit-cameras=cam00", "--fit-expression=e0", f"--save={out / 'pictures'}",
    ]  # fmt: skip
    assert main(arguments) == 0
    return out


def test_evaluation_states_what_was_held_out(evaluated):
    kinds = json.loads((evaluated / "evaluation.json").read_text())["by_kind"]
    assert {kind: row["images"] for kind, row in kinds.items()} == {
        "seen view": 6,
        "held-out view": 3,
        "held-out expression": 3,
        "held-out identity, novel view": 2,
        "held-out identity, other expression": 2,
    }


def test_saved_pictures_score_as_they_were_evaluated(evaluated, roots, tmp_path):
    arguments = ["score", str(evaluated / "pictures"), str(roots[0]), str(tmp_path), "--partial"]
    assert main(arguments) == 0
    ours = json.loads((evaluated / "evaluation.json").read_text())
    theirs = json.loads((tmp_path / "evaluation.json").read_text())
    assert theirs["images"] == ours["images"] == 16
    for name, tolerance in (("psnr_db", 0.05), ("ssim", 2e-3), ("rmse", 2e-3)):  # 8 bits
        assert theirs[name] == pytest.approx(ours[name], abs=tolerance)


def test_pictures_of_16_bits_score_as_those_of_8(evaluated, roots, tmp_path):
    (tmp_path / "deep").mkdir()
    found = []
    for path in (evaluated / "pictures").glob("S000_*"):
        write_image(tmp_path / "deep" / path.name, read_image(path).astype(np.uint16) * 257)
    for number, folder in enumerate((evaluated / "pictures", tmp_path / "deep")):
        score = ["score", str(folder), str(roots[0]), str(tmp_path / str(number))]
        assert main([*score, "--subjects=S000"]) == 0
        found.append((tmp_path / str(number) / "evaluation.csv").read_bytes())
    assert found[0] == found[1]


def test_saved_pictures_do_not_replace_others(evaluated, table, roots, tmp_path, capsys):
    pictures = evaluated / "pictures"
    before = {path.name: path.stat().st_mtime_ns for path in pictures.iterdir()}
    arguments = [
        "evaluate", str(table / "full" / "checkpoint.pt"), str(roots[0]), str(tmp_path / "out"),
        "--subjects=S000", f"--save={pictures}",
    ]  # fmt: skip
    assert main(arguments) == 2
    assert (
        "pictures: holds pictures of these samples (S000_e0_cam00.png, " in capsys.readouterr().err
    )
    assert before == {path.name: path.stat().st_mtime_ns for path in pictures.iterdir()}
    assert not (tmp_path / "out").exists()


def test_missing_and_mis_sized_pictures_are_named(evaluated, roots, tmp_path, capsys):
    folder = evaluated / "pictures"
    score = ["score", str(folder), str(roots[0]), str(tmp_path)]
    assert main(score) == 1
    assert "2 of 18 pictures are missing: S002_e0_cam00" in capsys.readouterr().err
    path = Path(folder) / "S000_e0_cam01.png"
    whole = read_image(path)
    try:
        write_image(path, whole[:20])
        assert main([*score, "--partial"]) == 1
        assert "S000_e0_cam01.png is 32 x 20, expected 32 x 32" in capsys.readouterr().err
        assert main(["score", str(roots[0]), *score[2:], "--partial"]) == 1
        assert "18 of 18 pictures are missing" in (said := capsys.readouterr().err)
        assert "--partial" not in said
        path.write_bytes(b"noise")
        assert main([*score, "--partial"]) == 1
        assert "cannot be read" in capsys.readouterr().err
    finally:
        write_image(path, whole)


def test_seeds_give_intervals_and_test_shards_give_people_alone(tmp_path, capsys):
    source = EllipsoidSource(subjects=4, size=32, expressions=1, cameras=2)
    roots = [
        write_shards(tmp_path / name, source, test_subjects=(), subjects=people)
        for name, people in (("train", ("S000", "S001")), ("test", ("S002", "S003")))
    ]
    arguments = [
        "ablate", str(roots[0]), str(tmp_path / "out"), *STEADY, "--fit-expression=e0",
        "--holdout-cameras=cam01", "--fit-cameras=cam00", "--rows=no_mesh_decoder",
        "--fit-budget=9s",
    ]  # fmt: skip
    assert main([*arguments, f"--test={roots[1]}", "--seeds=2"]) == 0
    table = json.loads((tmp_path / "out" / "ablation.json").read_text())["rows"]
    assert set(table) == {"full", "no_mesh_decoder"}
    row, runs = table["no_mesh_decoder"], []
    for ending in ("", ".seed1"):
        folders = [tmp_path / "out" / f"{name}{ending}" for name in ("no_mesh_decoder", "full")]
        groups = [json.loads((f / "row.json").read_text())["groups"] for f in folders]
        runs.append([group["unseen"]["psnr_db"] for group in groups])
    gains = [own - full for own, full in runs]
    assert gains[0] != gains[1] and row["seeds"] == 2
    said = capsys.readouterr()
    assert said.err.count("has no part labels") == 2, "once per folder of shards"
    assert "ablate: 4 trainings and 8 fits of 9.0 s (1:12 min), except for" in said.err
    assert row["difference_db"]["unseen"] == pytest.approx(np.mean(gains), abs=1e-3)
    # Student's 97.5 % point of one degree of freedom is 12.706; half of two values' spread
    assert row["interval_db"]["unseen"] == pytest.approx(
        12.706 * abs(gains[0] - gains[1]) / 2, abs=2e-3
    )
    assert row["groups"]["unseen"]["images"] == 2 and " ± " in said.out
    assert main([*arguments, f"--test={roots[0]}"]) == 2
    assert "training also sees S000, S001; expected" in capsys.readouterr().err


def test_a_row_without_its_first_seed_is_left_out(table, roots, tmp_path, monkeypatch):
    row = json.loads((table / "full" / "row.json").read_text())

    def measured(run, name, variant, seed, wanted):
        return None if (name, seed) == ("no_mesh_decoder", 0) else row

    monkeypatch.setattr(ablate_module, "_row", measured)
    assert main([*command(roots, tmp_path), "--rows=full", "--seeds=2"]) == 0
    rows = json.loads((tmp_path / "ablation.json").read_text())["rows"]
    assert "no_mesh_decoder" not in rows and rows["no_refinement"]["seeds"] == 2


def test_the_benchmark_names_what_is_lost_beyond_its_interval():
    row = {
        "difference_db": {"view": -0.5, "unseen": -0.1},
        "interval_db": {"view": 0.2, "unseen": 0.3},
        "regions_db": {
            "view": {"psnr_mouth_db": (-1.5, 0.4), "psnr_hair_db": (0.5, 0.1)},
            "unseen": {"psnr_mouth_db": (-2.0, None)},  # one seed has no interval
        },
    }
    found = differences(row)
    assert found["view"]["all"] == (-0.5, 0.2) and found["unseen"]["mouth"] == (-2.0, None)
    assert earned(found) == ["view/all", "view/mouth"]
