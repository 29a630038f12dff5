"""Things before the face, and glasses, are found where views agree; nothing behind them counts."""

from __future__ import annotations

import numpy as np
import pytest

from express50.geometry.cameras import project, unproject
from express50.geometry.pixels import linear_to_srgb
from express50.head.load import load_head
from express50.head.model import HeadModel
from pipelines.regions.geometry import head_labels, make_head
from pipelines.regions.things import face_views
from pipelines.track.outline import matte_distance, outline_terms, sample_distance
from pipelines.track.photo_consistency import patch_terms, skin_samples
from pipelines.track.schedule import find_things, find_worn_glasses, matted_pictures
from pipelines.track.surface import FrameSetCrops, HeadCrop, mask_things, near_things
from tests.pipelines.test_regions_glasses import eyes, painted, rims, scenes
from tests.pipelines.textured_scenes import ORIGIN, RADIUS, ball_head, paint, picture, rig

SMALL = 0.018
PLACE = np.array([0.015, 0.01, RADIUS + 0.015])


def shots(thing: bool, mattes: bool = True) -> FrameSetCrops:
    """Crops of the painted ball, with a small one before it or without."""
    crops = []
    for camera in rig():
        root = picture(camera)
        if thing:
            near = picture(camera, PLACE, lambda p: 0.6 * paint(p[:, ::-1] + 0.3), SMALL)
            root = np.where(near.any(2, keepdims=True), near, root)
        levels = np.rint(255 * linear_to_srgb(root.astype(float) ** 2)).astype(np.uint8)
        alpha = 255 * root.any(2).astype(np.uint8) if mattes else None
        crops.append(HeadCrop(camera, levels, alpha))
    return FrameSetCrops((), tuple(crops))


def found_on(model: HeadModel, pictures: FrameSetCrops) -> np.ndarray:
    return find_things(model, pictures, model.template.numpy(), np.eye(3))


@pytest.fixture(scope="module")
def scene():
    """The ball as a head, its samples, the crops with a thing, and the thing's places."""
    model = ball_head()
    skin = skin_samples(model, 30_000)
    pictures = shots(thing=True)
    return model, skin, pictures, found_on(model, pictures)


def test_a_thing_before_the_face_is_found_and_a_bare_face_has_none(scene) -> None:
    model, skin, pictures, things = scene
    off = np.linalg.norm(things - PLACE, axis=1) - SMALL
    assert len(things) > 20 and np.quantile(np.abs(off), 0.75) < 0.004
    assert len(found_on(model, shots(thing=False))) == 0
    assert len(found_on(model, shots(thing=True, mattes=False))) == 0
    assert len(found_on(model, FrameSetCrops((), ()))) == 0


def test_every_view_distinguishes_the_face_from_what_is_before_it(scene) -> None:
    model, _, pictures, _ = scene
    head = make_head(model.template.numpy(), np.eye(3), head_labels(model))
    views = face_views(head, matted_pictures(pictures))
    assert [view.camera.id for view in views] == [crop.camera.id for crop in pictures.crops]
    for view in views:
        # Its rim is too near to the face to be told from it.
        thing, front = (picture(view.camera, PLACE, radius=r).any(2) for r in (SMALL, SMALL / 2))
        assert (view.covered & front).sum() > 0.8 * front.sum()
        assert not (view.bare & front).any()
        assert (view.covered & ~thing).sum() < 0.3 * thing.sum()
        assert view.bare.sum() > 0.7 * ((view.depth > 0) & ~thing).sum()


def test_what_a_thing_hides_is_not_looked_at(scene) -> None:
    model, skin, pictures, things = scene
    mesh = model.template.numpy()
    clear = mask_things(pictures, things)
    for crop, before in zip(clear.crops, pictures.crops, strict=True):
        middle = np.floor(project(crop.camera, PLACE[None])[0][0]).astype(int)
        assert crop.alpha[middle[1], middle[0]] == 0
        taken = (crop.alpha == 0) & (before.alpha > 0)
        assert 0.002 < taken.mean() < 0.05
    found = patch_terms(model, skin, clear, mesh, 0.006, 1.0)
    goals = np.concatenate([term.goals for term in found])
    assert np.quantile(np.abs(np.linalg.norm(goals - ORIGIN, axis=1) - RADIUS), 0.99) < 0.0015
    assert mask_things(pictures, things[:0]) is pictures


def test_pixels_behind_a_thing(scene) -> None:
    _, _, pictures, things = scene
    for crop in pictures.crops:
        pixels = project(crop.camera, np.stack([PLACE, PLACE * (-3, -3, 0.7)]))[0]
        assert near_things(things, crop.camera, pixels).tolist() == [True, False]
    assert not near_things(things[:0], pictures.crops[0].camera, np.zeros((3, 2))).any()


def test_an_edge_of_the_matte_that_is_a_things_does_not_pull() -> None:
    model, camera = ball_head(), rig()[0]
    alpha = np.where(picture(camera).any(2), 255, 0).astype(np.uint8)
    rim = np.flatnonzero(alpha[128])[-1]
    alpha[110:146, rim - 5 : rim + 25] = 255  # glasses in profile stick out of the face
    mesh, hidden = model.template.numpy(), np.zeros(len(model.template), bool)
    distance = matte_distance(alpha, camera)
    assert distance is not None
    y, x = np.mgrid[112:144:3, rim + 2 : rim + 24 : 3]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1) + 0.5
    things = unproject(camera, pixels, np.full(len(pixels), 0.98))

    def pulls(things: np.ndarray) -> np.ndarray:
        (term,) = outline_terms(model, (distance,), mesh, 1, True, hidden, things)
        return sample_distance(distance, project(camera, term.anchors.at(mesh))[0])[0]

    with_thing, without_thing = pulls(things[:0]), pulls(things)
    assert with_thing.min() < -8 and without_thing.min() > -6
    assert len(without_thing) > 0.75 * len(with_thing)


def worn(places: np.ndarray, mattes: bool = True) -> FrameSetCrops:
    drawn = [painted(scene, places) for scene in scenes()]
    alphas = [np.rint(255 * one.alpha).astype(np.uint8) if mattes else None for one in drawn]
    return FrameSetCrops(
        (), tuple(HeadCrop(d.camera, d.rgb, a) for d, a in zip(drawn, alphas, strict=True))
    )


def test_glasses_are_taken_out_of_the_crops() -> None:
    model, mesh, pictures = (load_head("procedural"), scenes()[0].head.vertices, worn(rims()))
    found = find_worn_glasses(model, pictures, mesh, np.eye(3))
    assert len(found) > 500 and (found[:, 2] > eyes()[:, 2].min() - 0.04).all()
    front = pictures.crops[3]
    left = mask_things(pictures, found).crops[3].alpha
    assert left is not None and front.alpha is not None
    gone = (front.alpha > 0) & (left == 0)
    assert 0.01 < gone.mean() < 0.05
    assert len(find_worn_glasses(model, worn(rims()[:0]), mesh, np.eye(3))) == 0
    assert len(find_worn_glasses(model, worn(rims(), mattes=False), mesh, np.eye(3))) == 0
    assert len(find_worn_glasses(model, FrameSetCrops((), ()), mesh, np.eye(3))) == 0
