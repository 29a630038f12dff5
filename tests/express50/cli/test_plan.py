"""Plans: figures come from receipts, grow by the stated law, or are absent."""

import json
from dataclasses import replace

import numpy as np
import pytest

from express50.__main__ import main
from express50.cli.plan import (
    TARGETS,
    Measured,
    _hours,
    estimate,
    measure,
    measure_sizes,
    target_of,
)
from express50.contract.layout import Dataset
from express50.contract.stage import stages
from express50.dial.choice import MeasuredSize, forecast
from express50.dial.figures import Footage, footage_of
from express50.dial.measuring import tune
from express50.runner.ledger import Ledger
from pipelines import ingest
from tests.express50.dial.toy_chain import captures_of, chain_of
from tests.stages import ingest_captures
from tests.synth import make_capture

SMALL = Footage(subjects=2, expressions=6, views=8, pixels=1e5, frames=36)


def cost(seconds, size=1e6, memory=1e9, preset="draft"):
    return Measured(seconds=(seconds,) * 4, bytes=size, memory=memory, preset=preset)


def test_express_50_is_scaled_linearly_from_one_dataset():
    target = target_of("express-50", {}, SMALL)
    assert target == Footage(
        subjects=50, expressions=60, views=24, pixels=8294400, frames=360, shape=0.5625
    )
    (row,) = estimate([stages()["matte"]], target, [(SMALL, {"matte": cost(2.0)})], workers=10)
    ratio = 24 * 8294400 / (8 * 1e5)
    assert row.items == 3000 and row.seconds == pytest.approx(2 * ratio)
    assert row.core_hours == pytest.approx(3000 * 2 * ratio / 3600)
    assert row.days == pytest.approx(row.core_hours / 240)
    assert row.disk == pytest.approx(3000 * 1e6 * ratio)
    assert row.memory == 1e9  # the constant part is unknown: no guess is printed


def test_a_stage_that_reduces_pictures_takes_no_longer_for_larger_ones():
    full, huge = (replace(SMALL, pixels=side * side) for side in (2048.0, 8192.0))
    found = [
        estimate([stages()["depth"]], target, [(SMALL, {"depth": cost(2.0)})], workers=1)[0]
        for target in (full, huge)
    ]
    assert found[0].seconds == found[1].seconds == pytest.approx(2.0 * 0.75 * 1024**2 / 1e5)
    assert found[0].disk < found[1].disk, "maps are written at full size"


def test_reduced_pictures_bound_the_stages_after_frames_and_no_other():
    names, target = ("ingest", "frames", "matte"), replace(SMALL, pixels=8e6)
    chosen = [stages()[name] for name in names]
    costs = {name: cost(2.0) for name in names}
    bounded = estimate(chosen, replace(target, side=1280), [(replace(SMALL, side=1280), costs)], 1)
    small = 0.75 * 1280**2
    for row, pixels in zip(bounded, (8e6, (8e6 + small) / 2, small), strict=True):
        assert row.seconds == pytest.approx(2.0 * pixels / 1e5)


def test_frames_that_ingest_does_not_decode_cost_nothing(tmp_path):
    short, long = (tmp_path / name for name in ("short", "long"))
    found = []
    for path, frames in ((short, 8), (long, 60)):
        make_capture(path / "raw", cameras=2, frames=frames, expressions=("smile",))
        found.append(footage_of(ingest_captures(path / "data", path / "raw", every=24)))
    assert [footage.decoded for footage in found] == [1, pytest.approx(2.5, abs=0.5)]
    target = target_of(None, {"frames_per_expression": 480}, found[0])
    assert target.decoded == 20
    (row,) = estimate([stages()["ingest"]], target, [(found[0], {"ingest": cost(2.0)})], 1)
    assert row.seconds == pytest.approx(40.0)  # 480 / 8 times as much it would be with every=1


def test_plates_are_an_item_per_subject_not_per_expression():
    (row,) = estimate([stages()["frames"]], SMALL, [(SMALL, {"frames": cost(2.0)})], workers=1)
    assert row.items == 2 * 6 + 2


def test_one_item_is_not_split_over_workers():
    (row,) = estimate([stages()["pack"]], SMALL, [(SMALL, {"pack": cost(86400.0)})], workers=32)
    assert row.items == 1 and row.days == pytest.approx(1.0)


def test_what_was_not_measured_is_reported_as_such():
    chosen, measured = [stages()["depth"], stages()["track"]], {"depth": cost(2.0)}
    rows = estimate(chosen, SMALL, [(SMALL, measured)], 1)
    assert [row.why for row in rows] == ["", "was not run"]
    assert rows[1].seconds is rows[1].core_hours is rows[1].disk is rows[1].memory is None


def test_every_stage_has_a_law_and_every_target_a_size():
    rows = estimate(list(stages().values()), SMALL, [(SMALL, {})], 1)
    assert [row.stage for row in rows] == list(stages())
    for name in TARGETS:
        assert target_of(name, {"frames_per_expression": 90}, SMALL).frames in (5400, 1080)


def test_figures_are_those_of_the_receipts(tmp_path, capsys):
    for name in ("S001", "S002"):
        make_capture(tmp_path / name, subject=name, cameras=2, frames=4, size=64)
    root = tmp_path / "data"
    captures = [str(tmp_path / name) for name in ("S001", "S002")]
    assert main(["ingest", str(root), *captures, "--workers", "0", "--preset", "draft"]) == 0
    dataset = Dataset(root)
    with Ledger(dataset.ledger) as ledger:
        receipts = ledger.read("ingest").values()
    found = measure(dataset, [ingest.STAGE])["ingest"]
    assert found.seconds == tuple(r.core_seconds for r in receipts)
    assert found.memory == max(r.peak_memory for r in receipts) and found.preset == "draft"
    files = [p for p in dataset.stage_dir("ingest").rglob("*") if p.is_file()]
    assert found.bytes == sum(p.stat().st_size for p in files) / 2
    size = {"pixels": 4096, "shape": 1.0, "every": 24}
    assert footage_of(dataset) == Footage(subjects=2, expressions=2, views=2, frames=4, **size)
    capsys.readouterr()
    assert main(["plan", str(root), "--size", "128x64", "--subjects", "10", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)["stages"][0]
    assert first["items"] == 10 and first["seconds"] == pytest.approx(2 * sum(found.seconds) / 2)
    for size in ("0x0", "-64x-64"):
        assert main(["plan", str(root), "--size", size]) == 2
    assert main(["plan", str(root), "--target", "renderme-360"]) == 0
    said = capsys.readouterr().out
    assert "was not run" in said and "not measured: calibrate" in said
    assert "e+" not in said
    assert main(["plan", str(root), "--size", "big"]) == 2


def test_frames_are_whole_and_no_value_seems_to_lie_outside_its_interval(tmp_path, capsys):
    names = ("smile", "frown", "pucker", "jaw_open")
    for subject, count in (("S001", 3), ("S002", 4)):
        given = {"subject": subject, "expressions": names[:count], "frames": 8, "size": 64}
        make_capture(tmp_path / subject, cameras=1, **given)
        ingest_captures(tmp_path / "data", tmp_path / subject)
    assert main(["plan", str(tmp_path / "data"), "--target", "express-50"]) == 0
    assert "8.29 megapixels, 137 frames per camera\n" in capsys.readouterr().out
    assert _hours(36.62, 36.6, 64.1) == "37 (37 to 64)" and _hours(274, 86, 670.4)[:8] == "274 (86 "


def test_reduced_pictures_keep_the_shape_of_the_footage():
    sides = {"pixels": 3840 * 2160.0, "side": 1280.0}
    assert replace(SMALL, **sides, shape=9 / 16).picture == 1280 * 720
    assert replace(SMALL, **sides, shape=1.0).picture == 1280 * 1280
    wide = {"pixels": 3840 * 2160, "shape": 9 / 16}
    assert target_of(None, wide, replace(SMALL, side=1280.0)).picture == 1280 * 720


def test_two_sizes_tell_what_does_not_grow_and_the_interval_holds_a_third():
    stage = stages()["matte"]
    large, unseen = (replace(SMALL, pixels=SMALL.pixels * k) for k in (4, 20))

    def seconds(footage):  # 3 s whatever the footage
        return 3.0 + 2.0 * footage.pixels / SMALL.pixels

    measured = [
        (f, {"matte": replace(cost(seconds(f)), bytes=1e6 * seconds(f))}) for f in (SMALL, large)
    ]
    (row,) = estimate([stage], unseen, measured, 1)
    assert row.sizes == 2 and row.seconds == pytest.approx(seconds(unseen))
    assert row.disk == pytest.approx(row.items * 1e6 * seconds(unseen))
    assert row.core_hours_low < row.core_hours < row.core_hours_high < 1.3 * row.core_hours
    (alone,) = estimate([stage], unseen, measured[:1], 1)
    assert alone.sizes == 1 and alone.seconds == pytest.approx(20 * 5.0)
    assert alone.core_hours_low < row.core_hours < alone.core_hours_high
    assert alone.disk_low < row.disk_low < row.disk < row.disk_high < alone.disk_high


def test_sizes_near_the_one_in_question_count_most():
    samples = [MeasuredSize(w, [t]) for w, t in ((1.0, 1.4), (14.0, 5.1), (240.0, 35.0))]
    for work, seconds in ((240.0, 35.0), (480.0, 66.0), (1.0, 1.4)):
        assert forecast(samples, work).value == pytest.approx(seconds, rel=0.06)


def test_intervals_hold_nine_times_in_ten():
    rng, kept = np.random.default_rng(1), 0
    for _ in range(80):
        samples = [
            MeasuredSize(w, rng.normal(2 + w, 0.2 * (2 + w), 8).tolist()) for w in (1.0, 4.0, 9.0)
        ]
        found = forecast(samples, 16.0)
        kept += found.low <= 18.0 <= found.high
    assert 67 <= kept <= 77


def test_a_dataset_that_was_only_tuned_is_planned(tmp_path, capsys):
    captures = captures_of(tmp_path / "captures", subjects=1)
    tune(chain_of(tmp_path / "data", captures))
    sizes = measure_sizes(Dataset(tmp_path / "data"), [ingest.STAGE])
    assert sizes[0][0].expressions == 4 and sizes[1][1]["solve"].preset == "draft"
    # What a trial takes over from another is measured once: repeated, it would narrow intervals.
    tried = {name: sum(name in table for _, table in sizes) for name in sizes[1][1]}
    assert tried == {"ingest": 1, "align": 1, "solve": 4, "map": 6}
    capsys.readouterr()
    assert main(["plan", str(tmp_path / "data"), "--target", "express-50"]) == 0
    assert "ingest" in (text := capsys.readouterr().out) and "was not run" in text


def test_a_folder_that_is_not_there_is_named_as_such(tmp_path, capsys):
    for command in (["plan"], ["tune"], ["run", "--budget", "1h"]):
        assert main([command[0], str(tmp_path / "lost"), *command[1:]]) == 2
        assert "no such dataset" in capsys.readouterr().err
    assert not (tmp_path / "lost").exists()


def test_a_folder_without_a_dataset_is_not_called_empty_of_footage(tmp_path, capsys):
    assert main(["plan", str(tmp_path)]) == 2
    assert "not a dataset (no ledger.sqlite); run 'express50 ingest" in capsys.readouterr().err
    with Ledger(Dataset(tmp_path).ledger):
        pass
    assert main(["plan", str(tmp_path)]) == 1
    assert "nothing is ingested, so nothing was measured; run 'exp" in capsys.readouterr().err
