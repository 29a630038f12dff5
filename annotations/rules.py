"""Rules that label without looking: RenderMe-360's key frames are the clips' last frames.

Its 12 expressions are recorded so that the performer holds the target at the end of the clip; the
dataset's users take the last frame (RenderMe-360's processing tools). That is another frame in each
of its releases, so ingest stores which one was read and the number of its last frame, and a label
says so. A rule's label stands below any person's and above a suggestion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from annotations.labels import RULE_PREFIX, Label, make_mark
from annotations.store import current_labels, read_labels
from express50.capture.index import Cue, Index
from express50.contract.layout import Dataset
from express50.errors import AnnotationError

LAST_FRAME = RULE_PREFIX + "last-frame"
RENDERME360_EXPRESSIONS = frozenset(f"e{n:0{width}}" for n in range(12) for width in (1, 2))


def ruled_cues(index: Index, expressions: Sequence[str] | None = None) -> list[Cue]:
    """The cues that the rule is about: RenderMe-360's expressions, or those named.

    They are the ones that ingest read out of its files, else those with ids e0 (or e00) to e11.
    """
    told = [name for name, row in _told(index).items() if str(row["performance"]).startswith("e")]
    wanted = (told or RENDERME360_EXPRESSIONS) if expressions is None else expressions
    return [cue for cue in index.cues if cue.expression_id in wanted]


def last_frame_marks(
    dataset: Dataset, index: Index, expressions: Sequence[str] | None = None
) -> list[Label]:
    """New marks of the rule for a subject; none where it has said the same before."""
    labels = read_labels(dataset, index.subject)
    said = current_labels(x for x in labels if x.annotator == LAST_FRAME)
    camera, source = next(iter(index.cameras.items()))
    marks = []
    for cue in ruled_cues(index, expressions):
        frame = min(cue.end_frame, source.frames - 1)
        known = said.get(cue.expression_id)
        if frame >= cue.start_frame and (known is None or known.frame != frame):
            mark = make_mark(index, cue.expression_id, frame, camera, LAST_FRAME)
            row = _told(index).get(cue.expression_id)
            marks.append(mark if row is None else _with_release(mark, row))
    return marks


def _told(index: Index) -> dict[str, dict]:
    """What ingest read of each expression's clip; empty of other captures."""
    return index.meta.get("renderme360", {})


def _with_release(mark: Label, row: dict) -> Label:
    """The mark with the release it was made on.

    Raises:
        AnnotationError: the clip's last frame is not the last of the performance.
    """
    if mark.pts != row["last_frame"]:
        raise AnnotationError(
            f"{mark.subject} {mark.expression}: the clip ends with frame {mark.pts}, the "
            f"performance with {row['last_frame']}; run 'express50 ingest' again"
        )
    reason = f"{row['release']} release, frame {row['last_frame']} of {row['num_frame']}"
    return replace(mark, reason=reason)
