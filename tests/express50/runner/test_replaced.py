"""Outputs that others replaced come back whole or not at all, and give way to what is made."""

import dataclasses
import errno
import json
import os
import shutil
from unittest.mock import Mock

import pytest

from express50.__main__ import main
from express50.dataset.audit import audit
from express50.runner import publish
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger
from express50.runner.publish import stage_lock
from express50.runner.runner import run_stage
from tests.faults import toy
from tests.faults.toy import make_dataset, run_toy, tree


def receipt_of(dataset, item="a"):
    with Ledger(dataset.ledger) as ledger:
        return ledger.read("toy")[item], ledger.made("toy")[item]


def kept(dataset):
    return sorted(p.parent.parent.name for p in dataset.replaced_dir.glob("toy/*/*/.receipt.json"))


@pytest.fixture
def dataset(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "S001/b"])
    run_toy(dataset)
    return dataset


@pytest.mark.parametrize("workers", [0, 2])
def test_going_back_to_old_settings_makes_nothing(dataset, workers, monkeypatch):
    before, receipt = tree(dataset.stage_dir("toy")), receipt_of(dataset)
    run_toy(dataset, workers=workers, word="b")
    other = tree(dataset.stage_dir("toy"))
    assert kept(dataset) == ["S001+b", "a"]

    back = run_toy(dataset, workers=workers)
    assert [(o.status, o.restored) for o in back.outcomes] == [("done", True)] * 2
    assert 'restored 2: settings changed: word was "b", is "a"' in "\n".join(back.lines())
    assert tree(dataset.stage_dir("toy")) == before
    found, made = receipt_of(dataset)
    assert made == receipt[1]  # the very files: their times and inodes too
    assert (found.seconds, found.metrics) == (receipt[0].seconds, receipt[0].metrics)
    assert run_toy(dataset).count("skipped") == 2
    run_toy(dataset, workers=workers, word="b")
    assert tree(dataset.stage_dir("toy")) == other


def test_an_input_that_is_as_before_brings_its_output_back(dataset):
    source = dataset.root / "in" / "a.txt"
    source.write_text("other")
    run_toy(dataset)
    source.write_text("a")
    assert [o.restored for o in run_toy(dataset).outcomes] == [False, True]


def test_items_that_come_back_to_the_list_are_restored(dataset, capsys):
    (dataset.root / "in" / "a.txt").rename(dataset.root / "a.txt")
    run_toy(dataset)
    assert not dataset.item_dir("toy", "a").exists() and kept(dataset) == ["a"]
    (dataset.root / "a.txt").rename(dataset.root / "in" / "a.txt")
    back = run_stage(toy.STAGE, dataset, toy.ToyConfig(), pool=Pool(0))
    assert "toy 1/1 a restored\n" in capsys.readouterr().err
    assert [o.restored for o in back.outcomes] == [False, True]
    assert "  restored 1: same as before" in list(back.lines())


def test_two_generations_are_kept(dataset):
    for word in "bcd":
        run_toy(dataset, word=word)
    assert kept(dataset) == ["S001+b"] * 2 + ["a"] * 2
    assert not any(o.restored for o in run_toy(dataset).outcomes)  # "a" was the oldest
    assert all(o.restored for o in run_toy(dataset, word="d").outcomes)


@pytest.mark.parametrize("harm", ["flip", "cut", "gone", "more", "receipt", "other item"])
def test_a_damaged_entry_never_comes_back(dataset, harm):
    before = tree(dataset.stage_dir("toy"))
    run_toy(dataset, word="b")
    (entry,) = dataset.replaced_dir.glob("toy/a/*")
    victim, receipt = entry / "deep" / "0.bin", entry / ".receipt.json"
    stat = victim.stat()
    data = victim.read_bytes()
    if harm == "flip":  # with size and time as they were
        with victim.open("r+b") as file:
            file.write(bytes([data[0] ^ 1]))
        os.utime(victim, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    elif harm == "cut":
        victim.write_bytes(data[:-1])
    elif harm == "gone":
        victim.unlink()
    elif harm == "more":
        (entry / "deep" / "x.bin").write_bytes(b"x")
    elif harm == "receipt":
        receipt.write_text("{}")
    else:
        receipt.write_text(json.dumps(json.loads(receipt.read_text()) | {"item": "S001/b"}))
    back = {o.item: o.restored for o in run_toy(dataset).outcomes}
    assert back == {"a": False, "S001/b": True}
    assert tree(dataset.stage_dir("toy")) == before


def test_a_kill_while_an_output_is_restored_costs_that_entry_alone(dataset, monkeypatch):
    before = tree(dataset.stage_dir("toy"))
    run_toy(dataset, word="b")
    other = tree(dataset.stage_dir("toy"))

    def killed(*given):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(publish, "keeping", killed)
        with pytest.raises(KeyboardInterrupt):
            run_toy(dataset)
    assert tree(dataset.stage_dir("toy")) == other
    run_toy(dataset)
    assert tree(dataset.stage_dir("toy")) == before


def test_a_disk_with_little_space_keeps_nothing(dataset, monkeypatch):
    usage = Mock(total=1e12, free=3e9)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    run_toy(dataset, word="b")
    assert kept(dataset) == ["S001+b", "a"]
    usage.free = 1.9e9
    assert run_toy(dataset, word="c").ok
    assert not dataset.replaced_dir.exists()


def test_a_full_disk_takes_the_store_before_it_stops_a_run(tmp_path):
    """The item meets /dev/full once: what was replaced goes, and the item is tried again."""
    dataset = make_dataset(tmp_path / "data", ["a", "z_full"])
    run_toy(dataset)
    run_toy(dataset, word="b")
    assert kept(dataset) == ["a", "z_full"]
    tries = []

    def full_once(dataset, item, config, out):
        tries.append(item)
        if tries.count(item) == 1 and item == "z_full":
            raise OSError(errno.ENOSPC, "No space left on device")
        return toy.run(dataset, item, config, out)

    stage = dataclasses.replace(toy.STAGE, run=full_once)
    summary = run_toy(dataset, stage=stage, word="c")
    assert summary.ok and tries == ["a", "z_full", "z_full"]


def test_check_reports_kept_outputs_and_finds_no_fault_in_them(dataset):
    run_toy(dataset, word="b")
    for deep in (False, True):
        result = audit(dataset, [toy.STAGE], deep=deep)
        assert result.findings == []
        (note,) = result.notes
        assert note.startswith(".replaced: 0.4 MB (10 files) of outputs that were replaced")
    audit(dataset, [toy.STAGE], fix=True)
    assert kept(dataset) == ["S001+b", "a"]


def test_prune_empties_the_store_and_says_what_it_freed(dataset, capsys):
    run_toy(dataset, word="b")
    size = sum(p.stat().st_size for p in dataset.replaced_dir.rglob("*") if p.is_file())
    before = tree(dataset.stage_dir("toy"))
    assert main(["prune", str(dataset.root), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"bytes": size, "files": 10}
    assert not dataset.replaced_dir.exists() and tree(dataset.stage_dir("toy")) == before
    dataset.stale_dir.symlink_to(dataset.stage_dir("toy"))  # what is not deleted is not freed
    assert main(["prune", str(dataset.root)]) == 0
    assert "freed 0 bytes in 0 files" in capsys.readouterr().out


def test_prune_deletes_trials_unless_one_is_running(dataset, capsys):
    trial = dataset.pilot_dir / "0123"
    trial.mkdir(parents=True)
    with stage_lock(dataset, "run"):
        (trial / "trial.json").write_text("{}")
        assert main(["prune", str(dataset.root)]) == 0
        shown = capsys.readouterr()
        assert "freed 0 bytes" in shown.out and "a trial is running" in shown.err
        assert (trial / "trial.json").is_file()
    assert main(["prune", str(dataset.root)]) == 0
    assert "freed 2 bytes in 1 file\n" in capsys.readouterr().out
    assert not dataset.pilot_dir.exists()
