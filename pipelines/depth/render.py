"""Volume rendering of signed distances along rays, and how its errors pull at the distances."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pipelines.depth.band import Band
from pipelines.depth.probes import LOBES, Appearance, Matrix, lobes, sparse_matrix
from pipelines.depth.rays import Rays

OUTSIDE = 4.0  # voxels; the distance where the band has no vertex
FAINT = 0.02  # share of a pixel's light below which a sample's colour is not looked up
THIN = 0.05  # opacity under which colours are not scaled up further
LEAST_NOISE = 1e-3  # of colours; better than that no camera is
ALPHA_NOISE = 0.15  # mattes are about so wrong at a rim


@dataclass(frozen=True)
class Scene:
    """What is rendered.

    Attributes:
        band: M vertices of distances and base colours.
        probes: P probes, ``wide`` voxels apart.
        rays: R rays in voxels.
        sharpness: of the logistic that makes distances opaque, per voxel.
        chunk: rays at once.
    """

    band: Band
    probes: Band
    wide: float
    rays: Rays
    sharpness: float
    chunk: int = 16384

    def chunks(self) -> list[slice]:
        """The rays in chunks."""
        count = len(self.rays.camera)
        return [slice(k, min(k + self.chunk, count)) for k in range(0, count, self.chunk)]


@dataclass(frozen=True)
class Errors:
    """Modelled less seen of R rays, and how much each counts.

    Attributes:
        colour: (R, 3), 0 where it does not count; opacity: (R,).
        colour_weight: (R,), opacity_weight: (R,) of their squares.
        cost: mean robust cost a ray.
        colour_error: median of the colours' absolute errors, 8-bit steps.
    """

    colour: torch.Tensor
    opacity: torch.Tensor
    colour_weight: torch.Tensor
    opacity_weight: torch.Tensor
    cost: float
    colour_error: float


def ray_weights(values: torch.Tensor, sharpness: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights (R, K) of samples along rays, and their sum, opacity (R,), from distances (R, K).

    An interval's opacity is the relative fall of the logistic distribution over it, never negative:
    unbiased at the first zero and blind to what it hides (NeuS, Wang et al. 2021, eq. 13). It is
    taken in logarithms, so that no ratio of vanishing numbers occurs. Half of an interval's weight
    goes to the sample at each of its ends.

    Args:
        values: distances, voxels, positive outside.
        sharpness: of the logistic, per voxel.
    """
    log = torch.nn.functional.logsigmoid(values * sharpness)
    passed = torch.cumsum((log[:, 1:] - log[:, :-1]).clamp_max(0), 1).exp()
    left = torch.cat([torch.ones_like(passed[:, :1]), passed], 1)
    half = (left[:, :-1] - left[:, 1:]) / 2
    weights = torch.nn.functional.pad(half, (0, 1)) + torch.nn.functional.pad(half, (1, 0))
    return weights, 1 - left[:, -1]


def distances(index: torch.Tensor, weight: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Distances (...) interpolated from values (M,) by (..., 8); far outside where none exist."""
    found = (values[index] * weight).sum(-1)
    return torch.where(weight.sum(-1) > 0, found, found.new_full((), OUTSIDE))


def bright(share: torch.Tensor, opacity: torch.Tensor) -> torch.Tensor:
    """Weights (R, K) of the samples that show, which sum to one as far as the ray is opaque.

    Faint samples give their light to the others: a pixel that lost it would be darker.
    """
    share = share / opacity.clamp_min(THIN)[:, None]
    kept = torch.where(share > FAINT, share, 0.0)
    return kept * (share.sum(1) / kept.sum(1).clamp_min(FAINT))[:, None]


def pixel_rows(scene: Scene, values: torch.Tensor) -> tuple[Matrix, torch.Tensor]:
    """The matrix (R, M + 3 P) from appearance to the rays' colours, and their opacity (R,).

    Colours are divided by opacity (pixels that count are opaque). Rays whose colour does not count
    have empty rows.
    """
    entries, opacity = [], []
    for at in scene.chunks():
        some = scene.rays.take(at)
        found = distances(*scene.band.interpolation(some.points()), values)
        share, solid = ray_weights(found, scene.sharpness)
        opacity.append(solid)
        share = torch.where((some.weight > 0)[:, None], bright(share, solid), 0.0)
        row, column = torch.nonzero(share, as_tuple=True)
        points = some.start[row] + some.along[row, column][:, None] * some.way[row]
        index, weight = scene.band.interpolation(points)
        rays = (row[:, None] + at.start).int()
        entries.append((rays, index.int(), weight * share[row, column][:, None]))
        entries.append(_probe_entries(scene, some, share, at.start))
    row, column, value = (
        torch.cat([part.expand(full.shape).reshape(-1) for part, full in pairs])
        for pairs in zip(*[[(e[k], e[2]) for k in range(3)] for e in entries], strict=True)
    )
    order = torch.argsort(row, stable=True)
    size = scene.band.count + LOBES * scene.probes.count
    matrix = sparse_matrix(row[order], column[order], value[order], (len(scene.rays.camera), size))
    return matrix, torch.cat(opacity)


def _probe_entries(
    scene: Scene, rays: Rays, share: torch.Tensor, first: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rows (n, 1, 1), columns (n, 8, 3) and values (n, 8, 3) by which probes light the pixels.

    Probes are so coarse that the pixel's mean place stands for its samples.
    """
    row = torch.nonzero(rays.weight > 0)[:, 0]
    middle = rays.start[row] + (share[row] * rays.along[row]).sum(1, keepdim=True) * rays.way[row]
    probe, near = scene.probes.interpolation(middle / scene.wide)
    angular = lobes(rays.way[row], rays.normal[row])
    lobe = torch.arange(LOBES, device=probe.device)
    column = scene.band.count + LOBES * probe[..., None] + lobe
    return (row + first).int()[:, None, None], column.int(), near[..., None] * angular[:, None]


def errors(
    matrix: Matrix,
    opacity: torch.Tensor,
    look: Appearance,
    rays: Rays,
    noise: float | None = None,
) -> Errors:
    """What the rendering lacks, weighed by Charbonnier's robust cost.

    Args:
        matrix: (R, N) of :func:`pixel_rows`.
        opacity: (R,) of the same.
        look: appearance.
        rays: R rays.
        noise: standard deviation of the colours; taken from their errors where not given.
    """
    counts = rays.weight > 0
    gap = matrix.rows @ look.colours - look.evened(rays.rgb, rays.camera)
    gap = torch.where(counts[:, None], gap, 0.0)
    typical = float(gap[counts].abs().median()) if bool(counts.any()) else 1.0
    noise = noise or max(1.4826 * typical, LEAST_NOISE)
    lack = opacity - rays.alpha
    colour = (1 + (gap / noise).square().mean(1)).sqrt()
    matte = (1 + (lack / ALPHA_NOISE).square()).sqrt()
    cost = (rays.weight * (colour - 1) + matte - 1).mean(dtype=torch.float64)
    return Errors(
        gap,
        lack,
        rays.weight / colour / (3 * noise**2),
        1 / matte / ALPHA_NOISE**2,
        float(cost),
        255 * typical,
    )


def pull(
    scene: Scene, values: torch.Tensor, base: torch.Tensor, wrong: Errors
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradient (M,) of the cost by the values (M,), and its lumped Gauss-Newton curvature (M,).

    ``base`` (M, 3) are the vertices' colours. The curvature is J^T W (J 1): the sums of the normal
    matrix's rows, exact for moves that do not change from vertex to vertex.
    """
    slope, bend = torch.zeros_like(values), torch.zeros_like(values)
    for at in scene.chunks():
        index, weight = scene.band.interpolation(scene.rays.take(at).points())
        found = distances(index, weight, values)
        apart = _colours_apart(found, scene.sharpness, index, weight, base)
        down, turn = ray_pull(
            found, scene.sharpness, apart, wrong.colour[at], wrong.opacity[at],
            wrong.colour_weight[at], wrong.opacity_weight[at],
        )  # fmt: skip
        size = down.abs() + turn.abs()
        row, column = torch.nonzero(size > 1e-3 * size.amax(1, keepdim=True), as_tuple=True)
        near, share = index[row, column].reshape(-1), weight[row, column]
        slope.index_add_(0, near, (share * down[row, column][:, None]).reshape(-1))
        bend.index_add_(0, near, (share * turn[row, column][:, None]).reshape(-1))
    return slope, bend.clamp_min(0)


def _colours_apart(
    found: torch.Tensor,
    sharpness: float,
    index: torch.Tensor,
    weight: torch.Tensor,
    base: torch.Tensor,
) -> torch.Tensor:
    """Base colours (R, K, 3) of the samples less their pixel's, 0 where they are faint."""
    share = bright(*ray_weights(found, sharpness))
    row, column = torch.nonzero(share, as_tuple=True)
    seen = (base[index[row, column]] * weight[row, column][..., None]).sum(1)
    mean = seen.new_zeros(len(share), 3)
    mean.index_add_(0, row, share[row, column][:, None] * seen)
    apart = seen.new_zeros(*share.shape, 3)
    apart[row, column] = seen - mean[row]
    return apart


def ray_pull(
    found: torch.Tensor,
    sharpness: float,
    apart: torch.Tensor,
    colour: torch.Tensor,
    opacity: torch.Tensor,
    colour_weight: torch.Tensor,
    opacity_weight: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradient (R, K) and lumped curvature (R, K) of the cost by the distances at the samples.

    Args:
        found: (R, K) distances, voxels.
        sharpness: per voxel.
        apart: (R, K, 3) the samples' colours less the pixel's.
        colour: (R, 3) errors.
        opacity: (R,) errors.
        colour_weight: (R,) of the colours' squared errors.
        opacity_weight: (R,) of the opacities'.
    """
    with torch.enable_grad():
        leaf = found.detach().requires_grad_()
        share, solid = ray_weights(leaf, sharpness)
        # the pixel's colour is the mean of its samples': only what sets them apart tells
        seen = (share[..., None] * apart).sum(1) / solid.detach().clamp_min(THIN)[:, None]
        outputs = [*seen.unbind(1), solid]
        rows = [torch.autograd.grad(out.sum(), leaf, retain_graph=True)[0] for out in outputs]
    down, turn = torch.zeros_like(found), torch.zeros_like(found)
    weighed = [*((colour_weight, error) for error in colour.unbind(1)), (opacity_weight, opacity)]
    for row, (weight, error) in zip(rows, weighed, strict=True):
        down += (weight * error)[:, None] * row
        turn += (weight * row.sum(1))[:, None] * row
    return down, turn
