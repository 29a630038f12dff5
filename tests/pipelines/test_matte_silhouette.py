"""The silhouette network: what it finds in unseen people, its crops, its weights, its training."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from express50.errors import FormatError
from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at, transform_points
from express50.head.load import load_head
from pipelines.matte import silhouette
from pipelines.matte.cutout import (
    SHIRT,
    CutView,
    HeadPlace,
    average_person,
    chin_and_above,
    guess_person,
    shirts_like_the_wall,
    trunk_of_a_person,
)
from pipelines.matte.silhouette import (
    CROP,
    SPAN_M,
    UP_M,
    SilhouetteNet,
    chances,
    crop_about,
    enlarged,
    load_silhouettes,
    save_silhouettes,
)
from pipelines.matte.silhouette_training import train
from pipelines.matte.silhouette_training.scenes import PersonView, draw_people, draw_scene

UNSEEN = 9000  # training's people have lower numbers


@pytest.fixture(scope="module")
def people() -> list[PersonView]:
    return draw_people(load_head("procedural"), 2, UNSEEN)


def test_unseen_people_are_found_in_drawn_rooms(people: list[PersonView]) -> None:
    rng = np.random.default_rng(4)
    scenes = [draw_scene(view, people[0], rng) for view in people for _ in range(2)]
    found = chances([scene.inputs for scene in scenes]) > 0.5
    true, seen = (np.array([getattr(s, name) > 0.5 for s in scenes]) for name in ("alpha", "seen"))
    wrong = ((found != true) & seen).sum() / seen.sum()
    guess = np.array([scene.inputs[4] for scene in scenes]) > 0.5
    assert wrong < 0.03 < 2 * wrong + ((guess != true) & seen).sum() / seen.sum()


@pytest.mark.parametrize("turn", [0.0, 1.2, 3.0])
def test_a_head_stands_upright_in_the_networks_picture(turn: float) -> None:
    density, chin = 700.0, np.array([310.0, 220.0])
    up = np.array([np.sin(turn), -np.cos(turn)])
    matrix = crop_about(chin, chin + UP_M * density * up, density)
    low, high = transform_points(matrix, np.array([chin, chin + 0.2 * density * up]))
    np.testing.assert_allclose(low, CROP / 2)
    np.testing.assert_allclose(high, [CROP / 2, CROP / 2 - 0.2 / SPAN_M * CROP])


def test_chances_come_back_to_their_pixels_and_are_negative_elsewhere() -> None:
    matrix = crop_about(np.array([100.0, 80.0]), np.array([100.0, 60.0]), 200.0)
    chance = np.zeros((CROP, CROP), np.float32)
    chance[: CROP // 2] = 1
    found = enlarged(chance, matrix, (300, 400))
    assert (found[:79, 60:140][17:] == 1).all() and (found[81:140, 60:140] == 0).all()
    assert (found[:, 200:] == -1).all()


@pytest.mark.parametrize(
    ("views", "chance", "on_head", "on_body"),
    [
        (3, 0.03, cv2.GC_BGD, cv2.GC_PR_BGD),  # few cameras: sure about heads, not about bodies
        (3, 0.003, cv2.GC_BGD, cv2.GC_BGD),
        (3, 0.97, cv2.GC_PR_FGD, cv2.GC_PR_FGD),
        (3, 0.995, cv2.GC_FGD, cv2.GC_PR_FGD),
        (8, 0.03, cv2.GC_BGD, cv2.GC_PR_FGD),  # many cameras: they decide about bodies
        (8, 0.97, cv2.GC_FGD, cv2.GC_PR_FGD),
    ],
)
def test_the_network_decides_about_heads_sooner_than_about_bodies(
    views: int, chance: float, on_head: int, on_body: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    pose = look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    camera = Camera("front", 256, 256, "PINHOLE", (300.0, 300.0, 128.0, 128.0), pose)
    view = CutView(camera, np.zeros((256, 256, 3), np.uint8), np.ones((256, 256), bool))
    place = HeadPlace(1.0, np.eye(3), np.zeros(3))
    monkeypatch.setattr(
        silhouette, "chances", lambda inputs: np.full((len(inputs), CROP, CROP), chance, np.float32)
    )
    chin, above = place.pixels(chin_and_above(), camera)
    crop = crop_about(chin, above, place.density(camera))
    shown = enlarged(np.ones((CROP, CROP), np.float32), crop, view.valid.shape) > 0
    likely = (average_person(view, place) == cv2.GC_PR_FGD) & shown
    body = average_person(view, place, {1: (trunk_of_a_person(),)}) > 0
    guesses, shirts = guess_person([view] * views, place, [body] * views)
    for guess, shirt in zip(guesses, shirts, strict=True):
        assert np.array_equal(shirt, body & shown & (chance > SHIRT))
        assert (likely & ~body).sum() > 500 and (guess[likely & ~body] == on_head).all()
        assert (likely & body).sum() > 500 and (guess[likely & body] == on_body).all()


@pytest.mark.parametrize(("clutter", "kept"), [(1.0, True), (40.0, False)])
def test_a_lost_shirt_is_kept_if_it_has_one_colour(clutter: float, kept: bool) -> None:
    rng = np.random.default_rng(0)
    camera = Camera("front", 96, 96, "PINHOLE", (100.0, 100.0, 48.0, 48.0), np.eye(4))
    cells = np.clip(120 + clutter * rng.normal(size=(12, 12, 3)), 0, 255).astype(np.uint8)
    wall = cv2.resize(cells, (96, 96), interpolation=cv2.INTER_NEAREST)
    view = CutView(camera, wall, np.ones((96, 96), bool))
    shirt, mask, guess = np.zeros((3, 96, 96), np.uint8)
    shirt[50:], mask[:60], guess[:] = 1, 1, cv2.GC_PR_FGD
    guess[:, :10] = cv2.GC_BGD  # somebody else
    (found,) = shirts_like_the_wall([view], [shirt > 0], [guess], [mask > 0])
    expected = (shirt > 0) & (guess != cv2.GC_BGD) & kept
    assert np.array_equal(found, expected)


def test_damaged_weights_are_named(tmp_path: Path) -> None:
    path = tmp_path / "weights.npz"
    path.write_bytes(silhouette.WEIGHTS.read_bytes()[:1000])
    with pytest.raises(FormatError, match="weights.npz.*silhouette weights"):
        load_silhouettes(path)


def test_weights_are_stored_folded_and_give_the_same_answer(tmp_path: Path) -> None:
    torch.manual_seed(0)
    net = SilhouetteNet()
    inputs = torch.rand(2, 7, CROP, CROP)
    net(inputs)  # batch normalisations learn
    expected = net.eval()(inputs).detach().numpy()
    save_silhouettes(net, tmp_path / "weights.npz")
    found = load_silhouettes(tmp_path / "weights.npz")(inputs).detach().numpy()
    np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max())


def test_training_learns(tmp_path: Path, people: list[PersonView]) -> None:
    train.read_people(tmp_path / "people.npz", lambda: people)
    net = train.train([tmp_path / "people.npz"], 25, 0, tmp_path)
    rng = np.random.default_rng(1)
    batch = train.batch_of([draw_scene(view, people[0], rng) for view in people[:8]])
    # Batch normalisations take the batch's moments, because theirs need hundreds of steps.
    first, last = (
        train.scene_loss(one.train()(batch[0]), *batch[1:]).item() for one in (SilhouetteNet(), net)
    )
    assert last < first - 0.2, (first, last)
