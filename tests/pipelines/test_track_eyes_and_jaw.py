"""Irises and jaw lines in the fit, crowded and wrongly calibrated cameras, covariances."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from express50.geometry.cameras import project, triangulate
from express50.head.load import load_head
from express50.head.model import HeadModel, landmarks, landmarks_of, vertex_normals
from express50.landmarks.irises import Irises
from pipelines.track.basis import make_basis
from pipelines.track.eyes_and_jaw import (
    JAW,
    contour_points,
    iris_vertices,
    measure_eyes,
    with_irises_and_jaw,
)
from pipelines.track.fit import fit
from pipelines.track.observe import (
    LandmarkView,
    landmark_sigma,
    point_covariance,
    triangulate_views,
)
from pipelines.track.state import Target, initial_pose, start_state
from pipelines.track.terms import MeshPlaces, PixelTerm, Sighting
from tests.pipelines.test_track import RIG, make_camera, make_scene, make_views


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head("procedural").to(dtype=torch.float64)


@pytest.mark.parametrize("angle", [0.0, 0.35, 0.7, 1.1, 1.5])
def test_moved_jaw_points_lie_on_the_rim(head: HeadModel, angle: float) -> None:
    mesh, camera = head.template.numpy(), make_camera(angle)
    line = contour_points(head, mesh, camera)
    points = line.places.at(mesh)
    normals = vertex_normals(head.template[None], head.faces)[0].numpy()
    towards = camera.center - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    rim = (normals[line.places.vertices[:, 0]] * towards).sum(1)
    assert np.abs(rim[line.moved & line.usable]).max(initial=0.0) <= 0.21
    fixed = landmarks(head, head.template[None])[0, :JAW].numpy()
    np.testing.assert_allclose(points[~line.moved], fixed[~line.moved], atol=1e-9)


def test_the_far_side_of_the_jaw_goes_first(head: HeadModel) -> None:
    mesh = head.template.numpy()
    front, side = (contour_points(head, mesh, make_camera(angle)) for angle in (0.0, 1.4))
    assert front.usable.sum() >= 11 and not front.moved[6:11].any()
    # Seen from the subject's left, the right half of the jaw (0..7) is hidden or on the rim.
    assert not (side.usable & ~side.moved)[:6].any()
    assert (side.usable & ~side.moved)[10:15].all()


def test_the_visible_jaw_explains_visible_marks_better(head: HeadModel) -> None:
    """Marks made on the outline of the far cheek are nearer to the moved points than to the fixed.

    The outline is that of the skin's own points, by their place in the image alone.
    """
    mesh, camera = head.template.numpy(), make_camera(0.7)
    line = contour_points(head, mesh, camera)
    fixed = landmarks(head, head.template[None])[0, :JAW].numpy()
    skin = head.regions["face"].numpy() & ~head.regions["neck"].numpy()
    outline = project(camera, mesh[skin])[0]

    def inside(point: np.ndarray) -> float:
        x, y = project(camera, point[None])[0][0]
        return abs(x - outline[np.abs(outline[:, 1] - y) < 4, 0].min())

    chosen = np.flatnonzero(line.moved & line.usable)
    moved = [inside(line.places.at(mesh)[point]) for point in chosen]
    assert len(chosen) >= 3
    assert np.mean(moved) < 0.6 * np.mean([inside(fixed[point]) for point in chosen])


def gazing(head: HeadModel, yaws: list[float]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Meshes of a head whose eyes turn, and the eyes' angles."""
    from express50.head.model import pose

    found = []
    for yaw in yaws:
        eyes = torch.tensor([[0, yaw, 0, 0, yaw, 0]], dtype=torch.float64)
        none = torch.zeros(1, 0, dtype=torch.float64)
        found.append((pose(head, none, none, eyes=eyes)[0].numpy(), eyes[0].numpy()))
    return found


def observed(head: HeadModel, mesh: np.ndarray, shift: np.ndarray) -> Target:
    """Exact views of a mesh, its irises seen a little beside the model's."""
    marks = landmarks_of(head, mesh)
    left, right = iris_vertices(head)
    views = []
    for camera in RIG:
        centres = project(camera, mesh[[left, right]] + shift)[0]
        irises = Irises(centres, np.full(2, 0.5), np.full(2, 0.9))
        points = project(camera, marks)[0]
        views.append(LandmarkView(camera, points, np.ones(68), 0.9, irises))
    observation, _ = triangulate_views("gaze", 0, views)
    return Target(observation, landmark_sigma(observation), False)


def test_irises_turn_the_eyes_and_a_constant_offset_does_not(head: HeadModel) -> None:
    basis = make_basis(head)
    shift = np.array([0.0, 0.0012, 0.0])
    made = gazing(head, [0.0, 0.4, -0.4, 0.0, 0.25, -0.25])
    targets = [observed(head, mesh, shift) for mesh, _ in made]
    rest = head.template.numpy()
    turns = np.tile(np.eye(3), (len(made), 1, 1))
    eyes = measure_eyes(head, targets, np.tile(rest, (len(made), 1, 1)), turns)
    assert eyes is not None
    np.testing.assert_allclose(eyes.offsets[:, 1], 0.0012, atol=5e-4)
    template = landmarks_of(head)
    errors, blind = [], []
    for target, (_, truth) in zip(targets, made, strict=True):
        start = start_state(basis, [initial_pose(target.observation, template)])
        for errors_of, one in (
            (errors, with_irises_and_jaw(head, target, rest, np.eye(3), eyes)),
            (blind, target),
        ):
            state, _ = fit(basis, [one], start, 8)
            angle = state.poses[0].own[basis.expression_size + 6 :][:6]
            errors_of.append(np.degrees(np.abs(angle - truth).max()))
    assert np.mean(errors) < 5.0 < 9.0 < np.mean(blind)


def test_reprojection_errors_have_the_slope_they_say() -> None:
    places = np.random.default_rng(0).normal(size=(2, 3)) * 0.1
    seen = [
        Sighting(camera, np.array(rows), np.full((len(rows), 2), 200.0), np.array([2.0, 3.0]))
        for camera, rows in ((RIG[0], [1, 0]), (RIG[1], [0, 1]))
    ]
    term = PixelTerm(MeshPlaces.of_vertices(np.array([1, 3])), tuple(seen))
    rows, residual, slope = term.residuals(places)
    np.testing.assert_array_equal(rows, [1, 0, 0, 1])
    for axis in range(3):
        ahead = term.residuals(places + np.eye(3)[axis] * 1e-6)[1]
        np.testing.assert_allclose(slope[..., axis], (ahead - residual) / 1e-6, rtol=1e-3, atol=0.1)


def test_covariance_is_that_of_repeated_triangulation() -> None:
    scene = make_scene()
    rng = np.random.default_rng(0)
    sigma = 0.7
    exact = [dataclasses.replace(v, sigma=np.full(68, sigma)) for v in make_views(scene.marks)]
    found = []
    for _ in range(60):
        noisy = [
            dataclasses.replace(v, points=v.points + sigma * rng.normal(size=(68, 2)))
            for v in exact
        ]
        found.append(triangulate(RIG, np.stack([v.points for v in noisy]), np.ones((3, 68))))
    error = np.stack(found) - scene.marks
    measured = np.einsum("nki,nkj->ij", error, error) / (len(error) * 68)
    stated = point_covariance(exact, scene.marks, np.ones((3, 68), dtype=bool)).mean(0)
    np.testing.assert_allclose(measured, stated, atol=0.05 * np.trace(stated))


def test_points_of_one_direction_have_no_covariance() -> None:
    scene = make_scene()
    views = make_views(scene.marks, cameras=[RIG[0], RIG[0]])
    covariance = point_covariance(views, scene.marks, np.ones((2, 68), dtype=bool))
    assert not np.isfinite(covariance).any() or np.trace(covariance[0]) > 1.0


def test_a_camera_given_ten_times_counts_as_one() -> None:
    """Nine copies of a camera that errs do not outvote three that agree."""
    scene = make_scene()
    good = make_views(scene.marks, 0.2, [make_camera(angle) for angle in (-0.8, -0.3, 0.3, 0.8)])
    bad = make_camera(0.0)
    points = project(bad, scene.marks)[0] + [5.0, 0.0]
    copies = [
        LandmarkView(dataclasses.replace(bad, id=f"copy{n}"), points, np.ones(68), 0.9)
        for n in range(9)
    ]
    observation, _ = triangulate_views("smile", 0, [*good, *copies])
    crowds = {view.camera_id: view.redundancy for view in observation.views}
    assert crowds[good[0].camera_id] == pytest.approx(1.0, abs=0.01)
    for view in observation.views:
        if view.camera_id.startswith("copy"):
            assert view.redundancy >= 8.9
    error = np.linalg.norm(observation.points - scene.marks, axis=1)
    assert np.nanmedian(error) < 2.5e-3
