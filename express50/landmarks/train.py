"""Make `weights.npz`: `python -m express50.landmarks.train --views DIR [--ict PATH]`.

Trains on renders of random heads only (`synthetic.py`): the procedural head and, where a path is
given, ICT-FaceKit. No photograph of a person is used. The result depends on the
arguments alone; the shipped file came from several runs in a row (docs/LOG.md).
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from express50.head.load import load_head
from express50.landmarks.augment import Crop, make_backgrounds, random_crop
from express50.landmarks.network import (
    WEIGHTS,
    LandmarkNet,
    heat_loss,
    load_network,
    save_network,
)
from express50.landmarks.training_set import ViewSet, make_views, read_views

FILE_VIEWS = 500
BATCH = 32


def main(arguments: list[str] | None = None) -> int:
    """Render what is missing, train, save and report the error on held-out heads."""
    parser = argparse.ArgumentParser(
        prog="python -m express50.landmarks.train", description=__doc__
    )
    parser.add_argument("--views", type=Path, required=True, help="folder for rendered views")
    parser.add_argument("--ict", help="ICT-FaceKit checkout or .npz to train on as well")
    parser.add_argument("--files", type=int, default=12, help="files of 500 views a head model")
    parser.add_argument("--steps", type=int, default=3000, help="batches of 32 crops")
    parser.add_argument("--start", type=Path, help="weights to go on from")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=WEIGHTS)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    train_files, held_out = [], {}
    for spec in ["procedural", *([options.ict] if options.ict else [])]:
        model = load_head(spec)
        files = [
            make_views(options.views, model, number, FILE_VIEWS, options.seed)
            for number in range(options.files + 1)
        ]
        train_files += files[1:]
        held_out[model.name] = read_views(files[:1])
    net = train(read_views(train_files), options.steps, options.seed, options.start, options.out)
    for name, views in held_out.items():
        print(f"{name}: held-out heads {validate(net, views, options.seed)}")
    return 0


def train(views: ViewSet, steps: int, seed: int, start: Path | None, out: Path) -> LandmarkNet:
    """Train on views; weights are saved every 200 steps and at the end."""
    torch.manual_seed(seed)
    rng = np.random.default_rng([seed, 1])
    backgrounds = make_backgrounds(400, rng)
    net = load_network(start) if start else LandmarkNet()
    net = net.train().to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(net.parameters(), lr=1e-3, weight_decay=1e-3)
    began, losses = time.monotonic(), []
    for step in range(steps):
        # Warm up over 100 steps, then a cosine down to one hundredth.
        rate = min(1.0, (step + 1) / 100) * (0.505 + 0.495 * math.cos(math.pi * step / steps))
        optimiser.param_groups[0]["lr"] = (1.5e-3 if start else 2.5e-3) * rate
        picks = rng.integers(len(views.facing), size=BATCH)
        loss = crop_loss(net, [random_crop(views, i, backgrounds, rng) for i in picks])
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        optimiser.step()
        losses.append(loss.item())
        if (step + 1) % 50 == 0:
            seconds = (time.monotonic() - began) / (step + 1)
            print(f"step {step + 1}: loss {np.mean(losses[-50:]):.3f}, {seconds:.2f} s", flush=True)
        if (step + 1) % 200 == 0 or step + 1 == steps:
            save_network(net, out)
    return load_network(out)


def crop_batch(crops: list[Crop]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Images (B, 3, H, W) in [0, 1], points (B, 68, 2), score targets (B,), point weights (B,)."""
    images = torch.from_numpy(np.stack([crop.image for crop in crops])).permute(0, 3, 1, 2)
    return (
        images.contiguous(memory_format=torch.channels_last).float() / 255.0,
        torch.from_numpy(np.stack([crop.points for crop in crops])),
        torch.tensor([crop.score for crop in crops]),
        torch.tensor([crop.weight for crop in crops]),
    )


def crop_loss(net: LandmarkNet, crops: list[Crop]) -> torch.Tensor:
    """Distance and Laplace likelihood of the points, cross entropy of the score."""
    images, points, score, weight = crop_batch(crops)
    output = net(images)
    # The square root's slope at zero distance is bounded by the added 0.01 px^2.
    distance = ((output.points - points).square().sum(-1) + 0.01).sqrt()
    likelihood = 2 * output.log_scale + distance * torch.exp(-output.log_scale)
    heat = heat_loss(output.heat, points)
    share = weight / weight.sum().clamp_min(1.0)
    point_loss = ((0.2 * distance + likelihood + heat).mean(1) * share).sum()
    return point_loss + functional.binary_cross_entropy_with_logits(output.logit, score)


@torch.no_grad()
def validate(net: LandmarkNet, views: ViewSet, seed: int) -> str:
    """Median and mean error of frontal crops in crop pixels, and the score's accuracy."""
    rng = np.random.default_rng([seed, 2])
    backgrounds = make_backgrounds(50, rng)
    net.eval()
    errors, right = [], []
    for start in range(0, len(views.facing), BATCH):
        picks = range(start, min(start + BATCH, len(views.facing)))
        crops = [random_crop(views, i, backgrounds, rng) for i in picks]
        images, points, score, weight = crop_batch(crops)
        output = net(images)
        error = (output.points - points).norm(dim=-1).mean(1)
        errors.append(error[weight >= 1.0])
        clear = (score <= 0) | (score >= 1)
        right.append(((output.logit > 0) == (score > 0.5))[clear].float())
    error = torch.cat(errors)
    return (
        f"error median {error.median():.2f} mean {error.mean():.2f} crop px, "
        f"score right {100 * torch.cat(right).mean():.1f} %"
    )


if __name__ == "__main__":
    raise SystemExit(main())
