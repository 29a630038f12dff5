"""One face, one camera, at the extremes: lenses, distances, cut faces, profiles, backs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from express50.errors import CaptureError
from express50.geometry.cameras import Camera, project_pinhole
from express50.head.load import load_head
from express50.head.model import landmarks_of, pose
from express50.head.preview import render_preview
from express50.landmarks.detector import Detection, detect
from express50.landmarks.irises import find_irises
from express50.landmarks.network import load_network
from pipelines.photo import capture
from pipelines.photo.capture import find_faces, single_camera, weigh_focal
from pipelines.track.basis import Basis, Points, make_basis
from pipelines.track.config import TrackConfig
from pipelines.track.eyes_and_jaw import contour_points
from pipelines.track.fit import fit
from pipelines.track.observe import LandmarkView, landmark_sigma, triangulate_views
from pipelines.track.state import Target, initial_pose, start_state
from pipelines.track.terms import landmark_anchors

data = pytest.importorskip("skimage.data")


@pytest.fixture(scope="module")
def basis() -> Basis:
    return make_basis(load_head("procedural"))


@pytest.fixture(scope="module")
def seen() -> Detection:
    return detect(load_network(), data.astronaut())


def fit_one(basis: Basis, face: Detection, camera: Camera) -> tuple[np.ndarray, float]:
    """World landmarks (68, 3) of a single-view fit, and their error between brows and mouth, px."""
    view = LandmarkView(camera, face.points, face.sigma, face.score)
    observation, _ = triangulate_views("photo", 0, [view])
    template = landmarks_of(basis.model)
    start = start_state(basis, [initial_pose(observation, template)])
    target = Target(observation, landmark_sigma(observation), False)
    state, cost = fit(basis, [target], start, 8)
    assert np.isfinite(cost)
    own = np.concatenate([state.shape, state.poses[0].own])
    everything = Points(basis, np.arange(len(basis.model.template)))
    mesh = everything.evaluate(own, state.poses[0].rotation)
    marks = landmark_anchors(basis.model).at(mesh)
    pixels, _ = project_pinhole(camera, marks)
    return marks, float(np.sqrt(((pixels - face.points)[17:] ** 2).sum(1).mean()))


@pytest.mark.parametrize(("focal", "worst"), [(20.0, 20.0), (300.0, 3.0), (8000.0, 3.0)])
def test_any_lens_gives_a_head_before_the_camera(basis, seen, focal: float, worst: float) -> None:
    """No head looks like this one under a lens of 20 px: it is fitted badly, but as a head."""
    camera = single_camera("photo", 512, 512, focal)
    marks, error = fit_one(basis, seen, camera)
    depth = (marks @ camera.cam_from_world[2, :3]) + camera.cam_from_world[2, 3]
    assert (depth > 0).all()
    assert error < worst
    assert 0.07 < np.ptp(marks[17:, 0]) < 0.16


@pytest.mark.parametrize("away", [1e3, 1e5])
def test_far_from_the_origin_the_fit_is_the_same(basis, seen, away: float) -> None:
    camera = single_camera("photo", 512, 512, 800.0)
    here, _ = fit_one(basis, seen, camera)
    shift = np.array([0.6, -0.5, 0.62]) * away
    moved = np.eye(4)
    moved[:3, 3] = -shift
    far = replace(camera, cam_from_world=camera.cam_from_world @ moved)
    there, _ = fit_one(basis, seen, far)
    np.testing.assert_allclose(there - shift, here, atol=2e-4)


def test_a_face_partly_outside_the_image_is_fitted_where_it_is(basis, seen) -> None:
    cut = 195
    face = detect(load_network(), np.ascontiguousarray(data.astronaut()[:, cut:]))
    assert face.score > 0.3
    marks, _ = fit_one(basis, face, single_camera("photo", 512 - cut, 512, 800.0))
    pixels, _ = project_pinhole(single_camera("photo", 512 - cut, 512, 800.0), marks)
    inside = seen.points[:, 0] > cut
    error = np.linalg.norm(pixels + [cut, 0] - seen.points, axis=1)[17:][inside[17:]]
    assert np.median(error) < 6.0


def head_from(yaw: float) -> np.ndarray:
    model = load_head("procedural")
    none = torch.zeros(1, 0)
    return render_preview(model, pose(model, none, none)[0], yaw=yaw, size=256)


@pytest.mark.parametrize("yaw", [-75.0, 75.0])
def test_a_profile_is_found_and_fitted(basis, yaw: float) -> None:
    (face,) = find_faces(Path("profile.png"), [head_from(yaw)], TrackConfig())
    camera = single_camera("photo", 256, 256, 256 / 0.34 * 1.2)
    marks, error = fit_one(basis, face, camera)
    assert error < 8.0
    # A camera that went round to the subject's left sees the nose point to its own left.
    assert np.sign(marks[30, 0] - marks[27:48, 0].mean()) == -np.sign(yaw)


@pytest.mark.parametrize("yaw", [130.0, 180.0])
def test_the_back_of_a_head_is_not_a_face(yaw: float) -> None:
    with pytest.raises(CaptureError, match=r"back.png: no face found \(best score 0.0"):
        find_faces(Path("back.png"), [head_from(yaw)], TrackConfig())


def test_a_score_just_too_low_is_not_rounded_up(monkeypatch) -> None:
    almost = SimpleNamespace(score=0.1999)
    monkeypatch.setattr(capture, "detect", lambda *unused: almost)
    with pytest.raises(CaptureError, match=r"best score 0.19, expected 0.2 or more"):
        find_faces(Path("dim.png"), [head_from(0.0)], TrackConfig())


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (3000, 2)])
def test_sliver_pictures_have_no_face_and_no_irises(size: tuple[int, int]) -> None:
    image = np.full((*size, 3), 128, np.uint8)
    with pytest.raises(CaptureError, match="no face found"):
        find_faces(Path("sliver.png"), [image], TrackConfig())
    irises = find_irises(image, detect(load_network(), image))
    assert (irises.confidence == 0).all() and np.isfinite(irises.centres).all()


def test_a_face_hardly_constrains_its_lens(basis, seen) -> None:
    """The range of focal lengths is wide, holds the guess, and a given one is kept."""
    found = weigh_focal(basis, [seen], (512, 512), (836.0, "guess"))
    assert found.source == "guess" and found.pixels == 836.0
    assert found.low < 600 < 1300 < found.high


def test_jaw_lines_of_degenerate_meshes_stay_finite(basis: Basis) -> None:
    camera = single_camera("photo", 64, 64, 100.0)
    for mesh in (np.zeros((len(basis.model.template), 3)), 1e6 * basis.model.template.numpy()):
        line = contour_points(basis.model, mesh, camera)
        assert np.isfinite(line.places.at(mesh)).all()
        assert line.places.vertices.shape == (17, 3) and line.usable.dtype == bool


@pytest.mark.parametrize(
    ("width", "turns"), [(48, 0), (96, 0), (192, 0), (192, 1), (192, 2), (192, 3)]
)
def test_a_face_is_found_wherever_and_however_small_it_is(width: int, turns: int) -> None:
    """In a picture of 1000 pixels, among other things; the pasted face is about `width` wide."""
    from skimage import data

    head = cv2.resize(data.astronaut()[:280, 80:380], None, fx=width / 96, fy=width / 96)
    picture = cv2.resize(data.coffee(), (1000, 1000))
    rng = np.random.default_rng(width + turns)
    y, x = (int(rng.integers(0, 1000 - side)) for side in head.shape[:2])
    picture[y : y + head.shape[0], x : x + head.shape[1]] = head
    face = detect(load_network(), np.ascontiguousarray(np.rot90(picture, turns)), smallest=0.08)
    assert face.score > 0.5
    middle = np.array([x, y]) + np.array([144, 125]) * width / 96
    for _ in range(turns):  # as np.rot90 turns it
        middle = np.array([middle[1], 1000 - middle[0]])
    assert np.linalg.norm(face.points.mean(0) - middle) < 0.25 * width
