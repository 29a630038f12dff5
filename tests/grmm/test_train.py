import io
import json
import math
import os
import re
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from express50.contract.segmentation_labels import LABELS
from express50.errors import ConfigError, DiskFullError, FormatError, TrainError
from express50.files.atomic import write_with
from grmm import checkpoint
from grmm import train as train_module
from grmm.data import HeadViews
from grmm.evaluate import (
    NO_NETWORKS,
    Journal,
    compare,
    component_effects,
    evaluate,
    mean,
    summarise,
    training_render,
    write_evaluation,
)
from grmm.losses import LAYERS, load_vgg
from grmm.train import train
from grmm.train_state import best_device, budget_used, prepare, set_rates, split_samples
from grmm.warm_start import fill_texels, project_texture, warm_start
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


def state_of(path):
    return torch.load(path / "checkpoint.pt", weights_only=True)


def assert_equal(a, b, where=""):
    """Equal bit for bit, through nested dictionaries and lists."""
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_equal(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_equal(x, y, f"{where}[{i}]")
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b), where
    else:
        assert a == b, where


def test_resumed_run_equals_straight_run_bit_for_bit(tmp_path, source):
    head = ellipsoid_head()
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    config = tiny_config(train={"iterations": 6, "final_lr": 1.0})
    first = tiny_config(train={"iterations": 3, "final_lr": 1.0})
    train(source, head, straight, config)
    train(source, head, broken, first)
    torch.manual_seed(99)  # the state of the process must not matter
    train(source, head, broken, config, resume=True)
    a, b = state_of(straight), state_of(broken)
    for content in (a, b):
        content["loop"].pop("seconds")
    assert_equal(a, b)
    assert a["loop"]["iteration"] == 6


class Disk:
    """Takes checkpoints of a folder up to its free bytes, and gives back what is deleted."""

    def __init__(self, folder, free):
        self.folder, self.size = folder, free

    def used(self):
        files = [path.stat() for path in self.folder.glob("*checkpoint*")]
        return sum({file.st_ino: file.st_size for file in files}.values())

    def write(self, path, write):
        buffer = io.BytesIO()
        write(buffer)
        if self.used() + buffer.tell() > self.size:
            raise DiskFullError(f"{path}: the disk is full")
        write_with(path, write)


def test_weights_are_saved_when_the_disk_fills_up(tmp_path, source, monkeypatch):
    disk, rates = Disk(tmp_path, 1e9), train_module.set_rates

    def fill_late(state, config):
        if state.iteration == 3:
            disk.size = disk.used()
        rates(state, config)

    monkeypatch.setattr(checkpoint, "write_with", disk.write)
    monkeypatch.setattr(train_module, "set_rates", fill_late)
    train(source, ellipsoid_head(), tmp_path, tiny_config(train={"iterations": 5}))
    assert state_of(tmp_path)["loop"]["iteration"] == 5
    assert [path.name for path in tmp_path.glob("*checkpoint*")] == ["checkpoint.pt"]


def test_training_on_a_cpu_without_the_native_library_is_refused(tmp_path, source, monkeypatch):
    monkeypatch.setattr("express50.native.why_missing", lambda: "it was not built; build it")
    if best_device().type == "cpu":
        with pytest.raises(ConfigError, match="needs the native library: it was not built"):
            train(source, ellipsoid_head(), tmp_path / "out", tiny_config())
        assert not (tmp_path / "out").exists()


def test_saving_takes_a_bounded_share_of_the_time(tmp_path, source, monkeypatch):
    saves, galleries = [], []
    real_save, real_gallery = train_module.save, train_module.collect_gallery

    def slow(*arguments):
        real_save(*arguments)
        time.sleep(0.2)
        saves.append(arguments[1].name)

    def counted(*arguments):
        galleries.append(real_gallery(*arguments))
        return galleries[-1]

    monkeypatch.setattr(train_module, "save", slow)
    monkeypatch.setattr(train_module, "collect_gallery", counted)
    settings, began = {"iterations": 25, "save_seconds": 1e-3}, time.monotonic()
    train(source, ellipsoid_head(), tmp_path, tiny_config(train=settings))
    # Space is kept, the last is saved, and one save is due per twenty times the time of one.
    due = 1 + (time.monotonic() - began) / (20 * 0.2)
    assert saves[-1] == "checkpoint.pt" and len(saves) <= 2 + due
    assert len(galleries) == 1


def test_training_on_a_full_disk_stops_at_once(tmp_path, source, monkeypatch, capsys):
    monkeypatch.setattr(checkpoint, "write_with", Disk(tmp_path, 1e4).write)
    with pytest.raises(DiskFullError):
        train(source, ellipsoid_head(), tmp_path, tiny_config(train={"iterations": 25}))
    assert "iteration 20" not in capsys.readouterr().err


@pytest.mark.parametrize("empty", [1, 12])
def test_empty_mattes_are_named_before_training(tmp_path, source, monkeypatch, capsys, empty):
    def read(index):
        sample = EllipsoidSource.read(source, index)
        return replace(sample, alpha=sample.alpha * (index >= empty))

    monkeypatch.setattr(source, "read", read)
    words = f"{empty} of 12 views show no head, by their mattes or cameras (S000/e0/cam00"
    if empty == 12:
        with pytest.raises(TrainError, match=re.escape(words)):
            train(source, ellipsoid_head(), tmp_path, tiny_config())
        assert list(tmp_path.iterdir()) == []
    else:
        train(source, ellipsoid_head(), tmp_path, tiny_config(train={"iterations": 1}))
        assert words in capsys.readouterr().err


def test_a_camera_that_sees_no_head_is_named_before_training(tmp_path, monkeypatch, capsys):
    class Averted(EllipsoidSource):
        def read(self, index):
            sample, turned = super().read(index), np.diag([-1.0, 1, -1, 1])
            away = turned @ sample.place.cam_from_world
            place = replace(sample.place, cam_from_world=away)
            return replace(sample, place=place) if self.keys[index].camera == "cam01" else sample

    monkeypatch.setattr("grmm.data.CHECKED_MATTES", 2)  # not those of cam01
    config = tiny_config(train={"iterations": 1})
    train(Averted(size=32), ellipsoid_head(), tmp_path, config)
    words = "1 of 4 views show no head, by their mattes or cameras (S001/e1/cam01); check them"
    assert words in capsys.readouterr().err


def test_files_of_metrics_are_checked_before_training(tmp_path, source):
    (tmp_path / "bad.pth").write_bytes(b"mistyped")
    config = tiny_config(metrics={"alexnet": str(tmp_path / "bad.pth")})
    with pytest.raises(ConfigError, match="metrics.alexnet"):
        train(source, ellipsoid_head(), tmp_path / "out", config)
    assert not (tmp_path / "out").exists()


def test_training_on_one_view_lowers_the_error(tmp_path):
    source = EllipsoidSource(subjects=1, expressions=1, cameras=1)
    start = tiny_config(train={"iterations": 1})
    longer = tiny_config(train={"iterations": 40, "lr": 5e-3})
    before = train(source, ellipsoid_head(), tmp_path / "a", start)["psnr_train_db"]
    after = train(source, ellipsoid_head(), tmp_path / "b", longer)["psnr_train_db"]
    assert after > before + 3


def test_held_out_cameras_are_never_trained_on(tmp_path, source):
    config = tiny_config(data={"holdout_cameras": ("cam01",)})
    metrics = train(source, ellipsoid_head(), tmp_path, config)
    assert metrics["training_views"] == 8 and metrics["heldout_images"] == 2
    assert "cam01" not in state_of(tmp_path)["cameras"]
    written = json.loads((tmp_path / "metrics.json").read_text())
    assert written["psnr_heldout_view_db"] > 10 and written["lpips"].startswith("n/a")
    assert {p.name for p in (tmp_path / "preview").iterdir()} == {"training.jpg", "heldout.jpg"}


def test_unknown_and_exhaustive_holdouts_are_refused(tmp_path, source):
    with pytest.raises(ConfigError, match="cam09"):
        train(source, ellipsoid_head(), tmp_path, tiny_config(data={"holdout_cameras": ("cam09",)}))
    everything = tiny_config(data={"holdout_cameras": ("cam00", "cam01", "cam02")})
    with pytest.raises(TrainError, match="no views to train on"):
        train(source, ellipsoid_head(), tmp_path, everything)


def test_time_budget_ends_the_run(tmp_path, source):
    config = tiny_config(train={"iterations": 10_000, "seconds": 0.5})
    metrics = train(source, ellipsoid_head(), tmp_path, config)
    assert 1 <= metrics["iterations"] < 10_000
    assert metrics["seconds"] < 20


def test_a_budget_that_outlasts_the_steps_is_said_to_be_left(tmp_path, source, capsys):
    train(source, ellipsoid_head(), tmp_path, tiny_config(train={"iterations": 1, "seconds": 3600}))
    said = capsys.readouterr().err
    assert "of the budget are left, because train.iterations is 1" in said


def test_slow_steps_show_their_progress(tmp_path, source, monkeypatch, capsys):
    monkeypatch.setattr(train_module, "SAY_SECONDS", 0.0)
    train(source, ellipsoid_head(), tmp_path, tiny_config())
    assert "iteration 1  " in capsys.readouterr().err


def test_interrupt_leaves_a_checkpoint_to_resume(tmp_path, source, monkeypatch, capsys):
    from grmm import train as module

    real = module.step

    def interrupted(run, *rest):
        if run.iteration == 2:
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGINT)
        real(run, *rest)

    monkeypatch.setattr(module, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(source, ellipsoid_head(), tmp_path, tiny_config(train={"iterations": 5}))
    assert state_of(tmp_path)["loop"]["iteration"] == 3
    assert capsys.readouterr().err.count("stopping: this step ends, then it is saved\n") == 1
    monkeypatch.setattr(module, "step", real)
    config = tiny_config(train={"iterations": 5})
    assert train(source, ellipsoid_head(), tmp_path, config, resume=True)["iterations"] == 5


def test_a_long_step_ends_with_the_time(tmp_path, source):
    settings = {"seconds": 0.5, "accumulate": 10**6}
    metrics = train(source, ellipsoid_head(), tmp_path, tiny_config(train=settings))
    assert metrics["iterations"] == 1 and metrics["seconds"] < 20
    assert metrics["psnr_train_db"] > 10


@pytest.mark.parametrize("kind", [FormatError, OSError, torch.OutOfMemoryError])
def test_a_sample_that_becomes_unusable_loses_no_step(tmp_path, source, monkeypatch, kind):
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    config = tiny_config(train={"iterations": 5, "accumulate": 2, "final_lr": 1.0})
    train(source, ellipsoid_head(), straight, config)
    taken, item = [], HeadViews.item

    def damaged(views, index, *, crop=False):
        taken.append(crop)
        if crop and sum(taken) == 8:  # the second view of the fourth step
            raise kind("train-000000.tar: damaged")
        return item(views, index, crop=crop)

    monkeypatch.setattr(HeadViews, "item", damaged)
    with pytest.raises(kind, match="damaged"):
        train(source, ellipsoid_head(), broken, config)
    assert state_of(broken)["loop"]["iteration"] == 3
    train(source, ellipsoid_head(), broken, config, resume=True)
    a, b = state_of(straight), state_of(broken)
    for content in (a, b):
        content["loop"].pop("seconds")
    assert_equal(a, b)


def test_rates_fall_along_a_cosine(views):
    config = tiny_config(train={"iterations": 10, "lr": 1.0, "final_lr": 0.1, "code_lr_scale": 3.0})
    run = prepare(views, config)
    rates = []
    for run.iteration in (0, 5, 10):
        set_rates(run, config)
        rates.append(run.optimizer.param_groups[0]["lr"])
        assert run.optimizer.param_groups[1]["lr"] == pytest.approx(3 * rates[-1])
    assert rates == pytest.approx([1.0, 0.55, 0.1])
    assert budget_used(run, config) == 1


def test_warm_start_shows_the_subjects_before_the_first_step(views):
    config = tiny_config()
    run = prepare(views, config)
    cold = summarise(evaluate(views, run.training, training_render(run.model, views)))
    warm_start(run.model, views, run.training)
    warm = summarise(evaluate(views, run.training, training_render(run.model, views)))
    assert warm["psnr_head_db"] > cold["psnr_head_db"] + 3
    colours = [run.model.appearance(z, views.state(0), views.item(0).view) for z in run.model.z_id]
    assert colours[0][:, 0].mean() > colours[1][:, 0].mean() + 0.1  # S000 is red, S001 blue
    spread = run.model.z_id[:, 0].detach()
    assert float(spread.std()) == pytest.approx(1.0, rel=1e-4)


def test_projected_texture_is_the_footage_where_seen_only():
    views = HeadViews(EllipsoidSource(size=64, cameras=6, subjects=1), ellipsoid_head(24, 32))
    config = tiny_config()
    run = prepare(views, config)
    indices = [i for i, key in enumerate(views.keys) if key.expression == "e0"]
    colours, weight = project_texture(run.model, views, indices)
    with torch.no_grad():
        points = run.model.geometry(*run.model.codes(0, 0), views.state(0)).means
    unit = points / torch.tensor([0.08, 0.11, 0.09])
    pattern = 0.6 + 0.25 * torch.sin(4 * unit[:, 0]) + 0.15 * torch.sign(unit[:, 1])
    expected = torch.tensor([0.9, 0.5, 0.4]) * pattern[:, None]
    smooth = (weight > 0) & (unit[:, 1].abs() > 0.15)
    assert float((colours - expected)[smooth].abs().mean()) < 0.03
    front = [i for i in indices if views.keys[i].camera == "cam00"]
    _, from_one = project_texture(run.model, views, front)
    assert 0.1 < float((from_one > 0).float().mean()) < 0.5


def test_a_texture_does_not_depend_on_which_poses_are_still_in_memory():
    """A pose took the Gaussians of one that was dropped before, whose address it had."""
    source = EllipsoidSource(size=32, expressions=6, cameras=1, subjects=1)
    views, forgetful = (HeadViews(source, ellipsoid_head()) for _ in range(2))
    forgetful._states.limit = 0
    model = prepare(views, tiny_config()).model
    expected, _ = project_texture(model, views, range(6))
    assert torch.equal(project_texture(model, forgetful, range(6))[0], expected)


def test_unknown_texels_take_the_nearest_colour():
    values = torch.tensor([[1.0], [0.0], [0.0], [3.0]])
    known = torch.tensor([True, False, False, True])
    texels = torch.tensor([0, 1, 62, 63])
    assert fill_texels(values, known, texels, 8)[:, 0].tolist() == [1, 1, 3, 3]
    nothing = fill_texels(values, torch.zeros(4, dtype=torch.bool), texels, 8)
    assert nothing[:, 0].tolist() == [0.5] * 4


def test_objective_that_is_not_finite_stops_with_the_sample_named(source, tmp_path):
    class Poisoned(EllipsoidSource):
        def read(self, index):
            sample = super().read(index)
            sample.depth[16, 16] = float("inf")
            return sample

    with pytest.raises(TrainError, match="iteration 0"):
        train(Poisoned(size=32), ellipsoid_head(), tmp_path, tiny_config())


def test_weights_that_are_not_finite_do_not_replace_the_last_checkpoint(source, tmp_path):
    def poisoned(state, rendering, item):  # a term of 0 whose gradient is NaN, from step 2 on
        opacity = rendering.gaussians.opacities.sum()
        return {"own": (0 * opacity).sqrt() if state.iteration else 0 * opacity}

    config = tiny_config(train={"save_seconds": 1e-9})
    with pytest.raises(TrainError, match=r"not saved, because .* holds NaN or Inf"):
        train(source, ellipsoid_head(), tmp_path, config, own_terms=poisoned)
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert saved["loop"]["iteration"] == 1


def test_evaluation_is_written_as_table_and_means(tmp_path, views):
    run = prepare(views, tiny_config())
    rows = evaluate(views, [0, 4], training_render(run.model, views))
    summary = write_evaluation(tmp_path, rows)
    lines = (tmp_path / "evaluation.csv").read_text().splitlines()
    assert len(lines) == 3 and lines[0].startswith("subject,expression,camera,kind,psnr_db")
    assert summary["psnr_db"] == pytest.approx(
        (rows[0]["psnr_db"] + rows[1]["psnr_db"]) / 2, abs=1e-3
    )
    assert set(summary["by_camera"]) == {"cam00", "cam01"}


def vgg_weights():
    generator = torch.Generator().manual_seed(0)
    weights, channels, index = {}, 3, 0
    for entry in LAYERS:
        if entry == "M":
            index += 1
            continue
        weights[f"features.{index}.weight"] = 0.05 * torch.randn(
            entry, channels, 3, 3, generator=generator
        )
        weights[f"features.{index}.bias"] = torch.zeros(entry)
        channels, index = entry, index + 2
    return weights


def test_perceptual_distance_is_zero_for_equal_images_and_learns(tmp_path):
    path = tmp_path / "vgg16.pth"
    torch.save(vgg_weights() | {"classifier.0.weight": torch.zeros(1)}, path)
    distance = load_vgg(str(path))
    image = torch.rand(3, 32, 32, requires_grad=True)
    assert float(distance(image, image.detach()).detach()) == 0
    distance(image, torch.rand(3, 32, 32)).backward()
    assert image.grad.abs().sum() > 0
    assert not any(p.requires_grad for p in distance.parameters())


def test_wrong_perceptual_weights_are_named(tmp_path):
    torch.save({}, tmp_path / "empty.pth")
    for name, words in (("empty", "features.0.weight"), ("absent", "no such file")):
        with pytest.raises(ConfigError, match=words):
            load_vgg(str(tmp_path / f"{name}.pth"))


def test_held_out_expressions_are_not_trained_on():
    keys = EllipsoidSource(subjects=2, expressions=2, cameras=3).keys
    config = tiny_config(data={"holdout_cameras": ("cam01",), "holdout_expressions": ("*1/e1",)})
    training, holdout = split_samples(keys, config)
    assert {(keys[i].subject, keys[i].expression) for i in training} == {
        ("S000", "e0"), ("S000", "e1"), ("S001", "e0"),
    }  # fmt: skip
    assert sorted(training + holdout) == list(range(12)) and len(training) == 6
    wrong = tiny_config(data={"holdout_expressions": ("S009/e0",)})
    with pytest.raises(ConfigError, match="S009/e0"):
        split_samples(keys, wrong)


def test_a_long_evaluation_shows_its_progress(views, monkeypatch, capsys):
    monkeypatch.setattr("grmm.evaluate.SAY_SECONDS", 0.0)
    evaluate(views, [0, 1, 4], training_render(prepare(views, tiny_config()).model, views))
    said = capsys.readouterr().err
    assert "measured 1 of 3 images, " in said and "measured 2 of 3 images, " in said


def test_an_evaluation_names_the_full_disk(views, monkeypatch):
    monkeypatch.setattr("grmm.evaluate.journal_rows", lambda journal: {})
    run = prepare(views, tiny_config())
    journal, render = Journal(Path("/dev/full"), ""), training_render(run.model, views)
    with pytest.raises(DiskFullError, match="/dev/full: the disk is full"):
        evaluate(views, [0], render, journal=journal)


def test_a_rendering_with_nan_is_refused_not_passed_over(views):
    render = training_render(prepare(views, tiny_config()).model, views)

    def damaged(item):
        out = render(item)
        out.image[0, 0, 0] = float("nan")
        return out

    with pytest.raises(TrainError, match="the rendering holds NaN"):
        evaluate(views, [0], damaged)


class Parted(EllipsoidSource):
    """The toy head with lips on its upper half and hair on the lower; a few pixels are eyes."""

    def read(self, index):
        sample = super().read(index)
        parts = np.where(sample.alpha > 0, LABELS.index("hair"), 0).astype(np.uint8)
        parts[: self.size // 2][sample.alpha[: self.size // 2] > 0] = LABELS.index("lips")
        parts[self.size // 2, 14:18] = LABELS.index("eyes")
        return replace(sample, parts=parts)


def test_regions_are_measured_by_labels():
    views = HeadViews(Parted(size=32), ellipsoid_head())
    item = views.item(0)
    image = item.target.clone()
    image[:, :16] += 0.1 * torch.from_numpy(item.parts[:16] == LABELS.index("lips"))
    row = compare(image, item, NO_NETWORKS)
    assert row["psnr_mouth_db"] == pytest.approx(20, abs=0.3) and row["psnr_hair_db"] == 100
    assert math.isnan(row["psnr_skin_db"]) and math.isnan(row["psnr_eyes_db"])  # none; four pixels
    assert math.isnan(compare(image, replace(item, parts=None), NO_NETWORKS)["psnr_mouth_db"])


def test_metrics_tell_what_each_component_gains(tmp_path):
    config = tiny_config(data={"holdout_cameras": ("cam01",)}, train={"iterations": 30, "lr": 5e-3})
    metrics = train(Parted(size=32), ellipsoid_head(), tmp_path, config)
    gains = metrics["components_gain_db"]
    assert set(gains) == {"z_exp", "mesh_decoder", "refinement"}
    assert metrics["components_gain_on"] == "held-out views"
    assert all(gain["psnr_db"] != 0 for gain in gains.values())
    assert gains["refinement"]["psnr_mouth_db"] is not None
    loaded = checkpoint.load_checkpoint(tmp_path / "checkpoint.pt")
    views = HeadViews(Parted(size=32), ellipsoid_head())
    held = [i for i, key in enumerate(views.keys) if key.camera == "cam01"]
    rows = evaluate(views, held, training_render(loaded.model, views))
    assert gains["refinement"]["psnr_db"] == pytest.approx(
        mean(rows, "psnr_db") - mean(rows, "psnr_unrefined_db"), abs=1e-3
    )
    before = {name: value.clone() for name, value in loaded.model.state_dict().items()}
    component_effects(loaded.model, views, held[:1])
    after = loaded.model.state_dict()
    assert after.keys() == before.keys() and all(torch.equal(before[k], after[k]) for k in after)


def test_terms_of_the_caller_are_added_to_the_objective(tmp_path, source):
    def opaque(state, rendering, item):
        return {"opaque": 10 * (1 - rendering.gaussians.opacities).mean()}

    config = tiny_config(train={"iterations": 12, "lr": 5e-3})
    found = {}
    for name, own in (("plain", None), ("own", opaque)):
        metrics = train(source, ellipsoid_head(), tmp_path / name, config, own_terms=own)
        loaded = checkpoint.load_checkpoint(tmp_path / name / "checkpoint.pt")
        views = HeadViews(source, ellipsoid_head())
        with torch.no_grad():
            gaussians = loaded.model.geometry(*loaded.model.codes(0, 0), views.state(0))
        found[name] = float(gaussians.opacities.mean()), "opaque" in metrics["terms"]
    assert found["own"][0] > found["plain"][0] + 0.01
    assert (found["plain"][1], found["own"][1]) == (False, True)


def test_a_process_takes_its_own_gpu(monkeypatch):
    chosen = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    monkeypatch.setenv("LOCAL_RANK", "3")
    assert best_device() == torch.device("cuda:3") and chosen == [torch.device("cuda:3")]
