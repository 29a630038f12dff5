"""Solve simulated rigs from boards, and gather stated and true errors of their cameras."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.intervals_collect import Figures, Sample, sampled
from express50.errors import CalibrationError
from express50.rigs.world_frame import meeting_point
from pipelines.calibrate.board_rig import solve_rig
from pipelines.calibrate.uncertainty import camera_errors, head_points, state_uncertainty
from tests.pipelines.board_rigs import POINTS, board_motion, make_rig, observe, sizes_of

# Cameras, focal length in pixels, distance in metres, noise of corners in pixels.
RIGS: dict[str, tuple[int, float, float, float]] = {
    "2 views": (2, 900.0, 1.1, 0.1),
    "4 views": (4, 900.0, 1.1, 0.1),
    "8 views": (8, 900.0, 1.1, 0.1),
    "noise": (4, 900.0, 1.1, 0.6),
    "focal length 400 px": (4, 400.0, 0.6, 0.1),
    "focal length 2,500 px": (4, 2500.0, 3.1, 0.1),
    "focal length 20,000 px": (4, 20000.0, 24.0, 0.1),
}
BOARDS = 24


def rig_samples(seeds: range) -> Iterator[tuple[str, Sample]]:
    """Yield the condition and the sample of every simulated rig; one that fails is left out."""
    for name, (count, focal, distance, noise) in RIGS.items():
        span = 150.0 if count > 2 else 40.0
        rig = make_rig(count, focal, distance=distance, span_deg=span)
        for seed in seeds:
            corners = observe(rig, board_motion(BOARDS, seed, span), noise, seed)
            try:
                solution = solve_rig(corners, POINTS, sizes_of(rig), "OPENCV")
            except CalibrationError:
                continue
            stated = state_uncertainty(solution, POINTS)
            if not stated:
                continue
            true = {n: rig[n] for n in solution.cameras}
            off = camera_errors(solution.cameras, true, head_points() + meeting_point(true))
            names = sorted(stated)
            figures: Figures = {"stated_mm": np.array([stated[n].mm for n in names])}
            scale = np.array([stated[n].mm / stated[n].px for n in names])
            errors = scale * [off[n] for n in names]
            yield name, sampled("calibrate", f"{name} {seed}", [figures], [errors])
