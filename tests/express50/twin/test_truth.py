import dataclasses

import numpy as np
import pytest
import torch

from benchmarks.truth import Truth, align_worlds
from express50.errors import CaptureError
from express50.files.images import read_image
from express50.geometry.cameras import project, resized, transform_camera
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.head.model import landmarks
from express50.twin.rig import make_rig
from express50.twin.surface import Material


@pytest.fixture(scope="module")
def truth(recording):
    return Truth(recording / "truth")


def test_landmarks_project_into_the_alpha(truth):
    frame = truth.peaks("S001")["jaw_open"]
    camera = truth.cameras("S001")["cam01"]
    alpha = truth.render_alpha("S001", frame, camera)
    vertices = torch.from_numpy(truth.vertices("S001", frame)).float()
    marks = landmarks(truth.head_model("S001"), vertices[None])[0].numpy()
    pixels, _ = project(camera, marks)
    x, y = np.floor(pixels[17:]).astype(int).T  # the jaw line itself may lie on the silhouette
    assert (alpha[y, x] > 0.99).all()
    assert alpha.min() == 0.0 and alpha.max() == 1.0
    assert ((alpha > 0.01) & (alpha < 0.99)).sum() > 50


def test_alpha_matches_the_footage(truth, recording):
    frame, camera = 2, truth.cameras("S001")["cam01"]
    alpha = truth.render_alpha("S001", frame, camera)
    root = recording / "captures" / "S001"
    image = read_image(root / f"cameras/cam01/frames/{frame:06d}.png").astype(float)
    plate = read_image(root / "plates/cam01.png").astype(float)
    change = np.abs(image - plate).max(-1)
    assert change[alpha == 0].mean() < 4.0
    # Skin as grey as the wall may not differ everywhere, most of the subject does.
    assert (change[alpha == 1] > 12).mean() > 0.85


def test_depth_is_that_of_the_vertices(truth):
    camera, frame = truth.cameras("S001")["cam01"], 4
    depth, valid = truth.render_depth("S001", frame, camera)
    pixels, z = project(camera, truth.vertices("S001", frame))
    x, y = np.floor(pixels).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    behind = z[inside] - depth[y[inside], x[inside]]
    seen = valid[y[inside], x[inside]]
    # No vertex is in front of the depth map by more than the slope across a pixel.
    assert np.quantile(behind[seen], 0.02) > -0.012
    assert np.isfinite(depth).all() and (depth[valid] > 0.5).all() and (depth[~valid] == 0).all()


def test_the_surface_is_where_the_depth_is_and_fills_the_alpha(truth):
    camera, frame = truth.cameras("S001")["cam01"], 4
    material, vertex = truth.surface("S001", frame, camera)
    depth, valid = truth.render_depth("S001", frame, camera)
    assert np.array_equal(material >= 0, valid)
    assert {Material.SKIN, Material.EYE, Material.HAIR, Material.CLOTH} <= set(np.unique(material))
    points, _ = truth.mesh("S001", frame)
    pixels, z = project(camera, points[vertex[valid]])
    assert np.quantile(np.abs(z - depth[valid]), 0.9) < 0.02
    # Skin belongs to the head model, whose vertices come first; cloth does not.
    heads = len(truth.vertices("S001", frame))
    assert (vertex[material == Material.SKIN] < heads).all()
    assert (vertex[material == Material.CLOTH] >= heads).all()
    assert truth.hairiness("S001").max() > 0.9 and truth.hairiness("S001").min() == 0


def test_peak_frames_are_in_their_windows_and_strongest(truth):
    for expression, first in (("neutral", 0), ("jaw_open", 5)):
        peak = truth.peaks("S001")[expression]
        assert first < peak < first + 4
        strengths = [truth.parameters("S001", f)["strength"] for f in range(first, first + 5)]
        assert int(np.argmax(strengths)) == peak - first and strengths[peak - first] == 1.0
    assert truth.parameters("S001", truth.peaks("S001")["jaw_open"])["jaw"][0] > 0.2


def test_vertices_are_metres_near_the_rig(truth):
    vertices, faces = truth.mesh("S001", 0)
    head = truth.vertices("S001", 0)
    assert np.array_equal(vertices[: len(head)], head.astype(np.float32))
    assert faces.max() == len(vertices) - 1
    assert 0.2 < np.ptp(head[:, 1]) < 0.45


def test_truth_renders_at_any_size_and_in_a_pinhole(truth):
    camera = resized(truth.cameras("S001")["cam00"], 48, 48)
    alpha = truth.render_alpha("S001", 0, camera)
    full = truth.render_alpha("S001", 0, truth.cameras("S001")["cam00"])
    halved = full.reshape(48, 2, 48, 2).mean((1, 3))
    assert np.abs(alpha - halved).mean() < 0.01


def test_missing_truth_is_refused(truth, tmp_path):
    with pytest.raises(CaptureError, match="no truth"):
        Truth(tmp_path)
    with pytest.raises(CaptureError, match="S009"):
        truth.vertices("S009", 0)
    with pytest.raises(ValueError, match=r"expected 0\.\.9"):
        truth.vertices("S001", 10)


@pytest.mark.parametrize("count", [1, 2, 8])
def test_align_worlds_finds_the_rigid_motion(count):
    rig = make_rig(count, 64, 64, 0)
    motion = make_transform(axis_angle_to_matrix(np.array([0.3, -2.0, 0.7])), [0.4, -1.0, 2.0])
    moved = {name: transform_camera(camera, motion) for name, camera in rig.items()}
    found = align_worlds(moved, rig)
    assert np.abs(found @ motion - np.eye(4)).max() < 1e-9
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_align_worlds_averages_noise_and_needs_a_shared_camera():
    rig = make_rig(8, 64, 64, 0)
    rng = np.random.default_rng(0)
    noisy = {}
    for name, camera in rig.items():
        pose = camera.cam_from_world.copy()
        pose[:3, 3] += rng.normal(0, 1e-3, 3)
        noisy[name] = dataclasses.replace(camera, cam_from_world=pose)
    assert np.abs(align_worlds(noisy, rig) - np.eye(4)).max() < 2e-3
    with pytest.raises(ValueError, match="share no camera"):
        align_worlds({"a": rig["cam00"]}, rig)
