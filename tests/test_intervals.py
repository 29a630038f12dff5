"""What the benchmark of error bounds says of few people, and how it weighs items."""

import numpy as np
import pytest

from benchmarks.intervals import spread
from benchmarks.intervals_collect import sampled
from benchmarks.intervals_fit import fit_model


def test_a_rows_interval_is_wide_where_few_people_differ_much():
    alike = {"few": [90.0, 90.5], "many": [90.0, 90.5] * 8}
    apart = {"few": [80.0, 98.0], "many": [80.0, 98.0] * 8}
    (_, narrow), (_, narrower) = spread(alike)
    (_, wide), (_, less) = spread(apart)
    assert narrower[0] > narrow[0] > 88 and narrow[1] < 92
    assert wide[0] < less[0] < 89 < less[1] < wide[1]
    assert list(spread({"one": [90.0]})) == [("one", None)]


def test_intervals_of_rows_hold_the_true_coverage_nine_times_in_ten():
    rng, held = np.random.default_rng(3), []
    for _ in range(300):
        rows = {name: list(rng.normal(90, 4, 2)) for name in "abcd"}
        held += [low <= 90 <= high for _, (low, high) in spread(rows)]
    assert 0.87 < np.mean(held) < 0.93


def test_a_proportional_model_weighs_rigs_of_any_number_of_cameras_alike():
    def rig(count, ratio):
        figures = [{"stated_mm": np.full(count, 0.1)}]
        return sampled("calibrate", f"rig {ratio}", figures, [np.full(count, 0.1 * ratio)])

    model = fit_model([rig(100, 1.0), rig(2, 2.0), rig(2, 3.0)], "mm")
    assert np.exp(model.typical[0]) == pytest.approx(2.0)
    assert np.exp(model.bound[0]) == pytest.approx(3.0)


def test_an_items_interval_holds_nine_in_ten_of_unseen_items_even_if_a_few_are_far_off():
    rng, held = np.random.default_rng(5), []

    def rigs(count):
        far = np.exp(rng.normal(0, np.where(rng.random(count) < 0.1, 2.0, 0.3)))
        return [
            sampled("calibrate", f"rig {k}", [{"stated_mm": np.ones(9)}], [np.full(9, ratio)])
            for k, ratio in enumerate(far)
        ]

    for _ in range(40):
        low, middle, high = fit_model(rigs(60), "mm").item
        held += [low <= s.errors[0] / s.figures["stated_mm"][0] <= high for s in rigs(60)]
        assert low < middle < high
    assert 0.88 < np.mean(held) < 0.93


def test_an_items_interval_is_wider_where_people_differ():
    def item(apart):
        rng = np.random.default_rng(7)
        ratios = np.exp(np.array([-apart, 0, apart])[:, None] + rng.normal(0, 0.1, (3, 20)))
        figures = [{"stated_mm": np.ones(9)}]
        samples = [
            sampled("calibrate", f"S{n}/{k}", figures, [np.full(9, ratio)])
            for n, own in enumerate(ratios)
            for k, ratio in enumerate(own)
        ]
        return np.ptp(np.log(fit_model(samples, "mm").item)), np.ptp(np.log(ratios))

    (alike, range_alike), (apart, range_apart) = item(0.0), item(0.5)
    assert alike < range_alike and apart > range_apart
