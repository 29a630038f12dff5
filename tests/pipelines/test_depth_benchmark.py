"""Check the benchmark of depth: its figures and the swept settings."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from benchmarks.accuracy import measure_depth, measure_matte, measure_regions, measure_track
from benchmarks.depth_score import of_surest, summary
from benchmarks.depth_sweep import AXES
from express50.contract.layout import Dataset
from pipelines.depth import DepthConfig


def test_every_setting_of_the_sweep_exists():
    known = {field.name for field in fields(DepthConfig)}
    for axis, (knob, values) in AXES.items():
        assert axis == "views" or knob in known
        for value in values if axis != "views" else ():
            DepthConfig(**{knob: value})


def test_figures_are_those_of_all_pixels_and_none_where_nothing_was_measured():
    rows = [{"errors": np.full(3, 1.0), "skin": np.ones(1), "degrees": np.ones(1), "covered": 1.0,
             "gib": 1.0, "s": 2.0, "sure": np.zeros(0)},
            {"errors": np.full(1, 9.0), "skin": np.ones(1), "degrees": np.ones(1), "covered": 0.5,
             "gib": 2.0, "s": 4.0, "sure": np.zeros(0)}]  # fmt: skip
    found = summary(rows)
    assert found["abs_error_mm_median"] == 1 and found["coverage"] == 0.75
    assert found["seconds_per_frame"] == 3 and found["peak_memory_gib"] == 2
    assert "n/a" in summary([]) and "abs_error_mm_p95_of_surest" not in found
    empty = rows[0] | {"errors": np.zeros(0), "skin": np.zeros(0), "degrees": np.zeros(0)}
    assert "n/a" in summary([empty])


def test_errors_of_the_surest_pixels_leave_out_the_least_confident():
    errors, sure = np.full(1000, 1.0), np.full(1000, 0.9)
    errors[:80], sure[:80] = 20.0, 0.1
    found = of_surest(errors, sure)["abs_error_mm_p95_of_surest"]
    assert found["0.98"] == 20 and found["0.9"] == 1
    assert of_surest(errors, -sure)["abs_error_mm_p95_of_surest"]["0.7"] == 20


@pytest.mark.parametrize("measure", [measure_matte, measure_track, measure_depth, measure_regions])
def test_stages_without_outputs_have_no_figures(measure, tmp_path) -> None:
    """They were NaN, which is not JSON."""
    assert set(measure(Dataset(tmp_path), None).values()) == {0}
