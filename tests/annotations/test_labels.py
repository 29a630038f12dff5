"""The label store: nothing is lost, people stand above suggestions, undo is a record."""

import json
import os
import time
from dataclasses import replace

import pytest

from annotations.labels import (
    AUTOMATIC,
    Label,
    append_label,
    current_labels,
    human_digest,
    labels_of,
    last_event,
    latest_labels,
    make_event,
    make_flag,
    make_mark,
    read_labels,
)
from express50.capture.index import CameraSource, Cue, Index
from express50.contract.layout import Dataset
from express50.errors import AnnotationError, UnknownNameError


def _index(tmp_path):
    source = CameraSource(
        kind="frames", source="cameras/a/frames", width=8, height=8, frames=10,
        pts=tuple(range(0, 100, 10)), dhash=tuple(f"{i:016x}" for i in range(10)), sha256="0",
    )  # fmt: skip
    return Index(
        subject="S1", capture=tmp_path, fps=24.0, cameras={"a": source}, plates={}, board=None,
        calibration=None, cues=(Cue("smile", 2, 6),),
    )  # fmt: skip


def _mark(frame, annotator, when):
    return Label(
        subject="S1", expression="smile", action="mark", annotator=annotator, time=when, frame=frame
    )


def test_mark_stores_the_frame_identity(tmp_path):
    mark = make_mark(_index(tmp_path), "smile", 4, "a", "ann")
    assert (mark.pts, mark.dhash) == (40, f"{4:016x}")
    dataset = Dataset(tmp_path)
    append_label(dataset, mark)
    assert read_labels(dataset, "S1") == [mark]


@pytest.mark.parametrize(
    ("expression", "frame", "camera", "named"),
    [
        ("frown", 4, "a", "frown"),
        ("smile", 7, "a", "frame 7 is outside its cue window; expected 2 to 6"),
        ("smile", 4, "z", "'z'"),
    ],
)
def test_mark_outside_footage_or_cue_is_refused(tmp_path, expression, frame, camera, named):
    with pytest.raises((AnnotationError, UnknownNameError), match=named):
        make_mark(_index(tmp_path), expression, frame, camera, "ann")


def test_person_outranks_a_later_suggestion():
    labels = [_mark(3, "ann", 1.0), _mark(5, AUTOMATIC, 2.0)]
    assert current_labels(labels)["smile"].frame == 3
    assert current_labels(reversed(labels))["smile"].frame == 3


def test_later_person_wins_and_undo_restores_the_earlier_label():
    labels = [_mark(3, "ann", 1.0), _mark(5, "bob", 2.0), _mark(6, "bob", 3.0)]
    assert current_labels(labels)["smile"].frame == 6
    undo = Label(subject="S1", expression="smile", action="undo", annotator="bob", time=4.0)
    assert current_labels([*labels, undo])["smile"].frame == 5
    assert current_labels([*labels, undo, undo])["smile"].frame == 3
    assert current_labels([*labels, undo, undo, undo])["smile"].frame == 3


def test_an_older_label_that_an_import_put_below_is_not_its_annotators_latest():
    new, old, undo = _mark(5, "ann", 2.0), _mark(3, "ann", 1.0), _mark(None, "ann", 3.0)
    assert latest_labels([new, old]) == [new] == [*current_labels([new, old]).values()]
    assert last_event([new, old], "smile", "ann") == new
    undone = [new, replace(undo, action="undo"), old]
    assert labels_of(undone, "ann") == {"smile": old}


def test_a_clock_that_was_ahead_does_not_outlive_what_is_said_next(tmp_path):
    dataset, index = Dataset(tmp_path), _index(tmp_path)
    append_label(dataset, _mark(3, "ann", time.time() + 3600))
    mark = append_label(dataset, make_mark(index, "smile", 5, "a", "ann"))
    assert current_labels(read_labels(dataset, "S1"))["smile"] == mark
    for left in (3, None):
        append_label(dataset, make_event(index, "smile", "undo", "ann"))
        force = current_labels(read_labels(dataset, "S1")).get("smile")
        assert (force and force.frame) == left


def test_automatic_labels_do_not_change_the_human_digest(tmp_path):
    dataset = Dataset(tmp_path)
    before = human_digest(dataset, "S1")
    append_label(dataset, _mark(3, AUTOMATIC, time.time()))
    assert human_digest(dataset, "S1") == before
    append_label(dataset, _mark(3, "ann", time.time()))
    assert human_digest(dataset, "S1") != before


def test_line_that_is_not_an_event_raises_with_its_number(tmp_path):
    dataset = Dataset(tmp_path)
    append_label(dataset, _mark(3, "ann", 1.0))
    with dataset.labels_file("S1").open("a") as file:
        file.write(json.dumps({"subject": "S1"}) + "\n")
    with pytest.raises(AnnotationError, match="line 2"):
        read_labels(dataset, "S1")


def test_adjudication_outranks_later_marks_and_keeps_the_originals(tmp_path):
    index = _index(tmp_path)
    settle = replace(make_mark(index, "smile", 4, "a", "eve"), action="settle")
    labels = [_mark(3, "ann", 1.0), _mark(5, "eve", 2.0), settle, _mark(6, "bob", 9e9)]
    assert current_labels(labels)["smile"] == settle
    assert {who: labels_of(labels, who)["smile"].frame for who in ("ann", "bob", "eve")} == {
        "ann": 3, "bob": 6, "eve": 5,
    }  # fmt: skip
    assert current_labels([*labels, make_event(index, "smile", "undo", "eve")])["smile"].frame == 6


def test_rule_ranks_between_people_and_suggestions():
    labels = [_mark(5, "rule:last-frame", 3.0), _mark(3, AUTOMATIC, 4.0)]
    assert current_labels(labels)["smile"].frame == 5
    assert current_labels([*labels, _mark(4, "ann", 1.0)])["smile"].frame == 4


def test_plateau_and_effort_are_kept(tmp_path):
    index = _index(tmp_path)
    mark = make_mark(index, "smile", 4, "a", "ann", 3, 5)
    mark = replace(mark, seconds=2.5, keys=2, shown=True)
    append_label(Dataset(tmp_path), mark)
    assert read_labels(Dataset(tmp_path), "S1") == [mark]
    for first, last in ((5, 5), (1, None)):  # without the frame; beyond the cue window
        with pytest.raises(AnnotationError):
            make_mark(index, "smile", 4, "a", "ann", first, last)


def test_a_flag_needs_a_reason_and_an_expression(tmp_path):
    index = _index(tmp_path)
    assert make_flag(index, "smile", " failed: blinked ", "ann").reason == "failed: blinked"
    with pytest.raises(AnnotationError, match="smile"):
        make_flag(index, "smile", " ", "ann")
    with pytest.raises(UnknownNameError, match="frown"):
        make_flag(index, "frown", "failed", "ann")


def test_the_umask_decides_who_else_may_label(tmp_path):
    dataset = Dataset(tmp_path)
    before = os.umask(0o002)  # as in folders that a group of annotators shares
    try:
        append_label(dataset, make_flag(_index(tmp_path), "smile", "failed", "ann"))
    finally:
        os.umask(before)
    assert dataset.labels_file("S1").stat().st_mode & 0o777 == 0o664
