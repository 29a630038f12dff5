"""A dataset of painted frames: two subjects, and suggestions as align writes them."""

import json

import numpy as np
import pytest

from annotations.ui.app import AnnotateApp
from annotations.ui.session import open_session
from express50.config import resolve_config
from express50.layout import Dataset
from express50.runner import run_stage
from pipelines import ingest
from tests.synth import make_capture

EXPRESSIONS = ("neutral", "smile", "jaw_open")
FRAMES_EACH = 16


@pytest.fixture(scope="session")
def footage(tmp_path_factory):
    """An ingested dataset of S001 and S002: 2 cameras, 3 expressions of 16 frames; only copied."""
    root = tmp_path_factory.mktemp("annotator")
    captures = []
    for subject in ("S001", "S002"):
        captures.append(root / subject)
        make_capture(
            captures[-1], subject=subject, cameras=2, frames=48, size=32, plates=False,
            calibration=False, expressions=EXPRESSIONS,
        )  # fmt: skip
    dataset = Dataset(root / "dataset")
    ingest.register(dataset, captures)
    config = resolve_config(ingest.STAGE, "draft")
    assert run_stage(ingest.STAGE, dataset, config, workers=0, progress=False).ok
    return dataset


@pytest.fixture
def dataset(footage, tmp_path):
    """The footage without suggestions; labels go to a folder of its own."""
    root = tmp_path / "dataset"
    root.mkdir()
    for name in ("ingest", "captures.json"):
        (root / name).symlink_to(footage.root / name)
    return Dataset(root)


def suggest(dataset, table):
    """Write suggestions: {subject: {expression: [frame, other candidates ...]}}."""
    for subject, rows in table.items():
        folder = dataset.item_dir("align", subject)
        folder.mkdir(parents=True, exist_ok=True)
        content = {e: suggestion_row(e, frames) for e, frames in rows.items()}
        (folder / "suggestions.json").write_text(json.dumps(content))


def suggestion_row(expression, frames):
    start = EXPRESSIONS.index(expression) * FRAMES_EACH
    numbers = np.arange(start, start + FRAMES_EACH)
    curve = np.exp(-(((numbers - frames[0]) / 3.0) ** 2)).round(3).tolist()
    return {
        "frame": frames[0], "confidence": 0.9, "start": start, "activity": curve,
        "candidates": frames, "match": curve, "kind": "match", "camera": "cam01",
        "reference": {"subject": "S001", "frame": 4, "camera": "cam01"},
    }  # fmt: skip


@pytest.fixture
def suggested(dataset):
    """The footage with suggestions for every expression of both subjects."""
    rows = {"neutral": [4], "smile": [20, 27], "jaw_open": [40, 36, 45]}
    suggest(dataset, {"S001": rows, "S002": rows})
    return dataset


@pytest.fixture
def make_app():
    """An app over a dataset, without the landmark network."""

    def make(dataset, annotator="ann", **options):
        options.setdefault("order", "subject")
        return AnnotateApp(open_session(dataset, annotator, **options))

    return make
