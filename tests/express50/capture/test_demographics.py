"""Counts of people: only what captures state as a number, nobody twice."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from express50.capture.demographics import (
    OTHERS,
    age_counts,
    gender_counts,
    mean_age,
    public_meta,
    shown_counts,
)


def test_ages_are_summed_up():
    metas = [{"age": 17}, {"age": 18.5}, {"age": 80}, {}]
    assert mean_age(metas) is None and mean_age(metas, 3) == (38.5, 3)
    assert age_counts(metas) == {"0-17": 1, "18-29": 1, "60+": 1, "not given": 1}
    assert gender_counts([{"gender": "x"}, {}]) == {"not given": 1, "x": 1}


@pytest.mark.parametrize(
    ("counts", "shown"),
    [
        ({"f": 4}, {}),
        ({"f": 5}, {"f": 5}),
        ({"f": 29, "m": 21}, {"f": 29, "m": 21}),
        ({"f": 9, "m": 4}, {}),  # thirteen people and nine women would say four men
        ({"f": 9, "m": 6, "x": 1}, {"f": 9, OTHERS: 7}),
        ({"f": 9, "m": 4, "not given": 2}, {"f": 9, OTHERS: 6}),
        ({"not given": 80}, {}),
    ],
)
def test_groups_under_five_are_not_counted_and_cannot_be_inferred_by_subtraction(counts, shown):
    assert shown_counts(counts) == shown


@given(st.dictionaries(st.sampled_from(["a", "b", "c", "d", "not given"]), st.integers(0, 12)))
def test_every_shown_count_is_of_five_and_all_are_accounted_for(counts):
    shown = shown_counts(counts)
    assert all(n >= 5 for n in shown.values())
    assert sum(shown.values()) in (0, sum(counts.values()))


def test_only_known_keys_of_a_capture_go_on():
    meta = {"subject": "S1", "licence": "x", "name": "Jane", "age": 3, "note": "Jane's cousin"}
    assert public_meta(meta) == {"subject": "S1", "licence": "x"}


@pytest.mark.parametrize("age", [None, "31", True, -1, 201, math.nan, math.inf, -math.inf])
def test_what_is_not_an_age_counts_as_not_given(age):
    assert mean_age([{"age": age}], 1) is None
    assert age_counts([{"age": age}]) == {"not given": 1}
