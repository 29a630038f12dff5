"""Items that read another item's output: what they read is made first, whatever was asked for."""

from __future__ import annotations

from dataclasses import replace

import pytest

from express50.errors import StageError
from express50.runner.runner import run_stage
from express50.runner.schedule import waves_of
from tests.faults import toy
from tests.faults.toy import make_dataset, tree


def sources(dataset, item, config):
    return [] if item == "first" else ["first"]


def inputs(dataset, item, config):
    found = dataset.item_dir("toy", "first") / "deep"
    return toy.inputs(dataset, item, config) | ({} if item == "first" else {"source": found})


def run(dataset, item, config, out):
    facts = toy.run(dataset, item, config, out)
    if item != "first":
        read = (dataset.item_dir("toy", "first") / "deep" / "0.bin").read_bytes()
        (out / "read.bin").write_bytes(read)
    return facts


STAGE = replace(toy.STAGE, inputs=inputs, run=run, sources=sources)
NAMES = ["a", "b", "first"]


def done(dataset, items=None, workers=0):
    summary = run_stage(STAGE, dataset, toy.ToyConfig(), items, workers=workers, progress=False)
    return {outcome.item: outcome.status for outcome in summary.outcomes}


@pytest.mark.parametrize("workers", [0, 2])
def test_any_order_gives_the_same_bytes(tmp_path, workers):
    at_once = make_dataset(tmp_path / "one", NAMES)
    assert done(at_once, workers=workers) == dict.fromkeys(NAMES, "done")
    in_turn = make_dataset(tmp_path / "two", NAMES)
    assert done(in_turn, ["b"]) == {"b": "done", "first": "done"}
    assert done(in_turn, ["a"]) == {"a": "done", "first": "skipped"}
    assert tree(at_once.stage_dir("toy")) == tree(in_turn.stage_dir("toy"))
    assert done(in_turn) == dict.fromkeys(NAMES, "skipped")


def test_a_changed_source_is_made_again_and_so_is_what_read_it(tmp_path):
    dataset = make_dataset(tmp_path / "data", NAMES)
    done(dataset)
    before = tree(dataset.stage_dir("toy"))
    (dataset.root / "in" / "first.txt").write_text("other")
    assert done(dataset, ["a"]) == {"a": "done", "first": "done"}
    after = tree(dataset.stage_dir("toy"))
    assert after["a/read.bin"] != before["a/read.bin"]
    assert after["a/read.bin"] == after["first/deep/0.bin"]


def test_items_that_wait_for_each_other_are_one_error():
    ring = replace(STAGE, sources=lambda dataset, item, config: ["b" if item == "a" else "a"])
    with pytest.raises(StageError, match="wait for each other"):
        waves_of(ring, None, None, ["a"])


def test_a_source_that_fails_does_not_take_the_others_along(tmp_path):
    """As the depth stage does it: what is not there is not read."""

    def perhaps(dataset, item, config):
        found = dataset.item_dir("toy", "bad") / "deep"
        read = {} if item == "bad" else {"source": found if found.is_dir() else "none"}
        return toy.inputs(dataset, item, config) | read

    needing = {"a": ["bad"], "b": ["bad"], "bad": []}
    stage = replace(toy.STAGE, inputs=perhaps, sources=lambda d, item, c: needing[item])
    dataset = make_dataset(tmp_path / "data", list(needing))

    def outcome():
        summary = run_stage(stage, dataset, toy.ToyConfig(), workers=0, progress=False)
        return {one.item: one.status for one in summary.outcomes}

    assert outcome() == {"a": "done", "b": "done", "bad": "failed"}
    (dataset.root / "in" / "bad.txt").write_text("mended")
    assert outcome() == dict.fromkeys(needing, "done")
    assert outcome() == dict.fromkeys(needing, "skipped")
