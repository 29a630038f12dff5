"""Bundle adjustment of extreme rigs: far away, long and short lenses, hardly any observation."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.calibrate.adjuster import RigPriors, adjust_rig
from tests.pipelines.test_calibrate_adjuster import (
    bumped,
    make_rig,
    spots,
    tracks_errors,
    tracks_in,
)


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
