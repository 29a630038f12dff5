"""The calibrate stage: cameras given with the capture are checked, others solved from the board."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from express50.cameras import Camera, read_cameras, write_cameras
from express50.errors import CalibrationError
from express50.index import Index, index_path, read_index
from express50.layout import Dataset
from express50.rigs.world import check_meeting
from express50.stage import Stage
from pipelines.calibrate.board import board_from_table, board_points, read_observations
from pipelines.calibrate.colour import Palette
from pipelines.calibrate.config import PRESETS, CalibrateConfig
from pipelines.calibrate.moved import footage_metrics, look_at_footage
from pipelines.calibrate.pictures import draw_residuals, draw_rig
from pipelines.calibrate.solve import Solution, solve_rig


def items(dataset: Dataset) -> list[str]:
    """Subjects: a rig may be bumped between two of them, so each has its own cameras."""
    return dataset.subjects()


def inputs(dataset: Dataset, item: str, config: CalibrateConfig) -> dict[str, Path | str]:
    """The frame index, and the calibration file or else every board image."""
    index = read_index(dataset, item)
    found: dict[str, Path | str] = {"index": index_path(dataset, item)}
    if index.calibration is not None:
        found["calibration"] = index.capture / index.calibration
    elif index.board is not None:
        for files in index.board["cameras"].values():
            found |= {name: index.capture / name for name in files}
    return found


def run(dataset: Dataset, item: str, config: CalibrateConfig, out: Path) -> dict:
    """Write cameras.json and the pictures of one subject, and from a board its cameras' gains.

    CONVENTIONS.md says in which world.
    """
    index = read_index(dataset, item)
    if index.calibration is not None:
        return _run_given(index, config, out)
    if index.board is not None and index.board["cameras"]:
        return _run_board(index, config, out)
    raise CalibrationError(
        f"{index.capture}: has neither calibration.json nor board/<camera>/*.png; add the cameras "
        "as {id: {model, width, height, params, world_to_camera}} or synchronised images of a "
        "ChArUco board with its board.toml, then run 'express50 ingest' again"
    )


def _run_given(index: Index, config: CalibrateConfig, out: Path) -> dict:
    path = index.capture / str(index.calibration)
    given = read_cameras(path)
    cameras = {name: given[name] for name in sorted(index.cameras) if name in given}
    check_given(cameras, {n: (s.width, s.height) for n, s in index.cameras.items()}, str(path))
    write_cameras(out / "cameras.json", cameras)
    (out / "qc").mkdir()
    draw_rig(out / "qc" / "rig.jpg", cameras, np.zeros((0, 3)))
    missing = sorted(set(index.cameras) - set(cameras))
    return {
        "source": "given",
        "reprojection_px": None,
        "cameras": dict.fromkeys(cameras),
        "models": {name: camera.model for name, camera in cameras.items()},
        "weak": [],
        "dropped": [{"what": name, "why": f"not in {path.name}"} for name in missing],
        **footage_metrics(look_at_footage(index, cameras, config.check_moments)),
    }


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
    table = index.board or {}
    where = f"{index.capture}: board.toml"
    board = board_from_table(table["config"], where)
    sizes = {name: (source.width, source.height) for name, source in index.cameras.items()}
    files = {
        name: [index.capture / file for file in table["cameras"].get(name, [])] for name in sizes
    }
    palette = Palette(board)
    observations = read_observations(board, files, sizes, config.board_frames, palette.look)
    solution = solve_rig(observations, board_points(board), sizes, config)
    write_cameras(out / "cameras.json", solution.cameras)
    (out / "qc").mkdir()
    boards = np.array([pose[:3, 3] for pose in solution.boards.values()]).reshape(-1, 3)
    draw_rig(out / "qc" / "rig.jpg", solution.cameras, boards)
    draw_residuals(out / "qc" / "residuals.jpg", solution)
    seen = look_at_footage(index, solution.cameras, config.check_moments)
    colour = palette.write(out / "gains.json", sorted(solution.cameras))
    return _metrics(solution) | {"colour": colour} | footage_metrics(seen)


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


STAGE = Stage(
    name="calibrate",
    version=3,
    config=CalibrateConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
)
