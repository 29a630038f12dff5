"""The simulated annotator: the cheapest keys, through the real app."""

import asyncio

import pytest

from annotations.labels import read_labels
from annotations.ui.app import AnnotateApp
from annotations.ui.session import Session
from annotations.ui.task import open_view
from benchmarks.replay import MOVES, cheapest_keys, measure_steps, replay
from express50.errors import AnnotationError


@pytest.mark.parametrize(
    ("frame", "keys"),
    [(20, 0), (21, 0), (22, 1), (24, 3), (27, 1), (30, 1), (31, 1), (45, 5), (99, 1), (0, 1)],
)
def test_cheapest_keys_reach_the_frame_within_the_tolerance(frame, keys):
    view = open_view(5, 80, (20, 28))
    found = cheapest_keys(view, frame, tolerance=1)
    assert len(found) == keys
    for key in found:
        view = MOVES[key](view)
    assert abs(view.cursor - min(max(frame, 5), 80)) <= 1


def test_replay_counts_keys_of_right_and_wrong_suggestions(suggested):
    truth = {
        ("S001", "neutral"): 5, ("S001", "smile"): 27, ("S002", "neutral"): 7,
        ("S002", "jaw_open"): 40,
    }  # fmt: skip
    result = replay(suggested, truth, order="subject", size=(80, 24))
    assert result.keystrokes == [1, 2, 3, 1]
    assert result.errors == [1, 0, 1, 0]
    assert len(result.steps) == 3
    assert result.summary()["keystrokes_per_label_median"] == 1.5
    marks = read_labels(suggested, "S001") + read_labels(suggested, "S002")
    assert [(m.expression, m.frame) for m in marks] == [
        ("neutral", 4), ("smile", 27), ("neutral", 6), ("jaw_open", 40),
    ]  # fmt: skip
    with pytest.raises(AnnotationError):
        replay(suggested, truth, order="subject")


def test_steps_are_measured_over_tasks_cameras_and_zooms(suggested):
    steps = measure_steps(suggested, 12, faces=False, size=(80, 24))
    assert len(steps) == 12
    assert min(steps) > 0
    assert read_labels(suggested, "S001") == []


def test_faces_found_late_are_drawn(suggested):
    class Finder:
        ready = False

        def load(self):
            self.ready = True

        def find(self, subject, camera, frame):
            from annotations.ui.frames import Face

            return Face(0.5, 0.5, 0.2) if self.ready else None

    app = AnnotateApp(Session(suggested, "ann"), faces=Finder())

    async def run():
        async with app.run_test(size=(80, 22)) as pilot:
            for _ in range(100):
                await pilot.pause(0.1)
                if app.desk.query_one("#frame").look.face is not None:
                    return
            pytest.fail("the face was never drawn")

    asyncio.run(run())
