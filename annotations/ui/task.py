"""Hold the state of one task: its data, and the position in its cue window.

``load_scene`` reads footage, suggestion, reference and labels at once. The functions of a
``CueView`` are pure: each takes a view and returns another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from annotations.labels import Label, current_labels, labels_of, lost_frame, read_labels
from annotations.suggestions import (
    CanonicalFrame,
    Suggested,
    canonical,
    read_suggestions,
    reference_subject,
)
from annotations.worklist import LabelTask
from express50.capture.expressions import expression_words
from express50.capture.index import Index, read_index
from express50.contract.layout import Dataset
from express50.errors import Express50Error


@dataclass(frozen=True, kw_only=True)
class TaskScene:
    """One task, ready to be shown."""

    task: LabelTask  # subject, expression and doubt
    name: str  # of the expression
    description: str  # of the expression
    index: Index | None = None  # the subject's footage; None if it cannot be read
    first: int = 0  # frame of the cue window
    last: int = 0  # frame of the cue window, inclusive
    cameras: tuple[str, ...] = ()  # ids from the suggestion's on, which sees the face best
    suggestion: Suggested | None = None  # what align suggested; None if it did not run
    reference: CanonicalFrame | None = None  # the reference's frame of the expression
    reference_index: Index | None = None  # the reference's footage; None if it cannot be read
    is_reference: bool = False  # whether this subject is the reference itself
    mine: Label | None = None  # this annotator's label, or None
    in_force: Label | None = None  # the label in force, whoever gave it
    problem: str | None = None  # why the task cannot be labelled, in plain words
    notes: tuple[str, ...] = ()  # what the annotator should know, in plain words


def load_scene(dataset: Dataset, task: LabelTask, annotator: str) -> TaskScene:
    """Read a task; faults become ``problem`` or ``notes``, not exceptions."""
    name, description = expression_words(task.expression)
    description = description or "Not in the built-in script: match the reference."
    scene = TaskScene(task=task, name=name, description=description)
    try:
        return _load(dataset, scene, annotator)
    except (Express50Error, OSError) as error:
        return replace(scene, problem=str(error))


def _load(dataset: Dataset, scene: TaskScene, annotator: str) -> TaskScene:
    task = scene.task
    index = read_index(dataset, task.subject)
    cue = next((c for c in index.cues if c.expression_id == task.expression), None)
    last = -1 if cue is None else min(cue.end_frame, index.frames - 1)
    if cue is None or last < cue.start_frame:
        problem = f"{task.subject} has no footage of {task.expression}: see its cues.csv"
        return replace(scene, problem=problem)
    notes: list[str] = []
    suggestion = _suggestion(dataset, task, notes)
    reference, reference_index, is_reference = _reference(dataset, task, notes)
    labels = read_labels(dataset, task.subject)
    mine = labels_of(labels, annotator).get(task.expression)
    in_force = current_labels(labels).get(task.expression)
    notes += [
        f"{label.annotator}'s frame {label.frame} of {label.camera} shows another picture in the "
        "present footage: look and mark again"
        for label in (mine, in_force)
        if label is not None and label.frame is not None and lost_frame(index, label)
    ]
    names = list(index.cameras)
    best = names.index(suggestion.camera) if suggestion and suggestion.camera in names else 0
    return replace(
        scene,
        index=index,
        first=cue.start_frame,
        last=last,
        cameras=tuple(names[best:] + names[:best]),
        suggestion=suggestion,
        reference=reference,
        reference_index=reference_index,
        is_reference=is_reference,
        mine=mine,
        in_force=in_force,
        notes=tuple(dict.fromkeys(notes)),
    )


def _suggestion(dataset: Dataset, task: LabelTask, notes: list[str]) -> Suggested | None:
    try:
        found = read_suggestions(dataset, task.subject).get(task.expression)
    except Express50Error as error:
        notes.append(str(error))
        return None
    if found is None:
        notes.append("no suggestion ('express50 align' has not run): starting in mid-window")
    return found


def _reference(
    dataset: Dataset, task: LabelTask, notes: list[str]
) -> tuple[CanonicalFrame | None, Index | None, bool]:
    """Return the canonical frame, its footage, and whether this task is the reference's own."""
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


@dataclass(frozen=True, kw_only=True)
class CueView:
    """Position within one task."""

    first: int  # frame of the cue window
    last: int  # frame of the cue window, inclusive
    cursor: int  # the frame that is shown
    candidates: tuple[int, ...] = ()  # suggested frames, best first, where they are known and shown
    candidate: int = 0  # which of them was visited last
    plateau_first: int | None = None  # start of the plateau, if it was set
    plateau_last: int | None = None  # end of the plateau, if it was set


def open_view(
    first: int, last: int, candidates: tuple[int, ...] = (), cursor: int | None = None
) -> CueView:
    """Open a view on the given frame, else on the best candidate, else in the window's middle."""
    inside = tuple(dict.fromkeys(c for c in candidates if first <= c <= last))
    if cursor is None or not first <= cursor <= last:
        cursor = inside[0] if inside else (first + last) // 2
    return CueView(first=first, last=last, cursor=cursor, candidates=inside)


def view_of_scene(scene: TaskScene, hidden: bool) -> CueView | None:
    """Open a task on the annotator's own mark, else on the suggestion, else in the middle."""
    if scene.index is None:
        return None
    mine, found = scene.mine, None if hidden else scene.suggestion
    candidates = (found.frame, *found.candidates) if found else ()
    view = open_view(scene.first, scene.last, candidates, mine.frame if mine else None)
    return view if mine is None else replace(view, plateau_first=mine.first, plateau_last=mine.last)


def go_to(view: CueView, frame: int) -> CueView:
    """Move to a frame; the cursor stops at the window's ends."""
    return replace(view, cursor=min(max(frame, view.first), view.last))


def step(view: CueView, by: int) -> CueView:
    """Move by some frames."""
    return go_to(view, view.cursor + by)


def next_candidate(view: CueView, by: int) -> CueView:
    """Move to the next (1) or previous (-1) candidate, wrapping around."""
    if not view.candidates:
        return view
    # Away from every candidate the first press returns to the one visited last.
    away = view.cursor not in view.candidates
    here = view.candidate if away else view.candidates.index(view.cursor)
    place = here if away and by > 0 else (here + by) % len(view.candidates)
    return pick_candidate(view, place + 1)


def pick_candidate(view: CueView, rank: int) -> CueView:
    """Move to a candidate by its rank, 1 the best; without one, stay."""
    if not 1 <= rank <= len(view.candidates):
        return view
    return replace(go_to(view, view.candidates[rank - 1]), candidate=rank - 1)


def set_plateau(view: CueView, end: int) -> CueView:
    """Set an end of the plateau, 0 or 1, at the cursor; clear it if it is already there."""
    ends = [view.plateau_first, view.plateau_last]
    ends[end] = None if ends[end] == view.cursor else view.cursor
    first, last = ends
    if first is not None and last is not None and first > last:
        ends[1 - end] = None  # the newer end stays
    return replace(view, plateau_first=ends[0], plateau_last=ends[1])
