"""The audit finds what was broken by hand, fixes what can be made again, and reports no more."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from express50.__main__ import main
from express50.contract.layout import Dataset
from express50.dataset.audit import audit
from express50.errors import StageError
from express50.files.atomic import write_json
from express50.files.digests import text_digest
from express50.runner.ledger import Ledger
from express50.runner.publish import stage_lock
from pipelines import ingest
from tests.faults import toy
from tests.synth import make_capture

REPOSITORY = Path(__file__).resolve().parents[2]
LATER = toy.after_toy()
STAGES = (toy.STAGE, LATER)
NAMES = ["S001", "S002"]


@pytest.fixture
def dataset(tmp_path):
    found = toy.make_dataset(tmp_path / "data", NAMES)
    run(found)
    return found


def run(dataset):
    assert toy.run_toy(dataset).ok
    return toy.run_toy(dataset, stage=LATER)


def look(dataset, **options):
    result = audit(dataset, STAGES, **options)
    return {(f.kind, f.where): f for f in result.findings}, result


def output(dataset, item="S001", stage="toy"):
    return dataset.item_dir(stage, item) / "deep" / "1.bin"


def flip(path, keep_time=False):
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(bytes(data))
    os.utime(path, ns=times if keep_time else (times[0], times[1] + 1))


def test_an_undisturbed_dataset_is_sound_and_nothing_is_written(dataset):
    before = toy.tree(dataset.root)
    for deep in (False, True):
        found, result = look(dataset, deep=deep)
        assert found == {} and result.notes == [] and result.sound
        assert result.files == 12 and (result.hashed > 0) == deep
    assert toy.tree(dataset.root) == before


@pytest.mark.parametrize(
    ("kind", "harm"),
    [
        ("missing", lambda d: output(d).unlink()),
        ("missing", lambda d: shutil.rmtree(d.item_dir("toy", "S001"))),
        ("missing", lambda d: (d.item_dir("toy", "S001") / "metrics.json").unlink()),
        ("changed", lambda d: flip(output(d))),
        ("changed", lambda d: output(d).write_bytes(b"short")),
    ],
    ids=["file", "folder", "metrics", "byte", "size"],
)
def test_harm_is_found_fixed_and_made_again_to_the_same_bytes(dataset, kind, harm):
    before = toy.tree(dataset.stage_dir("toy"))
    harm(dataset)
    found, result = look(dataset)
    assert list(found) == [(kind, "toy S001")] and not result.sound
    # What was made of the good one stays right: it is not blamed, and not made again.
    found, result = look(dataset, fix=True)
    assert list(found) == [(kind, "toy S001")] and result.sound
    assert not dataset.item_dir("toy", "S001").exists()
    found, result = look(dataset, fix=True)  # nor because the good one is not back yet
    assert found == {} and "toy: 1 of 2 items to do" in result.notes[0]
    assert [o.status for o in toy.run_toy(dataset).outcomes] == ["done", "skipped"]
    assert toy.tree(dataset.stage_dir("toy")) == before
    assert toy.run_toy(dataset, stage=LATER).count("skipped") == 2
    assert look(dataset)[1].sound and not list(dataset.stale_dir.glob("toy/*"))


def test_a_flipped_bit_under_an_old_time_is_found_by_reading_alone(dataset):
    flip(output(dataset), keep_time=True)
    assert look(dataset)[0] == {}
    assert list(look(dataset, deep=True)[0]) == [("changed", "toy S001")]


def test_a_copy_with_other_times_is_sound(dataset, tmp_path):
    shutil.copytree(dataset.root, tmp_path / "copy", copy_function=shutil.copy)
    found, result = look(Dataset(tmp_path / "copy"))
    assert found == {} and result.hashed > 0


def test_output_without_receipt(dataset):
    with Ledger(dataset.ledger) as ledger:
        ledger.forget("toy", ["S001"])
    assert list(look(dataset)[0]) == [("unknown", "toy S001")]
    assert look(dataset, fix=True)[1].sound
    assert run(dataset).ok and look(dataset)[0] == {}


def test_what_nobody_can_make_again_is_never_moved(dataset):
    own = dataset.item_dir("toy", "S001") / "notes.txt"
    own.write_text("by hand")
    output(dataset).unlink()
    stranger = dataset.item_dir("toy", "S009")
    shutil.copytree(dataset.item_dir("toy", "S002"), stranger)
    found, result = look(dataset, fix=True)
    assert set(found) == {("missing", "toy S001"), ("unknown", "toy S009")}
    assert not any(f.fixed for f in found.values()) and not result.sound
    assert own.read_text() == "by hand" and stranger.is_dir()


def test_upstream_made_anew_with_other_bytes_blames_what_was_made_of_the_old(dataset):
    assert toy.run_toy(dataset, word="b").ok
    found, _ = look(dataset)
    assert set(found) == {("outdated", "after S001"), ("outdated", "after S002")}
    one = found["outdated", "after S001"]
    assert "changed since it was made: toy" in one.what
    assert one.fix == f"run 'express50 after {dataset.root}' with the same settings as before"
    old = toy.tree(dataset.stage_dir("after"))
    assert look(dataset, fix=True)[1].sound
    assert toy.tree(dataset.stage_dir("after")) == old  # until a run has better ones
    assert toy.run_toy(dataset, stage=LATER).count("done") == 2
    assert look(dataset)[0] == {}


def test_items_with_the_same_finding_share_a_line(dataset, capsys, monkeypatch):
    monkeypatch.setattr("express50.cli.dataset.stages", lambda: {s.name: s for s in STAGES})
    shutil.rmtree(dataset.stage_dir("after"))
    assert main(["check", str(dataset.root)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("after S001, S002: the ledger has a receipt, but") and len(lines) < 4


def test_a_run_alone_makes_outdated_outputs_again(dataset):
    assert toy.run_toy(dataset, word="b").ok
    assert toy.run_toy(dataset, stage=LATER).count("done") == 2
    assert look(dataset)[0] == {}


def test_downstream_that_read_a_file_replaced_by_hand_is_found(dataset):
    good = toy.tree(dataset.stage_dir("after"))
    flip(output(dataset))
    assert toy.run_toy(dataset, stage=LATER).count("done") == 1  # it reads the wrong bytes
    found, _ = look(dataset)
    # The second cannot be judged before the first is fixed, and is then.
    assert list(found) == [("changed", "toy S001")]
    look(dataset, fix=True)
    toy.run_toy(dataset)
    assert list(look(dataset)[0]) == [("outdated", "after S001")]
    look(dataset, fix=True)
    run(dataset)
    assert look(dataset)[0] == {} and toy.tree(dataset.stage_dir("after")) == good


def test_other_settings_are_a_note_and_nothing_is_set_aside(dataset):
    text = dataset.config_file("toy").read_text()
    dataset.config_file("toy").write_text(text.replace("files = 3", "files = 4"))
    found, result = look(dataset, fix=True)
    words = "toy: outdated S001 and 1 more: settings changed: files was 3, is 4; the next run"
    assert found == {} and words in result.notes[0]
    dataset.config_file("toy").write_text("[toy]\nfils = 3\n")
    found, result = look(dataset, fix=True)
    assert list(found) == [("config", "config/toy.toml")] and not result.sound
    assert "did you mean" in found["config", "config/toy.toml"].what


def test_leftovers_are_swept_and_a_running_stage_is_left_alone(dataset):
    leftover = dataset.staging_dir / f"toy-{0:032x}"
    leftover.mkdir()
    output(dataset).unlink()
    with stage_lock(dataset, "toy"):
        found, result = look(dataset)
        assert found == {} and result.notes == ["toy: is running; its items were not checked"]
        with pytest.raises(StageError, match="another 'toy' is running"):
            look(dataset, fix=True)
        assert leftover.is_dir()
    assert set(look(dataset)[0]) == {("leftover", ".staging toy"), ("missing", "toy S001")}
    assert leftover.is_dir()
    assert look(dataset, fix=True)[1].sound and not leftover.exists()


@pytest.mark.parametrize("harm", ["header", "page", "gone"])
def test_an_unreadable_ledger_is_set_aside_and_outputs_are_made_again(dataset, harm):
    before = toy.tree(dataset.stage_dir("after"))
    data = dataset.ledger.read_bytes()
    if harm == "gone":
        dataset.ledger.unlink()
    elif harm == "header":
        dataset.ledger.write_bytes(b"x" * 200 + data[200:])
    else:
        dataset.ledger.write_bytes(data[:4096] + b"\xff" * (len(data) - 4096))
    found, result = look(dataset)
    assert list(found) == [("ledger", "ledger.sqlite")] and not result.sound
    assert look(dataset, fix=True)[1].sound
    assert len(list(dataset.root.glob("ledger.sqlite.unreadable-*"))) == (harm != "gone")
    assert run(dataset).ok and toy.tree(dataset.stage_dir("after")) == before
    assert look(dataset)[0] == {}


def test_an_output_whose_digests_are_lost_is_made_again(dataset):
    before = toy.tree(dataset.stage_dir("toy"))
    with closing(sqlite3.connect(dataset.ledger, isolation_level=None)) as database:
        database.execute("DELETE FROM made WHERE item = 'S001'")
    assert set(look(dataset)[0]) == {("unknown", "toy S001"), ("unknown", "after S001")}
    assert look(dataset, fix=True)[1].sound
    assert run(dataset).ok and toy.tree(dataset.stage_dir("toy")) == before


def test_traces_of_the_withdrawn_are_found_by_digest_alone(dataset):
    write_json(dataset.root / "withdrawn.json", [{"id_sha256": text_digest("S-0_9"), "files": 1}])
    assert look(dataset)[0] == {}
    (dataset.root / "notes").mkdir()
    (dataset.root / "notes" / "a.json").write_text('{"key": "S-0_9_smile_cam03"}')
    (dataset.root / "notes" / "b.json").write_text('{"key": "S-0_91_smile"}')
    with Ledger(dataset.ledger) as ledger:
        receipt = ledger.read("toy")["S001"]
        ledger.write(type(receipt)(**vars(receipt) | {"reason": "like S-0_9"}))
    outside = dataset.root.parent / "model.pt"
    outside.write_bytes(b"codes of S-0_9")
    found, _ = look(dataset, checkpoints=[outside])
    people = {where for kind, where in found if kind == "person"}
    assert people == {"ledger.sqlite", "notes/a.json", str(outside)}


def test_killed_half_way_then_checked_and_made_again(tmp_path):
    dataset = toy.make_dataset(tmp_path / "data", [f"item{n}" for n in range(12)])
    command = [sys.executable, "-m", "tests.faults.toy", str(dataset.root), "0"]
    variables = os.environ | {"PYTHONPATH": str(REPOSITORY), toy.SLOWER: "5"}
    process = subprocess.Popen(command, cwd=REPOSITORY, env=variables)
    give_up = time.monotonic() + 60
    while len(list(dataset.root.glob("toy/*"))) < 3 and time.monotonic() < give_up:
        time.sleep(0.01)
    while not list(dataset.staging_dir.glob("toy-*")) and time.monotonic() < give_up:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    result = audit(dataset, [toy.STAGE], fix=True)
    # A kill between the rename and the receipt leaves one output unaccounted for, at most.
    assert result.sound and {f.kind for f in result.findings} <= {"leftover", "unknown"}
    assert any(f.kind == "leftover" for f in result.findings)
    summary = toy.run_toy(dataset, seconds=0.02)
    assert summary.ok and summary.count("skipped") >= 2
    assert audit(dataset, [toy.STAGE]).findings == []


def test_command_on_real_stages(tmp_path, capsys):
    for name in NAMES:
        make_capture(tmp_path / name, subject=name, cameras=2, frames=4)
    root = str(tmp_path / "data")
    assert main(["ingest", root, *(str(tmp_path / n) for n in NAMES), "--workers", "0"]) == 0
    capsys.readouterr()
    assert main(["check", root]) == 0
    assert "sound" in capsys.readouterr().out
    dataset = Dataset(tmp_path / "data")
    label = {"subject": "S001", "expression": "smile", "action": "mark", "annotator": "ann"}
    label |= {"time": 1.0, "frame": 99, "camera": "cam00", "pts": 1, "dhash": "0"}
    dataset.labels_file("S001").parent.mkdir()
    dataset.labels_file("S001").write_text(json.dumps(label) + "\n")
    shutil.rmtree(tmp_path / "S002")
    (dataset.proxies_dir("S001") / "cam01.tar").unlink()
    assert main(["check", root, "--fix", "--json"]) == 1
    account = json.loads(capsys.readouterr().out)
    kinds = sorted((f["kind"], f["fixed"]) for f in account["findings"])
    assert kinds == [("capture", False), ("label", False), ("label", False), ("missing", True)]
    assert dataset.labels_file("S001").read_text() == json.dumps(label) + "\n"
    assert main(["ingest", root, "--items", "S001", "--workers", "0"]) == 0
    assert ingest.STAGE.items(dataset) == NAMES
    dataset.captures_file.write_text("no table")
    capsys.readouterr()
    assert main(["check", root]) == 1
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 2 and said[0].startswith("captures.json: ")
    assert main(["check", str(tmp_path / "nothing")]) == 2
    assert "nothing" in capsys.readouterr().err
