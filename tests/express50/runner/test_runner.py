"""The runner: skips, isolates, accounts, and sets aside what is stale or deadly."""

import contextlib
import dataclasses
import errno
import logging
import os
import resource
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from logging.handlers import BufferingHandler
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from express50.cli.status import read_status
from express50.contract.config import field_documents
from express50.contract.stage import ExpectedError, Note
from express50.errors import CaptureError, ConfigError, DiskError, DiskFullError, StageError
from express50.runner import publish
from express50.runner.clusters import RemoteWorkers
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger
from express50.runner.outdated import outdated
from express50.runner.runner import Outcome, Summary, run_stage, select_items
from express50.runner.worker import Task, keep_freed_memory, peak_memory, reset_peak_memory
from tests.faults import toy
from tests.faults.toy import make_dataset, run_toy, tree
from tests.stages import metrics_of


def statuses(summary):
    return {outcome.item: outcome.status for outcome in summary.outcomes}


def receipts(dataset):
    with Ledger(dataset.ledger) as ledger:
        return ledger.read("toy")


def test_one_bad_item_never_stops_the_others(tmp_path):
    names = ["bad1", "bug1", "drop1", "nan1", "noinput1", "ok1", "S001/cam03"]
    dataset = make_dataset(tmp_path / "data", names)
    summary = run_toy(dataset)
    failed = {"bad1", "bug1", "nan1", "noinput1"}
    assert {k for k, v in statuses(summary).items() if v == "failed"} == failed
    assert {k for k, v in statuses(summary).items() if v == "done"} == set(names) - failed
    assert not summary.ok
    assert {k: r.status for k, r in receipts(dataset).items()} == statuses(summary)
    assert [summary.count(s) for s in ("done", "skipped", "failed")] == [3, 0, 4]
    (dropped,) = (o.dropped for o in summary.outcomes if o.item == "drop1")
    assert dropped == (Note("cam03", "dark"),)
    lines = "\n".join(summary.lines())
    assert all(name in lines for name in (*failed, "cam03"))
    assert all(not (dataset.item_dir("toy", name)).exists() for name in failed)


def test_a_warning_of_many_items_is_one_line():
    wide = Note("cam05", "the subject leaves the image at the right (22%)")
    items = [f"S001/e{number}" for number in range(5)]
    outcomes = [Outcome(item, "done", warnings=(wide, Note("cam06", item))) for item in items]
    found = [line for line in Summary("matte", tuple(outcomes), 1.0).lines() if "warning" in line]
    assert found[0] == f"  warning S001/e0, S001/e1, S001/e2 and 2 more: cam05: {wide.why}"
    assert len(found) == 1 + len(items)


def test_unexpected_error_leaves_its_traceback_in_a_log_that_success_removes(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["bug1", "ok1"])
    (outcome,) = [o for o in run_toy(dataset).outcomes if o.status == "failed"]
    log = dataset.log_file("toy", "bug1")
    assert outcome.reason.startswith("KeyError: 'absent'")
    assert str(log) in outcome.reason
    assert "misbehave" in log.read_text()


def test_footage_that_may_not_be_read_is_not_a_defect(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["denied1"])
    (outcome,) = run_toy(dataset).outcomes
    assert outcome.reason.startswith("PermissionError: /raw/cam02: Permission denied; check its")
    assert not dataset.log_file("toy", "denied1").exists()


def test_a_changed_input_setting_or_version_makes_an_item_again_and_is_reported(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])
    newer = dataclasses.replace(toy.STAGE, version=2)

    def again(**values):
        """Return each item's reason; an item without one was skipped."""
        summary = run_toy(dataset, **values)
        reasons = {o.item: o.again for o in summary.outcomes}
        assert statuses(summary) == {k: "done" if why else "skipped" for k, why in reasons.items()}
        assert all(why in "\n".join(summary.lines()) for why in reasons.values())
        return [reasons["a"], reasons["b"]]

    assert set(statuses(run_toy(dataset)).values()) == {"done"}
    assert again() == ["", ""]
    (dataset.root / "in" / "a.txt").write_text("other")
    assert again() == ["inputs changed: text", ""]
    assert again(word="c") == ['settings changed: word was "a", is "c"'] * 2
    assert again(stage=newer, word="c") == ["stage version changed: it was 1, is 2"] * 2
    shutil.rmtree(dataset.item_dir("toy", "b"))
    assert again(stage=newer, word="c") == ["", "output missing"]


def test_finished_work_that_will_be_made_again_is_announced(tmp_path, capsys):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])

    def said(items=None, **values):
        capsys.readouterr()
        run_stage(toy.STAGE, dataset, toy.ToyConfig(**values), items, pool=Pool(0))
        return capsys.readouterr().err

    assert "again" not in said() + said()
    lines = said(word="c").splitlines()
    assert lines[0].startswith("toy: makes 2 finished items again, which took 0.")
    assert lines[0].endswith('settings changed: word was "a", is "c"') and lines[-1].startswith(
        "toy 2/2 b"
    )
    assert "again" not in said()  # restored at no cost
    (dataset.root / "in" / "b.txt").unlink()
    assert "toy: set aside 1 item (b), which it no longer makes" in said()


def test_items_that_changed_for_one_reason_share_a_line_and_all_are_counted(tmp_path, capsys):
    expressions = ("frown", "smile", "jaw_open", "pucker", "wink")
    dataset = make_dataset(tmp_path / "data", [f"S001/{name}" for name in expressions])

    def said(text, name):
        stage = dataclasses.replace(
            toy.STAGE, inputs=lambda _, item, config: {name(item.split("/")[1]): text}
        )
        capsys.readouterr()
        run_stage(stage, dataset, toy.ToyConfig(), pool=Pool(0))
        return [line for line in capsys.readouterr().err.splitlines() if "finished" in line]

    for text in "ab":  # the name of the input holds the item's expression
        lines = said(text, lambda expression: f"frame {expression} cam00")
    (line,) = lines
    assert "makes 5 finished items again" in line and line.endswith(": inputs changed: frame cam00")
    for text in "cd":
        lines = said(text, lambda expression: f"length {len(expression)}")
    assert [line.split("makes ")[1].split(" ")[0] for line in lines] == ["2", "1", "1", "1"]
    assert lines[-1].endswith(": other reasons")


def test_outputs_of_items_that_are_gone_are_not_called_outdated(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])
    run_toy(dataset)
    fewer = dataclasses.replace(toy.STAGE, items=lambda dataset: ["a"])
    for name in "ab":
        (dataset.root / "in" / f"{name}.txt").write_text("other")
    with Ledger(dataset.ledger) as ledger:
        for stage, items in ((toy.STAGE, ["a", "b"]), (fewer, ["a"])):
            assert [item for _, item, _ in outdated(dataset, [stage], ledger)] == items


def test_the_receipt_of_an_output_that_fills_the_disk_is_kept(tmp_path, monkeypatch):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])
    write, refused = Ledger.write, []

    def full(ledger, receipt):
        if list(dataset.staging_dir.glob(".toy.reserve")):
            refused.append(receipt.item)
            raise DiskFullError("the disk is full")
        write(ledger, receipt)

    monkeypatch.setattr(Ledger, "write", full)
    assert run_toy(dataset).ok and refused == ["a"]
    assert set(statuses(run_toy(dataset)).values()) == {"skipped"}


class OneItem:
    """A monitor that lets one item through."""

    def __init__(self):
        self.seen = []

    def begun(self, item):
        pass

    def settled(self, receipt):
        self.seen.append(receipt)

    def closed(self):
        return bool(self.seen)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_closed_monitor_leaves_items_that_the_next_run_makes(tmp_path, workers):
    dataset, monitor = make_dataset(tmp_path, ["a", "b", "c", "d", "e", "f"]), OneItem()
    config = toy.ToyConfig(seconds=0.1)
    with Pool(workers) as pool:
        summary = run_stage(toy.STAGE, dataset, config, pool=pool, progress=False, monitor=monitor)
    left = [o.item for o in summary.outcomes if o.status == "left"]
    assert 3 <= len(left) <= 5 and not summary.ok and f"{len(left)} left" in next(summary.lines())
    assert len(monitor.seen) + len(left) == 6 and all(r.core_seconds > 0 for r in monitor.seen)
    rest = run_toy(dataset, seconds=0.1)
    assert rest.ok and rest.count("done") == len(left)


def test_touched_input_with_the_same_content_is_skipped(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a"])
    run_toy(dataset)
    (dataset.root / "in" / "a.txt").write_text("a")
    assert statuses(run_toy(dataset)) == {"a": "skipped"}


def test_what_failed_is_not_said_to_be_made_again(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "bad"])
    (dataset.root / "in" / "bad.txt").write_text("repaired")
    assert run_toy(dataset).ok
    (dataset.root / "in" / "bad.txt").write_text("other")
    lines = list(run_toy(dataset, word="c").lines())
    assert "1 done + 0 skipped + 1 failed" in lines[0]
    assert [line.split(":")[0] for line in lines[1:]] == ["  made again 1", "  failed bad"]


def test_lost_output_is_made_again(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a"])
    run_toy(dataset)
    before = tree(dataset.stage_dir("toy"))
    (dataset.item_dir("toy", "a") / "metrics.json").unlink()
    assert statuses(run_toy(dataset)) == {"a": "done"}
    assert tree(dataset.stage_dir("toy")) == before


@pytest.mark.parametrize("room", [True, False])
def test_output_of_an_item_that_failed_on_newer_data_is_not_read(tmp_path, room, monkeypatch):
    if not room:
        monkeypatch.setattr(publish, "LEAST_ROOM", float("inf"))
    dataset = make_dataset(tmp_path / "data", ["bad1"])
    source = dataset.root / "in" / "bad1.txt"
    source.write_text("repaired")
    assert run_toy(dataset).ok
    source.write_text("broken")
    assert not run_toy(dataset).ok
    assert not dataset.item_dir("toy", "bad1").exists()
    assert (dataset.stale_dir / "toy" / "bad1" / "metrics.json").is_file() == (not room)
    source.write_text("repaired")
    assert [(o.status, o.restored) for o in run_toy(dataset).outcomes] == [("done", room)]
    assert not (dataset.stale_dir / "toy" / "bad1").exists()


def test_a_run_that_is_stopped_costs_nothing_that_was_made(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "b", "c", "d"])
    run_toy(dataset)
    real = toy.STAGE.run

    def stopped(dataset, item, config, out):
        if item == "b":
            raise KeyboardInterrupt
        return real(dataset, item, config, out)

    mistyped = dataclasses.replace(toy.STAGE, run=stopped)
    with pytest.raises(KeyboardInterrupt):
        run_toy(dataset, stage=mistyped, word="b")
    with Ledger(dataset.ledger) as ledger:
        (status,) = read_status(ledger, ["toy"])
    assert (status.state, status.done, status.to_do) == ("stopped", 1, 3)
    skipped = dict.fromkeys("bcd", "skipped")
    assert statuses(run_toy(dataset)) == {"a": "done"} | skipped


def test_a_run_killed_between_output_and_receipt_is_seen(tmp_path):
    """The receipt is still the former one, and must not vouch for what was published since."""
    dataset = make_dataset(tmp_path / "data", ["a"])
    run_toy(dataset)
    before = tree(dataset.stage_dir("toy"))
    shutil.copy(dataset.ledger, tmp_path / "ledger.sqlite")
    run_toy(dataset, word="b")
    for path in dataset.root.glob("ledger.sqlite*"):
        path.unlink()
    shutil.copy(tmp_path / "ledger.sqlite", dataset.ledger)
    assert statuses(run_toy(dataset)) == {"a": "done"}
    assert tree(dataset.stage_dir("toy")) == before


def test_a_copied_dataset_is_up_to_date(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a"])
    run_toy(dataset)
    shutil.copytree(dataset.root, tmp_path / "copy", copy_function=shutil.copyfile)
    assert statuses(run_toy(toy.Dataset(tmp_path / "copy"))) == {"a": "skipped"}


def test_outputs_stay_until_new_ones_are_complete(tmp_path):
    """Another setting fails: what the former one made stays, with its receipt, and is said."""
    dataset = make_dataset(tmp_path / "data", ["a"])
    run_toy(dataset)
    before, (receipt,) = tree(dataset.stage_dir("toy")), receipts(dataset).values()
    assert statuses(run_toy(dataset, files=-1)) == {"a": "failed"}
    assert tree(dataset.stage_dir("toy")) == before
    (noted,) = receipts(dataset).values()
    assert noted == dataclasses.replace(receipt, reason=noted.reason, time=noted.time)
    with Ledger(dataset.ledger) as ledger:
        (status,) = read_status(ledger, ["toy"])
    assert (status.state, [r.reason for r in status.failed]) == ("failed", [noted.reason])
    assert "toy.files is -1" in noted.reason
    assert statuses(run_toy(dataset)) == {"a": "skipped"}
    assert receipts(dataset)["a"].reason == ""


def test_outputs_stand_where_footage_is_out_of_reach(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])
    run_toy(dataset)

    def unmounted(dataset, item, config):
        raise CaptureError(f"{item}: no such capture")

    gone = dataclasses.replace(toy.STAGE, inputs=unmounted)
    summary = run_toy(dataset, stage=gone)
    assert statuses(summary) == {"a": "failed", "b": "failed"}
    assert statuses(run_toy(dataset)) == {"a": "skipped", "b": "skipped"}


def test_outputs_stand_where_a_file_of_the_footage_is_out_of_reach(tmp_path):
    dataset, given = make_dataset(tmp_path / "data", ["a", "b"]), tmp_path / "calibration.json"
    given.write_text("{}")

    def naming(dataset, item, config):
        return toy.inputs(dataset, item, config) | ({"given": given} if item == "a" else {})

    stage = dataclasses.replace(toy.STAGE, inputs=naming)
    assert run_toy(dataset, stage=stage).ok
    given.rename(tmp_path / "away")
    assert statuses(run_toy(dataset, stage=stage)) == {"a": "failed", "b": "skipped"}
    (tmp_path / "away").rename(given)
    assert statuses(run_toy(dataset, stage=stage)) == {"a": "skipped", "b": "skipped"}


def test_a_defect_in_naming_inputs_is_one_items(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])

    def naming(dataset, item, config):
        return toy.inputs(dataset, item, config) | ({} if item == "b" else {"x": {}["absent"]})

    broken = dataclasses.replace(toy.STAGE, inputs=naming)
    summary = run_toy(dataset, stage=broken)
    assert statuses(summary) == {"a": "failed", "b": "done"}
    assert "KeyError: 'absent' (unexpected; traceback in" in summary.outcomes[0].reason


@pytest.mark.parametrize("workers", [0, 2])
def test_a_full_disk_stops_the_stage(tmp_path, workers):
    """/dev/full refuses bytes as a full disk does; items after it are not computed."""
    dataset = make_dataset(tmp_path / "data", ["a", "full1", *(f"z{n}" for n in range(6))])
    with pytest.raises(DiskFullError, match="the disk is full .*No space left on device"):
        run_toy(dataset, workers=workers, seconds=0.1)
    assert "full1" not in receipts(dataset)
    assert not dataset.item_dir("toy", "z5").exists()
    (dataset.root / "in" / "full1.txt").write_text("repaired")
    again = statuses(run_toy(dataset, workers=workers, seconds=0.1))
    # With two workers the item before is still being computed when the disk turns out to be full.
    assert again["full1"] == "done" and (workers or again["a"] == "skipped")
    assert set(again.values()) <= {"done", "skipped"}


@pytest.mark.parametrize("trouble", [errno.EIO, errno.EROFS])
def test_a_disk_that_breaks_stops_the_stage(tmp_path, monkeypatch, trouble):
    dataset = make_dataset(tmp_path / "data", ["a", "b", "c"])
    sync, broken, tried = os.fsync, [], []

    def run(data, item, config, out):
        tried.append(item)
        broken.extend(["b"] * (item == "b"))
        return toy.STAGE.run(data, item, config, out)

    def fsync(descriptor):
        if broken:
            raise OSError(trouble, os.strerror(trouble))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    stage = dataclasses.replace(toy.STAGE, run=run)
    with pytest.raises(DiskError, match=f"cannot be written to .{os.strerror(trouble)}"):
        run_toy(dataset, stage=stage)
    assert tried == ["a", "b"] and receipts(dataset)["a"].status == "done"
    broken.clear()
    assert statuses(run_toy(dataset)) == {"a": "skipped", "b": "done", "c": "done"}


def test_a_nearly_full_disk_stops_before_an_item_is_computed(tmp_path, monkeypatch):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])
    usage = Mock(total=1e12, free=99e6)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(DiskFullError, match="expected at least 100.0 MB; 99.0 MB are free"):
        run_toy(dataset)
    assert receipts(dataset) == {} and not dataset.stage_dir("toy").exists()
    usage.free = 101e6
    assert run_toy(dataset).ok


def test_a_setting_that_fits_no_item_leaves_what_is_made(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])
    run_toy(dataset)

    def without(dataset, item, config):
        raise StageError("toy.weights /nope.pth: no such file")

    broken = dataclasses.replace(toy.STAGE, inputs=without)
    with pytest.raises(StageError, match="no item can be made: StageError: toy.weights /nope.pth"):
        run_toy(dataset, stage=broken, word="b")
    assert statuses(run_toy(dataset)) == {"a": "skipped", "b": "skipped"}


@pytest.mark.parametrize("workers", [0, 2])
def test_a_setting_that_every_item_fails_by_stops_after_a_few(tmp_path, workers):
    names = [f"a{n}" for n in range(8)]
    dataset = make_dataset(tmp_path / "data", names)
    run_toy(dataset)
    with pytest.raises(StageError, match="first 3 items fail with the same error, though they"):
        run_toy(dataset, workers=workers, files=-1)
    assert set(statuses(run_toy(dataset)).values()) == {"skipped"}


def test_items_that_never_were_made_may_all_fail(tmp_path):
    dataset = make_dataset(tmp_path / "data", [f"a{n}" for n in range(8)])
    assert set(statuses(run_toy(dataset, files=-1)).values()) == {"failed"}


def test_an_item_whose_input_is_missing_is_shown_as_failed(tmp_path, capsys):
    def without(dataset, item, config):
        raise StageError("not calibrated")

    waiting = dataclasses.replace(toy.STAGE, inputs=without)
    run_stage(waiting, make_dataset(tmp_path / "data", ["a"]), toy.ToyConfig(), pool=Pool(0))
    assert "toy 1/1 a failed 0.0 s: StageError: not calibrated" in capsys.readouterr().err


def test_outputs_of_vanished_items_are_set_aside_only_by_a_full_run(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a", "b"])
    run_toy(dataset)
    (dataset.root / "in" / "b.txt").unlink()
    run_toy(dataset, items=["a"])
    assert dataset.item_dir("toy", "b").exists()
    run_toy(dataset)
    assert not dataset.item_dir("toy", "b").exists()
    assert list(receipts(dataset)) == ["a"]


def test_items_that_vanish_cost_their_own_rows_alone(tmp_path, monkeypatch):
    parsed, counts = Ledger._parsed, [0]

    def counted(*arguments):
        counts[-1] += 1
        return parsed(*arguments)

    monkeypatch.setattr(Ledger, "_parsed", counted)
    for size in (10, 40):
        dataset = make_dataset(tmp_path / str(size), [f"a{n:02d}" for n in range(size)])
        run_toy(dataset)
        for path in sorted((dataset.root / "in").iterdir())[1:]:
            path.unlink()
        counts.append(0)
        run_toy(dataset)
        assert sorted(receipts(dataset)) == ["a00"]
    assert counts[-1] < 5 * counts[-2]


def test_workers_give_the_same_bytes_as_inline(tmp_path):
    names = [f"item{n}" for n in range(5)] + ["bad1", "bug1"]
    inline, spread = (make_dataset(tmp_path / n, names) for n in ("inline", "spread"))
    first, second = run_toy(inline, workers=0), run_toy(spread, workers=2)
    assert statuses(first) == statuses(second)
    assert tree(inline.stage_dir("toy")) == tree(spread.stage_dir("toy"))


def test_item_that_kills_its_worker_is_set_aside_after_two_attempts(tmp_path):
    names = ["poison1", "once1", *[f"item{n}" for n in range(6)]]
    dataset = make_dataset(tmp_path / "data", names)
    summary = run_toy(dataset, workers=2)
    assert {k for k, v in statuses(summary).items() if v == "failed"} == {"poison1"}
    table = receipts(dataset)
    assert (table["poison1"].attempts, table["once1"].attempts) == (2, 2)
    assert "died 2 times" in table["poison1"].reason


def test_receipt_counts_time_and_memory(tmp_path):
    dataset = make_dataset(tmp_path / "data", ["a"])
    run_toy(dataset, seconds=0.05)
    receipt = receipts(dataset)["a"]
    assert receipt.seconds >= 0.15
    assert 1e6 < receipt.peak_memory < 1e11
    assert receipt.metrics == {"length": 1, "dropped": [], "warnings": []}
    assert metrics_of(dataset, "toy", "a") == (receipt.metrics)


def test_receipt_and_metrics_hold_the_expected_error(tmp_path):
    stated = ExpectedError(0.4, 0.3, 0.6, "mm")
    stage = dataclasses.replace(
        toy.STAGE,
        run=lambda *task: dataclasses.replace(toy.STAGE.run(*task), expected_error=stated),
    )
    dataset = make_dataset(tmp_path / "data", ["a"])
    run_toy(dataset, stage=stage)
    metrics = metrics_of(dataset, "toy", "a")
    assert receipts(dataset)["a"].metrics == metrics
    assert metrics["expected_error"] == {"value": 0.4, "low": 0.3, "high": 0.6, "unit": "mm"}


def test_resolved_config_is_saved_and_can_be_given_back(tmp_path):
    from express50.contract.config import resolve_config

    dataset = make_dataset(tmp_path / "data", ["a"])
    run_toy(dataset, word="x", files=4)
    again = resolve_config(toy.STAGE, "draft", dataset.config_file("toy"))
    assert again == toy.ToyConfig(word="x", files=4)


def test_stage_without_items_and_unmatched_pattern_are_errors(tmp_path):
    dataset = make_dataset(tmp_path / "data", [])
    with pytest.raises(ConfigError, match="not a dataset"):
        run_toy(dataset)
    with (
        Ledger(dataset.ledger),
        pytest.raises(StageError, match="nothing to do; 'express50 status .*' shows which"),
    ):
        run_toy(dataset)
    dataset = make_dataset(tmp_path / "other", ["S001", "S002"])
    assert select_items(toy.STAGE, dataset, "*2") == ["S002"]
    with pytest.raises(ConfigError, match="no item of toy matches .did you mean 'S001'"):
        select_items(toy.STAGE, dataset, "S01")


def test_unreachable_scheduler_is_one_error_and_leaves_what_is_made(tmp_path, monkeypatch):
    from express50.runner import clusters

    dataset = make_dataset(tmp_path / "data", ["a", "b"])
    run_toy(dataset)
    monkeypatch.setattr(clusters, "CONNECT_SECONDS", 0.5)
    config, nowhere = toy.ToyConfig(word="b"), "tcp://127.0.0.1:9"
    with pytest.raises(StageError, match="scheduler tcp://127.0.0.1:9: cannot connect"):
        run_stage(toy.STAGE, dataset, config, pool=Pool(scheduler=nowhere), progress=False)
    assert statuses(run_toy(dataset)) == {"a": "skipped", "b": "skipped"}


def test_given_scheduler_is_used_and_left_running(tmp_path):
    from distributed import Client, LocalCluster

    dataset = make_dataset(tmp_path / "data", ["a", "b", "c"])
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        with Pool(scheduler=cluster.scheduler_address) as pool:
            summary = run_stage(toy.STAGE, dataset, toy.ToyConfig(), pool=pool, progress=False)
        with Client(cluster) as client:
            assert len(client.nthreads()) == 1
    assert summary.count("done") == 3


def test_two_runs_of_one_item_on_one_scheduler_both_make_it(tmp_path):
    from distributed import LocalCluster

    datasets = [make_dataset(tmp_path / name, ["a", "b"]) for name in ("one", "two")]
    config, options = toy.ToyConfig(seconds=0.1), {"dashboard_address": None, "protocol": "tcp://"}
    field_documents(toy.ToyConfig)  # CPython 3.11 may fail if two threads parse source at once
    with LocalCluster(n_workers=2, threads_per_worker=1, **options) as cluster:

        def go(dataset):
            with Pool(scheduler=cluster.scheduler_address) as pool:
                return run_stage(toy.STAGE, dataset, config, pool=pool, progress=False)

        with ThreadPoolExecutor(2) as threads:
            assert all(summary.count("done") == 2 for summary in threads.map(go, datasets))
    for dataset in datasets:
        assert all(dataset.item_dir("toy", item).is_dir() for item in ("a", "b"))


def test_lost_scheduler_is_one_error_and_what_is_done_is_kept(tmp_path):
    from distributed import LocalCluster

    dataset = make_dataset(tmp_path / "data", [f"item{n}" for n in range(40)])
    cluster = LocalCluster(n_workers=1, processes=True, dashboard_address=None, silence_logs=50)
    heard = BufferingHandler(100)
    logging.getLogger("distributed.client").addHandler(heard)
    timer = threading.Timer(1.0, cluster.close)
    timer.start()
    with (
        Pool(scheduler=cluster.scheduler_address) as pool,
        pytest.raises(StageError, match="lost the dask scheduler"),
    ):
        run_stage(toy.STAGE, dataset, toy.ToyConfig(seconds=0.1), pool=pool, progress=False)
    timer.join()
    logging.getLogger("distributed.client").removeHandler(heard)
    assert not heard.buffer  # else a page of tracebacks stands before the one line
    assert run_toy(dataset, seconds=0.001).ok


@pytest.mark.parametrize("call", ["nthreads", "submit"])
def test_whichever_call_finds_the_scheduler_gone_the_error_is_the_same(call):
    from distributed.comm import CommClosedError

    client = Mock()
    client.nthreads.return_value = {"worker": 1}
    getattr(client, call).side_effect = CommClosedError("in <TCP (closed)>: reset by peer")
    pool = Pool(scheduler="tcp://gone:8786")
    pool._workers = RemoteWorkers(client)
    task = Task(toy.STAGE, toy.Dataset(Path("data")), "item", toy.ToyConfig(), "f" * 64, {})
    with pytest.raises(StageError, match="lost the dask scheduler .*reset by peer"):
        pool.run([task, task], settle=Mock())


def test_bar_on_a_terminal_shows_counts_and_failures(tmp_path):
    """The driver's standard error is a pseudo-terminal; plain lines go everywhere else."""
    dataset = make_dataset(tmp_path / "data", ["a", "b", "bad1"])
    code = (
        "import sys; from pathlib import Path; from tests.faults import toy;"
        "from express50.runner.executor import Pool;"
        "from express50.runner.runner import run_stage;"
        "dataset = toy.Dataset(Path(sys.argv[1]));"
        "run_stage(toy.STAGE, dataset, toy.ToyConfig(seconds=.1), pool=Pool(0))"
    )
    driver, terminal = os.openpty()
    repository = Path(__file__).resolve().parents[3]
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "120"}
    command = [sys.executable, "-c", code, str(dataset.root)]
    with subprocess.Popen(command, cwd=repository, env=environment, stderr=terminal) as process:
        os.close(terminal)
        shown = b""
        with contextlib.suppress(OSError):  # Linux ends a terminal's output with EIO
            while block := os.read(driver, 4096):
                shown += block
    assert process.returncode == 0
    text = shown.decode()
    assert "3/3" in text
    assert "failed" in text


def test_freed_memory_is_used_again_and_is_given_back_between_items():
    allocator = keep_freed_memory()
    if allocator is None:
        pytest.skip("the C library is not glibc")

    def cycle():
        for _ in range(20):
            np.ones(5_000_000, np.float32)

    cycle()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    cycle()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < 1000  # of 97,000 pages
    np.ones(50_000_000, np.float32)
    reset_peak_memory()
    held = peak_memory()
    allocator.malloc_trim(0)
    reset_peak_memory()
    assert peak_memory() < held - 150_000_000
