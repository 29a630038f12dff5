"""Colours compared between views: exact derivatives, steps that lead home, detail, samples."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at
from express50.head.load import load_head
from pipelines.track.photometry import Photometry, Picture, bilinear, look, robust_mean
from pipelines.track.samples import COVERED, Visibility, spread
from pipelines.track.shots import Shot, cut_shot, detail
from tests.pipelines.textured_scenes import (
    RADIUS,
    ball,
    ball_head,
    paint,
    picture,
    places_on,
    rig,
    seen_weights,
)


def smooth(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), 1.5)


def make_term(tie: float, sigma: float = 0.02, seed: int = 0):
    """A term on the sphere's exact mesh, and that mesh."""
    cameras = rig()
    vertices, faces = ball()
    samples = places_on(faces, vertices, 300)
    places, normals, weights = seen_weights(cameras, samples, vertices, faces)
    rng = np.random.default_rng(seed)
    pictures = []
    for camera, weight in zip(cameras, weights, strict=True):
        gain = rng.uniform(0.8, 1.25, 3)
        shade = np.tile(gain, (len(places), 1)) * (0.9 + 2.0 * places[:, :1])
        image = smooth(
            picture(camera, colour=lambda p, g=gain: g * (0.9 + 2 * p[:, :1]) * paint(p))
        )
        pictures.append(Picture(camera, image, weight, shade))
    values = np.stack([look(p.camera, p.image, places)[0] for p in pictures])
    albedo = robust_mean(values, np.stack([p.shade for p in pictures]), weights, 20.0)
    return Photometry(samples.corners, samples.bary, tuple(pictures), albedo, tie, sigma), vertices


def at_points(term: Photometry, gradient: np.ndarray, count: int) -> np.ndarray:
    full = np.zeros((count, 3))
    np.add.at(full, term.rows, term.bary[..., None] * gradient[:, None])
    return full


def slope_along(term: Photometry, positions: np.ndarray, way: np.ndarray) -> float:
    return (term.cost(positions + 1e-8 * way) - term.cost(positions - 1e-8 * way)) / 2e-8


@pytest.mark.parametrize("tie", [0.0, 0.3, 1.0])
def test_gradient_is_exact_without_outliers(tie: float) -> None:
    """With a wide sigma nothing is an outlier and the mean is the exact minimiser."""
    term, vertices = make_term(tie, sigma=20.0)
    rng = np.random.default_rng(1)
    positions = vertices + rng.normal(size=vertices.shape) * 5e-4
    gradient = at_points(term, term.normal(positions)[1], len(vertices))
    for _ in range(6):
        way = rng.normal(size=vertices.shape)
        assert (gradient * way).sum() == pytest.approx(slope_along(term, positions, way), rel=2e-3)


@pytest.mark.parametrize("tie", [0.0, 1.0])
def test_gradient_leads_downhill_among_outliers(tie: float) -> None:
    """The robust mean is only nearly a minimum: directions agree, not digits."""
    term, vertices = make_term(tie, sigma=0.01)
    wrong = picture(term.pictures[1].camera, colour=lambda p: 1.0 - paint(p[:, [1, 2, 0]]))
    other = replace(term.pictures[1], image=smooth(wrong))
    term = replace(term, pictures=(term.pictures[0], other, *term.pictures[2:]))
    positions = vertices + np.random.default_rng(1).normal(size=vertices.shape) * 1e-4
    gradient = at_points(term, term.normal(positions)[1], len(vertices))
    slope = slope_along(term, positions, gradient)
    assert slope == pytest.approx((gradient**2).sum(), rel=0.25)


@pytest.mark.parametrize("tie", [0.0, 0.3, 1.0])
def test_matrix_is_positive_semidefinite_and_a_tie_adds_to_it(tie: float) -> None:
    term, vertices = make_term(tie)
    matrix, gradient = term.normal(vertices + 3e-4)
    assert np.isfinite(matrix).all() and np.isfinite(gradient).all()
    np.testing.assert_allclose(matrix, np.swapaxes(matrix, 1, 2), rtol=1e-9, atol=1e-6)
    values = np.linalg.eigvalsh(matrix)
    assert (values > -1e-9 * values.max()).all()
    free = replace(term, tie=0.0).normal(vertices + 3e-4)[0]
    more = np.linalg.eigvalsh(matrix - free)
    assert (more > -1e-9 * values.max()).all()
    assert (more[:, 2].max() > 1.0) == (tie > 0)


@pytest.mark.parametrize(
    ("tie", "move"), [(1.0, (6e-4, -5e-4, 3e-4)), (0.0, (0, 0, 1.5e-3)), (1.0, (0, 0, -1.5e-3))]
)
def test_steps_lead_home(tie: float, move: tuple[float, float, float]) -> None:
    """Sideways the tie tells the way, in depth the views do."""
    term, vertices = make_term(tie)
    shift = np.array(move)
    costs = [term.cost(vertices + shift)]
    for _ in range(8):
        matrix, gradient = term.normal(vertices + shift)
        shift = shift - np.linalg.solve(matrix.sum(0), gradient.sum(0))
        costs.append(term.cost(vertices + shift))
    least = term.cost(vertices)
    assert costs[1] < costs[0] and costs[-1] - least < 0.05 * (costs[0] - least)
    assert np.linalg.norm(shift) < 0.2 * np.linalg.norm(move)


def test_unknown_colours_tie_nothing() -> None:
    term, vertices = make_term(1.0)
    unknown = replace(term, albedo=np.full_like(term.albedo, np.nan))
    free = replace(term, tie=0.0)
    positions = vertices + 2e-4
    assert unknown.cost(positions) == pytest.approx(free.cost(positions))
    for one, other in zip(unknown.normal(positions), free.normal(positions), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_one_view_without_a_tie_says_nothing() -> None:
    term, vertices = make_term(0.0)
    one = replace(term, pictures=term.pictures[:1])
    matrix, gradient = one.normal(vertices)
    scale = np.abs(term.normal(vertices)[0]).max()
    assert one.cost(vertices) < 1e-9
    assert np.abs(matrix).max() < 1e-6 * scale and np.abs(gradient).max() < 1e-6 * scale


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


def test_pictures_are_read_between_pixels_and_their_slope_is_exact() -> None:
    y, x = np.mgrid[:12, :17] + 0.5
    image = np.stack([2 * x + 3 * y, x - y], -1).astype(np.float32)
    pixels = np.random.default_rng(0).uniform(1, 11, (40, 2))
    value, slope = bilinear(image, pixels)
    np.testing.assert_allclose(value, pixels @ [[2, 1], [3, -1]], rtol=1e-6)
    np.testing.assert_allclose(slope, np.broadcast_to([[2, 3], [1, -1]], slope.shape), atol=1e-5)
    far = np.array([[-1e9, 5.0], [5.0, 1e9], [17.0, 12.0]])
    assert np.isfinite(bilinear(image, far)[0]).all()
    camera, places = rig()[0], paint(np.random.default_rng(1).normal(size=(30, 3))) * 0.1
    shot = smooth(picture(camera))
    _, slope = look(camera, shot, places)
    for axis in range(3):
        step = 1e-8 * np.eye(3)[axis]
        numeric = (
            look(camera, shot, places + step)[0] - look(camera, shot, places - step)[0]
        ) / 2e-8
        np.testing.assert_allclose(slope[..., axis], numeric, atol=1e-3 * np.abs(slope).max())


def plain_shot(image: np.ndarray, alpha: np.ndarray | None) -> Shot:
    height, width = image.shape[:2]
    camera = Camera("c", width, height, "PINHOLE", (100, 100, width / 2, height / 2), np.eye(4))
    return Shot("c", camera, np.zeros((height, width, 3), np.uint8), alpha)


def test_detail_keeps_marks_and_drops_light_and_background() -> None:
    y, x = np.mgrid[:64, :64]
    broad = np.repeat((0.4 + 0.004 * x)[..., None], 3, 2).astype(np.float32)
    marked = broad.copy()
    marked[30:33, 30:33] -= 0.1
    fine = detail(marked, plain_shot(marked, None), 4.0)
    assert fine[31, 31].mean() < -0.06
    assert np.abs(detail(broad, plain_shot(broad, None), 4.0)[16:48, 16:48]).max() < 1e-3
    # A bright wall beside the head must not darken the skin next to it.
    alpha = np.where(x < 40, 255, 0).astype(np.uint8)
    flat = np.full((64, 64, 3), 0.4, np.float32)
    walled = np.where(alpha[..., None] > 0, flat, np.float32(1.0))
    inside = detail(walled, plain_shot(walled, alpha), 4.0)[:, :40]
    outside = detail(walled, plain_shot(walled, None), 4.0)[:, :40]
    assert np.abs(inside).max() < 0.02 < 0.1 < np.abs(outside).max()


@pytest.mark.parametrize("alpha", [np.zeros((64, 64), np.uint8), np.full((64, 64), 255, np.uint8)])
def test_detail_of_empty_and_full_mattes_is_finite(alpha: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    image = rng.random((64, 64, 3), dtype=np.float32)
    got, free = (detail(image, plain_shot(image, a), 5.0) for a in (alpha, None))
    np.testing.assert_allclose(got, free, atol=1e-3)


def test_crops_show_the_same_rays_and_give_up_on_what_is_not_there() -> None:
    camera = rig(size=400, focal=900.0)[1]
    image = np.rint(255 * picture(camera)).astype(np.uint8)
    vertices, _ = ball()
    shot = cut_shot(camera, image, None, vertices, 100)
    assert max(shot.image.shape[:2]) <= 100 and shot.image.shape[1::-1] == (
        shot.camera.width, shot.camera.height,
    )  # fmt: skip
    front = vertices[vertices @ camera.center > 0.5 * RADIUS]
    whole, _ = look(camera, cv2.GaussianBlur(image, (0, 0), 2.0).astype(np.float32), front)
    part, _ = look(shot.camera, shot.image.astype(np.float32), front)
    assert np.abs(part - whole).mean() < 8.0
    behind = replace(camera, cam_from_world=np.diag([1.0, -1, -1, 1]) @ camera.cam_from_world)
    assert cut_shot(behind, image, None, vertices, 100) is None
    assert cut_shot(camera, image, None, vertices + [5.0, 0, 0], 100) is None


def test_samples_are_deterministic_even_and_on_the_allowed_skin_only() -> None:
    vertices, _ = ball(rings=24)
    face = vertices[:, 1] > -0.03
    model = ball_head(regions={"face": face, "scalp": vertices[:, 1] > 0.08})
    samples, again = spread(model, 3000), spread(model, 3000)
    for one, other in zip(vars(samples).values(), vars(again).values(), strict=True):
        np.testing.assert_array_equal(one, other)
    allowed = face & (vertices[:, 1] <= 0.08)
    assert allowed[samples.corners].all()
    np.testing.assert_allclose(samples.bary.sum(1), 1.0)
    assert (samples.bary >= 0).all()
    places = samples.at(vertices)
    # Archimedes: equal slices of a sphere have equal area.
    counts, _ = np.histogram(places[:, 1], np.linspace(-0.02, 0.07, 10))
    assert counts.max() < 1.2 * counts.min()
    around, _ = np.histogram(np.arctan2(places[:, 0], places[:, 2]), np.linspace(-np.pi, np.pi, 9))
    assert around.max() < 1.2 * around.min()


def test_samples_of_neck_and_ears_lie_there() -> None:
    model = load_head("procedural")
    samples = spread(model, 900, COVERED)
    inside = np.any([model.regions[name].numpy() for name in COVERED], axis=0)
    assert inside[samples.corners].all()
    for name in COVERED:
        assert model.regions[name].numpy()[samples.corners].all(1).sum() > 50


def test_a_head_without_regions_is_skin_all_over() -> None:
    model = ball_head()
    bare = replace(model, regions={})
    assert len(np.unique(spread(bare, 2000).faces)) > 1000


@pytest.mark.parametrize("distance", [0.05, 0.3, 0.46, 0.6, 3.0])
def test_a_plate_hides_another_however_near_the_camera(distance: float) -> None:
    plate = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.01
    vertices = np.concatenate([plate, plate + [0.0, 0.0, 0.02]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    camera = Camera(
        "cam", 100, 100, "PINHOLE", (100.0, 100.0, 50.0, 50.0),
        look_at(np.array([0.0, 0, 0.02 + distance]), np.zeros(3), np.array([0.0, 1, 0])),
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
