"""Bundle adjustment of rigs returns to the truth, holds what is held, and stays finite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from express50.geometry.cameras import Camera, project
from express50.geometry.transforms import look_at
from pipelines.calibrate.adjuster import (
    AdjustedRig,
    RigPriors,
    _linearise,
    _moved,
    adjust_rig,
    cameras_covariance,
    eliminate,
    move_pose,
    triangulate_tracks,
)
from pipelines.calibrate.tracks import PointTracks, _undistorted

LENSES = {
    "SIMPLE_PINHOLE": (900.0, 320.0, 240.0),
    "PINHOLE": (900.0, 905.0, 318.0, 242.0),
    "SIMPLE_RADIAL": (900.0, 320.0, 240.0, -0.1),
    "OPENCV": (900.0, 905.0, 318.0, 242.0, -0.1, 0.05, 1e-3, -1e-3),
    "FULL_OPENCV": (900.0, 905.0, 318.0, 242.0, -0.1, 0.05, 1e-3, -1e-3, 0, 0.02, 0, 0),
}


def make_rig(model="OPENCV", count=5, far=0.0, focal=1.0):
    rig = {}
    for i in range(count):
        angle = 0.4 * (i - (count - 1) / 2)
        eye = np.array([far + np.sin(angle), 0.2 * (-1) ** i, np.cos(angle)])
        params = list(LENSES[model])
        for k in range(2 if params[1] > 800 else 1):
            params[k] *= focal
        pose = look_at(eye, np.array([far, 0, 0]))
        rig[f"c{i}"] = Camera(f"c{i}", 640, 480, model, tuple(params), pose)
    return rig


def tracks_in(rig, points, noise=0.0):
    recorded = [project(camera, points)[0] for camera in rig.values()]
    rng = np.random.default_rng(0)
    recorded = [p + rng.normal(size=p.shape) * noise for p in recorded]
    camera, point = np.divmod(np.arange(len(rig) * len(points)), len(points))
    sigma = np.full(len(camera), 0.5)
    return PointTracks(tuple(rig), camera, point, np.concatenate(recorded), sigma)


def spots(count=60, far=0.0):
    return np.random.default_rng(1).uniform(-0.12, 0.12, (count, 3)) + [far, 0, 0]


def bumped(rig, size):
    rng = np.random.default_rng(2)
    steps = rng.normal(size=(len(rig), 6)) * size
    return {
        n: replace(c, cam_from_world=move_pose(c.cam_from_world, step))
        for (n, c), step in zip(rig.items(), steps, strict=True)
    }


@pytest.mark.parametrize("model", list(LENSES))
def test_derivatives_are_those_of_the_projection(model):
    rig = make_rig(model, 2)
    points = spots(8)
    tracks = tracks_in(rig, points)
    cameras = list(rig.values())
    at = _linearise(cameras, tracks, points)
    assert np.abs(at.errors).max() < 1e-6
    for k in range(10):
        step = np.zeros(10)
        step[k] = h = 1e-3 if k in (7, 8) else 1e-6
        there, back = (
            _linearise([_moved(c, s * step) for c in cameras], tracks, points).errors
            for s in (1, -1)
        )
        expected = (there - back) / (2 * h)
        np.testing.assert_allclose(at.by_camera[:, :, k], expected, rtol=2e-3, atol=0.05)


def test_a_bumped_rig_returns_to_the_truth_and_held_lenses_stay():
    rig, points = make_rig(), spots()
    tracks = tracks_in(rig, points)
    wrong = bumped(rig, 5e-3)
    priors = RigPriors(turn_rad=1.0, move_m=1.0)
    found = adjust_rig(wrong, tracks, triangulate_tracks(wrong, tracks), priors, (1.5,))
    assert np.linalg.norm(found.errors, axis=1).max() < 1e-3
    assert all(found.cameras[n].params == c.params for n, c in rig.items())


def test_a_focal_length_and_a_bend_are_found_and_pinholes_do_not_bend():
    rig, points = make_rig("SIMPLE_RADIAL"), spots(150)
    tracks = tracks_in(rig, points)
    wrong = {n: replace(c, params=(930.0, *c.params[1:3], -0.05)) for n, c in rig.items()}
    priors = RigPriors(turn_rad=0.02, move_m=0.02, focal=0.1, bend=0.1)
    found = adjust_rig(
        wrong, tracks, triangulate_tracks(wrong, tracks), priors, (1.5,), iterations=80
    )
    focals = [c.params[0] for c in found.cameras.values()]
    assert np.abs(np.array(focals) - 900).max() < 12
    assert np.abs([c.params[3] + 0.1 for c in found.cameras.values()]).max() < 0.03
    pinholes = make_rig("PINHOLE")
    tracks = tracks_in(pinholes, points)
    found = adjust_rig(pinholes, tracks, points, priors, (1.5,), iterations=5)
    assert all(len(c.params) == 4 for c in found.cameras.values())


def test_mismatches_do_not_pull():
    rig, points = make_rig(), spots()
    tracks = tracks_in(rig, points, 0.3)
    rng = np.random.default_rng(3)
    bad = rng.random(len(tracks.point)) < 0.1
    pixels = tracks.pixels + bad[:, None] * rng.normal(size=tracks.pixels.shape) * 60
    priors = RigPriors(turn_rad=0.01, move_m=0.01)
    given = bumped(rig, 2e-3)
    dirty = replace(tracks, pixels=pixels)
    found = adjust_rig(given, dirty, triangulate_tracks(given, dirty), priors, (1.5,))
    left = np.linalg.norm(found.errors, axis=1)[~bad]
    assert np.median(left) < 0.6


def tracks_errors(rig, tracks, points):
    cameras = list(rig.values())
    return _linearise(cameras, tracks, points).errors


def test_a_camera_that_looks_away_has_a_huge_error_and_no_warning():
    rig, points = make_rig(), spots()
    tracks, away = tracks_in(rig, points), np.diag([-1.0, 1.0, -1.0, 1.0])
    rig["c4"] = replace(rig["c4"], cam_from_world=away @ rig["c4"].cam_from_world)
    fit = AdjustedRig(rig, points, np.zeros((len(tracks.pixels), 2)), 0.0)
    variance = np.diag(cameras_covariance(fit, tracks, RigPriors(), 1.5)).reshape(5, -1)
    assert np.isfinite(variance).all()
    assert variance[4, :3].min() > 1e4 * variance[:4, :3].max() > 0


def test_priors_are_about_the_expected_lenses_wherever_the_fit_starts():
    rig, expected = make_rig("SIMPLE_PINHOLE"), make_rig("SIMPLE_PINHOLE", focal=1.05)
    tracks = tracks_in(rig, spots())
    priors = RigPriors(focal=1e-6)
    found = adjust_rig(rig, tracks, spots(), priors, (1e3,), expected=expected).cameras
    for name in rig:
        assert found[name].params[0] == pytest.approx(expected[name].params[0], rel=1e-3)
    free = adjust_rig(rig, tracks, spots(), priors, (1e3,)).cameras
    assert free["c0"].params[0] == pytest.approx(rig["c0"].params[0], rel=1e-3)


@pytest.mark.parametrize("bend", [-50.0, -2.0, 2.0, 1e3, 5e5])
def test_features_where_a_lens_diverges_are_not_matched_and_give_no_warning(bend):
    camera = Camera("c0", 640, 480, "SIMPLE_RADIAL", (500.0, 320.0, 240.0, bend), np.eye(4))
    pixels = np.array([[0.0, 0.0], [320.0, 240.0], [640.0, 480.0]])
    ideal, described = _undistorted(camera, (pixels, np.ones((3, 128))))
    assert np.isfinite(ideal).all()
    assert described[1].all() and np.isfinite(described).all()
    assert bend > 0 or not described[[0, 2]].any()


def test_groups_that_are_hardly_held_are_eliminated():
    rng, count = np.random.default_rng(0), 4000
    way, size = rng.normal(size=(count, 1, 3)), 10 ** rng.uniform(-3, 6, (count, 1, 1))
    by_group = size * rng.normal(size=(count, 2, 1)) * way  # both rows say the same of the group
    camera, group = np.zeros(count, int), np.arange(count)
    found = eliminate(
        rng.normal(size=(count, 2, 1)), by_group, np.ones((count, 2)), camera, group, 1
    )
    assert np.isfinite(found.cameras).all() and np.isfinite(found.follow(np.ones(1))).all()


@pytest.mark.parametrize(
    ("far", "focal", "count", "number"),
    [
        (1000.0, 1.0, 5, 60),
        (0.0, 20.0, 5, 60),
        (0.0, 0.03, 5, 60),
        (0.0, 1.0, 2, 1),
        (0.0, 1.0, 1, 3),
    ],
)
def test_extreme_rigs_stay_finite(far, focal, count, number):
    rig, points = make_rig("PINHOLE", count, far, focal), spots(number, far)
    tracks = tracks_in(rig, points)
    given = bumped(rig, 1e-4)
    found = adjust_rig(
        given, tracks, points, RigPriors(focal=0.1, centre=0.01), (1.5,), iterations=20
    )
    assert np.isfinite(found.points).all() and np.isfinite(found.errors).all()
    assert all(np.isfinite(c.cam_from_world).all() for c in found.cameras.values())
    before = np.linalg.norm(tracks_errors(given, tracks, points), axis=1).mean()
    assert np.linalg.norm(found.errors, axis=1).mean() <= before + 1e-9


def test_points_behind_cameras_and_on_one_spot_stay_finite():
    rig = make_rig("PINHOLE", 3)
    points = np.concatenate([spots(10), np.tile([[0.0, 0.0, 5.0]], (5, 1)), np.zeros((5, 3))])
    tracks = tracks_in(rig, np.concatenate([spots(10), np.zeros((10, 3))]))
    found = adjust_rig(rig, tracks, points, RigPriors(), (1.5,), iterations=20)
    assert np.isfinite(found.points).all() and np.isfinite(found.errors).all()
