"""Reconstruct an analytic head: accuracy, baselines, robustness, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from express50.contract.layout import Dataset
from express50.contract.segmentation_labels import label_mask
from express50.contract.stage import Note
from express50.errors import StageError
from express50.geometry.cameras import rays, unproject
from express50.geometry.raycast import mesh_scene
from express50.head.load import HeadTopology
from pipelines.depth import DepthConfig
from pipelines.depth.blocks import build
from pipelines.depth.maps import cast_maps, picture_of, surface_maps
from pipelines.depth.prior import (
    bare_triangles,
    boundary_loops,
    close_mesh,
    matte_agreement,
    signed_distance,
)
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.stage import run, write_meshes
from pipelines.depth.surface import advance, extract_mesh
from pipelines.depth.views import (
    head_box,
    hull_distance,
    make_view,
    silhouette_distance,
    with_face,
    without_contradiction,
)
from pipelines.regions.geometry import FACE, render_head
from pipelines.regions.things import FaceView
from tests.pipelines.bump_head import mesh, render, ring
from tests.pipelines.region_scenes import camera_at, tracked

QUICK = 4.0  # millimetres per voxel


@pytest.fixture(scope="module")
def shots():
    """Eight cameras over 300 degrees: (camera, rgb, alpha, true depth)."""
    return [(camera, *render(camera)) for camera in ring(8, 160)]


@pytest.fixture(scope="module")
def views(shots):
    return [make_view(camera, rgb, alpha, 1024) for camera, rgb, alpha, _ in shots]


@pytest.fixture(scope="module")
def surface(views):
    return reconstruct(views, voxel_mm=QUICK)


def errors_mm(surface, shots, views=None) -> np.ndarray:
    """Absolute errors, millimetres; with views only of what lies over 2 mm inside their hull."""
    scene = mesh_scene(surface.vertices, surface.faces)
    found = []
    for camera, _, alpha, true in shots:
        view = cast_maps(surface, scene, camera, alpha)
        both = view.valid & (true > 0)
        assert both.sum() > 0.95 * ((true > 0) & (alpha > 0.5)).sum()
        if views is not None:
            origin, directions = rays(camera)
            both[both] = (
                hull_distance(views, (origin + directions * true[..., None])[both]) < -0.002
            )
        found.append(1e3 * np.abs(view.depth - true)[both])
    return np.concatenate(found)


def test_depth_is_right_to_under_a_millimetre(surface, shots):
    error = errors_mm(surface, shots)
    assert np.median(error) < 0.8
    assert np.percentile(error, 95) < 3.0


def test_photographs_help_where_silhouettes_show_nothing(surface, views, shots):
    flat = [replace(view, rgb=np.full_like(view.rgb, 128)) for view in views]
    hull = reconstruct(flat, voxel_mm=QUICK)
    carved, filled = (np.mean(errors_mm(s, shots, views)) for s in (surface, hull))
    assert carved < 0.6 * filled


def test_eye_sockets_which_no_silhouette_shows_are_carved(surface, views):
    deep = np.array([[side, 0.025, 0.081] for side in (-0.03, 0.03)])
    vertices, _ = mesh()
    at = vertices[[np.linalg.norm(vertices - p, axis=1).argmin() for p in deep]]
    assert (hull_distance(views, at) < -0.002).all()
    assert np.abs(surface.grid.sample(at)).max() < 0.002


def test_a_tracked_mesh_4_mm_off_does_no_harm(views, shots, surface):
    vertices, faces = mesh()
    wave = 0.004 * np.sin(vertices[:, [1, 2, 0]] * 50)
    keep = (vertices[faces][:, :, 1] > -0.06).all(1)  # open below, like a head model's neck
    moved = reconstruct(views, close_mesh(vertices + wave, faces[keep]), QUICK)
    assert np.median(errors_mm(moved, shots)) < np.median(errors_mm(surface, shots)) + 0.2


@pytest.mark.parametrize(("count", "bland"), [(2, False), (2, True), (3, False)])
def test_few_views_30_degrees_apart_keep_to_the_track(count, bland):
    """Their hull reaches centimetres before the face, which no silhouette shows."""
    shots = [(camera, *render(camera)) for camera in ring(count, 160, 30.0 * count)]
    grey = [(c, np.full_like(rgb, 128) if bland else rgb, alpha) for c, rgb, alpha, _ in shots]
    few = [make_view(*shot, 1024) for shot in grey]
    vertices, faces = mesh()
    wave = 0.003 * np.sin(vertices[:, [1, 2, 0]] * 50)
    keep = (vertices[faces][:, :, 1] > -0.06).all(1)
    error = errors_mm(reconstruct(few, close_mesh(vertices + wave, faces[keep]), QUICK), shots)
    assert np.median(error) < (5.0 if bland else 1.5)
    assert np.percentile(error, 90) < (20.0 if bland else 8.0)
    assert np.percentile(error, 95) < (30.0 if bland else 16.0)


def test_a_track_elsewhere_is_noticed(views):
    vertices, faces = mesh()
    assert matte_agreement(views, vertices, faces) > 0.97
    assert matte_agreement(views, vertices + [0.06, 0, 0], faces) < 0.85


def test_prior_counts_inner_sheets_and_capped_holes_as_inside():
    vertices, faces = mesh()
    open_below = faces[(vertices[faces][:, :, 1] > -0.06).all(1)]
    assert len(boundary_loops(open_below)) == 1
    prior = close_mesh(vertices, open_below)
    points = np.array([[0, 0, 0.0], [0, 0.05, 0], [0, 0.2, 0], [0, -0.09, 0.0], [0.1, 0, 0]])
    assert (prior.distance(points) < 0).tolist() == [True, True, False, False, False]
    gap = np.zeros(2)
    believed = prior.trust(np.array([[0, 0.1, 0.0], [0, -0.06, 0.0]]), gap)
    assert believed.tolist() == [1.0, 0.0]


def test_prior_is_weaker_where_the_hull_rises_far_above_it(shots):
    """Hair and shoulders rise above the tracked mesh; they are kept whole, without a shell."""
    vertices, faces = mesh()
    prior = close_mesh(vertices, faces)
    axis = np.linspace(-0.25, 0.25, 31)
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    far = (np.linalg.norm(cube, axis=-1) - 0.15).astype(np.float32)
    outlines = prior.outlines([make_view(*shot[:3], 1024) for shot in shots])
    kept = prior.merge(cube, far, outlines, 0.02) < 0
    assert kept.sum() > 0.98 * (far < 0).sum()
    assert not (kept & (far >= 0)).any()
    own = prior.distance(cube)
    near = (own - 0.01).astype(np.float32)
    merged = prior.merge(cube, near, outlines, 0.02)
    np.testing.assert_allclose(merged[near < 0.02], own[near < 0.02], atol=1e-6)
    np.testing.assert_array_equal(merged[near >= 0.02], near[near >= 0.02])


@pytest.mark.parametrize(("count", "shoulders"), [(4, 0.0), (5, 0.04)])
def test_shoulders_may_stand_out_from_the_tracked_body_but_nothing_from_the_face(count, shoulders):
    """Cameras in front do not show how far forward either reaches."""
    vertices, faces = mesh()
    prior = close_mesh(vertices, faces[(vertices[faces][:, :, 1] > -0.06).all(1)])
    outlines = prior.outlines([make_view(c, *render(c)[:2], 1024) for c in ring(count, 160, 30.0)])

    def reach(height: float) -> float:
        before = np.array([[0, height, z] for z in np.arange(0.0, 0.3, 0.001)])
        kept = prior.merge(before, np.full(len(before), -0.05, np.float32), outlines, 0.0) < 0
        return float(signed_distance(prior.body, before)[kept.argmin()])

    assert reach(0.0) < 0.01
    assert shoulders - 0.005 < reach(-0.14) < shoulders + 0.01


def test_what_glasses_hide_is_not_compared_and_the_head_is_kept_behind_them(shots):
    views = [make_view(*shot[:3], 1024) for shot in shots]
    bare = close_mesh(*mesh())
    front = np.array([[x, y, 0.125] for x in (-0.01, 0, 0.01) for y in (-0.01, 0, 0.01)])
    worn = replace(bare, glasses=front)
    assert bare.without_glasses(views)[0] is views[0]
    for view, clear in zip(views, worn.without_glasses(views), strict=True):
        hidden = ((clear.alpha == 0) & (view.alpha > 0)).mean()
        facing = view.camera.center[2] > 0.8  # from elsewhere they stand beside the head
        assert 0.005 < hidden < 0.02 if facing else hidden < 0.001
        np.testing.assert_array_equal(clear.silhouette_px, view.silhouette_px)
    points, height = np.array([[0, 0, 0.12], [0, 0.12, 0]]), np.full(2, 0.05)
    assert bare.trust(points, height).tolist() == [0, 0]
    assert worn.trust(points, height).tolist() == [1, 0]


def test_a_bare_face_is_kept_however_far_above_it_the_hull_lies():
    vertices, faces = mesh()
    front, up = vertices[:, 2] > 0.05, vertices[:, 1] > 0.05
    model = HeadTopology(vertices, faces, {"face": front, "forehead": up})
    bare = bare_triangles(model)
    assert 0 < bare.sum() < (front & ~up)[faces].any(1).sum()
    assert not bare_triangles(replace(model, regions={})).any()
    solid = replace(close_mesh(vertices, faces), bare=bare)
    points, height = np.array([[0, 0, 0.2], [0, 0.2, 0.06], [0, 0, -0.2]]), np.full(3, 0.1)
    assert solid.trust(points, height).tolist() == [1, 0, 0]
    open_behind = faces[(vertices[faces][:, :, 2] > -0.05).all(1)]
    solid = close_mesh(vertices, open_behind)  # its cap has triangles, which are not of the face
    cut = HeadTopology(vertices, open_behind, {"face": front})  # some vertices have no triangle
    solid = replace(solid, bare=bare_triangles(cut))
    assert solid.trust(points, height).tolist() == [1, 0, 0]


def test_room_before_the_face_is_carved_where_a_view_shows_it_bare(shots):
    """A hand leaves the hull full of air between it and the face."""
    camera, _, _, true = next(shot for shot in shots if shot[0].center[2] > 0.8)
    bare = (true > 0) & (np.arange(camera.width) < camera.width / 2)
    view = FaceView(camera, true.astype(np.float32), bare, (true > 0) & ~bare, np.zeros((0, 3)))
    solid = close_mesh(*mesh())
    middle = camera.width // 2
    pixels = np.array([[middle + x + 0.5, middle + 0.5] for x in (-12, -12, 12)])
    depth = true[middle, pixels[:, 0].astype(int)] - [0.03, 0.004, 0.03]
    points, hull = unproject(camera, pixels, depth), np.full(3, -0.05, np.float32)
    air, skin, thing = replace(solid, face_views=(view,)).carved(points, hull.copy())
    assert air > 0.01 and skin < 0 and thing < 0
    np.testing.assert_array_equal(solid.carved(points, hull.copy()), hull)


def test_a_matte_that_contradicts_the_others_is_left_out(shots, views):
    camera, rgb, alpha, _ = shots[3]
    half = alpha.copy()
    half[:, :85] = 0
    kept, why = without_contradiction([*views[:3], make_view(camera, rgb, half, 1024), *views[4:]])
    assert [note.what for note in why] == [camera.id] and len(kept) == 7
    assert without_contradiction(views)[1] == []


def test_what_a_matte_lacks_of_the_tracked_face_is_added():
    head, camera = tracked(), camera_at(75, size=200)
    labels = render_head(head, camera)[0]
    matte = (labels > 0).astype(np.float32)
    whole = make_view(camera, np.zeros((200, 200, 3), np.uint8), matte, 1024)
    face, rows = label_mask(labels, *FACE), np.nonzero(label_mask(labels, "lips"))[0]
    for deep_m, added in ((0.02, True), (0.002, False)):
        pixels = round(deep_m * camera.K[0, 0])
        alpha = whole.alpha.copy()
        for row in range(rows.min() - 20, rows.max()):  # from the nose's tip to the mouth
            tip = np.flatnonzero(alpha[row])[0]
            alpha[row, tip : tip + pixels] = 0
        lacking = replace(whole, alpha=alpha, silhouette_px=silhouette_distance(alpha))
        found = with_face(lacking, head)
        assert (found is not lacking) == added
        assert (found.alpha[face] == 1).all() == added
        assert np.array_equal(found.silhouette_px, silhouette_distance(found.alpha))
    assert with_face(whole, head) is whole


@pytest.mark.parametrize(("lacking", "least"), [(("photo",), 1), (("cam00", "cam01"), 2)])
def test_a_photograph_without_a_matte_is_not_asked_for_two_cameras(lacking, least, monkeypatch):
    notes = [Note(name, "it has no matte") for name in lacking]
    monkeypatch.setattr("pipelines.depth.stage.read_views", lambda *given: ([], [], notes))
    words = f"0 cameras with a matte of the head, expected at least {least} .*'express50 matte d'"
    with pytest.raises(StageError, match=words):
        run(Dataset(Path("d")), "S001/photo", Path("out"), **vars(DepthConfig(image_side=64)))


def test_unusable_mattes_are_refused(shots):
    camera, rgb, alpha, _ = shots[0]
    for bad, key in ((np.zeros_like(alpha), "0.00%"), (np.ones_like(alpha), "100.0%"),
                     (alpha[:-1], "160x159")):  # fmt: skip
        with pytest.raises(StageError, match=key):
            make_view(camera, rgb, bad, 1024)


def test_large_images_are_reduced_with_their_camera(shots):
    camera, rgb, alpha, _ = shots[0]
    view = make_view(camera, rgb, alpha, 80)
    assert view.alpha.shape == (80, 80)
    np.testing.assert_allclose(view.camera.K[:2], camera.K[:2] / 2)


def test_silhouette_distance_has_subpixel_position():
    x = np.arange(64) + 0.5
    alpha = np.clip(20.3 - np.hypot(x[None] - 32, x[:, None] - 32) + 0.5, 0, 1)
    signed = silhouette_distance(alpha.astype(np.float32))
    true = 20.3 - np.hypot(x[None] - 32, x[:, None] - 32)
    near = np.abs(true) < 5
    assert np.abs(signed - true)[near].max() < 0.25


def test_box_holds_the_head_and_little_more(views):
    low, high = head_box(views)
    vertices, _ = mesh()
    assert (low < vertices.min(0)).all() and (high > vertices.max(0)).all()
    assert ((high - low) < 1.5 * np.ptp(vertices, axis=0)).all()


def test_advance_moves_a_sphere_by_the_displacement():
    side = np.full(3, 0.15)
    grid = build(-side, side, 0.005, lambda points: np.linalg.norm(points, axis=1) - 0.1)
    vertices, normals, _ = extract_mesh(grid)
    np.testing.assert_allclose((normals * vertices).sum(1), 0.1, atol=1e-3)
    moved = extract_mesh(advance(grid, vertices, np.full(len(vertices), -0.012)))[0]
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.088, atol=3e-4)


def test_two_runs_give_the_same_surface(surface, views):
    again = reconstruct(views, voxel_mm=QUICK)
    assert again.vertices.tobytes() == surface.vertices.tobytes()
    assert again.colors.tobytes() == surface.colors.tobytes()


def test_confidence_separates_good_depth_from_bad(surface, shots):
    mattes = [np.rint(alpha * 255).astype(np.uint8) for _, _, alpha, _ in shots]
    pictures = [
        picture_of(camera, rgb, matte)
        for (camera, rgb, _, _), matte in zip(shots, mattes, strict=True)
    ]
    views = surface_maps(replace(surface, grid=None), pictures)  # as published, without the grid
    sure, unsure = [], []
    for (_, view, _), (*_, true) in zip(views, shots, strict=True):
        true = true[view.window]
        error = np.abs(view.depth - true)
        both = view.valid & (true > 0)
        cut = np.median(view.confidence[both])
        sure.append(error[both & (view.confidence > cut)])
        unsure.append(error[both & (view.confidence <= cut)])
    assert np.concatenate(sure).mean() < np.concatenate(unsure).mean()


def test_ply_is_read_by_another_library(surface, tmp_path):
    import trimesh

    write_meshes(tmp_path, surface)
    read = trimesh.load(tmp_path / "surface.ply", process=False)
    assert len(read.faces) == len(surface.faces)
    assert read.is_watertight and read.volume > 0
    assert read.visual.vertex_colors[:, 0].mean() > read.visual.vertex_colors[:, 2].mean()
