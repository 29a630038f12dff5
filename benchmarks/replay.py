"""Simulate an annotator at the real app: what labels cost in keys and seconds.

The annotator knows the true frames. A frame within the tolerance is accepted; any other is left for
the nearest good one along the path that needs the fewest keys: steps, tens, and suggestions.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from textual.pilot import Pilot

from annotations.labels import Label, labels_of, read_labels
from annotations.ui import task as moves
from annotations.ui.app import AnnotateApp
from annotations.ui.frames import FaceFinder
from annotations.ui.session import Session
from annotations.ui.task import CueView
from express50.contract.layout import Dataset
from express50.errors import AnnotationError

SIZE = (120, 40)
Move = Callable[[CueView], CueView]


MOVES: dict[str, Move] = {
    "right": lambda view: moves.step(view, 1),
    "left": lambda view: moves.step(view, -1),
    "pagedown": lambda view: moves.step(view, 10),
    "pageup": lambda view: moves.step(view, -10),
    "tab": lambda view: moves.next_candidate(view, 1),
    "home": lambda view: moves.go_to(view, view.first),
    "end": lambda view: moves.go_to(view, view.last),
    **{str(rank): partial(moves.pick_candidate, rank=rank) for rank in range(1, 6)},
}
MEASURED_KEYS = ("left", "right", "pageup", "pagedown")


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """What the labels cost."""

    labels: list[Label] = field(default_factory=list)  # the labels that were given, in their order
    keystrokes: list[int] = field(default_factory=list)  # of each label
    # of each label, as the app counted them; a machine's, not a person's
    seconds: list[float] = field(default_factory=list)
    # seconds from each key that moved the cursor to the picture, encoded for a terminal
    steps: list[float] = field(default_factory=list)
    errors: list[int] = field(default_factory=list)  # frames between each mark and the truth

    def summary(self) -> dict[str, float]:
        """Return medians and 95th percentiles; empty lists give no entry."""
        rows: dict[str, float] = {"labels": len(self.labels)}
        if self.keystrokes:
            rows["keystrokes_per_label_median"] = float(np.median(self.keystrokes))
            rows["keystrokes_per_label_mean"] = float(np.mean(self.keystrokes))
        if self.steps:
            rows["seconds_per_frame_step_p95"] = float(np.percentile(self.steps, 95))
        return rows


class MeasuredApp(AnnotateApp):
    """The app, with the time from a key to the bytes that a terminal would get."""

    def __init__(self, session: Session, **options: Any) -> None:
        super().__init__(session, **options)
        self.painted = 0

    def _display(self, screen: Any, renderable: Any) -> None:
        """Encode what is drawn even though no terminal is there, then note the time."""
        super()._display(screen, renderable)
        if hasattr(renderable, "render_segments"):
            renderable.render_segments(self.console).encode()
            self.painted += 1


def replay(
    dataset: Dataset,
    truth: Mapping[tuple[str, str], int],
    tolerance: int = 1,
    *,
    order: str = "doubt",
    size: tuple[int, int] = SIZE,
) -> ReplayResult:
    """Label every task whose truth is known through the real app, without a terminal.

    Args:
        dataset: an ingested dataset; align may have run or not.
        truth: true peak frame by (subject, expression).
        tolerance: frames off that the annotator lets pass.
        order: of the tasks.
        size: of the terminal, columns and rows.

    Raises:
        AnnotationError: no task has a truth.
    """
    session = Session(
        dataset,
        "replay",
        subjects=sorted({subject for subject, _ in truth}),
        expressions=sorted({expression for _, expression in truth}),
        order=order,
    )
    if not any((t.subject, t.expression) in truth and session.is_open(t) for t in session.tasks):
        raise AnnotationError(f"{dataset.root}: no open task has a known truth")
    app = MeasuredApp(session, faces=None)
    return asyncio.run(_label_all(app, truth, tolerance, size))


async def _label_all(
    app: MeasuredApp, truth: Mapping[tuple[str, str], int], tolerance: int, size: tuple[int, int]
) -> ReplayResult:
    result = ReplayResult()
    async with app.run_test(size=size) as pilot:
        await _settle(app, pilot)
        for _ in range(len(app.session.tasks)):
            task = app.session.task
            if task is None or not app.session.is_open(task):
                break
            frame = truth.get((task.subject, task.expression))
            if frame is None:  # not in this replay: look at the next one
                await pilot.press("n")
                continue
            await _label_one(app, pilot, frame, tolerance, result)
    return result


async def _label_one(
    app: MeasuredApp, pilot: Pilot, frame: int, tolerance: int, result: ReplayResult
) -> None:
    task, view = app.session.task, app.desk.view
    if task is None or view is None:
        raise AnnotationError(f"{task} cannot be labelled: it has no footage")
    for key in cheapest_keys(view, frame, tolerance):
        result.steps.append(await timed_press(app, pilot, key))
    await pilot.press("enter")
    said = labels_of(read_labels(app.session.dataset, task.subject), app.session.annotator)
    label = said[task.expression]
    result.labels.append(label)
    result.keystrokes.append(label.keys or 0)
    result.seconds.append(label.seconds or 0.0)
    result.errors.append(abs((label.frame or 0) - frame))


def cheapest_keys(view: CueView, frame: int, tolerance: int) -> list[str]:
    """Find the fewest keys from the cursor to a frame within the tolerance, breadth first."""
    goal = min(max(frame, view.first), view.last)
    seen: dict[CueView, list[str]] = {view: []}
    edge = [view]
    while edge:
        for here in edge:
            if abs(here.cursor - goal) <= tolerance:
                return seen[here]
        following: dict[CueView, list[str]] = {}
        for here in edge:
            for key, move in MOVES.items():
                there = move(here)
                if there not in seen and there not in following:
                    following[there] = [*seen[here], key]
        seen |= following
        edge = list(following)
    raise AnnotationError(f"no keys lead from frame {view.cursor} to {goal}")


async def timed_press(app: MeasuredApp, pilot: Pilot, key: str) -> float:
    """Press a key and wait for what it draws; return seconds until the terminal could have it."""
    before = app.painted
    start = time.perf_counter()
    app.simulate_key(key)
    for _ in range(400):
        if app.painted > before:
            break
        await asyncio.sleep(0.001)
    spent = time.perf_counter() - start
    await pilot.pause()
    return spent


async def _settle(app: MeasuredApp, pilot: Pilot) -> None:
    """Wait until the first task is shown, faces are known and nothing is left to decode."""
    await pilot.pause()
    while app.desk.scene is None or (app.desk.faces is not None and not app.desk.faces.ready):
        await pilot.pause(0.05)
    while not app.cache.idle():
        await pilot.pause(0.02)


def measure_steps(
    dataset: Dataset, presses: int, *, faces: bool = True, size: tuple[int, int] = (160, 48)
) -> list[float]:
    """Return seconds of each of so many steps through a dataset, tasks, cameras and zooms mixed in.

    From the key to the picture encoded for the terminal, decoding included where it was not done
    ahead.
    """
    session = Session(dataset, "measure")
    app = MeasuredApp(session, faces=FaceFinder(dataset) if faces else None)
    return asyncio.run(_scrub(app, presses, size))


async def _scrub(app: MeasuredApp, presses: int, size: tuple[int, int]) -> list[float]:
    rng = np.random.default_rng(0)
    steps: list[float] = []
    async with app.run_test(size=size) as pilot:
        await _settle(app, pilot)
        while len(steps) < presses:
            view = app.desk.view
            if view is None or view.first == view.last or rng.random() < 0.05:
                await pilot.press(str(rng.choice(["n", "p", "c", "z"])))
                continue
            key = str(rng.choice(MEASURED_KEYS))
            if MOVES[key](view) != view:  # at an end there is nothing to draw
                steps.append(await timed_press(app, pilot, key))
    return steps
