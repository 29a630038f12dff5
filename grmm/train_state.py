"""Hold the state of a training run: set it up, save and resume it, and end it."""

from __future__ import annotations

import contextlib
import fnmatch
import json
import math
import os
import signal
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, current_thread, main_thread

import torch
from torch import Tensor

from express50.console import log
from express50.errors import FEW, ConfigError, TrainError, few
from express50.files.atomic import write_bytes
from express50.files.text import read_text
from express50.geometry.sampling import evenly
from grmm import losses
from grmm.checkpoint import Gallery, load_checkpoint, save_checkpoint
from grmm.config import Config, as_tables
from grmm.data import HeadView, HeadViews, SampleKey, Shuffle, with_codes
from grmm.model import GRMM, Rendering

COVERED_TEXELS = 0.75  # of a map that head models' layouts use
LARGEST_MAP = 512  # the paper's
SAVING_SHARE = 0.05  # at most this share of the time
REPORT = (  # files that show how good a checkpoint is
    "metrics.json", "given.jpg", "held_out.jpg", "preview/training.jpg", "preview/heldout.jpg",
)  # fmt: skip
SAY_SECONDS = 10.0  # between lines of progress, at most
CHANGEABLE = {"iterations", "seconds", "save_seconds", "evaluate_images"}  # when a run is resumed


Terms = Callable[["TrainState", Rendering, HeadView], dict[str, Tensor]]
"""Terms of one's own in the objective, 0-d tensors by name, weights included."""


@dataclass(kw_only=True)
class TrainState:
    """Everything that the training loop changes, and what it reads in every step."""

    model: GRMM
    views: HeadViews
    training: list[int]
    holdout: list[int]
    optimizer: torch.optim.Optimizer
    shuffle: Shuffle
    perceptual: torch.nn.Module | None
    edges: Tensor
    iteration: int = 0
    seconds: float = 0.0
    terms: dict[str, Tensor] = field(default_factory=dict)
    own_terms: Terms | None = None


def prepare(views: HeadViews, config: Config, rank: int = 0, world: int = 1) -> TrainState:
    """Build the model, its optimiser and the order of samples."""
    keys = views.keys
    training, holdout = split_samples(keys, config)
    subjects = sorted({keys[i].subject for i in training})
    expressions = sorted({keys[i].expression for i in training})
    model = GRMM(config.model, views.head, subjects, expressions).to(views.head.device)
    return TrainState(
        model=model,
        views=views,
        training=training,
        holdout=with_codes(keys, holdout, subjects, expressions),
        optimizer=make_optimizer(model, config),
        shuffle=Shuffle(training, config.train.seed, rank, world),
        perceptual=losses.load_vgg(config.loss.vgg16, views.head.device),
        edges=losses.mesh_edges(views.head.faces),
    )


def with_map_size(config: Config, views: HeadViews) -> Config:
    """Replace ``n_g = 0`` with a side that suits the head's size in the images.

    The aim is one texel per pixel: the largest heads show half of their surface.
    """
    if config.model.n_g:
        return config
    training, _ = split_samples(views.keys, config)
    areas = [int(views.item(i).mask.sum()) for i in evenly(training, 16)]
    step = 2 ** (len(config.model.ladder) + 1)
    side = step * math.ceil(math.sqrt(2 * max(areas) / COVERED_TEXELS) / step)
    n_g = max(2 * step, min(side, LARGEST_MAP))
    return replace(config, model=replace(config.model, n_g=n_g))


def best_device() -> torch.device:
    """Return the CUDA device of this process as ``torchrun`` numbers them, else the CPU."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    device = torch.device(f"cuda:{os.environ.get('LOCAL_RANK', '0')}")
    torch.cuda.set_device(device)  # gsplat's kernels and NCCL take the current one
    return device


def gpu() -> tuple[str, float] | None:
    """Return the name and the memory, GiB, of this process' GPU; None if there is none."""
    device = best_device()
    if device.type == "cpu":
        return None
    found = torch.cuda.get_device_properties(device)
    return found.name, found.total_memory / 2**30


def split_samples(keys: Sequence[SampleKey], config: Config) -> tuple[list[int], list[int]]:
    """Split samples into those to train on and those held out by camera or expression.

    Raises:
        ConfigError: a held-out name fits no sample.
        TrainError: nothing is left to train on.
    """
    cameras, frames = {key.camera for key in keys}, {"/".join(key.frame) for key in keys}
    held = _matching("holdout_cameras", config.data.holdout_cameras, cameras)
    unseen = _matching("holdout_expressions", config.data.holdout_expressions, frames)
    holdout = [
        i for i, key in enumerate(keys) if key.camera in held or "/".join(key.frame) in unseen
    ]
    training = sorted(set(range(len(keys))) - set(holdout))
    if not training:
        raise TrainError(
            f"no views to train on: all {len(keys)} samples are held out by camera or expression; "
            "hold out fewer or pack more"
        )
    return training, holdout


def _matching(setting: str, patterns: Iterable[str], known: Collection[str]) -> set[str]:
    """Return the names that match any of the patterns; refuse a pattern that none matches."""
    found = {pattern: fnmatch.filter(known, pattern) for pattern in patterns}
    for pattern, names in found.items():
        if not names:
            expected = few(sorted(known), FEW)
            raise ConfigError(f"data.{setting} names {pattern}; expected some of {expected}")
    return set().union(*found.values())


def make_optimizer(model: GRMM, config: Config) -> torch.optim.Optimizer:
    """Build Adam with a rate for each of `GRMM.parameter_groups`."""
    scales = {  # checkpoints hold the groups in this order
        "decoders": 1.0,
        "codes": config.train.code_lr_scale,
        "texels": config.train.texel_lr_scale,
        "refinement": config.train.refine_lr_scale,
    }
    parameters = model.parameter_groups()
    groups = [{"params": parameters[name], "scale": scale} for name, scale in scales.items()]
    return torch.optim.Adam(groups, lr=config.train.lr, fused=True)


def budget_used(state: TrainState, config: Config) -> float:
    """Return the share of the budget used, by iterations or by seconds, whichever is further."""
    by_time = state.seconds / config.train.seconds if config.train.seconds else 0.0
    return max(state.iteration / config.train.iterations, by_time)


def finished(state: TrainState, config: Config) -> bool:
    """Return True when iterations or seconds are used up."""
    return budget_used(state, config) >= 1


def set_rates(state: TrainState, config: Config) -> None:
    """Set the rates for this share of the budget: a half cosine from 1 to ``final_lr``."""
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, budget_used(state, config))))
    factor = config.train.final_lr + (1 - config.train.final_lr) * cosine
    for group in state.optimizer.param_groups:
        group["lr"] = config.train.lr * group["scale"] * factor


@contextlib.contextmanager
def saving(
    path: Path, save: Callable[[Path], None], every: float
) -> Iterator[Callable[[bool], None]]:
    """Yield a function to call after each step, which saves when it is time, or if told it is last.

    It is time when ``every`` seconds have passed (0: never), or more, if saving would otherwise
    take more than `SAVING_SHARE` of the time. The report on the checkpoint that is replaced goes,
    so that none is left beside another's after a kill. A spare file reserves the space for the next
    checkpoint, so that the state can still be saved if others fill the disk meanwhile.
    """
    spare = path.with_name(f".{path.name}.spare")
    saved, cost = time.perf_counter(), 0.0

    def after_step(last: bool) -> None:
        nonlocal saved, cost
        now = time.perf_counter()
        due = every > 0 and now - saved >= max(every, cost / SAVING_SHARE)
        if due or last:
            # Free the spare's space. A second name keeps the former file when the next checkpoint
            # takes its place: no byte is copied.
            spare.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # none yet, or a disk without second names
                spare.hardlink_to(path)
            save(path)
            for name in REPORT:
                (path.parent / name).unlink(missing_ok=True)
            saved = time.perf_counter()
            cost = saved - now
        elif not spare.exists():
            save(spare)

    try:
        yield after_step
    finally:
        spare.unlink(missing_ok=True)


def save(state: TrainState, path: Path, config: Config, head_spec: str, gallery: Gallery) -> None:
    """Write a checkpoint with the loop's full state."""
    save_checkpoint(
        path,
        model=state.model,
        config=config,
        head_spec=head_spec,
        gallery=gallery,
        optimizer=state.optimizer.state_dict(),
        loop={
            "iteration": state.iteration,
            "seconds": state.seconds,
            "samples": state.views.source.digest,
            "shuffle": state.shuffle.state(),
            "torch": torch.get_rng_state(),
        },
    )


def restore(state: TrainState, path: Path, config: Config, device: torch.device) -> None:
    """Restore a run to the point where rank 0 wrote its checkpoint.

    Raises:
        ConfigError: settings, subjects or samples differ from those of the checkpoint.
    """
    loaded = load_checkpoint(path, device)
    if "shuffle" not in loaded.loop:
        raise ConfigError(
            f"{path}: holds no state to resume from (a person was withdrawn from it, or it is a "
            "fit); train into another folder, or start over with --overwrite"
        )
    tables = ("model", "loss", "data", "train")
    changed = differences(loaded.config, config, tables, {("train", key) for key in CHANGEABLE})
    for what in ("subjects", "expressions"):
        if lone := sorted({*getattr(loaded.model, what)} ^ {*getattr(state.model, what)}):
            changed.append(f"the {what} of the shards ({few(lone)} only before or only now)")
    if loaded.loop["samples"] != state.views.source.digest:
        changed.append("the samples of the shards")
    refuse_changes(path, changed, "train into another folder")
    state.model.load_state_dict(loaded.model.state_dict())
    state.optimizer.load_state_dict(loaded.optimizer)
    state.shuffle.restore(loaded.loop["shuffle"])
    torch.set_rng_state(loaded.loop["torch"])
    state.iteration, state.seconds = loaded.loop["iteration"], loaded.loop["seconds"]
    if finished(state, config):
        log(
            f"{path}: its budget is used up, after {state.iteration} iterations in "
            f"{state.seconds:.1f} s; to train on, raise train.iterations or --budget"
        )
    else:
        log(f"{path}: resuming at iteration {state.iteration}")


def differences(
    old: Config, new: Config, tables: Iterable[str], but: Collection[tuple[str, str]]
) -> list[str]:
    """List the settings in these tables that differ, except for ``but``, as (table, key)."""
    before, after = as_tables(old), as_tables(new)
    return [
        f"{table}.{key} {before[table][key]!r} -> {value!r}"
        for table in tables
        for key, value in after[table].items()
        if value != before[table][key] and (table, key) not in but
    ]


def refuse_changes(path: Path, changed: Sequence[str], elsewhere: str) -> None:
    """Raise ConfigError if anything differs from what an unfinished checkpoint was made with."""
    if changed:
        raise ConfigError(
            f"{path}: cannot resume, these differ: {'; '.join(changed)}. "
            f"Keep these settings, {elsewhere}, or start over with --overwrite"
        )


def start_log(path: Path, iteration: int) -> None:
    """Keep the log's lines up to an iteration: a resumed run repeats the later ones."""
    if not path.exists():
        return
    kept = []
    for line in read_text(path, TrainError).splitlines():
        # A kill may have cut the last line short.
        with contextlib.suppress(ValueError, TypeError, KeyError):
            if json.loads(line)["iteration"] <= iteration:
                kept.append(line + "\n")
    write_bytes(path, "".join(kept).encode())


def append_log(path: Path, state: TrainState) -> None:
    """Append the progress of a run to OUT/log.jsonl, one JSON object per line."""
    terms = {name: float(value) for name, value in state.terms.items()}
    numbers = {"loss": sum(terms.values())} | terms
    entry = {"iteration": state.iteration, "seconds": round(state.seconds, 3)}
    entry |= {name: round(value, 8) for name, value in numbers.items()}
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
    except OSError as error:  # the disk is full; the weights matter more than a log line
        log(f"{path}: could not write a log line ({error})")


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Event]:
    """Let the current iteration end before a stop takes effect: it sets the event.

    That is Ctrl-C, SIGTERM, or the end of a terminal or connection, unless ``nohup`` ignores it.
    """
    interrupt, former = Event(), {}

    def stop(number: int, frame: object) -> None:
        if not interrupt.is_set():
            interrupt.set()
            with contextlib.suppress(RuntimeError):  # it came while another line was written
                log("stopping: this step ends, then it is saved")

    try:
        if current_thread() is main_thread():  # no other gets signals
            hangup = (signal.SIGHUP,) if signal.getsignal(signal.SIGHUP) == signal.SIG_DFL else ()
            for number in (signal.SIGINT, signal.SIGTERM, *hangup):
                former[number] = signal.signal(number, stop)
        yield interrupt
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
