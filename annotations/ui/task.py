"""The data of one task: footage, suggestion, reference and labels, read at once."""

from __future__ import annotations

from dataclasses import dataclass

from annotations.labels import Label
from annotations.store import current_labels, labels_of, read_labels
from annotations.suggestions import (
    CanonicalFrame,
    Suggested,
    canonical,
    read_suggestions,
    reference_subject,
)
from annotations.worklist import LabelTask
from express50.capture.expressions import load_script
from express50.capture.index import Index, read_index
from express50.contract.layout import Dataset
from express50.errors import Express50Error


@dataclass(frozen=True, kw_only=True)
class TaskScene:
    """One task, ready to be shown.

    Attributes:
        task: subject, expression and doubt.
        name, description: of the expression.
        index: the subject's footage; None where it cannot be read.
        first, last: the cue window, both inside.
        cameras: camera ids, the one that sees the face best first.
        suggestion: what align suggested; None where it did not run.
        reference: the reference's canonical frame of the expression, None where there is none.
        reference_index: footage of the reference; None where it cannot be read.
        is_reference: whether this subject is the reference itself.
        mine: this annotator's label; None where there is none.
        in_force: the label that stands, whoever gave it.
        problem: why the task cannot be labelled, in plain words.
        notes: what the annotator should know, in plain words.
    """

    task: LabelTask
    name: str
    description: str
    index: Index | None = None
    first: int = 0
    last: int = 0
    cameras: tuple[str, ...] = ()
    suggestion: Suggested | None = None
    reference: CanonicalFrame | None = None
    reference_index: Index | None = None
    is_reference: bool = False
    mine: Label | None = None
    in_force: Label | None = None
    problem: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[str, str]:
        """Subject and expression."""
        return self.task.subject, self.task.expression

    @property
    def candidates(self) -> tuple[int, ...]:
        """Suggested frames, best first."""
        found = self.suggestion
        return () if found is None else (found.frame, *found.candidates)


def load_scene(dataset: Dataset, task: LabelTask, annotator: str) -> TaskScene:
    """Read a task; faults become ``problem`` or ``notes``, not exceptions."""
    name, description = _words(task.expression)
    try:
        return _load(dataset, task, annotator, name, description)
    except (Express50Error, OSError) as error:
        return TaskScene(task=task, name=name, description=description, problem=str(error))


def _load(
    dataset: Dataset, task: LabelTask, annotator: str, name: str, description: str
) -> TaskScene:
    index = read_index(dataset, task.subject)
    cue = next((c for c in index.cues if c.expression_id == task.expression), None)
    last = -1 if cue is None else min(cue.end_frame, index.frames - 1)
    if cue is None or last < cue.start_frame:
        problem = f"{task.subject} has no footage of {task.expression}: see its cues.csv"
        return TaskScene(task=task, name=name, description=description, problem=problem)
    notes: list[str] = []
    suggestion = _suggestion(dataset, task, notes)
    reference, reference_index, is_reference = _reference(dataset, task, notes)
    labels = read_labels(dataset, task.subject)
    mine = labels_of(labels, annotator).get(task.expression)
    in_force = current_labels(labels).get(task.expression)
    notes += [n for label in (mine, in_force) if (n := _identity_note(index, label))]
    return TaskScene(
        task=task,
        name=name,
        description=description,
        index=index,
        first=cue.start_frame,
        last=last,
        cameras=_order_cameras(index, suggestion),
        suggestion=suggestion,
        reference=reference,
        reference_index=reference_index,
        is_reference=is_reference,
        mine=mine,
        in_force=in_force,
        notes=tuple(dict.fromkeys(notes)),
    )


def _words(expression: str) -> tuple[str, str]:
    entry = next((e for e in load_script() if e.id == expression), None)
    if entry is None:
        return expression, "Not in the built-in script: match the reference."
    return entry.name, entry.description


def _suggestion(dataset: Dataset, task: LabelTask, notes: list[str]) -> Suggested | None:
    try:
        found = read_suggestions(dataset, task.subject).get(task.expression)
    except Express50Error as error:
        notes.append(str(error))
        return None
    if found is None:
        notes.append("no suggestion ('express50 align' not run): you start in the window's middle")
    return found


def _reference(
    dataset: Dataset, task: LabelTask, notes: list[str]
) -> tuple[CanonicalFrame | None, Index | None, bool]:
    """Canonical frame, its footage, and whether this task is the reference's own."""
    try:
        is_reference = reference_subject(dataset) == task.subject
        frame = canonical(dataset, task.expression)
        index = None if frame is None else read_index(dataset, frame.subject)
    except Express50Error as error:
        notes.append(str(error))
        return None, None, False
    if frame is None or index is None:
        notes.append("the reference has no frame of this expression yet")
        return None, None, is_reference
    if frame.camera not in index.cameras or not 0 <= frame.frame < index.frames:
        notes.append(f"the reference's frame {frame.frame} of {frame.camera} is not in its footage")
        return None, None, is_reference
    return frame, index, is_reference


def _order_cameras(index: Index, suggestion: Suggested | None) -> tuple[str, ...]:
    """The suggestion's camera first, then the others in their own order from there on."""
    names = list(index.cameras)
    best = suggestion.camera if suggestion is not None else ""
    start = names.index(best) if best in names else 0
    return tuple(names[start:] + names[:start])


def _identity_note(index: Index, label: Label | None) -> str | None:
    """A warning where a label was made on other footage than what lies here now."""
    if label is None or label.frame is None or label.camera is None:
        return None
    source = index.cameras.get(label.camera)
    known = source is not None and 0 <= label.frame < source.frames
    if known and source is not None and source.dhash[label.frame] == label.dhash:
        return None
    return (
        f"{label.annotator}'s frame {label.frame} of {label.camera} is another picture in today's "
        "footage: look again and mark anew"
    )
