"""Calibrate one subject's cameras: given ones are checked, others solved from board or footage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from express50.capture.index import Index, calibration_file, read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.errors import CalibrationError, CaptureError
from express50.files.atomic import write_json
from express50.files.calibration import read_cameras, write_cameras
from express50.geometry.cameras import Camera, resized
from express50.landmarks.network import load_network
from express50.rigs.world_frame import check_meeting
from pipelines.calibrate.board import BoardCorners, board_from_table, board_points, read_corners
from pipelines.calibrate.board_rig import BoardSolution, solve_rig
from pipelines.calibrate.camera_moves import FootageCheck, check_footage
from pipelines.calibrate.colour_gains import ColourGains, WhiteCollector
from pipelines.calibrate.config import CalibrateConfig
from pipelines.calibrate.first_guess import start_camera
from pipelines.calibrate.footage import (
    find_footage_points,
    known_focals,
    read_footage,
    reduced_camera,
)
from pipelines.calibrate.footage_rig import solve_footage
from pipelines.calibrate.plots import draw_residuals, draw_rig
from pipelines.calibrate.refine import RefinedRig, refine_by_board, refine_by_footage

COLOUR_FRAMES = 12
"""Board images read per camera if only its colours are needed."""


@dataclass(frozen=True)
class CalibratedRig:
    """The cameras of one subject, and what is reported about them.

    Attributes:
        source: given, board or footage.
        cameras: in the canonical world, metres.
        reprojection_px: rms over all observations; None for given cameras.
        per_camera_px: the same by camera.
        figures: metrics that only this source has.
        gains: colour gains, if a board shows them.
        solution: the board's solution, for plots.
        dropped, warnings: notes.
    """

    source: str
    cameras: dict[str, Camera]
    reprojection_px: float | None = None
    per_camera_px: Mapping[str, float | None] = field(default_factory=dict)
    figures: Mapping[str, object] = field(default_factory=dict)
    gains: ColourGains | None = None
    solution: BoardSolution | None = None
    dropped: tuple[Note, ...] = ()
    warnings: tuple[Note, ...] = ()


def run(dataset: Dataset, item: str, config: CalibrateConfig, out: Path) -> Result:
    """Write cameras.json and plots of one subject, and from a board the gains of its cameras.

    CONVENTIONS.md describes the world.
    """
    index = read_index(dataset, item)
    given = calibration_file(dataset, index)
    has_board = index.board is not None and bool(index.board["cameras"])
    if given is not None:
        rig = _given(index, given, has_board, config)
    elif has_board:
        rig = _from_board(index, config)
    else:
        rig = _from_footage(index, config)
    check = None
    if rig.source != "footage":  # there the same footage would judge itself
        check = _check_footage(index, rig.cameras, config.check_moments)
    return _write(rig, check, out)


def _write(rig: CalibratedRig, check: FootageCheck | None, out: Path) -> Result:
    """Write the files of a calibrated rig and gather its metrics."""
    names = sorted(rig.cameras)
    figures = dict(rig.figures)
    write_cameras(out / "cameras.json", rig.cameras)
    (out / "qc").mkdir()
    boards = rig.solution.boards.values() if rig.solution else ()
    origins = np.array([pose[:3, 3] for pose in boards]).reshape(-1, 3)
    draw_rig(out / "qc" / "rig.jpg", rig.cameras, origins)
    if rig.solution is not None:
        draw_residuals(out / "qc" / "residuals.jpg", rig.solution)
    if rig.gains is not None:
        write_json(out / "gains.json", {n: [round(g, 5) for g in rig.gains.gain[n]] for n in names
                                        if n in rig.gains.gain})  # fmt: skip
        figures["colour"] = {
            "spread_percent": _rounded(rig.gains.before, 3),
            "spread_evened_percent": _rounded(rig.gains.after, 3),
            "squares": rig.gains.squares,
            "untold": [name for name in names if name not in rig.gains.gain],
        }
    moved = [
        Note(
            name,
            f"seems to have moved since it was calibrated: its picture is off by"
            f" {move.shift_px:.1f} px (turned {move.turn_deg:.2f} degrees, moved"
            f" {move.move_mm:.1f} mm); calibrate the rig again, or leave the camera out",
        )
        for name, move in (check.moved if check else {}).items()
    ]
    figures["footage"] = check and {
        "points": check.points,
        "error_px": _rounded(check.error_px, 4),
        "unchecked": sorted(check.unchecked),
    }
    metrics = {
        "source": rig.source,
        "reprojection_px": _rounded(rig.reprojection_px, 5),
        "cameras": {name: _rounded(rig.per_camera_px.get(name), 5) for name in names},
        "models": {name: rig.cameras[name].model for name in names},
        **figures,
    }
    return Result(metrics, rig.dropped, (*rig.warnings, *moved))


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _notes(reasons: Mapping[str, str]) -> tuple[Note, ...]:
    return tuple(Note(what, why) for what, why in sorted(reasons.items()))


def _given(index: Index, path: Path, has_board: bool, config: CalibrateConfig) -> CalibratedRig:
    given = read_cameras(path)
    cameras = {name: given[name] for name in sorted(index.cameras) if name in given}
    check_given(cameras, sizes_of(index), str(path))
    refined: RefinedRig | None = None
    gains: ColourGains | None = None
    warnings: tuple[Note, ...] = ()
    if config.refine != "none" and has_board:
        corners, points, whites = _read_board(index, config.board_frames)
        gains = whites.gains(sorted(cameras))
        refined = refine_by_board(
            cameras, corners, points, rounds=config.rounds, lenses=config.refine == "all"
        )
    elif config.refine != "none":
        refined = _refine_by_footage(index, cameras, config)
    elif has_board:
        try:
            gains = _read_board(index, COLOUR_FRAMES)[2].gains(sorted(cameras))
        except (CalibrationError, CaptureError) as error:
            # The cameras do not need the board: they were given.
            warnings = (Note("board", f"colour gains are unknown: {error}"),)
    missing = dict.fromkeys(set(index.cameras) - set(cameras), f"not in {path.name}")
    return CalibratedRig(
        source="given",
        cameras=refined.cameras if refined else cameras,
        figures={"refined": refined.figures(cameras)} if refined else {},
        gains=gains,
        dropped=_notes(missing),
        warnings=warnings,
    )


def _refine_by_footage(
    index: Index, cameras: dict[str, Camera], config: CalibrateConfig
) -> RefinedRig:
    checked = _check_footage(index, cameras, max(1, config.check_moments))
    # One bumped camera is corrected first. Where several seem to have moved, the whole rig is off,
    # and the check cannot say which camera is at fault.
    start = checked.cameras if checked is not None and len(checked.moved) == 1 else cameras
    seen = find_footage_points(index, cameras, config.solve_moments)
    small = {name: reduced_camera(camera) for name, camera in cameras.items()}
    placed = {n: replace(c, cam_from_world=start[n].cam_from_world) for n, c in small.items()}
    lenses = config.refine == "all"
    refined = refine_by_footage(
        small, placed, seen,
        turn_deg=config.refine_turn_deg, move_mm=config.refine_move_mm, lenses=lenses,
    )  # fmt: skip
    if refined.kept:
        return replace(refined, cameras=cameras)
    return replace(
        refined,
        cameras={
            name: _at_footage_size(camera, cameras[name])
            if lenses
            else replace(cameras[name], cam_from_world=camera.cam_from_world)
            for name, camera in refined.cameras.items()
        },
    )


def _at_footage_size(small: Camera, camera: Camera) -> Camera:
    """Resize a reduced camera to the footage's size, that of `camera`."""
    size = (camera.width, camera.height)
    return small if size == (small.width, small.height) else resized(small, *size)


def sizes_of(index: Index) -> dict[str, tuple[int, int]]:
    """Return the (width, height) of each camera's footage."""
    return {name: (source.width, source.height) for name, source in index.cameras.items()}


def check_given(cameras: dict[str, Camera], sizes: dict[str, tuple[int, int]], where: str) -> None:
    """Check cameras that came with a capture against its footage.

    Raises:
        CalibrationError: no camera is left, an image size differs from the footage's, or the
            cameras do not look at one place in front of them all.
    """
    if not cameras:
        raise CalibrationError(
            f"{where}: holds none of the footage's cameras ({', '.join(sorted(sizes))}); name them "
            "as the folders in cameras/"
        )
    for name, camera in cameras.items():
        if (camera.width, camera.height) != tuple(sizes[name]):
            raise CalibrationError(
                f"{where}: camera {name} is {camera.width}x{camera.height}, its footage is "
                f"{sizes[name][0]}x{sizes[name][1]}; scale the intrinsics to the footage"
            )
    check_meeting(cameras, where)


def _from_board(index: Index, config: CalibrateConfig) -> CalibratedRig:
    corners, points, whites = _read_board(index, config.board_frames)
    solution = solve_rig(corners, points, sizes_of(index), config.camera_model, config.rounds)
    squared, kept = np.sum(solution.errors**2, axis=1), solution.corners
    return CalibratedRig(
        source="board",
        cameras=solution.cameras,
        reprojection_px=_rms(squared),
        per_camera_px={
            n: _rms(squared[kept.camera == kept.cameras.index(n)]) for n in solution.cameras
        },
        figures={
            "corners": len(squared),
            "corners_rejected": solution.corners_found - len(squared),
            "board_frames": len(solution.boards),
        },
        gains=whites.gains(sorted(solution.cameras)),
        solution=solution,
        dropped=_notes(solution.dropped),
        warnings=_notes(solution.weak),
    )


def _read_board(index: Index, limit: int) -> tuple[BoardCorners, np.ndarray, WhiteCollector]:
    """Read the board's corners in its images, their places on it (P, 3), and its white squares."""
    table = index.board or {}
    board = board_from_table(table["config"], f"{index.capture}: board.toml")
    files = {n: [index.capture / file for file in table["cameras"].get(n, [])]
             for n in index.cameras}  # fmt: skip
    whites = WhiteCollector(board)
    corners = read_corners(board, files, sizes_of(index), limit, whites.look)
    return corners, board_points(board), whites


def _from_footage(index: Index, config: CalibrateConfig) -> CalibratedRig:
    blank = {name: start_camera(name, size, 1.0) for name, size in sizes_of(index).items()}
    small = {name: reduced_camera(camera) for name, camera in blank.items()}
    focals = {n: f * small[n].width / blank[n].width for n, f in known_focals(index).items()}
    solved = solve_footage(
        find_footage_points(index, blank, config.solve_moments),
        {name: (camera.width, camera.height) for name, camera in small.items()},
        focals,
        str(index.capture),
        model=config.camera_model,
        distance_m=config.distance_m,
        eye_distance_mm=config.eye_distance_mm,
    )
    cameras = {n: _at_footage_size(camera, blank[n]) for n, camera in solved.cameras.items()}
    check_meeting(cameras, str(index.capture))
    squared, good = np.sum(solved.errors**2, axis=1), solved.inliers
    scale = (
        f"taken from the distance between the eyes, assumed to be {config.eye_distance_mm:g} mm:"
        " adults' differ by 12 % (two standard deviations); measure it and set"
        " calibrate.eye_distance_mm, or bring a board"
    )
    return CalibratedRig(
        source="footage",
        cameras=cameras,
        reprojection_px=_rms(squared[good]),
        per_camera_px={
            name: _rms(squared[good & (solved.tracks.camera == i)])
            for i, name in enumerate(solved.tracks.names)
        },
        figures={
            "features": int(good.sum()),
            "focals_told": sorted(set(focals) & set(solved.cameras)),
            "eye_moments": solved.eye_frames,
            "eye_spread": round(solved.eye_spread, 5),
        },
        dropped=_notes(solved.dropped),
        warnings=(*_notes(solved.weak), Note("scale", scale)),
    )


def _rms(squared: np.ndarray) -> float | None:
    return float(np.sqrt(squared.mean())) if squared.size else None


def _check_footage(index: Index, cameras: Mapping[str, Camera], count: int) -> FootageCheck | None:
    """Search for moved cameras in so many frame sets; None with fewer than three cameras."""
    if count < 1 or len(cameras) < 3:
        return None
    frames: dict[int, dict[str, np.ndarray]] = {}
    for frame, name, image in read_footage(index, cameras, count):
        frames.setdefault(frame, {})[name] = image
    return check_footage(cameras, frames, load_network())
