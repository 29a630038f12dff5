"""Moves within a cue window."""

from hypothesis import given, settings
from hypothesis import strategies as st

from annotations.ui import task as moves
from annotations.ui.task import open_view


def test_view_opens_on_the_suggestion_or_in_the_middle():
    assert open_view(10, 30, (17, 25)).cursor == 17
    assert open_view(10, 30).cursor == 20
    assert open_view(10, 30, (99, 17, 17)).candidates == (17,)
    assert open_view(10, 30, (17,), cursor=12).cursor == 12


def test_window_of_one_frame_does_not_move():
    view = open_view(7, 7, (7,))
    for move in (
        lambda v: moves.step(v, 10),
        lambda v: moves.step(v, -1),
        lambda v: moves.next_candidate(v, 1),
        lambda v: moves.next_candidate(v, -1),
        lambda v: moves.pick_candidate(v, 4),
    ):
        assert move(view).cursor == 7


def test_next_candidate_cycles_and_returns_after_a_detour():
    view = open_view(0, 50, (20, 30, 10))
    seen = []
    for _ in range(4):
        view = moves.next_candidate(view, 1)
        seen.append(view.cursor)
    assert seen == [30, 10, 20, 30]
    away = moves.step(view, 2)
    assert moves.next_candidate(away, 1).cursor == 30
    assert moves.next_candidate(view, -1).cursor == 20


def test_plateau_ends_can_be_set_moved_and_removed():
    view = moves.set_plateau(open_view(0, 9, (3,)), 0)
    view = moves.set_plateau(moves.step(view, 3), 1)
    assert (view.plateau_first, view.plateau_last) == (3, 6)
    assert moves.set_plateau(view, 1).plateau_last is None
    crossed = moves.set_plateau(moves.step(view, 2), 0)
    assert (crossed.plateau_first, crossed.plateau_last) == (8, None)
    crossed = moves.set_plateau(moves.go_to(view, 1), 1)
    assert (crossed.plateau_first, crossed.plateau_last) == (None, 1)


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
        "[": lambda v, n: moves.set_plateau(v, 0),
        "]": lambda v, n: moves.set_plateau(v, 1),
    }
    for act, number in keys:
        view = acts[act](view, number)
        assert view.first <= view.cursor <= view.last
        if view.plateau_first is not None and view.plateau_last is not None:
            assert view.plateau_first <= view.plateau_last
