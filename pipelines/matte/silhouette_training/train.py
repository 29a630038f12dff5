"""Train the silhouette network: `python -m pipelines.matte.silhouette_training.train --views DIR`.

It sees people of the digital twin only, in drawn rooms. An interrupted run continues from its last
state, which is kept in DIR beside the rendered people. The result depends on the arguments alone,
up to how the machine rounds.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn import functional
from torch.utils.data import DataLoader, Dataset

from express50.head import BUILTIN_NAME
from express50.head.load import load_head
from express50.landmarks.training.descent import minimise
from express50.landmarks.training.views import made_once
from pipelines.matte.silhouette import WEIGHTS, SilhouetteNet, save_silhouettes
from pipelines.matte.silhouette_training.scenes import (
    PersonView,
    TrainingScene,
    draw_people,
    draw_scene,
)

FIRST, FILE_PEOPLE = 5000, 40  # number of the first person; people per file
BATCH, RATE = 16, 2e-3
OVERLAP = 0.3  # weight of the overlap's loss beside that of single pixels
WAITING = 8  # batches that are drawn ahead


class Batches(Dataset):
    """Draws the batch of each step: inputs, alphas, and which pixels are in the picture."""

    def __init__(self, files: list[Path], seed: int) -> None:
        """Name the files of rendered people, which the process that draws them reads."""
        self.files, self.seed = files, seed
        self.people: list[PersonView] = []

    def __getitem__(self, step: int) -> list[torch.Tensor]:
        """Return the batch of a step, seeded by it, so that interrupted runs draw the same."""
        if not self.people:
            cv2.setNumThreads(1)
            self.people = [view for file in self.files for view in read_people(file)]
        rng = np.random.default_rng([self.seed, 2, step])
        pairs = rng.integers(len(self.people), size=(BATCH, 2))
        return batch_of([draw_scene(self.people[one], self.people[k], rng) for one, k in pairs])


def batch_of(scenes: list[TrainingScene]) -> list[torch.Tensor]:
    """Stack scenes: inputs (B, 7, C, C), alphas and pixels inside of the pictures (B, C, C)."""
    rows = [(scene.inputs, scene.alpha, scene.seen) for scene in scenes]
    return [torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True)]


def main(arguments: list[str] | None = None) -> int:
    """Render missing people, train, and save."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.matte.silhouette_training.train")
    parser.add_argument("--views", type=Path, required=True, help="folder for rendered people")
    parser.add_argument("--files", type=int, default=16, help=f"of {FILE_PEOPLE} people each")
    parser.add_argument("--steps", type=int, default=14000, help=f"batches of {BATCH} pictures")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=WEIGHTS)
    options = parser.parse_args(arguments)
    files = [rendered(options.views, number) for number in range(options.files)]
    save_silhouettes(train(files, options.steps, options.seed, options.views), options.out)
    return 0


def rendered(folder: Path, number: int) -> Path:
    """Return a file of rendered people; render them if it does not exist."""
    path, first = folder / f"people-{number:03d}.npz", FIRST + number * FILE_PEOPLE
    if not path.exists():
        read_people(path, lambda: draw_people(load_head(BUILTIN_NAME), FILE_PEOPLE, first))
    return path


def read_people(path: Path, make: Callable[[], list[PersonView]] = list) -> list[PersonView]:
    """Read a file of rendered people; make it if it does not exist."""
    return made_once(path, PersonView, make)


def train(files: list[Path], steps: int, seed: int, folder: Path) -> SilhouetteNet:
    """Train on files of rendered people; the run's state is kept in a folder."""
    torch.manual_seed(seed)
    net = SilhouetteNet().to(memory_format=torch.channels_last)
    drawn: list[Iterator[list[torch.Tensor]]] = []

    def loss_at(step: int) -> torch.Tensor:
        if not drawn:  # a run taken up again does not begin at step 0
            # Another process draws ahead. It is not forked, which can block libraries' threads.
            loader = DataLoader(
                Batches(files, seed), None, sampler=range(step, steps), num_workers=1,
                prefetch_factor=WAITING, multiprocessing_context="spawn",
            )  # fmt: skip
            drawn.append(iter(loader))
        inputs, alpha, seen = next(drawn[0])
        return scene_loss(net(inputs.to(memory_format=torch.channels_last)), alpha, seen)

    return minimise(net, steps, RATE, folder / f"run-{len(files)}-{steps}-{seed}.pt", loss_at)


def scene_loss(found: torch.Tensor, alpha: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Return the loss of logits against alphas, (B, C, C) each, over `seen` pixels."""
    pixels = functional.binary_cross_entropy_with_logits(found, alpha, reduction="none")
    chance = torch.sigmoid(found)
    both, either = (chance * alpha * seen).sum(), ((chance + alpha) * seen).sum()
    return (pixels * seen).sum() / seen.sum() - OVERLAP * 2 * both / either


if __name__ == "__main__":
    raise SystemExit(main())
