"""The error that remains at the most expensive settings, and how differences are measured."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.budget import Run, figures, quick_budgets, run_one
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, NoSettings, Stage
from express50.dial.choice import (
    Workload,
    choice_lines,
    front,
    point_of,
    remaining_square,
    size_factor,
    taken_over,
)
from express50.dial.figures import Cost, Footage, PilotFigures, Trial
from express50.dial.results import RESULTS
from express50.head.load import load_head
from express50.head.model import vertex_normals

LOST = np.array([0.5, 0.4, 0.1])  # squares: all cheap, then one stage dear, then another


def test_what_stated_errors_confirm_is_taken_off():
    assert remaining_square(0.25 + LOST, LOST) == pytest.approx(0.25)
    assert remaining_square(0.25 + 0.5 * LOST, LOST) == pytest.approx(0.25)


def test_differences_that_no_stated_error_confirms_promise_nothing():
    same = np.full(3, 0.44)  # as of the mesh of the twin: a quarter was promised
    assert remaining_square(same, LOST) == pytest.approx(0.44)
    assert remaining_square(np.array([0.3, 0.35, 0.5]), LOST) == pytest.approx(0.35)  # they rise


def test_a_remainder_is_not_below_zero():
    assert remaining_square(np.array([0.4, 0.3, 0.0]), LOST) >= 0
    assert remaining_square(np.array([0.3]), np.array([0.5])) == pytest.approx(0.3)


def test_registrations_differ_along_their_normals_alone(tmp_path, monkeypatch):
    head = load_head("procedural")
    mesh = head.template.double()
    normals = vertex_normals(mesh[None], head.faces)[0].numpy()
    tangent = np.cross(normals, np.roll(normals, 1, axis=1))
    mesh = mesh.numpy()
    rng = np.random.default_rng(0)
    out, along = 2e-4 * rng.normal(size=len(mesh)), 2e-3 * rng.normal(size=len(mesh))
    moved = mesh + out[:, None] * normals + along[:, None] * tangent
    kind = next(kind for kind in RESULTS if kind.name == "mesh")
    found = apart_of(kind, tmp_path, monkeypatch, moved, mesh)
    assert found == pytest.approx(1e3 * np.median(np.abs(out)), rel=0.05)


def apart_of(kind, root, monkeypatch, one, two):
    """Compare two meshes as registrations of one expression."""
    where = {"a": one, "b": two}
    for name in where:
        path = Dataset(root / name).registration_file("S0", "e0")
        path.parent.mkdir(parents=True)
        path.touch()

    class Stored:
        head = "procedural"

        def __init__(self, path):
            self.vertices = where[Path(path).relative_to(root).parts[0]]

    for reader in ("read_registration", "read_track"):
        monkeypatch.setattr(f"express50.dial.results.{reader}", Stored)
    (found,) = kind.apart(Dataset(root / "a"), Dataset(root / "b"), "S0", ["e0"])
    return found


def test_the_resting_face_has_no_peak_to_differ_in(tmp_path):
    a, b = Dataset(tmp_path / "a"), Dataset(tmp_path / "b")
    for dataset, frames in ((a, {"neutral": 2, "smile": 9}), (b, {"neutral": 5, "smile": 10})):
        rows = {name: {"frame": frame} for name, frame in frames.items()}
        dataset.peaks_file("S0").parent.mkdir(parents=True)
        dataset.peaks_file("S0").write_text(json.dumps(rows))
    (kind,) = [kind for kind in RESULTS if kind.name == "peaks"]
    assert kind.apart(a, b, "S0", ["neutral", "smile"]) == [1.0]


def run(name, seconds, budget=None, finished=True, error=1.0):
    promise = {"value": 1.0, "low": 0.5, "high": 1.5, "unit": "mm", "stated": True}
    promised = {"depth": promise} if budget else {}
    errors = {"depth": error} if finished else {}
    settings = {"depth": "draft"} if promised else {}
    return Run(name, seconds, budget, seconds, settings, promised, errors, finished)


def test_a_budget_that_stops_early_is_a_miss_and_keeps_no_promise():
    presets = [run("draft", 30.0), run("standard", 60.0, error=0.9)]
    kept = figures([run("b", 50.0, 55.0)], presets, True)
    assert (kept["time_miss_percent"], kept["promise_kept_percent"]) == (0, 100)
    early = run("c", 20.0, 50.0, finished=False)
    found = figures([early], presets, True)
    assert found["unfinished"] == ["c"] and found["regret_percent"] is None
    assert (found["time_miss_percent"], found["promise_kept_percent"]) == (100, 0)
    both = figures([run("b", 50.0, 55.0), early], presets, True)
    assert both["promise_kept_percent"] == 50 and both["regret_percent"] == 0


def test_a_refused_budget_is_a_miss_only_where_a_preset_would_have_fitted():
    presets = [run("draft", 30.0), run("standard", 60.0)]
    small, fair = (Run("d", 5.0, budget, None, {}, {}, {}, False) for budget in (20.0, 40.0))
    assert figures([small], presets, True)["time_miss_percent"] == 0
    assert figures([fair], presets, True)["time_miss_percent"] == 100


def test_a_run_that_was_refused_before_it_made_anything_is_still_a_row(tmp_path):
    done = tmp_path / "budget-1m" / "done.json"
    done.parent.mkdir()
    done.write_text('{"code": 2, "seconds": 3.0}')
    by_clock, core = (
        run_one(tmp_path, "budget-1m", [], n, ["--budget", "1m"], False) for n in (2, 0)
    )
    assert (by_clock.seconds, by_clock.budget, by_clock.finished) == (3.0, 60.0, False)
    assert core.seconds == 0


def test_a_result_that_is_right_in_most_runs_does_not_outweigh_all_others():
    presets = [run("draft", 30.0), run("standard", 60.0, error=0.9)]
    for one, peaks in zip(presets, (0.5, 0.0), strict=True):
        one.errors["peaks"] = peaks
    budget = run("b", 61.0, 65.0, error=0.9)
    budget.errors["peaks"] = 0.0
    late = run("c", 61.0, 65.0, error=1.0)
    late.errors["peaks"] = 0.5
    assert figures([budget], presets, True)["regret_percent"] == 0
    assert 0 < figures([late], presets, True)["regret_percent"] < 1000


def test_the_quick_form_asks_for_what_should_be_as_good_as_the_best_preset():
    rows = ((36.0, 5.0), (45.0, 4.2), (55.0, 4.05), (60.0, 4.0))
    points = [{"core_seconds": seconds, "worse": worse} for seconds, worse in rows]
    table = {"front": points, "presets": {"draft": points[0], "standard": points[-1]}}
    assert quick_budgets(table) == ["0.0115ch", "0.0176ch", "0.0192ch"]
    assert len(quick_budgets(table | {"front": points[-1:]})) == 1


def reducing_chain(cut_draft):
    """A chain that may cut pictures in ``cut_draft`` seconds; whole ones take 3 s there."""
    stages = [
        Stage(name=name, version=1, config=NoSettings, items=None, inputs=None, run=None,
              growth=Growth(reduces="side" if name == "cut" else ""))
        for name in ("read", "cut", "map")
    ]  # fmt: skip

    def trial(cut, seconds):
        costs = {
            name: Cost(seconds=s, core_seconds=s, bytes=1, memory=1, items=1)
            for name, s in zip(("read", "cut", "map"), seconds, strict=True)
        }
        footage = Footage(subjects=1, expressions=1, views=1, pixels=1, frames=1)
        return Trial(
            settings={"read": "standard", "cut": cut, "map": "standard"}, footage=footage,
            scripted=1, costs=costs, errors={}, failed={}, folder="",
        )  # fmt: skip

    whole = SimpleNamespace(side=0)
    trials = [trial("draft", (5.0, cut_draft, 2.0)), trial("standard", (5.0, 3.0, 14.0))]
    losses = {"cut": {"draft": {"mesh": 1.0}, "standard": {}}}
    return Workload(
        stages=stages,
        ladders={s.name: dict.fromkeys(("draft", "standard"), whole) for s in stages},
        measured=PilotFigures(key="", trials=trials, losses=losses),
        footage=trials[0].footage, width=1, cores=True,
    )  # fmt: skip


def test_stages_after_smaller_pictures_cost_what_trials_measured():
    load = reducing_chain(1.0)
    factors = [
        [size_factor(load, stage, {"cut": label}) for stage in load.stages]
        for label in ("draft", "standard")
    ]
    assert factors == [[1.0, 1.0, 1.0], [1.0, 1.0, 7.0]]


def test_smaller_pictures_that_take_longer_to_make_stay_a_choice_for_what_they_save_later():
    points = front(reducing_chain(4.0))
    found = [(point.settings["cut"], point.seconds) for point in points]
    assert found == [("draft", 5 + 4 + 2), ("standard", 5 + 3 + 14)]


def test_an_item_of_all_subjects_is_not_taken_from_a_trial_of_one():
    load = reducing_chain(1.0)
    last = replace(load.stages[-1], growth=Growth(items=(), time=("subjects",)))  # as of `pack`
    load = replace(load, stages=[*load.stages[:-1], last])
    trial, two = load.measured.trials[0], replace(load.footage, subjects=2.0)
    assert [*taken_over(load, trial)] == ["read", "cut", "map"]
    assert [*taken_over(replace(load, footage=two), trial)] == ["read", "cut"]


def test_no_setting_saves_time_over_one_that_is_made_already():
    made = dict.fromkeys(("read", "cut", "map"), ("standard", 1.0))
    load = replace(reducing_chain(1.0), done=[made])
    point = point_of(load, dict.fromkeys(made, "standard"))
    (row,) = (line for line in choice_lines(load, point, "", 0.0) if line.startswith("cut "))
    assert "made already" in row and "draft: 1.0 s more" in row  # it said 2.0 s less
