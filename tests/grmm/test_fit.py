import json
import math
import os
import re
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.errors import ConfigError, TrainError
from grmm import fit as fit_module
from grmm.checkpoint import load_checkpoint
from grmm.config import MetricsConfig
from grmm.data import HeadViews
from grmm.edit import trained_head
from grmm.fit import (
    NOVEL_VIEW,
    FitProtocol,
    evaluate_unseen,
    fit,
    invert_codes,
    locality_loss,
    reconstruction,
    tune_decoders,
)
from grmm.fit_state import save_fit, start
from grmm.metrics import PerceptualMetrics
from grmm.render import expression_grid, frontal, interpolation, turntable
from grmm.train import train
from grmm.warm_start import spread_change
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A checkpoint trained on S000 and S001."""
    out = tmp_path_factory.mktemp("run")
    train(EllipsoidSource(size=32), ellipsoid_head(), out, tiny_config(train={"iterations": 8}))
    return out / "checkpoint.pt"


@pytest.fixture
def loaded(trained):
    return load_checkpoint(trained)


@pytest.fixture
def views():
    """Three subjects; S002 is the unseen one."""
    return HeadViews(EllipsoidSource(subjects=3, size=32), ellipsoid_head())


def unseen(views, camera="cam00"):
    return [i for i, k in enumerate(views.keys) if (k.subject, k.camera) == ("S002", camera)]


def test_stage_one_changes_codes_only(loaded, views):
    state = start(loaded, views, unseen(views))
    before = {k: v.clone() for k, v in state.model.state_dict().items()}
    z_id = state.z_id.clone()
    assert torch.equal(z_id, loaded.model.z_id.mean(0))
    invert_codes(state)
    assert state.done.iterations == {1: 3, 2: 0}
    assert all(torch.equal(v, before[k]) for k, v in state.model.state_dict().items())
    assert not torch.equal(state.z_id, z_id)
    assert set(state.z_exp) == {"e0", "e1"}


def test_stage_two_changes_decoders_only(loaded, views):
    state = start(loaded, views, unseen(views))
    before = {k: v.clone() for k, v in state.model.state_dict().items()}
    z_id = state.z_id.clone()
    tune_decoders(state)
    assert state.done.iterations == {1: 0, 2: 3}
    changed = {k for k, v in state.model.state_dict().items() if not torch.equal(v, before[k])}
    assert {name.split(".")[0] for name in changed} == {"mesh", "transform", "opacity", "colour"}
    assert torch.equal(state.z_id, z_id)
    assert all(torch.equal(v, before[k]) for k, v in loaded.model.state_dict().items())


@pytest.mark.parametrize(("weight", "moves"), [(0.0, True), (100.0, False)])
def test_stage_two_keeps_the_mesh_where_training_does(loaded, views, weight, moves):
    objective = replace(loaded.config.loss, displacement=weight)
    settings = replace(loaded.config.fit, stage2_iterations=30, stage2_lr=1e-2)
    loaded = replace(loaded, config=replace(loaded.config, loss=objective, fit=settings))
    state = start(loaded, views, unseen(views))
    tune_decoders(state)
    item = views.item(state.given[0])
    z_exp = state.z_exp[item.key.expression]
    moved = state.model.geometry(state.z_id, z_exp, item.state).displacement
    assert (float(moved.norm(dim=1).max()) > 5e-4) == moves


def test_locality_loss_is_zero_until_the_model_is_tuned(loaded, views):
    state = start(loaded, views, unseen(views))
    item = views.item(state.given[0])
    assert float(locality_loss(state, item).detach()) < 1e-6
    with torch.no_grad():
        state.model.colour.bias += 1
    assert float(locality_loss(state, item).detach()) > 1e-3


def test_reconstruction_has_the_perceptual_term_where_weights_are_given(loaded, views):
    state = start(loaded, views, unseen(views))
    target = views.item(state.given[0]).target
    plain = reconstruction(state, (0.5 * target, target))
    state.perceptual = lambda image, other: (image - other).abs().sum()
    expected = plain + 0.04 * (0.5 * target).sum()
    torch.testing.assert_close(reconstruction(state, (0.5 * target, target)), expected)


def test_fit_improves_on_the_mean_code_and_reports_both_views(loaded, views, tmp_path, capsys):
    settings = replace(loaded.config.fit, stage1_iterations=10, stage2_iterations=25)
    loaded = replace(loaded, config=replace(loaded.config, fit=settings))
    given = unseen(views, "cam00") + unseen(views, "cam01")
    metrics = fit(loaded, views, given, unseen(views, "cam02"), tmp_path)
    said = capsys.readouterr().err
    assert re.findall("fit, (.*): PSNR given", said) == [
        "mean code",
        "after stage 1",
        "after stage 2",
    ]
    stages = metrics["stages"]
    assert stages["stage2"]["psnr_given_db"] > stages["mean_code"]["psnr_given_db"] + 1
    assert metrics["psnr_db"] == stages["stage2"]["psnr_held_out_db"]
    assert metrics["held_out_cameras"] == ["cam02"]
    assert json.loads((tmp_path / "metrics.json").read_text())["subject"] == "S002"
    assert (tmp_path / "given.jpg").exists() and (tmp_path / "held_out.jpg").exists()
    again = load_checkpoint(tmp_path / "checkpoint.pt")
    assert again.model.subjects == ("S002",)
    item = views.item(given[0])
    with torch.no_grad():
        picture = again.model(0, 0, item.state, item.view).image
    squared = (picture.clamp(0, 1) - item.target).square().mean()
    assert float(-10 * torch.log10(squared)) == pytest.approx(
        stages["stage2"]["psnr_given_db"], abs=2.0
    )


def test_a_fitted_person_takes_on_expressions_of_training(loaded, views, tmp_path):
    fit(loaded, views, unseen(views)[:1], [], tmp_path)
    again = load_checkpoint(tmp_path / "checkpoint.pt")
    assert again.model.subjects == ("S002",) and set(again.model.expressions) == {"e0", "e1"}
    moved = trained_head(again, "S002", "e1")
    assert moved.tracked.expression[0] == 1
    torch.testing.assert_close(moved.z_exp, loaded.model.z_exp[1].detach())
    torch.testing.assert_close(moved.z_id, again.model.z_id[0].detach())
    tuned = fit(again, views, unseen(views)[:1], [], tmp_path / "again")  # and can be fitted again
    assert tuned["subject"] == "S002"


def test_a_person_of_the_training_keeps_the_fitted_head(loaded, tmp_path):
    """Other expressions of the training came without offsets, and took them from all frames."""

    class WithOffsets(EllipsoidSource):
        def place(self, index):
            place = super().place(index)
            return replace(place, tracked=replace(place.tracked, offsets=offsets))

    offsets = np.full((len(ellipsoid_head().template), 3), 1e-3, np.float32)
    views = HeadViews(WithOffsets(size=32), ellipsoid_head())
    save_fit(start(loaded, views, [0]), tmp_path / "checkpoint.pt")
    again = load_checkpoint(tmp_path / "checkpoint.pt")
    assert views.keys[0].frame == ("S000", "e0") and set(again.model.expressions) == {"e0", "e1"}
    for expression in again.model.expressions:
        shown = trained_head(again, "S000", expression).tracked.offsets
        np.testing.assert_array_equal(shown, offsets)


def test_a_fit_shows_its_progress(loaded, views, monkeypatch, capsys):
    monkeypatch.setattr("grmm.fit.SAY_SECONDS", 0.0)
    invert_codes(start(loaded, views, [0, 1]))
    said = capsys.readouterr().err
    assert "fit: stage 1, iteration 1, " in said and " of this stage left" in said


def test_fit_stops_at_its_time_budget(loaded, views, tmp_path):
    settings = replace(
        loaded.config.fit, stage1_iterations=10_000, stage2_iterations=10_000, seconds=0.4
    )
    loaded = replace(loaded, config=replace(loaded.config, fit=settings))
    metrics = fit(loaded, views, unseen(views)[:1], [], tmp_path)
    assert 1 <= metrics["stage1_iterations"] < 10_000
    assert 1 <= metrics["stage2_iterations"] < 10_000
    assert metrics["psnr_is_of"].startswith("given views")


def test_a_short_budget_decays_by_time(loaded, views):
    state = start(loaded, views, unseen(views))
    shares = [share for _, share, _ in fit_module._items(state, 1, 10**6, 0.3)]
    assert shares[0] < 0.3 and 0.7 < shares[-1] <= 1 and shares == sorted(shares)
    state = start(loaded, views, unseen(views))
    shares = [share for _, share, _ in fit_module._items(state, 1, 4, math.inf)]
    assert shares == [0, 0.25, 0.5, 0.75]


def interrupt_at(monkeypatch, stage, iteration, number=signal.SIGINT):
    """Send a signal while a fit takes this step; returns how to end that."""
    return at_step(monkeypatch, stage, iteration, lambda: os.kill(os.getpid(), number))


def at_step(monkeypatch, stage, iteration, act):
    """Do something while a fit takes this step; returns how to end that."""
    real = fit_module._finite

    def finite(loss, now, of):
        if (of, now) == (stage, iteration):
            act()
        return real(loss, now, of)

    monkeypatch.setattr(fit_module, "_finite", finite)
    return lambda: monkeypatch.setattr(fit_module, "_finite", real)


@pytest.mark.parametrize(
    ("stage", "iteration", "number"),
    [(1, 1, signal.SIGINT), (1, 2, signal.SIGHUP), (2, 0, signal.SIGINT), (2, 1, signal.SIGTERM)],
)
def test_an_interrupted_fit_resumes_to_the_same_bytes(
    loaded, views, tmp_path, monkeypatch, stage, iteration, number
):
    tables = replace(loaded.config.fit, texture_warm_start=True, shuffle_directions=0.5)
    loaded = replace(loaded, config=replace(loaded.config, fit=tables))
    given, held_out = unseen(views, "cam00"), unseen(views, "cam01")
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    expected = fit(loaded, views, given, held_out, straight)
    stop = interrupt_at(monkeypatch, stage, iteration, number)
    with pytest.raises(KeyboardInterrupt):
        fit(loaded, views, given, held_out, broken)
    stop()
    assert [path.name for path in broken.iterdir()] == ["checkpoint.pt"]
    assert load_checkpoint(broken / "checkpoint.pt").model.subjects == ("S002",)
    metrics = fit(loaded, views, given, held_out, broken, continued=True)
    assert metrics | {"seconds": 0} == expected | {"seconds": 0}
    made, wanted = ((folder / "checkpoint.pt").read_bytes() for folder in (broken, straight))
    assert made == wanted


def test_a_stopped_measurement_continues_its_fits(loaded, views, tmp_path, monkeypatch):
    protocol, judge = (
        FitProtocol(cameras=("cam00",), expression="e0"),
        PerceptualMetrics(MetricsConfig()),
    )

    def measured(folder=None, loaded=loaded):
        return evaluate_unseen(loaded, views, "S002", protocol, judge, folder=folder)

    expected, _ = measured()
    stop = interrupt_at(monkeypatch, 2, 1)
    with pytest.raises(KeyboardInterrupt):
        measured(tmp_path)
    stop()
    [path] = tmp_path.glob("*/checkpoint.pt")
    unfinished = path.stat().st_size
    assert repr(measured(tmp_path)[0]) == repr(expected)
    assert path.stat().st_size < 0.6 * unfinished, "the optimiser's state is left out"
    steps = []
    at_step(monkeypatch, 1, 0, lambda: steps.append(1))
    rows, effort = measured(tmp_path)  # finished: no step is taken again
    assert repr(rows) == repr(expected) and effort["iterations"] > 0 and not steps
    longer = replace(loaded.config.fit, stage1_iterations=5)
    measured(tmp_path, replace(loaded, config=replace(loaded.config, fit=longer)))
    assert steps == [1] and len(list(tmp_path.glob("*/checkpoint.pt"))) == 2


def test_a_fit_stopped_while_it_is_measured_is_measured_later(loaded, views, tmp_path, monkeypatch):
    def stop(*arguments):
        raise KeyboardInterrupt

    given = unseen(views)
    expected = fit(loaded, views, given, [], tmp_path / "straight")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(fit_module, "comparison_sheet", stop)
        fit(loaded, views, given, [], tmp_path)
    monkeypatch.setattr(fit_module, "_finite", stop)  # no step is taken again
    metrics = fit(loaded, views, given, [], tmp_path, continued=True)
    assert metrics | {"seconds": 0} == expected | {"seconds": 0}


def test_a_fit_saves_at_intervals(loaded, views, tmp_path, monkeypatch):
    tables = replace(loaded.config.train, save_seconds=1e-9)
    loaded = replace(loaded, config=replace(loaded.config, train=tables))
    monkeypatch.setattr("grmm.train_state.SAVING_SHARE", 1e9)

    def fail():
        raise MemoryError

    at_step(monkeypatch, 1, 2, fail)
    with pytest.raises(MemoryError):
        fit(loaded, views, unseen(views), [], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
    state = load_checkpoint(tmp_path / "checkpoint.pt").loop["fit"]["progress"]
    assert state["stage"] == 1 and state["iterations"] == {1: 2, 2: 0}


def test_a_fit_of_something_else_is_not_continued(loaded, views, tmp_path, monkeypatch):
    stop = interrupt_at(monkeypatch, 1, 1)
    with pytest.raises(KeyboardInterrupt):
        fit(loaded, views, unseen(views), [], tmp_path)
    stop()
    before = (tmp_path / "checkpoint.pt").read_bytes()

    def refused(words, loaded=loaded, views=views, given=None):
        with pytest.raises(ConfigError, match=words) as error:
            fit(loaded, views, given or unseen(views), [], tmp_path, continued=True)
        assert "start over with --overwrite" in str(error.value)
        assert (tmp_path / "checkpoint.pt").read_bytes() == before

    faster = replace(loaded.config.fit, stage2_lr=0.5, seconds=60.0)  # the budget may change
    changed = replace(loaded, config=replace(loaded.config, fit=faster))
    refused("these differ: fit.stage2_lr 0.0001 -> 0.5. ", loaded=changed)
    refused("the views to fit to", given=unseen(views, "cam01"))
    source = EllipsoidSource(subjects=3, size=32)
    source.digest = "others"
    refused("the samples of the shards", views=HeadViews(source, ellipsoid_head()))
    with torch.no_grad():
        loaded.model.colour.bias += 1
    refused("the checkpoint to fit from")


def test_training_does_not_continue_an_unfinished_fit(loaded, views, tmp_path, monkeypatch):
    interrupt_at(monkeypatch, 1, 1)
    with pytest.raises(KeyboardInterrupt):
        fit(loaded, views, unseen(views), [], tmp_path)
    with pytest.raises(ConfigError, match="or it is a fit"):
        train(EllipsoidSource(size=32), ellipsoid_head(), tmp_path, loaded.config, resume=True)


def test_a_fit_to_all_views_leaves_no_picture_of_held_out_ones(loaded, views, tmp_path):
    (tmp_path / "held_out.jpg").write_bytes(b"of an earlier fit")
    fit(loaded, views, unseen(views), [], tmp_path)
    assert not (tmp_path / "held_out.jpg").exists()


def test_views_of_two_subjects_are_refused(loaded, views, tmp_path):
    with pytest.raises(ConfigError, match="2 subjects"):
        fit(loaded, views, [0, len(views.keys) - 1], [], tmp_path)


def test_views_with_empty_mattes_are_refused(loaded, views, tmp_path, monkeypatch):
    read = views.source.read
    monkeypatch.setattr(
        views.source, "read", lambda i: replace(read(i), alpha=np.zeros_like(read(i).alpha))
    )
    with pytest.raises(TrainError, match="2 of 2 views show no head, by .* .S002/e0/cam00, "):
        fit(loaded, views, unseen(views), [], tmp_path)


def test_turntable_grid_and_interpolation(loaded):
    start, end = (trained_head(loaded, *frame) for frame in (("S000", "e0"), ("S001", "e1")))
    view = frontal(loaded)
    frames = list(turntable(loaded, start, view, frames=3))
    assert len(frames) == 3 and frames[0].shape == (32, 32, 3)
    assert not np.array_equal(frames[0], frames[1])
    rows, *names = expression_grid(loaded, ["S000", "S001"], ["e0", "e1"], view)
    assert names == [["S000", "S001"], ["e0", "e1"]]
    assert len(rows) == 2 and len(rows[0]) == 2
    blend_frames = list(interpolation(loaded, start, end, view, frames=3))
    np.testing.assert_array_equal(blend_frames[0], rows[0][0])
    np.testing.assert_array_equal(blend_frames[2], rows[1][1])


def test_unseen_texels_change_like_their_mirror_images():
    means = torch.tensor([[0.05, 0, 0], [-0.05, 0, 0], [0.0, 0.2, 0], [0.0, -0.2, 0]])
    colours = torch.tensor([[0.5] * 3, [0.5] * 3, [0.1] * 3, [0.5] * 3])
    change = torch.tensor([[1.0] * 3, [9.0] * 3, [-1.0] * 3, [9.0] * 3])
    weight = torch.tensor([1.0, 0.0, 1.0, 0.0])  # the others' values mean nothing
    guess = spread_change(change, weight, colours, means)
    torch.testing.assert_close(guess[1], torch.ones(3))  # mirror of the first
    torch.testing.assert_close(guess[3], torch.ones(3), atol=0.1, rtol=0)  # the first's colour
    assert torch.equal(spread_change(change, 0 * weight, colours, means), torch.zeros(4, 3))


def test_every_expression_that_an_unseen_person_is_fitted_in_is_measured(tmp_path):
    source = EllipsoidSource(expressions=1, size=32)
    train(source, ellipsoid_head(), tmp_path, tiny_config(train={"iterations": 1}))
    views = HeadViews(EllipsoidSource(subjects=3, expressions=3, size=32), ellipsoid_head())
    protocol = FitProtocol(cameras=("cam00",), expression="e1,e2")
    loaded, judge = load_checkpoint(tmp_path / "checkpoint.pt"), PerceptualMetrics(MetricsConfig())
    rows, _ = evaluate_unseen(loaded, views, "S002", protocol, judge)
    shown = sorted((row["expression"], row["camera"]) for row in rows if row["kind"] == NOVEL_VIEW)
    assert shown == [(e, c) for e in ("e1", "e2") for c in ("cam01", "cam02")]
