"""Train the networks of `weights.npz`.

    python -m express50.landmarks.training.train --views DIR [--ict PATH] [--start WEIGHTS]

Trains on renders of random heads: of the procedural head and, if a path is given, of ICT-FaceKit.
No photograph of a person is used. The shipped file comes from both heads and several runs, each
with the weights of the one before as `--start`; docs/LOG.md has the commands. `--parts` trains only
these parts of given weights; all others, including batch normalisations, do not change. The result
depends on the arguments alone, up to rounding. An interrupted run continues from its last state in
DIR to the same result. `benchmarks.landmarks` measures the weights.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn import functional

from express50.contract.config import field_documents
from express50.head import BUILTIN_NAME
from express50.head.load import load_head
from express50.head.model import HeadModel
from express50.landmarks import WEIGHTS
from express50.landmarks.detector import close_window, cut_crop, place_crop, points_in_crop
from express50.landmarks.network import (
    CROP,
    LEFT_EYE,
    MIRROR,
    MOUTH,
    POINTS,
    CloseNet,
    LandmarkNet,
    Output,
    as_input,
    eye_net,
    mouth_net,
    save_network,
    trainable_network,
)
from express50.landmarks.training.descent import laplace_loss, minimise, place_loss
from express50.landmarks.training.random_heads import BLINKS, random_head
from express50.landmarks.training.scene import HeadScene, TrainingView
from express50.landmarks.training.views import (
    FILE_VIEWS,
    TrainingCrop,
    composite,
    degrade,
    made_once,
    make_backgrounds,
    open_views,
    random_crop,
)

BATCH = 32
RATE, RATE_ON = 2e-3, 1e-3  # from random weights, from given ones
FIRST_FILES = 6
STEPS_PER_FILE = 300
SIDE = 112  # pixels of a close-up
YAW = np.radians(75.0)
FILE_HEADS = 100
# Random errors of the crop, as landmarks have: share of its side, logarithm of its size, radians.
SHIFT, GROWTH, TURN = 0.05, 0.12, 0.08
Rng = np.random.Generator
SMALL_EVERY = 4  # after the small steps, one in this many stays small, for blurred faces


@dataclass(frozen=True)
class Part:
    """A part of the face for which there are close-ups."""

    name: str  # used in file names
    make: Callable[[], CloseNet]  # returns its untrained network
    sides: tuple[np.ndarray, ...]  # the landmarks of each close-up; the second close-up is mirrored
    frame_m: float  # width of a rendered view, metres
    blinks: float  # argument of `random_head`
    mouths: float  # argument of `random_head`
    views: int  # number per close-up of a head
    files: int  # number per head model, of `FILE_HEADS` heads each
    steps: int  # number of batches
    batch: int  # their size


# Most eyes blink. Most mouths are shut, slightly open, or show their teeth.
CLOSE_UPS = {
    "eyes": Part("eyes", eye_net, (LEFT_EYE, MIRROR[LEFT_EYE]), 0.09, 0.75, 0.0, 3, 4, 2500, 128),
    "mouth": Part("mouth", mouth_net, (MOUTH,), 0.12, BLINKS, 0.75, 6, 2, 2000, 96),
}
# The trunk, what finds points and faces with it, and the close-ups, which do not use it.
PARTS = ("trunk", "heat", "shape", "face", "outline", *CLOSE_UPS)


@dataclass(frozen=True)
class CloseView:
    """A rendered close-up."""

    image: np.ndarray  # (SIDE, SIDE, 3) uint8
    points: np.ndarray  # (68, 2) float32 pixels, corner origin, most of them outside
    side: np.int64  # index into the part's sides


@dataclass(frozen=True, kw_only=True)
class TrainingPlan:
    """Settings of a training run."""

    steps: int = 6000
    "Number of batches of 32 crops."
    small_steps: int = 3000
    "The first of these are at half resolution."
    files: int = 30
    "Files of views per head model."
    seed: int = 0
    "Seed of everything random."


def main(arguments: list[str] | None = None) -> int:
    """Render missing views, train, and save."""
    parser = argparse.ArgumentParser(
        prog="python -m express50.landmarks.training.train", description=__doc__
    )
    parser.add_argument("--views", type=Path, required=True, help="folder for rendered views")
    parser.add_argument("--ict", help="ICT-FaceKit checkout or .npz to train on as well")
    words = field_documents(TrainingPlan)
    for name, value in vars(TrainingPlan()).items():
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=int, default=value, help=words[name])
    parser.add_argument("--start", type=Path, help="weights to start from")
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=PARTS, help="what to train; all by default"
    )
    parser.add_argument("--out", type=Path, default=WEIGHTS)
    options = parser.parse_args(arguments)
    if options.start is None and set(options.parts) != set(PARTS):
        parser.error("--parts needs --start, the weights of the other parts")
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    models = [load_head(spec) for spec in (BUILTIN_NAME, options.ict) if spec]
    plan = TrainingPlan(**{name: getattr(options, name) for name in words})
    net = train(models, plan, options.views, options.start, options.parts)
    for name in set(options.parts) & set(CLOSE_UPS):
        setattr(net, name, train_part(CLOSE_UPS[name], models, options.views, plan.seed))
    save_network(net, options.out)
    return 0


def start_network(start: Path | None, parts: Sequence[str]) -> LandmarkNet:
    """Return a network with the given weights, ready to train some of its parts."""
    net = LandmarkNet(whole=True)
    if start is not None:
        net.load_state_dict(trainable_network(start).state_dict(), strict=False)
    for name, module in net.named_children():
        part = name if name in PARTS else "trunk"
        module.train(part in parts).requires_grad_(part in parts)
    return net.to(memory_format=torch.channels_last)


def train(
    models: list[HeadModel],
    plan: TrainingPlan,
    folder: Path,
    start: Path | None = None,
    parts: Sequence[str] = PARTS,
) -> LandmarkNet:
    """Train on views of the head models; the folder keeps the views and the run's state."""
    torch.manual_seed(plan.seed)
    backgrounds = make_backgrounds(400, np.random.default_rng([plan.seed, 1]))
    net = start_network(start, parts)
    begun = hashlib.sha256(start.read_bytes()).hexdigest()[:8] if start else "anew"
    chosen = [] if set(parts) == set(PARTS) else sorted(parts)
    values = (str(value) for value in astuple(plan))
    name = "-".join([*(m.name for m in models), *values, begun, *chosen])
    sets: list[list[TrainingView]] = []

    def loss_at(step: int) -> torch.Tensor:
        # Few files at first, so that training starts early.
        files = min(plan.files, FIRST_FILES + step // STEPS_PER_FILE)
        while len(sets) < len(models) * files:
            number = 1 + len(sets) // len(models)
            sets.append(open_views(folder, models[len(sets) % len(models)], number, plan.seed))
        # Seeded by the step, so that a continued run draws the same crops.
        rng = np.random.default_rng([plan.seed, 2, step])
        small = step < plan.small_steps or step % SMALL_EVERY == 0
        size = CROP // 2 if small else CROP
        picks = np.divmod(rng.integers(len(sets) * FILE_VIEWS, size=BATCH), FILE_VIEWS)
        crops = [
            random_crop(sets[file][view], backgrounds, rng, size)
            for file, view in zip(*picks, strict=True)
        ]
        return crop_loss(net, crops)

    rate, steps = RATE_ON if start else RATE, plan.steps if set(parts) - set(CLOSE_UPS) else 0
    return minimise(net, steps, rate, folder / f"training-{name}.pt", loss_at)


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
        images = as_input(np.stack(crops))
        found, log_scale = net(images)
        return laplace_loss(found, log_scale, torch.from_numpy(np.stack(points)))[0].mean()

    names = "-".join(model.name for model in models)
    state = folder / f"{part.name}-training-{names}-{seed}.pt"
    return minimise(net, part.steps, RATE, state, loss_at)


def crop_loss(net: LandmarkNet, crops: list[TrainingCrop]) -> torch.Tensor:
    """Return the loss of a batch: that of points and outline, and entropies of both logits."""
    images = torch.from_numpy(np.stack([crop.image for crop in crops])).permute(0, 3, 1, 2)
    with torch.autocast("cpu", torch.bfloat16):
        output: Output = net(images.contiguous(memory_format=torch.channels_last).float() / 255.0)
    points = torch.from_numpy(np.stack([crop.points for crop in crops]))
    marks, outline = points.tensor_split((POINTS,), dim=1)
    visible = torch.from_numpy(np.stack([crop.visible for crop in crops]))
    seen = functional.binary_cross_entropy_with_logits(output.seen, visible, reduction="none")
    weight = torch.tensor([crop.weight for crop in crops])
    share = weight / weight.sum().clamp_min(1.0)
    loss, _ = place_loss(output.points, output.log_scale, output.heat, marks)
    loss = (loss + 0.5 * seen).mean(1) * share
    edge = output.outline, output.outline_log_scale, output.outline_heat
    loss = loss + 0.5 * place_loss(*edge, outline)[0].mean(1) * share
    score = torch.tensor([crop.score for crop in crops])
    return loss.sum() + functional.binary_cross_entropy_with_logits(output.logit, score)


if __name__ == "__main__":
    raise SystemExit(main())
