"""Add teeth and the inside of the mouth to heads of FLAME's topology, which have neither.

FLAME has 5023 vertices, two rings of 15 vertices around the lips, paired by index, and an open loop
of 32 vertices at the back of the lips. The 120 tooth vertices have the order and places that VHAP
and GaussianAvatars use, so that their parameters and ours give the same first 5143 vertices.
Triangles, texture map and the pouch that closes the loop behind the teeth (65 more vertices) are
our own. GRMM's supplement asks for teeth and pouch, each with its own part of the texture map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from express50.errors import HeadModelError
from express50.geometry.meshes import open_edges
from express50.head.model import JOINTS, HeadModel

FLAME_VERTICES, TOOTH_VERTICES = 5023, 120
# Outer rings of the lips from one corner to the other; VHAP's vertex ids.
UPPER_RING = (
    1713, 1715, 1716, 1735, 1696, 1694, 1657, 3543, 2774, 2811, 2813, 2850, 2833, 2832, 2830,
)  # fmt: skip
LOWER_RING = (
    1576, 1577, 1773, 1774, 1795, 1802, 1865, 3503, 2948, 2905, 2898, 2881, 2880, 2713, 2712,
)  # fmt: skip
CORNERS = (1594, 2730)  # of the loop at the back of the lips
LOOP_SIZE = 32
# The rows of 15 tooth vertices, in order: jaw (0 upper, 1 lower), whether root, whether back.
_ROWS = ((0, 1, 0), (1, 1, 0), (0, 0, 0), (1, 0, 0), (0, 1, 1), (0, 0, 1), (1, 1, 1), (1, 0, 1))
# Each jaw's rows as a strip: front root, front edge, back edge, back root.
_AROUND = ((0, 2, 5, 4), (1, 3, 7, 6))
# Heights and depths in units of the mean distance between the rings.
_INSET, _GAP, _ROOT, _OVERJET, _THICK = 1.5, 0.1, 2.0, 0.4, 1.0
_LIPS = (0.002, 0.03)  # mean distances between the rings, metres; FLAME's template has 7.7 mm
# The pouch: copies of the loop, shrunk to its middle and set back, then one end vertex.
_POUCH = ((1.0, 0.012), (0.7, 0.026), (0.0, 0.034))  # share of the loop's width, metres behind it
_STRIP_V = (0.0, 0.4, 0.6, 1.0)  # heights of a jaw's rows in its chart
# Largest charts (width, height), on the unit square, of pouch, upper and lower teeth.
_CHARTS = ((0.18, 0.18), (0.2, 0.12), (0.2, 0.12))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """Vertices to append to a model; their directions are means of the model's own."""

    places: torch.Tensor  # (N, 3) metres, in the template
    shape_from: torch.Tensor  # (N, V) weights of the model's vertices, rows sum to 1
    motion_from: torch.Tensor  # the same for expression, pose, skinning; 0 if the part is rigid
    skinning: torch.Tensor  # (N, J) if the part is rigid, else 0
    faces: torch.Tensor  # (F, 3) into the whole model
    uv: torch.Tensor  # (T, 2)
    uv_faces: torch.Tensor  # (F, 3), from 0


def add_mouth(model: HeadModel) -> HeadModel:
    """Add teeth and a pouch behind them to a model of FLAME's vertices; old ids and joints stay.

    Upper teeth follow the neck joint, lower teeth the jaw. Both do not move in expressions, and
    change with the identity as the lips in front do. The pouch follows the loop it hangs on.

    Raises:
        HeadModelError: the model's lips are not FLAME's, or its texture map has no room.
    """
    charts = place_charts(model.uv.numpy(), model.uv_faces.numpy(), _CHARTS, model.name)
    teeth = _teeth(model, charts[1:])
    pouch = _pouch(model, charts[0])
    count = len(model.template)
    model = _appended(_appended(model, teeth), pouch)
    number = torch.arange(len(model.template)) - count
    row_jaw = torch.tensor([jaw for jaw, _, _ in _ROWS]).repeat_interleave(15)
    jaw = torch.full((len(number),), -1)
    jaw[count : count + TOOTH_VERTICES] = row_jaw
    masks = {
        "upper_teeth": jaw == 0,
        "lower_teeth": jaw == 1,
        "teeth": jaw >= 0,
        "mouth_interior": number >= TOOTH_VERTICES,
    }
    regions = {name: mask | masks.get(name, mask) for name, mask in model.regions.items()}
    return replace(model, name=f"{model.name}+mouth", regions=masks | regions)


def _teeth(model: HeadModel, charts: tuple[np.ndarray, ...]) -> _Part:
    """Make two arches of 15 columns: a strip in front, one behind, and the edge between them."""
    upper, lower = (model.template[list(ring)].double() for ring in (UPPER_RING, LOWER_RING))
    unit = float((upper - lower).norm(dim=1).mean())
    if not _LIPS[0] < unit < _LIPS[1]:
        raise HeadModelError(
            f"head model {model.name!r}: its lips' rings are {1e3 * unit:.3g} mm apart, expected"
            f" {1e3 * _LIPS[0]:g} to {1e3 * _LIPS[1]:g}; give FLAME's vertices in metres"
        )
    middle = 0.5 * (upper + lower)
    middle[:, 1] = middle[:, 1].mean()
    middle[:, 2] -= _INSET * unit
    places = []
    for jaw, root, back in _ROWS:
        up = 1.0 - 2.0 * jaw
        row = middle.clone()
        row[:, 1] += up * unit * (_GAP + _ROOT * root)
        row[:, 2] -= unit * (_OVERJET * jaw + _THICK * back)
        places.append(row)
    shape_from = torch.zeros(15, len(model.template))
    for ring in (UPPER_RING, LOWER_RING):
        shape_from[torch.arange(15), list(ring)] += 0.5
    bone = torch.tensor([JOINTS.index("jaw" if jaw else "neck") for jaw, _, _ in _ROWS])
    skinning = torch.nn.functional.one_hot(bone, len(JOINTS)).repeat_interleave(15, 0)
    # Seen from the front, columns that start at the subject's left run from right to left.
    from_left = bool(upper[0, 0] > upper[-1, 0])
    strips, uv_strips, uv = [], [], []
    for jaw, rows in enumerate(_AROUND):
        flip = from_left == bool(jaw)
        strips.append(_strip(rows, flip))
        uv_strips.append(_strip(range(4 * jaw, 4 * jaw + 4), flip))
        left, bottom, right, top = charts[jaw]
        u = np.linspace(left, right, 15)[:: -1 if from_left else 1]
        share = np.array(_STRIP_V) if jaw else 1 - np.array(_STRIP_V)
        v = bottom + share * (top - bottom)
        uv.append(np.stack(np.broadcast_arrays(u, v[:, None]), -1).reshape(-1, 2))
    return _Part(
        places=torch.cat(places),
        shape_from=shape_from.repeat(8, 1),
        motion_from=torch.zeros(TOOTH_VERTICES, len(model.template)),
        skinning=skinning,
        faces=torch.from_numpy(np.concatenate(strips)) + len(model.template),
        uv=torch.from_numpy(np.concatenate(uv)),
        uv_faces=torch.from_numpy(np.concatenate(uv_strips)),
    )


def _strip(rows: tuple[int, ...] | range, flip: bool) -> np.ndarray:
    """Return the triangles (84, 3) between consecutive rows of 15 vertices."""
    grid = 15 * np.asarray(rows)[:, None] + np.arange(15)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
    return faces[:, ::-1].copy() if flip else faces


def _pouch(model: HeadModel, chart: np.ndarray) -> _Part:
    """Make the rings behind the loop at the back of the lips, and one end vertex."""
    loop = torch.from_numpy(mouth_loop(model.faces.numpy(), model.name))
    size, first = len(loop), len(model.template) + TOOTH_VERTICES
    own = torch.nn.functional.one_hot(loop, len(model.template)).double()
    mean = own.mean(0, keepdim=True).expand_as(own)
    weights, places = [], []
    for share, depth in _POUCH:
        ring = share * own + (1 - share) * mean
        ring = ring if share else ring[:1]
        place = ring @ model.template.double()
        place[:, 2] -= depth
        weights.append(ring)
        places.append(place)
    combined = torch.cat(weights).float()
    steps = np.concatenate([np.arange(size), np.arange(2 * size + 1) + size])
    ids = np.concatenate([loop.numpy(), first + np.arange(2 * size + 1)])
    # Three rings and the end vertex, numbered in that order, make a funnel.
    k, after = np.arange(size), np.roll(np.arange(size), -1)
    corners = (k, after, size + after), (k, size + after, size + k)
    sides = [np.stack(three, -1) + ring for ring in (0, size) for three in corners]
    tip = np.stack([2 * size + k, 2 * size + after, np.full(size, 3 * size)], -1)
    faces = np.concatenate([*sides, tip])
    # In the chart the rings are concentric circles.
    angle = 2 * np.pi * np.arange(size) / size
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    rings = np.concatenate([circle, circle * 2 / 3, circle / 3, np.zeros((1, 2))])
    middle, half = 0.5 * (chart[:2] + chart[2:]), 0.5 * (chart[2:] - chart[:2])
    return _Part(
        places=torch.cat(places),
        shape_from=combined,
        motion_from=combined,
        skinning=torch.zeros(len(combined), len(JOINTS)),
        faces=torch.from_numpy(ids[faces]),
        uv=torch.from_numpy(middle + half * rings),
        uv_faces=torch.from_numpy(steps[faces]),
    )


def mouth_loop(faces: np.ndarray, name: str) -> np.ndarray:
    """Return the ids (32,) of the open loop behind the lips, in the order of new faces along it.

    It starts at the first of CORNERS.

    Raises:
        HeadModelError: the faces (F, 3) have no such loop.
    """
    # The face on the other side of an edge runs along it in the opposite direction.
    following = {int(b): int(a) for a, b in open_edges(faces)}
    loop = [CORNERS[0]]
    while len(loop) <= LOOP_SIZE and (after := following.get(loop[-1])) not in (None, loop[0]):
        loop.append(after)
    if len(loop) != LOOP_SIZE or CORNERS[1] not in loop:
        raise HeadModelError(
            f"head model {name!r}: no open loop of {LOOP_SIZE} vertices through {CORNERS[0]} and"
            f" {CORNERS[1]} behind the lips, expected FLAME's topology; give FLAME's own faces"
        )
    return np.array(loop)


def _appended(model: HeadModel, part: _Part) -> HeadModel:
    """Return the model with a part's vertices, faces and chart appended."""
    count, added = len(model.template), len(part.places)
    # Parts are made for the bare head: vertices appended since then have no weight.
    room = count - part.shape_from.shape[1]
    shape_from, motion_from = (
        torch.nn.functional.pad(weights, (0, room)).to(model.dtype)
        for weights in (part.shape_from, part.motion_from)
    )
    pose = model.pose_dirs.reshape(-1, count, 3)
    pose = torch.cat([pose, torch.einsum("nv,pvc->pnc", motion_from, pose)], 1)
    skinning = part.skinning.to(model.dtype) + motion_from @ model.skinning
    blank = torch.zeros(added, dtype=torch.bool)
    return replace(
        model,
        template=torch.cat([model.template, part.places.to(model.dtype)]),
        shape_dirs=_extended(model.shape_dirs, shape_from),
        expression_dirs=_extended(model.expression_dirs, motion_from),
        pose_dirs=pose.flatten(1),
        joint_regressor=torch.nn.functional.pad(model.joint_regressor, (0, added)),
        skinning=torch.cat([model.skinning, skinning]),
        faces=torch.cat([model.faces, part.faces]),
        uv=torch.cat([model.uv, part.uv.to(model.dtype)]),
        uv_faces=torch.cat([model.uv_faces, part.uv_faces + len(model.uv)]),
        regions={name: torch.cat([mask, blank]) for name, mask in model.regions.items()},
    )


def _extended(directions: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return directions (V, 3, K) with those of appended vertices, weighted means of the old."""
    return torch.cat([directions, torch.einsum("nv,vck->nck", weights, directions)])


GRID = 512  # cells per side of the search
GUTTER = 3  # cells kept free around a chart, so that neighbours do not bleed into each other
SHRINK, LEAST = 0.9, 0.15  # factor between tries, and the least accepted share of a wanted size


def place_charts(
    uv: np.ndarray, uv_faces: np.ndarray, sizes: Sequence[tuple[float, float]], name: str
) -> tuple[np.ndarray, ...]:
    """Find free rectangles (left, bottom, right, top), one per wanted (width, height).

    Earlier ones get more room. Each is shrunk until it fits, and takes the first free place from
    the top of the map, which is ``uv`` (T, 2), v up, of ``uv_faces`` (F, 3).

    Raises:
        HeadModelError: a chart does not fit even at LEAST of its size.
    """
    # Cells that triangles touch; the first row is at v = 1.
    cells = np.zeros((GRID, GRID), np.uint8)
    places = np.stack([uv[:, 0], 1 - uv[:, 1]], -1) * GRID
    for triangle in np.floor(places).clip(0, GRID - 1).astype(np.int32)[uv_faces]:
        cv2.fillConvexPoly(cells, triangle, 1)
    taken = cv2.dilate(cells, np.ones((2 * GUTTER + 1,) * 2, np.uint8)) > 0
    taken[:GUTTER] = taken[-GUTTER:] = taken[:, :GUTTER] = taken[:, -GUTTER:] = True
    found = []
    for width, height in sizes:
        box = _first_free(taken, width * GRID, height * GRID)
        if box is None:
            raise HeadModelError(
                f"head model {name!r}: its texture map has no room for a mouth; leave a free"
                " corner in the template's map"
            )
        row, column, rows, columns = box
        around = slice(max(0, row - GUTTER), row + rows + GUTTER)
        taken[around, max(0, column - GUTTER) : column + columns + GUTTER] = True
        # Cells count down from the top, v counts up.
        bottom, top = GRID - row - rows, GRID - row
        found.append(np.array([column, bottom, column + columns, top]) / GRID)
    return tuple(found)


def _first_free(taken: np.ndarray, width: float, height: float) -> tuple[int, int, int, int] | None:
    """Find the largest free rectangle among the tried sizes: row, column, rows and columns."""
    scale = 1.0
    while scale >= LEAST:
        rows, columns = max(2, round(height * scale)), max(2, round(width * scale))
        window = np.ones((rows, columns), np.uint8)
        inside = cv2.dilate(taken.astype(np.uint8), window, anchor=(0, 0))
        free = np.argwhere(inside[: GRID - rows + 1, : GRID - columns + 1] == 0)
        if len(free):
            return int(free[0, 0]), int(free[0, 1]), rows, columns
        scale *= SHRINK
    return None
