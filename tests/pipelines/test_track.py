"""Tracking, from its derivatives to the stage, on a small made-up head with exact landmarks."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.contract.config import build_config
from express50.dataset.tracks import shape_spread
from express50.errors import CaptureError, ConfigError, StageError
from express50.files.digests import path_digest
from express50.geometry.cameras import Camera, project, project_with_slope
from express50.geometry.transforms import axis_angle_to_matrix, look_at
from express50.head.model import landmarks_of, pose
from express50.landmarks.detector import Detection
from express50.landmarks.irises import Irises
from express50.landmarks.sources import Marked
from express50.runner.worker import input_digests
from pipelines.track.basis import Basis, Points, make_basis
from pipelines.track.config import TrackConfig
from pipelines.track.fit import consistent_sigma, fit
from pipelines.track.observe import (
    LandmarkView,
    landmark_sigma,
    robust_triangulate,
    triangulate_views,
)
from pipelines.track.stage import shape_warnings
from pipelines.track.state import EXPRESSION_MEAN, State, Target, initial_pose, prior, start_state
from pipelines.track.terms import landmark_anchors
from tests.express50.head.tiny_head import tiny_head
from tests.stages import run_here


def make_camera(angle: float, size: int = 400, name: str = "") -> Camera:
    eye = 1.2 * np.array([np.sin(angle), 0.1, np.cos(angle)])
    pose_ = look_at(eye, np.zeros(3))
    params = (1.8 * size, 1.8 * size, size / 2, size / 2)
    return Camera(name or f"cam{angle:+.2f}", size, size, "PINHOLE", params, pose_)


RIG = [make_camera(angle) for angle in (-0.7, 0.0, 0.6)]


@dataclasses.dataclass(frozen=True)
class Scene:
    """Truth of one expression of the tiny head."""

    basis: Basis
    shape: np.ndarray
    own: np.ndarray
    rotation: np.ndarray
    vertices: np.ndarray
    marks: np.ndarray


def make_scene(seed: int = 0, expression: float = 0.6) -> Scene:
    model = tiny_head(vertices=90, seed=1)
    basis = make_basis(model)
    shape = np.random.default_rng(99).normal(size=5) * 0.7
    rng = np.random.default_rng(seed)
    own = np.zeros(4 + 18)
    own[:4] = rng.uniform(0, expression, 4)
    own[7] = 0.1
    own[-3:] = rng.normal(size=3) * 0.03
    rotation = axis_angle_to_matrix(rng.normal(size=3) * 0.2)
    points = Points(basis, np.arange(90))
    vertices = points.evaluate(np.concatenate([shape, own]), rotation)
    marks = landmark_anchors(model).at(vertices)
    return Scene(basis, shape, own, rotation, vertices, marks)


def make_views(
    marks: np.ndarray, noise: float = 0.0, cameras: list[Camera] = RIG
) -> list[LandmarkView]:
    rng = np.random.default_rng(7)
    return [
        LandmarkView(c, project(c, marks)[0] + noise * rng.normal(size=(68, 2)), np.ones(68), 0.9)
        for c in cameras
    ]


def test_sparse_points_equal_the_whole_model() -> None:
    scene = make_scene()
    model = scene.basis.model
    own = torch.from_numpy(scene.own)[None]
    whole = pose(
        model, torch.from_numpy(scene.shape)[None], own[:, :4],
        neck=own[:, 4:7], jaw=own[:, 7:10], eyes=own[:, 10:16],
    )  # fmt: skip
    world = whole[0].numpy() @ scene.rotation.T + scene.own[-3:]
    np.testing.assert_allclose(scene.vertices, world, atol=1e-12)
    np.testing.assert_allclose(scene.marks, landmarks_of(model, world), atol=1e-12)


def test_jacobian_matches_finite_differences() -> None:
    scene = make_scene()
    points = Points(scene.basis, np.array([3, 50]))
    x = np.concatenate([scene.shape, scene.own])
    _, jacobian = points.linearise(x, scene.rotation)
    for column in range(len(x)):
        step = np.zeros_like(x)
        step[column] = 1e-6
        ahead = points.evaluate(x + step, scene.rotation)
        slope = (ahead - points.evaluate(x - step, scene.rotation)) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, column], slope, atol=1e-7)


def test_projection_slope_matches_finite_differences() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3)) * 0.1
    pixels, slope = project_with_slope(RIG[0], points)
    np.testing.assert_allclose(pixels, project(RIG[0], points)[0], atol=1e-9)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-6
        ahead, back = (project(RIG[0], points + s * step)[0] for s in (1, -1))
        np.testing.assert_allclose(slope[:, :, axis], (ahead - back) / 2e-6, rtol=1e-5, atol=1e-4)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), unit=st.booleans(), neutral=st.booleans())
def test_prior_slope_matches_finite_differences(seed: int, unit: bool, neutral: bool) -> None:
    model = dataclasses.replace(tiny_head(vertices=20), unit_expressions=unit)
    own = np.random.default_rng(seed).normal(size=22)
    cost = lambda x: 0.5 * float((prior(model, x, neutral)[0] ** 2).sum())  # noqa: E731
    residual, slope = prior(model, own, neutral)
    gradient = slope.T @ residual
    for column in range(22):
        step = np.eye(22)[column] * 1e-6
        numeric = (cost(own + step) - cost(own - step)) / 2e-6
        assert gradient[column] == pytest.approx(numeric, rel=1e-4, abs=1e-3)
    np.testing.assert_array_equal(gradient[-6:], 0.0)


def test_one_strong_activation_costs_no_more_than_several_weak_ones() -> None:
    model = tiny_head(vertices=20)
    assert model.unit_expressions

    def cost(*activations: float) -> float:
        own = np.zeros(22)
        own[: len(activations)] = activations
        residual, _ = prior(model, own, False)
        return 0.5 * float(residual @ residual)

    assert cost(0.8) < 1.3 * cost(0.2, 0.2, 0.2, 0.2), "of squares it would be four times as much"
    assert cost(0.8) - cost(0.4) == pytest.approx(0.4 / EXPRESSION_MEAN, rel=0.05)
    assert cost(1e-9) == pytest.approx(0.0, abs=1e-9)


def test_triangulation_survives_wild_outliers() -> None:
    scene = make_scene()
    cameras = [make_camera(angle) for angle in np.linspace(-1, 1, 7)]
    views = make_views(scene.marks, 0.3, cameras)
    rng = np.random.default_rng(1)
    wrong = rng.random((7, 68)) < 0.25
    for view, bad in zip(views, wrong, strict=True):
        view.points[bad] += rng.normal(size=(bad.sum(), 2)) * 120
    points, inliers = robust_triangulate(views)
    enough = (~wrong).sum(0) >= 3
    error = np.linalg.norm(points - scene.marks, axis=1)[enough]
    assert np.median(error) < 0.5e-3
    assert (inliers & wrong).sum() < 0.05 * wrong.sum() + 3


def test_a_view_that_shows_something_else_is_left_out() -> None:
    scene = make_scene()
    views = make_views(scene.marks, 0.3, [make_camera(angle) for angle in (-0.8, -0.3, 0.2, 0.7)])
    views[2].points[:] = np.random.default_rng(0).uniform(0, 400, (68, 2))
    observation, refused = triangulate_views("smile", 3, views)
    assert refused == [views[2].camera_id]
    assert len(observation.views) == 3


@pytest.mark.parametrize("scale", [0.01, 100.0, 1000.0])
def test_a_rig_in_another_unit_is_named(scale: float) -> None:
    scene = make_scene()
    cameras = []
    for camera in RIG:
        moved = camera.cam_from_world.copy()
        moved[:3, 3] *= scale
        cameras.append(dataclasses.replace(camera, cam_from_world=moved))
    observation, _ = triangulate_views("smile", 0, make_views(scene.marks * scale, 0.0, cameras))
    template = landmarks_of(scene.basis.model)
    words = f"the rig seems {scale:g}x off.* divide the camera translations by {scale:g} and"
    with pytest.raises(StageError, match=words):
        initial_pose(observation, template)


def targets_of(scene: Scene, views: list[LandmarkView]) -> tuple[list[Target], list]:
    observation, _ = triangulate_views("smile", 0, views)
    model = scene.basis.model
    start = initial_pose(observation, landmarks_of(model))
    return [Target(observation, landmark_sigma(observation), False)], [start]


def test_exact_landmarks_give_the_mesh_back() -> None:
    """Weak priors, exact data: the fitted mesh is the true one, vertices without landmarks too."""
    scene = make_scene()
    observation, _ = triangulate_views("smile", 0, make_views(scene.marks))
    views = tuple(dataclasses.replace(view, sigma=np.full(68, 0.02)) for view in observation.views)
    observation = dataclasses.replace(observation, views=views)
    template = landmarks_of(scene.basis.model)
    targets = [Target(observation, np.full((3, 68), 0.005), False)]
    start = start_state(scene.basis, [initial_pose(observation, template)])
    state, _ = fit(scene.basis, targets, start, 60)
    got = fitted_vertices(scene.basis, state)
    assert np.sqrt(((got - scene.vertices) ** 2).sum(1).mean()) < 2e-4


def fitted_vertices(basis: Basis, state: State) -> np.ndarray:
    points = Points(basis, np.arange(len(basis.model.template)))
    pose_ = state.poses[0]
    return points.evaluate(np.concatenate([state.shape, pose_.own]), pose_.rotation)


def test_fit_never_raises_its_own_cost_and_shares_one_shape() -> None:
    scenes = [make_scene(0), make_scene(1)]
    pairs = [targets_of(scene, make_views(scene.marks, 1.0)) for scene in scenes]
    targets = [pair[0][0] for pair in pairs]
    state = start_state(scenes[0].basis, [pair[1][0] for pair in pairs])
    costs = [fit(scenes[0].basis, targets, state, n)[1] for n in (0, 1, 2, 4, 8, 16)]
    assert all(later <= earlier + 1e-9 for earlier, later in zip(costs, costs[1:], strict=False))
    assert costs[-1] < 0.5 * costs[0]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_cameras_stay_stable(count: int) -> None:
    """One camera cannot see depth: the prior keeps coefficients sane and the mesh near."""
    scene = make_scene()
    targets, poses = targets_of(scene, make_views(scene.marks, 0.5, RIG[1 : 1 + count] or RIG[:1]))
    state, _ = fit(scene.basis, targets, start_state(scene.basis, poses), 20)
    assert np.abs(state.shape).max() < 4.0
    assert -0.2 < state.poses[0].own[:4].min() <= state.poses[0].own[:4].max() < 1.4
    pixels = project(RIG[1], fitted_vertices(scene.basis, state))[0]
    truth = project(RIG[1], scene.vertices)[0]
    assert np.median(np.linalg.norm(pixels - truth, axis=1)) < 6.0


def test_fitted_rotations_stay_rotations() -> None:
    scene = make_scene()
    targets, poses = targets_of(scene, make_views(scene.marks, 2.0))
    state, _ = fit(scene.basis, targets, start_state(scene.basis, poses), 15)
    R = state.poses[0].rotation
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) > 0


def test_views_that_contradict_the_fit_lose_weight() -> None:
    scene = make_scene()
    targets, _ = targets_of(scene, make_views(scene.marks, 0.3))
    shifted = targets[0].observation.views[1]
    shifted.points[:] += 90.0
    sigma = consistent_sigma(targets[0], scene.marks)
    assert np.isinf(sigma[1]).all()
    assert np.isfinite(sigma[0]).mean() > 0.9


def test_presets_are_valid_and_bad_values_are_refused() -> None:
    from pipelines.track import STAGE

    for values in STAGE.presets.values():
        build_config(STAGE, values)
    for name, value in (
        ("stride", 0),
        ("search", 2.0),
        ("patch_rounds", -1),
        ("samples", 5),
        ("head", ""),
    ):
        with pytest.raises(ConfigError, match=f"track.{name} is"):
            TrackConfig(**{name: value})


def no_irises() -> Irises:
    return Irises(np.zeros((2, 2)), np.full(2, np.inf), np.zeros(2))


@pytest.fixture
def tracked_dataset(ingested, monkeypatch: pytest.MonkeyPatch):
    """A calibrated, labelled dataset whose detector finds the landmarks of a tiny head."""
    from benchmarks.common import write_peaks
    from express50.capture.frames import read_cameras_of
    from pipelines import calibrate, frames
    from pipelines.track import read_inputs, stage

    run_here(calibrate.STAGE, ingested, check_frame_sets=0)
    write_peaks(ingested, "S001", {"neutral": 1, "smile": 4})
    run_here(frames.STAGE, ingested)
    scene = make_scene()

    def marked(image: np.ndarray, camera_id: str, frame: int) -> Marked:
        points = project(read_cameras_of(ingested, "S001")[camera_id], scene.marks)[0]
        face = Detection(points, np.ones(68), np.full(68, 0.9), 0.95)
        return Marked(face, no_irises(), visible_contour=False)

    monkeypatch.setattr(read_inputs, "open_source", lambda *unused: marked)
    monkeypatch.setattr(stage, "_basis", lambda *unused: scene.basis)
    return ingested, scene


def test_mattes_are_an_input_whatever_the_rounds(tracked_dataset) -> None:
    """Without rounds of outlines and patches the texture and the UV map still read them."""
    from pipelines.track import STAGE

    dataset, _ = tracked_dataset
    mattes = dataset.item_dir("matte", "S001")
    mattes.mkdir(parents=True)
    for rounds in (0, 1):
        config = TrackConfig(outline_rounds=rounds, patch_rounds=rounds)
        assert STAGE.inputs(dataset, "S001", config)["mattes"] == mattes


def test_who_chose_a_peak_and_how_surely_makes_no_track_again(tracked_dataset) -> None:
    from pipelines.track import STAGE

    dataset, _ = tracked_dataset
    path = dataset.peaks_file("S001")
    rows = json.loads(path.read_text())

    def found(**changed: object) -> dict[str, str]:
        path.write_text(json.dumps({name: row | changed for name, row in rows.items()}))
        return input_digests(STAGE, dataset, "S001", TrackConfig(), path_digest)

    first = found()
    assert found(annotator="ann", confidence=1.0) == first != found(frame=2)


def test_stage_writes_the_contracted_file(tracked_dataset, tmp_path: Path) -> None:
    from pipelines.track import STAGE

    dataset, scene = tracked_dataset
    quick = TrackConfig(outline_rounds=0, patch_rounds=1, texture_side=64)
    outputs = []
    for attempt in range(2):
        out = tmp_path / f"out{attempt}"
        out.mkdir()
        metrics = STAGE.run(dataset, "S001", quick, out).metrics
        outputs.append({file.name: file.read_bytes() for file in sorted(out.rglob("*.*"))})
    assert outputs[0] == outputs[1]
    assert set(outputs[0]) == {
        "track.npz", "overlay_neutral.jpg", "overlay_smile.jpg", "sheet.jpg",
        "albedo.png", "appearance.npz",
    }  # fmt: skip
    assert set(metrics["landmark_rms_px"]) == {"neutral", "smile"}
    assert [row["patch_reach_m"] for row in metrics["schedule"]] == [0.008] + 4 * [0.0048]
    with np.load(tmp_path / "out0" / "track.npz", allow_pickle=False) as track:
        shapes = {name: track[name].shape for name in track.files}
        assert str(track["schema"]) == "express50.track/2"
        assert track["vertices"].dtype == np.float32
        model = scene.basis.model
        posed = pose(
            model, torch.from_numpy(track["shape"])[None].expand(2, -1),
            torch.from_numpy(track["expression"]), neck=torch.from_numpy(track["neck"]),
            jaw=torch.from_numpy(track["jaw"]), eyes=torch.from_numpy(track["eyes"]),
        ).numpy()  # fmt: skip
        world = np.einsum("eij,evj->evi", track["R"], posed) + track["t"][:, None]
        np.testing.assert_allclose(track["vertices"], world, atol=1e-6)
        for doubt in (track["sigma"], track["bound"]):
            assert np.isfinite(doubt).all() and (doubt > 0).all()
    assert shapes == {
        "schema": (), "head": (), "expressions": (2,), "frames": (2,), "shape": (5,),
        "expression": (2, 4), "neck": (2, 3), "jaw": (2, 3), "eyes": (2, 6), "R": (2, 3, 3),
        "t": (2, 3), "vertices": (2, 90, 3), "offsets": (90, 3),
        "sigma": (2, 90), "bound": (2, 90), "glasses": (0, 3), "glasses_row": (0,),
    }  # fmt: skip


def test_no_face_anywhere_is_a_clear_error(
    tracked_dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipelines.track import STAGE, read_inputs

    dataset, _ = tracked_dataset
    nothing = Detection(np.zeros((68, 2)), np.ones(68), np.zeros(68), 0.0)
    blind = Marked(nothing, no_irises(), visible_contour=False)
    monkeypatch.setattr(read_inputs, "open_source", lambda *unused: lambda *image: blind)
    with pytest.raises(StageError, match="S001: no expression could be tracked"):
        STAGE.run(dataset, "S001", TrackConfig(), tmp_path)


def test_missing_footage_and_missing_faces_have_different_messages(
    tracked_dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipelines.track import STAGE, read_inputs

    def gone(*unused):
        raise CaptureError("cam00: cannot be opened")

    dataset, _ = tracked_dataset
    monkeypatch.setattr(read_inputs, "read_peak_frame", gone)
    with pytest.raises(StageError, match="cannot be opened"):
        STAGE.run(dataset, "S001", TrackConfig(), tmp_path)


def test_a_shape_that_nobody_has_is_named():
    person = np.random.default_rng(0).normal(size=68)
    assert shape_warnings(0.6 * person) == shape_warnings(np.zeros(0)) == []
    (note,) = shape_warnings(2 * person)
    assert "qc/overlay" in note.why
    (note,) = shape_warnings(1.2004 / shape_spread(person) * person)
    assert "coefficients are 1.21 standard" in note.why, "not like the limit, 1.2"
