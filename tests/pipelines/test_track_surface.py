"""Head crops, samples of the skin, their visibility, and colours that most views agree on."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at
from express50.head.load import load_head
from pipelines.track.appearance import robust_mean
from pipelines.track.surface import COVERED, Visibility, cut_crop, look_up, spread_samples
from tests.pipelines.textured_scenes import (
    RADIUS,
    ball,
    ball_head,
    picture,
    places_on,
    rig,
    seen_weights,
)


def test_robust_mean_leaves_out_a_highlight() -> None:
    rng = np.random.default_rng(0)
    shade = rng.uniform(0.6, 1.4, (6, 50, 3))
    albedo = rng.uniform(0.2, 0.8, (50, 3))
    values = shade * albedo + rng.normal(size=shade.shape) * 0.005
    values[0] += 0.5
    trust = rng.uniform(0.3, 1.0, (6, 50))
    got = robust_mean(values, shade, trust, 0.01)
    np.testing.assert_allclose(got, albedo, atol=0.02)
    plain = (trust[..., None] * shade * values).sum(0) / (trust[..., None] * shade**2).sum(0)
    assert np.abs(got - albedo).mean() < 0.1 * np.abs(plain - albedo).mean()


def test_crops_show_the_same_rays_and_give_up_on_what_is_not_there() -> None:
    camera = rig(size=400, focal=900.0)[1]
    image = np.rint(255 * picture(camera)).astype(np.uint8)
    vertices, _ = ball()
    shot = cut_crop(camera, image, None, vertices, 100)
    assert max(shot.image.shape[:2]) <= 100 and shot.image.shape[1::-1] == (
        shot.camera.width, shot.camera.height,
    )  # fmt: skip
    front = vertices[vertices @ camera.center > 0.5 * RADIUS]
    whole = look_up(camera, cv2.GaussianBlur(image, (0, 0), 2.0).astype(np.float32), front)
    part = look_up(shot.camera, shot.image.astype(np.float32), front)
    assert np.abs(part - whole).mean() < 8.0
    behind = replace(camera, cam_from_world=np.diag([1.0, -1, -1, 1]) @ camera.cam_from_world)
    assert cut_crop(behind, image, None, vertices, 100) is None
    assert cut_crop(camera, image, None, vertices + [5.0, 0, 0], 100) is None


def test_samples_are_deterministic_even_and_on_the_allowed_skin_only() -> None:
    vertices, _ = ball(rings=24)
    face = vertices[:, 1] > -0.03
    model = ball_head(regions={"face": face, "scalp": vertices[:, 1] > 0.08})
    samples, again = spread_samples(model, 3000), spread_samples(model, 3000)
    for one, other in zip(vars(samples).values(), vars(again).values(), strict=True):
        np.testing.assert_array_equal(one, other)
    allowed = face & (vertices[:, 1] <= 0.08)
    assert allowed[samples.vertices].all()
    np.testing.assert_allclose(samples.weights.sum(1), 1.0)
    assert (samples.weights >= 0).all()
    places = samples.at(vertices)
    # Archimedes: equal slices of a sphere have equal area.
    counts, _ = np.histogram(places[:, 1], np.linspace(-0.02, 0.07, 10))
    assert counts.max() < 1.2 * counts.min()
    around, _ = np.histogram(np.arctan2(places[:, 0], places[:, 2]), np.linspace(-np.pi, np.pi, 9))
    assert around.max() < 1.2 * around.min()


def test_samples_of_neck_and_ears_lie_there() -> None:
    model = load_head("procedural")
    samples = spread_samples(model, 900, COVERED)
    inside = np.any([model.regions[name].numpy() for name in COVERED], axis=0)
    assert inside[samples.vertices].all()
    for name in COVERED:
        assert model.regions[name].numpy()[samples.vertices].all(1).sum() > 50


def test_a_head_without_regions_is_skin_all_over() -> None:
    model = ball_head()
    bare = replace(model, regions={})
    assert len(np.unique(spread_samples(bare, 2000).vertices, axis=0)) > 1000


@pytest.mark.parametrize("distance", [0.05, 0.3, 0.46, 0.6, 3.0])
def test_a_plate_hides_another_however_near_the_camera(distance: float) -> None:
    plate = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.01
    vertices = np.concatenate([plate, plate + [0.0, 0.0, 0.02]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    camera = Camera(
        "cam", 100, 100, "PINHOLE", (100.0, 100.0, 50.0, 50.0),
        look_at(np.array([0.0, 0, 0.02 + distance]), np.zeros(3)),
    )  # fmt: skip
    places = np.array([[0.001, 0.002, 0.0], [0.001, 0.002, 0.02]])
    normals = np.tile([0.0, 0.0, 1.0], (2, 1))
    weights = Visibility(vertices, faces).weights(camera, places, normals)
    assert weights[0] == 0 and weights[1] > 0.9


def test_what_is_hidden_or_turned_away_is_not_seen() -> None:
    cameras = rig()
    vertices, faces = ball()
    samples = places_on(faces, vertices)
    places, normals, weights = seen_weights(cameras, samples, vertices, faces)
    for camera, weight in zip(cameras, weights, strict=True):
        way = camera.center - places
        cosine = (way * normals).sum(1) / np.linalg.norm(way, axis=1)
        np.testing.assert_allclose(weight, np.where(cosine > 0.25, cosine, 0.0), atol=1e-9)
    # A second ball between the camera and half of the first.
    shield = vertices * 0.3 + 0.5 * cameras[0].center + [0.0, 0.06, 0.0]
    both = np.concatenate([vertices, shield])
    more = np.concatenate([faces, faces + len(vertices)])
    hidden = Visibility(both, more).weights(cameras[0], places, normals)
    assert set(np.flatnonzero(hidden)) < set(np.flatnonzero(weights[0]))
    gone = (weights[0] > 0) & (hidden == 0)
    assert 0.05 < gone.mean() < 0.9 and places[gone, 1].mean() > places[~gone, 1].mean()
