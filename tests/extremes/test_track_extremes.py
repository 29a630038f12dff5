"""Tracking's searches and comparisons at the extremes: lenses, places, mattes, half a face."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from express50.files.images import linear_to_srgb
from pipelines.track.appearance import EVEN_LIGHT, Appearance
from pipelines.track.bake import bake_albedo
from pipelines.track.config import TrackConfig
from pipelines.track.outline import outline_vertices, signed_distance
from pipelines.track.photometry import Photometry
from pipelines.track.pictures import Moment, see, with_photometry, with_relief
from pipelines.track.refine import with_outlines
from pipelines.track.relief import Relief
from pipelines.track.samples import Visibility, spread
from pipelines.track.shots import Shot, cut_shot
from pipelines.track.state import Target
from tests.pipelines.textured_scenes import (
    ORIGIN,
    RADIUS,
    ball,
    ball_head,
    paint,
    picture,
    places_on,
    rig,
    seen_weights,
)

CONFIG = TrackConfig(samples=600)
FAR = (np.array([1000.0, 0, 0]), np.array([-400.0, 1000.0, 1000.0]))


def take(camera, centre=ORIGIN, mesh=None, alpha="true", image=None, side=512) -> Shot | None:
    """The stage's crop of a picture of the sphere, with its true matte if no other is given."""
    root = picture(camera, centre)
    levels = np.rint(255 * linear_to_srgb(root.astype(float) ** 2)).astype(np.uint8)
    matte = np.where(root.any(2), 255, 0).astype(np.uint8) if isinstance(alpha, str) else alpha
    mesh = ball(centre=centre)[0] if mesh is None else mesh
    return cut_shot(camera, levels if image is None else image, matte, mesh, side)


def search(shots, mesh) -> Relief | None:
    """The stage's search on one moment; its relief, if it found any."""
    model, faces = ball_head(), spread(ball_head(), CONFIG.samples)
    moment = Moment((), tuple(shots))
    sights = [see(model, faces, moment, mesh)]
    made = with_relief(model, faces, [bare_target()], [moment], sights, mesh[None], 0.006, 1.0)
    return made[0].terms[0] if made[0].terms else None


def compare(shots, mesh) -> tuple[Target, Appearance]:
    """The stage's comparison of colours on one moment."""
    model, moment = ball_head(), Moment((), tuple(shots))
    samples = spread(model, CONFIG.samples)
    sights = [see(model, samples, moment, mesh)]
    made, appearance = with_photometry(
        samples, [bare_target()], [moment], sights, mesh[None], None, CONFIG
    )
    return made[0], appearance


def bare_target() -> Target:
    """A target that holds nothing yet; neither search nor comparison looks at its landmarks."""
    return Target(observation=None, sigma=np.zeros((0, 68)), neutral=True)  # type: ignore[arg-type]


def check(term, positions) -> None:
    """Cost, matrix and gradient are finite and the matrix has no negative direction."""
    matrix, gradient = term.normal(positions)
    assert np.isfinite(term.cost(positions))
    assert np.isfinite(matrix).all() and np.isfinite(gradient).all()
    values = np.linalg.eigvalsh(matrix)
    assert (values > -1e-6 * max(values.max(), 1.0)).all()


def positions_of(made: Target, mesh: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros((68, 3)), mesh[made.vertices]])


def head_mesh(offset: float = 0.003, centre=ORIGIN) -> np.ndarray:
    return ball_head().template.numpy() * (RADIUS + offset) / RADIUS + centre


@pytest.mark.parametrize("centre", FAR)
def test_far_from_the_origin_search_and_comparison_are_the_same(centre) -> None:
    results = []
    for place in (np.zeros(3), centre):
        mesh = head_mesh(centre=place)
        shots = [take(camera, place, mesh) for camera in rig(centre=place)]
        relief = search(shots, mesh)
        made, appearance = compare(shots, mesh)
        positions = positions_of(made, mesh)
        check(made.terms[0], positions)
        results.append((relief, made.terms[0].cost(positions), appearance, place))
    (here, cost, look, _), (there, other, seen, _) = results
    assert len(here.rows) > 140 and abs(len(here.rows) - len(there.rows)) < 0.05 * len(here.rows)
    for relief, place in ((here, 0 * centre), (there, centre)):
        radii = np.linalg.norm(relief.goals - place, axis=1)
        assert abs(np.median(radii) - RADIUS) < 4e-4
    assert other == pytest.approx(cost, rel=0.05)
    for name, gain in look.gains.items():
        np.testing.assert_allclose(seen.gains[name], gain, atol=0.01)


@pytest.mark.parametrize("centre", FAR)
def test_far_from_the_origin_visibility_and_outlines_are_the_same(centre) -> None:
    found = []
    for place in (np.zeros(3), centre):
        vertices, faces = ball(centre=place)
        camera = rig(centre=place)[0]
        samples = places_on(faces, vertices - place)
        weights = seen_weights([camera], samples, vertices, faces)[2]
        outline = outline_vertices(vertices, faces, camera, np.ones(len(vertices), bool))
        found.append((weights, set(outline.tolist())))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-6)
    one, other = found[0][1], found[1][1]
    assert len(one) > 20 and len(one & other) > 0.9 * len(one | other)


@pytest.mark.parametrize(
    ("focal", "distance", "size"), [(20.0, 0.25, 64), (8000.0, 12.0, 256), (8000.0, 40.0, 128)]
)
def test_wide_and_long_lenses(focal: float, distance: float, size: int) -> None:
    cameras = rig(size=size, focal=focal, distance=distance)
    mesh = head_mesh(0.0)
    shots = [shot for shot in (take(camera, mesh=mesh) for camera in cameras) if shot]
    assert len(shots) == 4
    relief = search(shots, mesh)
    made, appearance = compare(shots, mesh)
    check(made.terms[0], positions_of(made, mesh))
    assert all(np.isfinite(gain).all() for gain in appearance.gains.values())
    if relief is not None:
        off = np.abs(np.linalg.norm(relief.goals, axis=1) - RADIUS)
        assert np.median(off) < max(0.5 * np.median(relief.sigma), 1e-3)
    assert (relief is not None) == (focal > 20)


@pytest.mark.parametrize("value", [0, 255])
def test_black_and_white_pictures_pull_nowhere(value: int) -> None:
    mesh = head_mesh()
    flat = np.full((256, 256, 3), value, np.uint8)
    shots = [take(camera, mesh=mesh, image=flat) for camera in rig()]
    assert search(shots, mesh) is None
    made, appearance = compare(shots, mesh)
    check(made.terms[0], positions_of(made, mesh))
    _, gradient = made.terms[0].normal(positions_of(made, mesh))
    assert np.abs(gradient).max() < 1e-3
    albedo, _ = bake_albedo(ball_head(), mesh[None], [Moment((), tuple(shots))], appearance, 32)
    assert albedo.max() - albedo.min() < 90 and (albedo.mean() < 5) == (value == 0)


def test_empty_mattes_show_nobody() -> None:
    mesh, empty = head_mesh(), np.zeros((256, 256), np.uint8)
    shots = [take(camera, mesh=mesh, alpha=empty) for camera in rig()]
    assert search(shots, mesh) is None
    made, appearance = compare(shots, mesh)
    assert made.terms == () and np.isfinite(appearance.light).all()
    assert signed_distance(empty, rig()[0]) is None
    outlined = with_outlines(ball_head(), [bare_target()], [Moment((), ())], mesh[None], bald=False)
    assert outlined[0].outlines == () and len(outlined[0].vertices) == 0


def test_no_camera_at_all() -> None:
    mesh = head_mesh()
    assert search([], mesh) is None
    made, appearance = compare([], mesh)
    assert made.terms == () and np.isfinite(appearance.light).all()


def test_half_the_face_outside_the_picture() -> None:
    """Only what is inside counts; the rim of a picture is no mark."""
    mesh, shots = head_mesh(), []
    for camera in rig():
        width = camera.width // 2
        half = replace(camera, width=width)
        root = picture(half)
        levels = np.rint(255 * linear_to_srgb(root.astype(float) ** 2)).astype(np.uint8)
        shots.append(cut_shot(half, levels, None, mesh, 512))
    relief = search(shots, mesh)
    places = relief.goals
    assert len(places) > 50 and abs(np.median(np.linalg.norm(places, axis=1)) - RADIUS) < 4e-4
    assert (places[:, 0] < 0.02).mean() > 0.95
    made, _ = compare(shots, mesh)
    check(made.terms[0], positions_of(made, mesh))
    weight = np.stack([p.weight for p in made.terms[0].pictures])
    assert (weight.max(0) > 0).all()


def test_cameras_given_twice_add_nothing_new() -> None:
    mesh = head_mesh()
    shots = [take(camera, mesh=mesh) for camera in rig()]
    assert search(shots[:1] * 3, mesh) is None
    twice = search(shots + [replace(s, camera_id=s.camera_id + "b") for s in shots], mesh)
    assert abs(np.median(np.linalg.norm(twice.goals, axis=1)) - RADIUS) < 4e-4


def test_a_head_behind_its_own_camera_or_beyond_the_frame_is_no_shot() -> None:
    camera, mesh = rig()[0], head_mesh()
    assert take(camera, mesh=mesh + 2.5 * camera.center) is None
    assert take(camera, mesh=mesh + [0.0, 3.0, 0.0]) is None


def test_mesh_folded_to_a_point_is_silent() -> None:
    mesh = np.zeros_like(head_mesh())
    vertices, faces = ball()
    weights = Visibility(0 * vertices, faces).weights(rig()[0], np.zeros((5, 3)), np.zeros((5, 3)))
    assert (weights == 0).all()
    shots = [take(camera, mesh=head_mesh()) for camera in rig()]
    assert search(shots, mesh) is None
    made, _ = compare(shots, mesh)
    assert made.terms == ()


def test_colours_beyond_reach_are_clipped_not_wrapped() -> None:
    """A dark gain would make the albedo brighter than white."""
    cameras = rig()
    mesh = head_mesh(0.0)
    shots = tuple(take(camera, mesh=mesh) for camera in cameras)
    dark = Appearance(EVEN_LIGHT, {c.id: np.full(3, 0.25) for c in cameras}, np.zeros((0, 3)))
    albedo, known = bake_albedo(ball_head(), mesh[None], [Moment((), shots)], dark, 48)
    assert known.any() and (albedo[known] == 255).mean() > 0.5
    assert paint(mesh).max() <= 1.0
    assert isinstance(compare(list(shots), mesh)[0].terms[0], Photometry)
