"""Files of rendered training views: made once, deterministic by (seed, head model, number)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.head.model import HeadModel
from express50.landmarks.training.render import HeadScene, TrainingView
from express50.landmarks.training.skin import random_head

SIDE = 192
FILE_VIEWS = 300
# Each head is seen from every fifth of the range in which a face can be made out, and from behind.
FACE_YAW = np.radians(100.0)
VIEWS_A_HEAD = 6
_ARRAYS = {"rgba": np.uint8, "points": np.float32, "visible": np.bool_, "facing": np.float32}


@dataclass(frozen=True)
class ViewSet:
    """Rendered views.

    Attributes:
        rgba: (N, S, S, 4) uint8, black where empty.
        points: (N, 68, 2) pixels, corner origin.
        visible: (N, 68) bool, landmarks that the head does not hide.
        facing: (N,) cosine between the face's forward direction and the direction to the camera.
    """

    rgba: np.ndarray
    points: np.ndarray
    visible: np.ndarray
    facing: np.ndarray


def view_file(folder: Path, model_name: str, number: int, seed: int) -> Path:
    """Path of one file of views."""
    return folder / f"{model_name}-{seed}-{number:03d}.npz"


def draw_yaws(rng: np.random.Generator) -> np.ndarray:
    """Yaws (VIEWS_A_HEAD,) of one head's views, radians: even in front, the last from behind."""
    strata = VIEWS_A_HEAD - 1
    front = ((np.arange(strata) + rng.random(strata)) * 2 / strata - 1) * FACE_YAW
    return np.append(front, rng.uniform(FACE_YAW, 2 * np.pi - FACE_YAW))


def draw_views(model: HeadModel, count: int, rng: np.random.Generator) -> list[TrainingView]:
    """Render `count` views of random heads."""
    views: list[TrainingView] = []
    while len(views) < count:
        scene = HeadScene(model, random_head(model, rng))
        yaws = draw_yaws(rng)[: count - len(views)]
        views += [scene.render(rng, SIDE, float(yaw)) for yaw in yaws]
    return views


def stack_views(views: list[TrainingView]) -> ViewSet:
    """One set of rendered views."""
    return ViewSet(
        **{
            name: np.array([getattr(view, name) for view in views], dtype)
            for name, dtype in _ARRAYS.items()
        }
    )


def make_views(folder: Path, model: HeadModel, number: int, seed: int) -> Path:
    """Render one file of `FILE_VIEWS` views, unless it is there already."""
    path = view_file(folder, model.name, number, seed)
    if path.exists():
        return path
    rng = np.random.default_rng([seed, number, *model.name.encode()])
    views = stack_views(draw_views(model, FILE_VIEWS, rng))
    folder.mkdir(parents=True, exist_ok=True)
    # Two processes that happen to render the same file write the same bytes.
    part = path.with_suffix(f".{os.getpid()}.part")
    with part.open("wb") as file:
        np.savez(file, **vars(views))
    part.rename(path)
    return path


def read_views(path: Path) -> ViewSet:
    """Read a file of views."""
    with np.load(path, allow_pickle=False) as data:
        return ViewSet(**{name: data[name] for name in _ARRAYS})
