"""Tracking's searches and comparisons at the extremes: lenses, places, mattes, half a face."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from express50.files.images import read_image
from express50.geometry.pixels import linear_to_srgb
from pipelines.track.appearance import EVEN_LIGHT, Appearance, bake_albedo, write_texture
from pipelines.track.observe import Observation
from pipelines.track.outline import matte_distance, outline_terms, outline_vertices
from pipelines.track.photo_consistency import patch_terms, skin_samples
from pipelines.track.state import Target
from pipelines.track.surface import FrameSetCrops, HeadCrop, Visibility, cut_crop
from pipelines.track.terms import NormalTerm, cost, information
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

SAMPLES = 600
FAR = (np.array([1000.0, 0, 0]), np.array([-400.0, 1000.0, 1000.0]))


def take(camera, centre=ORIGIN, mesh=None, alpha="true", image=None, side=512) -> HeadCrop | None:
    """The stage's crop of a picture of the sphere, with its true matte if no other is given."""
    root = picture(camera, centre)
    levels = np.rint(255 * linear_to_srgb(root.astype(float) ** 2)).astype(np.uint8)
    matte = np.where(root.any(2), 255, 0).astype(np.uint8) if isinstance(alpha, str) else alpha
    mesh = ball(centre=centre)[0] if mesh is None else mesh
    return cut_crop(camera, levels if image is None else image, matte, mesh, side)


def search(crops, mesh) -> NormalTerm | None:
    """The stage's search on one frame set; its surface, if it found any."""
    model = ball_head()
    pictures = FrameSetCrops((), tuple(crops))
    found = patch_terms(model, skin_samples(model, SAMPLES), pictures, mesh, 0.006, 1.0)
    return found[0] if found else None


def texture(tmp_path, crops, mesh) -> dict[str, np.ndarray] | None:
    """Light and gains of the stage's texture on one frame set; None if nothing was written."""
    unknown = np.full((68, 3), np.nan)
    seen = Observation("neutral", 0, (), np.zeros((0, 68), bool), unknown, np.zeros((68, 3, 3)))
    targets = [Target(seen, np.zeros((0, 68)), neutral=True)]
    pictures = [FrameSetCrops((), tuple(crops))]
    write_texture(tmp_path, ball_head(), targets, mesh[None], pictures, SAMPLES, 32)
    if not (tmp_path / "albedo.png").exists():
        return None
    with np.load(tmp_path / "appearance.npz", allow_pickle=False) as file:
        return {name: file[name] for name in ("light", "gains")}


def check(term, mesh) -> None:
    """Cost, matrix and gradient are finite and the matrix has no negative direction."""
    places = term.anchors.at(mesh)
    matrix, gradient = information(term, places)
    assert np.isfinite(cost(term, places))
    assert np.isfinite(matrix).all() and np.isfinite(gradient).all()
    values = np.linalg.eigvalsh(matrix)
    assert (values > -1e-6 * max(values.max(), 1.0)).all()


def head_mesh(offset: float = 0.003, centre=ORIGIN) -> np.ndarray:
    return ball_head().template.numpy() * (RADIUS + offset) / RADIUS + centre


@pytest.mark.parametrize("centre", FAR)
def test_far_from_the_origin_search_and_texture_are_the_same(centre, tmp_path) -> None:
    results = []
    for place in (np.zeros(3), centre):
        mesh = head_mesh(centre=place)
        crops = [take(camera, place, mesh) for camera in rig(centre=place)]
        found = search(crops, mesh)
        check(found, mesh)
        results.append((found, texture(tmp_path, crops, mesh), place))
    (here, look, _), (there, seen, _) = results
    sizes = len(here.goals), len(there.goals)
    assert sizes[0] > 140 and abs(sizes[0] - sizes[1]) < 0.05 * sizes[0]
    for found, place in ((here, 0 * centre), (there, centre)):
        radii = np.linalg.norm(found.goals - place, axis=1)
        assert abs(np.median(radii) - RADIUS) < 4e-4
    np.testing.assert_allclose(seen["gains"], look["gains"], atol=0.02)


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
def test_wide_and_long_lenses(focal: float, distance: float, size: int, tmp_path) -> None:
    cameras = rig(size=size, focal=focal, distance=distance)
    mesh = head_mesh(0.0)
    shots = [shot for shot in (take(camera, mesh=mesh) for camera in cameras) if shot]
    assert len(shots) == 4
    relief = search(shots, mesh)
    look = texture(tmp_path, shots, mesh)
    assert look is None or all(np.isfinite(values).all() for values in look.values())
    if relief is not None:
        off = np.abs(np.linalg.norm(relief.goals, axis=1) - RADIUS)
        assert np.median(off) < max(0.5 * np.median(relief.sigma), 1e-3)
    assert (relief is not None) == (focal > 20)


@pytest.mark.parametrize("value", [0, 255])
def test_black_and_white_pictures_pull_nowhere(value: int, tmp_path) -> None:
    mesh = head_mesh()
    flat = np.full((256, 256, 3), value, np.uint8)
    shots = [take(camera, mesh=mesh, image=flat) for camera in rig()]
    assert search(shots, mesh) is None
    look = texture(tmp_path, shots, mesh)
    assert look is not None and all(np.isfinite(values).all() for values in look.values())
    albedo = read_image(tmp_path / "albedo.png")
    assert albedo.max() - albedo.min() < 90 and (albedo.mean() < 5) == (value == 0)


def test_empty_mattes_show_nobody(tmp_path) -> None:
    mesh, empty = head_mesh(), np.zeros((256, 256), np.uint8)
    crops = [take(camera, mesh=mesh, alpha=empty) for camera in rig()]
    assert search(crops, mesh) is None
    assert texture(tmp_path, crops, mesh) is None
    assert matte_distance(empty, rig()[0]) is None
    hidden, things = np.zeros(len(mesh), bool), np.zeros((0, 3))
    assert outline_terms(ball_head(), (), mesh, 0, False, hidden, things) == []


def test_no_camera_at_all(tmp_path) -> None:
    mesh = head_mesh()
    assert search([], mesh) is None
    assert texture(tmp_path, [], mesh) is None


def test_half_the_face_outside_the_picture() -> None:
    """Only what is inside counts; the rim of a picture is no mark."""
    mesh, shots = head_mesh(), []
    for camera in rig():
        width = camera.width // 2
        half = replace(camera, width=width)
        root = picture(half)
        levels = np.rint(255 * linear_to_srgb(root.astype(float) ** 2)).astype(np.uint8)
        shots.append(cut_crop(half, levels, None, mesh, 512))
    relief = search(shots, mesh)
    places = relief.goals
    assert len(places) > 50 and abs(np.median(np.linalg.norm(places, axis=1)) - RADIUS) < 4e-4
    assert (places[:, 0] < 0.02).mean() > 0.95
    check(relief, mesh)


def test_cameras_given_twice_add_nothing_new() -> None:
    mesh = head_mesh()
    shots = [take(camera, mesh=mesh) for camera in rig()]
    assert search(shots[:1] * 3, mesh) is None
    twice = search(
        shots + [replace(s, camera=replace(s.camera, id=s.camera.id + "b")) for s in shots], mesh
    )
    assert abs(np.median(np.linalg.norm(twice.goals, axis=1)) - RADIUS) < 4e-4


def test_a_head_behind_its_camera_or_outside_the_frame_gives_no_shot() -> None:
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


def test_colours_beyond_reach_are_clipped_not_wrapped() -> None:
    """A dark gain would make the albedo brighter than white."""
    cameras = rig()
    mesh = head_mesh(0.0)
    shots = tuple(take(camera, mesh=mesh) for camera in cameras)
    dark = Appearance(EVEN_LIGHT, {c.id: np.full(3, 0.25) for c in cameras}, np.zeros((0, 3)))
    albedo, known = bake_albedo(ball_head(), mesh[None], [FrameSetCrops((), shots)], dark, 48)
    assert known.any() and (albedo[known] == 255).mean() > 0.5
    assert paint(mesh).max() <= 1.0
