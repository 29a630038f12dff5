"""Train the networks for eyes and mouth of `weights.npz` on close-ups of rendered heads.

Most eyes blink. Most mouths are shut, slightly open, or show their teeth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from express50.head.model import HeadModel
from express50.landmarks.detector import close_window, cut_crop, place_crop, points_in_crop
from express50.landmarks.network import (
    LEFT_EYE,
    MIRROR,
    MOUTH,
    POINTS,
    CloseNet,
    eye_net,
    mouth_net,
)
from express50.landmarks.training.descent import descend, laplace_loss
from express50.landmarks.training.random_heads import BLINKS, random_head
from express50.landmarks.training.scene import HeadScene
from express50.landmarks.training.views import composite, degrade, made_once, make_backgrounds

SIDE = 112  # pixels of a close-up
YAW = np.radians(75.0)
FILE_HEADS = 100
# Random errors of the crop, as landmarks have: share of its side, logarithm of its size, radians.
SHIFT, GROWTH, TURN = 0.05, 0.12, 0.08
RATE = 2e-3
Rng = np.random.Generator


@dataclass(frozen=True)
class Part:
    """A part of the face for which there are close-ups.

    Attributes:
        name: used in file names.
        make: returns its untrained network.
        sides: the landmarks of each close-up; the second close-up is mirrored.
        frame_m: width of a rendered view, metres.
        blinks, mouths: arguments of `random_head`.
        views: number per close-up of a head.
        files: number per head model, of `FILE_HEADS` heads each.
        steps, batch: number of batches, and their size.
    """

    name: str
    make: Callable[[], CloseNet]
    sides: tuple[np.ndarray, ...]
    frame_m: float
    blinks: float
    mouths: float
    views: int
    files: int
    steps: int
    batch: int


PARTS = {
    "eyes": Part("eyes", eye_net, (LEFT_EYE, MIRROR[LEFT_EYE]), 0.09, 0.75, 0.0, 3, 4, 2500, 128),
    "mouth": Part("mouth", mouth_net, (MOUTH,), 0.12, BLINKS, 0.75, 6, 2, 2000, 96),
}


@dataclass(frozen=True)
class CloseView:
    """A rendered close-up."""

    image: np.ndarray  # (SIDE, SIDE, 3) uint8
    points: np.ndarray  # (68, 2) float32 pixels, corner origin, most of them outside
    side: np.int64  # index into the part's sides


def draw_close_ups(part: Part, model: HeadModel, heads: int, rng: Rng) -> list[CloseView]:
    """Render close-ups of random heads."""
    backgrounds, views = make_backgrounds(30, rng), []
    for _ in range(heads):
        scene = HeadScene(model, random_head(model, rng, part.blinks, part.mouths))
        for side, ids in enumerate(part.sides):
            middle = scene.head.landmarks[ids].mean(0)
            for yaw in rng.uniform(-YAW, YAW, part.views):
                view = scene.render(rng, SIDE, float(yaw), (middle, part.frame_m))
                behind = backgrounds[rng.integers(len(backgrounds))][:SIDE, :SIDE]
                image = composite(view.rgba, np.eye(2, 3), behind)
                views.append(CloseView(image, view.points[:POINTS], np.int64(side)))
    return views


def close_crop(
    part: Part, net: CloseNet, view: CloseView, rng: Rng
) -> tuple[np.ndarray, np.ndarray]:
    """Cut a degraded crop (S, S, 3) uint8 as the detector does; also return its points (N, 2)."""
    ids, flipped = part.sides[view.side], bool(view.side)
    if len(part.sides) == 1 and rng.random() < 0.5:
        ids, flipped = MIRROR[ids], True
    window = close_window(net, view.points.astype(np.float64), ids, flipped)
    angle = rng.normal() * TURN
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = window[:, :2] @ turn * np.exp(rng.normal() * GROWTH)
    middle = window @ np.array([net.crop / 2, net.crop / 2, 1.0])
    middle = middle + turn @ (rng.normal(size=2) * SHIFT * net.crop)
    window = place_crop(middle, turn, net.crop)
    points = points_in_crop(window, view.points[ids])
    return degrade(cut_crop(view.image, window, net.crop), rng), points.astype(np.float32)


def train_part(part: Part, models: list[HeadModel], folder: Path, seed: int) -> CloseNet:
    """Train a part's network on close-ups of head models; the folder keeps these and the state."""
    torch.manual_seed(seed)
    views: list[CloseView] = []
    for model in models:
        for number in range(part.files):
            rng = np.random.default_rng([seed, 7, number, *model.name.encode()])
            path = folder / f"{part.name}-{model.name}-{seed}-{number:03d}.npz"
            draw = partial(draw_close_ups, part, model, FILE_HEADS, rng)
            views += made_once(path, CloseView, draw)
    net = part.make().train()

    def loss_at(step: int) -> torch.Tensor:
        rng = np.random.default_rng([seed, 8, step])
        picks = rng.integers(len(views), size=part.batch)
        crops, points = zip(*(close_crop(part, net, views[k], rng) for k in picks), strict=True)
        images = torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float() / 255.0
        found, log_scale = net(images)
        return laplace_loss(found, log_scale, torch.from_numpy(np.stack(points)))[0].mean()

    names = "-".join(model.name for model in models)
    state = folder / f"{part.name}-training-{names}-{seed}.pt"
    return descend(net, part.steps, RATE, state, loss_at)
