"""Rules that label without looking: RenderMe-360's key frames are the clips' last frames.

Its 12 expressions are recorded so that the performer holds the target at the end of the clip; the
dataset's users take the last frame (RenderMe-360's processing tools). A rule's label stands below
any person's and above a suggestion.
"""

from __future__ import annotations

from collections.abc import Sequence

from annotations.store import RULE_PREFIX, Label, current_labels, make_mark, read_labels
from express50.index import Cue, Index
from express50.layout import Dataset

LAST_FRAME = RULE_PREFIX + "last-frame"
RENDERME360_EXPRESSIONS = frozenset(f"e{n:0{width}}" for n in range(12) for width in (1, 2))


def ruled_cues(index: Index, expressions: Sequence[str] | None = None) -> list[Cue]:
    """The cues that the rule is about: RenderMe-360's ids e0 (or e00) to e11, or those named."""
    wanted = RENDERME360_EXPRESSIONS if expressions is None else expressions
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
            marks.append(make_mark(index, cue.expression_id, frame, camera, LAST_FRAME))
    return marks
