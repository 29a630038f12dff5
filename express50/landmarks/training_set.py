"""Files of rendered training views: made once, deterministic by (seed, head model, number)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.head.model import HeadModel
from express50.landmarks.synthetic import HeadScene, random_head

SIDE = 208
VIEWS_A_HEAD = 5


@dataclass(frozen=True)
class ViewSet:
    """Rendered views: rgba (N, SIDE, SIDE, 4) uint8, points (N, 68, 2) pixels, facing (N,)."""

    rgba: np.ndarray
    points: np.ndarray
    facing: np.ndarray


def view_file(folder: Path, model_name: str, number: int) -> Path:
    """Path of one file of views."""
    return folder / f"{model_name}-{number:03d}.npz"


def make_views(folder: Path, model: HeadModel, number: int, count: int, seed: int) -> Path:
    """Render `count` views of random heads into one file, unless it is there already."""
    path = view_file(folder, model.name, number)
    if path.exists():
        return path
    rng = np.random.default_rng([seed, number, *model.name.encode()])
    views: list = []
    while len(views) < count:
        scene = HeadScene(model, random_head(model, rng))
        # The last of each head's views comes from anywhere, backs of heads included.
        for view in range(min(VIEWS_A_HEAD, count - len(views))):
            views.append(scene.render(rng, SIDE, turned=view >= VIEWS_A_HEAD - 2))
    folder.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(
            file,
            rgba=np.stack([view.rgba for view in views]),
            points=np.stack([view.points for view in views]).astype(np.float32),
            facing=np.array([view.facing for view in views], np.float32),
        )
    part.rename(path)
    return path


def read_views(paths: list[Path]) -> ViewSet:
    """Read files of views into one set."""
    parts = [np.load(path) for path in paths]
    return ViewSet(
        *(np.concatenate([part[key] for part in parts]) for key in ("rgba", "points", "facing"))
    )
