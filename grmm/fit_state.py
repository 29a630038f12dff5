"""Hold the state of a fit: start it, save it, resume it, and write the fitted model."""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from express50.console import log
from express50.errors import ConfigError
from grmm import losses
from grmm.checkpoint import (
    TRAINING,
    Checkpoint,
    Gallery,
    collect_gallery,
    load_checkpoint,
    save_checkpoint,
)
from grmm.config import Config
from grmm.data import NO_OFFSETS, HeadView, HeadViews
from grmm.edit import transfer
from grmm.evaluate import SEEN, kind_of
from grmm.model import GRMM, PinholeView, Rendering
from grmm.train_state import CHANGEABLE, differences, refuse_changes

Scores = dict[str, float | None]
FIT = "fit"  # name of its state in a checkpoint's loop


@dataclass(kw_only=True)
class FitProgress:
    """How far a fit is: its stage, the iterations and seconds of each stage, and the scores."""

    stage: int = 1
    iterations: dict[int, int] = field(default_factory=lambda: {1: 0, 2: 0})
    seconds: dict[int, float] = field(default_factory=lambda: {1: 0.0, 2: 0.0})
    scores: dict[str, Scores] = field(default_factory=dict)


@dataclass(kw_only=True)
class FitState:
    """Everything that a fit reads or changes, such as the tuned model and the fitted codes."""

    loaded: Checkpoint
    model: GRMM
    views: HeadViews
    given: list[int]
    z_id: Tensor
    z_exp: dict[str, Tensor]
    perceptual: torch.nn.Module | None
    rng: np.random.Generator
    done: FitProgress = field(default_factory=FitProgress)
    optimizer: torch.optim.Optimizer | None = None
    saved_optimizer: dict[str, Any] = field(default_factory=dict)

    @property
    def config(self) -> Config:
        """Return the settings of the checkpoint fitted from."""
        return self.loaded.config

    def render(self, item: HeadView, shade_view: PinholeView | None = None) -> Rendering:
        """Render the person in a view; an expression that is not fitted has its trained code."""
        name, trained = item.key.expression, self.model.expressions
        z_exp = self.z_exp[name] if name in self.z_exp else self.model.z_exp[trained.index(name)]
        return self.model.render(
            self.z_id, z_exp, item.state, item.view, self.views.background, shade_view
        )


def start(loaded: Checkpoint, views: HeadViews, given: list[int]) -> FitState:
    """Start from the mean codes and a copy of the model; known expressions keep their codes."""
    subjects = sorted({views.keys[i].subject for i in given})
    if len(subjects) != 1:
        raise ConfigError(
            f"got views of {len(subjects)} subjects ({', '.join(subjects) or 'none'}), "
            "expected one; choose one with --subject"
        )
    views.check_mattes(given)
    model = loaded.model
    codes = model.z_exp.detach()
    known = dict(zip(model.expressions, codes, strict=True))
    expressions = sorted({views.keys[i].expression for i in given})
    return FitState(
        loaded=loaded,
        model=copy.deepcopy(model),
        views=views,
        given=given,
        z_id=model.z_id.detach().mean(0),
        z_exp={name: known.get(name, codes.mean(0)).clone() for name in expressions},
        perceptual=losses.load_vgg(loaded.config.loss.vgg16, codes.device),
        rng=np.random.default_rng(loaded.config.train.seed),
    )


def use_optimizer(state: FitState, optimizer: torch.optim.Optimizer) -> torch.optim.Optimizer:
    """Take a stage's optimiser, and continue with its saved state if the fit was resumed in it."""
    if state.saved_optimizer:
        optimizer.load_state_dict(state.saved_optimizer)
        state.saved_optimizer = {}
    state.optimizer = optimizer
    return optimizer


def inputs(state: FitState) -> dict[str, object]:
    """Describe what a fit is made from, so that another fit is not continued by mistake."""
    weights = hashlib.sha256()
    for name, tensor in sorted(state.loaded.model.state_dict().items()):
        weights.update(name.encode())
        weights.update(tensor.cpu().contiguous().numpy())
    return {
        "the checkpoint to fit from": weights.hexdigest(),
        "the samples of the shards": state.views.source.digest,
        "the views to fit to": [str(state.views.keys[i]) for i in state.given],
    }


def save_unfinished(state: FitState, path: Path, made_from: dict[str, object]) -> None:
    """Write a checkpoint that `resume` continues from; it renders like a finished one."""
    loop = {
        "inputs": made_from,
        "progress": vars(state.done),
        "random": state.rng.bit_generator.state,
    }
    optimizer = state.optimizer.state_dict() if state.optimizer else {}
    save_fit(state, path, optimizer, {FIT: loop})


def resume(state: FitState, path: Path, made_from: dict[str, object]) -> None:
    """Put a fit where `save_unfinished` left it; ConfigError if it is finished or another one."""
    saved = load_checkpoint(path, state.z_id.device)
    if FIT not in saved.loop:
        raise ConfigError(f"{path} exists; name another folder, or overwrite it with --overwrite")
    loop, tables = saved.loop[FIT], ("model", "loss", "data", "train", "fit")
    budget = {("fit", "seconds"), *(("train", key) for key in CHANGEABLE)}
    changed = [name for name, value in made_from.items() if loop["inputs"][name] != value]
    changed += differences(saved.config, state.config, tables, budget)
    refuse_changes(path, changed, "fit into another folder")
    content = saved.model.state_dict()
    codes = content.pop("z_exp")
    state.z_id = content.pop("z_id")[0].clone()
    state.z_exp = {name: codes[n].clone() for n, name in enumerate(state.z_exp)}
    state.model.load_state_dict(content, strict=False)  # its own codes are of other people
    state.saved_optimizer = saved.optimizer
    state.rng.bit_generator.state = loop["random"]
    state.done = FitProgress(**loop["progress"])
    stage = state.done.stage
    log(f"{path}: resuming stage {stage} at iteration {state.done.iterations[stage]}")


def save_fit(
    state: FitState,
    path: Path,
    optimizer: dict[str, Any] | None = None,
    loop: dict[str, Any] | None = None,
) -> None:
    """Write a checkpoint of the tuned model, whose only subject is the fitted one.

    It keeps the expressions of training (their codes, and one frame of parameters each), so that
    they can be transferred to the subject.
    """
    subject = state.views.keys[state.given[0]].subject
    former = state.loaded.model
    trained_codes = zip(former.expressions, former.z_exp.detach(), strict=True)
    known = {name: code for name, code in trained_codes if name not in state.z_exp}
    model = GRMM(state.model.config, state.views.head, [subject], [*state.z_exp, *known])
    content = state.model.state_dict()
    content["z_id"] = state.z_id.detach()[None]
    content["z_exp"] = torch.stack([*state.z_exp.values(), *known.values()]).detach()
    model.load_state_dict(content)
    own, trained = collect_gallery(state.views, state.given), state.loaded.gallery
    # One training frame per expression, without its person's offsets.
    donors: dict[str, tuple[str, str]] = {}
    for frame in trained.frames:
        if frame[1] in known:
            donors.setdefault(frame[1], frame)
    mine = next(iter(own.frames.values()))
    frames = {
        f: transfer(mine, trained.frames[f])
        if f[0] == subject  # a person of the training keeps the head that was fitted now
        else replace(trained.frames[f], offsets=NO_OFFSETS)
        for f in donors.values()
    }
    # Training cameras stay for rendering; the subject's own come first.
    cameras: dict[str, PinholeView] = own.cameras | {
        f"{TRAINING}{name}": view for name, view in trained.cameras.items()
    }
    save_checkpoint(
        path,
        model=model,
        config=state.config,
        head_spec=state.loaded.head_spec,
        gallery=Gallery(frames=own.frames | frames, cameras=cameras),
        seen_before={
            (key.expression, key.camera)
            for key in state.views.keys
            if key.subject == subject and kind_of(state.loaded, key) == SEEN
        },
        optimizer=optimizer,
        loop=loop,
    )
