"""The search of the surface: exact derivatives, heights on a painted sphere, silence elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.track import photo_consistency
from pipelines.track.photo_consistency import PatchViews, _patches, surface_term
from pipelines.track.photo_consistency import search as search_patches
from pipelines.track.terms import MeshPlaces, NormalTerm, information
from tests.pipelines.term_checks import cost_at, gradient_at, slope_along
from tests.pipelines.textured_scenes import (
    ORIGIN,
    RADIUS,
    ball,
    picture,
    places_on,
    rig,
    seen_weights,
    true_heights,
)

REACH = 0.006


def search(cameras, images, radius=RADIUS + 0.003, weights=None, centre=ORIGIN):
    """Search from a sphere of another radius: the sweep, samples, places, normals."""
    vertices, faces = ball(radius, centre=centre)
    samples = places_on(faces, vertices - centre)
    places, normals, seen = seen_weights(cameras, samples, vertices, faces)
    weights = seen**2 if weights is None else weights
    images = list(zip(images, cameras, strict=True))
    views = PatchViews(images, weights, places, normals, vertices, faces)
    return search_patches(views, REACH), samples, places, normals


def relief_of(found, samples, places, normals) -> NormalTerm | None:
    return surface_term(found, samples, places, normals, 1.0)


@pytest.fixture(scope="module")
def pictures():
    cameras = rig()
    return cameras, [picture(camera).mean(2) for camera in cameras]


@pytest.mark.parametrize("millimetres", [-4.0, -2.0, 2.0, 3.0])
def test_heights_are_found_to_a_fraction_of_a_pixel(pictures, millimetres: float) -> None:
    found, samples, places, normals = search(*pictures, RADIUS + 1e-3 * millimetres)
    truth = true_heights(places, normals)
    relief = relief_of(found, samples, places, normals)
    assert abs(np.median(truth) + 1e-3 * millimetres) < 2e-4
    assert found.pixel == pytest.approx(1 / (2.2 * 256), rel=0.15)
    kept = np.flatnonzero(
        (samples.vertices[:, None] == relief.anchors.vertices[None]).all(2).any(1)
    )
    assert len(relief.goals) > 0.7 * len(truth)
    error = np.abs(found.height - truth)[kept] / found.pixel
    assert np.median(error) < 0.15 and np.quantile(error, 0.9) < 0.5
    radii = np.linalg.norm(relief.goals, axis=1)
    assert np.median(np.abs(radii - RADIUS)) < 0.15 * found.pixel
    assert (relief.sigma > 0.3 * found.pixel).all() and np.isfinite(relief.sigma).all()


def test_derivatives_and_a_step() -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(30, 3)) * 0.01
    corners, normals = rng.integers(0, 30, (50, 3)), rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    anchors = MeshPlaces(corners, rng.dirichlet(np.ones(3), 50))
    goals = anchors.at(vertices) + rng.normal(size=(50, 3)) * 0.003
    term = NormalTerm(anchors, goals, normals, rng.uniform(1e-3, 3e-3, 50), 4e-3)
    eigenvalues = np.linalg.eigvalsh(information(term, anchors.at(vertices))[0])
    assert (eigenvalues > -1e-9 * eigenvalues.max()).all() and (eigenvalues[:, 2] > 0).all()
    full = gradient_at(term, vertices)
    for vertex in range(0, 30, 5):
        for axis in range(3):
            way = np.zeros((30, 3))
            way[vertex, axis] = 1.0
            slope = slope_along(term, vertices, way)
            assert full[vertex, axis] == pytest.approx(slope, rel=1e-5, abs=1e-4)
    assert cost_at(term, vertices - 1e-8 * full) < cost_at(term, vertices)


def nothing(found, *rest) -> bool:
    assert all(np.isfinite(x).all() for x in (found.height, found.score, found.sharpness))
    relief = relief_of(found, *rest)
    return relief is None or len(relief.goals) < 0.02 * len(found.height)


def test_skin_without_texture_gives_no_measurement() -> None:
    cameras = rig()
    lit = [picture(c, colour=lambda p: 0.6 + 2.0 * p).mean(2) for c in cameras]
    assert nothing(*search(cameras, lit))
    rng = np.random.default_rng(1)
    noisy = [image + rng.normal(size=image.shape).astype(np.float32) * 0.004 for image in lit]
    assert nothing(*search(cameras, noisy))


def test_one_view_or_the_same_view_twice_gives_no_measurement(pictures) -> None:
    cameras, images = pictures
    assert nothing(*search(cameras[:1], images[:1]))
    assert nothing(*search(cameras[:1] * 2, images[:1] * 2))
    assert nothing(*search([], [], weights=np.zeros((0, 400))))
    assert nothing(*search(cameras, images, weights=np.zeros((4, 400))))


def test_only_places_that_two_views_see_are_compared(pictures, monkeypatch) -> None:
    cameras, images = pictures
    vertices, faces = ball(RADIUS + 0.003)
    samples = places_on(faces, vertices)
    weights = seen_weights(cameras, samples, vertices, faces)[2] ** 2
    weights[1:, ::2] = 0.0  # half of the places are left to one view
    compared = []

    def count(image, camera, places, *rest):
        compared.append(len(places))
        return _patches(image, camera, places, *rest)

    monkeypatch.setattr(photo_consistency, "_patches", count)
    whole = search(cameras, images)[0]
    del compared[:]
    half = search(cameras, images, weights=weights)[0]
    assert 0 < sum(compared) <= (weights[:, 1::2] > 0).sum()
    assert (half.score[::2] == 0).all() and (half.score[1::2] > 0.5).any()
    np.testing.assert_allclose(half.score[1::2], whole.score[1::2], atol=1e-6)
    del compared[:]
    search(cameras[:1], images[:1])
    assert not compared


def test_a_view_that_shows_something_else_is_outvoted(pictures) -> None:
    cameras, images = pictures
    wrong = picture(cameras[1], colour=lambda p: 1 - np.sin(300 * p[:, [1, 2, 0]])).mean(2)
    found, samples, places, normals = search(cameras, [images[0], wrong, *images[2:]])
    relief = relief_of(found, samples, places, normals)
    radii = np.linalg.norm(relief.goals, axis=1)
    assert len(radii) > 100 and np.median(np.abs(radii - RADIUS)) < 0.5 * found.pixel


def test_a_wrong_patch_among_right_ones_is_left_out(pictures) -> None:
    found, samples, places, normals = search(*pictures)
    bad = np.arange(0, 400, 40)
    found.height[bad] += 4 * found.pixel
    relief = relief_of(found, samples, places, normals)
    off = np.abs(np.linalg.norm(relief.goals, axis=1) - RADIUS)
    assert off.max() < 2.0 * found.pixel


def test_too_few_samples_are_refused(pictures) -> None:
    found, samples, places, normals = search(*pictures)
    some = slice(0, 30)
    few = type(found)(found.height[some], found.score[some], found.sharpness[some], found.pixel)
    part = samples.some(some)
    assert surface_term(few, part, places[some], normals[some], 1.0) is None


@pytest.mark.parametrize("centre", [(1000.0, 0, 0), (-300.0, 1000.0, 700.0)])
def test_the_search_does_not_depend_on_the_origin(pictures, centre) -> None:
    here, *_ = search(*pictures)
    centre = np.array(centre)
    cameras = rig(centre=centre)
    images = [picture(camera, centre).mean(2) for camera in cameras]
    there, *_ = search(cameras, images, centre=centre)
    sure = here.sharpness > 0.05
    assert sure.mean() > 0.7
    assert np.quantile(np.abs(there.height - here.height)[sure], 0.95) < 0.05 * here.pixel
