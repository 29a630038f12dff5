"""Budgeted runs of a toy chain: what is chosen, promised and kept, and how they go on."""

import itertools
import json
import re
import shutil
from dataclasses import replace

import pytest

from annotations.suggestions import reference_subject
from express50.contract.layout import Dataset, existing_dataset
from express50.dial.budget import Clock, parse_budget, parse_goal
from express50.dial.choice import point_of
from express50.dial.figures import Cost, Footage, Trial, dial_dir
from express50.dial.measuring import measured_figures, tune, workload
from express50.dial.pilot import Pilot, guessed, keep_for_run, trial_seconds
from express50.dial.run import RunState, closing_lines, reserved, run_file, run_within
from express50.errors import ConfigError, StageError
from express50.files.atomic import write_json
from express50.runner.executor import Pool
from express50.runner.runner import run_stage
from tests.express50.dial.toy_chain import (
    FAILS,
    PAUSE,
    STOPS,
    StepsConfig,
    captures_of,
    chain_of,
    count_pauses,
    error_of,
)
from tests.faults.toy import tree
from tests.synth import make_capture

STEPS = {"draft": 1, "standard": 4, "reference": 16}


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return captures_of(tmp_path_factory.mktemp("captures"))


def go(root, captures, budget=None, goal=None, said=None):
    chain = chain_of(root, captures, said)
    budget = None if budget is None else parse_budget(budget)
    goal = None if goal is None else parse_goal(goal)
    return run_within(chain, budget, goal, lambda stage, summary: None)


def outputs(root):
    dataset = Dataset(root)
    return {name: tree(dataset.stage_dir(name)) for name in ("ingest", "align", "solve", "map")}


def test_much_time_buys_the_dearest_settings_and_the_promise_is_the_error(tmp_path, captures):
    """What the pilot made is not made twice, and a finished run has nothing more to do."""
    said = []
    summaries, state = go(tmp_path / "d", captures, "5m", said=said)
    assert state.finished and all(summary.ok for summary in summaries)
    assert state.settings == {
        "ingest": "standard", "align": "standard", "solve": "reference", "map": "reference"
    }  # fmt: skip
    promised = state.promised["value"]
    assert promised["value"] == pytest.approx(error_of(state.settings), rel=0.05)
    assert promised["low"] < error_of(state.settings) < promised["high"]
    assert any("expected error: value 0.5" in line for line in said)
    assert any("draft:" in line and "less, value +" in line for line in said)
    assert not Dataset(tmp_path / "d").pilot_dir.exists()
    for path in dial_dir(Dataset(tmp_path / "d")).iterdir():  # figures name nobody
        assert "S0" not in path.read_text() and "S1" not in path.read_text()
    restored = {s.stage: sum(o.restored for o in s.outcomes) for s in summaries}
    assert restored["ingest"] == 1 and restored["align"] == 1
    summaries, state = go(tmp_path / "d", captures, "5m")
    assert state.finished and all(s.count("done") == 0 for s in summaries)


def test_the_front_is_the_one_that_trying_everything_gives(tmp_path, captures, monkeypatch):
    count_pauses(monkeypatch)
    table, lines = tune(chain_of(tmp_path / "d", captures))
    peaks, subjects = 4, 3
    cost = {  # map takes two pauses per step and peak
        (solve, fit): subjects * peaks * (STEPS[solve] + 2 * STEPS[fit])
        for solve, fit in itertools.product(STEPS, STEPS)
    }
    error = {c: error_of({"solve": c[0], "map": c[1]}) for c in cost}
    best = {
        c for c in cost
        if not any(cost[o] <= cost[c] and error[o] < error[c] - 1e-9 for o in cost)
        and not any(cost[o] < cost[c] and error[o] <= error[c] + 1e-9 for o in cost)
    }  # fmt: skip
    found = [(p["settings"]["solve"], p["settings"]["map"]) for p in table["front"]]
    assert set(found) == best
    errors = [p["errors"]["value"]["value"] for p in table["front"]]
    assert errors == sorted(errors, reverse=True)
    for choice, value in zip(found, errors, strict=True):
        assert value == pytest.approx(error[choice], rel=0.12)
    head, *rows = (dial_dir(Dataset(tmp_path / "d")) / "front.csv").read_text().splitlines()
    assert head.startswith("point,seconds,value_mm,value_mm_low,value_mm_high,ingest")
    assert len(rows) == len(found) + 3 and any("reference" in line for line in lines)


def test_a_tight_budget_takes_the_best_that_fits(tmp_path, captures, monkeypatch):
    count_pauses(monkeypatch)
    table, _ = tune(chain_of(tmp_path / "d", captures))
    best = table["front"][-1]
    # On a busy machine the front may have few points, so that the middle one is nearly the best.
    middle = [p for p in table["front"] if p["core_seconds"] < 0.7 * best["core_seconds"]][-1]
    state = spend(tmp_path / "d", captures, 1.2 * middle["core_seconds"])
    assert state.finished
    assert state.promised["value"]["value"] <= middle["errors"]["value"]["value"]
    assert state.promised["value"]["value"] > best["errors"]["value"]["value"]


@pytest.mark.parametrize("expressions", [4, 7])
def test_what_trials_made_costs_the_run_nothing(tmp_path, expressions):
    """With 7 expressions, `solve` of a trial's 3 is another item, and so is `map` after it."""
    chain = chain_of(tmp_path / "d", captures_of(tmp_path / "c", 1, expressions))
    measured = measured_figures(chain, Clock(None))
    load = workload(chain, measured, False, {})
    tried = {4: 4, 7: 3}[expressions]
    whole = [t for t in measured.trials if t.footage.expressions == tried]
    assert len(whole) == 5
    for trial in whole:
        each = point_of(load, trial.settings).each
        assert each["ingest"] == each["align"] == 0
        assert (each["solve"] == each["map"] == 0) == (tried == expressions)
    shutil.rmtree(chain.dataset.pilot_dir)  # as `tune` does
    assert point_of(workload(chain, measured, False, {}), whole[0].settings).seconds > 0


@pytest.mark.parametrize("steps", [("standard", "draft"), ("reference", "draft")])
def test_a_run_takes_what_the_trial_with_its_settings_made(tmp_path, steps):
    """Even if trials of former settings of the same names are there."""
    captures = captures_of(tmp_path / "c", 1, 3)
    former, chain = (chain_of(tmp_path / "d", captures) for _ in range(2))
    former.ladders["solve"] = {k: StepsConfig(steps=n + 1) for k, n in STEPS.items()}
    _, measured = (measured_figures(one, Clock(None)) for one in (former, chain))
    chosen = dict(zip(("ingest", "align", "solve", "map"), ("standard",) * 2 + steps, strict=True))
    keep_for_run(chain.dataset, chosen, measured.trials)
    restored = {}
    for stage in chain.stages:
        config = chain.ladders[stage.name][chosen[stage.name]]
        summary = run_stage(stage, chain.dataset, config, pool=chain.pool, progress=False)
        restored[stage.name] = sum(o.restored for o in summary.outcomes)
    assert restored == {"ingest": 1, "align": 1, "solve": 1, "map": 3}


def test_trials_of_a_core_hour_budget_are_guessed_in_core_hours(tmp_path, captures):
    chain = chain_of(tmp_path / "d", captures)  # three subjects of four expressions
    cost = Cost(seconds=50.0, core_seconds=2.0, bytes=1.0, memory=1.0, items=3)
    footage = Footage(subjects=1, expressions=3, views=2, pixels=2304, frames=16)
    base = Trial(
        settings={}, footage=footage, scripted=4, costs={"solve": cost, "map": cost}, errors={},
        failed={}, folder="",
    )  # fmt: skip
    cores, clock = (Pilot(chain, "S0", Clock(parse_budget(text))) for text in ("1ch", "1h"))
    for pilot, each in ((cores, 2), (clock, 50)):
        guess = guessed(pilot, base, "solve", "standard", 3.0)
        assert trial_seconds(pilot, guess, "solve") == 3 * each * 3 + 3 * each


def test_a_budget_below_the_cheapest_settings_says_what_the_least_is(
    tmp_path, captures, monkeypatch
):
    count_pauses(monkeypatch)  # or a quick machine would need less than this
    words = r"(the cheapest settings need|ended before) .*; (give|the same command again)"
    with pytest.raises(ConfigError, match=words):
        go(tmp_path / "d", captures[:2], "0.2s")
    assert not (tmp_path / "d" / "map").exists()
    with pytest.raises(ConfigError, match="nothing but trials has been made yet"):
        existing_dataset(tmp_path / "d")
    kept = run_file(Dataset(tmp_path / "d"))
    assert not kept.exists()  # measuring does not count again
    _, state = go(tmp_path / "d", captures[:2], "5m")  # with what the pilot made
    assert state.finished and state.stated["value"][0] == pytest.approx(error_of(state.settings))
    before = kept.read_bytes()
    with pytest.raises(ConfigError, match=r"--budget 0\.001s: "):
        go(tmp_path / "d", captures, "0.001s")
    assert kept.read_bytes() == before  # a refused budget costs no earlier run its choices


def test_a_refused_budget_says_how_much_of_it_was_waiting(tmp_path, captures, monkeypatch):
    count_pauses(monkeypatch, working=0.1)
    table, _ = tune(chain_of(tmp_path / "d", captures))
    with pytest.raises(ConfigError, match=r"processor time: .* --budget 0\.\d+ch instead"):
        go(tmp_path / "d", captures, f"{0.5 * table['front'][0]['seconds']:.2f}s")


@pytest.mark.parametrize("budget", ["0.001s", "8s"])  # ends in ingest, and later
def test_a_budget_that_ends_while_measuring_is_called_too_small(
    tmp_path, captures, budget, monkeypatch
):
    count_pauses(monkeypatch)
    with pytest.raises(ConfigError, match=rf"--budget {budget}: .*give "):
        go(tmp_path / "d", captures, budget)


def test_a_goal_is_reached_in_the_least_time_or_refused(tmp_path, captures, monkeypatch):
    count_pauses(monkeypatch)
    _, state = go(tmp_path / "d", captures, goal="0.8mm")
    assert error_of(state.settings) <= 0.8
    assert state.settings["solve"] == "standard" and state.settings["map"] == "standard"
    with pytest.raises(ConfigError, match=r"0\.1mm: the best that any settings give is value 0\.5"):
        go(tmp_path / "d", captures, goal="0.1mm")
    with pytest.raises(ConfigError, match=r"1px: expected one of these units: mm \(value\)"):
        go(tmp_path / "other", captures, goal="1px")
    assert not (tmp_path / "other" / ".staging").exists()  # nothing was measured for it


def test_a_goal_that_untried_settings_may_reach_asks_for_more_time(tmp_path, captures, monkeypatch):
    monkeypatch.setattr("express50.dial.pilot.LIKELY_RATIO", 1e9)
    with pytest.raises(ConfigError, match=r"no time to try .*solve standard and reference.*larger"):
        go(tmp_path / "d", captures, "5m", "0.6mm")


def test_an_error_stated_by_only_the_trial_or_the_result_breaks_no_promise():
    said = {"value": 1.0, "low": 0.5, "high": 2.0, "unit": "mm", "stated": True}
    state = RunState(key="", budget="1h", goal="", finished=True, promised={"track": said},
                     stated={"depth": [1.0, 0.5, 2.0]})  # fmt: skip
    lines = list(closing_lines(state, []))
    assert lines[1:] == [
        "depth: 1 mm (0.5 to 2), nothing promised", "track: no error is stated, 1 mm promised"
    ]  # fmt: skip


@pytest.mark.parametrize("place", ["solve S1", "map S2/e1"])
def test_an_interrupted_run_goes_on_with_its_choices_and_ends_alike(
    tmp_path, captures, monkeypatch, place
):
    tune(chain_of(tmp_path / "d", captures))
    monkeypatch.setenv(STOPS, place)
    with pytest.raises(KeyboardInterrupt):
        go(tmp_path / "d", captures, "5m")
    before = json.loads((dial_dir(Dataset(tmp_path / "d")) / "run.json").read_text())
    said = []
    _, state = go(tmp_path / "d", captures, "5m", said=said)
    assert state.settings == before["settings"] and state.spent > before["spent"] > 0
    assert any("continuing with" in line for line in said) and state.finished
    other = chain_of(tmp_path / "other", captures)
    for stage in other.stages:
        config = other.ladders[stage.name][state.settings[stage.name]]
        run_stage(stage, other.dataset, config, pool=Pool(0), progress=False)
    assert outputs(tmp_path / "d") == outputs(tmp_path / "other")


@pytest.mark.parametrize("step", ["write_json", "shutil.copytree", "run_stage"])
def test_a_trial_that_was_killed_goes_on_with_a_capture_that_was_moved(tmp_path, monkeypatch, step):
    """A folder without its capture passed for begun, and a copy for the trial that it copied."""
    captures, copy = captures_of(tmp_path / "c", 1, 4), shutil.copytree

    def killed(*given, **more):
        patch.setattr("shutil.copytree", copy)  # which calls itself
        if step == "shutil.copytree":
            copy(*given, **more)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(f"express50.dial.pilot.{step}", killed)
        go(tmp_path / "d", captures, "5m")
    (tmp_path / "c").rename(tmp_path / "moved")
    go(tmp_path / "d", [tmp_path / "moved" / "S0"], "5m")
    measured = json.loads((dial_dir(Dataset(tmp_path / "d")) / "measured.json").read_text())
    tried = {(t["settings"]["solve"], t["settings"]["map"]) for t in measured["trials"]}
    assert len(tried) == len(measured["trials"]) == 5
    assert not any(trial["failed"] for trial in measured["trials"])


def test_captures_that_come_after_a_finished_run_get_the_budget_anew(
    tmp_path, captures, monkeypatch
):
    monkeypatch.setattr("express50.dial.run.GRACE", 0.0)
    _, before = go(tmp_path / "d", captures[:2], "5m")
    path = dial_dir(Dataset(tmp_path / "d")) / "run.json"
    write_json(path, json.loads(path.read_text()) | {"spent": 299.99})  # it just fitted
    summaries, state = go(tmp_path / "d", captures, "5m")
    assert state.finished and summaries[0].count("done") == 1
    assert state.settings == before.settings and state.seconds < 100


def test_a_larger_budget_tries_what_a_small_one_had_no_time_for(tmp_path, captures, monkeypatch):
    monkeypatch.setattr("express50.dial.pilot.LIKELY_RATIO", 1e9)
    _, cheap = go(tmp_path / "d", captures, "5m")
    assert cheap.settings["map"] == "draft"
    monkeypatch.undo()
    _, state = go(tmp_path / "d", captures, "6m")
    assert state.settings["map"] == "reference"


def test_a_refusal_after_more_measuring_leaves_an_earlier_run_its_choices(
    tmp_path, captures, monkeypatch
):
    with monkeypatch.context() as patch:
        patch.setattr("express50.dial.pilot.LIKELY_RATIO", 1e9)
        go(tmp_path / "d", captures, "5m")
    before = run_file(Dataset(tmp_path / "d")).read_bytes()
    with pytest.raises(ConfigError, match=r"0\.1mm: the best .* 0\.5"):
        go(tmp_path / "d", captures, "4m", "0.1mm")
    assert run_file(Dataset(tmp_path / "d")).read_bytes() == before


def test_a_slower_machine_than_measured_gets_cheaper_settings(tmp_path, captures, monkeypatch):
    count_pauses(monkeypatch)
    tune(chain_of(tmp_path / "d", captures))
    monkeypatch.setenv(PAUSE, "5")
    said = []
    state = spend(tmp_path / "d", captures, 800, said)
    assert state.settings["map"] != "reference" and any("behind time" in line for line in said)
    assert state.changes


def test_time_that_runs_out_leaves_items_for_a_larger_budget(tmp_path, captures, monkeypatch):
    def one_setting(budget):
        chain = chain_of(tmp_path / "d", captures)
        chain.ladders |= {name: {"standard": StepsConfig()} for name in ("solve", "map")}
        return run_within(chain, parse_budget(budget), None, lambda stage, summary: None)

    count_pauses(monkeypatch)
    one_setting("1ch")
    shutil.rmtree(tmp_path / "d" / "map")
    shutil.rmtree(tmp_path / "d" / "solve")
    monkeypatch.setenv(PAUSE, "5")
    summaries, state = one_setting("0.07ch")  # 252 s: 144 at the measured speed, 720 now
    assert not state.finished and state.spent < 252 * 1.4
    assert any("left" in line for line in closing_lines(state, summaries))
    made = len(list((tmp_path / "d" / "map").glob("*/*")))
    monkeypatch.setenv(PAUSE, "0.1")
    summaries, state = one_setting("0.08ch")
    assert state.finished and summaries[-1].count("skipped") == made < 12


def test_a_run_that_is_a_little_short_of_time_continues():
    assert reserved(own=5, rest=20, left=30, budget=40) == 20
    assert reserved(own=5, rest=20, left=22, budget=40) == 16  # late by 3 of 40, or by 4
    assert reserved(own=5, rest=20, left=20, budget=40) == 16  # by 5: each gets four fifths


def test_a_late_run_whose_items_are_slower_still_makes_everything(tmp_path, captures, monkeypatch):
    """Predicted to be 2 s late, a run stopped as soon as an item took longer than predicted."""
    count_pauses(monkeypatch)
    monkeypatch.setattr("express50.dial.pilot.LIKELY_RATIO", 1e9)
    measured_figures(chain_of(tmp_path / "d", captures), Clock(parse_budget("1ch")))
    path = run_file(Dataset(tmp_path / "d"))
    budget = "0.0666667ch"
    run_within(chain_of(tmp_path / "d", captures), parse_budget(budget), None, lambda *_: None)
    for stage in ("solve", "map"):  # 36 s
        shutil.rmtree(tmp_path / "d" / stage)
    left = json.loads(path.read_text()) | {"spent": 240.0 - 34.0, "finished": False}
    write_json(path, left)
    monkeypatch.setenv(PAUSE, "1.5")
    _, state = go(tmp_path / "d", captures, budget)
    assert state.finished and 240 < state.spent < 1.1 * 240


def test_a_run_that_falls_behind_spends_its_time_and_keeps_what_trials_made(
    tmp_path, captures, monkeypatch
):
    """S0 is whole after the trial; S1 would take 48 of the 30 s. Nothing of either was made."""
    count_pauses(monkeypatch)
    monkeypatch.setattr("express50.dial.pilot.LIKELY_RATIO", 1e9)
    measured_figures(chain_of(tmp_path / "d", captures[:2]), Clock(parse_budget("0.0083ch")))
    monkeypatch.setenv(PAUSE, "4")
    monkeypatch.setattr("express50.dial.run._Run.slowness", lambda run: 4.0)
    summaries, state = go(tmp_path / "d", captures[:2], "0.0083ch")
    counts = {s.stage: [s.count(w) for w in ("done", "failed", "left")] for s in summaries}
    assert counts["solve"] == [2, 0, 0] and counts["map"] == [5, 0, 3]
    assert {o.item for o in summaries[-1].outcomes if o.restored} == {f"S0/e{n}" for n in range(4)}
    assert 0.8 * 29.9 < state.spent <= 29.9
    assert state.rest == pytest.approx(3 * 2 * 4)  # at the speed that was seen


def test_a_reference_that_the_trial_lacks_does_not_stop_it(tmp_path, captures):
    said, root = [], tmp_path / "d"
    chain = chain_of(root, captures, said)
    write_json(root / "labels" / "reference.json", {"subject": "S1"})

    def inputs(dataset, item, config):
        return {"index": dataset.index_file(item), "reference": reference_subject(dataset)}

    chain.stages = [replace(s, inputs=inputs) if s.name == "align" else s for s in chain.stages]
    _, state = run_within(chain, parse_budget("5m"), None, lambda stage, summary: None)
    assert state.finished and not any("cannot be measured" in line for line in said)


def test_a_disk_without_hard_links_will_do(tmp_path, captures, monkeypatch):
    def refuse(source, target):
        raise PermissionError(1, "Operation not permitted")  # as exFAT and some network drives

    monkeypatch.setattr("os.link", refuse)
    _, state = go(tmp_path / "d", captures, "5m")
    assert state.finished


def test_one_item_is_enough(tmp_path):
    captures = captures_of(tmp_path / "captures", subjects=1, expressions=1)
    said = []
    _, state = go(tmp_path / "d", captures, "5m", said=said)
    assert state.finished and state.settings["map"] == "reference"
    assert any(re.match("solve +reference +made already +standard: ", line) for line in said)


def test_a_setting_that_fails_in_the_pilot_is_not_chosen(tmp_path, captures, monkeypatch):
    monkeypatch.setenv(FAILS, "map 1")  # the cheapest, which the first trial runs
    _, state = go(tmp_path / "d", captures, "5m")
    assert state.finished and state.settings["map"] == "reference"
    monkeypatch.setenv(FAILS, "solve 16")
    _, state = go(tmp_path / "e", captures, "5m")
    assert state.finished and state.settings["solve"] == "standard"


def test_a_stage_that_fails_at_every_setting_is_named_and_nothing_else_is_tried(
    tmp_path, captures, monkeypatch
):
    monkeypatch.setenv(FAILS, "solve")
    said = []
    with pytest.raises(StageError, match=r"no subject could be measured: solve: .* lead nowhere"):
        go(tmp_path / "d", captures, "5m", said=said)
    assert sum("cannot be measured" in line for line in said) == 2  # the last one is the error
    assert not any(line.startswith("measuring map") for line in said)


def test_a_reason_names_no_subject_and_keeps_the_words_that_hold_its_id(tmp_path, monkeypatch):
    """Of a person called `s`, it said `16 the subjecttepthe subject`."""
    make_capture(tmp_path / "s", subject="s", cameras=2, frames=4, size=48, expressions=("e0",))
    monkeypatch.setenv(FAILS, "solve")
    with pytest.raises(StageError, match="solve: .*the subject: 16 steps lead nowhere"):
        go(tmp_path / "d", [tmp_path / "s"], "5m")


def test_a_subject_that_cannot_be_ingested_is_not_measured_but_the_next_is(tmp_path):
    captures, said = captures_of(tmp_path / "c", 2, 1), []
    chain = chain_of(tmp_path / "d", captures, said)
    for video in (captures[0] / "cameras").rglob("*.*"):
        video.write_bytes(b"damaged")
    summaries, state = run_within(chain, parse_budget("5m"), None, lambda stage, summary: None)
    assert any(re.match("S0 cannot be measured, .*: ingest: ", line) for line in said)
    assert state.finished and summaries[0].count("failed") == 1 and summaries[-1].ok


def test_excluded_subjects_are_not_called_missing_captures(tmp_path):
    chain = chain_of(tmp_path / "d", captures_of(tmp_path / "c", 1, 1))
    labels = chain.dataset.labels_file("S0")
    labels.parent.mkdir()
    labels.write_text('{"action": "exclude", "reason": "blinks"}\n')
    with pytest.raises(StageError, match="every subject is excluded; .*include .* S0"):
        measured_figures(chain, Clock(None))


def test_core_hours_count_processor_time_alone(tmp_path, captures):
    _, state = go(tmp_path / "d", captures, "0.02ch")
    assert state.finished and state.settings["map"] == "reference"
    assert 0 < state.spent < 30  # the toys sleep


def spend(root, captures, seconds, said=None):
    """Run the toys within a budget of core seconds."""
    return go(root, captures, f"{seconds / 3600:.7f}ch", said=said)[1]


@pytest.fixture(scope="module")
def one_capture(tmp_path_factory):
    return captures_of(tmp_path_factory.mktemp("one"), subjects=1)


def test_a_small_budget_is_spent_on_better_settings(tmp_path, one_capture, monkeypatch):
    """One subject, four expressions: `draft` takes 12 s; before, 60 s were half used for it."""
    count_pauses(monkeypatch)
    spent = {budget: spend(tmp_path / str(budget), one_capture, budget) for budget in (13, 48, 144)}
    assert all(state.finished and state.spent <= budget for budget, state in spent.items())
    chosen = {b: (s.settings["solve"], s.settings["map"]) for b, s in spent.items()}
    assert chosen[13] == ("draft", "draft")
    assert chosen[48] == ("draft", "standard") and spent[48].spent == 12 + 32
    assert chosen[144] == ("standard", "standard")


def test_no_budget_that_holds_the_cheapest_settings_is_overrun(tmp_path, one_capture, monkeypatch):
    """A step up takes these toys four times as long, which is more than is assumed."""
    count_pauses(monkeypatch)
    for budget in (16, 36, 90):
        state = spend(tmp_path / str(budget), one_capture, budget)
        assert state.finished and state.spent <= budget


def test_a_larger_budget_measures_only_what_it_adds(tmp_path, one_capture, monkeypatch):
    count_pauses(monkeypatch)
    said = []
    first = spend(tmp_path / "d", one_capture, 13)
    state = spend(tmp_path / "d", one_capture, 48, said)
    assert first.settings["map"] == "draft" and state.settings["map"] == "standard"
    assert state.spent == 32 and not any("cheapest setting" in line for line in said)
    state = spend(tmp_path / "d", one_capture, 1500)
    assert state.settings["map"] == "reference"
    assert not Dataset(tmp_path / "d").pilot_dir.exists()  # everything was tried


def test_a_goal_that_the_cheapest_settings_reach_is_not_measured_further(
    tmp_path, one_capture, monkeypatch
):
    count_pauses(monkeypatch)
    said = []
    _, state = go(tmp_path / "d", one_capture, goal="3mm", said=said)
    assert state.spent < 12 and sum(line.startswith("measuring") for line in said) == 1
    assert state.settings["solve"] == state.settings["map"] == "draft"


def test_clock_figures_of_a_busy_machine_do_not_refuse_a_later_budget(tmp_path, captures):
    chain, said = chain_of(tmp_path / "d", captures), []
    tune(chain)
    path = dial_dir(chain.dataset) / "measured.json"
    table = json.loads(path.read_text())
    for trial in table["trials"]:
        for cost in trial["costs"].values():
            cost["seconds"] *= 1e5  # on the quickest machine more than the budget
    write_json(path, table)
    _, state = go(tmp_path / "d", captures, "5m", said=said)
    assert state.finished and any("measuring again" in line for line in said)
    assert state.settings["map"] == "reference"


def test_what_later_stages_cannot_begin_is_left_and_not_failed(tmp_path, captures, monkeypatch):
    """The time ends in `solve`, whose first subject takes longer than all was predicted to."""
    monkeypatch.setattr("express50.dial.run.GRACE", 0.0)
    count_pauses(monkeypatch)
    budget = 90
    monkeypatch.setattr("express50.dial.pilot.LIKELY_RATIO", 1e9)
    chain = chain_of(tmp_path / "d", captures)
    measured_figures(chain, Clock(parse_budget(f"{budget / 3600:.7f}ch")))
    monkeypatch.setenv(PAUSE, "20")
    summaries, state = go(tmp_path / "d", captures, f"{budget / 3600:.7f}ch")
    counts = {s.stage: [s.count(w) for w in ("done", "failed", "left")] for s in summaries}
    assert counts["solve"] == [2, 0, 1] and counts["map"] == [5, 0, 7]
    last = list(closing_lines(state, summaries))[-2:]
    assert "left for the rest: 1 of solve, 7 of map" in last[0] and "--budget 0.0" in last[1]
    monkeypatch.setenv(PAUSE, "1")
    summaries, state = go(tmp_path / "d", captures, last[1].split("--budget ")[1].split()[0])
    assert state.finished and all(summary.ok for summary in summaries)
