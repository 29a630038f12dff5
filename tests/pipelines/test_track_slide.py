"""Where the skin belongs along itself: exact derivatives, a drawn head, silence where unseen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.errors import ConfigError
from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at
from express50.head.load import load_head
from express50.head.model import landmarks, pose, vertex_normals
from pipelines.track.chart.layout import HEIGHT, WIDTH
from pipelines.track.chart.network import mark_places, reading_chart
from pipelines.track.config import TrackConfig
from pipelines.track.offsets import split_shape, with_modes
from pipelines.track.pictures import Moment
from pipelines.track.shots import Shot
from pipelines.track.slide import (
    SURPASSED,
    Slide,
    landmark_samples,
    read_slide,
    with_slides,
)
from pipelines.track.state import Target


def random_slide(seed: int, scale: float = 1e-3) -> tuple[Slide, np.ndarray]:
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(9, 3)) * 0.05
    marks = rng.permutation(9)[:5]
    normals = rng.normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    goals = positions[marks] + scale * rng.normal(size=(5, 3))
    return Slide(marks, goals, normals, rng.uniform(5e-4, 2e-3, 5)), positions


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
    above = replace(slide, goals=positions[slide.marks] + 0.002 * slide.normals)
    matrix, gradient = above.normal(positions)
    assert above.cost(positions) < 1e-20 and np.abs(gradient).max() < 1e-9
    assert np.abs(np.einsum("sij,sj->si", matrix, slide.normals)).max() < 1e-6
    assert np.linalg.eigvalsh(matrix).min() > -1e-3


def test_far_goals_lose_their_pull() -> None:
    slide, positions = random_slide(2, 1e-3)
    far, _ = random_slide(2, 1.0)
    assert np.abs(far.normal(positions)[1]).max() < 0.1 * np.abs(slide.normal(positions)[1]).max()
    assert np.isfinite(far.cost(positions))


def test_only_what_was_read_becomes_a_term() -> None:
    slide, _ = random_slide(3)
    target = target_of(np.ones((2, 68)))
    made, plain = with_slides([target, target], [slide, None])
    assert plain is target and made.terms == (slide,)
    assert made.vertices is target.vertices, "a fit has the landmarks among its points anyway"


def target_of(sigma: np.ndarray) -> Target:
    return Target(None, sigma, False, vertices=np.array([40, 41]))  # type: ignore[arg-type]


def test_a_chart_takes_trust_from_the_landmarks_it_reads() -> None:
    slide, _ = random_slide(3)
    target = target_of(np.where(np.arange(68) % 7, 1.5, np.inf)[None].repeat(2, 0))
    (made,) = with_slides([target], [slide])
    told = np.isin(np.arange(68), slide.marks)
    np.testing.assert_array_equal(made.sigma[:, ~told], target.sigma[:, ~told])
    np.testing.assert_array_equal(made.sigma[:, told], SURPASSED * target.sigma[:, told])
    assert np.nanmax(target.sigma[np.isfinite(target.sigma)]) == 1.5, "not changed in place"


@pytest.fixture(scope="module")
def head():
    return load_head("procedural")


@pytest.fixture(scope="module")
def chart(head):
    return reading_chart(head)


def told(monkeypatch, shift=0.0, mass=1.0) -> None:
    """Let every landmark be seen `shift` texels to the right of where it belongs."""
    at = mark_places() + (shift, 0.0)
    image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    seen = np.full((HEIGHT, WIDTH), mass, np.float32)
    monkeypatch.setattr("pipelines.track.slide.read_chart", lambda *_: (image, seen))
    monkeypatch.setattr("pipelines.track.slide.read_marks", lambda *_: (at, np.full(51, 0.5)))


def posed(head, jaw=0.0) -> np.ndarray:
    still = torch.zeros(1, 1)
    return pose(head, still, still, jaw=torch.tensor([[jaw, 0.0, 0.0]]))[0].double().numpy()


@pytest.mark.parametrize("jaw", [0.0, 0.25])
def test_landmarks_seen_where_they_belong_stay(head, chart, monkeypatch, jaw: float) -> None:
    told(monkeypatch)
    mesh = posed(head, jaw)
    slide = read_slide(head, chart, None, mesh, 1.0)
    assert len(slide.goals) > 45
    marks = landmark_samples(head).at(mesh)
    off = slide.goals - marks[slide.marks]
    assert np.abs(off).max() < 1e-6 and slide.cost(marks) < 1e-9


def test_landmarks_seen_aside_pull_the_mesh_there(head, chart, monkeypatch) -> None:
    told(monkeypatch, shift=2.0)
    mesh = posed(head)
    slide = read_slide(head, chart, None, mesh, 1.0)
    off = slide.goals - landmark_samples(head).at(mesh)[slide.marks]
    # To the right on the chart is the subject's left, +x; a texel is 1.2 to 1.4 mm in front.
    front = np.abs(slide.normals[:, 2]) > 0.9
    assert front.sum() > 15 and 2.0 < 1e3 * np.median(off[front, 0]) < 3.2
    far = read_slide(head, chart, None, mesh + 10_000.0, 1.0)
    np.testing.assert_allclose(far.goals - 10_000.0, slide.goals, atol=1e-6)
    np.testing.assert_allclose(far.sigma, slide.sigma, rtol=1e-4)
    trusted = read_slide(head, chart, None, mesh, 4.0)
    np.testing.assert_allclose(trusted.sigma, 0.5 * slide.sigma)


def test_what_is_not_seen_says_nothing(head, chart, monkeypatch) -> None:
    told(monkeypatch, mass=0.05)
    assert read_slide(head, chart, None, posed(head), 1.0) is None


def test_a_place_needs_two_views(head, chart) -> None:
    mesh = posed(head)
    front = [shot_of(mesh, angle) for angle in (-0.3, 0.3)]
    behind = [shot_of(mesh, angle) for angle in (2.8, 3.4)]
    assert read_slide(head, chart, Moment((), ()), mesh, 1.0) is None
    assert read_slide(head, chart, Moment((), tuple(behind)), mesh, 1.0) is None
    assert read_slide(head, chart, Moment((), (front[0], behind[0])), mesh, 1.0) is None
    assert read_slide(head, chart, Moment((), tuple(front)), mesh, 1.0) is not None
    marks = landmarks(head, torch.from_numpy(mesh).float()[None])[0].numpy()
    np.testing.assert_allclose(landmark_samples(head).at(mesh), marks, atol=1e-6)


def shot_of(mesh: np.ndarray, angle: float) -> Shot:
    """A grey picture from an angle about the head, radians; 0 in front."""
    centre = mesh.mean(0)
    eye = centre + np.array([np.sin(angle), 0.0, np.cos(angle)])
    view = look_at(eye, centre, np.array([0.0, 1.0, 0.0]))
    camera = Camera(f"{angle}", 128, 128, "PINHOLE", (250.0, 250.0, 64.0, 64.0), view)
    return Shot(camera.id, camera, np.full((128, 128, 3), 128, np.uint8), None)


def test_modes_along_the_skin_stay_in_it(head) -> None:
    model = head
    own = len(model.shape_names)
    more = with_modes(model, 6, 1e-3, 0.02, along=4)
    assert len(more.shape_names) == own + 6 + 3 * 4
    shape = np.zeros(own + 18)
    shape[own + 6 :] = np.random.default_rng(0).normal(size=12)
    coefficients, offsets = split_shape(more, shape)
    assert len(coefficients) == own and not coefficients.any()
    skin = model.regions["face"].numpy()
    assert 1e-4 < np.linalg.norm(offsets[skin], axis=1).mean() < 5e-3
    normals = vertex_normals(model.template[None].double(), model.faces)[0].numpy()
    assert np.abs((offsets * normals).sum(1)).max() < 1e-6
    only = with_modes(model, 0, 1e-3, 0.02, along=4)
    assert len(only.shape_names) == own + 12


@pytest.mark.parametrize(
    "wrong", [{"chart_rounds": -1}, {"offset_along": -1}, {"chart_weight": 0.0}]
)
def test_settings_that_cannot_work_are_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError, match="track: "):
        TrackConfig(**wrong)
