"""Calibrate one subject's cameras, and draw the result.

Given cameras are checked and refined; others are solved from a board or from the footage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from express50.capture.index import Index, calibration_file, read_index
from express50.contract.layout import Dataset
from express50.contract.stage import ExpectedError, Note, Result
from express50.error_model import error_bounds
from express50.errors import CalibrationError, CaptureError
from express50.files.atomic import write_json
from express50.files.calibration import read_cameras, write_cameras
from express50.files.images import write_image
from express50.geometry.cameras import Camera, pinhole, unproject
from express50.geometry.conventions import cell_to_corner
from express50.rigs.world_frame import check_meeting, judge, meeting_point
from pipelines.calibrate.board import (
    BoardCorners,
    board_from_table,
    board_points,
    footage_of_board,
    read_corners,
)
from pipelines.calibrate.board_rig import BoardSolution, solve_rig
from pipelines.calibrate.colour_gains import ColourGains, WhiteCollector
from pipelines.calibrate.config import CalibrateConfig
from pipelines.calibrate.footage import (
    at_footage_size,
    find_points,
    has_one_lens,
    known_focals,
    read_footage,
    reduced_camera,
)
from pipelines.calibrate.footage_rig import solve_footage, start_camera
from pipelines.calibrate.given_rig import FootageCheck, RefinedRig, check_footage, refine_by_footage
from pipelines.calibrate.timing import CameraTiming
from pipelines.calibrate.uncertainty import HeadError, state_uncertainty

COLOUR_FRAMES = 12  # board images read per camera if only its colours are needed


@dataclass(frozen=True)
class CalibratedRig:
    """The cameras of one subject in the canonical world, and what is reported about them."""

    source: str  # given, board or footage
    cameras: dict[str, Camera]
    reprojection_px: float | None = None  # rms over all observations; None for given cameras
    per_camera_px: Mapping[str, float | None] = field(default_factory=dict)
    figures: Mapping[str, object] = field(default_factory=dict)  # of this source only
    gains: ColourGains | None = None
    solution: BoardSolution | None = None
    dropped: tuple[Note, ...] = ()
    warnings: tuple[Note, ...] = ()
    expected: ExpectedError | None = None


def run(dataset: Dataset, item: str, config: CalibrateConfig, out: Path) -> Result:
    """Write cameras.json and plots of one subject, and from a board the gains of its cameras."""
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
        # a rig that is not in metres, or cameras that look elsewhere
        oddities = "; ".join(judge(rig.cameras).warnings)
        odd = (Note("cameras", oddities),) if oddities else ()
        rig = replace(rig, warnings=(*rig.warnings, *odd))
        check = _check_footage(index, rig.cameras, config.check_frame_sets)
    return _write(rig, check, out)


def _write(rig: CalibratedRig, check: FootageCheck | None, out: Path) -> Result:
    names = sorted(rig.cameras)
    figures = dict(rig.figures)
    write_cameras(out / "cameras.json", rig.cameras)
    (out / "qc").mkdir()
    boards = rig.solution.boards.values() if rig.solution else ()
    origins = np.array([pose[:3, 3] for pose in boards]).reshape(-1, 3)
    draw_rig(out / "qc" / "rig.jpg", rig.cameras, origins)
    if rig.solution is not None:
        draw_residuals(out / "qc" / "residuals.jpg", rig.solution, rig.per_camera_px)
    if rig.gains is not None:
        gains = rig.gains.gain
        rows = {n: [round(g, 5) for g in gains[n]] for n in names if n in gains}
        write_json(out / "gains.json", rows)
        figures["colour"] = {
            "spread_percent": _rounded(rig.gains.before, 3),
            "spread_evened_percent": _rounded(rig.gains.after, 3),
            "squares": rig.gains.squares,
            "unjudged": [name for name in names if name not in gains],
        }
    moved = {
        name: "seems to have moved since it was calibrated"
        + (", unless the face in its picture is another person's" if move.odd_face else "")
        + f": its picture is off by {move.shift_px:.1f} px (turned {move.turn_deg:.2f} degrees,"
        f" moved {move.move_mm:.1f} mm); calibrate the rig again, or leave the camera out"
        for name, move in (check.moved.items() if check else ())
    }
    moved |= check.mirrored if check else {}
    for a, b in check.exchanged if check else ():
        moved[f"{a} and {b}"] = (
            "look swapped: faces agree if each has the other's calibration; swap their names"
            " in the calibration, or their folders in cameras/, plates/ and board/"
        )
    if check and check.size:
        moved["size"] = check.size
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
    return Result(metrics, rig.dropped, (*rig.warnings, *_notes(moved)), rig.expected)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _rows(found: Mapping[str, CameraTiming] | Mapping[str, HeadError]) -> dict[str, dict]:
    """Return each camera's figures by name, to four digits."""
    return {
        name: {key: round(value, 4) for key, value in asdict(figures).items()}
        for name, figures in found.items()
    }


def _notes(reasons: Mapping[str, str]) -> tuple[Note, ...]:
    return tuple(Note(what, why) for what, why in sorted(reasons.items()))


def _given(index: Index, path: Path, has_board: bool, config: CalibrateConfig) -> CalibratedRig:
    given = read_cameras(path)
    cameras = {name: given[name] for name in sorted(index.cameras) if name in given}
    check_given(cameras, sizes_of(index), str(path))
    refined: RefinedRig | None = None
    gains: ColourGains | None = None
    warnings: tuple[Note, ...] = ()
    if config.refine != "none":
        # A single bumped camera is corrected first. If several seem to have moved, the whole rig is
        # off, and the check cannot find the ones at fault.
        check = _check_footage(index, cameras, max(1, config.check_frame_sets))
        refined = refine_by_footage(
            cameras, find_points(partial(read_footage, index, cameras, config.solve_frame_sets)),
            turn_deg=config.refine_turn_deg, move_mm=config.refine_move_mm,
            lenses=config.refine == "all",
            start=check.cameras if check is not None and len(check.moved) == 1 else None,
        )  # fmt: skip
    if has_board:
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


def sizes_of(index: Index) -> dict[str, tuple[int, int]]:
    """Return the (width, height) of each camera's footage."""
    return {name: (source.width, source.height) for name, source in index.cameras.items()}


def check_given(cameras: dict[str, Camera], sizes: dict[str, tuple[int, int]], where: str) -> None:
    """Raise CalibrationError unless cameras have the footage's sizes and look at one place."""
    if not cameras:
        raise CalibrationError(
            f"{where}: holds none of the footage's cameras ({', '.join(sorted(sizes))}); use the "
            "names of the folders in cameras/"
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
    uncertainty = state_uncertainty(solution, points)
    weak = _with_errors(solution.weak, uncertainty)
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
            "uncertainty": _rows(uncertainty),
            "timing": _rows(solution.timing),
        },
        gains=whites.gains(sorted(solution.cameras)),
        solution=solution,
        dropped=_notes(solution.dropped),
        warnings=(*_notes(weak), *_notes(_out_of_step(solution.timing))),
        expected=expected_error(uncertainty),
    )


def _with_errors(weak: Mapping[str, str], stated: Mapping[str, HeadError]) -> dict[str, str]:
    """Add to the reasons why cameras are weak how far these are probably off at the head."""
    return {
        name: f"{why}; expect errors of {error.px:.2g} px ({error.mm:.2g} mm) at the head"
        if (error := stated.get(name))
        else why
        for name, why in weak.items()
    }


def expected_error(uncertainty: Mapping[str, HeadError]) -> ExpectedError | None:
    """Return how far cameras are probably off at the head; None for a single camera."""
    stated = np.array([error.mm for error in uncertainty.values()])
    return error_bounds("calibrate", {"stated_mm": stated}).expected


def _out_of_step(timing: Mapping[str, CameraTiming]) -> dict[str, str]:
    """Warn of cameras whose pictures, or rows of pictures, were not taken when the others' were."""
    found = {}
    for name, camera in timing.items():
        ways = []
        if camera.late:
            side = "late" if camera.late > 0 else "early"
            ways.append(f"its pictures are {abs(camera.late):.2f} frames {side}")
        if camera.readout:
            rows = f"its last row is {abs(camera.readout):.2f} of a frame apart from its first"
            ways.append(f"{rows} (rolling shutter)")
        if ways:
            found[name] = (
                f"{', '.join(ways)}; the calibration corrects for this, but later stages do not:"
                " synchronise the cameras, or let subjects move slowly"
            )
    return found


def _read_board(index: Index, limit: int) -> tuple[BoardCorners, np.ndarray, WhiteCollector]:
    """Read the board's corners, their places on it (P, 3), and its white squares."""
    table = index.board or {}
    board = board_from_table(table["config"], f"{index.capture}: board.toml")
    whites = WhiteCollector(board)
    corners = read_corners(board, footage_of_board(index), sizes_of(index), limit, whites.look)
    return corners, board_points(board), whites


def _from_footage(index: Index, config: CalibrateConfig) -> CalibratedRig:
    if len(index.cameras) == 1:
        raise CalibrationError(
            f"{index.subject}: has one camera, and solving from footage needs two; track one camera"
            " with 'express50 photo FILE OUT', or add calibration.json and run 'express50 ingest'"
            " again"
        )
    blank = {name: start_camera(name, size, 1.0) for name, size in sizes_of(index).items()}
    small = {name: reduced_camera(camera) for name, camera in blank.items()}
    focals = {n: f * small[n].width / blank[n].width for n, f in known_focals(index).items()}
    solved = solve_footage(
        find_points(partial(read_footage, index, blank, config.solve_frame_sets), small=True),
        {name: (camera.width, camera.height) for name, camera in small.items()},
        focals,
        str(index.capture),
        model=config.camera_model,
        distance_m=config.distance_m,
        eye_distance_mm=config.eye_distance_mm,
        same_lens=has_one_lens(index),
    )
    cameras = {n: at_footage_size(camera, blank[n]) for n, camera in solved.cameras.items()}
    stated = {
        name: replace(error, px=error.px * cameras[name].width / small[name].width)
        for name, error in solved.uncertainty.items()
    }
    check_meeting(cameras, str(index.capture))
    squared, good = np.sum(solved.errors**2, axis=1), solved.inliers
    scale = (
        "the scale comes from an assumed distance between the eyes of"
        f" {config.eye_distance_mm:g} mm; adults' differ by 12 % (two standard deviations). Measure"
        " it and set calibrate.eye_distance_mm, or record a board"
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
            "known_focals": sorted(set(focals) & set(solved.cameras)),
            "eye_frame_sets": solved.eyes.frame_sets,
            "eye_spread": round(solved.eyes.spread, 5),
            "uncertainty": _rows(stated),
        },
        dropped=_notes(solved.dropped),
        warnings=(*_notes(_with_errors(solved.weak, stated)), Note("scale", scale)),
    )


def _rms(squared: np.ndarray) -> float | None:
    return float(np.sqrt(squared.mean())) if squared.size else None


def _check_footage(index: Index, cameras: dict[str, Camera], count: int) -> FootageCheck | None:
    """Search `count` frame sets for moved cameras; None with fewer than three cameras."""
    if count < 1 or len(cameras) < 3:
        return None
    return check_footage(cameras, find_points(partial(read_footage, index, cameras, count)))


def draw_rig(path: Path, cameras: Mapping[str, Camera], boards: np.ndarray) -> None:
    """Draw frusta and axes from above and from the front; `boards` (B, 3) are board origins."""
    figure = Figure(figsize=(11, 5.2), dpi=100, layout="tight")
    met = meeting_point(cameras)
    centers = np.stack([camera.center for camera in cameras.values()])
    target = centers.mean(0) if met is None else met
    reach = float(np.median(np.linalg.norm(centers - target, axis=1))) or 1.0
    titles = ("from above (front of the rig below)", "from the front")
    for column, (title, plane) in enumerate(zip(titles, ([0, 2], [0, 1]), strict=True), 1):
        axes = figure.add_subplot(1, 2, column)
        frusta, sights = [], []
        for name, camera in sorted(cameras.items()):
            size = np.array([camera.width, camera.height])
            corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
            outline = unproject(pinhole(camera), corners, np.full(4, 0.12 * reach))[:, plane]
            start = camera.center[plane]
            frusta += [
                [start, side, after]
                for side, after in zip(outline, np.roll(outline, -1, 0), strict=True)
            ]
            end = start if met is None else start + reach * camera.cam_from_world[2, plane]
            sights.append([start, end])
            axes.annotate(name, start, fontsize=6, textcoords="offset points", xytext=(3, 3))
        axes.add_collection(LineCollection(frusta, color="tab:blue", lw=0.8))
        axes.add_collection(LineCollection(sights, color="0.8", lw=0.5, zorder=0))
        if len(boards):
            axes.plot(*boards[:, plane].T, ".", color="tab:orange", ms=3, label="board")
            axes.legend(loc="upper right", fontsize=7)
        axes.plot(*target[plane], "k+", ms=10)
        axes.set_aspect("equal", "datalim")
        axes.set_xlabel("xyz"[plane[0]] + " [m]")
        axes.set_ylabel("xyz"[plane[1]] + " [m]")
        axes.set_title(title, fontsize=10)
        axes.grid(alpha=0.3)
        if column == 1:
            axes.invert_yaxis()
    _save(figure, path)


def draw_residuals(
    path: Path, solution: BoardSolution, per_camera_px: Mapping[str, float | None]
) -> None:
    """Draw the scatter of corner errors, their mean over the image, and the rms per camera.

    A round scatter and arrows without a pattern mean that the lens model is sufficient.
    """
    figure = Figure(figsize=(13, 4.2), dpi=100, layout="tight")
    errors = solution.errors
    scatter, field, bars = (figure.add_subplot(1, 3, i + 1) for i in range(3))
    limit = max(float(np.percentile(np.abs(errors), 99.5)) * 1.2, 1e-6)
    scatter.hexbin(errors[:, 0], errors[:, 1], gridsize=40, extent=(-limit, limit) * 2, mincnt=1)
    scatter.set_aspect("equal")
    scatter.set_title(f"errors of {len(errors)} corners [px]", fontsize=10)
    # The mean error in each cell of the image, over all cameras, as arrows.
    kept, cameras, cells = solution.corners, solution.cameras, 12
    known = [(c.width, c.height) if (c := cameras.get(n)) else (1, 1) for n in kept.cameras]
    where = kept.pixels / np.array(known)[kept.camera]
    cell = np.clip((where * cells).astype(int), 0, cells - 1) @ np.array([1, cells])
    count = np.bincount(cell, minlength=cells**2)
    full = np.flatnonzero(count >= 5)
    sums = [np.bincount(cell, errors[:, i], minlength=cells**2) for i in range(2)]
    mean = np.stack(sums, axis=1)[full] / count[full, None]
    at = cell_to_corner(np.column_stack([full % cells, full // cells])) / cells
    longest = float(np.linalg.norm(mean, axis=1).max(initial=1e-9))
    field.quiver(at[:, 0], at[:, 1], mean[:, 0], mean[:, 1], angles="xy", scale=longest * 12)
    field.set_xlim(0, 1)
    field.set_ylim(1, 0)
    field.set_title(f"mean error over the image (longest {longest:.3f} px)", fontsize=10)
    names = sorted(solution.cameras)
    colours = ["tab:red" if n in solution.weak else "tab:blue" for n in names]
    bars.bar(range(len(names)), [per_camera_px[name] for name in names], color=colours)
    bars.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    bars.set_title("rms per camera [px]; red: weakly constrained", fontsize=10)
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    write_image(path, np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3]), quality=90)
