"""Datasets for the annotation tests: indexes and suggestions, no pixels."""

import json

from express50.capture.index import CameraSource, Cue, Index, index_to_json
from express50.contract.layout import Dataset

EXPRESSIONS = ("neutral", "smile", "wink_left")
LENGTH = 10  # frames of each cue window


def make_index(root, subject="S001", expressions=EXPRESSIONS, cameras=("a", "b"), meta=None):
    """An index of `LENGTH` frames an expression."""
    frames = LENGTH * len(expressions)
    source = CameraSource(
        kind="frames", source="cameras/a/frames", width=8, height=8, frames=frames,
        pts=tuple(range(0, 10 * frames, 10)), dhash=tuple(f"{i:016x}" for i in range(frames)),
        sha256="0", names=tuple(f"{i:06d}.png" for i in range(frames)),
    )  # fmt: skip
    cues = tuple(Cue(e, n * LENGTH, n * LENGTH + LENGTH - 1) for n, e in enumerate(expressions))
    return Index(
        subject=subject, capture=root / "captures" / subject, fps=24.0,
        cameras=dict.fromkeys(cameras, source), plates={}, board=None, calibration=None,
        cues=cues, meta=meta or {},
    )  # fmt: skip


def make_dataset(root, subjects=("S001", "S002"), metas=None, **kwargs):
    """A dataset whose subjects are ingested as far as their indexes go."""
    dataset = Dataset(root)
    captures = {}
    for subject in subjects:
        index = make_index(root, subject, meta=(metas or {}).get(subject), **kwargs)
        captures[subject] = str(index.capture)
        path = dataset.index_file(subject)
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(index_to_json(index)))
    dataset.captures_file.write_text(json.dumps(captures))
    return dataset


def suggest(dataset, subject, frames):
    """Write suggestions: expression -> (frame, confidence)."""
    folder = dataset.item_dir("align", subject)
    folder.mkdir(parents=True, exist_ok=True)
    rows = {
        expression: {
            "frame": frame, "confidence": confidence, "start": frame, "activity": [1.0],
            "candidates": [frame], "camera": "a",
        }
        for expression, (frame, confidence) in frames.items()
    }  # fmt: skip
    (folder / "suggestions.json").write_text(json.dumps(rows))
