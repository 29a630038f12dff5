"""Train the face UV network: `python -m pipelines.track.face_uv_training.train --cases DIR`.

Starts from the landmark network's weights, or from those given by `--start`, and sees painted heads
only: the procedural one and, if a path is given, ICT-FaceKit. How the shipped file was made is in
`git show c44aa77:docs/LOG.md`, 2026-11-22. The result depends on the arguments alone, up to how the
machine rounds. An interrupted run continues from its last state, which is kept in DIR.
"""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from express50.errors import FormatError
from express50.geometry.conventions import corner_to_cell
from express50.geometry.sampling import bilinear
from express50.head import BUILTIN_NAME
from express50.head.load import load_head
from express50.head.model import HeadModel
from express50.landmarks.network import WEIGHTS as START
from express50.landmarks.network import (
    LandmarkNet,
    as_input,
    load_network,
    save_network,
    trainable_network,
)
from express50.landmarks.training.descent import minimise, place_loss
from express50.landmarks.training.views import made_once
from pipelines.track.config import UV_WEIGHTS
from pipelines.track.face_uv import (
    FIRST,
    HEIGHT,
    LIPS_APART,
    MARKS,
    TEXELS_PER_PIXEL,
    WIDTH,
    make_uv_map,
    mark_places,
    to_texels,
    to_window,
    window,
)
from pipelines.track.face_uv_training.cases import Case, draw_case, draw_person

FILE_CASES, CASES_PER_PERSON = 60, 2
BATCH = 32
RATE = 1e-3
HELD_OUT = 0
# Steps in which the inverse of a displacement is found.
TURNS = 6
# Landmarks that deep creases run along: where lips meet, twice; the upper lids with their lashes.
CREASES = (((60, 61, 62, 63, 64), (60, 67, 66, 65, 64)), ((36, 37, 38, 39),), ((42, 43, 44, 45),))
# Fractional bits of OpenCV's drawing coordinates.
FINE = 4
# Share of the texels about a place whose displacement must be known.
LEAST_SHARE = 0.25


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
    plan = UvTrainingPlan()
    parser.add_argument("--files", type=int, default=plan.files, help="files of cases per head")
    parser.add_argument("--steps", type=int, default=plan.steps, help="batches of 32 maps")
    parser.add_argument("--seed", type=int, default=plan.seed)
    parser.add_argument("--start", type=Path, default=START, help="weights to go on from")
    parser.add_argument("--out", type=Path, default=UV_WEIGHTS)
    options = parser.parse_args(arguments)
    try:
        trainable_network(options.start)
    except FormatError as error:
        parser.error(f"--start {error}")
    cv2.setNumThreads(1)
    models = [load_head(spec) for spec in (BUILTIN_NAME, options.ict) if spec]
    plan = UvTrainingPlan(steps=options.steps, files=options.files, seed=options.seed)
    save_network(train(models, plan, options.cases, options.start), options.out)
    net = load_network(options.out)
    for model in models:
        cases = open_cases(options.cases, model, HELD_OUT, plan.seed)
        print(f"{model.name}: held-out heads {validate(net, cases)}")
    return 0


def train(
    models: list[HeadModel], plan: UvTrainingPlan, folder: Path, start: Path = START
) -> LandmarkNet:
    """Train on cases of the head models; cases and the run's state are kept in a folder."""
    torch.manual_seed(plan.seed)
    net = trainable_network(start)
    begun = hashlib.sha256(start.read_bytes()).hexdigest()[:8]
    name = "-".join([*(m.name for m in models), *(str(value) for value in astuple(plan)), begun])
    cases = [
        case
        for number in range(HELD_OUT + 1, HELD_OUT + 1 + plan.files)
        for model in models
        for case in open_cases(folder, model, number, plan.seed)
    ]

    def loss_at(step: int) -> torch.Tensor:
        # Seeded by the step, so that a run taken up again draws what it would have drawn.
        rng = np.random.default_rng([plan.seed, 2, step])
        picks = rng.integers(len(cases), size=BATCH)
        batch = make_batch([warped(cases[pick], rng) for pick in picks], rng)
        return marks_loss(net, batch)[0]

    return minimise(net, plan.steps, RATE, folder / f"uv_map-training-{name}.pt", loss_at)


def open_cases(folder: Path, model: HeadModel, number: int, seed: int) -> list[Case]:
    """Read a file of `FILE_CASES` cases; they are drawn first if it is not there."""

    def draw() -> list[Case]:
        rng = np.random.default_rng([seed, number, *model.name.encode()])
        uv_map, cases = make_uv_map(model), list[Case]()
        while len(cases) < FILE_CASES:
            person = draw_person(model, uv_map, rng)
            cases += [draw_case(model, uv_map, person, rng) for _ in range(CASES_PER_PERSON)]
        return cases

    return made_once(folder / f"uv_map-{model.name}-{seed}-{number:03d}.npz", Case, draw)


def make_batch(cases: list[Case], rng: np.random.Generator | None = None) -> UvBatch:
    """Cut windows of maps, with creases drawn in if `rng` is given, and their landmarks."""
    found = [where_seen(case, to_texels(MARKS)) for case in cases]
    maps = [case.colors for case in cases]
    if rng is not None:
        maps = [creased(one, *marks, rng) for one, marks in zip(maps, found, strict=True)]
    images = np.stack([window(one) for one in maps])
    points = np.stack([to_window(at[FIRST:]) for at, _ in found])
    known = np.stack([mask[FIRST:] for _, mask in found])
    return UvBatch(
        as_input(images).contiguous(memory_format=torch.channels_last),
        torch.from_numpy(points).float(),
        torch.from_numpy(known).float(),
    )


def marks_loss(net: LandmarkNet, batch: UvBatch) -> tuple[torch.Tensor, torch.Tensor]:
    """Return distance, likelihood and entropy of the known landmarks, and distances (B, 51)."""
    output = net(batch.images)
    points, log_scale, heat = output.points, output.log_scale, output.heat
    found = points[:, FIRST:], log_scale[:, FIRST:], heat[:, FIRST:]
    loss, distance = place_loss(*found, batch.points)
    return (loss * batch.known).sum() / batch.known.sum().clamp_min(1.0), distance.detach()


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


def warped(case: Case, rng: np.random.Generator) -> Case:
    """Return the reading of a mesh that is off by some more, smooth in the map; maybe mirrored.

    A texel that shows what its neighbour showed belongs where the neighbour's did. Displacements
    are larger than a tracker's: a network that may expect small ones reports too small ones.
    """
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    coarse = rng.normal(size=(2, *rng.integers(2, 9, 2))) * rng.uniform(0.0, 3.5)
    fields = [cv2.resize(one, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for one in coarse]
    turn = rng.normal(size=(2, 2)) * 0.04
    broad = np.stack([x - WIDTH / 2, y - HEIGHT / 2], axis=2) @ turn + rng.normal(size=2) * 2.5
    shift = (rng.random() ** 0.5 * (np.stack(fields, axis=2) + broad)).astype(np.float32)
    at = x + shift[..., 0], y + shift[..., 1]
    colors = cv2.remap(case.colors, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    flow = cv2.remap(case.flow.astype(np.float32), *at, cv2.INTER_LINEAR) + shift
    valid = cv2.remap(case.valid.astype(np.float32), *at, cv2.INTER_LINEAR) > 0.99
    out = Case(colors, flow, valid)
    return mirrored(out) if rng.random() < 0.5 else out


def mirrored(case: Case) -> Case:
    """Return the same reading with the sides of the face exchanged."""
    flow = np.ascontiguousarray(case.flow[:, ::-1]) * np.array([-1.0, 1.0], np.float32)
    colors, valid = (np.ascontiguousarray(image[:, ::-1]) for image in (case.colors, case.valid))
    return Case(colors, flow, valid)


def where_seen(case: Case, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find where a map shows the content of texels (N, 2), corner origin, and whether it does (N,).

    Displacements are known where something is seen and asked for where it belongs.
    """
    valid = case.valid.astype(np.float32)
    share = cv2.GaussianBlur(valid, (0, 0), 1.5)
    flow = cv2.GaussianBlur(case.flow.astype(np.float32) * valid[..., None], (0, 0), 1.5)
    flow = flow / np.maximum(share, 1e-3)[..., None]
    own = (texels + LIPS_APART).astype(np.float32)
    at = own
    for _ in range(TURNS):
        at = own - bilinear(flow, at)
    return at - LIPS_APART, bilinear(share, at) > LEAST_SHARE


def creased(
    colors: np.ndarray, at: np.ndarray, known: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Darken lines where lips meet and along the upper lids of most maps (HEIGHT, WIDTH, 3) uint8.

    Painted shadows are as coarse as the head model's vertices, and on a face these lines show best
    where its parts end. The landmarks are at texels (68, 2), corner origin, where `known` (68,).
    """
    dark = np.zeros((HEIGHT, WIDTH), np.float32)
    for lines in CREASES:
        if rng.random() < 0.25 or not known[np.concatenate(lines)].all():
            continue
        one = np.zeros((HEIGHT, WIDTH), np.uint8)
        for line in lines:
            points = np.rint(corner_to_cell(at[list(line)]) * 2**FINE).astype(np.int32)
            width = int(rng.integers(1, 3))
            cv2.polylines(one, [points], False, 255, width, cv2.LINE_AA, FINE)
        soft = cv2.GaussianBlur(one.astype(np.float32) / 255.0, (0, 0), rng.uniform(0.3, 1.2))
        dark = np.maximum(dark, rng.uniform(0.1, 0.9) * soft)
    return np.rint(colors * (1.0 - dark[..., None])).astype(np.uint8)


if __name__ == "__main__":
    raise SystemExit(main())
