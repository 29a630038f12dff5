"""Train the face UV network: `python -m pipelines.track.face_uv_training.train --cases DIR`.

Goes on from the landmark network's weights or from those given by `--start`, on painted heads only:
the procedural one and, where a path is given, ICT-FaceKit (how the shipped file was made:
docs/LOG.md, 2026-11-22). The result depends on the arguments alone, up to how the machine rounds.
A run that was interrupted goes on from its last state, which is kept in DIR.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import time
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from express50.errors import FormatError
from express50.head.load import load_head
from express50.head.model import HeadModel
from express50.landmarks.network import WEIGHTS as START
from express50.landmarks.network import (
    LandmarkNet,
    heat_loss,
    load_network,
    save_network,
    trainable_network,
)
from express50.landmarks.training.train import keep_state, rate_share, take_up
from pipelines.track.config import UV_WEIGHTS
from pipelines.track.face_uv_map import (
    FIRST,
    MARKS,
    TEXELS_PER_PIXEL,
    make_uv_map,
    mark_places,
    to_texels,
    to_window,
    window,
)
from pipelines.track.face_uv_training.cases import draw_case, draw_person
from pipelines.track.face_uv_training.disturb import Case, creased, warped, where_seen

FILE_CASES, CASES_PER_PERSON = 60, 2
BATCH = 32
RATE = 1e-3
KEEP_EVERY = 100
HELD_OUT = 0


@dataclass(frozen=True, kw_only=True)
class UvTrainingPlan:
    """Settings of a training: number of batches, files of cases per head model, seed."""

    steps: int = 4000
    files: int = 24
    seed: int = 0


class UvBatch(NamedTuple):
    """Windows (B, 3, 128, 128) in [0, 1], landmarks (B, 51, 2) pixels, which are known (B, 51)."""

    images: torch.Tensor
    points: torch.Tensor
    known: torch.Tensor


def main(arguments: list[str] | None = None) -> int:
    """Draw missing cases, train, save and report the error on held-out heads."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.track.face_uv_training.train")
    parser.add_argument("--cases", type=Path, required=True, help="folder for drawn cases")
    parser.add_argument("--ict", help="ICT-FaceKit checkout or .npz to train on as well")
    parser.add_argument(
        "--files", type=int, default=UvTrainingPlan.files, help="files of cases per head"
    )
    parser.add_argument(
        "--steps", type=int, default=UvTrainingPlan.steps, help="batches of 32 maps"
    )
    parser.add_argument("--seed", type=int, default=UvTrainingPlan.seed)
    parser.add_argument("--start", type=Path, default=START, help="weights to go on from")
    parser.add_argument("--out", type=Path, default=UV_WEIGHTS)
    options = parser.parse_args(arguments)
    try:
        trainable_network(options.start)
    except FormatError as error:
        parser.error(f"--start {error}")
    cv2.setNumThreads(1)
    models = [load_head(spec) for spec in ("procedural", options.ict) if spec]
    plan = UvTrainingPlan(steps=options.steps, files=options.files, seed=options.seed)
    save_network(train(models, plan, options.cases, options.start), options.out)
    net = load_network(options.out)
    for model in models:
        cases = read_cases(make_cases(options.cases, model, HELD_OUT, plan.seed))
        print(f"{model.name}: held-out heads {validate(net, cases)}")
    return 0


def train(
    models: list[HeadModel], plan: UvTrainingPlan, folder: Path, start: Path = START
) -> LandmarkNet:
    """Train on cases of the head models; cases and the run's state are kept in a folder."""
    torch.manual_seed(plan.seed)
    net = trainable_network(start)
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=1e-3)
    begun = hashlib.sha256(start.read_bytes()).hexdigest()[:8]
    name = "-".join([*(m.name for m in models), *(str(value) for value in astuple(plan)), begun])
    cases = [
        case
        for number in range(HELD_OUT + 1, HELD_OUT + 1 + plan.files)
        for model in models
        for case in read_cases(make_cases(folder, model, number, plan.seed))
    ]
    state = folder / f"uv_map-training-{name}.pt"
    first = take_up(state, net, optimiser)
    began, losses = time.monotonic(), []
    for step in range(first, plan.steps):
        optimiser.param_groups[0]["lr"] = RATE * rate_share(step, plan.steps)
        # Seeded by the step, so that a run taken up again draws what it would have drawn.
        rng = np.random.default_rng([plan.seed, 2, step])
        picks = rng.integers(len(cases), size=BATCH)
        batch = make_batch([warped(cases[pick], rng) for pick in picks], rng)
        loss, _ = marks_loss(net, batch)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        optimiser.step()
        losses.append(loss.item())
        if (step + 1) % KEEP_EVERY == 0:
            seconds = (time.monotonic() - began) / (step + 1 - first)
            recent = np.mean(losses[-KEEP_EVERY:])
            print(f"step {step + 1}: loss {recent:.3f}, {seconds:.2f} s", flush=True)
            keep_state(state, net, optimiser, step + 1)
    return net.eval()


def make_cases(folder: Path, model: HeadModel, number: int, seed: int) -> Path:
    """Draw one file of `FILE_CASES` cases, unless it is there already."""
    path = folder / f"uv_map-{model.name}-{seed}-{number:03d}.npz"
    if path.exists():
        return path
    rng = np.random.default_rng([seed, number, *model.name.encode()])
    uv_map, cases = make_uv_map(model), list[Case]()
    while len(cases) < FILE_CASES:
        person = draw_person(model, uv_map, rng)
        cases += [draw_case(model, uv_map, person, rng) for _ in range(CASES_PER_PERSON)]
    folder.mkdir(parents=True, exist_ok=True)
    # Two processes that happen to draw the same file write the same bytes.
    part = path.with_suffix(f".{os.getpid()}.part")
    with part.open("wb") as file:
        names = Case.__annotations__
        stacks: dict[str, Any] = {n: np.stack([getattr(case, n) for case in cases]) for n in names}
        np.savez(file, **stacks)
    part.rename(path)
    return path


def read_cases(path: Path) -> list[Case]:
    """Read a file of cases."""
    with np.load(path, allow_pickle=False) as data:
        stacks = {name: data[name] for name in Case.__annotations__}
    return [
        Case(**{name: stack[index] for name, stack in stacks.items()})
        for index in range(len(stacks["valid"]))
    ]


def make_batch(cases: list[Case], rng: np.random.Generator | None = None) -> UvBatch:
    """Cut windows of maps, with creases drawn in if `rng` is given, and their landmarks."""
    found = [where_seen(case, to_texels(MARKS)) for case in cases]
    maps = [case.colors for case in cases]
    if rng is not None:
        maps = [creased(one, *marks, rng) for one, marks in zip(maps, found, strict=True)]
    images = np.stack([window(one) for one in maps])
    points = np.stack([to_window(at[FIRST:]) for at, _ in found])
    known = np.stack([mask[FIRST:] for _, mask in found])
    stacked = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255.0
    return UvBatch(
        stacked.contiguous(memory_format=torch.channels_last),
        torch.from_numpy(points).float(),
        torch.from_numpy(known).float(),
    )


def marks_loss(net: LandmarkNet, batch: UvBatch) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance, Laplace likelihood and cross entropy of the known landmarks; distances (B, 51)."""
    output = net(batch.images)
    # The square root's slope at zero distance is bounded by the added 0.01 px^2.
    off = (output.points[:, FIRST:] - batch.points).square().sum(-1)
    distance = (off + 0.01).sqrt()
    log_scale = output.log_scale[:, FIRST:]
    likelihood = 2 * log_scale + distance * torch.exp(-log_scale)
    heat = heat_loss(output.heat[:, FIRST:], batch.points)
    total = ((0.2 * distance + likelihood + heat) * batch.known).sum()
    return total / batch.known.sum().clamp_min(1.0), distance.detach()


@torch.inference_mode()
def validate(net: LandmarkNet, cases: list[Case]) -> str:
    """Measure the landmarks' error left in cases as they were drawn."""
    batch = make_batch(cases)
    _, after = marks_loss(net, batch)
    home = torch.from_numpy(to_window(mark_places())).float()
    before = (batch.points - home).norm(dim=-1)
    shown = batch.known > 0
    return (
        f"{TEXELS_PER_PIXEL * float(before[shown].mean()):.2f} texels before, "
        f"{TEXELS_PER_PIXEL * float(after[shown].mean()):.2f} after"
    )


if __name__ == "__main__":
    raise SystemExit(main())
