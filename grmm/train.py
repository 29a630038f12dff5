"""Train GRMM: one loop, read from top to bottom.

One iteration renders ``accumulate`` views (batch size 1 as in the paper), adds up the objective
and takes one Adam step. Under ``torchrun`` every process takes other views and DDP averages their
gradients. On a CPU a resumed run continues bit for bit, unless a time budget steers the rate.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import torch
import torch.distributed as distributed
from torch.nn.parallel import DistributedDataParallel

from express50.errors import ConfigError
from express50.head.model import HeadModel
from grmm.checkpoint import collect_gallery, load_checkpoint, save_checkpoint
from grmm.config import Config
from grmm.data import HeadViews, Source
from grmm.objective import step
from grmm.presets import as_tables
from grmm.progress import Interrupt, append_log, deferred_interrupt, log, start_log, tensorboard
from grmm.run import Run, best_device, budget_used, finished, prepare, set_rates, settle
from grmm.train_report import report
from grmm.warm_start import warm_start

PATIENT = 10_000  # iterations that a CPU does in a day at most
GREY_DB = 10.0  # what a grey picture scores
GLOO_SECONDS = 0.5  # for Gloo's threads to free tensors; 0.2 was enough in every run


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
    config = settle(config, views)
    run = prepare(views, config, rank, world)
    checkpoint = out / "checkpoint.pt"
    if resume:
        restore(run, checkpoint, config, device, rank)
    elif config.train.warm_start:
        warm_start(run.model, views, run.training, config.train.warm_start_images)
    if rank == 0:
        start_log(out / "log.jsonl", run.iteration)
    parallel = DistributedDataParallel(run.model) if world > 1 else run.model
    if rank == 0:
        log(f"{run.model.anchors.budget()}; {len(run.training)} views to train on")
        if run.perceptual is None:
            log("the perceptual term is off: loss.vgg16 names no weights")
        if device.type == "cpu" and not config.train.seconds and config.train.iterations > PATIENT:
            log(
                f"{config.train.iterations} iterations take days on a CPU; '--preset measured "
                "--budget 1h' is the setting that does best in an hour"
            )

    started, saved = time.perf_counter() - run.seconds, run.seconds
    scalars = tensorboard(out / "tensorboard", config.train.tensorboard and rank == 0)
    with deferred_interrupt() as interrupt, scalars as show:
        while not finished(run, config):
            set_rates(run, config)
            step(run, parallel, config)
            run.iteration += 1
            run.seconds = time.perf_counter() - started
            if world > 1:
                agree(run, interrupt, device)
            last = finished(run, config) or interrupt.requested
            due = run.iteration % config.train.save_every == 0 or (
                0 < config.train.save_seconds <= run.seconds - saved
            )
            if rank == 0 and (run.iteration % config.train.log_every == 0 or last):
                log(progress_line(run, config))
                append_log(out / "log.jsonl", run.iteration, run.seconds, run.terms)
                show(run.iteration, run.terms)
            if rank == 0 and (due or last):
                save(run, checkpoint, config, source.head)
                saved = run.seconds
            if interrupt.requested:
                raise KeyboardInterrupt
    leave_processes()
    metrics = report(run, config, out) if rank == 0 else {}
    if rank == 0 and float(str(metrics["psnr_train_db"])) < GREY_DB:
        log("pictures of training are worse than grey ones: it diverged; lower train.lr")
    return metrics


def join_processes() -> tuple[int, int, torch.device]:
    """Rank, number of processes and device; joins the group that ``torchrun`` describes."""
    world, device = int(os.environ.get("WORLD_SIZE", "1")), best_device()
    if world > 1:
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return int(os.environ.get("RANK", "0")), world, device


def leave_processes() -> None:
    """End the group that `join_processes` joined, if any.

    Gloo's threads outlive it, and take Python's lock to free what the last sum was of; one that
    does so while the interpreter ends aborts the process. So they are given time to.
    """
    if distributed.is_initialized():
        distributed.destroy_process_group()
        time.sleep(GLOO_SECONDS)


def agree(run: Run, interrupt: Interrupt, device: torch.device) -> None:
    """Let all processes see the same clock and the same wish to stop, or they would part ways."""
    common = torch.tensor([run.seconds, float(interrupt.requested)], device=device)
    distributed.all_reduce(common, distributed.ReduceOp.MAX)
    run.seconds, interrupt.requested = float(common[0]), bool(common[1] > 0)


def save(run: Run, path: Path, config: Config, head_spec: str) -> None:
    """Write the checkpoint with the loop's full state."""
    save_checkpoint(
        path,
        model=run.result,
        config=config,
        head_spec=head_spec,
        gallery=collect_gallery(run.views, run.training),
        optimizer=run.optimizer.state_dict(),
        loop={
            "iteration": run.iteration,
            "seconds": run.seconds,
            "samples": run.views.source.digest,
            "shuffle": run.shuffle.state(),
            "generator": run.generator.get_state(),
            "torch": torch.get_rng_state(),
        }
        | ({"weights": run.model.state_dict()} if run.average else {}),
    )


def restore(run: Run, path: Path, config: Config, device: torch.device, rank: int) -> None:
    """Put a run back to where its checkpoint was written, which has the state of rank 0."""
    loaded = load_checkpoint(path, device)
    if not loaded.loop:
        raise ConfigError(
            f"{path}: holds no state to resume from (a person was withdrawn from it, or it is a "
            "fit); train into another folder, or start over with --anew"
        )
    budget = {"iterations", "seconds", "save_every", "save_seconds", "log_every",
              "evaluate_images", "threads", "tensorboard"}  # fmt: skip
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
    elif loaded.loop.get("samples", run.views.source.digest) != run.views.source.digest:
        changed.append("the samples of the shards")
    if changed:
        raise ConfigError(
            f"{path}: cannot resume, these differ: {'; '.join(changed)}. "
            "Go on with the same, train into another folder, or start over with --anew"
        )
    run.model.load_state_dict(loaded.loop.get("weights", loaded.model.state_dict()))
    if run.average is not None:
        run.average.module.load_state_dict(loaded.model.state_dict())
        run.average.n_averaged.fill_(loaded.loop["iteration"])
    run.optimizer.load_state_dict(loaded.optimizer)
    run.shuffle.restore(loaded.loop["shuffle"])
    if rank == 0:  # the others draw other numbers
        run.generator.set_state(loaded.loop["generator"])
    torch.set_rng_state(loaded.loop["torch"])
    run.iteration, run.seconds = loaded.loop["iteration"], loaded.loop["seconds"]
    if finished(run, config):
        log(
            f"{path}: has all of its {run.iteration} iterations; to train on, raise "
            "train.iterations or --seconds"
        )
    else:
        log(f"{path}: going on from iteration {run.iteration}")


def progress_line(run: Run, config: Config) -> str:
    """Where the run is, how fast it goes and what the terms are."""
    rate = run.iteration / max(run.seconds, 1e-9)
    used = budget_used(run, config)
    left = run.seconds * (1 - used) / used if used > 0 else 0.0
    terms = " ".join(f"{name} {value:.4f}" for name, value in run.terms.items())
    return f"iteration {run.iteration}  {rate:.2f}/s  {in_words(left)} left  {terms}"


def in_words(seconds: float) -> str:
    """A time to go as a person would say it."""
    seconds = max(0.0, seconds)
    for unit, length in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"
