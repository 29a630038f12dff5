"""No state of the protocol is wrong, its mistakes are found, and the code does what it says."""

import functools
import itertools
import os
import shutil
from collections.abc import Iterable

import pytest

from express50.contract.layout import Dataset
from express50.errors import StageError
from express50.runner.ledger import Ledger
from express50.runner.publish import stage_lock
from tests.faults import toy
from tests.faults.protocol import MISTAKES, SET_ASIDE, Rules, State, explore, first_states, steps
from tests.faults.traced import Recorder

ITEM = "S001/smile"
KILLED = 9
SILENT = (
    "start",
    "driver: hand out",
    "driver: receipt",
    "worker: fail",
    "worker: report to nobody",
)


@pytest.mark.no_cover  # it would take twice as long, and the model is not the product
@pytest.mark.parametrize("swaps", [True, False])
def test_every_state_is_right(swaps):
    count, wrong, way = explore(Rules(swaps=swaps))
    assert not wrong, way
    assert count > 30_000


HARM = {
    "entries not synced": "torn",
    "parent not synced": "torn",
    "receipt before rename": "lost",
    "old removed first": "lost",
    "looks before it renames": "failed in vain",
    "leftovers deleted in place": "torn",
    "former not restored": "lost",
    "no lock": "doubled",
}


@pytest.mark.no_cover
@pytest.mark.parametrize("mistake", MISTAKES)
def test_every_mistake_is_found(mistake):
    _, wrong, way = explore(Rules(mistake, swaps="former" not in mistake))
    assert wrong == HARM[mistake] and way


@functools.cache  # runs that are killed one call later begin alike
def ways(states: frozenset[State], step: str, rules: Rules) -> frozenset[State]:
    """Return the states after a step that was seen, with any number of unseen ones before it."""
    kills = ("kill driver", "kill worker") if step == "kill" else ()
    reached, new, after = set(states), list(states), set()
    while new:
        state = new.pop()
        for name, following in steps(state, rules):
            quiet = name in SILENT or name in kills
            # The real call has nothing to delete where the model's step deletes nothing.
            quiet |= name == "worker: delete aside" and following.folders == state.folders
            quiet |= name == "driver: delete" and not state.makes
            if step in (name, name.replace(name.split(":")[0], "any")):
                after.add(following)
            if quiet and following not in reached:
                reached.add(following)
                new.append(following)
    if step == "kill":
        after = {s for s in reached if not s.runs and not alive(s)}
    return frozenset(after)


def alive(state: State) -> list:
    return [make for make in state.makes if not make.at.startswith("dead")]


def follow(recorded: list[str], states: Iterable[State], rules: Rules) -> frozenset[State]:
    """Return the states in which the model may be after what was recorded; fails if none."""
    states = frozenset(states)
    for number, step in enumerate(recorded):
        states = ways(states, step, rules)
        assert states, f"after {recorded[:number]} the model has no step {step!r}"
    return states


def dataset_of(root, made):
    dataset = toy.make_dataset(root, [ITEM])
    if made:
        assert toy.run_toy(dataset).ok
    return dataset


def record(dataset, monkeypatch, swaps=True, **settings):
    recorder = Recorder(dataset, "toy", ITEM, swaps)
    with monkeypatch.context() as patch:
        recorder.watch(patch)
        toy.run_toy(dataset, **settings)
    return recorder.steps


def record_until_killed(dataset, monkeypatch, swaps, calls):
    """Run in a child that is killed ahead of its n-th call; returns its steps, and if it was."""
    read, write = os.pipe()
    child = os.fork()
    if not child:
        left = [calls]
        recorder = Recorder(dataset, "toy", ITEM, swaps)

        def before():
            left[0] -= 1
            if left[0] < 0:
                os._exit(KILLED)

        recorder.before = before
        recorder.after = lambda step: os.write(write, f"{step}\n".encode())
        recorder.watch(monkeypatch)
        toy.run_toy(dataset, word="b")
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as file:
        recorded = file.read().splitlines()
    return recorded, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == KILLED


def on_disk(dataset):
    """Return settings of the published output ("" if it is none that a run makes) and receipt."""
    folder = dataset.item_dir("toy", ITEM)
    found = toy.tree(folder) if folder.exists() else None
    receipt = ""
    if dataset.ledger.exists():
        with Ledger(dataset.ledger) as ledger:
            receipt = ledger.read("toy").get(ITEM)
    return found, receipt


def replaced(dataset):
    """Return the files of the outputs that are kept for going back to them."""
    entries = [path.parent for path in sorted(dataset.replaced_dir.rglob(".receipt.json"))]
    return [
        {name: data for name, data in toy.tree(entry).items() if name != ".receipt.json"}
        for entry in entries
    ]


def assert_agree(states, dataset, outputs):
    """Check that output and receipt are those of one of the model's states."""
    found, receipt = on_disk(dataset)
    digests = {outputs[word][1]: word for word in outputs}
    words = "" if not receipt else digests.get(receipt.fingerprint, "failed")
    if receipt and receipt.status == "failed":
        words = "failed"
    said = {
        (None if s.target in (None, SET_ASIDE) else s.folders[s.target].settings, s.receipt)
        for s in states
    }
    content = None if found is None else next(w for w in outputs if outputs[w][0] == found)
    assert (content, words) in said


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    """Files and fingerprint of the item by settings, of undisturbed runs."""
    made = {}
    for word in ("a", "b"):
        dataset = toy.make_dataset(tmp_path_factory.mktemp(word), [ITEM])
        toy.run_toy(dataset, word=word)
        found, receipt = on_disk(dataset)
        made[word] = found, receipt.fingerprint
    return made


@pytest.mark.parametrize("made", [False, True])
@pytest.mark.parametrize("swaps", [True, False])
def test_a_run_is_a_path_of_the_model(tmp_path, monkeypatch, outputs, made, swaps):
    dataset = dataset_of(tmp_path, made)
    rules = Rules(swaps=swaps, crashes=0, late=0)
    recorded = record(dataset, monkeypatch, swaps, word="b")
    states = follow(recorded, [first_states(rules)[made]], rules)
    assert_agree(states, dataset, outputs)
    assert ("worker: swap" in recorded) == (made and swaps)
    assert ("worker: rename old" in recorded) == (made and not swaps)
    for step in ("driver: lock", "any: sync parent", "worker: sync entries", "driver: commit"):
        left_out = [one for one in recorded if one != step]
        with pytest.raises(AssertionError, match="the model has no step"):
            follow([*left_out, "driver: lock"], [first_states(rules)[made]], rules)
    again = record(dataset, monkeypatch, swaps, word="b")
    assert again == ["driver: lock", "driver: look"]
    assert_agree(states := follow(again, states, rules), dataset, outputs)
    if made:
        back = record(dataset, monkeypatch, swaps, word="a")  # what was replaced comes back
        assert_agree(follow(back, states, rules), dataset, outputs)
        assert replaced(dataset) == [outputs["b"][0]]


@pytest.mark.parametrize("swaps", [True, False])
def test_a_run_killed_at_any_call_and_the_next_one_are_a_path(
    tmp_path, monkeypatch, outputs, swaps
):
    dataset_of(tmp_path / "first", True)
    rules, before = Rules(swaps=swaps, late=0, runs=2), [first_states(Rules())[True]]
    left, second = [], set()
    for calls in itertools.count():
        dataset = Dataset(tmp_path / str(calls))
        shutil.copytree(tmp_path / "first", dataset.root)
        recorded, killed = record_until_killed(dataset, monkeypatch, swaps, calls)
        states = follow([*recorded, *["kill"] * killed], before, rules)
        assert_agree(states, dataset, outputs)
        left.append(on_disk(dataset)[0])
        recorded = record(dataset, monkeypatch, swaps, word="b")
        assert_agree(follow(recorded, states, rules), dataset, outputs)
        second |= set(recorded)
        assert on_disk(dataset)[0] == outputs["b"][0]
        assert all(files in (outputs["a"][0], outputs["b"][0]) for files in replaced(dataset))
        assert [path.name for path in dataset.staging_dir.iterdir()] == [".toy.lock"]
        if not killed:
            break
    assert outputs["a"][0] in left and left[-1] == outputs["b"][0]
    # Between two renames there is no output, and the next run puts the former one back.
    assert (None in left) == ("driver: restore" in second) == (not swaps)


def test_failures_and_a_second_run_are_paths(tmp_path, monkeypatch, outputs):
    dataset, rules = dataset_of(tmp_path, True), Rules(crashes=0, late=0, at_once=2)
    with stage_lock(dataset, "toy"), pytest.raises(StageError, match="another 'toy' is running"):
        record(dataset, monkeypatch)
    recorded = record(dataset, monkeypatch, files=-1)  # a wrong setting: the output stands
    states = follow(recorded, [first_states(rules)[True]], rules)
    assert_agree(states, dataset, outputs)
    assert "driver: set aside" not in recorded
    (dataset.root / "in" / "S001+smile.txt").write_text("other data")
    recorded = record(dataset, monkeypatch, files=-1)
    states = follow(recorded, states, rules)
    assert_agree(states, dataset, outputs)
    assert "driver: set aside" in recorded and on_disk(dataset)[0] is None
