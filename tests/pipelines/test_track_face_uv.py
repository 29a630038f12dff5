"""Where the skin belongs along itself: exact derivatives, a drawn head, silence where unseen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at
from express50.head.model import landmarks, pose, vertex_normals
from pipelines.track.basis import split_shape, with_modes
from pipelines.track.face_uv import (
    DISTRUST,
    HEIGHT,
    WIDTH,
    mark_places,
    reading_map,
    slide_term,
    with_slide,
)
from pipelines.track.state import Target
from pipelines.track.surface import FrameSetCrops, HeadCrop
from pipelines.track.terms import MeshPlaces, SlideTerm, information, landmark_anchors
from tests.pipelines.term_checks import cost_at, gradient_at, slope_along


def random_slide(seed: int, scale: float = 1e-3) -> tuple[SlideTerm, np.ndarray]:
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(9, 3)) * 0.05
    ids = rng.permutation(9)[:5]
    normals = rng.normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    goals = vertices[ids] + scale * rng.normal(size=(5, 3))
    sigma = rng.uniform(5e-4, 2e-3, 5)
    return SlideTerm(MeshPlaces.of_vertices(ids), 17 + ids, goals, normals, sigma), vertices


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([1e-5, 1e-3, 1e-2]))
def test_the_gradient_is_that_of_the_cost(seed: int, scale: float) -> None:
    slide, vertices = random_slide(seed, scale)
    gradient = gradient_at(slide, vertices)
    way = np.random.default_rng(seed + 1).normal(size=vertices.shape)
    size = np.linalg.norm(gradient) * np.linalg.norm(way)
    expected = (gradient * way).sum()
    assert slope_along(slide, vertices, way) == pytest.approx(expected, abs=1e-5 * size + 1e-6)


def test_what_lies_along_the_normal_counts_nothing() -> None:
    slide, vertices = random_slide(1)
    above = replace(slide, goals=slide.anchors.at(vertices) + 0.002 * slide.normals)
    matrix, gradient = information(above, above.anchors.at(vertices))
    assert cost_at(above, vertices) < 1e-20 and np.abs(gradient).max() < 1e-9
    assert np.abs(np.einsum("sij,sj->si", matrix, slide.normals)).max() < 1e-6
    assert np.linalg.eigvalsh(matrix).min() > -1e-3


def test_far_goals_lose_their_pull() -> None:
    slide, vertices = random_slide(2, 1e-3)
    far, _ = random_slide(2, 1.0)
    pulls = [np.abs(gradient_at(one, vertices)).max() for one in (far, slide)]
    assert pulls[0] < 0.1 * pulls[1]
    assert np.isfinite(cost_at(far, vertices))


def test_only_what_was_read_becomes_a_term() -> None:
    slide, _ = random_slide(3)
    target = target_of(np.ones((2, 68)))
    assert with_slide(target, None) is target
    assert with_slide(target, slide).terms == (slide,)


def target_of(sigma: np.ndarray) -> Target:
    return Target(None, sigma, False)  # type: ignore[arg-type]


def test_the_map_takes_trust_from_the_landmarks_it_reads() -> None:
    slide, _ = random_slide(3)
    target = target_of(np.where(np.arange(68) % 7, 1.5, np.inf)[None].repeat(2, 0))
    made = with_slide(target, slide)
    read = np.isin(np.arange(68), slide.marks)
    np.testing.assert_array_equal(made.sigma[:, ~read], target.sigma[:, ~read])
    np.testing.assert_array_equal(made.sigma[:, read], DISTRUST * target.sigma[:, read])
    assert np.nanmax(target.sigma[np.isfinite(target.sigma)]) == 1.5, "not changed in place"


@pytest.fixture(scope="module")
def chart(head):
    return reading_map(head)


def read_as(monkeypatch, shift=0.0, mass=1.0) -> None:
    """Let every landmark be seen `shift` texels to the right of where it belongs."""
    at = mark_places() + (shift, 0.0)
    image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    seen = np.full((HEIGHT, WIDTH), mass, np.float32)
    monkeypatch.setattr("pipelines.track.face_uv.unwrap", lambda *_: (image, seen))
    monkeypatch.setattr("pipelines.track.face_uv.read_marks", lambda *_: (at, np.full(51, 0.5)))


def posed(head, jaw=0.0) -> np.ndarray:
    still = torch.zeros(1, 1)
    return pose(head, still, still, jaw=torch.tensor([[jaw, 0.0, 0.0]]))[0].double().numpy()


@pytest.mark.parametrize("jaw", [0.0, 0.25])
def test_landmarks_seen_where_they_belong_stay(head, chart, monkeypatch, jaw: float) -> None:
    read_as(monkeypatch)
    mesh = posed(head, jaw)
    slide = slide_term(head, chart, None, mesh)
    assert len(slide.goals) > 45
    marks = landmark_anchors(head).at(mesh)
    off = slide.goals - marks[slide.marks]
    assert np.abs(off).max() < 1e-6 and cost_at(slide, mesh) < 1e-9


def test_landmarks_seen_aside_pull_the_mesh_there(head, chart, monkeypatch) -> None:
    read_as(monkeypatch, shift=2.0)
    mesh = posed(head)
    slide = slide_term(head, chart, None, mesh)
    off = slide.goals - landmark_anchors(head).at(mesh)[slide.marks]
    # To the right on the chart is the subject's left, +x; a texel is 1.2 to 1.4 mm in front.
    front = np.abs(slide.normals[:, 2]) > 0.9
    assert front.sum() > 10 and 2.0 < 1e3 * np.median(off[front, 0]) < 3.2
    far = slide_term(head, chart, None, mesh + 10_000.0)
    np.testing.assert_allclose(far.goals - 10_000.0, slide.goals, atol=1e-6)
    np.testing.assert_allclose(far.sigma, slide.sigma, rtol=1e-4)


def test_what_is_hardly_seen_or_in_hair_gives_no_term(head, chart, monkeypatch) -> None:
    read_as(monkeypatch)
    mesh, covered = posed(head), np.zeros(len(head.template), bool)
    covered[landmark_anchors(head).vertices[48:]] = True  # the mouth
    assert slide_term(head, chart, None, mesh, covered).marks.max() < 48
    covered[:] = True
    assert slide_term(head, chart, None, mesh, covered) is None
    read_as(monkeypatch, mass=0.05)
    assert slide_term(head, chart, None, mesh) is None


def test_a_place_needs_two_views(head, chart) -> None:
    mesh = posed(head)
    front = [shot_of(mesh, angle) for angle in (-0.3, 0.3)]
    behind = [shot_of(mesh, angle) for angle in (2.8, 3.4)]
    assert slide_term(head, chart, FrameSetCrops((), ()), mesh) is None
    assert slide_term(head, chart, FrameSetCrops((), tuple(behind)), mesh) is None
    assert slide_term(head, chart, FrameSetCrops((), (front[0], behind[0])), mesh) is None
    assert slide_term(head, chart, FrameSetCrops((), tuple(front)), mesh) is not None
    marks = landmarks(head, torch.from_numpy(mesh).float()[None])[0].numpy()
    np.testing.assert_allclose(landmark_anchors(head).at(mesh), marks, atol=1e-6)


def shot_of(mesh: np.ndarray, angle: float) -> HeadCrop:
    """A grey picture from an angle about the head, radians; 0 in front."""
    centre = mesh.mean(0)
    eye = centre + np.array([np.sin(angle), 0.0, np.cos(angle)])
    view = look_at(eye, centre)
    camera = Camera(f"{angle}", 128, 128, "PINHOLE", (250.0, 250.0, 64.0, 64.0), view)
    return HeadCrop(camera, np.full((128, 128, 3), 128, np.uint8), None)


def test_modes_along_the_skin_stay_in_it(head) -> None:
    model = head
    own = len(model.shape_names)
    more = with_modes(model, 6, along=4)
    assert len(more.shape_names) == own + 6 + 3 * 4
    shape = np.zeros(own + 18)
    shape[own + 6 :] = np.random.default_rng(0).normal(size=12)
    coefficients, offsets = split_shape(more, shape)
    assert len(coefficients) == own and not coefficients.any()
    skin = model.regions["face"].numpy()
    assert 1e-4 < np.linalg.norm(offsets[skin], axis=1).mean() < 5e-3
    normals = vertex_normals(model.template[None].double(), model.faces)[0].numpy()
    assert np.abs((offsets * normals).sum(1)).max() < 1e-6
    only = with_modes(model, 0, along=4)
    assert len(only.shape_names) == own + 12
