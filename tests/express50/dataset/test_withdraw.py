"""Withdrawal: nothing of the person stays, nothing of the others goes."""

import json
import shutil
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from express50.__main__ import main
from express50.capture.index import read_index
from express50.capture.readers.read import read_people
from express50.cli.status import read_status
from express50.contract.layout import Dataset
from express50.dataset import withdraw as withdraw_module
from express50.dataset.audit import audit
from express50.dataset.withdraw import (
    any_id_finder,
    files_naming,
    id_finder,
    withdraw,
    withdrawn,
    withdrawn_file,
)
from express50.errors import CaptureError, FormatError, NotReadyError, StageError, UnknownNameError
from express50.files.atomic import alone_in
from express50.files.digests import text_digest
from express50.runner import publish
from express50.runner.ledger import Ledger, Made, Receipt, Run, mark_file
from express50.runner.publish import keeping, stage_lock
from pipelines import ingest
from tests.faults.toy import tree
from tests.synth import make_capture


@contextmanager
def publishing(dataset, stage, item, keep=None):
    folder = publish.run_folder(dataset, stage)
    with folder as run, publish.publishing(run, dataset, stage, item, keep) as out:
        yield out


@pytest.fixture
def dataset(tmp_path):
    for name in ("S001", "S002"):
        make_capture(tmp_path / "raw" / name, subject=name, cameras=2, frames=4)
    captures = [str(tmp_path / "raw" / name) for name in ("S001", "S002")]
    assert main(["ingest", str(tmp_path / "data"), *captures, "--workers", "0"]) == 0
    dataset = Dataset(tmp_path / "data")
    for name in ("S001", "S002"):
        dataset.labels_file(name).parent.mkdir(exist_ok=True)
        dataset.labels_file(name).write_text("{}\n")
        with publishing(dataset, "matte", f"{name}/cam00") as out:
            (out / "metrics.json").write_text("{}")
    with publishing(dataset, "pack", "shards") as out:
        (out / "metrics.json").write_text("{}")
        (out / "splits.json").write_text('{"train": ["S001", "S002"]}')
    return dataset


def test_a_damaged_ledger_stops_a_withdrawal_before_it_removes_anything(dataset):
    data = bytearray(dataset.ledger.read_bytes())
    for side in ("-wal", "-shm"):
        dataset.ledger.with_name(dataset.ledger.name + side).unlink(missing_ok=True)
    data[200:] = b"\xff" * len(data[200:])
    dataset.ledger.write_bytes(data)

    def kept():
        return {
            k: v for k, v in tree(dataset.root).items() if "ledger" not in k and ".lock" not in k
        }

    before = kept()
    with pytest.raises(FormatError, match="not a ledger"):
        withdraw(dataset, "S001")
    assert kept() == before


def test_nothing_of_the_subject_stays_and_the_others_are_untouched(dataset):
    with Ledger(dataset.ledger) as ledger:  # of a run that was killed, in SLURM jobs
        ledger.write_run(Run(stage="track", items=2, running={"S001": 1.0}))
    dataset.slurm_dir.mkdir(parents=True)
    (dataset.slurm_dir / "1000.out").write_text("S001: chatter of a library")
    others = {k: v for k, v in tree(dataset.root).items() if "S002" in k}
    assert len(list(files_naming(id_finder("S001"), dataset.root))) > 5
    done = withdraw(dataset, "S001")
    assert done.remaining == ()
    assert list(files_naming(id_finder("S001"), dataset.root)) == []
    assert b"S001" not in dataset.ledger.read_bytes()
    assert {k: v for k, v in tree(dataset.root).items() if "S002" in k} == others
    assert not dataset.item_dir("pack", "shards").exists()
    assert dataset.subjects() == ["S002"]
    with Ledger(dataset.ledger) as ledger:
        assert list(ledger.read("ingest")) == ["S002"]


def test_a_camera_with_the_persons_id_is_not_the_person(tmp_path):
    rename = {"cam00": "01", "cam01": "02"}
    for name in ("01", "02"):
        raw = tmp_path / "raw" / name
        make_capture(raw, subject=name, cameras=2, frames=4)
        for path in (raw / "cameras", raw / "plates"):
            for file in list(path.iterdir()):
                file.rename(file.with_name(file.name.replace(file.stem, rename[file.stem])))
        table = json.loads((raw / "calibration.json").read_text())
        text = json.dumps({rename[k]: v for k, v in table.items()})
        (raw / "calibration.json").write_text(text)
    captures = [str(tmp_path / "raw" / name) for name in ("01", "02")]
    assert main(["ingest", str(tmp_path / "data"), *captures, "--workers", "0"]) == 0
    dataset = Dataset(tmp_path / "data")
    with publishing(dataset, "align", "02") as out:  # peaks that were matched to the other person's
        (out / "metrics.json").write_text('{"reference": "01"}')
    with publishing(dataset, "matte", "02/smile") as out:
        (out / "metrics.json").write_text('{"border_contact": {"01": 0.5}}')
        (out / "01.png").write_bytes(b"pixels")
    others = {k: v for k, v in tree(dataset.root).items() if k.startswith(("ingest/02", "matte"))}
    assert len(others) > 5
    done = withdraw(dataset, "01")
    assert done.remaining == () and not dataset.item_dir("ingest", "01").exists()
    assert not dataset.item_dir("align", "02").exists()
    assert {k: v for k, v in tree(dataset.root).items() if k in others} == others
    assert not [found for found in audit(dataset, []).findings if found.kind == "person"]
    dataset.labels_file("02").parent.mkdir(exist_ok=True)
    dataset.labels_file("02").write_text('{"camera": "01", "reference": "01"}\n')
    (found,) = [found for found in audit(dataset, []).findings if found.kind == "person"]
    assert found.where == "labels/02.jsonl"


def test_outputs_that_were_replaced_go_too(dataset):
    """S002's goes as well: it may hold what others were matched to."""
    for name in ("S001", "S002"):
        former = Receipt(
            stage="matte", item=f"{name}/cam00", fingerprint="f", status="done", made=Made({}, {})
        )
        with publishing(dataset, "matte", f"{name}/cam00", keeping(dataset, former)) as out:
            (out / "metrics.json").write_text("{}")
    assert len(list(dataset.replaced_dir.rglob("metrics.json"))) == 2
    assert main(["subject", "withdraw", str(dataset.root), "S001"]) == 0
    assert dataset.replaced_dir.exists()  # it was only listed
    assert withdraw(dataset, "S001").remaining == ()
    assert not dataset.replaced_dir.exists()

    entry = dataset.replaced_dir / "matte/S001+cam00/f"  # restored from a backup, say
    entry.mkdir(parents=True)
    (entry / "cam00.png").write_bytes(b"pixels")
    digests = withdrawn(dataset)
    assert list(files_naming(any_id_finder(digests), dataset.root)) == [entry / "cam00.png"]


def test_a_folder_that_is_not_a_dataset_is_named_as_such(tmp_path, capsys):
    (tmp_path / "merged").mkdir()  # as 'shards merge' makes one
    assert main(["subject", "withdraw", str(tmp_path / "merged"), "S001"]) == 2
    assert "merged: not a dataset (no ledger.sqlite)" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["", ".", "..", "../..", "S001/", "S001/cam00", "shards", "S009"])
def test_what_is_not_a_subject_removes_nothing(dataset, name):
    before = tree(dataset.root.parent)
    with pytest.raises(UnknownNameError, match="no subject .*; expected one of S001, S002"):
        withdraw(dataset, name)
    assert main(["subject", "withdraw", str(dataset.root), name, "--yes"]) == 2
    after = tree(dataset.root.parent)
    assert {k: v for k, v in after.items() if "ledger" not in k and "staging" not in k} == {
        k: v for k, v in before.items() if "ledger" not in k and "staging" not in k
    }


def test_a_file_that_is_not_a_checkpoint_is_refused_before_anything_is_removed(dataset, capsys):
    other = dataset.root.parent / "notes.txt"
    other.write_text("S001")
    for path in (other, dataset.root / "nope.pt"):
        command = ["subject", "withdraw", str(dataset.root), "S001", f"--checkpoint={path}"]
        assert main([*command, "--yes"]) == 1
        assert str(path) in capsys.readouterr().err
    assert dataset.subjects() == ["S001", "S002"]


def test_stages_are_done_without_the_person(dataset):
    withdraw(dataset, "S001")
    with Ledger(dataset.ledger) as ledger:
        (status,) = read_status(ledger, ["ingest"])
    assert (status.state, status.done, status.to_do) == ("done", 1, 0)


def test_points_and_pixels_that_spell_an_id_by_chance_do_not_count(dataset):
    with publishing(dataset, "depth", "S002/smile") as out:
        for name in ("surface.glb", "surface.ply", "cam00.exr", "cam00_normals.png"):
            (out / name).write_bytes(b"\x00S001\x00")
        (out / "metrics.json").write_text("{}")
    assert withdraw(dataset, "S001").remaining == ()
    assert len(list(dataset.item_dir("depth", "S002/smile").iterdir())) == 5


@pytest.mark.parametrize("linked", [False, True])
def test_what_is_left_is_found_and_makes_exit_code_1(dataset, tmp_path, capsys, linked):
    model = dataset.root / "grmm" / "model.pt"
    if linked:  # to another disk
        (tmp_path / "disk").mkdir()
        model.parent.symlink_to(tmp_path / "disk")
    else:
        model.parent.mkdir()
    model.write_bytes(b"\x00codes of S001\x00")
    command = ["subject", "withdraw", str(dataset.root), "S001", "--yes", "--json"]
    assert main(command) == 1
    account = json.loads(capsys.readouterr().out)
    assert account["remaining"] == [str(model)]
    assert account["raw_capture"].endswith("raw/S001")


def test_nothing_is_removed_without_yes(dataset, capsys):
    before = tree(dataset.root)
    assert main(["subject", "withdraw", str(dataset.root), "S001"]) == 0
    assert tree(dataset.root) == before
    lines = capsys.readouterr().out.splitlines()
    assert f"would remove {dataset.item_dir('ingest', 'S001')}" in lines
    shards = dataset.item_dir("pack", "shards")
    assert f"would remove {shards} (may hold several people's data)" in lines


def test_withdrawn_subject_is_not_taken_in_again(dataset):
    capture = dataset.captures()["S001"]
    withdraw(dataset, "S001")
    with pytest.raises(CaptureError, match="subject S001 was withdrawn"):
        ingest.add_captures(dataset, [capture])


def test_what_others_outputs_and_tables_say_of_the_person_goes_too(dataset):
    with publishing(dataset, "align", "S002") as out:
        (out / "metrics.json").write_text("{}")
        (out / "suggestions.json").write_text('{"smile": {"reference": {"subject": "S001"}}}')
    (dataset.root / "labels" / "reference.json").write_text('{"subject": "S001"}')
    dataset.config_file("pack").write_text('[pack]\ntest_subjects = ["S001"]\n')
    footage = dataset.captures()["S001"] / "capture.toml"
    with Ledger(dataset.ledger) as ledger:
        done = {"stage": "align", "fingerprint": "f", "status": "done"}
        ledger.write(Receipt(item="S002", metrics={"reference": "S001"}, **done))
        ledger.write(Receipt(item="S003", made=Made({"S001 plate": "d"}, {}), **done))
        ledger.write(Receipt(item="S004", made=Made({"plate": "d"}, {}), **done))
        ledger.sha256(footage)
        ledger.keep_digests()
    done = withdraw(dataset, "S001")
    assert done.remaining == ()
    assert not dataset.item_dir("align", "S002").exists()
    assert not (dataset.root / "labels" / "reference.json").exists()
    with Ledger(dataset.ledger) as ledger:
        assert "S002" not in ledger.read("align")
        assert list(ledger.made("align")) == ["S004"]
    assert b"S001" not in dataset.ledger.read_bytes()


def test_the_record_says_when_and_how_much_but_not_who(dataset):
    count = len([k for k in tree(dataset.root) if "S001" in k or k.startswith("pack/")])
    done = withdraw(dataset, "S001")
    text = withdrawn_file(dataset).read_text()
    (row,) = json.loads(text)
    assert row["files"] == done.files == count and "S001" not in text
    assert datetime.fromisoformat(row["time"]).tzinfo is not None
    assert withdrawn(dataset) == {row["id_sha256"]} == {text_digest("S001")}


@pytest.mark.parametrize("running", ["ingest", "depth", "run"])  # run: trials of a budget
def test_no_subject_is_withdrawn_while_a_stage_runs(dataset, running):
    before = tree(dataset.root)
    with stage_lock(dataset, running), pytest.raises(StageError, match=f"'{running}' is running"):
        withdraw(dataset, "S001")
    after, before = (
        {k: v for k, v in files.items() if not k.endswith(".lock")}
        for files in (tree(dataset.root), before)
    )
    assert after == before


def test_no_subject_is_withdrawn_while_a_model_is_trained(dataset):
    with alone_in(dataset.root / "grmm/train"), pytest.raises(NotReadyError, match="grmm/train"):
        withdraw(dataset, "S001")
    assert "S001" in dataset.subjects()


def test_a_link_to_a_capture_goes_and_the_capture_stays(dataset, tmp_path):
    (dataset.root / "raw").mkdir()
    (dataset.root / "raw/S001").symlink_to(tmp_path / "raw/S001")
    withdraw(dataset, "S001")
    assert not (dataset.root / "raw/S001").is_symlink() and any((tmp_path / "raw/S001").iterdir())


@pytest.mark.parametrize("test", [id_finder("104"), any_id_finder({text_digest("104")})])
def test_a_number_is_not_an_id_of_digits(test):
    for text in (
        '{"frame": 104, "x": 0.104}', '[103,104]', '[["smile", 104, 111]]', "x = 104\n",
        '{"pts": "103 104 105"}', "error 0.104 px", '{"n":104}', "[\n 104\n]",
    ):  # fmt: skip
        assert not test(text.encode()), text
    for text in ('{"subject": "104"}', "track/104/track.npz", "\n104\n", "104_smile_cam00.json",
                 "104,smile,3\n", '["104"]', '{"104": "/a"}', "104: no face"):  # fmt: skip
        assert test(text.encode()), text


def test_ids_at_the_joint_of_two_blocks_are_whole_words(tmp_path, monkeypatch):
    monkeypatch.setattr(withdraw_module, "CHUNK", 8)
    for text, found in (("abc S0012 x", []), ("abc S001 x", [True]), ("xyz1 S001", [True])):
        (tmp_path / "a.txt").write_text(text)
        assert [True for _ in files_naming(id_finder("S001"), tmp_path)] == found


def test_texts_in_arrays_and_archives_are_read_and_numbers_are_not(tmp_path):
    np.savez_compressed(tmp_path / "who.npz", subjects=np.array(["S002", "S001"]))
    np.savez(tmp_path / "chance.npz", values=np.frombuffer(b"\0S001\0\0\0", np.uint8))
    (tmp_path / "S001_smile.txt").write_text("")
    (tmp_path / "S0011.txt").write_text("S0011 xS001 S001x")
    found = {path.name for path in files_naming(id_finder("S001"), tmp_path)}
    assert found == {"who.npz", "S001_smile.txt"}
    by_digest = files_naming(any_id_finder({text_digest("S001")}), tmp_path)
    assert {path.name for path in by_digest} == found


def test_check_proves_a_withdrawal_and_finds_what_comes_back(dataset, capsys):
    withdraw(dataset, "S001")
    shutil.rmtree(dataset.stage_dir("matte"))  # outputs without receipts, made by this test
    dataset.labels_file("S002").write_text("")
    assert main(["check", str(dataset.root)]) == 0
    (dataset.root / "export").mkdir()
    (dataset.root / "export" / "a.json").write_text('{"key": "S001_smile_cam00"}')
    capsys.readouterr()
    assert main(["check", str(dataset.root)]) == 1
    assert "export/a.json: names a person who was withdrawn" in capsys.readouterr().out


def test_another_subject_whose_id_holds_the_persons_keeps_everything(dataset, tmp_path, capsys):
    make_capture(tmp_path / "raw" / "S001_2", subject="S001_2", cameras=2, frames=4)
    capture = str(tmp_path / "raw" / "S001_2")
    assert main(["ingest", str(dataset.root), capture, "--workers", "0"]) == 0
    shutil.rmtree(dataset.stage_dir("matte"))  # outputs without receipts, made by the fixture
    for subject in dataset.subjects():
        dataset.labels_file(subject).write_text("")
    before = tree(dataset.item_dir("ingest", "S001_2"))
    assert main(["subject", "withdraw", str(dataset.root), "S001", "--yes"]) == 0
    assert tree(dataset.item_dir("ingest", "S001_2")) == before
    assert main(["check", str(dataset.root)]) == 0
    assert main(["subject", "withdraw", str(dataset.root), "S002", "--yes"]) == 0
    (dataset.root / "notes.txt").write_text("S001_2_smile and S002-b, then S001_smile")
    capsys.readouterr()
    assert main(["check", str(dataset.root)]) == 1
    assert "notes.txt: names a person" in capsys.readouterr().out
    # The other way round: the longer id is withdrawn, the shorter one stays.
    assert id_finder("S1_b", {"S1"})(b"S1_b_smile") and not id_finder("S1_b", {"S1"})(b"S1_smile")
    test = any_id_finder({text_digest("S1_b")}, {"S1"})
    assert test(b"S1_b_smile") and not test(b"S1_smile")


def test_what_came_back_is_withdrawn_again(dataset):
    withdraw(dataset, "S001")
    with publishing(dataset, "track", "S001") as out:  # from a backup
        (out / "metrics.json").write_text("{}")
    assert withdraw(dataset, "S001").removed == (dataset.item_dir("track", "S001"),)
    assert list(files_naming(id_finder("S001"), dataset.root)) == []


def test_a_second_withdrawal_keeps_what_was_made_again_without_the_person(dataset, capsys):
    withdraw(dataset, "S001")
    with publishing(dataset, "pack", "shards") as out:
        (out / "metrics.json").write_text("{}")
    for words in ([], ["--yes"]):
        assert main(["subject", "withdraw", str(dataset.root), "S001", *words]) == 0
        assert capsys.readouterr().out == "nothing of S001 is left\n"
    assert dataset.item_dir("pack", "shards").exists()


PERSON = 'name = "Jane Roe"\nage = 4711e-2\ngender = "feminine"\nconsent_id = "C-77"\n'


def test_what_describes_a_person_stays_in_the_capture(dataset, tmp_path):
    capture = tmp_path / "raw" / "S001" / "capture.toml"
    capture.write_text(capture.read_text() + PERSON)
    assert main(["ingest", str(dataset.root), "--workers", "0"]) == 0
    assert read_index(dataset, "S001").meta["consent_id"] == "C-77"
    for name, data in tree(dataset.root).items():
        assert not {w for w in (b"Jane", b"47.11", b"feminine") if w in data}, name
    assert read_people(dataset, ["S001"]) == [{"gender": "feminine", "age": 47.11}]


def test_what_an_older_ingest_kept_of_a_person_is_found_and_fixed(dataset, capsys):
    path = dataset.index_file("S001")
    content = json.loads(path.read_text())
    content["meta"]["name"] = "Jane Roe"
    path.write_text(json.dumps(content))
    with Ledger(dataset.ledger) as ledger:
        receipt, made = ledger.read("ingest")["S001"], ledger.made("ingest")["S001"]
        files = made.files | {"index.json": mark_file(path)}
        ledger.write(replace(receipt, made=replace(made, files=files)))
    shutil.rmtree(dataset.stage_dir("matte"))
    shutil.rmtree(dataset.stage_dir("pack"))
    (dataset.root / "labels" / "S001.jsonl").write_text("")
    (dataset.root / "labels" / "S002.jsonl").write_text("")
    assert main(["check", str(dataset.root), "--json"]) == 1
    said = capsys.readouterr().out
    (finding,) = json.loads(said)["findings"]
    assert (
        finding["kind"] == "personal" and "personal data from capture.toml: name" in finding["what"]
    )
    assert "Jane" not in said
    assert main(["check", str(dataset.root), "--fix"]) == 0
    assert main(["ingest", str(dataset.root), "--workers", "0"]) == 0
    assert "name" not in read_index(dataset, "S001").meta
