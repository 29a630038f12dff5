"""Hold an annotator's session: the open task, the decisions, and what they cost.

No screen is needed: the app calls this, and so do tests. A decision is on disk, synced, when
``mark`` or ``flag`` returns.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass, replace

from annotations.labels import (
    Label,
    append_label,
    labels_of,
    last_event,
    make_event,
    make_flag,
    make_mark,
    read_labels,
)
from annotations.ui.task import CueView, TaskScene
from annotations.worklist import LabelTask, worklist
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.errors import AnnotationError

IDLE_SECONDS = 60.0  # a longer pause between two keys is a break, and counts as this


@dataclass
class Effort:
    """Cost of a label so far: keystrokes, and seconds without breaks."""

    keys: int = 0
    seconds: float = 0.0


class Session:
    """Tasks in order, the one that is open, decisions and their cost.

    A session begins with the first task that the annotator has not decided.
    """

    def __init__(
        self,
        dataset: Dataset,
        annotator: str,
        *,
        subjects: Collection[str] | None = None,
        expressions: Collection[str] | None = None,
        order: str = "doubt",
        blind: bool = False,
    ) -> None:
        """Open a session over a dataset; ``blind`` hides suggestions until a decision."""
        self.dataset = dataset
        self.annotator = annotator
        self.blind = blind
        self.tasks = worklist(dataset, annotator, subjects, expressions, order, everything=True)
        said = {subject: self._said(subject) for subject in {task.subject for task in self.tasks}}
        self._open = {task.key for task in self.tasks if task.expression not in said[task.subject]}
        self._efforts: defaultdict[int, Effort] = defaultdict(Effort)  # by position
        self._decided: list[int] = []
        self._clock = time.monotonic
        self._last_key = self._clock()
        self.position = next((n for n, t in enumerate(self.tasks) if t.key in self._open), 0)

    @property
    def task(self) -> LabelTask | None:
        """Return the open task; None when there are none at all."""
        return self.tasks[self.position] if self.tasks else None

    @property
    def done(self) -> int:
        """Number of tasks this annotator has decided, in this session and before."""
        return len(self.tasks) - len(self._open)

    def is_open(self, task: LabelTask) -> bool:
        """Return whether the annotator has not decided a task."""
        return task.key in self._open

    def hidden(self, task: LabelTask) -> bool:
        """Return whether suggestions and others' marks are hidden from the annotator."""
        return self.blind and self.is_open(task)

    def begin(self) -> None:
        """Start the clock: the first task is on the screen."""
        self._last_key = self._clock()

    def effort(self) -> Effort:
        """Sum the cost of the open task so far, with the time since the last key."""
        spent = self._efforts[self.position]
        return Effort(spent.keys, spent.seconds + self._since_last_key())

    def press(self) -> None:
        """Count a keystroke, and the time since the last one, for the open task."""
        self._book()
        self._efforts[self.position].keys += 1

    def _since_last_key(self) -> float:
        return min(max(self._clock() - self._last_key, 0.0), IDLE_SECONDS)

    def move(self, by: int) -> bool:
        """Open a neighbouring task, decided or not; False at either end."""
        target = self.position + by
        if not 0 <= target < len(self.tasks):
            return False
        self._go(target)
        return True

    def advance(self) -> bool:
        """Open the next undecided task, wrapping at the end; False if none is left."""
        target = self.following(1)
        if not target:
            return False
        self._go(target[0])
        return True

    def following(self, count: int) -> list[int]:
        """List the positions of the undecided tasks after the open one, wrapping at the end."""
        total = len(self.tasks)
        order = [(self.position + n) % total for n in range(1, total + 1)] if total else []
        return [n for n in order if self.tasks[n].key in self._open][:count]

    def _go(self, position: int) -> None:
        self._book()
        self.position = position

    def _book(self) -> None:
        """Add the time since the last key to the open task's cost."""
        self._efforts[self.position].seconds += self._since_last_key()
        self._last_key = self._clock()

    def mark(self, scene: TaskScene, view: CueView, camera: str) -> Label:
        """Mark the frame under the cursor; it is on disk when this returns.

        Raises:
            AnnotationError: the task has no footage, or the plateau leaves the frame out.
        """
        if scene.index is None:
            raise AnnotationError(scene.problem or "this task has no footage")
        label = make_mark(
            scene.index, scene.task.expression, view.cursor, camera, self.annotator,
            view.plateau_first, view.plateau_last,
        )  # fmt: skip
        found = scene.suggestion
        if found is not None:
            label = replace(label, suggested=found.frame, confidence=found.confidence)
        shown = found is not None and not self.hidden(scene.task)
        return self._save(replace(label, shown=shown))

    def flag(self, scene: TaskScene, reason: str) -> Label:
        """Flag the open task as having no usable peak; the flag is on disk when this returns.

        Raises:
            AnnotationError: the task has no footage, or the reason is empty.
        """
        if scene.index is None:
            raise AnnotationError(scene.problem or "this task has no footage")
        return self._save(make_flag(scene.index, scene.task.expression, reason, self.annotator))

    def _save(self, label: Label) -> Label:
        """Append a decision on the open task with what it cost."""
        self._book()
        spent = self._efforts[self.position]
        label = replace(label, seconds=round(spent.seconds, 2), keys=spent.keys)
        label = append_label(self.dataset, label)
        self._decided.append(self.position)
        self._open.discard(self.tasks[self.position].key)
        del self._efforts[self.position]
        return label

    def undo(self) -> Label | None:
        """Undo the annotator's last decision of this session, else that on the open task.

        The task it was about becomes the open one. Return what was taken back, which is a
        settlement where the annotator gave one since; None when there is nothing.
        """
        target = self._decided[-1] if self._decided else self.position
        if not self.tasks:
            return None
        task = self.tasks[target]
        if task.expression not in self._said(task.subject):
            del self._decided[-1:]
            return None
        index = read_index(self.dataset, task.subject)
        last = last_event(read_labels(self.dataset, task.subject), task.expression, self.annotator)
        append_label(self.dataset, make_event(index, task.expression, "undo", self.annotator))
        del self._decided[-1:]  # only now: it may not have been possible to write
        if task.expression not in self._said(task.subject):
            self._open.add(task.key)
        self._go(target)
        return last

    def _said(self, subject: str) -> dict[str, Label]:
        return labels_of(read_labels(self.dataset, subject), self.annotator)
