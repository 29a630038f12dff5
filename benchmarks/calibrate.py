"""Measure calibration against the twin's true rig.

The stage's solution stands beside a baseline from the same corners: OpenCV's calibration of every
camera alone, then relative poses averaged and chained, without a joint adjustment. Rigs are laid on
the true one by a rigid motion. ``head_px`` is what matters further on: how far, in pixels, points
in the head's place are projected from where the true camera has them. If no dataset is named, 24
cameras before a ChArUco board and one neutral face are recorded first (some minutes). Then one
camera of the solved rig after another is turned by ``BUMP_DEG`` and must be found in the footage;
in the rig as solved, none may be found. ``sfm`` and ``refine`` are rigs solved from footage alone,
and perturbed ones put right, on the twin and on the foreign heads of ``../shared/captures`` if
there are any. ``stated_to_true_error`` is the uncertainty that the solution states over its true
error, in the head's place. ``colour_gain_error_percent`` is of linear light per channel;
``colour_gain_unevened_percent`` leaves the cameras' colours as they are. The last line is one JSON
object.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.calibrate_footage import (
    BUMP_DEG,
    refine_figures,
    rig_errors,
    see_capture,
    sfm_figures,
)
from benchmarks.common import (
    add_twin_options,
    check_twin_options,
    make_parser,
    named_or_recorded,
    recorded,
    rms,
    rounded,
)
from benchmarks.truth import align_worlds
from express50.capture.index import Index, read_index
from express50.contract.config import resolve_config
from express50.files.calibration import read_cameras
from express50.geometry.cameras import Camera, transform_camera
from express50.geometry.transforms import invert_transform
from express50.rigs.world_frame import meeting_point
from express50.twin import TwinConfig
from express50.twin.rig import make_rig, make_sensor
from pipelines.calibrate import STAGE
from pipelines.calibrate.adjuster import move_pose
from pipelines.calibrate.board import (
    BoardCorners,
    board_from_table,
    board_points,
    footage_of_board,
    read_corners,
)
from pipelines.calibrate.board_adjust import BoardRig, corner_errors
from pipelines.calibrate.board_guess import (
    BoardView,
    all_board_poses,
    camera_params,
    fit_intrinsics,
    join_rig,
    mean_transform,
    rig_from_boards,
    with_ideal,
)
from pipelines.calibrate.board_rig import solve_rig
from pipelines.calibrate.colour_gains import WhiteCollector
from pipelines.calibrate.config import CalibrateConfig
from pipelines.calibrate.footage import find_points, read_footage
from pipelines.calibrate.given_rig import check_footage
from pipelines.calibrate.uncertainty import camera_errors, head_points, state_uncertainty

RIG = TwinConfig(
    subjects=1, cameras=24, width=540, height=540, expressions=("neutral",),
    frames_per_expression=4, footage="jpg", board_frames=60, plates=False,
)  # fmt: skip
"""60 board poses, so that the outermost cameras, too, see it some fifteen times."""
FACES = ("neutral", "smile_open", "surprise", "laugh", "sadness", "pucker")
APART = replace(RIG, cameras=8, expressions=FACES, board_frames=0)  # neighbours 40 degrees apart
SCENES = {"twin_six_expressions": replace(APART, cameras=24), "twin_40_degrees_apart": APART}
"""Rigs solved from footage alone, besides the one with the board."""


def main() -> int:
    """Run and print."""
    parser = make_parser("calibrate", __doc__)
    add_twin_options(parser)
    parser.add_argument("--recording", type=Path, default=Path("build/bench-rig"))
    parser.add_argument("--bumps", type=int, default=3, help="cameras bumped, one after another")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--set", dest="assignments", action="append", default=[])
    args = parser.parse_args()
    check_twin_options(parser, args)
    cv2.setNumThreads(1)
    dataset, truth = named_or_recorded(args, RIG, args.recording)
    config = resolve_config(STAGE, args.preset, None, args.assignments)
    subject = dataset.subjects()[0]
    index, true = read_index(dataset, subject), truth.cameras(subject)
    if index.board is None:
        sys.exit(f"{index.capture}: no board was recorded; name another --dataset")
    board = board_from_table(index.board["config"], str(index.capture))
    points = board_points(board)
    sizes = {name: (source.width, source.height) for name, source in index.cameras.items()}
    start = time.process_time()
    palette = WhiteCollector(board)
    observations = read_corners(
        board, footage_of_board(index), sizes, config.board_frames, palette.look
    )
    detected = time.process_time()
    solution = solve_rig(observations, points, sizes, config.camera_model, config.rounds)
    solved = time.process_time()
    started = time.process_time()
    rig = chained(observations, points, sizes)
    chain_seconds = time.process_time() - started
    errors = np.linalg.norm(corner_errors(rig, observations, points), axis=1)
    baseline = figures(rig.cameras, true) | {
        "reprojection_px_rms": rms(errors[np.isfinite(errors)]),
        "seconds": detected - start + chain_seconds,
    }
    row: dict[str, object] = {
        **figures(solution.cameras, true),
        "stated_to_true_error": stated_figures(observations, points, sizes, true),
        "reprojection_px_rms": rms(np.linalg.norm(solution.errors, axis=1)),
        **bump_figures(solution.cameras, index, args.bumps),
        "seconds": solved - start,
        "seconds_detection": detected - start,
        "corners": len(solution.errors),
        "dropped": len(solution.dropped),
        **footage_figures(index, true, config, args.recording),
        "baseline": {"opencv_chain": baseline},
    }
    if args.dataset is None:
        row |= gain_figures(palette, sorted(solution.cameras))
    print(json.dumps({"benchmark": "calibrate", "preset": args.preset, **rounded(row)}))
    return 0


def gain_figures(palette: WhiteCollector, names: list[str]) -> dict[str, float]:
    """Return the rms error of the colour gains and of leaving colours as they are, percent."""
    found = palette.gains(names)
    measured = np.array([found.gain.get(name, np.ones(3)) for name in names])
    every = sorted(make_rig(RIG.cameras, RIG.width, RIG.height, RIG.seed))
    true = np.log([make_sensor(every.index(name), RIG.seed).gain for name in names])
    true -= true.mean(0)
    return {
        "colour_gain_error_percent": 100 * rms((np.log(measured) - true).ravel()),
        "colour_gain_unevened_percent": 100 * rms(true.ravel()),
    }


def footage_figures(
    index: Index, true: Mapping[str, Camera], config: CalibrateConfig, folder: Path
) -> dict[str, object]:
    """Measure rigs solved from footage alone and perturbed ones refined, the twin's and foreign.

    A foreign capture's given calibration is hidden from the solution and is what it is held to.
    """
    shared = Path(os.environ.get("EXPRESS50_SHARED", Path(__file__).parents[2] / "shared"))
    seen = see_capture(index.capture, true, config.solve_frame_sets)
    sfm = {"twin": sfm_figures(seen, true, config)}
    refine = {"twin": refine_figures(seen, true, figures)}
    for name, scene in SCENES.items():
        dataset, truth = recorded(scene, folder / name)
        subject = dataset.subjects()[0]
        other = truth.cameras(subject)
        seen = see_capture(read_index(dataset, subject).capture, other, config.solve_frame_sets)
        sfm[name] = sfm_figures(seen, other, config)
    for root in sorted((shared / "captures").glob("*/calibration.json")):
        given = read_cameras(root)
        seen = see_capture(root.parent, given, config.solve_frame_sets)
        sfm[root.parent.name] = sfm_figures(seen, given, config)
        refine[root.parent.name] = refine_figures(seen, given, figures)
    return {"sfm": sfm, "refine": refine}


def bump_figures(cameras: Mapping[str, Camera], index: Index, bumps: int) -> dict[str, object]:
    """Return whether turned cameras, and no others, are found in the footage."""
    # One expression was recorded; without its cue the instants are spread over all frames.
    seen = find_points(partial(read_footage, replace(index, cues=()), cameras, 2))
    names, rng = sorted(cameras), np.random.default_rng(0)
    quiet = check_footage(cameras, seen)
    accused = {}
    for place in np.linspace(0, len(names) - 1, bumps + 2).round().astype(int)[1:-1]:
        name, axis = names[place], rng.normal(size=3)
        turn = np.radians(BUMP_DEG) * axis / np.linalg.norm(axis)
        pose = move_pose(cameras[name].cam_from_world, np.concatenate([turn, np.zeros(3)]))
        bumped = replace(cameras[name], cam_from_world=pose)
        accused[name] = sorted(check_footage({**cameras, name: bumped}, seen).moved)
    return {
        "bump_deg": BUMP_DEG,
        "bumped_camera_found": bool(accused)
        and all(found == [name] for name, found in accused.items()),
        "bumps_found": accused,
        "moved_in_the_rig_as_solved": sorted(quiet.moved),
        "unchecked": sorted(quiet.unchecked),
    }


def figures(estimated: Mapping[str, Camera], true: Mapping[str, Camera]) -> dict[str, float]:
    """Return errors of a rig after a rigid motion onto the true one."""
    motion = align_worlds(estimated, true)
    moved = {name: transform_camera(camera, motion) for name, camera in estimated.items()}
    return rig_errors(moved, true) | {"head_px": head_error(estimated, true), "cameras": len(moved)}


def head_error(estimated: Mapping[str, Camera], true: Mapping[str, Camera]) -> float:
    """Return the rms distance, pixels, between where both rigs see points in the head's place."""
    middle = meeting_point(true)
    points = head_points() + (np.zeros(3) if middle is None else middle)
    return rms(camera_errors(estimated, true, points).values())


def stated_figures(
    observations: BoardCorners,
    points: np.ndarray,
    sizes: Mapping[str, tuple[int, int]],
    true: Mapping[str, Camera],
) -> dict[str, float]:
    """Return stated uncertainty over true error, rms over cameras, for rigs of 4, 8 and all.

    The smaller rigs are parts of the recorded one: neighbours, and cameras evenly apart.
    """
    found, names = {}, sorted(sizes)
    for count in sorted({min(n, len(names)) for n in (4, 8, len(names))}):
        stated, off = list[float](), list[float]()
        apart = len(names) // count
        parts = [names[first::apart] for first in range(apart)]
        if apart > 1:
            parts += [names[count * i :][:count] for i in range(apart)]
        for part in parts:
            mine = np.isin(observations.camera, [observations.cameras.index(n) for n in part])
            solved = solve_rig(observations.select(mine), points, sizes)
            middle = meeting_point({name: true[name] for name in solved.cameras})
            stated += [error.px for error in state_uncertainty(solved, points).values()]
            off += camera_errors(solved.cameras, true, head_points() + middle).values()
        found[f"{count}_cameras"] = rms(stated) / rms(off)
    return found


def chained(
    observations: BoardCorners, points: np.ndarray, sizes: Mapping[str, tuple[int, int]]
) -> BoardRig:
    """Chain OpenCV's cameras by mean relative poses along the best tree of pairs, not adjusted."""
    lone: dict[str, Camera] = {}
    views: dict[str, dict[int, BoardView]] = {}
    for i, name in enumerate(observations.cameras):
        mine = observations.camera == i
        frames = {int(f): mine & (observations.frame == f) for f in observations.frame[mine]}
        found = [
            BoardView(f, points[observations.corner[rows]], observations.pixels[rows])
            for f, rows in sorted(frames.items())
            if rows.sum() >= 8
        ]
        fitted = fit_intrinsics(found, sizes[name], "OPENCV")
        if fitted is None:
            continue
        params = camera_params(*fitted[:2], "OPENCV")
        lone[name] = Camera(name, *sizes[name], "OPENCV", params, np.eye(4))
        views[name] = {found[k].frame: with_ideal(lone[name], found[k]) for k in fitted[2]}
    poses = {
        name: {frame: found[:1] for frame, found in mine.items()}
        for name, mine in all_board_poses(views).items()
    }
    edges = {}
    for a in sorted(lone):
        for b in sorted(lone):
            shared = sorted(set(poses[a]) & set(poses[b])) if a < b else []
            if shared:
                votes = [poses[b][f][0] @ invert_transform(poses[a][f][0]) for f in shared]
                weights = np.array([float(len(views[b][f].points)) for f in shared])
                edges[a, b] = (mean_transform(np.stack(votes), weights), float(weights.sum()))
    placed = join_rig(sorted(lone), edges, sweeps=0)
    boards = rig_from_boards(placed, lone, views, poses)
    cameras = {name: replace(lone[name], cam_from_world=pose) for name, pose in placed.items()}
    return BoardRig(cameras, boards)


if __name__ == "__main__":
    sys.exit(main())
