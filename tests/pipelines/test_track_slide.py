"""Where the skin belongs along itself: exact derivatives, a drawn head, silence where unseen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.head.load import load_head
from express50.head.model import landmarks
from pipelines.track.chart.network import reading_chart
from pipelines.track.offsets import split_shape, with_modes
from pipelines.track.pictures import Moment
from pipelines.track.slide import Slide, landmark_samples, read_slide, with_slides
from pipelines.track.state import Target


def random_slide(seed: int, scale: float = 1e-3) -> tuple[Slide, np.ndarray]:
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(9, 3)) * 0.05
    rows, bary = rng.integers(9, size=(5, 3)), rng.dirichlet(np.ones(3), 5)
    normals = rng.normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    goals = np.einsum("sk,skc->sc", bary, positions[rows]) + scale * rng.normal(size=(5, 3))
    return Slide(rows, bary, goals, normals, rng.uniform(5e-4, 2e-3, 5)), positions


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([1e-5, 1e-3, 1e-2]))
def test_the_gradient_is_that_of_the_cost(seed: int, scale: float) -> None:
    slide, positions = random_slide(seed, scale)
    _, gradient = slide.normal(positions)
    moved = np.zeros_like(positions)
    np.add.at(moved, slide.rows, gradient[:, None] * slide.bary[..., None])
    rng = np.random.default_rng(seed + 1)
    way, step = rng.normal(size=positions.shape), 1e-7
    rise = slide.cost(positions + step * way) - slide.cost(positions - step * way)
    size = np.linalg.norm(moved) * np.linalg.norm(way)
    assert rise / (2 * step) == pytest.approx((moved * way).sum(), abs=1e-5 * size + 1e-6)


def test_what_lies_along_the_normal_counts_nothing() -> None:
    slide, positions = random_slide(1)
    at = np.einsum("sk,skc->sc", slide.bary, positions[slide.rows])
    above = Slide(slide.rows, slide.bary, at + 0.002 * slide.normals, slide.normals, slide.sigma)
    matrix, gradient = above.normal(positions)
    assert above.cost(positions) < 1e-20 and np.abs(gradient).max() < 1e-9
    assert np.abs(np.einsum("sij,sj->si", matrix, slide.normals)).max() < 1e-6
    assert np.linalg.eigvalsh(matrix).min() > -1e-3


def test_far_goals_lose_their_pull() -> None:
    slide, positions = random_slide(2, 1e-3)
    far, _ = random_slide(2, 1.0)
    assert np.abs(far.normal(positions)[1]).max() < 0.1 * np.abs(slide.normal(positions)[1]).max()
    assert np.isfinite(far.cost(positions))


def test_terms_join_the_points_of_a_fit() -> None:
    slide, _ = random_slide(3)
    target = Target(None, np.zeros(0), False, vertices=np.array([40, 41]))  # type: ignore[arg-type]
    made, plain = with_slides([target, target], [slide, None])
    assert plain is target and len(made.terms) == 1
    (term,) = made.terms
    assert (made.vertices[term.rows - 68] == slide.rows).all() and term.rows.min() >= 70


def test_where_nothing_is_seen_nothing_is_said() -> None:
    model = load_head("procedural")
    mesh = model.template.double().numpy()
    chart = reading_chart(model)
    assert read_slide(model, chart, Moment((), ()), mesh, 1.0) is None
    marks = landmarks(model, model.template[None])[0].numpy()
    np.testing.assert_allclose(landmark_samples(model).at(mesh), marks, atol=1e-6)


def test_modes_along_the_skin_stay_in_it() -> None:
    model = load_head("procedural")
    own = len(model.shape_names)
    more = with_modes(model, 6, 1e-3, 0.02, along=4)
    assert len(more.shape_names) == own + 6 + 3 * 4
    shape = np.zeros(own + 18)
    shape[own + 6 :] = np.random.default_rng(0).normal(size=12)
    coefficients, offsets = split_shape(more, shape)
    assert len(coefficients) == own and not coefficients.any()
    skin = model.regions["face"].numpy()
    assert 1e-4 < np.linalg.norm(offsets[skin], axis=1).mean() < 5e-3
    only = with_modes(model, 0, 1e-3, 0.02, along=4)
    assert len(only.shape_names) == own + 12
