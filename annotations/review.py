"""Disagreements between annotators, and their adjudication, which keeps both originals."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from annotations.labels import FLAG_REASONS, Label, make_flag, make_mark
from annotations.store import current_labels, labels_by_person, read_labels
from express50.capture.index import Index, read_index
from express50.contract.exclusions import included_subjects
from express50.contract.layout import Dataset
from express50.errors import AnnotationError

FLAG = "flag:"  # before a reason in words, which else might be a name mistyped


@dataclass(frozen=True)
class Disagreement:
    """What people said of one clip; ``spread`` is frames, None where some saw no peak at all."""

    subject: str
    expression: str
    spread: int | None
    said: dict[str, str]
    settled: str | None

    def to_json(self) -> dict[str, object]:
        """JSON form."""
        return asdict(self)


def disagreements(
    dataset: Dataset, beyond: int = 2, settled: bool = False, subjects: list[str] | None = None
) -> list[Disagreement]:
    """The review queue, worst first: a flag against a mark, then the widest spread.

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
    """The disagreement of one clip, None where all agree."""
    frames = [x.frame for x in voices.values() if x.frame is not None]
    torn = 0 < len(frames) < len(voices)  # some mark a peak, some flag that there is none
    spread = max(frames, default=0) - min(frames, default=0)
    if not torn and spread <= beyond:
        return None
    settled = describe(force) if force is not None and force.action == "settle" else None
    said = {who: describe(label) for who, label in voices.items()}
    return Disagreement(subject, expression, None if torn else spread, said, settled)


def describe(label: Label) -> str:
    """A label in a few words: the frame, or why there is none."""
    if label.frame is not None:
        return f"frame {label.frame}"
    return f"flag: {label.reason or 'no reason given'}"


def settlement(
    dataset: Dataset, index: Index, expression: str, verdict: str, annotator: str
) -> Label:
    """The adjudication of a clip: a frame's number, an annotator whose label is right, or a reason:
    one of `FLAG_REASONS`, or any after ``flag:``.

    Raises:
        AnnotationError: the expression is unknown, the frame is outside its window, or the verdict
            is none of these.
    """
    voices = current_voices(dataset, index.subject, expression)
    chosen = voices.get(verdict)
    if chosen is None and verdict.lstrip("-").isdigit():
        camera = next((x.camera for x in voices.values() if x.camera), next(iter(index.cameras)))
        return make_mark(index, expression, int(verdict), camera, annotator, action="settle")
    if chosen is None and verdict not in FLAG_REASONS and not verdict.startswith(FLAG):
        raise AnnotationError(
            f"{index.subject} {expression}: {verdict!r} is no frame, annotator of it"
            f" ({', '.join(voices)}) or usual reason ({', '.join(FLAG_REASONS)}); any other reason"
            f" is {FLAG}REASON"
        )
    if chosen is None or chosen.frame is None or chosen.camera is None:
        reason = (chosen.reason if chosen else verdict.removeprefix(FLAG)) or ""
        return make_flag(index, expression, reason, annotator, action="settle")
    return make_mark(
        index, expression, chosen.frame, chosen.camera, annotator,
        first=chosen.first, last=chosen.last, action="settle",
    )  # fmt: skip


def current_voices(dataset: Dataset, subject: str, expression: str) -> dict[str, Label]:
    """What each person says of one clip.

    Raises:
        AnnotationError: nobody labelled it.
    """
    said = labels_by_person(read_labels(dataset, subject))
    voices = {who: own[expression] for who, own in said.items() if expression in own}
    if not voices:
        raise AnnotationError(f"{subject} {expression}: nobody has labelled it; nothing to settle")
    return voices
