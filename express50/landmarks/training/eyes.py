"""Train the eyes' network of `weights.npz` on close-ups of rendered eyes, most of them blinking."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from express50.head.model import HeadModel
from express50.landmarks.detector import cut_crop, eye_window
from express50.landmarks.network import (
    EYE_CROP,
    LEFT_EYE,
    MIRROR,
    POINTS,
    EyeNet,
)
from express50.landmarks.training.descent import descend
from express50.landmarks.training.random_heads import random_head
from express50.landmarks.training.scene import HeadScene
from express50.landmarks.training.views import composite, made_once, make_backgrounds, spoil

SIDE, FRAME_M = 112, 0.09  # of a close-up
YAW = np.radians(75.0)
VIEWS_PER_EYE, FILE_HEADS, BLINKS = 3, 100, 0.75
STEPS, FILES = 2500, 4  # batches in all, files of close-ups per head model
BATCH, RATE = 128, 2e-3
# The crop is off by what the face's landmarks may be: shares of its side, factor, radians.
SHIFT, GROWTH, TURN = 0.05, 0.12, 0.08
Rng = np.random.Generator


@dataclass(frozen=True)
class EyeView:
    """A close-up of an eye; a right eye and its points are stored as they are."""

    image: np.ndarray  # (SIDE, SIDE, 3) uint8
    points: np.ndarray  # (68, 2) float32 pixels, corner origin, most of them outside
    left: np.bool_


def draw_eyes(model: HeadModel, heads: int, rng: Rng) -> list[EyeView]:
    """Render close-ups of both eyes of random heads."""
    backgrounds, views = make_backgrounds(30, rng), []
    for _ in range(heads):
        scene = HeadScene(model, random_head(model, rng, BLINKS))
        for left in (True, False):
            ids = LEFT_EYE if left else MIRROR[LEFT_EYE]
            middle = scene.head.landmarks[ids].mean(0)
            for yaw in rng.uniform(-YAW, YAW, VIEWS_PER_EYE):
                view = scene.render(rng, SIDE, float(yaw), (middle, FRAME_M))
                behind = backgrounds[rng.integers(len(backgrounds))][:SIDE, :SIDE]
                image = composite(view.rgba, np.eye(2, 3), behind)
                views.append(EyeView(image, view.points[:POINTS], np.bool_(left)))
    return views


def eye_crop(view: EyeView, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Cut a crop (48, 48, 3) uint8 as the detector does, spoiled; points (6, 2) in it."""
    window = eye_window(view.points.astype(np.float64), bool(view.left))
    angle = rng.normal() * TURN
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = window[:, :2] @ turn * np.exp(rng.normal() * GROWTH)
    middle = window @ np.array([EYE_CROP / 2, EYE_CROP / 2, 1.0])
    middle = middle + turn @ (rng.normal(size=2) * SHIFT * EYE_CROP)
    window = np.column_stack([turn, middle - turn @ np.full(2, EYE_CROP / 2)])
    ids = LEFT_EYE if view.left else MIRROR[LEFT_EYE]
    points = (view.points[ids] - window[:, 2]) @ np.linalg.inv(turn).T
    return spoil(cut_crop(view.image, window, EYE_CROP), rng), points.astype(np.float32)


def train_eyes(models: list[HeadModel], folder: Path, seed: int) -> EyeNet:
    """Train on close-ups of the head models; these and the run's state are kept in a folder."""
    torch.manual_seed(seed)
    views: list[EyeView] = []
    for model in models:
        for number in range(FILES):
            rng = np.random.default_rng([seed, 7, number, *model.name.encode()])
            path = folder / f"eyes-{model.name}-{seed}-{number:03d}.npz"
            views += made_once(path, EyeView, partial(draw_eyes, model, FILE_HEADS, rng))
    net = EyeNet().train()

    def loss_at(step: int) -> torch.Tensor:
        rng = np.random.default_rng([seed, 8, step])
        picks = rng.integers(len(views), size=BATCH)
        crops, points = zip(*(eye_crop(views[pick], rng) for pick in picks), strict=True)
        images = torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float() / 255.0
        found, log_scale = net(images)
        # The slope at zero distance is bounded by the added 0.01 px^2.
        distance = (found - torch.from_numpy(np.stack(points))).square().sum(-1).add(0.01).sqrt()
        return (0.2 * distance + 2 * log_scale + distance * torch.exp(-log_scale)).mean()

    names = "-".join(model.name for model in models)
    return descend(net, STEPS, RATE, folder / f"eyes-training-{names}-{seed}.pt", loss_at)
