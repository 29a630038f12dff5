"""Withdrawal: nothing of the person stays, nothing of the others goes."""

import json

import pytest

from express50.cli import main
from express50.errors import CaptureError, FormatError, StageError
from express50.layout import Dataset
from express50.ledger import Ledger
from express50.publish import publishing
from express50.withdraw import files_naming, withdraw
from pipelines import ingest
from tests.faults.toy import tree
from tests.synth import make_capture


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
    before = {k: v for k, v in tree(dataset.root).items() if "ledger" not in k}
    with pytest.raises(FormatError, match="not a ledger"):
        withdraw(dataset, "S001")
    assert {k: v for k, v in tree(dataset.root).items() if "ledger" not in k} == before


def test_nothing_of_the_subject_stays_and_the_others_are_untouched(dataset):
    others = {k: v for k, v in tree(dataset.root).items() if "S002" in k}
    assert len(list(files_naming(dataset, "S001"))) > 5
    done = withdraw(dataset, "S001")
    assert done.remaining == ()
    assert list(files_naming(dataset, "S001")) == []
    assert b"S001" not in dataset.ledger.read_bytes()
    assert {k: v for k, v in tree(dataset.root).items() if "S002" in k} == others
    assert not dataset.item_dir("pack", "shards").exists()
    assert dataset.subjects() == ["S002"]
    with Ledger(dataset.ledger) as ledger:
        assert list(ledger.read("ingest")) == ["S002"]


def test_points_and_pixels_that_spell_an_id_by_chance_name_nobody(dataset):
    with publishing(dataset, "depth", "S002/smile") as out:
        for name in ("surface.glb", "surface.ply", "cam00.exr", "cam00_normals.png"):
            (out / name).write_bytes(b"\x00S001\x00")
        (out / "metrics.json").write_text("{}")
    assert withdraw(dataset, "S001").remaining == ()
    assert len(list(dataset.item_dir("depth", "S002/smile").iterdir())) == 5


def test_what_is_left_is_found_and_makes_exit_code_1(dataset, capsys):
    model = dataset.root / "grmm" / "model.pt"
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
    assert "would remove" in capsys.readouterr().out


def test_withdrawn_subject_is_not_taken_in_again(dataset):
    capture = dataset.captures()["S001"]
    withdraw(dataset, "S001")
    with pytest.raises(CaptureError, match="subject S001 was withdrawn"):
        ingest.register(dataset, [capture])


def test_unknown_subject_is_an_error(dataset):
    with pytest.raises(StageError, match="no subject 'S00'; subjects: S001, S002"):
        withdraw(dataset, "S00")
