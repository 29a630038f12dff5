"""Measure rigs solved from footage alone, and given rigs refined, against true cameras.

Parts of ``python -m benchmarks.calibrate``. What COLMAP's mapping makes of the same features is in
docs/LOG.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from express50.errors import CalibrationError
from express50.geometry.cameras import Camera, project, transform_camera, triangulate
from express50.geometry.transforms import make_transform, matrix_to_axis_angle, similarity_fit
from express50.rigs.camera_builder import in_metres
from express50.rigs.world_frame import meeting_point
from pipelines.calibrate.adjuster import move_pose
from pipelines.calibrate.config import CalibrateConfig
from pipelines.calibrate.footage import find_points, read_raw_footage, reduced_camera
from pipelines.calibrate.footage_rig import FootageSolution, solve_footage
from pipelines.calibrate.given_rig import refine_by_footage
from pipelines.calibrate.tracks import FrameSetPoints
from pipelines.calibrate.uncertainty import camera_errors, head_points

BUMP_DEG, BUMP_MM = 0.3, 5.0
ERRORS = ("rotation_error_deg", "translation_error_mm", "focal_error_percent")
RigJudge = Callable[[Mapping[str, Camera], Mapping[str, Camera]], dict[str, float]]


def see_capture(root: Path, true: Mapping[str, Camera], count: int) -> dict[int, FrameSetPoints]:
    """Return what the cameras of a raw capture see, in recorded pixels of `reduced_camera`."""
    return find_points(partial(read_raw_footage, root, true, count), small=True)


def small(cameras: Mapping[str, Camera]) -> dict[str, Camera]:
    """Return the cameras of reduced images."""
    return {name: reduced_camera(camera) for name, camera in cameras.items()}


def sfm_figures(
    seen: Mapping[int, FrameSetPoints], true: Mapping[str, Camera], config: CalibrateConfig
) -> dict[str, object]:
    """Return errors of rigs with unknown and with known focal lengths."""
    rig = small(true)
    sizes = {name: (camera.width, camera.height) for name, camera in rig.items()}
    known = {name: float(camera.K[0, 0]) for name, camera in rig.items()}
    rows: dict[str, object] = {}
    for key, focals in (("unknown_focals", {}), ("known_focals", known)):
        started = time.process_time()
        try:
            solved = solve_footage(
                seen, sizes, focals, "footage",
                model=config.camera_model, distance_m=config.distance_m,
                eye_distance_mm=config.eye_distance_mm,
            )  # fmt: skip
            row = similar(solved.cameras, rig) | {"weak": len(solved.weak)}
            row |= {"stated_to_true_error": stated_to_true(solved, rig)}
        except CalibrationError as error:
            row = {"cameras_registered": 0, "cameras": len(rig), "refused": str(error)}
        rows[key] = row | {"seconds": round(time.process_time() - started, 2)}
    return rows


def stated_to_true(solved: FootageSolution, true: Mapping[str, Camera]) -> float | None:
    """Return stated over true error at the head, rms over cameras.

    Worlds are laid on each other by a similarity of the head's points, as the stated error assumes.
    """
    names, middle = sorted(solved.cameras), meeting_point(true)
    if len(names) < 3 or middle is None:
        return None
    points = head_points() + middle
    pixels = np.stack([project(true[name], points)[0] for name in names])
    found = triangulate([solved.cameras[name] for name in names], pixels)
    scaled = in_metres(solved.cameras, 1 / similarity_fit(points, found)[0])
    off = camera_errors(scaled, {n: true[n] for n in names}, points)
    squares = [
        np.mean([solved.uncertainty[n].px ** 2 for n in names]),
        np.mean(np.square(list(off.values()))),
    ]
    return float(np.sqrt(squares[0] / squares[1]))


def similar(estimated: Mapping[str, Camera], true: Mapping[str, Camera]) -> dict[str, object]:
    """Return errors of a rig after a similarity onto the true one, and that similarity's scale."""
    names = sorted(estimated)
    count: dict[str, object] = {"cameras_registered": len(names), "cameras": len(true)}
    if len(names) < 3:
        return count
    centers = [np.stack([rig[n].center for n in names]) for rig in (estimated, true)]
    scale, R, t = similarity_fit(*centers)
    laid = {
        name: transform_camera(camera, make_transform(R, t))
        for name, camera in in_metres(dict(estimated), scale).items()
    }
    count["scale_error_percent"] = float(100 * abs(1 / scale - 1))
    return count | rig_errors(laid, true)


def rig_errors(laid: Mapping[str, Camera], true: Mapping[str, Camera]) -> dict[str, float]:
    """Return errors of a rig's cameras that was laid on the true one, means and worst."""
    rows = []
    for name, camera in laid.items():
        goal = true[name]
        turn = camera.cam_from_world[:3, :3] @ goal.cam_from_world[:3, :3].T
        degrees = np.degrees(np.linalg.norm(matrix_to_axis_angle(turn)))
        shift_mm = 1e3 * np.linalg.norm(camera.center - goal.center)
        rows.append((degrees, shift_mm, 100 * abs(camera.K[0, 0] / goal.K[0, 0] - 1)))
    found: dict[str, float] = {}
    for name, off in zip(ERRORS, np.transpose(rows), strict=True):
        found |= {name: float(off.mean()), f"{name}_max": float(off.max())}
    return found


def refine_figures(
    seen: Mapping[int, FrameSetPoints], true: Mapping[str, Camera], judge: RigJudge
) -> dict[str, object]:
    """Return errors of a perturbed rig before and after, and whether the true one is left as it is.

    `judge` compares a rig with the true one.
    """
    config, bumped = CalibrateConfig(), perturbed(true)
    refine = partial(
        refine_by_footage, seen=seen, turn_deg=config.refine_turn_deg,
        move_mm=config.refine_move_mm, lenses=False,
    )  # fmt: skip
    started = time.process_time()
    found = refine(bumped)
    seconds = time.process_time() - started
    quiet = refine(true)
    row: dict[str, object] = {
        "kept_given": bool(found.kept),
        "held_out_before_px": float(found.before_px),
        "held_out_after_px": float(found.after_px),
        "true_rig_left": bool(quiet.kept),
        "true_rig_head_px": judge(quiet.cameras, true)["head_px"],
    }
    row = _of(judge(found.cameras, true)) | row | {"seconds": round(seconds, 2)}
    return {"before": _of(judge(bumped, true)), "footage": row}


def _of(row: Mapping[str, float]) -> dict[str, object]:
    keys = ("rotation_error_deg", "rotation_error_deg_max", "translation_error_mm",
            "translation_error_mm_max", "head_px")  # fmt: skip
    return {key: row[key] for key in keys}


def perturbed(rig: Mapping[str, Camera]) -> dict[str, Camera]:
    """Return every camera turned by `BUMP_DEG` and moved by `BUMP_MM`, each its own way."""
    rng = np.random.default_rng(0)
    found = {}
    for name, camera in sorted(rig.items()):
        turn, shift = rng.normal(size=(2, 3))
        turn *= np.radians(BUMP_DEG) / np.linalg.norm(turn)
        shift *= 1e-3 * BUMP_MM / np.linalg.norm(shift)
        pose = move_pose(camera.cam_from_world, np.concatenate([turn, shift]))
        found[name] = replace(camera, cam_from_world=pose)
    return found
