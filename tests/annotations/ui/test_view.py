"""Moves within a cue window."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotations.ui import task as moves
from annotations.ui.task import CueView, open_view


def test_a_task_opens_on_the_suggestion_else_in_the_middle():
    assert open_view(10, 30, (17, 25)).cursor == 17
    assert open_view(10, 30).cursor == 20
    assert open_view(10, 30, (99, 17, 17)).candidates == (17,)
    assert open_view(10, 30, (17,), cursor=12).cursor == 12


def test_a_window_of_one_frame_stays_where_it_is():
    view = open_view(7, 7, (7,))
    for move in (
        lambda v: moves.step(v, 10),
        lambda v: moves.step(v, -1),
        lambda v: moves.next_candidate(v, 1),
        lambda v: moves.next_candidate(v, -1),
        lambda v: moves.pick_candidate(v, 4),
    ):
        assert move(view).cursor == 7


def test_tab_goes_round_the_candidates_and_back_to_the_last_one_after_a_detour():
    view = open_view(0, 50, (20, 30, 10))
    seen = []
    for _ in range(4):
        view = moves.next_candidate(view, 1)
        seen.append(view.cursor)
    assert seen == [30, 10, 20, 30]
    away = moves.step(view, 2)
    assert moves.next_candidate(away, 1).cursor == 30
    assert moves.next_candidate(view, -1).cursor == 20


def test_plateau_keys_set_move_and_take_back():
    view = moves.set_plateau_first(open_view(0, 9, (3,)))
    view = moves.set_plateau_last(moves.step(view, 3))
    assert (view.plateau_first, view.plateau_last) == (3, 6)
    assert moves.plateau_problem(view) is None
    assert "3 to 6" in moves.plateau_problem(moves.step(view, 1))
    assert moves.set_plateau_last(view).plateau_last is None
    crossed = moves.set_plateau_first(moves.step(view, 2))
    assert (crossed.plateau_first, crossed.plateau_last) == (8, None)
    crossed = moves.set_plateau_last(moves.go_to(view, 1))
    assert (crossed.plateau_first, crossed.plateau_last) == (None, 1)


def test_a_cursor_outside_its_window_is_refused():
    with pytest.raises(ValueError, match="2 to 5"):
        CueView(first=2, last=5, cursor=6)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 50), st.integers(0, 60), st.lists(st.integers(-5, 120), max_size=5),
    st.lists(st.tuples(st.sampled_from("stcp[]"), st.integers(-12, 12)), max_size=25),
)  # fmt: skip
def test_no_sequence_of_keys_leaves_the_window(first, length, candidates, keys):
    view = open_view(first, first + length, tuple(candidates))
    acts = {
        "s": moves.step,
        "t": moves.next_candidate,
        "c": lambda v, n: moves.go_to(v, v.cursor * n),
        "p": moves.pick_candidate,
        "[": lambda v, n: moves.set_plateau_first(v),
        "]": lambda v, n: moves.set_plateau_last(v),
    }
    for act, number in keys:
        view = acts[act](view, number)
        assert view.first <= view.cursor <= view.last
        if view.plateau_first is not None and view.plateau_last is not None:
            assert view.plateau_first <= view.plateau_last
