"""Agreeing cameras at the edges: few, blind, misplaced, far away, in other units, a pixel large."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from express50.geometry.cameras import pinhole_camera, scale_camera, transform_camera
from express50.geometry.transforms import look_at, make_transform
from pipelines.matte import visual_hull
from pipelines.matte.stage import corrected, make_view
from pipelines.matte.visual_hull import Agreement, MatteView, ball_of, compare_mattes
from tests.pipelines.bump_head import ring
from tests.pipelines.matte_rig import SIZE, disc, make_views, shots, with_alpha


def disturbed(views: list[MatteView]) -> list[MatteView]:
    """A shadow in one view, a hole in another."""
    shade, hole = disc(0.12, 0.3, 0.09), disc(0.5, 0.5, 0.09)
    changes = {4: np.maximum(views[4].alpha, shade), 8: np.where(hole, 0, views[8].alpha)}
    return with_alpha(views, changes)


def same(one: Agreement, other: Agreement) -> bool:
    """Check that the same pixels are removed and filled."""
    return all(
        set(a) == set(b) and all((a[name] == b[name]).all() for name in a)
        for a, b in ((one.removed, other.removed), (one.filled, other.filled))
    )


@pytest.mark.parametrize("count", [1, 2, 3])
def test_so_few_cameras_do_not_overrule_each_other(count):
    found = compare_mattes(disturbed(make_views())[3 : 3 + count])
    assert not found.removed and not found.filled
    assert f"{count} usable" in found.unchanged


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_empty_and_full_mattes_are_all_reported_and_left(value):
    views = make_views()
    found = compare_mattes([replace(v, alpha=np.full_like(v.alpha, value)) for v in views])
    assert not found.removed and not found.filled and "0 usable" in found.unchanged
    assert len(found.warnings) == len(views)


def test_mattes_without_a_common_subject_change_nothing():
    views = make_views()
    rng = np.random.default_rng(0)
    scattered = {k: disc(*rng.uniform(0.1, 0.9, 2), 0.06) for k in range(len(views))}
    found = compare_mattes(with_alpha(views, scattered))
    # Where nothing is possible nothing is ruled out: nobody knows who is wrong.
    assert not found.filled and not found.removed
    assert len(found.warnings) <= len(views) // 3


def test_a_camera_inside_the_subject_or_turned_away_is_left_out():
    clean = compare_mattes(disturbed(make_views()))
    for center in (np.array([0.0, 0.0, 0.05]), np.array([0.0, 0.0, 1.1])):
        rig = [camera for camera, _, _ in shots()]
        pose = look_at(center, center + [0, 0, 1.0])
        rig[0] = pinhole_camera("cam00", rig[0].K, SIZE, SIZE, pose)
        found = compare_mattes(disturbed(make_views(cameras=rig)))
        assert [note.what for note in found.warnings] == ["cam00"]
        assert set(found.removed) == set(clean.removed) and set(found.filled) == set(clean.filled)


def test_parallel_axes_and_a_rig_turned_outwards_have_no_common_place():
    rig = [transform_camera(ring(1, 32)[0], make_transform(np.eye(3), [x, 0, 0])) for x in range(4)]
    assert ball_of({str(k): camera for k, camera in enumerate(rig)}) is None
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    away = [replace(c, cam_from_world=turn @ c.cam_from_world) for c in ring(8, 32)]
    assert ball_of({camera.id: camera for camera in away}) is None


def test_a_subject_cut_by_the_frames_edge_is_not_eaten():
    rig = [camera for camera, _, _ in shots()]
    views = []
    for view in make_views():
        # The lower half of the picture is no footage: the head leaves it there.
        alpha, valid = view.alpha.copy(), view.valid.copy()
        alpha[SIZE // 2 :], valid[SIZE // 2 :] = 0, False
        views.append(replace(view, alpha=alpha, valid=valid))
    assert len(rig) == len(views)
    found = compare_mattes(views)
    assert not found.removed and not found.filled and not found.warnings


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1)])
def test_pictures_one_pixel_wide_do_not_fail(size):
    rig = [scale_camera(c, size[0] / SIZE, size[1] / SIZE) for c in ring(8, SIZE)]
    ball = ball_of({camera.id: camera for camera in rig})
    image = np.full((size[1], size[0], 3), 90, np.uint8)
    for value in (0, 120, 255):
        alpha = np.full((size[1], size[0]), value, np.uint8)
        alpha[: size[1] // 2] = 255
        views = [make_view(camera, ball, image, alpha, 192) for camera in rig]
        found = compare_mattes(views, 96)
        for view in views:
            out = corrected(alpha, found.removed.get(view.name), found.filled.get(view.name))
            assert out.shape == alpha.shape and out.dtype == np.uint8


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("far", [0.0, 1000.0])
def test_units_and_the_worlds_origin_do_not_matter(scale, far):
    rig = []
    for camera, _, _ in shots():
        pose = transform_camera(camera, make_transform(np.eye(3), [far, -far, far])).cam_from_world
        pose[:3, 3] *= scale
        rig.append(replace(camera, cam_from_world=pose))
    found = compare_mattes(disturbed(make_views(cameras=rig)))
    clean = compare_mattes(disturbed(make_views()))
    assert clean.removed and clean.filled and same(found, clean)


def test_more_cameras_than_a_byte_counts(monkeypatch):
    monkeypatch.setattr(visual_hull, "VOTES", 40)  # each view is there 23 times
    views = disturbed(make_views())
    many = [replace(v, name=f"{v.name}-{k}") for k in range(23) for v in views]
    found = compare_mattes(many, cells=16)
    assert len(many) == 276
    assert {name[:5] for name in found.removed} == {"cam04"}
