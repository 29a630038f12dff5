"""Train GRMM: one loop, read from top to bottom.

One iteration renders ``accumulate`` views (the paper's batch size is 1), sums the objective and
takes one Adam step. Under ``torchrun`` each process takes different views, and DDP averages their
gradients. On a CPU, a resumed run gives the same bits as an uninterrupted one, unless a time budget
controls the learning rate.
"""

from __future__ import annotations

import contextlib
import os
import time
import warnings
from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path
from threading import Event

import torch
import torch.distributed as distributed
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from express50 import native
from express50.console import count, log
from express50.errors import DivergedError, FormatError, NotReadyError
from express50.files.atomic import check_space, write_json
from express50.files.text import read_json_table
from express50.geometry.sampling import evenly
from express50.head.model import HeadModel
from grmm import losses
from grmm.checkpoint import collect_gallery
from grmm.config import Config, as_tables
from grmm.data import HeadView, HeadViews, Source
from grmm.evaluate import REGIONS, component_effects, evaluate, mean, training_render
from grmm.metrics import PerceptualMetrics
from grmm.model import Rendering
from grmm.rasterize import NotFiniteTensorError
from grmm.render import comparison_sheet
from grmm.train_state import (
    SAY_SECONDS,
    Terms,
    TrainState,
    append_log,
    best_device,
    budget_used,
    deferred_interrupt,
    finished,
    prepare,
    restore,
    save,
    saving,
    set_rates,
    start_log,
    with_map_size,
)
from grmm.warm_start import warm_start

LOG_EVERY = 20  # iterations between lines of progress, at most
DAY_STEPS = 10_000  # iterations that a CPU does in a day, at most
GREY_DB = 10.0  # the score of a grey picture
GLOO_SECONDS = 0.5  # for Gloo's threads to free tensors; 0.2 was enough in every run


def train(
    source: Source,
    head: HeadModel,
    out: Path,
    config: Config,
    *,
    resume: bool = False,
    own_terms: Terms | None = None,
) -> dict[str, object]:
    """Train on a source and write OUT/checkpoint.pt, OUT/metrics.json and OUT/preview/*.jpg.

    ``source.head`` is the name by which `load_head` finds ``head`` again. ``resume`` continues from
    OUT/checkpoint.pt, whose settings must be the same except for the budget. ``own_terms`` adds
    terms to the objective. Returns the content of metrics.json; empty in processes but the first.

    Raises:
        TrainError: nothing to train on.
        DivergedError: the objective or a weight is not finite.
        ConfigError: the configuration differs from the one resumed, or there is neither a GPU nor
            the native library.
    """
    # --- Processes, samples, model -------------------------------------------------------------
    rank, world, device = join_processes()
    if device.type == "cpu" and (why := native.why_missing()):  # a step would take minutes
        raise NotReadyError(f"training without a GPU needs the native library: {why}")
    torch.manual_seed(config.train.seed)
    perceptual = PerceptualMetrics(config.metrics)  # first, because it may reject its files
    views = HeadViews(source, head.to(device), config.data)
    config = with_map_size(config, views)
    state = prepare(views, config, rank, world)
    state.own_terms = own_terms
    views.check_mattes(state.training)
    checkpoint = out / "checkpoint.pt"
    if resume:
        restore(state, checkpoint, config, device)
    elif config.train.warm_start:
        warm_start(state.model, views, state.training)
    parallel: torch.nn.Module = state.model
    if world > 1:  # buffers are constants of the head model
        # Layouts differ for 1 x 1 convolutions; that costs little time and changes no result.
        warnings.filterwarnings("ignore", "Grad strides do not match bucket view strides")
        parallel = DistributedDataParallel(state.model, forward_sync_buffers=False)
    if rank == 0:
        out.mkdir(parents=True, exist_ok=True)
        check_space(out)
        start_log(out / "log.jsonl", state.iteration)
        gallery = collect_gallery(views, state.training)
        covered, texels = len(state.model.texels), config.model.n_g**2
        log(
            f"{covered} Gaussians of {texels} texels ({100 * covered / texels:.0f} % covered); "
            f"{count(len(state.training), 'view')} to train on"
        )
        if state.perceptual is None:
            log("the perceptual term is off: loss.vgg16 names no weights")
        if (
            device.type == "cpu"
            and not config.train.seconds
            and config.train.iterations > DAY_STEPS
        ):
            log("this takes days on a CPU; use '--preset auto --budget 1h' to train for an hour")

    # --- The loop ------------------------------------------------------------------------------
    def save_to(path: Path) -> None:
        save(state, path, config, source.head, gallery)

    def late() -> bool:  # several processes would have to agree, view by view
        state.seconds = time.perf_counter() - started
        return world == 1 and finished(state, config)

    started, every = time.perf_counter() - state.seconds, config.train.save_seconds
    said = state.seconds
    with deferred_interrupt() as interrupt, saving(checkpoint, save_to, every) as keep:
        while not finished(state, config):
            set_rates(state, config)
            order = state.shuffle.state()
            try:
                step(state, parallel, config, late)
            except DivergedError:
                raise
            except Exception:  # a damaged shard, too little memory, or another process has failed
                state.shuffle.restore(order)  # nothing else has changed: keep the steps before
                if rank == 0 and state.iteration:
                    keep(True)
                raise
            state.iteration += 1
            state.seconds = time.perf_counter() - started
            if world > 1:
                synchronise(state, interrupt, device)
            last = finished(state, config) or interrupt.is_set()
            due = state.iteration % LOG_EVERY == 0 or state.seconds - said >= SAY_SECONDS
            if rank == 0 and (due or last):
                said = state.seconds
                log(progress_line(state, config))
                append_log(out / "log.jsonl", state)
            if rank == 0:
                keep(last)
            if interrupt.is_set():  # only now, after the save
                raise KeyboardInterrupt
    if world > 1:
        distributed.destroy_process_group()
        # Gloo's threads outlive the group, and take Python's lock to free the tensors of the last
        # sum. If one does so while the interpreter ends, the process aborts: give them some time.
        time.sleep(GLOO_SECONDS)

    left = config.train.seconds - state.seconds
    if rank == 0 and state.iteration >= config.train.iterations and left > 0:
        log(
            f"{timedelta(seconds=round(left))} of the budget are left, because train.iterations is"
            f" {state.iteration}; the same command with a larger --set train.iterations=N trains on"
        )

    # --- The report ----------------------------------------------------------------------------
    return report(state, config, out, perceptual) if rank == 0 else {}


def step(
    state: TrainState,
    parallel: torch.nn.Module,
    config: Config,
    late: Callable[[], bool] = lambda: False,
) -> None:
    """Take one optimiser step over ``accumulate`` views, or over those seen when it is ``late``.

    Raises:
        DivergedError: something is not finite.
        FormatError, OSError: a view cannot be read.
    """
    state.optimizer.zero_grad(set_to_none=True)
    for left in reversed(range(config.train.accumulate)):
        item = state.views.item(state.shuffle.next(), crop=True)
        state.views.prefetch(state.shuffle.peek())
        shared = left == 0 or not isinstance(parallel, DistributedDataParallel)
        # Gradients are exchanged once per step, with the last view's.
        with contextlib.nullcontext() if shared else parallel.no_sync():
            try:
                rows = state.model.rows(*item.key.frame)
                rendering = parallel(*rows, item.state, item.view, state.views.background)
            except NotFiniteTensorError as error:
                raise DivergedError(
                    f"iteration {state.iteration}: training diverged ({error}); lower train.lr and "
                    "start over with --overwrite"
                ) from None
            terms = objective(state, rendering, item, config)
            loss = torch.stack(list(terms.values())).sum()
            state.terms = {name: term.detach() for name, term in terms.items()}
            if not bool(torch.isfinite(loss)):
                shown = (f"{name} {float(term):.4g}" for name, term in state.terms.items())
                raise DivergedError(
                    f"iteration {state.iteration}: the objective is not finite at {item.key.name}"
                    f" ({', '.join(shown)}); check this sample, or lower train.lr and start over"
                    " with --overwrite"
                )
            (loss / config.train.accumulate).backward()
        if late():
            break
    state.optimizer.step()


def objective(
    state: TrainState, rendering: Rendering, item: HeadView, config: Config
) -> dict[str, Tensor]:
    """Compute the weighted terms of the objective by name (paper: Training and Losses)."""
    weights, model = config.loss, state.model
    rendering = item.hide_behind_torso(rendering)
    images = {"rgb": item.comparable(rendering.rgb)}
    if model.refinement is not None:
        images["image"] = item.comparable(rendering.image)
    terms = {n: losses.reconstruction(image, item.target, weights) for n, image in images.items()}
    if state.perceptual is not None:
        for name, image in images.items():
            terms[f"perceptual_{name}"] = losses.PERCEPTUAL * state.perceptual(image, item.target)
    error = losses.depth_dm2(rendering.depth, rendering.alpha, item.depth, item.depth_valid)
    terms["depth"] = weights.depth * error
    if state.own_terms is not None:
        terms |= state.own_terms(state, rendering, item)
    codes, gaussians = model.codes(*model.rows(*item.key.frame)), rendering.gaussians
    terms["scale"] = weights.scale * losses.scale_mm(gaussians.scales_mm)
    terms["codes"] = weights.codes * losses.codes(*codes)
    if weights.laplacian:
        mesh = item.state.vertices + gaussians.displacement
        terms["laplacian"] = weights.laplacian * losses.laplacian_mm2(mesh, state.edges)
    if weights.displacement:
        error = losses.displacement_mm2(gaussians.displacement)
        terms["displacement"] = weights.displacement * error
    return terms


def report(
    state: TrainState, config: Config, out: Path, perceptual: PerceptualMetrics
) -> dict[str, object]:
    """Evaluate, draw previews and write metrics.json, unless it has the figures of this state."""
    measured: dict[str, object] = {
        "iterations": state.iteration,
        "seconds": round(state.seconds, 2),
        "measured_with": as_tables(config)["metrics"] | {"images": config.train.evaluate_images},
    }
    with contextlib.suppress(FormatError):  # there is none, or it is damaged
        found = read_json_table(out / "metrics.json", FormatError)
        if measured.items() <= found.items():
            log(f"{out}: the figures were measured before; delete metrics.json to measure again")
            return found
    log("measuring the model, component by component, and drawing previews")
    model, views, count = state.model, state.views, config.train.evaluate_images
    render = training_render(model, views)
    trained = {views.keys[i].frame for i in state.training}
    held = [i for i in state.holdout if views.keys[i].frame in trained]
    new = [i for i in state.holdout if views.keys[i].frame not in trained]
    training = evaluate(views, evenly(state.training, count), render)
    holdout = evaluate(views, evenly(held, count), render, perceptual)
    expressions = evaluate(views, evenly(new, count), render)
    metrics: dict[str, object] = {
        "psnr_train_db": mean(training, "psnr_db"),
        "psnr_heldout_view_db": mean(holdout, "psnr_db"),
        **{
            f"psnr_heldout_view_{region}_db": mean(holdout, f"psnr_{region}_db")
            for region in ("head", *REGIONS)
        },
        "components_gain_on": "held-out views" if held else "training views",
        "components_gain_db": component_effects(
            model, views, evenly(held or state.training, count)
        ),
        "psnr_heldout_expression_db": mean(expressions, "psnr_db"),
        "ssim": mean(holdout or training, "ssim"),
        "rmse": mean(holdout or training, "rmse"),
        "lpips": mean(holdout, "lpips"),
        "fid": perceptual.fid(),
        "depth_median_mm": mean(holdout or training, "depth_mm"),
        "heldout_images": len(holdout),
        "heldout_cameras": sorted({views.keys[i].camera for i in held}),
        "training_views": len(state.training),
        "subjects": list(model.subjects),
        "expressions": list(model.expressions),
        "gaussians": len(model.texels),
        "texels": config.model.n_g**2,
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        **measured,
        "iterations_per_second": round(state.iteration / max(state.seconds, 1e-9), 3),
        "terms": {name: round(float(value), 6) for name, value in state.terms.items()},
    }
    metrics |= perceptual.missing()
    for name, indices in (("training", state.training), ("heldout", state.holdout)):
        if indices:
            comparison_sheet(out / "preview" / f"{name}.jpg", views, evenly(indices, 6), render)
    write_json(out / "metrics.json", metrics)
    return metrics


def diverged(metrics: Mapping[str, object]) -> bool:
    """Return whether a grey picture would score better; False for no metrics."""
    psnr_db = metrics.get("psnr_train_db")
    return isinstance(psnr_db, float) and psnr_db < GREY_DB


def join_processes() -> tuple[int, int, torch.device]:
    """Join the group that ``torchrun`` describes; returns rank, number of processes and device."""
    world, device = int(os.environ.get("WORLD_SIZE", "1")), best_device()
    if world > 1:
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return int(os.environ.get("RANK", "0")), world, device


def synchronise(state: TrainState, interrupt: Event, device: torch.device) -> None:
    """Give all processes the same clock and request to stop; otherwise they would deadlock."""
    common = torch.tensor([state.seconds, float(interrupt.is_set())], device=device)
    distributed.all_reduce(common, distributed.ReduceOp.MAX)
    state.seconds = float(common[0])
    if common[1] > 0:
        interrupt.set()


def progress_line(state: TrainState, config: Config) -> str:
    """Describe the iteration, the speed, the time left and the terms in one line."""
    rate = state.iteration / max(state.seconds, 1e-9)
    used = min(1.0, budget_used(state, config))  # the last step may end late
    left = timedelta(seconds=round(state.seconds * (1 - used) / used if used > 0 else 0))
    terms = " ".join(f"{name} {float(value):.4f}" for name, value in state.terms.items())
    return f"iteration {state.iteration}  {rate:.2f}/s  {left} left  {terms}"
