"""The error that a stage expects is a finite interval around a value."""

import math

import pytest

from express50.contract.stage import ExpectedError, Result, typical_error
from express50.dial.choice import Expected, error_text
from express50.errors import StageError


@pytest.mark.parametrize(
    "figures",
    [
        (math.nan, 0, 1, "mm"), (1, 0, math.inf, "mm"), (1, -math.inf, 2, "mm"),
        (2, 0, 1, "mm"), (0, 1, 2, "mm"), (1, 0, 2, "inch"),
    ],
)  # fmt: skip
def test_figures_that_are_not_an_interval_and_unknown_units_are_refused(figures):
    with pytest.raises(StageError):
        ExpectedError(*figures)


def test_what_is_not_known_is_not_written():
    assert "expected_error" not in Result().to_json()


def test_items_without_a_figure_and_damaged_ones_do_not_count():
    rows = [
        Result(expected_error=ExpectedError(v, v / 2, 2 * v, "mm")).to_json() for v in (1, 2, 6)
    ]
    damaged = [
        {"expected_error": bad}
        for bad in (None, 3, {"value": 1}, {**rows[0]["expected_error"], "low": 9})
    ]
    assert typical_error([*rows, Result().to_json(), *damaged]) == ExpectedError(2, 1, 4, "mm")
    assert typical_error([]) is None
    assert str(ExpectedError(0.312, 0.22, 0.5, "mm")) == "0.31 mm (0.22 to 0.5)"


def test_large_errors_are_written_without_exponents():
    """One camera leaves the scale open: the interval of a photograph reaches beyond 100 mm."""
    assert str(ExpectedError(36.2, 9.44, 104.3, "mm")) == "36 mm (9.4 to 104)"
    expected = Expected(value=118.2, low=99.6, high=1234.0, unit="mm", stated=True)
    assert error_text("mesh", expected) == "mesh 118 mm (100 to 1234)"
