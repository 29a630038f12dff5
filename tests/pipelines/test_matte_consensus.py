"""Cameras that agree on their mattes: what is removed, filled, left alone and named; the stage."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.geometry.cameras import Camera
from express50.geometry.pixels import shrink
from pipelines.matte.stage import SHOWN, corrected, make_view
from pipelines.matte.visual_hull import Ball, compare_mattes, lacking_if_moved
from tests.pipelines.matte_rig import SIZE, disc, make_views, with_alpha

BACKDROP = np.array([77, 128, 102], np.uint8)


def changed(found) -> set[str]:
    return set(found.removed) | set(found.filled)


def test_views_that_agree_are_left_alone():
    found = compare_mattes(make_views())
    assert changed(found) == set() and found.warnings == [] and found.unchanged == ""


@pytest.mark.parametrize("cameras", [(4,), (2, 7), (1, 5, 9)])
def test_what_only_some_cameras_see_is_removed_whole(cameras):
    views = make_views()
    shade = disc(0.12, 0.3, 0.09)
    found = compare_mattes(
        with_alpha(views, {k: np.maximum(views[k].alpha, shade) for k in cameras})
    )
    assert changed(found) == {views[k].name for k in cameras} and found.warnings == []
    for k in cameras:
        gone = found.removed[views[k].name]
        assert gone[shade & (views[k].alpha == 0)].all()
        assert not gone[views[k].alpha > 0].any()


def test_a_shadow_that_touches_the_head_goes_up_to_the_hull():
    views = make_views()
    head = views[5].alpha > 0
    shade = disc(0.2, 0.45, 0.15) & ~head
    assert cv2.dilate(head.astype(np.uint8), np.ones((3, 3)))[shade].any()
    found = compare_mattes(with_alpha(views, {5: np.maximum(views[5].alpha, 0.7 * shade)}))
    gone = found.removed[views[5].name]
    assert gone[shade].mean() > 0.6 and not gone[head].any()


@pytest.mark.parametrize(
    ("tint", "least", "most"), [((1, 1, 1), 0.93, 1), ((1, 0.4, 0.4), 0.5, 0.9)]
)
def test_of_a_shadow_the_part_that_the_others_cannot_see_goes_too(tint, least, most):
    """What has another colour than the darkened plate may be the subject's."""
    views = make_views()
    head = views[5].alpha > 0
    shade = disc(0.2, 0.45, 0.15) & ~head
    plate = np.broadcast_to(BACKDROP, (SIZE, SIZE, 3))
    dark = np.rint(0.5 * BACKDROP * np.array(tint)).astype(np.uint8)
    rgb = np.where(head[..., None], views[5].rgb, plate)
    rgb[shade] = dark
    views = with_alpha(views, {5: np.maximum(views[5].alpha, shade)})
    views[5] = replace(views[5], rgb=rgb, plate=plate)
    gone = compare_mattes(views).removed[views[5].name]
    assert least <= gone[shade].mean() <= most and not gone[head].any()


def test_hair_at_the_rim_stays_and_a_cable_goes():
    views = make_views()
    column = SIZE // 2
    top = int(np.flatnonzero(views[5].alpha[:, column] > 0.5)[0])
    hair, cable = views[5].alpha.copy(), views[5].alpha.copy()
    hair[top - 3 : top, column] = 0.8
    cable[:top, column] = 0.8
    assert changed(compare_mattes(with_alpha(views, {5: hair}))) == set()
    gone = compare_mattes(with_alpha(views, {5: cable})).removed[views[5].name]
    assert gone[: top // 2, column].all() and not gone[views[5].alpha > 0].any()


@pytest.mark.parametrize("grey", [False, True])
def test_a_hole_is_filled_where_the_camera_shows_the_surface_the_others_see(grey):
    """The camera may see no colours."""
    views = [replace(view, rgb=view.rgb // np.array([1, 2, 4], np.uint8)) for view in make_views()]
    hole = disc(0.5, 0.5, 0.09)
    holed = with_alpha(views, {5: np.where(hole, 0, views[5].alpha)})
    if grey:
        luma = cv2.cvtColor(views[5].rgb, cv2.COLOR_RGB2GRAY)
        holed[5] = replace(holed[5], rgb=np.repeat(luma[..., None], 3, axis=2))
    found = compare_mattes(holed)
    assert changed(found) == {views[5].name} and not found.removed
    assert found.filled[views[5].name][hole].mean() > 0.95


def test_a_gap_that_shows_the_backdrop_stays_open():
    views = make_views()
    hole = disc(0.5, 0.5, 0.09)
    holed = with_alpha(views, {5: np.where(hole, 0, views[5].alpha)})
    holed[5] = replace(holed[5], rgb=np.where(hole[..., None], BACKDROP, holed[5].rgb))
    assert changed(compare_mattes(holed)) == set()


def test_a_spot_that_neighbours_lack_too_is_filled_where_the_rig_is_dense():
    views = make_views()
    holes = {k: np.where(disc(0.5, 0.5, 0.06), 0, views[k].alpha) for k in (5, 6)}
    found = compare_mattes(with_alpha(views, holes))
    assert set(found.filled) == {views[5].name, views[6].name}


@pytest.mark.parametrize("wrong", ["moved", "empty", "full", "upside down"])
def test_one_wrong_camera_is_named_and_other_mattes_stay(wrong):
    views = make_views()
    alpha = views[3].alpha
    shift = np.float32([[1, 0, 0.2 * SIZE], [0, 1, 0]])
    bad = {
        "moved": cv2.warpAffine(alpha, shift, (SIZE, SIZE)),
        "empty": np.zeros_like(alpha),
        "full": np.ones_like(alpha),
        "upside down": 1 - alpha,
    }[wrong]
    found = compare_mattes(with_alpha(views, {3: bad}))
    assert [note.what for note in found.warnings] == [views[3].name]
    assert changed(found) == set()


def test_empty_mattes_do_not_keep_a_wrong_one_from_being_named():
    views = make_views()
    nothing = {k: np.zeros((SIZE, SIZE)) for k in (0, 3, 6, 9)}
    wrong = np.roll(views[5].alpha, SIZE // 3, axis=1)
    found = compare_mattes(with_alpha(views, nothing | {5: wrong}))
    assert {note.what for note in found.warnings} == {views[k].name for k in (*nothing, 5)}
    assert views[5].name not in changed(found)


def test_a_wrong_camera_does_not_hide_what_another_must_remove():
    views = make_views()
    shade = disc(0.12, 0.3, 0.09)
    bad = {3: 1 - views[3].alpha, 8: np.maximum(views[8].alpha, shade)}
    found = compare_mattes(with_alpha(views, bad))
    assert set(found.removed) == {views[8].name} and len(found.warnings) == 1


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 11), st.floats(0, 1), st.floats(0, 1), st.floats(0.02, 0.3), st.booleans())
def test_no_blob_in_one_camera_removes_any_of_the_head(k, x, y, radius, hole):
    views = make_views()
    alpha, blob = views[k].alpha, disc(x, y, radius)
    bad = np.where(blob, 0, alpha) if hole else np.maximum(alpha, blob)
    found = compare_mattes(with_alpha(views, {k: bad}))
    for view in views:
        if view.name in found.removed:
            assert not found.removed[view.name][view.alpha > 0.5].any()
        if view.name in found.filled:
            assert not found.filled[view.name][view.alpha == 0].any()
    assert changed(found) <= {views[k].name}


def test_corrections_are_soft_and_spare_the_rest_to_the_bit():
    rng = np.random.default_rng(0)
    alpha = rng.integers(0, 256, (200, 160)).astype(np.uint8)
    removed, filled = np.zeros((50, 40), bool), np.zeros((50, 40), bool)
    removed[5:15, 5:15], filled[30:40, 20:30] = True, True
    out = corrected(alpha, removed, filled)
    near = np.zeros(alpha.shape, bool)
    near[14:66, 14:66] = near[114:166, 74:126] = True
    assert (out[~near] == alpha[~near]).all()
    assert (out[24:56, 24:56] == 0).all() and (out[124:156, 84:116] == 255).all()
    ramp = corrected(np.full((200, 160), 255, np.uint8), removed, None)[40, 50:70]
    assert len(set(ramp.tolist())) >= 4 and (np.diff(ramp.astype(int)) >= 0).all()
    assert (corrected(alpha, None, None) == alpha).all()


@pytest.mark.parametrize("size", [(1936, 1216), (160, 200), (1504, 2056)])
def test_pictures_of_the_contact_sheet_and_mattes_are_reduced_to_one_size(size):
    # Reduced in two steps, 160x200 is 103x128, in one step 102x128.
    width, height = size
    params = (2.0 * width, 2.0 * width, width / 2, height / 2)
    camera = Camera("cam00", width, height, "PINHOLE", params, np.eye(4))
    shown = shrink(np.zeros((height, width, 3), np.uint8), SHOWN)
    ball = Ball(np.array([0, 0, 2.0]), 0.3)
    view = make_view(camera, ball, shown, np.full((height, width), 255, np.uint8))
    assert view.alpha.shape == view.valid.shape and view.alpha[view.valid].min() == 1


def test_a_camera_that_has_turned_is_known_from_one_that_lacks_a_part() -> None:
    y, x = np.mgrid[:128, :128]
    solid = np.hypot(x - 64, y - 64) < 40
    assert lacking_if_moved(solid, solid) == 0
    assert lacking_if_moved(np.roll(solid, (8, -6), (0, 1)), solid) == 0
    hollow = solid & (np.hypot(x - 64, y - 64) > 15)
    assert lacking_if_moved(hollow, solid) > 0.6 * (solid & ~hollow).sum() / solid.sum()
    assert lacking_if_moved(solid, solid & False) == 0
