"""Check the files of the depth stage: meshes, maps in every format, the photo error."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from express50.capture.frames import read_cameras_of
from express50.dataset.depth_files import depth_file, read_depth, read_normals
from express50.dataset.tracks import read_track
from express50.errors import ConfigError
from express50.files.atomic import write_json
from express50.files.images import read_image
from express50.geometry.cameras import transform_camera
from express50.geometry.pixels import srgb_to_linear
from express50.geometry.raycast import mesh_scene
from express50.geometry.transforms import make_transform
from express50.head.load import load_head
from pipelines import regions, register
from pipelines.depth import STAGE, DepthConfig
from pipelines.depth.maps import PhotoErrors, compared_view, photo_errors
from pipelines.pack import ENCODE, EncodeConfig
from tests.pipelines.bump_dataset import make_dataset, published
from tests.pipelines.bump_head import mesh, render, ring
from tests.stages import run_here

QUICK = {"voxel_mm": 8.0}
ITEMS = ("S001/neutral", "S001/smile")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    made = make_dataset(tmp_path_factory.mktemp("depth"), cameras=4, size=80)
    made.track_file("S001").unlink()  # the surface is that of the views alone
    return made


@pytest.fixture(scope="module")
def written(dataset):
    """The folder of one item in the standard formats, and its metrics."""
    table = published(dataset, STAGE, DepthConfig(**QUICK))
    return dataset.item_dir("depth", ITEMS[0]), table[ITEMS[0]]


def test_both_meshes_hold_the_same_coloured_surface(written):
    folder, _ = written
    ply = trimesh.load(folder / "surface.ply", process=False)
    (glb,) = trimesh.load(folder / "surface.glb", process=False).geometry.values()
    np.testing.assert_array_equal(glb.faces, ply.faces)
    np.testing.assert_allclose(glb.vertices, ply.vertices, atol=1e-6)
    assert ply.is_watertight and ply.volume > 0
    np.testing.assert_allclose(glb.vertex_normals, ply.vertex_normals, atol=1e-2)
    srgb = ply.visual.vertex_colors[:, :3]
    linear = glb.visual.vertex_attributes["color"]
    assert np.ptp(srgb) > 60 and (linear[:, 3] == 255).all()
    np.testing.assert_allclose(linear[:, :3], 255 * srgb_to_linear(srgb / 255.0), atol=0.51)


def test_normal_maps_are_the_slope_of_the_depth_maps(dataset, written):
    folder, _ = written
    for name, camera in read_cameras_of(dataset, "S001").items():
        depth, valid = read_depth(depth_file(folder, name))
        normals, known = read_normals(folder / f"{name}_normals.png")
        assert (known == valid).mean() > 0.999 and (normals[known][:, 2] < 0.3).all()
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = np.stack([(x - camera.K[0, 2]) / camera.K[0, 0],
                         (y - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(x)], -1)  # fmt: skip
        points = rays * depth[..., None]
        across = np.cross(
            points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2]
        )
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
        inner = np.stack([valid[1 + a : 79 + a, 1 + b : 79 + b] for a in (-1, 0, 1)
                          for b in (-1, 0, 1)]).all(0)  # fmt: skip
        cosine = (across * normals[1:-1, 1:-1]).sum(-1)[inner]
        assert np.median(cosine) > 0.98


def test_colours_agree_through_the_right_surface_and_not_through_a_wrong_one():
    vertices, faces = mesh()
    rig = [(camera, *render(camera)[:2]) for camera in ring(6, 128, arc_deg=150)]

    def figures(points):
        scene = mesh_scene(points, faces)
        shots = [compared_view(scene, *row, 512) for row in rig]
        errors = np.concatenate([one.errors.ravel() for one in photo_errors(shots)])
        return PhotoErrors(errors, 1.0).figures()

    right, off = figures(vertices), figures(vertices + [0, 0, 0.006])
    assert 1 - right["photo_consistent"] < 0.5 * (1 - off["photo_consistent"])
    assert right["photo_error_median"] < 0.6 * off["photo_error_median"]


def test_gains_are_evened_and_unseen_points_are_not_compared():
    vertices, faces = mesh()
    scene = mesh_scene(vertices, faces)
    left, right = ring(2, 128, arc_deg=40)
    turn = make_transform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    behind = transform_camera(left, turn)
    rows = [(camera, *render(camera)[:2]) for camera in (left, right, behind)]
    dark = (rows[1][0], (rows[1][1] * 0.6).astype(np.uint8), rows[1][2])
    plain = photo_errors([compared_view(scene, *row, 512) for row in rows])
    gained = photo_errors([compared_view(scene, *row, 512) for row in (rows[0], dark, rows[2])])
    assert 0.5 < plain[0].compared < 1
    assert gained[0].figures()["photo_error_median"] < plain[0].figures()["photo_error_median"] + 1
    assert plain[2].compared == 0 and np.isnan(plain[2].errors).all()
    assert plain[2].figures() == {"photo_compared": 0.0}


def test_metrics_and_contact_sheet_show_the_photo_error(written):
    folder, row = written
    assert 0 < row["photo_error_median"] < row["photo_error_p95"]
    assert 0.5 < row["photo_consistent"] <= 1 and 0.3 < row["photo_compared"] <= 1
    assert row["cameras"]["cam01"]["photo_consistent"] > 0.5
    height, width = read_image(folder / "qc" / "surface.jpg").shape[:2]
    assert (height, width) == (5 * 240, 4 * 240)


@pytest.mark.parametrize(
    ("name", "value"), [("voxel_mm", 0.1), ("voxel_px", -1.0), ("image_side", 4), ("noise", 0.0)]
)
def test_values_out_of_range_are_named(name, value):
    with pytest.raises(ConfigError, match=name):
        DepthConfig(**{name: value})


def test_one_camera_gets_the_tracked_heads_depth_at_low_confidence(tmp_path):
    dataset = make_dataset(tmp_path, cameras=1, size=96)
    (camera,) = read_cameras_of(dataset, "S001").values()
    published(dataset, STAGE, DepthConfig(voxel_mm=3.0))
    folder = dataset.item_dir("depth", ITEMS[0])
    depth, valid = read_depth(depth_file(folder, camera.id))
    track = read_track(dataset.track_file("S001"))
    scene = mesh_scene(track.vertices[0], load_head(track.head).faces.numpy())
    alpha = read_image(dataset.matte_file("S001", "neutral", camera.id)) / 255.0
    shot = compared_view(scene, camera, np.zeros((*alpha.shape, 3), np.uint8), alpha, 96)
    both = valid & (shot.depth > 0)
    assert both.sum() > 0.9 * (shot.depth > 0).sum()
    assert np.median(np.abs(depth - shot.depth)[both]) < 1.5e-3
    assert read_image(folder / f"{camera.id}_confidence.png").max() < 80
    assert published(dataset, ENCODE, EncodeConfig(size=64))["S001"]["kept"] == len(ITEMS)

    dataset.track_file("S001").unlink()
    (outcome, _) = run_here(STAGE, dataset, voxel_mm=3.0).outcomes
    assert "express50 track" in outcome.reason


@pytest.mark.parametrize("cameras", [1, 2])
def test_what_shows_no_face_is_left_out_of_the_stages_that_need_one(tmp_path, cameras):
    dataset = make_dataset(tmp_path, cameras=cameras, size=48)
    note = {"what": "smile", "why": "no camera sees a face"}
    write_json(dataset.item_dir("track", "S001") / "metrics.json", {"dropped": [note]})
    assert STAGE.items(dataset) == list(ITEMS[:cameras])  # several cameras need no tracked head
    assert register.STAGE.items(dataset) == regions.STAGE.items(dataset) == list(ITEMS[:1])


def test_a_rig_of_which_one_camera_is_left_is_refused(tmp_path):
    dataset = make_dataset(tmp_path, cameras=3, size=48)
    for name in list(read_cameras_of(dataset, "S001"))[1:]:
        dataset.matte_file("S001", "neutral", name).unlink()
    run = run_here(STAGE, dataset, ITEMS[:1], **QUICK)
    assert "express50 matte" in run.outcomes[0].reason
