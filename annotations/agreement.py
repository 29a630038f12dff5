"""Agreement between annotators, their disagreements, and the adjudications that settle them.

Krippendorff's alpha is taken on time within the clip, 0 to 1: on absolute frame numbers, which
spread over a whole recording, it is near 1 whatever the annotators do. An adjudication keeps both
originals.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from annotations.labels import FLAG_REASONS, Label, make_flag, make_mark, with_plateau
from annotations.store import current_labels, labels_by_person, read_labels
from express50.capture.index import Index, read_index
from express50.contract.exclusions import included_subjects
from express50.contract.layout import Dataset
from express50.errors import AnnotationError

WITHIN = (1, 2, 4)  # frames
SLIP_FRAMES = 12  # further apart, two people did not mean the same moment
BOOTSTRAP = 1000
LEVEL = 0.95
# Of times within clips: far below one frame of a day's recording, far above what rounding leaves.
_NO_SPREAD = 1e-24


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
        marks = marks_by_person(read_labels(dataset, subject))
        for cue in read_index(dataset, subject).cues:
            said = marks.get(cue.expression_id, {})
            frames = {who: x.frame for who, x in said.items() if x.frame is not None}
            if len(frames) > 1:
                length = cue.end_frame - cue.start_frame + 1
                clips.append(
                    MarkedClip(subject, cue.expression_id, cue.start_frame, length, frames)
                )
    return clips


def marks_by_person(labels: Sequence[Label]) -> dict[str, dict[str, Label]]:
    """Return the marks in force by expression and annotator; flags are left out."""
    marks: dict[str, dict[str, Label]] = defaultdict(dict)
    for who, said in labels_by_person(labels).items():
        for expression, label in said.items():
            if label.frame is not None:
                marks[expression][who] = label
    return dict(marks)


def agreement(clips: Sequence[MarkedClip], seed: int = 0) -> dict[str, object]:
    """Compute figures over clips; each pair of annotators of a clip counts once.

    Returns:
        ``clips``, ``pairs``, ``within_1``, ``within_2``, ``within_4``, ``median_frames``,
        ``slip_rate``, ``alpha`` and ``alpha_interval`` (95 %, bootstrap over clips); figures are
        None where there is nothing to compare.
    """
    clips = [clip for clip in clips if len(clip.frames) > 1]
    distances = np.array(
        [abs(a - b) for clip in clips for a, b in combinations(clip.frames.values(), 2)]
    )
    if not len(distances):
        blank = dict.fromkeys((*(f"within_{k}" for k in WITHIN), "median_frames", "slip_rate"))
        return {"clips": 0, "pairs": 0} | blank | {"alpha": None, "alpha_interval": None}
    units = [clip_times(clip) for clip in clips]
    alpha = interval_alpha(units)
    return {
        "clips": len(clips),
        "pairs": len(distances),
        **{f"within_{k}": round(float((distances <= k).mean()), 4) for k in WITHIN},
        "median_frames": float(np.median(distances)),
        "slip_rate": round(float((distances > SLIP_FRAMES).mean()), 4),
        "alpha": None if alpha is None else round(alpha, 4),
        "alpha_interval": alpha_interval(units, seed),
    }


def clip_times(clip: MarkedClip) -> np.ndarray:
    """Return the marks as shares of the clip, 0 at its first frame and 1 at its last."""
    frames = np.array(list(clip.frames.values()), dtype=float)
    return (frames - clip.start) / max(1, clip.length - 1)


def interval_alpha(units: Sequence[np.ndarray]) -> float | None:
    """Krippendorff's alpha with the interval metric; None where all values are the same.

    The mean squared difference of all pairs of values is twice their variance, which gives a closed
    form without the coincidence matrix (K. Krippendorff, Content Analysis, 2004, chapter 11).

    Args:
        units: the values of each unit, at least two per unit.
    """
    values = np.concatenate(units)
    expected = 2.0 * values.var(ddof=1)
    if expected < _NO_SPREAD:
        return None
    observed = sum(len(unit) * 2.0 * unit.var(ddof=1) for unit in units) / len(values)
    return float(1.0 - observed / expected)


def alpha_interval(units: Sequence[np.ndarray], seed: int = 0) -> list[float] | None:
    """Bootstrap interval of alpha over clips; None with fewer than three clips or no spread."""
    if len(units) < 3:
        return None
    rng = np.random.default_rng(seed)
    draws = rng.integers(0, len(units), (BOOTSTRAP, len(units)))
    found = [interval_alpha([units[k] for k in draw]) for draw in draws]
    kept = [alpha for alpha in found if alpha is not None]
    if not kept:
        return None
    tails = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
    return [round(float(q), 4) for q in np.quantile(kept, tails)]


def by_expression(clips: Sequence[MarkedClip]) -> dict[str, dict[str, object]]:
    """Compute the agreement on each expression."""
    return _grouped(clips, lambda clip: [(clip.expression, clip.frames)])


def by_pair(clips: Sequence[MarkedClip]) -> dict[str, dict[str, object]]:
    """Compute the agreement of each pair of annotators, named ``ann+bob``."""

    def pairs(clip: MarkedClip) -> list[tuple[str, dict[str, int]]]:
        return [
            (f"{a}+{b}", {a: clip.frames[a], b: clip.frames[b]})
            for a, b in combinations(sorted(clip.frames), 2)
        ]

    return _grouped(clips, pairs)


def _grouped(clips: Sequence[MarkedClip], keys) -> dict[str, dict[str, object]]:
    groups: Mapping[str, list[MarkedClip]] = defaultdict(list)
    for clip in clips:
        for key, frames in keys(clip):
            part = MarkedClip(clip.subject, clip.expression, clip.start, clip.length, frames)
            groups[key].append(part)
    return {key: agreement(group) for key, group in groups.items()}


FLAG = "flag:"  # before a reason in words, which else might be a name mistyped


@dataclass(frozen=True)
class Disagreement:
    """Different labels of one clip; ``spread`` in frames, None where some saw no peak at all."""

    subject: str
    expression: str
    spread: int | None
    said: dict[str, str]
    settled: str | None


def disagreements(
    dataset: Dataset, beyond: int = 2, settled: bool = False, subjects: list[str] | None = None
) -> list[Disagreement]:
    """List the disagreements, worst first: a flag against a mark, then the widest spread.

    Args:
        dataset: the dataset.
        beyond: marks at most this many frames apart agree.
        settled: also list what was settled already.
        subjects: only these; all that are not excluded by default.
    """
    found = []
    for subject in subjects or included_subjects(dataset):
        labels = read_labels(dataset, subject)
        said = labels_by_person(labels)
        force = current_labels(labels)
        for cue in read_index(dataset, subject).cues:
            expression = cue.expression_id
            voices = {who: own[expression] for who, own in said.items() if expression in own}
            row = _compare(subject, expression, voices, force.get(expression), beyond)
            if row is not None and (settled or row.settled is None):
                found.append(row)
    return sorted(found, key=lambda row: (row.spread is not None, -(row.spread or 0)))


def _compare(
    subject: str, expression: str, voices: dict[str, Label], force: Label | None, beyond: int
) -> Disagreement | None:
    """Compare the labels of one clip; None where all agree."""
    frames = [x.frame for x in voices.values() if x.frame is not None]
    torn = 0 < len(frames) < len(voices)  # some mark a peak, some flag that there is none
    spread = max(frames, default=0) - min(frames, default=0)
    if not torn and spread <= beyond:
        return None
    settled = describe(force) if force is not None and force.action == "settle" else None
    said = {who: describe(label) for who, label in voices.items()}
    return Disagreement(subject, expression, None if torn else spread, said, settled)


def describe(label: Label) -> str:
    """Describe a label in a few words: its frame, or why it has none."""
    if label.frame is not None:
        return f"frame {label.frame}"
    return f"flag: {label.reason or 'no reason given'}"


def settlement(
    dataset: Dataset, index: Index, expression: str, verdict: str, annotator: str
) -> Label:
    """Make the adjudication of a clip.

    The verdict is a frame's number, an annotator whose label is right, or a reason: one of
    `FLAG_REASONS`, or any after ``flag:``.

    Raises:
        AnnotationError: the expression is unknown, the frame is outside its window, or the verdict
            is none of these.
    """
    voices = current_voices(dataset, index.subject, expression)
    chosen = voices.get(verdict)
    if chosen is None and verdict.lstrip("-").isdigit():
        camera = next((x.camera for x in voices.values() if x.camera), next(iter(index.cameras)))
        mark = make_mark(index, expression, int(verdict), camera, annotator)
        return replace(mark, action="settle")
    if chosen is None and verdict not in FLAG_REASONS and not verdict.startswith(FLAG):
        raise AnnotationError(
            f"{index.subject} {expression}: {verdict!r} is not a frame, an annotator of it"
            f" ({', '.join(voices)}) or a usual reason ({', '.join(FLAG_REASONS)}); write any other"
            f" reason as {FLAG}REASON"
        )
    if chosen is None or chosen.frame is None or chosen.camera is None:
        reason = (chosen.reason if chosen else verdict.removeprefix(FLAG)) or ""
        return replace(make_flag(index, expression, reason, annotator), action="settle")
    mark = make_mark(index, expression, chosen.frame, chosen.camera, annotator)
    return replace(with_plateau(mark, index, chosen.first, chosen.last), action="settle")


def current_voices(dataset: Dataset, subject: str, expression: str) -> dict[str, Label]:
    """Read each person's label of one clip.

    Raises:
        AnnotationError: it has no label.
    """
    said = labels_by_person(read_labels(dataset, subject))
    voices = {who: own[expression] for who, own in said.items() if expression in own}
    if not voices:
        raise AnnotationError(
            f"{subject} {expression}: no person labelled it; label it before you settle it"
        )
    return voices
