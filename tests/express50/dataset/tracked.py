"""Track files for tests: what the track stage writes, posed from random parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from express50.geometry.transforms_torch import axis_angle_to_matrix
from express50.head.load import load_head
from express50.head.model import HeadModel, pose

EXPRESSIONS = ("neutral", "smile")


def track_arrays(
    head: str | Path,
    expressions: tuple[str, ...] = EXPRESSIONS,
    seed: int = 0,
    offsets_mm: float = 3.0,
    turn: float = 1.0,
) -> dict[str, np.ndarray]:
    """Arrays of a track with schema 2 whose vertices belong to its parameters, offsets included."""
    model, rng, count = load_head(head), np.random.default_rng(seed), len(expressions)
    shape = 0.5 * rng.normal(size=min(4, model.shape_dirs.shape[2]))
    size = min(3, model.expression_dirs.shape[2])
    expression = rng.uniform(0, 0.5, (count, size))
    angles = {name: 0.1 * rng.normal(size=(count, k)) for name, k in
              (("neck", 3), ("jaw", 3), ("eyes", 6))}  # fmt: skip
    offsets = 1e-3 * offsets_mm * rng.normal(size=(len(model.template), 3))
    R = axis_angle_to_matrix(torch.from_numpy(turn * rng.normal(size=(count, 3)))).numpy()
    t = np.array([0.3, -1.2, 2.0]) + 0.1 * rng.normal(size=(count, 3))
    arrays = {"shape": shape, "expression": expression, **angles, "R": R, "t": t}
    return {
        "schema": np.array("express50.track/2"),
        "head": np.array(str(head)),
        "expressions": np.array(expressions),
        "frames": np.arange(count),
        **arrays,
        "vertices": world_vertices(model, arrays, offsets).astype(np.float32),
        "offsets": offsets.astype(np.float32),
    }


def world_vertices(
    model: HeadModel, arrays: dict[str, np.ndarray], offsets: np.ndarray
) -> np.ndarray:
    """World vertices (E, V, 3) float64 of a track's parameters."""
    exact = model.to(dtype=torch.float64)
    parts = {
        name: torch.from_numpy(np.asarray(arrays[name], np.float64))
        for name in ("expression", "neck", "jaw", "eyes")
    }
    shape = torch.from_numpy(arrays["shape"])[None].expand(len(arrays["R"]), -1)
    head = pose(exact, shape, **parts, offsets=torch.from_numpy(offsets)[None].double()).numpy()
    return np.einsum("eij,evj->evi", arrays["R"], head) + arrays["t"][:, None]


def write_track(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Write the arrays as the stage does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)
    return path
