"""Measure calibration on real footage that we may not ship, beside another tool's result.

``--rig4`` names a folder with a session of caliscope: four free-running webcams ``cam_N.mp4``,
their ``timestamps.csv``, the board they saw (``charuco.toml``) and the rig that caliscope solved
(``camera_array.toml``). Ours is solved from the odd frame sets. Both are judged on the corners of
the even ones, triangulated: by how far they project from where they were seen, and by how far the
distances of neighbours are from the side of a square. The last line is one JSON object.
"""

from __future__ import annotations

import csv
import json
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import make_parser, rounded
from express50.files.images import write_image
from express50.files.video import iterate_video
from express50.geometry.cameras import Camera, project, triangulate
from express50.rigs.read import read_rig
from pipelines.calibrate.board import Board, BoardCorners, board_footage, board_points, read_corners
from pipelines.calibrate.board_rig import solve_rig
from pipelines.calibrate.uncertainty import state_uncertainty

RIG4 = ("cameras_dropped", "reprojection_rms_px", "square_error_mm")


def main() -> int:
    """Run and print."""
    parser = make_parser("real", __doc__)
    parser.add_argument("--rig4", type=Path, help="the folder of caliscope's session")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    row = rig4_figures(args.rig4) if args.rig4 else dict.fromkeys(RIG4, "n/a: name --rig4 DIR")
    print(json.dumps(rounded({"benchmark": "real", "rig4": row})))
    return 0


def rig4_figures(folder: Path) -> dict[str, object]:
    """Return errors of our rig and of the peer's on the even frame sets."""
    peer = dict(read_rig(folder / "camera_array.toml"))
    board, odd, even = seen_board(folder, peer)
    sizes = {name: (camera.width, camera.height) for name, camera in peer.items()}
    points = board_points(board)
    solved = solve_rig(odd, points, sizes)
    return {
        "cameras_dropped": len(peer) - len(solved.cameras),
        **judged(solved.cameras, even, board),
        "peer": judged({name: peer[name] for name in solved.cameras}, even, board),
        "stated": {n: asdict(e) for n, e in state_uncertainty(solved, points).items()},
        "timing": {n: asdict(t) for n, t in solved.timing.items()},
        "dropped": solved.dropped,
        "weak": solved.weak,
    }


def seen_board(
    folder: Path, cameras: Mapping[str, Camera]
) -> tuple[Board, BoardCorners, BoardCorners]:
    """Find the board's corners in the odd and in the even frame sets."""
    table = tomllib.loads((folder / "charuco.toml").read_text())
    square = table["square_size_override_cm"] / 100
    board = Board(
        table["columns"], table["rows"], square, square * table["aruco_scale"],
        table["dictionary"], table["legacy_pattern"],
    )  # fmt: skip
    sets: dict[str, list[int]] = {name: [] for name in cameras}
    with (folder / "timestamps.csv").open() as rows:
        for row in csv.DictReader(rows):
            sets[f"cam_{row['cam_id']}"].append(int(row["sync_index"]))
    with tempfile.TemporaryDirectory() as made:
        files: dict[str, list[Path]] = {name: [] for name in cameras}
        for name, numbers in sets.items():
            footage = iterate_video(folder / f"{name}.mp4")
            for number, (_, image) in zip(sorted(numbers), footage, strict=True):
                files[name].append(Path(made) / name / f"{number:06d}.png")
                files[name][-1].parent.mkdir(exist_ok=True)
                write_image(files[name][-1], image)
        sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
        odd, even = (
            {
                n: board_footage([p for p in mine if int(p.stem) % 2 == side])
                for n, mine in files.items()
            }
            for side in (1, 0)
        )
        return board, read_corners(board, odd, sizes, 0), read_corners(board, even, sizes, 0)


def judged(rig: Mapping[str, Camera], corners: BoardCorners, board: Board) -> dict[str, object]:
    """Return rms errors of corners that two or more cameras see, triangulated set by set."""
    names, count = sorted(rig), (board.squares_x - 1) * (board.squares_y - 1)
    grid = np.full((len(names), len(corners.frames), count, 2), np.nan)
    for i, name in enumerate(names):
        mine = corners.camera == corners.cameras.index(name)
        grid[i, corners.frame[mine], corners.corner[mine]] = corners.pixels[mine]
    seen = grid.reshape(len(names), -1, 2)
    points = triangulate([rig[name] for name in names], seen)
    known = np.isfinite(points).all(1)
    offs = [project(rig[n], points[known])[0] - p[known] for n, p in zip(names, seen, strict=True)]
    squared = np.sum(np.stack(offs) ** 2, axis=-1)
    per_camera = {n: float(np.sqrt(np.nanmean(s))) for n, s in zip(names, squared, strict=True)}
    rows = points.reshape(-1, board.squares_y - 1, board.squares_x - 1, 3)
    sides = [np.linalg.norm(np.diff(rows, axis=axis), axis=-1).ravel() for axis in (1, 2)]
    off = 1e3 * (np.concatenate(sides) - board.square_length_m)
    return {
        "reprojection_rms_px": float(np.sqrt(np.nanmean(squared))),
        "square_error_mm": float(np.sqrt(np.nanmean(off**2))),
        "square_bias_mm": float(np.nanmean(off)),
        "per_camera_px": per_camera,
        "corners": int(np.isfinite(squared).sum()),
    }


if __name__ == "__main__":
    sys.exit(main())
