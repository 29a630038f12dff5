"""The face laid flat: which texel is which place, drawn readings, and what the network finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from express50.errors import HeadModelError
from express50.geometry.raycast import mesh_scene
from express50.head.load import load_head
from express50.landmarks.network import MIRROR, load_network, trainable_network
from pipelines.track.config import UV_WEIGHTS
from pipelines.track.face_uv import (
    FIRST,
    HEIGHT,
    LEFT,
    MARKS,
    SIDE,
    TEXELS_PER_PIXEL,
    UPPER,
    WIDTH,
    make_uv_map,
    mark_places,
    read_marks,
    reading_map,
    to_texels,
    to_window,
    window,
)
from pipelines.track.face_uv_training.cases import Case, Lamps, draw_case, draw_meshes, draw_person
from pipelines.track.face_uv_training.train import (
    UvTrainingPlan,
    creased,
    main,
    make_batch,
    marks_loss,
    mirrored,
    train,
    warped,
    where_seen,
)
from tests.express50.head.tiny_head import tiny_head

# Texels that the mean of all landmarks may lag behind a face that is moved by five.
SHORT = 0.75


@pytest.fixture(scope="module")
def chart(head):
    return make_uv_map(head)


@pytest.fixture(scope="module")
def cases(head, chart):
    rng = np.random.default_rng(77)
    return [draw_case(head, chart, draw_person(head, chart, rng), rng) for _ in range(4)]


def test_a_texel_shows_the_place_it_lies_at(chart) -> None:
    assert len(chart.texels) == WIDTH * HEIGHT
    places = (chart.places[chart.samples.vertices] * chart.samples.weights[..., None]).sum(1)
    np.testing.assert_allclose(places, chart.texels[:, ::-1] + 0.5, atol=1e-6)
    image = chart.image(np.arange(len(chart.texels), dtype=float)[:, None])
    assert len(np.unique(image)) == WIDTH * HEIGHT


def test_landmarks_of_any_head_lie_at_the_same_texels(head, chart) -> None:
    wide = replace(head, template=head.template * torch.tensor([1.15, 0.9, 1.05]))
    for model, flat in ((head, chart), (wide, make_uv_map(wide))):
        corners = model.faces[model.landmark_faces].numpy()
        got = (flat.places[corners] * model.landmark_bary.numpy()[..., None]).sum(1)
        # The ends of the jaw line are where the cylinder turns away, those of the brows where faces
        # are large: the map is bent within them.
        off = np.abs(got - to_texels(MARKS)).max(1)
        assert off[[17, 26]].max() < 0.7
        assert np.delete(off, [*range(17), 17, 26]).max() < 0.6


def test_eyes_and_mouth_are_not_skin_and_a_head_without_regions_is_all_skin(head, chart) -> None:
    at = chart.texels[~chart.skin]
    eyes = to_texels(MARKS[36:48]).mean(0)[1]
    assert 0.002 < (~chart.skin).mean() < 0.05
    assert (np.abs(at[:, 0] - eyes) < 12).mean() > 0.7
    bare = make_uv_map(replace(head, regions={}))
    assert bare.skin.all() and len(bare.texels) == WIDTH * HEIGHT


def test_a_mesh_in_its_true_place_is_not_moved(head, chart, monkeypatch) -> None:
    rng = np.random.default_rng(3)

    def right(*arguments):
        true, _ = draw_meshes(*arguments)
        return true, true

    monkeypatch.setattr("pipelines.track.face_uv_training.cases.draw_meshes", right)
    case = draw_case(head, chart, draw_person(head, chart, rng), rng)
    assert case.valid.mean() > 0.5
    assert np.quantile(np.abs(case.flow[case.valid]), 0.99) < 0.05


def test_displacements_are_as_large_as_the_mesh_is_off(head, chart) -> None:
    rng = np.random.default_rng(4)
    face = np.unique(chart.samples.vertices[chart.skin])
    sizes = []
    for _ in range(12):
        true, wrong = draw_meshes(head, chart, rng)
        sizes.append(np.sqrt(((true - wrong)[face] ** 2).sum(1).mean()))
    assert 4e-4 < min(sizes) < max(sizes) < 5.1e-3


def ramp() -> Case:
    """A reading of a mesh that fits: every texel's colour says where it belongs."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return Case(
        np.stack([x, y, 0 * x], axis=2).astype(np.uint8),
        np.zeros((HEIGHT, WIDTH, 2), np.float16),
        np.ones((HEIGHT, WIDTH), bool),
    )


def test_a_warp_moves_what_is_seen_and_reports_it() -> None:
    middle = (slice(20, -20), slice(20, -20))
    for seed in range(6):
        moved = warped(ramp(), np.random.default_rng(seed))
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        belongs = np.stack([x, y], axis=2) + moved.flow
        shows = moved.colors[..., :2].astype(float)
        # In a mirror the colours of the ramp run the other way.
        if shows[80, 60, 0] > shows[80, 130, 0]:
            shows[..., 0] = WIDTH - 1 - shows[..., 0]
        np.testing.assert_allclose(belongs[middle], shows[middle], atol=0.75)


def test_a_mirror_image_twice_is_the_reading(cases) -> None:
    case = cases[0]
    twice = mirrored(mirrored(case))
    np.testing.assert_array_equal(twice.flow, case.flow)
    np.testing.assert_array_equal(twice.colors, case.colors)
    np.testing.assert_array_equal(mirrored(case).flow[:, ::-1, 0], -case.flow[..., 0])


def test_landmarks_are_where_the_chart_shows_them() -> None:
    """A chart whose every texel shows what belongs three to its right and two below it."""
    shifted = replace(ramp(), flow=np.full((HEIGHT, WIDTH, 2), (3.0, 2.0), np.float16))
    home = to_texels(MARKS)
    at, known = where_seen(shifted, home)
    inner = ((home > 8) & (home < (WIDTH - 8, HEIGHT - 8))).all(1)
    np.testing.assert_allclose(at[inner], (home - (3.0, 2.0))[inner], atol=1e-3)
    assert known.all()
    _, hidden = where_seen(replace(shifted, valid=np.zeros((HEIGHT, WIDTH), bool)), home)
    assert not hidden.any()


def test_each_lip_moves_its_own_rim() -> None:
    """The lower half of the face is shown two texels too low, as by a jaw that is off."""
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float16)
    seam = int(round(to_texels(MARKS)[[62, 66], 1].mean()))
    flow[seam:, :, 1] = -2.0
    at, _ = where_seen(replace(ramp(), flow=flow), to_texels(MARKS))
    off = at - to_texels(MARKS)
    assert np.abs(off[[61, 62, 63], 1]).max() < 1.0 < 1.5 < off[[65, 66, 67], 1].min()


def test_the_shipped_network_finds_landmarks_of_heads_it_has_not_seen(cases) -> None:
    before, after = [], []
    for case in cases:
        for seed in range(4):
            drawn = warped(case, np.random.default_rng(seed))
            true, known = where_seen(drawn, to_texels(MARKS))
            at, error = read_marks(load_network(UV_WEIGHTS), np.float32(drawn.colors) / 255.0)
            assert at.shape == (68 - FIRST, 2) and (error > 0).all()
            shown = known[FIRST:]
            before.append(np.linalg.norm(true[FIRST:] - mark_places(), axis=1)[shown].mean())
            after.append(np.linalg.norm(true[FIRST:] - at, axis=1)[shown].mean())
    assert np.mean(after) < 0.75 * np.mean(before), (before, after)


@pytest.mark.parametrize("shift", [(5, 0), (-5, 0), (0, 5), (0, -5)])
def test_what_is_seen_far_from_home_is_not_read_nearer_to_it(cases, shift) -> None:
    moved = []
    for case in cases:
        colors = np.float32(case.colors) / 255.0
        at, _ = read_marks(load_network(UV_WEIGHTS), colors)
        there, _ = read_marks(load_network(UV_WEIGHTS), np.roll(colors, shift, axis=(1, 0)))
        moved.append((there - at).mean(0))
    assert np.abs(np.mean(moved, axis=0) - shift).max() < SHORT, moved


def test_creases_darken_lips_and_lids_that_are_seen_and_nothing_else() -> None:
    colors = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    at, known = to_texels(MARKS), np.ones(68, dtype=bool)
    rng = np.random.default_rng(3)
    darkest = np.min([creased(colors, at, known, rng) for _ in range(20)], axis=0)[..., 0]
    assert darkest.max() == 200
    column, row = at[[60, 62, 64, 37, 44]].astype(int).T
    assert darkest[row, column].max() < 150
    column, row = at[[8, 19, 24, 30, 41, 57]].astype(int).T
    assert darkest[row, column].min() > 195
    known[62] = False
    lids = np.min([creased(colors, at, known, rng) for _ in range(20)], axis=0)[..., 0]
    column, row = at[[61, 62, 63]].astype(int).T
    assert lids[row, column].min() == 200 and lids.min() < 150


def test_a_mirror_image_is_read_as_one(cases) -> None:
    colors = np.float32(cases[0].colors) / 255.0
    at, error = read_marks(load_network(UV_WEIGHTS), colors)
    flipped, same = read_marks(load_network(UV_WEIGHTS), colors[:, ::-1].copy())
    back = np.stack([WIDTH - flipped[:, 0], flipped[:, 1]], axis=1)
    order = MIRROR[FIRST:] - FIRST
    np.testing.assert_allclose(back[order], at, atol=0.02)
    np.testing.assert_allclose(same[order], error, atol=0.02)


@pytest.mark.parametrize("level", [0.0, 1.0, 1e6])
def test_a_chart_of_one_colour_gives_finite_landmarks(level: float) -> None:
    at, error = read_marks(load_network(UV_WEIGHTS), np.full((HEIGHT, WIDTH, 3), level, np.float32))
    assert np.isfinite(at).all() and np.isfinite(error).all()


def test_the_window_holds_every_landmark(chart) -> None:
    part = reading_map(load_head("procedural"))
    assert len(part.texels) == SIDE * SIDE < len(chart.texels)
    from_window = lambda pixels: pixels * TEXELS_PER_PIXEL + (LEFT, UPPER)  # noqa: E731
    pixels = to_window(mark_places())
    assert pixels.min() > 8 and pixels.max() < 120
    np.testing.assert_allclose(from_window(pixels), mark_places(), atol=1e-9)
    image = chart.image(chart.texels[:, ::-1].astype(np.float32) + 0.5)
    seen = window(image)
    want = from_window(np.stack(np.meshgrid(*[np.arange(128) + 0.5] * 2), axis=2))
    np.testing.assert_allclose(seen[2:-2, 2:-2], want[2:-2, 2:-2], atol=0.05)


def test_training_goes_on_where_it_was_stopped(tmp_path, monkeypatch, head) -> None:
    monkeypatch.setattr("pipelines.track.face_uv_training.train.FILE_CASES", 2)
    monkeypatch.setattr("pipelines.track.face_uv_training.train.BATCH", 2)
    monkeypatch.setattr("express50.landmarks.training.descent.KEEP_EVERY", 2)
    plan = UvTrainingPlan(steps=4, files=1)
    whole = train([head], plan, tmp_path / "one").state_dict()
    steps = iter(range(3))

    def stopped(*arguments):
        next(steps)
        return marks_loss(*arguments)

    monkeypatch.setattr("pipelines.track.face_uv_training.train.marks_loss", stopped)
    with pytest.raises(StopIteration):
        train([head], plan, tmp_path / "two")
    state = torch.load(next((tmp_path / "two").glob("*.pt")), weights_only=True)
    assert state["step"] == 2
    monkeypatch.setattr("pipelines.track.face_uv_training.train.marks_loss", marks_loss)
    again = train([head], plan, tmp_path / "two").state_dict()
    for name, value in whole.items():
        torch.testing.assert_close(again[name], value)


@pytest.mark.parametrize("content", [None, b"no archive", "others", "shapes"])
def test_training_starts_only_from_files_of_weights(tmp_path, capsys, content) -> None:
    path = tmp_path / "start.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        names = trainable_network().state_dict() if content == "shapes" else ["weight"]
        np.savez(path, **{name: np.zeros(1, np.float16) for name in names})
    with pytest.raises(SystemExit):
        main(["--cases", str(tmp_path), "--start", str(path)])
    message = capsys.readouterr().err
    why = "no such file" if content is None else "not landmark weights"
    assert f"start.npz: {why}" in message and "Traceback" not in message


def test_training_lowers_the_loss(cases) -> None:
    net = trainable_network().train()
    optimiser = torch.optim.Adam(net.parameters(), 1e-3)
    losses = []
    for _ in range(12):
        loss, _ = marks_loss(net, make_batch(cases[:2]))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]


def test_a_head_whose_eyes_coincide_is_named(head) -> None:
    faces = head.landmark_faces.clone()
    bary = head.landmark_bary.clone()
    faces[45], bary[45] = faces[36], bary[36]
    with pytest.raises(HeadModelError, match="landmarks 36 and 45"):
        make_uv_map(replace(head, landmark_faces=faces, landmark_bary=bary))


def test_a_tiny_head_has_a_chart_too() -> None:
    chart = make_uv_map(tiny_head(vertices=60))
    assert len(chart.texels) > 100 and np.isfinite(chart.samples.weights).all()


def test_what_stands_in_the_way_takes_the_light() -> None:
    square = np.array([[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]])
    lid = 0.05 * square + [0.0, 0.01, 0.0]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    scene = mesh_scene(np.concatenate([square, lid]), np.concatenate([faces, faces + 4]))
    lamps = Lamps(
        even=np.ones(3),
        sky=np.array([0.0, 1.0, 0.0]),
        directions=np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]),
        colors=np.ones((2, 3)),
        sizes=np.array([0.01, 0.01]),
        shine=10.0,
    )
    places = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.055, 0.0, 0.0]])
    up = np.tile([0.0, 1.0, 0.0], (3, 1))
    reach = lamps.reach(scene, places, up, np.random.default_rng(0))
    # Under the lid all but flat rays end; beside it the lamp above is free; the lower never shines.
    assert reach[0, 0] < 0.2 and np.array_equal(reach[0, 1:], [0.0, 0.0])
    assert np.array_equal(reach[1], [1.0, 1.0, 0.0])
    assert reach[0, 0] < reach[2, 0] < 1.0 and reach[2, 1] == 1.0
    lit = lamps.lit(np.full((3, 3), 0.5), up, reach, up, gloss=0.1)
    assert lit[0].max() < 0.2 * lit[1].max()
