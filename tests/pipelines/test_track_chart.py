"""The face laid flat: which texel is which place, drawn readings, and what the network finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.head.load import load_head
from express50.head.model import landmarks
from express50.landmarks.augment import MIRROR
from express50.landmarks.network import trainable_network
from pipelines.track.chart.cases import draw_case, draw_meshes, draw_person
from pipelines.track.chart.disturb import mirrored, warped, where_seen
from pipelines.track.chart.files import FILE_CASES, make_cases, read_cases
from pipelines.track.chart.layout import HEIGHT, MARKS, WIDTH, make_chart, to_texels
from pipelines.track.chart.network import (
    FIRST,
    SIDE,
    from_window,
    mark_places,
    read_marks,
    reading_chart,
    to_window,
    window,
)
from pipelines.track.chart.train import Plan, make_batch, marks_loss, train
from pipelines.track.slide import load_once
from tests.express50.head.tiny_head import tiny_head


@pytest.fixture(scope="module")
def head():
    return load_head("procedural")


@pytest.fixture(scope="module")
def chart(head):
    return make_chart(head)


@pytest.fixture(scope="module")
def cases(head, chart):
    rng = np.random.default_rng(77)
    return [draw_case(head, chart, draw_person(head, chart, rng), rng) for _ in range(4)]


def test_a_texel_shows_the_place_it_lies_at(chart) -> None:
    assert len(chart.texels) == WIDTH * HEIGHT
    places = (chart.places[chart.samples.corners] * chart.samples.bary[..., None]).sum(1)
    np.testing.assert_allclose(places, chart.texels[:, ::-1] + 0.5, atol=1e-6)
    image = chart.image(np.arange(len(chart.texels), dtype=float)[:, None])
    assert len(np.unique(image)) == WIDTH * HEIGHT


def test_landmarks_of_any_head_lie_at_the_same_texels(head, chart) -> None:
    wide = replace(head, template=head.template * torch.tensor([1.15, 0.9, 1.05]))
    for model, flat in ((head, chart), (wide, make_chart(wide))):
        corners = model.faces[model.landmark_faces].numpy()
        got = (flat.places[corners] * model.landmark_bary.numpy()[..., None]).sum(1)
        # The ends of the jaw line are where the cylinder turns away.
        assert np.abs(got - to_texels(MARKS))[17:].max() < 0.6


def test_eyes_and_mouth_are_not_skin_and_a_head_without_regions_is_all_skin(head, chart) -> None:
    at = chart.texels[~chart.skin]
    eyes = to_texels(MARKS[36:48]).mean(0)[1]
    assert 0.002 < (~chart.skin).mean() < 0.05
    assert (np.abs(at[:, 0] - eyes) < 12).mean() > 0.7
    bare = make_chart(replace(head, regions={}))
    assert bare.skin.all() and len(bare.texels) == WIDTH * HEIGHT


def test_where_nothing_is_off_nothing_is_to_be_moved(head, chart, monkeypatch) -> None:
    rng = np.random.default_rng(3)

    def right(*arguments):
        true, _ = draw_meshes(*arguments)
        return true, true

    monkeypatch.setattr("pipelines.track.chart.cases.draw_meshes", right)
    case = draw_case(head, chart, draw_person(head, chart, rng), rng)
    assert case.valid.mean() > 0.5
    assert np.quantile(np.abs(case.flow[case.valid]), 0.99) < 0.05


def test_displacements_are_as_large_as_the_mesh_is_off(head, chart) -> None:
    rng = np.random.default_rng(4)
    face = np.unique(chart.samples.corners[chart.skin])
    sizes = []
    for _ in range(12):
        true, wrong = draw_meshes(head, chart, rng)
        sizes.append(np.sqrt(((true - wrong)[face] ** 2).sum(1).mean()))
    assert 4e-4 < min(sizes) < max(sizes) < 5.1e-3


def test_a_warp_moves_what_is_seen_and_says_so(cases) -> None:
    """What belongs to a texel has the same colour before and after."""
    rng = np.random.default_rng(5)
    for case in cases:
        moved = warped(case, rng)
        assert moved.colors.shape == case.colors.shape and moved.valid.dtype == bool
        assert (moved.flow[moved.valid] != case.flow[moved.valid]).any()
        twice = mirrored(mirrored(case))
        np.testing.assert_array_equal(twice.flow, case.flow)
        np.testing.assert_array_equal(twice.colors, case.colors)
        np.testing.assert_array_equal(mirrored(case).flow[:, ::-1, 0], -case.flow[..., 0])


def test_the_shipped_network_finds_landmarks_of_heads_it_has_not_seen(cases) -> None:
    before, after = [], []
    for case in cases:
        for seed in range(4):
            drawn = warped(case, np.random.default_rng(seed))
            true, known = where_seen(drawn, to_texels(MARKS))
            at, error = read_marks(load_once(), np.float32(drawn.colors) / 255.0)
            assert at.shape == (68 - FIRST, 2) and (error > 0).all()
            shown = known[FIRST:]
            before.append(np.linalg.norm(true[FIRST:] - mark_places(), axis=1)[shown].mean())
            after.append(np.linalg.norm(true[FIRST:] - at, axis=1)[shown].mean())
    assert np.mean(after) < 0.75 * np.mean(before), (before, after)


def test_a_mirror_image_is_read_as_one(cases) -> None:
    colors = np.float32(cases[0].colors) / 255.0
    at, error = read_marks(load_once(), colors)
    flipped, same = read_marks(load_once(), colors[:, ::-1].copy())
    back = np.stack([WIDTH - flipped[:, 0], flipped[:, 1]], axis=1)
    order = MIRROR[FIRST:] - FIRST
    np.testing.assert_allclose(back[order], at, atol=0.02)
    np.testing.assert_allclose(same[order], error, atol=0.02)


@pytest.mark.parametrize("level", [0.0, 1.0, 1e6])
def test_a_chart_of_one_colour_gives_finite_landmarks(level: float) -> None:
    at, error = read_marks(load_once(), np.full((HEIGHT, WIDTH, 3), level, np.float32))
    assert np.isfinite(at).all() and np.isfinite(error).all()


def test_the_window_holds_every_landmark(chart) -> None:
    part = reading_chart(load_head("procedural"))
    assert len(part.texels) == SIDE * SIDE < len(chart.texels)
    pixels = to_window(mark_places())
    assert pixels.min() > 8 and pixels.max() < 120
    np.testing.assert_allclose(from_window(pixels), mark_places(), atol=1e-9)
    image = chart.image(chart.texels[:, ::-1].astype(np.float32) + 0.5)
    seen = window(image)
    want = from_window(np.stack(np.meshgrid(*[np.arange(128) + 0.5] * 2), axis=2))
    np.testing.assert_allclose(seen[2:-2, 2:-2], want[2:-2, 2:-2], atol=0.05)


def test_training_lowers_the_loss_and_goes_on_where_it_was_stopped(
    tmp_path, monkeypatch, head
) -> None:
    monkeypatch.setattr("pipelines.track.chart.files.FILE_CASES", 2)
    monkeypatch.setattr("pipelines.track.chart.train.BATCH", 2)
    monkeypatch.setattr("pipelines.track.chart.train.KEEP_EVERY", 3)
    assert FILE_CASES > 2
    plan = Plan(steps=6, files=1)
    whole = train([head], plan, tmp_path / "one").state_dict()
    kept = make_cases(tmp_path / "one", head, 1, 0)
    assert len(read_cases(kept)) == 2
    state = torch.load(next((tmp_path / "one").glob("*.pt")), weights_only=True)
    assert state["step"] == 6
    again = train([head], plan, tmp_path / "one").state_dict()
    for name, value in whole.items():
        torch.testing.assert_close(again[name], value)
    cases, net = read_cases(kept), trainable_network().train()
    optimiser = torch.optim.Adam(net.parameters(), 1e-3)
    losses = []
    for _ in range(12):
        loss, _ = marks_loss(net, make_batch(cases))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]


def test_a_tiny_head_has_a_chart_too() -> None:
    tiny = tiny_head(vertices=60)
    chart = make_chart(tiny)
    assert np.isfinite(chart.samples.bary).all()
    assert landmarks(tiny, tiny.template[None]).shape == (1, 68, 3)
