"""The reference identity and the order of the work."""

import json

import pytest

from annotations.labels import AUTOMATIC, Label, append_label, make_flag, make_mark
from annotations.suggestions import canonical, choose_reference, read_suggestions, reference_subject
from annotations.worklist import worklist
from express50.capture.index import read_index
from express50.contract.layout import exclusion_reason, included_subjects
from express50.errors import AnnotationError, FormatError, UnknownNameError
from tests.annotations.labelled import make_dataset, suggest


def _mark(dataset, subject, expression, frame, who):
    append_label(dataset, make_mark(read_index(dataset, subject), expression, frame, "a", who))


def _exclude(dataset, subject, action="exclude"):
    append_label(
        dataset,
        Label(subject=subject, expression="", action=action, annotator="ann", time=1.0,
              reason="heavy makeup"),
    )  # fmt: skip


def test_canonical_frame_is_the_label_or_else_the_suggestion_of_the_reference(tmp_path):
    dataset = make_dataset(tmp_path)
    assert canonical(dataset, "smile") is None
    suggest(dataset, "S001", {"smile": (14, 0.8)})
    assert (canonical(dataset, "smile").frame, canonical(dataset, "smile").by) == (14, "suggestion")
    _mark(dataset, "S001", "smile", 15, "ann")
    assert (canonical(dataset, "smile").frame, canonical(dataset, "smile").by) == (15, "ann")
    append_label(dataset, make_flag(read_index(dataset, "S001"), "smile", "failed", "ann"))
    assert canonical(dataset, "smile") is None


def test_reference_is_the_chosen_or_first_included_subject(tmp_path):
    dataset = make_dataset(tmp_path, ("S001", "S002", "S003"))
    assert reference_subject(dataset) == "S001"
    _exclude(dataset, "S001")
    assert reference_subject(dataset) == "S002"
    choose_reference(dataset, "S003")
    assert reference_subject(dataset) == "S003"
    with pytest.raises(UnknownNameError, match="S002, S003"):
        choose_reference(dataset, "S001")
    _exclude(dataset, "S003")
    with pytest.raises(AnnotationError, match="'S003'"):
        reference_subject(dataset)


def test_later_inclusion_ends_an_exclusion(tmp_path):
    dataset = make_dataset(tmp_path)
    assert exclusion_reason(dataset, "S002") is None
    _exclude(dataset, "S002")
    assert exclusion_reason(dataset, "S002") == "heavy makeup"
    assert included_subjects(dataset) == ["S001"]
    assert {t.subject for t in worklist(dataset, "ann")} == {"S001"}
    _exclude(dataset, "S002", "include")
    assert included_subjects(dataset) == ["S001", "S002"]


def test_the_latest_event_decides_though_an_import_put_an_older_one_below(tmp_path):
    dataset = make_dataset(tmp_path)
    for action, when in (("include", 200.0), ("exclude", 100.0)):
        event = Label(
            subject="S001", expression="", action=action, annotator="ann", time=when, reason="old"
        )
        append_label(dataset, event, imported=True)
    assert exclusion_reason(dataset, "S001") is None


def test_worklist_orders(tmp_path):
    dataset = make_dataset(tmp_path, ("S001", "S002", "S003"))
    choose_reference(dataset, "S002")
    for subject, sure in (("S001", 0.9), ("S002", 0.99), ("S003", 0.2)):
        suggest(dataset, subject, {"smile": (14, sure), "neutral": (3, 0.95)})
    order = [(t.subject, t.expression) for t in worklist(dataset, "ann")]
    assert order == [
        ("S002", "wink_left"), ("S002", "neutral"), ("S002", "smile"),
        ("S001", "wink_left"), ("S003", "wink_left"), ("S003", "smile"), ("S001", "smile"),
        ("S001", "neutral"), ("S003", "neutral"),
    ]  # fmt: skip
    by_expression = [(t.expression, t.subject) for t in worklist(dataset, "a", order="expression")]
    assert by_expression[:3] == [("neutral", "S002"), ("neutral", "S001"), ("neutral", "S003")]
    by_subject = [t.subject for t in worklist(dataset, "a", order="subject")]
    assert by_subject == ["S002"] * 3 + ["S001"] * 3 + ["S003"] * 3


def test_expressions_stay_together_when_a_subject_lacks_one(tmp_path):
    dataset = make_dataset(tmp_path)
    path = dataset.index_file("S002")
    index = json.loads(path.read_text())
    path.write_text(json.dumps(index | {"cues": index["cues"][1:]}))  # without neutral
    order = [(t.expression, t.subject) for t in worklist(dataset, "ann", order="expression")]
    assert order == [
        ("neutral", "S001"), ("smile", "S001"), ("smile", "S002"), ("wink_left", "S001"),
        ("wink_left", "S002"),
    ]  # fmt: skip


def test_only_labels_of_the_annotator_count_as_done(tmp_path):
    dataset = make_dataset(tmp_path)
    _mark(dataset, "S001", "smile", 15, "ann")
    _mark(dataset, "S001", "neutral", 5, AUTOMATIC)
    assert [t.expression for t in worklist(dataset, "ann", ["S001"])] == ["neutral", "wink_left"]
    assert len(worklist(dataset, "bob")) == 6
    assert len(worklist(dataset, "ann", everything=True)) == 6
    assert [t.subject for t in worklist(dataset, "ann", expressions=["smile"])] == ["S002"]


def test_unknown_subject_or_file_raises_with_its_name(tmp_path):
    dataset = make_dataset(tmp_path)
    with pytest.raises(UnknownNameError, match="'S009'"):
        worklist(dataset, "ann", ["S009"])
    suggest(dataset, "S001", {})
    dataset.suggestions_file("S001").write_text('{"smile": {"x": 1}}')
    with pytest.raises(FormatError, match="suggestions.json"):
        read_suggestions(dataset, "S001")
