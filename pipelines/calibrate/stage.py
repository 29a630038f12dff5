"""The calibrate stage: given cameras are checked, others solved from the board or the footage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from express50.capture.index import Index, calibration_file, index_path, read_index
from express50.contract.layout import Dataset
from express50.errors import CalibrationError, CaptureError
from express50.files.calibration import read_cameras, write_cameras
from express50.geometry.cameras import Camera, resized
from express50.landmarks.network import WEIGHTS
from express50.rigs.world_frame import check_meeting
from pipelines.calibrate.board import (
    Observations,
    board_from_table,
    board_points,
    read_observations,
)
from pipelines.calibrate.camera_moves import reduced_camera
from pipelines.calibrate.colour import Palette
from pipelines.calibrate.config import CalibrateConfig
from pipelines.calibrate.faces import start_camera
from pipelines.calibrate.footage_views import see_footage, told_focals
from pipelines.calibrate.moved import footage_metrics, look_at_footage
from pipelines.calibrate.pictures import draw_residuals, draw_rig
from pipelines.calibrate.refine import Refined, refine_by_board, refine_by_footage
from pipelines.calibrate.solve import Solution, solve_rig
from pipelines.calibrate.structure import Structure, inliers, solve_footage
from pipelines.calibrate.tracks import undistorted

COLOUR_FRAMES = 12
"""Board images read a camera where only its colours are to be told."""


def items(dataset: Dataset) -> list[str]:
    """Subjects: a rig may be bumped between two of them, so each has its own cameras."""
    return dataset.subjects()


def inputs(dataset: Dataset, item: str, config: CalibrateConfig) -> dict[str, Path | str]:
    """The frame index, the calibration file and every board image, as far as there; weights."""
    index = read_index(dataset, item)
    found: dict[str, Path | str] = {"index": index_path(dataset, item), "weights": WEIGHTS}
    given = calibration_file(dataset, index)
    if given is not None:
        found["calibration"] = given
    if index.board is not None:
        for files in index.board["cameras"].values():
            found |= {name: index.capture / name for name in files}
    return found


def run(dataset: Dataset, item: str, config: CalibrateConfig, out: Path) -> dict:
    """Write cameras.json and the pictures of one subject, and from a board its cameras' gains.

    CONVENTIONS.md says in which world.
    """
    index = read_index(dataset, item)
    given = calibration_file(dataset, index)
    if given is not None:
        return _run_given(index, given, config, out)
    if index.board is not None and index.board["cameras"]:
        return _run_board(index, config, out)
    return _run_footage(index, config, out)


def _run_given(index: Index, path: Path, config: CalibrateConfig, out: Path) -> dict:
    given = read_cameras(path)
    cameras = {name: given[name] for name in sorted(index.cameras) if name in given}
    check_given(cameras, sizes_of(index), str(path))
    facts: dict[str, object] = {}
    odd: list[dict[str, str]] = []
    has_board = index.board is not None and bool(index.board["cameras"])
    if config.refine != "none":
        if has_board:
            observations, points, palette = _board_seen(index, config.board_frames)
            facts["colour"] = palette.write(out / "gains.json", sorted(cameras))
            refined = refine_by_board(cameras, observations, points, config)
        else:
            refined = _refine_by_footage(index, cameras, config)
        facts["refined"] = refined.figures(cameras)
        cameras = refined.cameras
    elif has_board:
        try:
            palette = _board_seen(index, COLOUR_FRAMES)[2]
            facts["colour"] = palette.write(out / "gains.json", sorted(cameras))
        except (CalibrationError, CaptureError) as error:
            # The cameras do not need it: they were given.
            odd.append({"what": "board", "why": f"tells no colours: {error}"})
    write_cameras(out / "cameras.json", cameras)
    (out / "qc").mkdir()
    draw_rig(out / "qc" / "rig.jpg", cameras, np.zeros((0, 3)))
    missing = sorted(set(index.cameras) - set(cameras))
    seen = footage_metrics(look_at_footage(index, cameras, config.check_moments))
    return {
        "source": "given",
        "reprojection_px": None,
        "cameras": dict.fromkeys(cameras),
        "models": {name: camera.model for name, camera in cameras.items()},
        "weak": [],
        "dropped": [{"what": name, "why": f"not in {path.name}"} for name in missing],
        **facts,
        **seen,
        "warnings": odd + seen["warnings"],
    }


def _refine_by_footage(
    index: Index, cameras: dict[str, Camera], config: CalibrateConfig
) -> Refined:
    checked = look_at_footage(index, cameras, max(1, config.check_moments))
    # One bumped camera is put right first. Where several seem to have moved, the whole rig is off,
    # and whom the look blames is not to be trusted.
    lone = checked is not None and len(checked.moved) == 1
    start = checked.cameras if checked is not None and lone else cameras
    seen = see_footage(index, cameras, config.solve_moments)
    small = {name: reduced_camera(camera) for name, camera in cameras.items()}
    placed = {n: replace(c, cam_from_world=start[n].cam_from_world) for n, c in small.items()}
    refined = refine_by_footage(small, placed, undistorted(seen, small), config)
    if refined.kept:
        return replace(refined, cameras=cameras)
    lenses = config.refine == "all"
    full = {n: _full(camera, cameras[n], lenses) for n, camera in refined.cameras.items()}
    return replace(refined, cameras=full)


def _full(small: Camera, camera: Camera, lenses: bool) -> Camera:
    """A camera at its footage's size with the pose, and if asked the lens, of a reduced one."""
    if not lenses:
        return replace(camera, cam_from_world=small.cam_from_world)
    size = (camera.width, camera.height)
    return small if size == (small.width, small.height) else resized(small, *size)


def sizes_of(index: Index) -> dict[str, tuple[int, int]]:
    """(width, height) of each camera's footage."""
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


def _run_board(index: Index, config: CalibrateConfig, out: Path) -> dict:
    observations, points, palette = _board_seen(index, config.board_frames)
    solution = solve_rig(observations, points, sizes_of(index), config)
    write_cameras(out / "cameras.json", solution.cameras)
    (out / "qc").mkdir()
    boards = np.array([pose[:3, 3] for pose in solution.boards.values()]).reshape(-1, 3)
    draw_rig(out / "qc" / "rig.jpg", solution.cameras, boards)
    draw_residuals(out / "qc" / "residuals.jpg", solution)
    seen = look_at_footage(index, solution.cameras, config.check_moments)
    colour = palette.write(out / "gains.json", sorted(solution.cameras))
    return _metrics(solution) | {"colour": colour} | footage_metrics(seen)


def _board_seen(index: Index, limit: int) -> tuple[Observations, np.ndarray, Palette]:
    """Corners in the board's images, where they are on the board (P, 3), and its white squares."""
    table = index.board or {}
    board = board_from_table(table["config"], f"{index.capture}: board.toml")
    files = {n: [index.capture / file for file in table["cameras"].get(n, [])]
             for n in index.cameras}  # fmt: skip
    palette = Palette(board)
    found = read_observations(board, files, sizes_of(index), limit, palette.look)
    return found, board_points(board), palette


def _run_footage(index: Index, config: CalibrateConfig, out: Path) -> dict:
    blank = {name: start_camera(name, size, 1.0) for name, size in sizes_of(index).items()}
    small = {name: reduced_camera(camera) for name, camera in blank.items()}
    focals = {n: f * small[n].width / blank[n].width for n, f in told_focals(index).items()}
    seen = see_footage(index, blank, config.solve_moments)
    sizes = {name: (camera.width, camera.height) for name, camera in small.items()}
    solved = solve_footage(seen, sizes, focals, config, str(index.capture))
    cameras = {n: _full(camera, blank[n], True) for n, camera in solved.cameras.items()}
    check_meeting(cameras, str(index.capture))
    write_cameras(out / "cameras.json", cameras)
    (out / "qc").mkdir()
    draw_rig(out / "qc" / "rig.jpg", cameras, np.zeros((0, 3)))
    return _footage_metrics(solved, focals, config)


def _footage_metrics(solved: Structure, focals: dict[str, float], config: CalibrateConfig) -> dict:
    good = inliers(solved)
    squared, camera = np.sum(solved.errors**2, axis=1), solved.tracks.camera

    def rms(rows: np.ndarray) -> float | None:
        return round(float(np.sqrt(squared[rows].mean())), 5) if rows.any() else None

    names = solved.tracks.names
    scale = (
        f"taken from the distance between the eyes, assumed to be {config.eye_distance_mm:g} mm:"
        " adults' differ by 12 % (two standard deviations); measure it and set"
        " calibrate.eye_distance_mm, or bring a board"
    )
    return {
        "source": "footage",
        "reprojection_px": rms(good),
        "cameras": {n: rms(good & (camera == i)) for i, n in enumerate(names)},
        "models": {name: camera.model for name, camera in sorted(solved.cameras.items())},
        "features": int(good.sum()),
        "focals_told": sorted(set(focals) & set(solved.cameras)),
        "eye_moments": solved.eye_moments,
        "eye_spread": round(solved.eye_spread, 5),
        "weak": [{"what": name, "why": why} for name, why in solved.weak.items()],
        "dropped": [{"what": name, "why": why} for name, why in solved.dropped.items()],
        "footage": None,
        "warnings": [{"what": "scale", "why": scale}],
    }


def _metrics(solution: Solution) -> dict:
    squared = np.sum(solution.errors**2, axis=1)
    kept = solution.observations
    rms = {
        name: round(float(np.sqrt(squared[kept.camera == kept.cameras.index(name)].mean())), 5)
        for name in sorted(solution.cameras)
    }
    return {
        "source": "board",
        "reprojection_px": round(float(np.sqrt(squared.mean())), 5),
        "cameras": rms,
        "models": {name: camera.model for name, camera in sorted(solution.cameras.items())},
        "corners": len(squared),
        "corners_rejected": solution.corners_found - len(squared),
        "board_frames": len(solution.boards),
        "weak": [{"what": name, "why": why} for name, why in solution.weak.items()],
        "dropped": [{"what": name, "why": why} for name, why in solution.dropped.items()],
    }
