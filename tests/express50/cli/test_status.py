"""`status` reads a dataset's progress from its ledger while others write it."""

import html.parser
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from express50.__main__ import main
from express50.cli import status as status_cli
from express50.cli.status import SILENT_SECONDS, UNLOCKED_SECONDS, read_status, status_page
from express50.console import format_seconds
from express50.contract.layout import Dataset
from express50.runner import executor, worker
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger, Receipt, Run
from express50.runner.publish import is_running
from express50.runner.runner import run_stage
from pipelines import ingest
from tests.faults import toy
from tests.synth import make_capture

REPOSITORY = Path(__file__).resolve().parents[3]


def receipt(item, at, status="done", **values):
    values = {"stage": "toy", "fingerprint": "f", "seconds": 2.0} | values
    reason = "StageError: dark" if status == "failed" else ""
    return Receipt(item=item, time=at, status=status, reason=reason, **values)


def of(tmp_path, run, receipts, now):
    with Ledger(tmp_path / "ledger.sqlite") as ledger:
        if run is not None:
            ledger.write_run(run)
        for one in receipts:
            ledger.write(one)
    with Ledger(tmp_path / "ledger.sqlite", read_only=True) as ledger:
        (row,) = read_status(ledger, ["toy"], now)
    return row


def test_a_run_states_what_is_done_running_and_to_do_and_when_it_ends(tmp_path):
    run = Run(
        stage="toy",
        items=14,
        current=2,
        begun=100.0,
        seen=119.0,
        running={"a6": 115.0, "a5": 112.0},
    )
    receipts = [receipt(f"a{n}", 104.0 + 2 * n) for n in range(5)]
    receipts += [receipt("bad", 120.0, "failed", peak_memory=7), receipt("old", 50.0)]
    row = of(tmp_path, run, receipts, 120.0)
    assert (row.state, row.done, len(row.failed)) == ("running", 6, 1)
    assert sorted(row.running) == ["a5", "a6"]
    assert row.to_do == 14 - 2 - 6 - 2
    assert row.rate == pytest.approx(6 / 20)
    assert row.left_s == pytest.approx((14 - 2 - 6) / (6 / 20))
    assert (row.seconds, row.peak_memory) == (14.0, 7)


def test_a_trial_of_a_budgeted_run_is_shown(tmp_path, capsys):
    """It works in a dataset of its own, so that the table alone shows nothing for minutes."""
    make_capture(tmp_path / "S001", cameras=1)
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [tmp_path / "S001"])
    trial = dataset.pilot_dir / "abc"
    trial.mkdir(parents=True)
    now = time.time()
    with Ledger(trial / "ledger.sqlite") as ledger:
        ledger.write_run(Run(stage="observe", items=1, begun=now, seen=now, running={"S001": now}))
    assert main(["status", str(dataset.root)]) == 0
    assert "running observe: a trial" in capsys.readouterr().out
    Ledger(dataset.ledger).__exit__()
    assert main(["status", str(dataset.root)]) == 0
    assert "running observe: a trial" in capsys.readouterr().out


def test_an_item_that_has_ended_since_the_last_sign_is_not_running(tmp_path):
    run = Run(stage="toy", items=2, begun=100.0, seen=110.0, running={"a": 105.0, "b": 105.0})
    row = of(tmp_path, run, [receipt("a", 111.0)], 112.0)
    assert (list(row.running), row.done, row.to_do) == (["b"], 1, 0)


def test_items_that_failed_before_are_counted_once_while_they_wait(tmp_path):
    run = Run(stage="toy", items=6, current=1, begun=100.0, seen=119.0, running={"bad": 115.0})
    old = [receipt("bad", 50.0, "failed"), receipt("worse", 50.0, "failed"), receipt("ok", 50.0)]
    row = of(tmp_path, run, [*old, receipt("new", 110.0)], 120.0)
    # Two have no receipt yet.
    assert row.counts() == {"done": 2, "failed": 1, "running": 1, "to do": 2}
    assert [r.item for r in row.failed] == ["worse"]


def test_an_output_that_stood_when_its_item_failed_is_counted_once(tmp_path):
    stood = replace(receipt("a", 50.0), reason="CaptureError: no such folder")
    run = Run(stage="toy", items=2, begun=100.0, seen=119.0)
    row = of(tmp_path, run, [stood, receipt("b", 50.0)], 120.0)
    assert row.counts() == {"done": 0, "failed": 1, "running": 0, "to do": 1}


def test_the_rate_is_recent_and_falls_while_no_item_ends(tmp_path):
    slow = [receipt(f"slow{n}", 100.0 + 10 * n) for n in range(60)]
    quick = [receipt(f"quick{n}", 700.0 + n) for n in range(60)]
    run = Run(stage="toy", items=200, begun=90.0, seen=759.0)
    assert of(tmp_path, run, slow + quick, 759.0).rate == pytest.approx(1.0)
    assert of(tmp_path, run, [], 759.0 + 10).rate == pytest.approx(50 / 60)


@pytest.mark.parametrize(
    ("run", "receipts", "state", "to_do"),
    [
        (None, [], "not run", 0),
        (Run(stage="toy", items=1, begun=1.0, seen=3.0, ended=3.0), ["done"], "done", 0),
        (Run(stage="toy", items=1, begun=1.0, seen=3.0, ended=3.0), ["failed"], "failed", 0),
        (Run(stage="toy", items=3, begun=1.0, seen=3.0, ended=3.0), ["done"], "stopped", 2),
        (
            Run(stage="toy", items=3, begun=1.0, seen=3.0, running={"b": 2.0}),
            ["done"],
            "stopped",
            2,
        ),
    ],
)
def test_states(tmp_path, run, receipts, state, to_do):
    rows = [receipt(f"a{n}", 2.0, one) for n, one in enumerate(receipts)]
    row = of(tmp_path, run, rows, 4.0 + SILENT_SECONDS)
    assert (row.state, row.to_do, row.running) == (state, to_do, {})


class Tags(html.parser.HTMLParser):
    """Open elements balance, and nothing is loaded from elsewhere."""

    VOID = {"meta", "br"}

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.attributes, self.text = [], [], [], ""

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        self.attributes += attrs
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def parsed(text):
    tags = Tags()
    tags.feed(text)
    assert tags.open == []
    assert not [value for name, value in tags.attributes if name in ("src", "href", "srcset")]
    assert not re.search(r"https?:|url\(|@import", text)
    return tags


def test_page_escapes_all_text_and_loads_nothing(tmp_path):
    evil = "<script>alert(1)</script>&\"'"
    failed = receipt(evil, 105.0, "failed", metrics={}, attempts=3)
    run = Run(stage="toy", items=9, begun=100.0, seen=119.0, running={evil + "2": 101.0})
    row = of(tmp_path, run, [failed, receipt("slow", 110.0, seconds=4020.0)], 120.0)
    tags = parsed(status_page(evil, [row], 3.0))
    assert tags.seen.count("script") == 1  # its own, by which it loads itself again
    for words in (evil + "2", "StageError: dark", "1:07 h", "running", "to do"):
        assert words in tags.text
    assert "script" not in parsed(status_page(evil, [row], None)).seen


def test_durations():
    words = [format_seconds(s) for s in (1.26, 42.4, 59.7, 185, 7800, 273_600)]
    assert words == ["1.3 s", "42 s", "1:00 min", "3:05 min", "2:10 h", "3 d 4 h"]


@contextmanager
def running_toy(dataset, workers):
    """A run of the toy in another process, which is killed unless it has ended by then."""
    command = [sys.executable, "-m", "tests.faults.toy", str(dataset.root), str(workers)]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen(
        command, cwd=REPOSITORY, env=environment, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def status_of_toy(dataset, now=None):
    with Ledger(dataset.ledger, read_only=True) as ledger:
        (row,) = read_status(ledger, ["toy"], now)
    return row


def first_with(dataset, seen, patience=60.0):
    """The first status of which something is true."""
    give_up = time.monotonic() + patience
    while time.monotonic() < give_up:
        if dataset.ledger.is_file():
            row = status_of_toy(dataset)
            if seen(row):
                return row
        time.sleep(0.05)
    raise AssertionError("not seen")


@pytest.mark.parametrize("workers", [0, 2])
def test_page_follows_a_run_of_another_process_to_its_end(tmp_path, monkeypatch, workers):
    names = ["bad1", *(f"item{n}" for n in range(4)), "wait"]
    dataset = toy.make_dataset(tmp_path / "data", names)
    said = []

    def say(line):  # the second line says that the page follows a run, whose last item then ends
        said.append(line)
        if len(said) == 2:
            (dataset.root / "go").touch()

    monkeypatch.setattr(status_cli, "PAGE_SECONDS", 0.2)
    monkeypatch.setattr(status_cli, "say", say)
    monkeypatch.setattr(status_cli, "stages", lambda: {"toy": toy.STAGE})
    page = tmp_path / "page.html"
    with running_toy(dataset, workers) as process:
        row = first_with(dataset, lambda row: row.state == "running" and row.running and row.done)
        assert row.done + len(row.failed) + len(row.running) + row.to_do == len(names)
        assert main(["status", str(dataset.root), "--page", str(page)]) == 1
        assert process.wait(timeout=60) == 1
    assert said[0] == f"wrote {page}" and "until the run ends" in said[1]
    end = status_of_toy(dataset)
    assert (end.state, end.done, len(end.failed), end.to_do) == ("failed", 5, 1, 0)
    text = page.read_text()
    assert "bad1" in text and "expected &#39;repaired&#39;" in text
    assert "script" not in parsed(text).seen


def test_a_worker_whose_clock_is_behind_does_not_stop_the_run(tmp_path, monkeypatch):
    def run_task(task):
        made = worker.run_task(task)
        return replace(made, time=made.time - 300)

    monkeypatch.setattr(executor, "run_task", run_task)
    dataset = toy.make_dataset(tmp_path / "data", ["a", "b"])
    toy.run_toy(dataset, workers=0)
    row = status_of_toy(dataset)
    assert (row.state, row.counts()["done"], row.counts()["to do"]) == ("done", 2, 0)


def test_finished_items_are_not_to_do_while_a_run_looks_what_has_changed(tmp_path):
    dataset = toy.make_dataset(tmp_path / "data", ["a", "b"])
    toy.run_toy(dataset, workers=0)
    (dataset.root / "in" / "c.txt").write_text("new")
    seen = []

    def inputs(dataset, item, config):
        row = first_with(dataset, lambda row: row.state == "running")
        seen.append((row.done, row.to_do))
        return toy.inputs(dataset, item, config)

    stage = replace(toy.STAGE, inputs=inputs)
    run_stage(stage, dataset, toy.ToyConfig(), pool=Pool(0), progress=False)
    assert seen == [(2, 1)] * 3
    row = status_of_toy(dataset)
    assert (row.state, row.done, row.to_do) == ("done", 3, 0)


def test_a_killed_run_counts_as_stopped(tmp_path):
    dataset = toy.make_dataset(tmp_path / "data", [*(f"item{n}" for n in range(40)), "wait"])
    with running_toy(dataset, 0):
        first_with(dataset, lambda row: row.running)
    assert status_of_toy(dataset, time.time() + SILENT_SECONDS).state == "stopped"
    clock_set_back = time.time() - 1e6
    assert status_of_toy(dataset, clock_set_back).state == "stopped"
    with Ledger(dataset.ledger, read_only=True) as ledger:  # its lock is free, so it is sooner sure
        soon, locked = time.time() + UNLOCKED_SECONDS, partial(is_running, dataset)
        (row,) = read_status(ledger, ["toy"], soon, locked)
    assert row.state == "stopped"
    assert row.to_do + row.done == 41 and row.to_do > 0


def test_serve_answers_only_on_this_machine(tmp_path):
    of(tmp_path, None, [receipt("a", 1.0, stage="ingest")], 2.0)
    command = [sys.executable, "-u", "-m", "express50", "status", str(tmp_path), "--serve", "0"]
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True) as process:
        address = process.stdout.readline().split()[0]
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address, timeout=10) as answer:
            assert "ingest" in parsed(answer.read().decode()).text
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(address + "ledger.sqlite", timeout=10)
        process.send_signal(signal.SIGINT)  # the way to stop it, so no failure
    assert process.returncode == 0


def test_a_file_that_is_not_a_ledger_is_one_error_without_advice_to_delete_it(tmp_path, capsys):
    (tmp_path / "ledger.sqlite").write_bytes(b"no database" * 100)
    assert main(["status", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "cannot be read as a ledger" in error and "delete" not in error


def test_a_port_that_cannot_be_is_one_error(tmp_path, capsys):
    of(tmp_path, None, [], 2.0)
    assert main(["status", str(tmp_path), "--serve", "70000"]) == 2
    assert "expected a whole number, 0 to 65535" in capsys.readouterr().err


def test_status_reads_ledgers_of_before_runs_were_kept_and_writes_nothing(tmp_path, capsys):
    of(tmp_path, None, [receipt("a", 1.0, "failed", stage="ingest")], 2.0)
    with Ledger(tmp_path / "ledger.sqlite") as ledger:
        ledger._database.execute("DROP TABLE runs")
        ledger._database.execute("PRAGMA journal_mode=DELETE")
    before = (tmp_path / "ledger.sqlite").read_bytes()
    assert main(["status", str(tmp_path), "--page", str(tmp_path / "p.html")]) == 1
    assert main(["status", str(tmp_path), "--json"]) == 1
    out = capsys.readouterr().out
    assert json.loads(out[out.index("{") :])["ingest"][0]["reason"] == "StageError: dark"
    assert "StageError: dark" in (tmp_path / "p.html").read_text()
    assert (tmp_path / "ledger.sqlite").read_bytes() == before


def test_outdated_outputs_are_listed_with_what_changed(tmp_path, capsys):
    make_capture(tmp_path / "S001", subject="S001", cameras=2, frames=4)
    root = tmp_path / "data"
    ingest = ["ingest", str(root), str(tmp_path / "S001"), "--workers", "0"]
    assert main(ingest) == 0
    capsys.readouterr()
    assert main(["status", str(root)]) == 0
    assert "outdated" not in capsys.readouterr().out

    config = root / "config" / "ingest.toml"  # as a run writes it that fails or is stopped
    config.write_text(config.read_text().replace("proxy_quality = 85", "proxy_quality = 70"))
    why = "settings changed: proxy_quality was 85, is 70"
    assert main(["status", str(root)]) == 0
    assert f"outdated ingest S001: {why}" in capsys.readouterr().out
    assert main(["status", str(root), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ingest"][0]["outdated"] == why
    assert main(["check", str(root)]) == 0
    assert f"note: ingest: outdated S001: {why}" in capsys.readouterr().out

    assert main(ingest) == 0  # the settings that it was made with
    assert "1 skipped" in capsys.readouterr().out
    footage = next((tmp_path / "S001").rglob("*.png"))
    footage.write_bytes(footage.read_bytes() + b"x")
    assert main(["status", str(root)]) == 0
    assert "outdated ingest S001: inputs changed: " in capsys.readouterr().out


def test_dropped_parts_are_counted(tmp_path, capsys):
    notes = [{"what": f"camera {n}", "why": "it is dark"} for n in range(5)]
    with Ledger(tmp_path / "ledger.sqlite") as ledger:
        ledger.write(receipt("S001", 1.0, stage="ingest", metrics={"dropped": notes}))
    assert main(["status", str(tmp_path)]) == 0
    assert "dropped ingest: 5 parts, camera 0 of S001, " in capsys.readouterr().out
