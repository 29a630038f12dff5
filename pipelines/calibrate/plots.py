"""Plots of a calibration: the rig in space, and the errors of the board's corners."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from express50.files.images import write_image
from express50.geometry.cameras import Camera
from express50.rigs.world_frame import meeting_point
from pipelines.calibrate.board_rig import BoardSolution


def _save(figure: Figure, path: Path) -> None:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    write_image(path, np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3]), quality=90)


def _frustum(camera: Camera, length: float) -> np.ndarray:
    """Return (5, 3) world points: the camera's centre, then its image plane's corners."""
    K = camera.K
    x = (np.array([0, camera.width, camera.width, 0]) - K[0, 2]) / K[0, 0]
    y = (np.array([0, 0, camera.height, camera.height]) - K[1, 2]) / K[1, 1]
    plane = np.column_stack([x, y, np.ones(4)]) * length
    local = np.vstack([np.zeros(3), plane])
    return local @ camera.world_from_cam[:3, :3].T + camera.center


def draw_rig(path: Path, cameras: Mapping[str, Camera], boards: np.ndarray) -> None:
    """Draw the cameras' frusta from above and from the front; `boards` (B, 3) are board origins.

    Lengths are metres; the grey lines are optical axes up to the point in which they meet.
    """
    figure = Figure(figsize=(11, 5.2), dpi=100, layout="tight")
    met = meeting_point(cameras)
    centers = np.stack([camera.center for camera in cameras.values()])
    target = centers.mean(0) if met is None else met
    reach = float(np.median(np.linalg.norm(centers - target, axis=1))) or 1.0
    for column, (title, a, b) in enumerate(
        (("from above (front of the rig below)", 0, 2), ("from the front", 0, 1))
    ):
        axes = figure.add_subplot(1, 2, column + 1)
        for name, camera in sorted(cameras.items()):
            _draw_camera(axes, name, camera, (a, b), 0.12 * reach, met is not None and reach)
        if len(boards):
            axes.plot(boards[:, a], boards[:, b], ".", color="tab:orange", ms=3, label="board")
            axes.legend(loc="upper right", fontsize=7)
        axes.plot(*target[[a, b]], "k+", ms=10)
        axes.set_aspect("equal", "datalim")
        axes.set_xlabel("xyz"[a] + " [m]")
        axes.set_ylabel("xyz"[b] + " [m]")
        axes.set_title(title, fontsize=10)
        axes.grid(alpha=0.3)
        if b == 2:
            axes.invert_yaxis()
    _save(figure, path)


def _draw_camera(
    axes: Axes,
    name: str,
    camera: Camera,
    plane: tuple[int, int],
    size: float,
    axis_length: float,
) -> None:
    corners = _frustum(camera, size)[:, list(plane)]
    for i in range(4):
        triangle = corners[[0, 1 + i, 1 + (i + 1) % 4]]
        axes.plot(triangle[:, 0], triangle[:, 1], color="tab:blue", lw=0.8)
    end = (camera.center + axis_length * camera.cam_from_world[2, :3])[list(plane)]
    axes.plot([corners[0, 0], end[0]], [corners[0, 1], end[1]], color="0.8", lw=0.5, zorder=0)
    axes.annotate(name, corners[0], fontsize=6, textcoords="offset points", xytext=(3, 3))


def draw_residuals(path: Path, solution: BoardSolution) -> None:
    """Draw the scatter of corner errors, their mean over the image, and the rms per camera.

    A round scatter and arrows without a pattern mean that the lens model is sufficient.
    """
    figure = Figure(figsize=(13, 4.2), dpi=100, layout="tight")
    kept, errors = solution.corners, solution.errors
    scatter, field, bars = (figure.add_subplot(1, 3, i + 1) for i in range(3))
    limit = max(float(np.percentile(np.abs(errors), 99.5)) * 1.2, 1e-6)
    scatter.hexbin(errors[:, 0], errors[:, 1], gridsize=40, extent=(-limit, limit) * 2, mincnt=1)
    scatter.set_aspect("equal")
    scatter.set_title(f"errors of {len(errors)} corners [px]", fontsize=10)
    _draw_field(field, solution)
    names = sorted(solution.cameras)
    rms = [
        np.sqrt(np.mean(np.sum(errors[kept.camera == kept.cameras.index(n)] ** 2, axis=1)))
        for n in names
    ]
    colours = ["tab:red" if n in solution.weak else "tab:blue" for n in names]
    bars.bar(range(len(names)), rms, color=colours)
    bars.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    bars.set_title("rms per camera [px]; red: weakly tied in", fontsize=10)
    _save(figure, path)


def _draw_field(axes: Axes, solution: BoardSolution, cells: int = 12) -> None:
    """Draw the mean error in each cell of the image, over all cameras, as arrows."""
    kept = solution.corners
    sizes = np.array(
        [
            (solution.cameras[n].width, solution.cameras[n].height)
            if n in solution.cameras
            else (1, 1)
            for n in kept.cameras
        ]
    )
    where = kept.pixels / sizes[kept.camera]
    cell = np.clip((where * cells).astype(int), 0, cells - 1) @ np.array([1, cells])
    count = np.bincount(cell, minlength=cells**2)
    full = np.flatnonzero(count >= 5)
    mean = (
        np.stack(
            [np.bincount(cell, solution.errors[:, i], minlength=cells**2) for i in range(2)], axis=1
        )[full]
        / count[full, None]
    )
    at = (np.column_stack([full % cells, full // cells]) + 0.5) / cells
    longest = float(np.linalg.norm(mean, axis=1).max(initial=1e-9))
    axes.quiver(at[:, 0], at[:, 1], mean[:, 0], mean[:, 1], angles="xy", scale=longest * 12)
    axes.set_xlim(0, 1)
    axes.set_ylim(1, 0)
    axes.set_title(f"mean error over the image (longest {longest:.3f} px)", fontsize=10)
