"""Annotation at its limits: nothing to compare, huge numbers, no number, no room, no pixels."""

import asyncio
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from textual.geometry import Size

from annotations.align.stage import accept_sure
from annotations.labels import append_label, make_mark, read_labels
from annotations.sheet import make_sheet, render_sheet
from annotations.suggestions import Suggested, read_suggestions
from annotations.ui import task as moves
from annotations.ui.app import AnnotateApp
from annotations.ui.panes import (
    GUTTER,
    StripContent,
    column_of,
    draw_strip,
    frame_at,
    frames_ahead,
)
from annotations.ui.session import Session
from annotations.ui.task import open_view
from annotations.validate import (
    MarkedClip,
    agreement,
    by_expression,
    by_pair,
    clip_times,
    disagreements,
    marked_clips,
    problems,
)
from annotations.worklist import coverage, worklist
from benchmarks.replay import cheapest_keys
from express50.__main__ import main
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.errors import FormatError
from tests.annotations.labelled import make_dataset, suggest
from tests.stages import ingest_captures
from tests.synth import make_capture

DAY = 60 * 86400  # frames of a day at 60 a second


def clips_of(*frames, start=0, length=24):
    return [
        MarkedClip("S1", f"e{n}", start, length, dict(zip("abcdef", row, strict=False)))
        for n, row in enumerate(frames)
    ]


@pytest.mark.parametrize("clips", [[], clips_of((3,)), clips_of((), (5,))])
def test_agreement_needs_two_annotators(clips):
    found = agreement(clips)
    assert (found["clips"], found["pairs"], found["alpha"], found["within_1"]) == (0, 0, None, None)
    assert by_pair(clips) == {}
    assert all(row["alpha"] is None for row in by_expression(clips).values())


def test_equal_marks_have_no_alpha_but_agree():
    found = agreement(clips_of((4, 4), (4, 4, 4), (4, 4)))
    assert (found["alpha"], found["alpha_interval"]) == (None, None)
    assert (found["within_1"], found["median_frames"], found["slip_rate"]) == (1.0, 0.0, 0.0)


def test_clips_marked_once_do_not_count():
    with_lone = agreement(clips_of((4, 5), (9,), (14, 14)))
    assert with_lone == agreement(
        [c for c in clips_of((4, 5), (9,), (14, 14)) if len(c.frames) > 1]
    )
    assert with_lone["clips"] == 2


def test_difference_of_a_frame_in_a_day_long_clip_gives_negative_alpha():
    start = 10**15
    marks = [(start + 5, start + 6), (start + 5, start + 6), (start + 6, start + 5)]
    found = agreement(clips_of(*marks, start=start, length=DAY))
    assert found["alpha"] is not None and found["alpha"] < 0.0


@pytest.mark.parametrize("length", [-3, 0, 1])
def test_a_clip_without_length_gives_numbers(length):
    clip = MarkedClip("S1", "e", 7, length, {"a": 7, "b": 7})
    assert np.isfinite(clip_times(clip)).all()
    assert agreement([clip])["within_1"] == 1.0


marks = st.lists(st.lists(st.integers(0, 23), min_size=1, max_size=4), min_size=1, max_size=6)


@settings(deadline=None, max_examples=12)
@given(frames=marks, start=st.sampled_from([0, 1, 10**6, 2**40]))
def test_agreement_depends_neither_on_where_the_clip_starts_nor_on_who_is_named_first(
    frames, start
):
    here = agreement(clips_of(*frames))
    moved = [[f + start for f in row] for row in frames]
    assert agreement(clips_of(*moved, start=start)) == here
    turned = agreement(clips_of(*(row[::-1] for row in frames)))
    assert turned["alpha"] == pytest.approx(here["alpha"], abs=1e-3) and (
        turned["pairs"] == here["pairs"]
    )
    if here["pairs"]:
        assert 0 <= here["within_1"] <= here["within_2"] <= here["within_4"] <= 1
        assert here["alpha"] is None or here["alpha"] <= 1


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, -0.1, 1.5])
def test_confidence_outside_zero_to_one_is_refused(tmp_path, wrong, capsys):
    dataset = make_dataset(tmp_path / "data")
    suggest(dataset, "S001", {"smile": (14, wrong)})
    with pytest.raises(FormatError, match="smile: confidence|NaN or infinite"):
        read_suggestions(dataset, "S001")
    assert main(["annotate", "next", str(dataset.root)]) == 1
    assert "express50 align" in capsys.readouterr().err
    note = make_sheet(dataset).notes[0]  # and the sheet is made all the same
    assert (
        "smile: confidence" in note or "NaN or infinite" in note
    )  # and the sheet is made all the same


def test_curve_with_nan_is_refused(tmp_path):
    dataset = make_dataset(tmp_path / "data")
    suggest(dataset, "S001", {"smile": (14, 0.5)})
    path = dataset.suggestions_file("S001")
    path.write_text(path.read_text().replace("[1.0]", "[1.0, NaN]"))
    with pytest.raises(FormatError, match="line .* NaN, which is NaN or infinite"):
        read_suggestions(dataset, "S001")


def test_capture_without_cues_has_no_tasks_or_problems(tmp_path):
    dataset = make_dataset(tmp_path / "data", expressions=())
    assert worklist(dataset, "ann") == []
    assert problems(dataset) == [] and disagreements(dataset) == [] and marked_clips(dataset) == []
    assert coverage(dataset)["cells"] == {"S001": {}, "S002": {}}
    sheet = make_sheet(dataset)
    assert sheet.rows == [] and sum(sheet.counts().values()) == 0
    assert "0 expressions" in render_sheet(dataset, sheet)
    assert Session(dataset, "ann").task is None


windows = st.tuples(st.integers(0, 10**9), st.integers(1, 3000))


@settings(deadline=None, max_examples=40)
@given(window=windows, width=st.integers(1, 250), height=st.integers(1, 12), data=st.data())
def test_strip_fits_any_window_and_size(window, width, height, data):
    first, count = window
    cursor = first + data.draw(st.integers(0, count - 1))
    view = open_view(first, first + count - 1, (cursor,))
    curve = tuple(np.sin(np.arange(count) / 7.0).tolist())
    content = StripContent(view=view, activity=curve, match=curve)
    lines = draw_strip(content, width, height)
    assert len(lines) <= height
    assert {line.cell_length for line in lines} == {max(width, GUTTER) if width > GUTTER else width}
    if width > GUTTER:
        room = width - GUTTER
        assert 0 <= column_of(view, cursor, room) < room
        under = frame_at(view, column_of(view, cursor, room), room)
        assert under <= cursor <= under + math.ceil(count / room)


def test_long_window_decodes_ahead_within_bounds():
    view = open_view(500, 1499, (700, 1300))
    ahead = frames_ahead(view)
    assert len(ahead) == len(set(ahead)) == 64 and {700, 1300} <= set(ahead)
    assert min(ahead) >= 500
    assert cheapest_keys(view, 1498, tolerance=1) == ["end"]
    assert cheapest_keys(view, 1000, tolerance=1) == ["pagedown"] * 30
    assert moves.step(view, 10**12).cursor == 1499
    assert moves.step(view, -(10**12)).cursor == 500


@pytest.fixture(scope="module")
def speck(tmp_path_factory):
    """Two subjects filmed with 5 x 5 pixels."""
    root = tmp_path_factory.mktemp("speck")
    captures = [root / subject for subject in ("S001", "S002")]
    for path in captures:
        make_capture(path, subject=path.name, cameras=1, frames=6, size=5, plates=False)
    return ingest_captures(root / "dataset", *captures)


@pytest.mark.parametrize("cell", [None, Size(7, 15)])
@pytest.mark.parametrize("size", [(1, 1), (2, 3), (30, 10)])
def test_app_with_tiny_frames_and_terminals(speck, tmp_path, cell, size):
    dataset = Dataset(tmp_path)
    for name in ("ingest", "captures.json"):
        (tmp_path / name).symlink_to(speck.root / name)
    session = Session(dataset, "ann", order="subject")
    app = AnnotateApp(session, sixel_cell=cell)

    async def run():
        async with app.run_test(size=size) as pilot:
            await pilot.press("right", "z", "question_mark", "x", "enter")
            await pilot.pause()

    asyncio.run(run())
    (label,) = read_labels(dataset, "S001")
    assert (label.frame, label.expression) == (2, "neutral")


def test_sheet_of_tiny_frames(speck, tmp_path):
    dataset = Dataset(tmp_path)
    for name in ("ingest", "captures.json"):
        (tmp_path / name).symlink_to(speck.root / name)
    append_label(dataset, make_mark(read_index(dataset, "S001"), "smile", 5, "cam00", "ann"))
    file = tmp_path / "sheet.html"
    assert main(["annotate", "sheet", str(tmp_path), str(file), "--around", "1000000"]) == 0
    assert 'data-count="3"' in file.read_text()  # the window's, not a million


def test_huge_frame_numbers_survive_the_store(tmp_path):
    dataset = make_dataset(tmp_path / "data", subjects=("S001",))
    mark = make_mark(read_index(dataset, "S001"), "smile", 14, "a", "ann")
    huge = type(mark)(**vars(mark) | {"frame": 2**62, "pts": -(2**63), "time": 1e300})
    append_label(dataset, huge)
    assert read_labels(dataset, "S001") == [huge]
    assert {p.kind for p in problems(dataset)} == {"window", "identity", "coverage"}
    sheet = make_sheet(dataset)
    tile = next(t for row in sheet.rows for t in row.tiles if t.expression == "smile")
    assert tile.doubtful and "other footage" in tile.words
    assert json.loads(dataset.labels_file("S001").read_text())["frame"] == 2**62


def test_a_new_label_mends_one_that_the_footage_no_longer_fits(tmp_path):
    """Labels stay in the file when a capture is replaced; only those in use are compared."""
    dataset = make_dataset(tmp_path, subjects=("S001",))
    index = read_index(dataset, "S001")
    cue = index.cues[0]
    good = make_mark(index, cue.expression_id, cue.start_frame, "a", "ann")

    def identities():
        return sum(problem.kind == "identity" for problem in problems(dataset))

    append_label(dataset, replace(good, dhash="f" * 16))
    assert identities() == 1
    append_label(dataset, good)
    assert identities() == 0


def test_automatic_labels_follow_the_footage_at_the_same_frame(tmp_path):
    dataset = make_dataset(tmp_path, subjects=("S001",))
    index = read_index(dataset, "S001")
    cue = index.cues[0]
    frame = cue.start_frame
    suggested = Suggested(
        frame=frame, camera="a", confidence=1.0, start=frame, activity=[1.0], candidates=[frame]
    )
    sure = {cue.expression_id: suggested}
    accept_sure(dataset, index, sure, 0.0)
    accept_sure(dataset, index, sure, 0.0)
    assert len(read_labels(dataset, "S001")) == 1
    source = index.cameras["a"]
    other = replace(source, dhash=tuple("f" * 16 for _ in source.dhash))
    accept_sure(dataset, replace(index, cameras={**index.cameras, "a": other}), sure, 0.0)
    assert [label.dhash for label in read_labels(dataset, "S001")][1:] == ["f" * 16]
