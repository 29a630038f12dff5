"""Measure depth of a known head under everything that goes wrong in a studio."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from express50.errors import StageError
from express50.files.images import write_image
from express50.geometry.cameras import pinhole_camera, rays
from express50.geometry.raycast import mesh_scene
from express50.geometry.transforms import axis_angle_to_matrix
from pipelines.depth import STAGE, DepthConfig
from pipelines.depth.maps import cast_maps, compared_view, photo_errors
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.views import make_view, without_contradiction
from tests.pipelines.bump_dataset import make_dataset
from tests.pipelines.bump_head import RADII, render, ring

SIZE = 96  # pixels of 3.4 mm
VOXEL_MM = 4.0


def take(cameras):
    """Each camera's picture: (camera, rgb, alpha, true depth)."""
    return [(camera, *render(camera)) for camera in cameras]


@pytest.fixture(scope="module")
def shots():
    return take(ring(8, SIZE))


@pytest.fixture(scope="module")
def views(shots):
    return views_of(shots)


@pytest.fixture(scope="module")
def usual(views, shots):
    """Errors, millimetres, where nothing is wrong."""
    return errors_mm(reconstruct(views, voxel_mm=VOXEL_MM), shots)[0]


def views_of(shots):
    return [make_view(camera, rgb, alpha, 1024) for camera, rgb, alpha, _ in shots]


def errors_mm(surface, shots, parts=None):
    """Errors (N,) of all pixels with a true depth (or of ``parts``), and the share covered."""
    scene = mesh_scene(surface.vertices, surface.faces)
    found, covered = [], []
    for k, (camera, _, alpha, true) in enumerate(shots):
        view = cast_maps(surface, scene, camera, alpha)
        wanted = (true > 0) & (alpha > 0.5) & (True if parts is None else parts[k])
        covered.append((view.valid & wanted).sum() / max(1, wanted.sum()))
        found.append(1e3 * np.abs(view.depth - true)[view.valid & wanted])
    return np.concatenate(found), min(covered)


def as_good_as(errors, usual, share=0.1):
    """Whether the median and the 95th percentile are within a share, or 0.1 mm, of the usual."""
    got, known = (np.percentile(e, [50, 95]) for e in (errors, usual))
    return (got < (1 + share) * known + 0.1).all()


def turned(camera, degrees):
    pose = camera.cam_from_world.copy()
    pose[:3] = axis_angle_to_matrix(np.radians([0, degrees, 0])) @ pose[:3]
    return replace(camera, cam_from_world=pose)


def test_three_neighbouring_views_still_give_a_face(shots, views):
    kept, why = without_contradiction(views[3:6])
    errors, covered = errors_mm(reconstruct(kept, voxel_mm=VOXEL_MM), shots[3:6])
    assert not why and covered > 0.99
    assert np.median(errors) < 1.0 and np.percentile(errors, 95) < 5.0


@pytest.mark.parametrize("degrees", [1.0, 3.0, 10.0])
def test_one_wrong_camera_is_named_and_does_no_harm(shots, views, usual, degrees):
    wrong = replace(views[3], camera=turned(views[3].camera, degrees))
    all_views = [*views[:3], wrong, *views[4:]]
    kept, why = without_contradiction(all_views)
    assert [note.what for note in why] == [wrong.camera.id] and "calibration" in why[0].why
    surface = reconstruct(kept, voxel_mm=VOXEL_MM)
    right = [shot for k, shot in enumerate(shots) if k != 3]
    assert as_good_as(errors_mm(surface, right)[0], usual)


def test_a_camera_too_little_off_for_the_mattes_stands_out_in_the_photo_error(views):
    wrong = replace(views[3], camera=turned(views[3].camera, 0.5))
    all_views = [*views[:3], wrong, *views[4:]]
    surface = reconstruct(all_views, voxel_mm=VOXEL_MM)
    scene = mesh_scene(surface.vertices, surface.faces)
    found = photo_errors([compared_view(scene, v.camera, v.rgb, v.alpha) for v in all_views])
    medians = np.array([one.figures()["photo_error_median"] for one in found])
    assert medians.argmax() == 3 and medians[3] > 1.4 * np.delete(medians, 3).max()


@pytest.mark.parametrize("radius_px", [2, 5])
def test_a_hole_in_every_matte_drills_no_tunnels(shots, usual, radius_px):
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:SIZE, :SIZE]
    holed = []
    for camera, rgb, alpha, true in shots:
        at = rng.uniform(38, 58, 2)
        hole = (y - at[0]) ** 2 + (x - at[1]) ** 2 < radius_px**2
        assert (alpha[hole] > 0.9).all()
        holed.append((camera, rgb, np.where(hole, 0, alpha).astype(np.float32), true))
    surface = reconstruct(views_of(holed), voxel_mm=VOXEL_MM)
    errors, covered = errors_mm(surface, shots)  # under the holes too
    assert covered > 0.99 and as_good_as(errors, usual)
    assert errors_mm(surface, holed)[0].size < errors.size  # no depth where the matte has none


def test_empty_mattes_are_one_error_that_names_every_camera(tmp_path):
    dataset = make_dataset(tmp_path, cameras=3, size=32)
    for name in ("cam00", "cam01", "cam02"):
        with_head = dataset.matte_file("S001", "smile", name)
        write_image(with_head, np.zeros((32, 32), np.uint8))
    with pytest.raises(StageError) as caught:
        STAGE.run(dataset, "S001/smile", DepthConfig(voxel_mm=VOXEL_MM), tmp_path)
    words = str(caught.value)
    assert words.count("its matte is empty") == 3 and "\n" not in words
    assert all(name in words for name in ("S001/smile", "cam00", "cam01", "cam02"))


@pytest.mark.parametrize(
    ("place", "radius"), [((0.03, 0.025, 0.081), 0.016), ((0.055, 0.0, 0.055), 0.025)]
)
def test_a_mirror_on_the_skin_misleads_no_more_than_silhouettes(shots, views, usual, place, radius):
    """A patch that shows the room, differently to every view: in an eye socket, on a cheek."""
    mirrored, patches = [], []
    for camera, rgb, alpha, true in shots:
        origin, way = rays(camera)
        points = origin + way * true[..., None]
        patch = (true > 0) & (np.linalg.norm(points - np.array(place), axis=-1) < radius)
        shown = np.where(patch[..., None], room(points, way)[..., None], rgb).astype(np.uint8)
        mirrored.append((camera, shown, alpha, true))
        patches.append(patch)
    surface = reconstruct(views_of(mirrored), voxel_mm=VOXEL_MM)
    flat = [replace(view, rgb=np.full_like(view.rgb, 128)) for view in views]
    hull = reconstruct(flat, voxel_mm=VOXEL_MM)
    inside, alone = (errors_mm(one, mirrored, patches)[0] for one in (surface, hull))
    outside, _ = errors_mm(surface, mirrored, [~patch for patch in patches])
    assert len(inside) > 100
    assert (np.percentile(inside, [50, 95]) < np.percentile(alone, [50, 95]) + 0.3).all()
    assert as_good_as(outside, usual)


def room(points, way):
    """Brightness (H, W) of the room in a mirror at points (H, W, 3) seen along ``way``."""
    normals = points / RADII**2
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    along = way / np.linalg.norm(way, axis=-1, keepdims=True)
    back = along - 2 * (along * normals).sum(-1, keepdims=True) * normals
    turns = np.array([[1, 0.3, 0.2], [0.1, 1, 0.4], [0.5, 0.2, 1], [1, 1, -1]])
    waves = np.sin(9 * np.arange(1, 5) * (back @ turns.T) + np.arange(4)).sum(-1)
    return np.clip(128 + 30 * waves, 0, 255)


@pytest.mark.parametrize(("shift", "least_cut"), [(20, 5), (30, 8)])
def test_a_head_cut_by_the_frames_edge_keeps_its_shape(usual, shift, least_cut):
    """Principal points moved by up to a third of the image, in another direction each."""
    moved = []
    for k, camera in enumerate(ring(8, SIZE)):
        K = camera.K.copy()
        K[:2, 2] += [shift if k % 2 else -shift, shift * (k % 3 - 1)]
        moved.append(pinhole_camera(camera.id, K, SIZE, SIZE, camera.cam_from_world))
    cut = take(moved)
    rims = [np.r_[a[[0, -1]].ravel(), a[:, [0, -1]].ravel()].max() > 0.5 for _, _, a, _ in cut]
    assert sum(rims) >= least_cut
    kept, why = without_contradiction(views_of(cut))
    errors, covered = errors_mm(reconstruct(kept, voxel_mm=VOXEL_MM), cut)
    assert not why and covered > 0.98 and as_good_as(errors, usual, 0.25)


def test_a_matte_of_specks_that_vanish_when_shrunk_is_refused(shots):
    camera, rgb, alpha, _ = shots[0]
    specks = np.zeros_like(alpha)
    specks[::12, ::12] = 1.0
    with pytest.raises(StageError, match="48x48"):
        make_view(camera, rgb, specks, SIZE // 2)
    assert make_view(camera, rgb, alpha, SIZE // 2).camera.width == SIZE // 2


def test_small_holes_are_filled_for_all_that_looks_at_a_matte(shots):
    camera, rgb, alpha, _ = shots[0]
    middle = np.argwhere(alpha > 0.99).mean(0).astype(int)
    holed = alpha.copy()
    holed[middle[0] - 2 : middle[0] + 3, middle[1] - 2 : middle[1] + 3] = 0.0
    view = make_view(camera, rgb, holed, SIZE)
    assert view.alpha[tuple(middle)] == 1.0 and view.silhouette_px[tuple(middle)] > 0
