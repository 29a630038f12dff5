"""Personal movements, folds and redness: outside of the head model, and only where asked for."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.truth import Truth
from express50.capture.expressions import select
from express50.head.load import load_head
from express50.head.model import landmarks_of
from express50.twin.body import build_body, head_vertices, own_offsets
from express50.twin.skin import living_skin
from express50.twin.studio import write_truth
from express50.twin.subjects import make_subject, perform


@pytest.fixture(scope="module")
def model():
    return load_head("procedural")


def coefficients(model, **values: float) -> np.ndarray:
    return np.array([values.get(name, 0.0) for name in model.expression_names])


def test_personal_motion_is_seeded_and_leaves_everything_else_as_it_was(model) -> None:
    plain, lively, again, other = (
        make_subject(model, f"S{n:03d}", n, 0, amount)
        for n, amount in ((1, 0.0), (1, 1.0), (1, 1.0), (2, 1.0))
    )
    assert plain.own is None
    assert np.array_equal(plain.offsets, lively.offsets)
    assert plain.look.skin.tolist() == lively.look.skin.tolist()
    assert np.array_equal(lively.own, again.own)
    assert np.abs(lively.own - other.own).max() > 0.2
    assert not lively.own[model.regions["left_eyeball"].numpy()].any()
    assert not lively.own[model.regions["teeth"].numpy()].any()


def test_no_coefficients_of_the_model_give_a_personal_motion(model) -> None:
    subject = make_subject(model, "S001", 1, 0, 1.0)
    smile = coefficients(model, mouthSmile_L=1.0, mouthSmile_R=1.0)
    added = own_offsets(model, subject.own, smile)
    assert not own_offsets(model, subject.own, 0 * smile).any()
    assert np.linalg.norm(added, axis=1).max() > 1e-3
    basis = model.expression_dirs.double().numpy().reshape(-1, len(smile))
    best, *_ = np.linalg.lstsq(basis, added.ravel(), rcond=None)
    left = added - (basis @ best).reshape(added.shape)
    assert np.linalg.norm(left) > 0.3 * np.linalg.norm(added)


def test_muscles_fold_the_skin_beside_them_and_effort_colours_it(model) -> None:
    marks = landmarks_of(model).astype(np.float64)
    grid = np.linspace(-0.004, 0.004, 9)
    forehead = marks[19] + np.array([[0.015, 0.022 + dy, 0.0] for dy in grid])
    cheek = np.repeat(0.5 * (marks[46] + marks[54])[None], 9, 0)
    still, raised = (
        living_skin(model, 1, 0, 50, 1.0, coefficients(model, **values))
        for values in ({}, {f"brow{p}_{s}": 1.0 for p in ("InnerUp", "OuterUp") for s in "LR"})
    )
    np.testing.assert_array_equal(still.factor(np.concatenate([forehead, cheek])), 1.0)
    light = raised.factor(forehead).mean(1)
    assert light.max() / light.min() > 1.15  # valleys and ridges
    red, green, _ = raised.factor(cheek)[0]
    assert abs(red / green - 1) > 0.05
    older, younger = (
        max(living_skin(model, 1, 0, age, 1.0, coefficients(model, browDown_L=1.0)).folds.values())
        for age in (60, 20)
    )
    assert older > younger > 0


def test_truth_keeps_the_personal_motion(model, tmp_path) -> None:
    subject = make_subject(model, "S001", 1, 0, 1.0)
    body = build_body(model, subject, 0, 0.0)
    play = perform(model, select(("neutral", "smile")), 6, 24.0, 1, 0)
    write_truth(tmp_path / "S001", "procedural", body, play, {})
    frame = play.peaks["smile"]
    found = Truth(tmp_path).vertices("S001", frame)
    np.testing.assert_allclose(found, head_vertices(model, subject, play, frame), atol=1e-7)
    plain = head_vertices(model, make_subject(model, "S001", 1, 0), play, frame)
    assert np.linalg.norm(found - plain, axis=1).max() > 1e-3
