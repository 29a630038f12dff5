"""A training run's state: model, samples held out and not, optimiser, schedule."""

from __future__ import annotations

import fnmatch
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from express50.errors import ConfigError, TrainError
from grmm import losses
from grmm.config import Config
from grmm.data import HeadViews, Key
from grmm.model import GRMM
from grmm.order import Shuffle, spread
from grmm.perceptual import load_vgg

COVERED_TEXELS = 0.75  # of a map that head models' layouts use
LARGEST_MAP = 512  # the paper's


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
    average: AveragedModel | None = None

    @property
    def result(self) -> GRMM:
        """The model that is kept: of averaged weights where there are any."""
        return self.model if self.average is None else self.average.module


def settle(config: Config, views: HeadViews) -> Config:
    """The configuration with n_g chosen from the head's size in the images where it is 0.

    A texel a pixel: the largest heads show half of their surface, and a map covers three quarters
    of its texels. More Gaussians than pixels would cost time and show nothing.
    """
    if config.model.n_g:
        return config
    training, _ = split_samples(views.keys, config)
    areas = [int(views.item(i).mask.sum()) for i in spread(training, 16)]
    step = 2 ** (len(config.model.ladder) + 1)
    side = step * math.ceil(math.sqrt(2 * max(areas) / COVERED_TEXELS) / step)
    n_g = max(2 * step, min(side, LARGEST_MAP))
    return replace(config, model=replace(config.model, n_g=n_g))


def best_device() -> torch.device:
    """The CUDA device of this process, as ``torchrun`` numbers them, where there is one."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device(f"cuda:{os.environ.get('LOCAL_RANK', '0')}")


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
    averaging = get_ema_multi_avg_fn(config.train.ema)
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
        average=AveragedModel(model, multi_avg_fn=averaging) if config.train.ema else None,
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
