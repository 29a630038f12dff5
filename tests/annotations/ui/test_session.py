"""A session without a screen: order, cost and undo."""

import pytest

from annotations.labels import append_label, labels_of, make_mark, read_labels
from annotations.ui.session import IDLE_SECONDS, Session
from annotations.ui.task import load_scene, set_plateau, step, view_of_scene
from annotations.worklist import LabelTask
from express50.capture.index import read_index
from express50.errors import AnnotationError
from tests.annotations.footage import suggest


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def begin(dataset, **options):
    session = Session(dataset, "ann", order="subject", **options)
    session._clock = Clock()
    session.begin()
    return session, session._clock


def scene_and_view(session):
    scene = load_scene(session.dataset, session.task, session.annotator)
    return scene, view_of_scene(scene, session.hidden(session.task))


def mark(session):
    scene, view = scene_and_view(session)
    label = session.mark(scene, view, scene.cameras[0])
    session.advance()
    return label


def test_accepted_suggestion_costs_one_key_and_its_seconds(suggested):
    session, clock = begin(suggested)
    clock.now += 3.5
    session.press()
    label = mark(session)
    assert (label.frame, label.suggested, label.confidence) == (4, 4, 0.9)
    assert (label.keys, label.seconds, label.shown) == (1, 3.5, True)
    assert read_labels(suggested, "S001") == [label]
    assert session.task.expression == "smile"


def test_effort_counts_earlier_visits_but_not_breaks(suggested):
    session, clock = begin(suggested)
    session.press()
    clock.now += 2
    session.move(1)
    clock.now += 4
    session.move(-1)
    clock.now += 3600
    session.press()
    label = mark(session)
    assert label.keys == 2
    assert label.seconds == 2 + IDLE_SECONDS


def test_undo_returns_to_the_task_and_appends_an_event(suggested):
    session, _ = begin(suggested)
    mark(session)
    mark(session)
    assert session.done == 2
    assert session.undo().expression == "smile"
    assert session.task.expression == "smile"
    assert session.undo().expression == "neutral"
    assert session.done == 0
    assert session.undo() is None
    events = read_labels(suggested, "S001")
    assert [e.action for e in events] == ["mark", "mark", "undo", "undo"]
    assert labels_of(events, "ann") == {}


def test_an_undo_that_cannot_be_written_can_be_repeated(suggested, monkeypatch):
    session, _ = begin(suggested)
    mark(session)
    with monkeypatch.context() as patch:
        patch.setattr("annotations.ui.session.append_label", None)
        with pytest.raises(TypeError):
            session.undo()
    assert session.undo().expression == "neutral"


def test_undo_of_a_second_mark_restores_the_first(suggested):
    session, _ = begin(suggested)
    mark(session)
    session.move(-1)
    scene, view = scene_and_view(session)
    session.mark(scene, step(view, 3), scene.cameras[0])
    session.undo()
    assert labels_of(read_labels(suggested, "S001"), "ann")["neutral"].frame == 4
    assert not session.is_open(session.task)


def test_a_session_resumes_at_the_next_undecided_task(suggested):
    session, _ = begin(suggested)
    mark(session)
    scene, _ = scene_and_view(session)
    session.flag(scene, "occluded")
    again, _ = begin(suggested)
    assert (again.done, again.task.expression) == (2, "jaw_open")
    other = Session(suggested, "bob", order="subject")
    assert (other.done, other.task.expression) == (0, "neutral")


def test_blind_hides_until_the_first_decision(suggested):
    session, _ = begin(suggested, blind=True)
    first = session.task
    assert session.hidden(first)
    label = mark(session)
    assert (label.shown, label.suggested, label.frame) == (False, 4, 7)
    assert not session.hidden(first)
    session.move(-1)
    assert mark(session).shown is True


def test_flagging_every_task_finishes_the_session(suggested):
    session, _ = begin(suggested, subjects=["S002"])
    for _ in range(3):
        scene, _ = scene_and_view(session)
        label = session.flag(scene, "not performed")
        more = session.advance()
    assert (more, label.reason) == (False, "not performed")
    assert session.done == len(session.tasks) == 3


def test_mark_outside_its_plateau_writes_nothing(suggested):
    session, _ = begin(suggested)
    scene, view = scene_and_view(session)
    view = step(set_plateau(step(view, 2), 0), -2)
    with pytest.raises(AnnotationError, match="6 to 15"):
        session.mark(scene, view, scene.cameras[0])
    assert read_labels(suggested, "S001") == []


def test_label_on_other_footage_is_noted(suggested):
    index = read_index(suggested, "S001")
    label = make_mark(index, "smile", 20, "cam00", "ann")
    append_label(suggested, type(label)(**{**vars(label), "dhash": "0" * 16}))
    scene = load_scene(suggested, LabelTask("S001", "smile", 0.1), "ann")
    assert any("frame 20 of cam00" in note for note in scene.notes)


def test_missing_inputs_become_notes_and_problems(dataset):
    scene = load_scene(dataset, LabelTask("S001", "smile", 1.0), "ann")
    assert scene.problem is None
    assert any("align" in note for note in scene.notes)
    assert any("reference" in note for note in scene.notes)
    assert "shout" in load_scene(dataset, LabelTask("S001", "shout", 1.0), "ann").problem
    assert "'S9'" in load_scene(dataset, LabelTask("S9", "smile", 1.0), "ann").problem
    suggest(dataset, {"S001": {"smile": [20]}})
    dataset.suggestions_file("S001").write_text("[")
    assert "suggestions" in " ".join(
        load_scene(dataset, LabelTask("S001", "smile", 1), "ann").notes
    )
