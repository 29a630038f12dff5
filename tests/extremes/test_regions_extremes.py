"""Test labels at the edges: no head, no matte, one pixel, far worlds, damaged tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from express50.contract.segmentation_labels import LABELS, label_mask
from express50.dataset.depth_files import encode_depth, write_depth
from express50.errors import FormatError, StageError
from express50.files.images import write_image
from express50.geometry.cameras import pinhole_camera, resized, transform_camera
from express50.geometry.transforms import look_at, make_transform
from pipelines.regions import STAGE, RegionsConfig
from pipelines.regions.geometry import SCALP, head_alpha, head_geometry, make_head, render_head
from pipelines.regions.stage import label_shares, label_view, mesh_fit, subject_box, view_warning
from tests.pipelines.bump_dataset import make_dataset
from tests.pipelines.region_scenes import camera_at, make_scene, tracked

SCENE = make_scene(0)
CONFIG = RegionsConfig()


def labels_of(camera, alpha, depth=None, head=SCENE.head) -> np.ndarray:
    """Labels of a view on a grey frame."""
    rgb = np.full((camera.height, camera.width, 3), 128, np.uint8)
    return label_view(head, camera, rgb, np.float32(alpha), depth, False, CONFIG.image_side).labels


def turned_away():
    """A camera before the face that looks the other way."""
    eye = np.array([0.0, 0.0, 1.0])
    K = np.array([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]])
    pose = look_at(eye, 2 * eye)
    return pinhole_camera("away", K, 64, 64, pose)


def test_a_camera_that_does_not_see_the_head_has_no_head() -> None:
    aside = replace(SCENE.camera, params=(*SCENE.camera.params[:2], 9000.0, 80.0))
    for camera in (turned_away(), aside):
        full = np.ones((camera.height, camera.width))
        assert not render_head(SCENE.head, camera)[0].any()
        labels = labels_of(camera, full)
        assert label_mask(labels, "torso").all()
        plain = head_geometry(SCENE.head, camera, np.float32(full), None).labels()
        assert label_mask(plain, "torso").all()
        assert head_alpha(np.float32(full), labels).max() == 0


def test_a_camera_inside_the_head_gives_finite_labels() -> None:
    inside = replace(turned_away(), cam_from_world=np.eye(4))
    labels, depth = render_head(SCENE.head, inside)
    assert np.isfinite(depth).all() and (labels <= SCALP).all()
    assert (labels_of(inside, np.ones((64, 64))) < len(LABELS)).all()


def test_empty_and_full_mattes() -> None:
    empty = np.zeros(SCENE.alpha.shape)
    assert not labels_of(SCENE.camera, empty).any()
    full = labels_of(SCENE.camera, empty + 1)
    assert (full > 0).all() and {LABELS[k] for k in np.unique(full)} >= {"skin", "torso"}
    unknown = np.zeros(SCENE.alpha.shape, np.float32)
    assert np.array_equal(labels_of(SCENE.camera, empty + 1, unknown), full)  # knows nothing


def test_what_hides_all_of_a_face_is_not_the_face() -> None:
    depth = np.full(SCENE.alpha.shape, 0.5, np.float32)
    labels = labels_of(SCENE.camera, np.ones(SCENE.alpha.shape), depth)
    assert not label_mask(labels, "eyes").any()
    face = label_mask(SCENE.labels, "eyes", "lips")
    assert (labels[face] == LABELS.index("hand")).mean() > 0.9


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (2, 3)])
def test_the_smallest_pictures(size) -> None:
    camera = resized(SCENE.camera, *size)
    for alpha in (0.0, 1.0):
        labels = labels_of(camera, np.full(size[::-1], alpha))
        assert labels.shape == size[::-1] and bool(labels.any()) is (alpha > 0)
        head = head_alpha(np.full(size[::-1], alpha, np.float32), labels)
        assert np.isfinite(head).all() and head.min() >= 0
        shares = label_shares(labels)
        assert sum(shares.values()) == pytest.approx(1, abs=1e-5)
        assert subject_box(labels)


def test_a_subject_a_kilometre_from_the_origin_has_the_same_labels() -> None:
    far = np.array([600.0, -20.0, 800.0])
    motion = make_transform(np.eye(3), far)
    camera = transform_camera(SCENE.camera, motion)
    head = make_head(SCENE.head.vertices + far, np.eye(3), SCENE.head.labels)
    near = labels_of(SCENE.camera, SCENE.alpha, SCENE.depth)
    moved = labels_of(camera, SCENE.alpha, SCENE.depth, head)
    assert (near == moved).mean() > 0.999


def test_a_camera_a_kilometre_away_sees_a_head_of_a_few_pixels() -> None:
    camera = camera_at(0, 8, distance=1000.0)
    labels, depth = render_head(tracked(), camera)
    assert 4 < (labels > 0).sum() < 40 and depth[labels > 0].min() > 999
    wide = replace(camera, params=(50.0, 50.0, 4.0, 4.0))  # the head is far under a pixel
    assert (labels_of(wide, np.ones((8, 8))) < len(LABELS)).all()


def test_figures_of_empty_input_are_finite_and_named() -> None:
    nothing = np.zeros((4, 4), bool)
    fit = mesh_fit(nothing, np.zeros((4, 4)), np.zeros((4, 4)))
    assert fit == {"mesh_in_matte": 0.0, "mesh_iou_head": 0.0}
    figures = {"mesh_in_frame": True, "mesh_in_matte": 1.0, "head": 0.5,
               "labels": label_shares(np.ones((4, 4), np.uint8))}  # fmt: skip
    assert view_warning(figures) is None
    changes = (
        {"mesh_in_frame": False},
        {"labels": label_shares(np.zeros((4, 4), np.uint8))},
        {"head": 0.0},
        {"mesh_in_matte": 0.3},
    )
    assert len({view_warning(figures | change) for change in changes} - {None}) == 4
    assert "30%" in str(view_warning(figures | changes[-1]))


def test_damaged_tracks_are_one_clear_line(tmp_path) -> None:
    dataset = make_dataset(tmp_path, cameras=2, size=32)
    path = dataset.track_file("S001")
    with np.load(path) as table:
        arrays = dict(table)
    for changes, message in (
        ({"R": np.nan * arrays["R"]}, "R .*not finite.*; run 'express50 track' again"),
        ({"expressions": np.array(["shout", "wink"])}, "it is not tracked"),
    ):
        np.savez(path, **arrays | changes)
        with pytest.raises((FormatError, StageError), match=message) as caught:
            STAGE.run(dataset, "S001/smile", CONFIG, tmp_path)
        assert "\n" not in str(caught.value)


def test_mattes_and_depth_maps_of_another_size_are_named(tmp_path) -> None:
    dataset = make_dataset(tmp_path, cameras=3, size=32)
    write_image(dataset.matte_file("S001", "smile", "cam00"), np.zeros((8, 8), np.uint8))
    folder = dataset.item_dir("depth", "S001/smile")
    folder.mkdir(parents=True)
    write_depth(folder, "cam01", encode_depth(np.ones((8, 8)), np.ones((8, 8), bool)))
    result = STAGE.run(dataset, "S001/smile", CONFIG, tmp_path)
    why = {note.what: note.why for note in result.dropped}
    assert "express50 matte" in why["cam00"] and "express50 depth" in why["cam01"]
    assert set(result.metrics["cameras"]) == {"cam02"}
