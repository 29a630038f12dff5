"""Train GRMM: one loop, read from top to bottom.

One iteration renders ``accumulate`` views (batch size 1 as in the paper), adds up the objective
and takes one Adam step. Under ``torchrun`` every process takes other views and DDP averages their
gradients. On a CPU a resumed run continues bit for bit, unless a time budget steers the rate.
"""

from __future__ import annotations

import fnmatch
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
import torch.distributed as distributed
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from express50.errors import ConfigError, TrainError
from express50.head.model import HeadModel
from grmm import losses
from grmm.checkpoint import collect_gallery, load_checkpoint, save_checkpoint
from grmm.config import Config
from grmm.data import HeadViews, Item, Key, Shuffle, Source
from grmm.model import GRMM, Rendering, View
from grmm.perceptual import load_vgg, random_crop
from grmm.presets import as_tables
from grmm.progress import Interrupt, append_log, deferred_interrupt, log, start_log
from grmm.train_report import report
from grmm.warm_start import warm_start


@dataclass(kw_only=True)
class Run:
    """Everything the loop changes."""

    model: GRMM
    views: HeadViews
    training: list[int]
    holdout: list[int]
    optimizer: torch.optim.Optimizer
    shuffle: Shuffle
    generator: torch.Generator
    perceptual: torch.nn.Module | None
    edges: Tensor
    iteration: int = 0
    seconds: float = 0.0
    terms: dict[str, float] = field(default_factory=dict)


def train(
    source: Source, head: HeadModel, out: Path, config: Config, *, resume: bool = False
) -> dict[str, object]:
    """Train on a source and write OUT/checkpoint.pt, OUT/metrics.json and OUT/preview/*.jpg.

    Args:
        source: samples; ``source.head`` is how `load_head` finds ``head`` again.
        head: the head model the samples were tracked with.
        out: folder, made if absent.
        config: resolved configuration.
        resume: go on from OUT/checkpoint.pt, whose configuration must agree in all but the budget.

    Returns:
        What metrics.json holds.

    Raises:
        TrainError: nothing to train on, or the objective is not finite.
        ConfigError: the configuration differs from the one resumed.
    """
    rank, world, device = join_processes()
    if config.train.threads:
        torch.set_num_threads(config.train.threads)
    torch.manual_seed(config.train.seed)
    views = HeadViews(
        source,
        head,
        background=config.data.background,
        torso=config.data.torso,
        cache_mb=config.data.cache_mb,
        device=device,
    )
    run = prepare(views, config, rank, world)
    checkpoint = out / "checkpoint.pt"
    if resume:
        restore(run, checkpoint, config, device)
    elif config.train.warm_start:
        warm_start(run.model, views, run.training, config.train.warm_start_images)
    if rank == 0:
        start_log(out / "log.jsonl", run.iteration)
    parallel = DistributedDataParallel(run.model) if world > 1 else run.model
    if rank == 0:
        log(f"{run.model.anchors.budget()}; {len(run.training)} views to train on")
        if run.perceptual is None:
            log("the perceptual term is off: loss.vgg16 names no weights")

    started = time.perf_counter() - run.seconds
    with deferred_interrupt() as interrupt:
        while not finished(run, config):
            set_rates(run, config)
            step(run, parallel, config)
            run.iteration += 1
            run.seconds = time.perf_counter() - started
            if world > 1:
                agree(run, interrupt, device)
            last = finished(run, config) or interrupt.requested
            if rank == 0 and (run.iteration % config.train.log_every == 0 or last):
                log(progress_line(run, config))
                append_log(out / "log.jsonl", run.iteration, run.seconds, run.terms)
            if rank == 0 and (run.iteration % config.train.save_every == 0 or last):
                save(run, checkpoint, config, source.head)
            if interrupt.requested:
                raise KeyboardInterrupt
    metrics = report(run, config, out) if rank == 0 else {}
    if world > 1:
        distributed.destroy_process_group()
    return metrics


def join_processes() -> tuple[int, int, torch.device]:
    """Rank, number of processes and device; joins the group that ``torchrun`` describes."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    cuda = torch.cuda.is_available()
    device = torch.device(f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if cuda else "cpu")
    if world > 1:
        distributed.init_process_group("nccl" if cuda else "gloo")
    return int(os.environ.get("RANK", "0")), world, device


def agree(run: Run, interrupt: Interrupt, device: torch.device) -> None:
    """Let all processes see the same clock and the same wish to stop, or they would part ways."""
    common = torch.tensor([run.seconds, float(interrupt.requested)], device=device)
    distributed.all_reduce(common, distributed.ReduceOp.MAX)
    run.seconds, interrupt.requested = float(common[0]), bool(common[1] > 0)


def prepare(views: HeadViews, config: Config, rank: int = 0, world: int = 1) -> Run:
    """Build model, optimiser and order of samples."""
    training, holdout = split_samples(views.keys, config)
    keys = [views.keys[i] for i in training]
    subjects = sorted({key.subject for key in keys})
    expressions = sorted({key.expression for key in keys})
    model = GRMM(config.model, views.head, subjects, expressions).to(views.device)
    # What was held out can be judged only where its codes were trained.
    holdout = [
        i
        for i in holdout
        if views.keys[i].subject in subjects and views.keys[i].expression in expressions
    ]
    perceptual = load_vgg(Path(config.loss.vgg16)).to(views.device) if config.loss.vgg16 else None
    return Run(
        model=model,
        views=views,
        training=training,
        holdout=holdout,
        optimizer=make_optimizer(model, config),
        shuffle=Shuffle(training, config.train.seed, rank, world),
        generator=torch.Generator().manual_seed(config.train.seed + rank),
        perceptual=perceptual,
        edges=losses.mesh_edges(views.head.faces),
    )


def split_samples(keys: Sequence[Key], config: Config) -> tuple[list[int], list[int]]:
    """Samples to train on and held-out ones: views of held-out cameras, held-out expressions.

    Raises:
        ConfigError: a held-out name fits no sample.
        TrainError: nothing is left to train on.
    """
    cameras = {key.camera for key in keys}
    unknown = set(config.data.holdout_cameras) - cameras
    if unknown:
        raise ConfigError(
            f"data.holdout_cameras names {', '.join(sorted(unknown))}; "
            f"the shards have {', '.join(sorted(cameras))}"
        )
    frames = {f"{key.subject}/{key.expression}" for key in keys}
    held = {p: set(fnmatch.filter(frames, p)) for p in config.data.holdout_expressions}
    for pattern, found in held.items():
        if not found:
            raise ConfigError(
                f"data.holdout_expressions names {pattern}; expected SUBJECT/EXPRESSION such as "
                f"{min(frames)}"
            )
    unseen = set().union(*held.values())
    holdout = [
        i
        for i, key in enumerate(keys)
        if key.camera in config.data.holdout_cameras or f"{key.subject}/{key.expression}" in unseen
    ]
    training = sorted(set(range(len(keys))) - set(holdout))
    if config.train.overfit:
        training, holdout = training[: config.train.overfit], []
    if not training:
        raise TrainError(
            f"no views to train on: {len(keys)} samples, all by held-out cameras or expressions; "
            "hold out fewer or pack more"
        )
    return training, holdout


def make_optimizer(model: GRMM, config: Config) -> torch.optim.Optimizer:
    """Adam with a group each for codes, per-texel parameters, refinement and all else."""
    settings = config.train
    codes = [model.z_id, model.z_exp]
    texels = [
        parameter
        for ladder in (model.transform, model.opacity, model.colour)
        for parameter in ladder.texel_parameters()
    ]
    refinement = [] if model.refinement is None else list(model.refinement.parameters())
    special = {id(parameter) for parameter in codes + texels + refinement}
    rest = [parameter for parameter in model.parameters() if id(parameter) not in special]
    groups = [
        {"params": rest, "scale": 1.0},
        {"params": codes, "scale": settings.code_lr_scale},
        {"params": texels, "scale": settings.texel_lr_scale},
        {"params": refinement, "scale": settings.refine_lr_scale},
    ]
    return torch.optim.Adam(groups, lr=settings.lr, betas=settings.betas, fused=True)


def finished(run: Run, config: Config) -> bool:
    """True when iterations or seconds are used up."""
    return budget_used(run, config) >= 1


def budget_used(run: Run, config: Config) -> float:
    """Share of the budget used, by iterations or by seconds, whichever is further."""
    by_time = run.seconds / config.train.seconds if config.train.seconds else 0.0
    return max(run.iteration / config.train.iterations, by_time)


def set_rates(run: Run, config: Config) -> None:
    """Learning rates at this share of the budget: a half cosine from 1 to ``final_lr``."""
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, budget_used(run, config))))
    factor = config.train.final_lr + (1 - config.train.final_lr) * cosine
    for group in run.optimizer.param_groups:
        group["lr"] = config.train.lr * group["scale"] * factor


def step(run: Run, parallel: torch.nn.Module, config: Config) -> None:
    """One optimiser step over ``accumulate`` views."""
    run.optimizer.zero_grad(set_to_none=True)
    for _ in range(config.train.accumulate):
        item = run.views.item(run.shuffle.next(), config.data.crop_margin_px)
        subject = run.model.subjects.index(item.key.subject)
        expression = run.model.expressions.index(item.key.expression)
        shade_view = other_direction(run, config.train.shuffle_directions)
        rendering = parallel(
            subject, expression, item.state, item.view, run.views.background, shade_view
        )
        terms = objective(run, rendering, item, config)
        loss = torch.stack(list(terms.values())).sum()
        run.terms = {name: float(term.detach()) for name, term in terms.items()}
        if not bool(torch.isfinite(loss)):
            raise TrainError(
                f"iteration {run.iteration}: the objective is not finite at {item.key}: "
                f"{run.terms}; expected finite terms. Lower train.lr or look at this sample"
            )
        (loss / config.train.accumulate).backward()
    if config.train.clip_norm:
        torch.nn.utils.clip_grad_norm_(run.model.parameters(), config.train.clip_norm)
    run.optimizer.step()


def other_direction(run: Run, share: float) -> View | None:
    """A random training view in a ``share`` of calls, else None."""
    if float(torch.rand((), generator=run.generator)) >= share:
        return None
    index = run.training[int(torch.randint(len(run.training), (), generator=run.generator))]
    sample = run.views.sample(index)
    return run.views.view_of(sample, sample.alpha.shape[1], sample.alpha.shape[0])


def objective(run: Run, rendering: Rendering, item: Item, config: Config) -> dict[str, Tensor]:
    """Weighted terms of the objective by name (paper: Training and Losses)."""
    weights, model = config.loss, run.model
    images = {"rgb": item.comparable(rendering.rgb)}
    if model.refinement is not None:
        images["image"] = item.comparable(rendering.image)
    terms = {n: losses.reconstruction(image, item.target, weights) for n, image in images.items()}
    if run.perceptual is not None and run.iteration % weights.perceptual_every == 0:
        for name, image in images.items():
            pair = random_crop((image, item.target), weights.perceptual_crop_px, run.generator)
            term = weights.perceptual * weights.perceptual_every * run.perceptual(*pair)
            terms[f"perceptual_{name}"] = term
    if bool(item.depth_valid.any()):
        error = losses.depth_dm2(
            rendering.depth, rendering.alpha, item.depth, item.depth_valid, weights.depth_erode_px
        )
        terms["depth"] = weights.depth * error
    z_id, z_exp = model.codes(
        model.subjects.index(item.key.subject), model.expressions.index(item.key.expression)
    )
    bounds = config.model.scale_bounds_mm
    return terms | losses.regularisers(rendering, z_id, z_exp, run.edges, bounds, weights)


def save(run: Run, path: Path, config: Config, head_spec: str) -> None:
    """Write the checkpoint with the loop's full state."""
    save_checkpoint(
        path,
        model=run.model,
        config=config,
        head_spec=head_spec,
        gallery=collect_gallery(run.views, run.training),
        optimizer=run.optimizer.state_dict(),
        loop={
            "iteration": run.iteration,
            "seconds": run.seconds,
            "shuffle": run.shuffle.state(),
            "generator": run.generator.get_state(),
            "torch": torch.get_rng_state(),
        },
    )


def restore(run: Run, path: Path, config: Config, device: torch.device) -> None:
    """Put a run back to where its checkpoint was written."""
    loaded = load_checkpoint(path, device)
    if not loaded.loop:
        raise ConfigError(
            f"{path}: holds no state to resume from (a person was withdrawn from it, or it is a "
            "fit); train into another folder"
        )
    budget = {"iterations", "seconds", "save_every", "log_every", "evaluate_images", "threads"}
    old, new = as_tables(loaded.config), as_tables(config)
    changed = [
        f"{table}.{key} {old[table][key]!r} -> {value!r}"
        for table in ("model", "loss", "data", "train")
        for key, value in new[table].items()
        if value != old[table][key] and not (table == "train" and key in budget)
    ]
    names = (loaded.model.subjects, loaded.model.expressions)
    if names != (run.model.subjects, run.model.expressions):
        changed.append("the subjects or expressions of the shards")
    if changed:
        raise ConfigError(
            f"{path}: cannot resume, these differ: {'; '.join(changed)}. "
            "Resume with the same settings or train into another folder"
        )
    run.model.load_state_dict(loaded.model.state_dict())
    run.optimizer.load_state_dict(loaded.optimizer)
    run.shuffle.restore(loaded.loop["shuffle"])
    run.generator.set_state(loaded.loop["generator"])
    torch.set_rng_state(loaded.loop["torch"])
    run.iteration, run.seconds = loaded.loop["iteration"], loaded.loop["seconds"]


def progress_line(run: Run, config: Config) -> str:
    """Where the run is, how fast it goes and what the terms are."""
    rate = run.iteration / max(run.seconds, 1e-9)
    used = budget_used(run, config)
    left = run.seconds * (1 - used) / used if used > 0 else 0.0
    terms = " ".join(f"{name} {value:.4f}" for name, value in run.terms.items())
    return f"iteration {run.iteration}  {rate:.2f}/s  {left:.0f} s left  {terms}"
