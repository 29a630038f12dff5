"""Check labels against the footage that they name, and people against each other.

The installed hook ``label_problems`` names this module; see ``pyproject.toml``.

Krippendorff's alpha is taken on time within the clip, 0 to 1. On absolute frame numbers, which
spread over a whole recording, it would be near 1 whatever the annotators do. An adjudication keeps
both originals.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from annotations.labels import (
    FLAG_REASONS,
    Label,
    current_labels,
    footage_problems,
    latest_labels,
    make_flag,
    make_mark,
    read_labels,
    unreadable_lines,
    voices,
)
from express50.capture.index import Index, read_index
from express50.contract.layout import Dataset, included_subjects
from express50.errors import AnnotationError, advised

FLAG = "flag:"  # prefix of a free-text reason, which might otherwise be a mistyped name
WITHIN = (1, 2, 4)  # frames
SLIP_FRAMES = 12  # frames; further apart, two people did not mean the same moment
BOOTSTRAP = 1000
# A spread of times within clips: far below a frame of a day's recording, far above rounding.
_NO_SPREAD = 1e-24


@dataclass(frozen=True)
class LabelProblem:
    """Something wrong with a label.

    Kinds: ``identity`` (the frame is not the one that was labelled), ``window`` (outside the cue),
    ``unknown`` (no such expression or camera), ``contradiction`` (a peak for one, none for another,
    not settled), ``unreadable`` (a line cut short, or damaged) and ``coverage`` (no label in
    force).
    """

    subject: str
    expression: str
    kind: str
    what: str


def problems(dataset: Dataset, subjects: list[str] | None = None) -> list[LabelProblem]:
    """List the problems of some subjects' labels, of all that are not excluded by default."""
    chosen = included_subjects(dataset) if subjects is None else subjects
    found = []
    for subject in chosen:
        index, labels = read_index(dataset, subject), read_labels(dataset, subject)
        for number in unreadable_lines(dataset, subject):
            what = f"line {number} of {dataset.labels_file(subject)} cannot be read; label it again"
            found.append(LabelProblem(subject, "", "unreadable", what))
        named = {cue.expression_id for cue in index.cues}
        for label in latest_labels(labels):  # a newer label replaces a wrong one
            if label.expression not in named:  # taken out of cues.csv: nothing uses it
                continue
            for kind, what in footage_problems(index, label):
                words = f"{label.annotator}: {what}"
                found.append(LabelProblem(subject, label.expression, kind, words))
        force = current_labels(labels)
        for cue in index.cues:
            if cue.expression_id not in force:
                found.append(LabelProblem(subject, cue.expression_id, "coverage", "no label"))
    for row in disagreements(dataset, subjects=chosen):
        if row.spread is None:
            said = ", ".join(f"{who}: {what}" for who, what in row.said.items())
            verdict = f"--settle {row.subject} {row.expression} VERDICT"
            settle = advised("express50 annotate review", dataset.root, verdict)
            what = f"{said}; settle it with {settle}"
            found.append(LabelProblem(row.subject, row.expression, "contradiction", what))
    return found


@dataclass(frozen=True)
class Disagreement:
    """Different labels of one clip; ``spread`` in frames, None if some saw no peak at all."""

    subject: str
    expression: str
    spread: int | None
    said: dict[str, str]
    settled: str | None


def disagreements(
    dataset: Dataset, beyond: int = 2, settled: bool = False, subjects: list[str] | None = None
) -> list[Disagreement]:
    """List the disagreements, worst first: a flag against a mark, then the widest spread.

    Marks at most ``beyond`` frames apart agree. What was settled already is left out unless
    ``settled``, and so are excluded subjects unless they are named.
    """
    found = []
    for subject in subjects or included_subjects(dataset):
        labels = read_labels(dataset, subject)
        said, force = voices(labels), current_labels(labels)
        for name in (cue.expression_id for cue in read_index(dataset, subject).cues):
            own = said.get(name, {})
            frames = [label.frame for label in own.values() if label.frame is not None]
            torn = 0 < len(frames) < len(own)  # some mark a peak, some flag that there is none
            spread = max(frames, default=0) - min(frames, default=0)
            verdict = force[name] if name in force and force[name].action == "settle" else None
            if (torn or spread > beyond) and (settled or verdict is None):
                words = {who: describe(label) for who, label in own.items()}
                outcome = None if verdict is None else describe(verdict)
                row = Disagreement(subject, name, None if torn else spread, words, outcome)
                found.append(row)
    return sorted(found, key=lambda row: (row.spread is not None, -(row.spread or 0)))


def describe(label: Label) -> str:
    """Describe a label in a few words: its frame, or why it has none."""
    if label.frame is not None:
        return f"frame {label.frame}"
    return f"flag: {label.reason or 'no reason given'}"


def in_spite_of(settled: Label) -> str:
    """Say that a settlement outranks what an annotator has just decided."""
    return f"{settled.annotator}'s settlement ({describe(settled)}) stays in force"


def settlement(
    dataset: Dataset, index: Index, expression: str, verdict: str, annotator: str
) -> Label:
    """Make the adjudication of a clip.

    The verdict is a frame's number, an annotator whose label is right, or a reason: one of
    `FLAG_REASONS`, or any after ``flag:``.

    Raises:
        AnnotationError: nobody labelled the expression, the frame is outside its window, or the
            verdict is none of these.
    """
    where = f"{index.subject} {expression}"
    said = voices(read_labels(dataset, index.subject)).get(expression)
    if not said:
        raise AnnotationError(f"{where}: no person labelled it; label it before you settle it")
    chosen = said.get(verdict)
    if chosen is not None and chosen.frame is not None:
        label = make_mark(
            index, expression, chosen.frame, chosen.camera or "", annotator, chosen.first,
            chosen.last,
        )  # fmt: skip
    elif chosen is not None:
        label = make_flag(index, expression, chosen.reason or "", annotator)
    elif verdict.lstrip("-").isdigit():
        camera = next((x.camera for x in said.values() if x.camera), next(iter(index.cameras)))
        label = make_mark(index, expression, int(verdict), camera, annotator)
    elif verdict in FLAG_REASONS or verdict.startswith(FLAG):
        label = make_flag(index, expression, verdict.removeprefix(FLAG), annotator)
    else:
        raise AnnotationError(
            f"{where}: {verdict!r} is not a frame, one of its annotators ({', '.join(said)}) or a"
            f" usual reason ({', '.join(FLAG_REASONS)}); write any other reason as {FLAG}REASON"
        )
    return replace(label, action="settle")


@dataclass(frozen=True)
class MarkedClip:
    """One clip that several people marked: frames by annotator, and the clip's window."""

    subject: str
    expression: str
    start: int
    length: int
    frames: dict[str, int]


def marked_clips(dataset: Dataset, subjects: Iterable[str] | None = None) -> list[MarkedClip]:
    """Find the clips that at least two people marked; excluded subjects are left out."""
    clips = []
    for subject in sorted(subjects or included_subjects(dataset)):
        said = voices(read_labels(dataset, subject))
        for cue in read_index(dataset, subject).cues:
            own = said.get(cue.expression_id, {})
            frames = {who: x.frame for who, x in own.items() if x.frame is not None}
            if len(frames) > 1:
                length = cue.end_frame - cue.start_frame + 1
                clip = MarkedClip(subject, cue.expression_id, cue.start_frame, length, frames)
                clips.append(clip)
    return clips


def agreement(clips: Sequence[MarkedClip]) -> dict[str, object]:
    """Compute figures over clips; each pair of annotators of a clip counts once.

    They are ``clips``, ``pairs``, ``within_1``, ``within_2``, ``within_4``, ``median_frames``,
    ``slip_rate``, ``alpha`` and ``alpha_interval`` (95 %, bootstrap over clips), None if there
    is nothing to compare.
    """
    clips = [clip for clip in clips if len(clip.frames) > 1]
    pairs = [pair for clip in clips for pair in combinations(clip.frames.values(), 2)]
    distances = np.abs(np.diff(np.array(pairs).reshape(-1, 2), axis=1))
    units = [clip_times(clip) for clip in clips]
    alpha = interval_alpha(units) if clips else None
    return {
        "clips": len(clips),
        "pairs": len(pairs),
        **{f"within_{k}": _mean(distances <= k) for k in WITHIN},
        "median_frames": float(np.median(distances)) if pairs else None,
        "slip_rate": _mean(distances > SLIP_FRAMES),
        "alpha": None if alpha is None else round(alpha, 4),
        "alpha_interval": alpha_interval(units),
    }


def _mean(values: np.ndarray) -> float | None:
    return round(float(values.mean()), 4) if values.size else None


def clip_times(clip: MarkedClip) -> np.ndarray:
    """Return the marks as shares of the clip, 0 at its first frame and 1 at its last."""
    frames = np.array(list(clip.frames.values()), dtype=float)
    return (frames - clip.start) / max(1, clip.length - 1)


def interval_alpha(units: Sequence[np.ndarray]) -> float | None:
    """Compute Krippendorff's alpha with the interval metric from two or more values of each unit.

    None if it is undefined: all values are the same, or there is one unit alone, whose spread is
    also the expected one.

    The mean squared difference of all pairs of values is twice their variance, which gives a closed
    form without the coincidence matrix (K. Krippendorff, Content Analysis, 2004, chapter 11).
    """
    values = np.concatenate(units)
    expected = 2.0 * values.var(ddof=1)
    if len(units) < 2 or expected < _NO_SPREAD:
        return None
    observed = sum(len(unit) * 2.0 * unit.var(ddof=1) for unit in units) / len(values)
    return float(1.0 - observed / expected)


def alpha_interval(units: Sequence[np.ndarray]) -> list[float] | None:
    """Return alpha's 95 % bootstrap interval over clips; None below three or without spread."""
    if len(units) < 3:
        return None
    rng = np.random.default_rng(0)
    draws = rng.integers(0, len(units), (BOOTSTRAP, len(units)))
    found = [interval_alpha([units[k] for k in draw]) for draw in draws]
    kept = [alpha for alpha in found if alpha is not None]
    if not kept:
        return None
    return [round(float(q), 4) for q in np.quantile(kept, (0.025, 0.975))]


def by_expression(clips: Sequence[MarkedClip]) -> dict[str, dict[str, object]]:
    """Compute the agreement on each expression."""
    groups: dict[str, list[MarkedClip]] = defaultdict(list)
    for clip in clips:
        groups[clip.expression].append(clip)
    return {expression: agreement(group) for expression, group in groups.items()}


def by_pair(clips: Sequence[MarkedClip]) -> dict[str, dict[str, object]]:
    """Compute the agreement of each pair of annotators, named ``ann+bob``."""
    groups: dict[str, list[MarkedClip]] = defaultdict(list)
    for clip in clips:
        for a, b in combinations(sorted(clip.frames), 2):
            pair = replace(clip, frames={a: clip.frames[a], b: clip.frames[b]})
            groups[f"{a}+{b}"].append(pair)
    return {pair: agreement(group) for pair, group in groups.items()}
