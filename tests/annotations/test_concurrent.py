"""Annotators at once on one subject, some of them killed: no acknowledged event lost, none torn."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from annotations.labels import append_label, current_labels, labels_of, make_mark, read_labels
from express50.capture.index import read_index

REPOSITORY = Path(__file__).resolve().parents[2]
KILLED = {"bob": 17, "dot": 41}  # after so many acknowledged events

# Decides at random through the session that the screen uses, and says so after each event.
_ANNOTATOR = """
import json, random, sys
sys.path[:0] = sys.argv[4:]
from annotations.ui.task import load_scene
from annotations.ui.session import Session
from annotations.ui.task import go_to, open_view
from express50.contract.layout import Dataset

who = sys.argv[2]
dice = random.Random(who)
session = Session(Dataset(sys.argv[1]), who, subjects=["S001"], order="subject")
print("ready", flush=True)
sys.stdin.readline()
for _ in range(int(sys.argv[3])):
    session.move(dice.choice([-1, 1]))
    scene = load_scene(session.dataset, session.task, who)
    view = open_view(scene.first, scene.last)
    what = dice.choice(["mark", "mark", "mark", "flag", "undo"])
    said = [what, scene.task.expression, None]
    if what == "mark":
        said[2] = dice.randint(scene.first, scene.last)
        session.mark(scene, go_to(view, said[2]), dice.choice(scene.cameras))
    elif what == "flag":
        session.flag(scene, "occluded")
    elif (undone := session.undo()) is not None:
        said[1] = undone.expression
    else:
        continue
    print(json.dumps(said), flush=True)
"""


def start(dataset, who):
    count = "1000000" if who in KILLED else "120"
    command = [sys.executable, "-c", _ANNOTATOR, str(dataset.root), who, count, str(REPOSITORY)]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip


def stack_of(events):
    """What is left of a person's events: expression to frame, None for a flag."""
    stacks = {}
    for what, expression, frame in events:
        stack = stacks.setdefault(expression, [])
        if what != "undo":
            stack.append(frame)
        elif stack:
            stack.pop()
    return {expression: stack[-1] for expression, stack in stacks.items() if stack}


@pytest.fixture
def finished(suggested):
    """Four ran at once, two of them killed in the middle: (dataset, acknowledged by annotator)."""
    workers = {who: start(suggested, who) for who in ("ann", "bob", "cem", "dot")}
    for worker in workers.values():
        assert worker.stdout.readline() == "ready\n"
    for worker in workers.values():
        worker.stdin.write("go\n")
        worker.stdin.flush()
    heard = {who: [] for who in workers}
    for who, count in KILLED.items():
        heard[who] = [workers[who].stdout.readline() for _ in range(count)]
        time.sleep(0.003)  # somewhere in the next event
        workers[who].send_signal(signal.SIGKILL)
    for who, worker in workers.items():
        rest, _ = worker.communicate()
        heard[who] += rest.splitlines()
        assert worker.returncode == (-signal.SIGKILL if who in KILLED else 0)
    return suggested, {who: [json.loads(line) for line in lines] for who, lines in heard.items()}


def test_no_acknowledged_event_is_lost_or_torn_and_the_order_is_kept(finished):
    dataset, heard = finished
    text = dataset.labels_file("S001").read_text()
    assert text.endswith("\n")
    rows = [json.loads(line) for line in text.splitlines()]  # a torn line is no JSON
    assert len(heard["ann"]) > 80 and len(heard["cem"]) > 80
    for who, said in heard.items():
        mine = [r for r in rows if r["annotator"] == who]
        found = [[r["action"], r["expression"], r.get("frame")] for r in mine]
        assert found[: len(said)] == said
        # A killed one may have written one event more than it could tell of.
        assert len(found) - len(said) <= (who in KILLED)
        force = labels_of(read_labels(dataset, "S001"), who)
        assert {e: label.frame for e, label in force.items()} == stack_of(found)
    index = read_index(dataset, "S001")
    marks = [r for r in rows if r["action"] == "mark"]
    assert all(index.cameras[r["camera"]].dhash[r["frame"]] == r["dhash"] for r in marks)
    # Their turns interleave: nobody waited for another to finish.
    assert sum(a["annotator"] != b["annotator"] for a, b in zip(rows, rows[1:], strict=False)) > 40


def test_full_disk_raises_and_loses_no_other_mark(suggested, monkeypatch):
    index = read_index(suggested, "S001")
    append_label(suggested, make_mark(index, "smile", 20, "cam00", "ann"))
    write, rest = os.write, [30]

    def full(handle, data):
        if rest[0] == 0:
            raise OSError(28, "No space left on device")
        count = write(handle, data[: rest[0]])
        rest[0] -= count
        return count

    monkeypatch.setattr("annotations.labels.os.write", full)
    with pytest.raises(OSError, match="No space"):
        append_label(suggested, make_mark(index, "smile", 21, "cam00", "ann"))
    monkeypatch.setattr("annotations.labels.os.write", lambda h, data: write(h, data[:7]))
    append_label(suggested, make_mark(index, "smile", 22, "cam00", "ann"))
    assert [label.frame for label in read_labels(suggested, "S001")] == [20, 22]


@pytest.mark.parametrize(
    "tail", [b"\0" * 4096, b'{"action": "ma\xff\xfe', b"\xe2\x82", b"[1, 2]x", b'{"subj']
)
def test_corrupt_last_line_is_skipped(suggested, tail):
    index = read_index(suggested, "S001")
    append_label(suggested, make_mark(index, "smile", 20, "cam00", "ann"))
    with suggested.labels_file("S001").open("ab") as file:
        file.write(tail)
    append_label(suggested, make_mark(index, "smile", 22, "cam00", "bob"))
    labels = read_labels(suggested, "S001")
    assert [label.frame for label in labels] == [20, 22]
    assert current_labels(labels)["smile"].frame == 22
