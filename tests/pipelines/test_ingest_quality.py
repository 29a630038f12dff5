"""Faults put into footage are found by camera and frame; clean footage gives no warning."""

import json

import cv2
import numpy as np
import pytest

from express50.contract.layout import Dataset
from express50.geometry.pixels import linear_to_srgb, srgb_to_linear
from pipelines import ingest
from pipelines.ingest.quality import (
    describe_steps,
    find_repeats,
    find_steps,
    light_cells,
    measure_drift,
    movement,
    small_grey,
)
from tests.stages import run_here
from tests.synth import make_rig, render_ball, write_frames

CAMERAS, FRAMES = 5, 90


@pytest.fixture(scope="module")
def footage():
    """Images by camera, with sensor noise, of a mark that moves unevenly."""
    rng = np.random.default_rng(4)
    speed = np.abs(np.convolve(rng.normal(0, 1.6, FRAMES + 6), np.ones(3) / 3, "same"))[:FRAMES]
    times = np.cumsum(speed)
    found = {}
    for name, camera in make_rig(CAMERAS, 96).items():
        images = [render_ball(camera, t).astype(float) for t in times]
        found[name] = [
            np.clip(np.rint(i + rng.normal(0, 1.5, i.shape)), 0, 255).astype(np.uint8)
            for i in images
        ]
    return found


def moves(images):
    greys = [small_grey(image) for image in images]
    pairs = zip([None, *greys[:-1]], greys, strict=True)
    return np.array([movement(before, after) for before, after in pairs])


def in_step(footage, length):
    table = {name: moves(images)[:length] for name, images in footage.items()}
    return find_steps(table, (length,), 8)


def test_footage_in_step_gives_no_steps(footage):
    assert in_step(footage, FRAMES) == ({}, {})


@pytest.mark.parametrize("lag", [1, 2, 5])
def test_a_shifted_camera_is_found_with_its_shift(footage, lag):
    shifted = footage | {"cam01": footage["cam01"][lag:]}
    steps, _ = in_step(shifted, FRAMES - lag)
    assert list(steps) == ["cam01"]
    (step,) = steps["cam01"]
    assert step.lag == lag and step.frame <= lag
    assert "ahead of the others from its start" in describe_steps(steps["cam01"])
    late = footage | {"cam03": footage["cam03"][:1] * lag + footage["cam03"]}
    steps, _ = in_step(late, FRAMES)
    assert list(steps) == ["cam03"]
    assert steps["cam03"][-1].lag == -lag and steps["cam03"][-1].frame < 16


def test_a_lag_lasts_from_clip_to_clip(footage):
    table = {name: moves(images) for name, images in footage.items()}
    ahead = moves(footage["cam01"][2:])
    twice = {name: np.tile(row[: FRAMES - 2], 2) for name, row in table.items()}
    steps, _ = find_steps(twice | {"cam01": np.tile(ahead, 2)}, (FRAMES - 2,) * 2, 8)
    assert [step.lag for step in steps["cam01"]] == [2]
    back = np.concatenate([ahead, table["cam01"][: FRAMES - 2]])
    steps, _ = find_steps(twice | {"cam01": back}, (FRAMES - 2,) * 2, 8)
    assert [step.lag for step in steps["cam01"]] == [2, 0]
    assert steps["cam01"][1].frame == FRAMES - 2


@pytest.mark.parametrize(("frame", "lost"), [(20, 1), (45, 1), (60, 3)])
def test_lost_frames_are_found_where_they_were_lost(footage, frame, lost):
    images = footage["cam02"]
    cut = footage | {"cam02": images[:frame] + images[frame + lost :]}
    steps, _ = in_step(cut, FRAMES - lost)
    assert list(steps) == ["cam02"]
    (step,) = steps["cam02"]
    assert step.lag == lost and abs(step.frame - frame) <= 3


def test_repeated_frames_are_found(footage):
    images = footage["cam04"]
    held = images[:30] + [images[29]] * 3 + images[33:]
    table = {n: moves(i) for n, i in (footage | {"cam04": held}).items()}
    assert set(find_repeats(table)) <= {"cam04"}
    found = set(find_repeats(table).get("cam04", []))
    others = np.median([table[n][30:33] for n in table if n != "cam04"], axis=0)
    assert found and found <= {30, 31, 32}
    assert find_repeats({n: moves(i) for n, i in footage.items()}) == {}
    assert others.max() > 1


def test_two_cameras_or_a_still_scene_cannot_be_judged(footage):
    pair = {name: footage[name] for name in ("cam00", "cam01")}
    steps, unjudged = in_step(pair, FRAMES)
    assert steps == {} and sorted(unjudged) == ["cam00", "cam01"]
    rng = np.random.default_rng(0)
    still = {
        n: [np.clip(i[0] + rng.normal(0, 1.5, i[0].shape), 0, 255).astype(np.uint8)
            for _ in range(60)]
        for n, i in footage.items()
    }  # fmt: skip
    steps, unjudged = in_step(still, 60)
    assert steps == {} and len(unjudged) == CAMERAS


def lit(image, gains):
    linear = srgb_to_linear(image / 255.0) * gains
    return np.rint(linear_to_srgb(np.clip(linear, 0, 1)) * 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("gain", "exposure", "red", "blue"),
    [((0.8, 0.8, 0.8), 0.32, 0, 0), ((0.9, 1, 1), 0.05, 0.15, 0), ((1, 1, 1.2), 0.09, 0, 0.26)],
)
def test_drift_of_light_is_measured_in_stops(footage, gain, exposure, red, blue):
    ramp = np.linspace(0, 1, FRAMES)[:, None] * (np.array(gain) - 1) + 1
    images = [lit(i, g) for i, g in zip(footage["cam02"], ramp, strict=True)]
    drift = measure_drift(
        np.stack([light_cells(image) for image in images]), np.arange(len(images))
    )
    assert drift is not None
    assert drift.exposure == pytest.approx(exposure, abs=0.03)
    assert drift.red == pytest.approx(red, abs=0.03)
    assert drift.blue == pytest.approx(blue, abs=0.03)
    cells = np.stack([light_cells(image) for image in footage["cam02"]])
    steady = measure_drift(cells, np.arange(len(cells)))
    assert max(steady.exposure, steady.red, steady.blue) < 0.02


def test_ingest_warns_of_all_faults_and_writes_their_figures(footage, tmp_path):
    capture = tmp_path / "S001"
    ramp = np.linspace(1, 0.7, FRAMES)[:, None]
    faulty = dict(footage)
    faulty["cam00"] = [lit(i, np.ones(3) * g) for i, g in zip(footage["cam00"], ramp, strict=True)]
    faulty["cam01"] = [cv2.GaussianBlur(image, (0, 0), 3) for image in footage["cam01"]]
    faulty["cam02"] = footage["cam02"][:40] + footage["cam02"][42:]
    for name, images in faulty.items():
        write_frames(capture / "cameras" / name / "frames", images)
    (capture / "capture.toml").write_text('subject = "S001"\nfps = 24\n')
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [capture])
    summary = run_here(ingest.STAGE, dataset, preset="reference")
    assert summary.ok
    assert any("warning S001: camera cam02" in line for line in summary.lines())
    folder = dataset.item_dir("ingest", "S001")
    rows = json.loads((folder / "metrics.json").read_text())["warnings"]
    said = {row["what"]: row["why"] for row in rows}
    assert sorted(said) == ["camera cam00", "camera cam01", "camera cam02", "expressions"]
    assert "exposure changes by 0.5" in said["camera cam00"]
    assert "out of focus: its sharpest edges are" in said["camera cam01"]
    assert "loses 2 frames at about frame" in said["camera cam02"]
    figures = json.loads((folder / "checks.json").read_text())
    (step,) = figures["sync"]["out_of_step"]["cam02"]
    assert step["lag"] == 2 and abs(step["frame"] - 40) <= 3
    assert figures["light"]["cam00"]["exposure"] == pytest.approx(0.515, abs=0.06)
    lines = list(ingest.account(dataset, ["S001"]))
    assert lines[0] == "  S001 (express50): 5 cameras, 88 to 90 frames each, 0 expressions"


def test_ingest_says_that_it_did_not_check_sync(footage, tmp_path):
    for name, images in footage.items():
        write_frames(tmp_path / "S001/cameras" / name / "frames", images)
    (tmp_path / "S001/capture.toml").write_text('subject = "S001"\nfps = 24\n')
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [tmp_path / "S001"])
    for every, said in ((24, True), (1, False)):
        lines = run_here(ingest.STAGE, dataset, every=every).lines()
        assert any("sync: not checked, as one of 24 frames" in line for line in lines) is said
