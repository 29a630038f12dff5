"""Counts of people: only what captures state as a number, nobody twice."""

import math

import pytest

from express50.demographics import age_counts, age_summary, gender_counts


def test_ages_are_summed_up():
    metas = [{"age": 17}, {"age": 18.5}, {"age": 80}, {}]
    assert age_summary(metas) == {"people": 3, "youngest": 17, "oldest": 80, "mean": 38.5}
    assert age_counts(metas) == {"0-17": 1, "18-29": 1, "60+": 1, "not given": 1}
    assert gender_counts([{"gender": "x"}, {}]) == {"not given": 1, "x": 1}


@pytest.mark.parametrize("age", [None, "31", True, -1, 201, math.nan, math.inf, -math.inf])
def test_what_is_no_age_is_not_given(age):
    assert age_summary([{"age": age}]) is None
    assert age_counts([{"age": age}]) == {"not given": 1}
