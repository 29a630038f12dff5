"""The level set's surface refined by rendering it: rounds of Gauss-Newton on a sparse band.

Each round takes other pixels, solves their appearance and moves the surface against the errors of
the rendering. What earlier rounds learnt is kept as in recursive least squares, so that noise
averages out. The move lives on a lattice coarser than the distances, bends as a thin plate (smooth
where pixels say little) and keeps the distances' slope at one: gradients of a rendering that moved
vertices one by one would break the surface (Nicolet et al. 2021). At the end, pixels that no round
has seen say whether the result is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from express50.errors import ConfigError
from pipelines.depth.band import Band, grown, make_band, roughness, slopes, slopes_transposed
from pipelines.depth.blocks import Grid, at, held, replaced, voxel_index
from pipelines.depth.config import DepthConfig
from pipelines.depth.grid import View
from pipelines.depth.probes import (
    Appearance,
    Matrix,
    conjugate_gradients,
    plain_appearance,
    solve_appearance,
    sparse_matrix,
)
from pipelines.depth.rays import OPAQUE, Rays, Sight, make_sight
from pipelines.depth.render import Errors, Scene, errors, pixel_rows, pull
from pipelines.depth.surface import extract_mesh

REACH = 3.5  # voxels of the band to either side
MOVE_EVERY, PROBE_EVERY = 2, 4  # voxels between the moves' and the probes' vertices
MOST_STEP, MOST_MOVE = 0.5, 2.0  # voxels a round, and in all: beyond, samples would run out
SOFT = (0.8, 0.4)  # voxels; standard deviation of the surface's blur in the first and last round
LOGISTIC = np.pi / np.sqrt(3)  # standard deviation of the logistic distribution times sharpness
EIKONAL = 0.1  # weight of unit slope against what pixels usually say
APPEARANCE_STEPS, MOVE_STEPS = 8, 150  # of conjugate gradients
HELD_OUT = 0.1  # share of a round's rays that only judge
FEWEST_RAYS = 100  # below, there is nothing to render


@dataclass(frozen=True)
class Model:
    """What a refinement works on.

    Attributes:
        band: M vertices; start: (M,) their distances, voxels.
        moves: N coarser vertices; spread: (M, N) takes their moves to the band.
        probes: P vertices coarser still.
    """

    band: Band
    start: torch.Tensor
    moves: Band
    spread: Matrix
    probes: Band

    def values(self, move: torch.Tensor) -> torch.Tensor:
        """Distances (M,) after moves (N,), voxels."""
        return self.start + (self.spread.rows @ move[:, None])[:, 0]


def refine(views: Sequence[View], grid: Grid, config: DepthConfig) -> tuple[Grid, dict]:
    """The grid refined by rendering, or as it was where that does not pay, and what was done.

    Raises:
        ConfigError: CUDA is asked for and absent.
    """
    mesh = extract_mesh(grid)
    if not config.render_rounds or not len(mesh[2]):
        return grid, {}
    device = pick_device(config.device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums in one order; the runner counts one core an item
    try:
        return _refine(views, grid, mesh, config, device)
    finally:
        torch.set_num_threads(threads)


def pick_device(name: str) -> torch.device:
    """The device of this name; "auto" is CUDA where there is one.

    Raises:
        ConfigError: CUDA is asked for and absent.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "depth.device is 'cuda' but torch finds no CUDA device; expected one, or"
            " --set depth.device=auto"
        )
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def _refine(
    views: Sequence[View],
    grid: Grid,
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray],
    config: DepthConfig,
    device: torch.device,
) -> tuple[Grid, dict]:
    model = make_model(grid, mesh[0], device)
    budget = int(config.render_rays * (config.render_rounds + HELD_OUT))
    sight = make_sight(views, grid.origin, grid.voxel, mesh, config.render_samples, budget)
    if sight.count < FEWEST_RAYS:
        return grid, {"render_kept": False, "render_rays": 0}
    judges = sight.batch(slice(0, _held(sight, config)), device)
    move = torch.zeros(model.moves.count, device=device)
    bend, rejected = torch.zeros_like(move), 0
    mean = judges.rgb[judges.alpha > OPAQUE].mean(0).nan_to_num(0.5)
    look = plain_appearance(model.band, model.probes, len(views), mean)
    for k in range(config.render_rounds):
        rays = _batch(sight, k, config, device)
        scene = _scene(model, rays, k / max(1, config.render_rounds - 1))
        values = model.values(move)
        seen, wrong = explain(scene, values, look, 2 if k == 0 else 1)
        down, turn = pull(scene, values, seen.colours[: model.band.count], wrong)
        down, turn = ((model.spread.columns @ x[:, None])[:, 0] for x in (down, turn))
        step = solve_step(model, move, down, bend + turn, config.render_stiffness)
        if not all(bool(torch.isfinite(x).all()) for x in (down, turn, step)):
            rejected += 1
            continue
        look, bend = seen, bend + turn
        move = (move + step.clamp(-MOST_STEP, MOST_STEP)).clamp(-MOST_MOVE, MOST_MOVE)
    rays = _batch(sight, config.render_rounds - 1, config, device)
    plain = plain_appearance(model.band, model.probes, len(views), mean)  # no start favours either
    old, new = (judge(model, m, plain, rays, judges) for m in (torch.zeros_like(move), move))
    kept = np.isfinite(new.cost) and new.cost < old.cost
    numbers = _numbers(model, move, grid, old, new) | {
        "render_kept": bool(kept),
        "render_rays": len(rays.camera) * config.render_rounds,
        "render_rounds_rejected": rejected,
        "render_device": device.type,
    }
    return (written_back(grid, model, move) if kept else grid), numbers


def _held(sight: Sight, config: DepthConfig) -> int:
    return int(HELD_OUT * min(sight.count, config.render_rays))


def _batch(sight: Sight, k: int, config: DepthConfig, device: torch.device) -> Rays:
    """The rays of round k, after those held out; some again where pixels run out."""
    first, count = _held(sight, config), config.render_rays
    start = first + (k * count) % (sight.count - first)
    start = max(first, min(start, sight.count - count))
    return sight.batch(slice(start, start + count), device)


def _scene(model: Model, rays: Rays, progress: float) -> Scene:
    soft = SOFT[0] * (SOFT[1] / SOFT[0]) ** progress
    return Scene(model.band, model.probes, PROBE_EVERY, rays, float(LOGISTIC / soft))


def explain(
    scene: Scene, values: torch.Tensor, look: Appearance, effort: int
) -> tuple[Appearance, Errors]:
    """The appearance solved for these distances (M,), and what it leaves."""
    rays = scene.rays
    matrix, opacity = pixel_rows(scene, values)
    look = solve_appearance(
        matrix, scene.band, rays.rgb, rays.camera, rays.weight, look, effort * APPEARANCE_STEPS
    )
    return look, errors(matrix, opacity, look, rays)


def judge(model: Model, move: torch.Tensor, look: Appearance, rays: Rays, judges: Rays) -> Errors:
    """What rays that taught nothing find wrong after moves (N,), explained by other rays."""
    values = model.values(move)
    look, _ = explain(_scene(model, rays, 1.0), values, look, 2)
    matrix, opacity = pixel_rows(_scene(model, judges, 1.0), values)
    return errors(matrix, opacity, look, judges, noise=1 / 255)


def solve_step(
    model: Model, move: torch.Tensor, down: torch.Tensor, bend: torch.Tensor, stiffness: float
) -> torch.Tensor:
    """The step (N,), voxels, of moves (N,): data, a thin plate, unit slope; conjugate gradients.

    Args:
        model: what is moved.
        move: (N,) so far: the plate is of the whole move, so that noise does not pile up.
        down: (N,) gradient of the data's cost.
        bend: (N,) its curvature.
        stiffness: voxels under which moves are smoothed where pixels say as much as usual.
    """
    told = bend > 0.05 * bend.mean()
    usual = float(bend[told].median()) if bool(told.any()) else 1.0
    plate, ridge = (stiffness / MOVE_EVERY) ** 4 * usual, 1e-3 * usual
    ways, lack = _slant(model, move)

    def product(x: torch.Tensor) -> torch.Tensor:
        along = (ways * slopes(model.moves, x)).sum(1, keepdim=True)
        out = (bend + ridge) * x + plate * roughness(model.moves, roughness(model.moves, x))
        return out + EIKONAL * usual * slopes_transposed(model.moves, ways * along)

    bent = plate * roughness(model.moves, roughness(model.moves, move))
    right = EIKONAL * usual * slopes_transposed(model.moves, ways * lack[:, None]) - down - bent
    scale = 1 / (bend + ridge + 1.2 * plate + 0.5 * EIKONAL * usual)
    return conjugate_gradients(product, right, torch.zeros_like(move), scale, MOVE_STEPS)


def _slant(model: Model, move: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions (N, 3) in which distances rise and the slope (N,) they lack, 0 where unknown.

    In voxels of the moves' lattice, whose vertices lie on the band's.
    """
    values = torch.cat([model.start, model.start.new_full((1,), torch.nan)])
    values = values[model.band.find(model.moves.cells * MOVE_EVERY)] + move
    slant = slopes(model.moves, values / MOVE_EVERY)
    length = slant.norm(dim=1, keepdim=True)
    known = torch.isfinite(length) & (model.moves.sides < model.moves.count).all(1, keepdim=True)
    ways = torch.where(known, slant / length.clamp_min(1e-3), 0.0)
    return ways, MOVE_EVERY * torch.where(known, 1 - length, 0.0)[:, 0]


def make_model(grid: Grid, vertices: np.ndarray, device: torch.device) -> Model:
    """Band, moves and probes about the grid's surface, whose mesh has ``vertices`` (V, 3)."""
    touched = np.unique(np.floor((vertices - grid.origin) / grid.voxel).astype(np.int64), axis=0)
    cells = grown(touched, int(np.ceil(REACH)))
    values = grid.sample(grid.origin + grid.voxel * cells) / grid.voxel
    near = np.abs(values) < REACH
    band = make_band(cells[near], device)
    start = torch.from_numpy(values[near].astype(np.float32)).to(device)
    moves = make_band(_lattice(cells[near], MOVE_EVERY), device)
    index, weight = moves.interpolation(band.cells.float() / MOVE_EVERY)
    row = torch.arange(band.count, device=device)[:, None].expand(index.shape)
    row, index, weight = (part.reshape(-1) for part in (row, index, weight))
    spread = sparse_matrix(row, index, weight, (band.count, moves.count))
    return Model(band, start, moves, spread, make_band(_lattice(cells[near], PROBE_EVERY), device))


def _lattice(cells: np.ndarray, every: int) -> np.ndarray:
    """Coordinates of the coarse vertices whose cells hold fine vertices (N, 3)."""
    base = np.unique(cells // every, axis=0)
    corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    return (base[:, None] + corner).reshape(-1, 3)


def written_back(grid: Grid, model: Model, move: torch.Tensor) -> Grid:
    """The grid with the band's new distances; its blocks hold all of the band."""
    moved = grid.voxel * model.values(move).cpu().numpy()

    def values(places: np.ndarray) -> np.ndarray:
        found = at(grid, places)
        index = torch.from_numpy(voxel_index(places)).to(model.band.cells.device)
        vertex = model.band.find(index).cpu().numpy()
        known = vertex < model.band.count
        found[known] = moved[vertex[known]]
        return found

    return replaced(grid, held(grid), values)


def _numbers(model: Model, move: torch.Tensor, grid: Grid, old: Errors, new: Errors) -> dict:
    """What the metrics say; colours in 8-bit steps, of pixels that no round has seen."""
    near = model.start.abs() < 1
    moved = model.values(move)[near] - model.start[near]
    tables = (model.band, model.moves, model.probes)
    found = {
        "render_moved_mm": float(moved.square().mean().sqrt()) * grid.voxel * 1e3,
        "render_cost_before": old.cost,
        "render_cost": new.cost,
        "render_colour_error_before": old.colour_error,
        "render_colour_error": new.colour_error,
        "render_alpha_error_before": float(old.opacity.abs().mean()),
        "render_alpha_error": float(new.opacity.abs().mean()),
    }
    known = {key: value if np.isfinite(value) else None for key, value in found.items()}
    return known | {
        "band_voxels": model.band.count,
        "band_mib": sum(table.bytes for table in tables) / 2**20,
    }
