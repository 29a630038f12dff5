"""Hair and things on the face: colours unlike it, and landmarks that are not trusted there.

A bare skull is recognised by what the pictures show of it, not by their rims.
"""

import numpy as np
import pytest
import torch

from express50.geometry.cameras import Camera, crop_camera, unproject
from express50.geometry.transforms import look_at
from express50.head.load import load_head
from express50.head.model import pose
from pipelines.regions.colour import SKIN as FACE_SKIN
from pipelines.regions.colour import like_skin, like_skin_around
from pipelines.regions.geometry import SCALP, head_labels, make_head, render_head
from pipelines.track.observe import LandmarkView, Observation
from pipelines.track.schedule import (
    HAIR_FACTOR,
    NEAR_THING_FACTOR,
    NEAR_THING_M,
    is_bald,
    widened_sigma,
)
from pipelines.track.state import Target
from pipelines.track.surface import FrameSetCrops, HeadCrop
from pipelines.track.terms import landmark_anchors
from tests.pipelines.textured_scenes import rig


def test_shading_is_like_skin_and_hair_is_not():
    rng = np.random.default_rng(0)
    skin = np.log([0.8, 0.6, 0.5]) + rng.normal(0, 0.15, (400, 1)) + rng.normal(0, 0.01, (400, 3))
    hair = np.log([0.2, 0.15, 0.12]) + rng.normal(0, 0.1, (100, 1))
    face = np.concatenate([skin, hair])
    assert like_skin(skin, face).mean() > 0.95 and not like_skin(hair, face).any()


@pytest.mark.parametrize(("other", "alike"), [((0.45, 0.5, 0.6), True), ((0.2, 0.2, 0.2), False)])
def test_another_light_on_one_side_is_not_hair(other: tuple[float, ...], alike: bool) -> None:
    """The other side is lit in blue, or most of it is covered by dark hair."""
    rng = np.random.default_rng(0)
    left = np.arange(400) < 200
    colours = np.where((np.arange(400) < 170)[:, None], other, (0.8, 0.6, 0.5))
    face = np.log(colours) + rng.normal(0, 0.1, (400, 1)) + rng.normal(0, 0.01, (400, 3))
    found = like_skin_around(face, left)
    assert found[~left].mean() > 0.95 and (found[:170].mean() > 0.95) == alike
    none = np.zeros(400, bool)
    assert not like_skin_around(face, none)[:170].any()


def target_of(cameras) -> Target:
    """Views that see all landmarks in a row, 20 pixels apart."""
    points = np.stack([20.0 * np.arange(68), np.full(68, 100.0)], axis=1)
    views = tuple(LandmarkView(c, points, np.full(68, 2.0), 1.0) for c in cameras)
    none = np.full((68, 3), np.nan)
    seen = Observation("neutral", 0, views, np.ones((len(views), 68), bool), none, none[:, None])
    return Target(seen, np.full((len(views), 68), 2.0), neutral=True)


def test_landmarks_in_a_beard_are_uncertain_and_its_edge_is_not_the_jaw():
    model = load_head("procedural")
    hidden, things = np.zeros(len(model.template), bool), np.zeros((0, 3))
    target = target_of(rig()[:2])
    assert np.array_equal(widened_sigma(model, target, hidden, things), target.sigma)
    anchors = landmark_anchors(model).vertices
    hidden[anchors[[8, 57]]] = True
    found = widened_sigma(model, target, hidden, things)
    assert np.isinf(found[:, 8]).all() and (found[:, 57] == 2.0 * HAIR_FACTOR).all()
    assert (found[:, 36] == 2.0).all()


def test_landmarks_on_a_thing_are_uncertain_where_it_is_seen_and_those_beside_it_less_so():
    model, (one, other) = load_head("procedural"), rig()[:2]
    hidden, target = np.zeros(len(model.template), bool), target_of((one, other))
    # Before landmark 10 in one camera; the other sees it elsewhere.
    at = target.observation.views[0].points[10]
    thing = unproject(one, at[None], np.array([0.9]))
    found = widened_sigma(model, target, hidden, thing)
    pixel = 0.9 / one.K[0, 0]
    near = np.flatnonzero(20 * pixel * np.abs(np.arange(68) - 10) < NEAR_THING_M)
    assert np.isinf(found[0, 10])
    assert (found[0, near[near != 10]] == 2.0 * NEAR_THING_FACTOR).all()
    assert (np.delete(found[0], near) == 2.0).all()
    assert not np.array_equal(found[0], found[1])


SIZE, FOCAL = 400, 900.0
SKIN, HAIR = (200, 150, 125), (110, 80, 62)


@pytest.fixture(scope="module")
def scene():
    """The head at rest, two cameras before it, and what each of their pixels shows."""
    head = load_head("procedural")
    still = torch.zeros(1, 1)
    mesh = pose(head, still, still)[0].double().numpy()
    views = []
    for side in (-0.2, 0.2):
        eye = mesh.mean(0) + [side, 0.25, 0.9]
        params = (FOCAL, FOCAL, SIZE / 2, SIZE / 2)
        camera = Camera("cam", SIZE, SIZE, "PINHOLE", params, look_at(eye, mesh.mean(0)))
        labels, _ = render_head(make_head(mesh, np.eye(3), head_labels(head)), camera)
        views.append((camera, labels))
    return head, mesh, views


def bald(
    scene, hair: bool, shade: float = 1.0, noise: float = 0.0, first_row: int = 0, count: int = 2
) -> bool:
    """Judge a head with hair or skin on its scalp, one half of it in shade, in sensor noise."""
    head, mesh, views = scene
    random = np.random.default_rng(0)
    crops = []
    for camera, labels in views[:count]:
        grown = hair & ((labels == SCALP) | (labels == 0))
        image = np.where(grown[..., None], HAIR, SKIN).astype(np.float32)
        image[:, : SIZE // 2] *= shade
        image += random.normal(0, noise, image.shape)
        image = image.clip(0, 255).round().astype(np.uint8)[first_row:]
        cut = crop_camera(camera, 0, first_row, SIZE, SIZE - first_row)
        crops.append(HeadCrop(cut, image, np.full(image.shape[:2], 255, np.uint8)))
    return is_bald(head, FrameSetCrops((), tuple(crops)), mesh, np.eye(3))


def test_hair_above_the_face_is_not_taken_for_a_bald_head(scene):
    assert not bald(scene, hair=True)
    assert bald(scene, hair=False)
    assert not bald(scene, hair=False, count=1), "it may be fair hair"


@pytest.mark.parametrize("shade", [0.2, 0.35, 0.6])
def test_hair_in_hard_light_is_not_taken_for_a_bald_head(scene, shade):
    assert not bald(scene, hair=True, shade=shade)
    assert bald(scene, hair=False, shade=0.8)


def test_noise_is_not_taken_for_hair(scene):
    assert bald(scene, hair=False, noise=25.0) and not bald(scene, hair=True, noise=25.0)


def test_a_skull_outside_the_picture_is_not_seen(scene):
    face = min(np.flatnonzero((labels == FACE_SKIN).any(1))[0] for _, labels in scene[2])
    assert bald(scene, hair=False) and not bald(scene, hair=False, first_row=int(face))
