"""Appearance of a surface: a fine base colour and coarse probes of how it changes with direction.

After ProbeSDF (Toussaint et al. 2025): what a place looks like varies fast in space and slowly in
angle, so colour lives on the band's vertices, and its dependence on the reflected direction, in
spherical harmonics of the first degree, on probes several voxels apart. Both enter a pixel
linearly, so they are solved from the photographs by conjugate gradients rather than descended to,
with each camera's gain and offset between.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from pipelines.depth.band import Band, roughness

MOST_GAIN = 2.0  # a camera's gain beyond this factor is no gain
FEWEST = 100  # pixels from which a camera's gain is found
LOBES = 3


@dataclass(frozen=True)
class Matrix:
    """A sparse matrix (R, N) and its transpose, both by rows: products in a fixed order."""

    rows: torch.Tensor
    columns: torch.Tensor


@dataclass(frozen=True)
class Appearance:
    """What M vertices and P probes look like, and how C cameras differ.

    Attributes:
        colours: (M + 3 P, 3) sRGB in [0, 1]: base colours, then three lobes a probe.
        gain: (C, 3), offset: (C, 3) that take a camera's colours to those of a common one.
    """

    colours: torch.Tensor
    gain: torch.Tensor
    offset: torch.Tensor

    def evened(self, rgb: torch.Tensor, camera: torch.Tensor) -> torch.Tensor:
        """Colours (R, 3) of cameras (R,) as one common camera would have seen them."""
        return self.gain[camera] * rgb + self.offset[camera]


def plain_appearance(band: Band, probes: Band, cameras: int, colour: torch.Tensor) -> Appearance:
    """One ``colour`` (3,) on every side of everything, all cameras alike."""
    device = band.cells.device
    base = colour.repeat(band.count, 1)
    lobes = torch.zeros(LOBES * probes.count, 3, device=device)
    gain = torch.ones(cameras, 3, device=device)
    return Appearance(torch.cat([base, lobes]), gain, torch.zeros_like(gain))


def sparse_matrix(
    row: torch.Tensor, column: torch.Tensor, value: torch.Tensor, shape: tuple[int, int]
) -> Matrix:
    """The matrix with these entries (N,), rows ascending."""

    def by_rows(row, column, value, height, width):
        starts = torch.zeros(height + 1, dtype=torch.int32, device=row.device)
        starts[1:] = torch.cumsum(torch.bincount(row, minlength=height), 0)
        return torch.sparse_csr_tensor(
            starts, column.int(), value, (height, width), check_invariants=False
        )

    order = torch.argsort(column.int(), stable=True)
    return Matrix(
        by_rows(row, column, value, *shape),
        by_rows(column[order], row[order], value[order], *shape[::-1]),
    )


def lobes(ways: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """First-degree harmonics (..., 3), up to a factor, of where rays (..., 3) are reflected to.

    They are the direction itself. The constant one is the base colour (Ramamoorthi and Hanrahan
    2001).
    """
    return ways - 2 * (ways * normals).sum(-1, keepdim=True) * normals


def solve_appearance(
    matrix: Matrix,
    band: Band,
    rgb: torch.Tensor,
    camera: torch.Tensor,
    weight: torch.Tensor,
    start: Appearance,
    steps: int,
    spread: float = 0.05,
    shyness: float = 0.02,
) -> Appearance:
    """Appearance that explains the photographs: conjugate gradients, then gains.

    Args:
        matrix: (R, M + 3 P) of how pixels see vertices and probes.
        band: M vertices.
        rgb: (R, 3) in [0, 1].
        camera: (R,) int64 of C cameras.
        weight: (R,).
        start: where to start from; conjugate gradients that stop early stay near it.
        steps: of conjugate gradients.
        spread: weight of the squared graph Laplacian of the base colours, so that vertices no
            pixel sees take their neighbours'.
        shyness: weight of the squared lobes, against the pixels a probe sees: what base colours
            explain, they shall.
    """
    weight = weight[:, None]
    M = band.count
    square = torch.sparse_csr_tensor(
        matrix.columns.crow_indices(), matrix.columns.col_indices(),
        matrix.columns.values() ** 2, matrix.columns.shape, check_invariants=False,
    )  # fmt: skip
    diagonal = square @ weight
    ridge = torch.full_like(diagonal, 1e-6)
    ridge[M:] = 1e-3 + shyness * diagonal[M:]

    def product(x: torch.Tensor) -> torch.Tensor:
        out = matrix.columns @ (weight * (matrix.rows @ x)) + ridge * x
        out[:M] += spread * roughness(band, roughness(band, x[:M]))
        return out

    scale = diagonal + ridge
    scale[:M] += 1.2 * spread
    right = matrix.columns @ (weight * start.evened(rgb, camera))
    colours = conjugate_gradients(product, right, start.colours, 1 / scale, steps)
    return camera_gains(Appearance(colours, start.gain, start.offset), matrix.rows @ colours,
                        rgb, camera, weight)  # fmt: skip


def conjugate_gradients(
    product: Callable[[torch.Tensor], torch.Tensor],
    right: torch.Tensor,
    x: torch.Tensor,
    scale: torch.Tensor,
    steps: int,
) -> torch.Tensor:
    """Solution of a positive definite system from ``x``, preconditioned by a diagonal ``scale``.

    Columns share their steps. Stops early where nothing is left to gain. Source: Hestenes and
    Stiefel 1952.
    """

    def dot(a: torch.Tensor, b: torch.Tensor) -> float:
        return float((a * b).sum(dtype=torch.float64))

    gap = right - product(x)
    z = scale * gap
    way, height = z, dot(gap, z)
    first = height
    for _ in range(steps):
        if not height > 1e-9 * max(first, 1e-30):
            break
        moved = product(way)
        step = height / max(dot(way, moved), 1e-30)
        x = x + step * way
        gap = gap - step * moved
        z = scale * gap
        height, last = dot(gap, z), height
        way = z + height / last * way
    return x


def camera_gains(
    look: Appearance,
    colours: torch.Tensor,
    rgb: torch.Tensor,
    camera: torch.Tensor,
    weight: torch.Tensor,
) -> Appearance:
    """The appearance with gains and offsets that take photographs (R, 3) to ``colours`` (R, 3).

    They are 1 and 0 on average over cameras, for the colours carry the rest; a camera that sees
    little, or whose gain is beyond belief, keeps what it had. ``weight`` is (R, 1).
    """
    sums = weight.new_zeros(len(look.gain), 1).index_add_(0, camera, weight)

    def mean(values: torch.Tensor) -> torch.Tensor:
        total = values.new_zeros(len(look.gain), 3).index_add_(0, camera, weight * values)
        return total / sums.clamp_min(1e-6)

    middle, level = mean(rgb), mean(colours)
    apart = rgb - middle[camera]
    spread = mean(apart**2)
    slope = mean(apart * (colours - level[camera])) / spread.clamp_min(1e-9)
    good = (spread > 1e-4) & (slope > 1 / MOST_GAIN) & (slope < MOST_GAIN) & (sums > FEWEST)
    gain = torch.where(good, slope, look.gain)
    gain = gain / gain.mean(0)
    offset = torch.where(good, level - gain * middle, look.offset)
    return Appearance(look.colours, gain, offset - offset.mean(0))
