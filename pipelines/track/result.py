"""What the stage writes of a fit: track.npz and the metrics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from express50.errors import StageError
from express50.head.model import HeadModel, landmarks
from pipelines.track.observe import Marks
from pipelines.track.offsets import split_shape
from pipelines.track.outline import Outline
from pipelines.track.pinhole import project_pinhole
from pipelines.track.sparse_head import Basis
from pipelines.track.state import State, Target

SCHEMA = "express50.track/2"


def write_track(
    path: Path,
    head: str,
    basis: Basis,
    targets: list[Target],
    state: State,
    vertices: np.ndarray,
) -> None:
    """Write track.npz; no pickled objects."""
    own = np.stack([item.own for item in state.poses])
    count = basis.expression_size
    shape, offsets = split_shape(basis.model, state.shape)
    arrays = {
        "schema": np.array(SCHEMA),
        "head": np.array(head),
        "expressions": np.array([target.observation.expression for target in targets]),
        "frames": np.array([target.observation.frame for target in targets], dtype=np.int64),
        "shape": shape,
        "offsets": offsets.astype(np.float32),
        "expression": own[:, :count],
        "neck": own[:, count : count + 3],
        "jaw": own[:, count + 3 : count + 6],
        "eyes": own[:, count + 6 : count + 12],
        "R": np.stack([item.rotation for item in state.poses]),
        "t": own[:, -3:],
        "vertices": vertices.astype(np.float32),
    }
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StageError(f"{name} holds NaN or infinite values; the fit diverged")
    np.savez(path, **arrays)  # type: ignore[arg-type]  # numpy types its options only


def track_metrics(
    model: HeadModel, targets: list[Target], vertices: np.ndarray, dropped: list[dict[str, str]]
) -> dict:
    """Reprojection of inlier landmarks, RMS pixels by expression and camera."""
    marks = landmarks(model, torch.from_numpy(vertices)).numpy()
    table: dict[str, dict[str, float]] = {}
    used, total = 0, 0
    for target, points in zip(targets, marks, strict=True):
        row = {}
        for view, inliers in zip(target.observation.views, target.observation.inliers, strict=True):
            pixels, _ = project_pinhole(view.camera, points)
            squared = ((pixels - view.points) ** 2).sum(1)
            chosen = inliers.copy()
            chosen[:17] = False
            if chosen.any():
                row[view.camera_id] = round(float(np.sqrt(squared[chosen].mean())), 4)
            used, total = used + int(inliers.sum()), total + inliers.size
        table[target.observation.expression] = row
    values = [value for row in table.values() for value in row.values()]
    return {
        "expressions": len(targets),
        "landmark_rms_px": table,
        "landmark_rms_px_mean": round(float(np.mean(values)), 4) if values else None,
        "landmarks_used": used,
        "landmarks_seen": total,
        "outline_views": _count(targets, Outline),
        "marked_views": _count(targets, Marks),
        "head": model.name,
        "dropped": dropped,
    }


def _count(targets: list[Target], kind: type) -> int:
    return sum(isinstance(one, kind) for target in targets for one in target.outlines)
