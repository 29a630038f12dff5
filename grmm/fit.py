"""Fit an unseen person by inverse rendering, in the paper's two stages; measure on other views.

Stage 1 inverts the codes with all networks fixed, starting from the mean code. Stage 2 fixes the
codes and fine-tunes the decoders, held near the pretrained model by the locality loss, and the mesh
near the tracked one where training held it there. G22 lists what the paper leaves open: iterations,
rates, cameras of the locality loss.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from express50.console import figure_label, format_seconds, log
from express50.errors import ConfigError, DivergedError
from express50.files.atomic import check_space, dump_json, write_json
from express50.geometry.sampling import evenly
from grmm import losses
from grmm.checkpoint import Checkpoint
from grmm.config import as_tables
from grmm.data import HeadView, HeadViews, Shuffle, with_codes
from grmm.edit import HeadCodes, between, trained_head
from grmm.evaluate import HELD_IDENTITY, SEEN, Journal, Row, evaluate, kind_of, mean
from grmm.fit_state import (
    FitState,
    Scores,
    inputs,
    resume,
    save_fit,
    save_unfinished,
    start,
    use_optimizer,
)
from grmm.metrics import PerceptualMetrics
from grmm.model import PinholeView, Rendering
from grmm.render import comparison_sheet
from grmm.shard_source import select
from grmm.train_state import SAY_SECONDS, deferred_interrupt, saving
from grmm.warm_start import LOGIT_LIMIT, project_texture, spread_change

Keep = Callable[[bool], None]
"""Is called after each step, with whether it was the last; may save the fit."""
Keeping = Callable[[], contextlib.AbstractContextManager[Keep | None]]
SCORED_PICTURES = 12  # pictures scored between the stages
STAGE1_SHARE = 0.35  # of a time budget (G22)
STAGE1_LR = 1e-2  # learning rate of the codes: they are few and start at a mean (G22)
STAGE1_FINAL_LR = 0.1  # rate at the end of stage 1 over the rate at its start (G22)
LOCALITY_T = 0.3  # weight of the fitted subject in the interpolation (paper, supplement)
FITS = "unfinished_fits"  # folder that a stopped measurement continues from
NOVEL_VIEW = f"{HELD_IDENTITY}, novel view"
NOVEL_EXPRESSION = f"{HELD_IDENTITY}, other expression"


def fit(
    loaded: Checkpoint,
    views: HeadViews,
    given: Sequence[int],
    held_out: Sequence[int],
    out: Path,
    *,
    continued: bool = False,
) -> dict[str, object]:
    """Fit one subject from the views ``given``; report on them and on ``held_out``.

    Views that training saw, of a person who was in training, do not count as held out.
    Every expression among the views gets its own z_exp; z_id is common. Writes OUT/checkpoint.pt
    (the tuned model, whose only subject is the fitted one), OUT/metrics.json and OUT/*.jpg. The
    checkpoint is saved as `grmm train` saves its own. ``continued`` goes on from the one in OUT,
    whose inputs and settings must be the same except for the budget.

    Raises:
        TrainError: no view shows the head.
        ConfigError: no views, or views of several subjects; the checkpoint in OUT is of a finished
            fit, or of another one.
    """
    judge = PerceptualMetrics(loaded.config.metrics)  # first, because it may reject its files
    state, checkpoint = start(loaded, views, list(given)), out / "checkpoint.pt"
    out.mkdir(parents=True, exist_ok=True)
    check_space(out)
    made_from = inputs(state)
    if continued:
        resume(state, checkpoint, made_from)
    held_out = [
        i
        for i in held_out
        if views.keys[i].expression in state.z_exp and kind_of(loaded, views.keys[i]) != SEEN
    ]
    keeping = partial(_kept, state, checkpoint, made_from)
    effort = run_stages(state, lambda: _scores(state, held_out), keeping)
    rows = evaluate(views, held_out or state.given, state.render, judge)
    metrics: dict[str, object] = {
        "subject": views.keys[state.given[0]].subject,
        "expressions": sorted(state.z_exp),
        "cameras": sorted({views.keys[i].camera for i in state.given}),
        "held_out_cameras": sorted({views.keys[i].camera for i in held_out}),
        "psnr_db": mean(rows, "psnr_db"),
        "psnr_is_of": "held-out views" if held_out else "given views: none was held out",
        "stages": state.done.scores,
        "lpips": mean(rows, "lpips"),
        "rmse": mean(rows, "rmse"),
        "fid": judge.fid(),
    }
    metrics |= effort | judge.missing()
    comparison_sheet(out / "given.jpg", views, state.given[:6], state.render)
    if held_out:
        comparison_sheet(out / "held_out.jpg", views, held_out[:6], state.render)
    write_json(out / "metrics.json", metrics)
    save_fit(state, checkpoint)  # last, because then the fit counts as finished
    return metrics


def run_stages(
    state: FitState, score: Callable[[], Scores], keeping: Keeping = contextlib.nullcontext
) -> dict[str, object]:
    """Run what is left of both stages within the time budget; returns the effort.

    Scores before, between and after them go to ``state.done``; the time that scoring takes does
    not count against the budget. ``keeping`` makes what surrounds a stage and saves its state.
    """
    settings, done = state.config.fit, state.done
    budget = settings.seconds or math.inf
    torch.manual_seed(state.config.train.seed)
    if not done.scores:
        done.scores["mean_code"] = score()
    if done.stage == 1:
        with keeping() as keep:
            invert_codes(state, STAGE1_SHARE * budget, keep)
        done.scores["stage1"] = score()
        done.stage = 2
        if settings.texture_warm_start and settings.stage2_iterations:
            began = time.perf_counter()
            start_texture(state)
            done.seconds[2] = time.perf_counter() - began
    with keeping() as keep:
        tune_decoders(state, budget - done.seconds[1], keep)
    done.scores["stage2"] = score()
    return {
        "stage1_iterations": done.iterations[1],
        "stage2_iterations": done.iterations[2],
        "iterations": sum(done.iterations.values()),
        "seconds": round(sum(done.seconds.values()), 2),
    }


@contextlib.contextmanager
def _kept(state: FitState, path: Path, made_from: dict[str, object]) -> Iterator[Keep]:
    """Yield a function that saves after steps, and ends the fit after one in which Ctrl-C came."""
    save = partial(save_unfinished, state, made_from=made_from)
    every = state.config.train.save_seconds
    with deferred_interrupt() as interrupt, saving(path, save, every) as after_step:

        def keep(last: bool) -> None:
            after_step(last or interrupt.is_set())
            if interrupt.is_set():  # only now, after the save
                raise KeyboardInterrupt

        yield keep


def invert_codes(state: FitState, limit: float = math.inf, keep: Keep | None = None) -> None:
    """Optimise z_id and z_exp (stage 1) for at most this many seconds."""
    settings = state.config.fit
    state.model.requires_grad_(False)
    codes = [state.z_id, *state.z_exp.values()]
    for code in codes:
        code.requires_grad_(True)
    optimizer = use_optimizer(state, torch.optim.Adam(codes, lr=STAGE1_LR))
    for number, share, item in _items(state, 1, settings.stage1_iterations, limit, keep):
        optimizer.param_groups[0]["lr"] = STAGE1_LR * STAGE1_FINAL_LR**share
        optimizer.zero_grad()
        rendering, z_exp = state.render(item), state.z_exp[item.key.expression]
        loss = state.config.loss.codes * losses.codes(state.z_id, z_exp)
        _finite(_footage_loss(state, rendering, item) + loss, number, 1).backward()
        optimizer.step()
    for code in codes:
        code.requires_grad_(False)


def tune_decoders(state: FitState, limit: float = math.inf, keep: Keep | None = None) -> None:
    """Fine-tune the decoders with the locality loss (stage 2)."""
    settings, train = state.config.fit, state.config.train
    # Adam moves the decoders; codes and refinement stay fixed.
    rates = {"decoders": settings.stage2_lr, "texels": settings.stage2_lr * train.texel_lr_scale}
    parameters = state.model.parameter_groups()
    for parameter in (*parameters["decoders"], *parameters["texels"]):
        parameter.requires_grad_(True)
    groups = [{"params": parameters[name], "lr": rate} for name, rate in rates.items()]
    optimizer = use_optimizer(state, torch.optim.Adam(groups, fused=True))
    for number, _, item in _items(state, 2, settings.stage2_iterations, limit, keep):
        optimizer.zero_grad()
        shuffled = state.rng.random() < settings.shuffle_directions
        shade = random_camera(state) if shuffled else None
        rendering = state.render(item, shade)
        # Few views do not say where the mesh should be: it stays near the tracked one.
        moved = losses.displacement_mm2(rendering.gaussians.displacement)
        loss = _footage_loss(state, rendering, item) + state.config.loss.displacement * moved
        if settings.locality and number % settings.locality_every == 0:
            weight = settings.locality * settings.locality_every
            loss = loss + weight * locality_loss(state, item)
        _finite(loss, number, 2).backward()
        optimizer.step()
    state.model.requires_grad_(False)


def _items(
    state: FitState, stage: int, iterations: int, limit: float, keep: Keep | None = None
) -> Iterator[tuple[int, float, HeadView]]:
    """Yield given views in shuffled order until iterations or time run out; at least one.

    Each comes with its number and the share of the iterations or of the time that is used up.
    After each, ``keep`` hears whether it was the last.
    """
    done, shuffle = state.done, Shuffle(state.given, state.config.train.seed)
    number = shuffle.taken = done.iterations[stage]
    said = time.perf_counter()
    began = said - done.seconds[stage]
    used = done.seconds[stage] / max(limit, 1e-9)
    while number < iterations and (number == 0 or used < 1):
        share = max(number / iterations, min(used, 1.0))
        if number > 0 and time.perf_counter() - said >= SAY_SECONDS:
            said = time.perf_counter()
            left = format_seconds((said - began) * (1 - share) / share)
            log(f"fit: stage {stage}, iteration {number}, {left} of this stage left")
        yield number, share, state.views.item(shuffle.next(), crop=True)
        number += 1
        done.iterations[stage], done.seconds[stage] = number, time.perf_counter() - began
        used = done.seconds[stage] / max(limit, 1e-9)
        if keep is not None:
            keep(number == iterations or used >= 1)


def start_texture(state: FitState) -> None:
    """Put the colours that the given views show into the bias (FitConfig.texture_warm_start).

    Texels that no view shows change like seen texels that looked similar before and lie near them
    or near their mirror image. So a paler face comes with paler ears.
    """
    model = state.model
    shown = []
    for expression, z_exp in state.z_exp.items():
        own = [i for i in state.given if state.views.keys[i].expression == expression]
        shown.append(project_texture(model, state.views, own, state.z_id, z_exp))
    weight = torch.stack([w for _, w in shown]).sum(0)
    colours = torch.stack([w[:, None] * c for c, w in shown]).sum(0)
    colours = colours / weight.clamp_min(1e-8)[:, None]
    item = state.views.item(state.given[0])
    with torch.no_grad():
        views = [state.views.item(i).view for i in state.given[:8]]
        now = torch.stack([model.appearance(state.z_id, item.state, v)[:, :3] for v in views])
        now = now.mean(0)
        wanted = torch.logit(colours.clamp(LOGIT_LIMIT, 1 - LOGIT_LIMIT))
        change = wanted - torch.logit(now.clamp(LOGIT_LIMIT, 1 - LOGIT_LIMIT))
        place = model.geometry(state.z_id, next(iter(state.z_exp.values())), item.state).means
        guess = spread_change(change, weight, now, place)
        # Texels seen at a slant are blurred: trust grows with the squared cosine.
        trust = (weight / 0.25).clamp(0, 1)[:, None]
        model.colour.bias.flatten(1)[:3, model.texels] += (trust * change + (1 - trust) * guess).T


def reconstruction(state: FitState, *pairs: tuple[Tensor, Tensor]) -> Tensor:
    """Add up L_rec of pairs of (3, H, W) images: the rasterised and, if there is one, refined."""
    used = pairs if state.model.refinement is not None else pairs[:1]
    terms = [losses.reconstruction(*pair, state.config.loss, state.perceptual) for pair in used]
    return torch.stack(terms).sum()


def _footage_loss(state: FitState, rendering: Rendering, item: HeadView) -> Tensor:
    rendering = item.hide_behind_torso(rendering)
    images = (rendering.rgb, rendering.image)
    return reconstruction(state, *((item.comparable(image), item.target) for image in images))


def locality_loss(state: FitState, item: HeadView) -> Tensor:
    """Compare the tuned model and the loaded one between a training identity and the subject.

    Codes and coefficients are blended at a fixed t (weight of the subject), jaw and neck by SLERP
    (paper, supplement). A random training camera sees the mesh posed again from the blend.
    """
    frames = sorted(f for f in state.loaded.gallery.frames if f[0] in state.loaded.model.subjects)
    frame = frames[int(state.rng.integers(len(frames)))]
    view = random_camera(state)
    own = next(i for i in state.given if state.views.keys[i] == item.key)
    mine = HeadCodes(
        z_id=state.z_id,
        z_exp=state.z_exp[item.key.expression],
        tracked=state.views.place(own).tracked,
    )
    head = between(trained_head(state.loaded, *frame), mine, LOCALITY_T)
    scene = (head.z_id, head.z_exp, head.state(state.loaded), view, state.views.background)
    tuned = state.model.render(*scene)
    with torch.no_grad():
        before = state.loaded.model.render(*scene)
    return reconstruction(state, (tuned.rgb, before.rgb), (tuned.image, before.image))


def random_camera(state: FitState) -> PinholeView:
    """Choose one of the training cameras."""
    cameras = state.loaded.gallery.cameras
    return cameras[sorted(cameras)[int(state.rng.integers(len(cameras)))]]


def _finite(loss: Tensor, iteration: int, stage: int) -> Tensor:
    if not bool(torch.isfinite(loss)):
        remedy = "lower fit.stage2_lr or check" if stage == 2 else "check"
        raise DivergedError(
            f"fit, stage {stage}, iteration {iteration}: the objective is {float(loss.detach())}, "
            f"expected a finite number; {remedy} the tracked parameters"
        )
    return loss


def _scores(state: FitState, held_out: Sequence[int]) -> Scores:
    chosen = {"psnr_given_db": state.given, "psnr_held_out_db": held_out}
    scores = {
        name: mean(evaluate(state.views, evenly(indices, SCORED_PICTURES), state.render), "psnr_db")
        for name, indices in chosen.items()
    }
    shown = [f"{figure_label(k)}: {v}" for k, v in scores.items() if v is not None]
    when = ("mean code", "after stage 1", "after stage 2")[len(state.done.scores)]
    log(f"fit, {when}: {'; '.join(shown)}")
    return scores


@dataclass(frozen=True, kw_only=True)
class FitProtocol:
    """The views of an unseen person that a fit gets."""

    cameras: tuple[str, ...] = ()  # patterns of those to fit from; empty: the first by id
    expression: str = "neutral"  # patterns of those to fit; others get the codes of training
    images: int = 0  # the most to measure per person and kind, 0 = all


def evaluate_unseen(
    loaded: Checkpoint,
    views: HeadViews,
    subject: str,
    protocol: FitProtocol,
    judge: PerceptualMetrics,
    keep: Callable[[int, Tensor], None] | None = None,
    among: Sequence[int] | None = None,
    folder: Path | None = None,
    journal: Journal | None = None,
) -> tuple[list[Row], dict[str, Any]]:
    """Fit a person from the protocol's views; rows of its other views and expressions, effort.

    ``among`` are the indices to measure, by default all of the person's. ``folder`` is that of
    `fit_unseen`, ``journal`` that of `evaluate`.

    Raises:
        ConfigError: the shards hold no such views, or nothing is left to measure.
    """
    given, own = unseen_views(loaded.model.expressions, views, subject, protocol, among)
    state, effort = fit_unseen(loaded, views, given, folder)
    rows = []
    for kind, fitted in ((NOVEL_VIEW, True), (NOVEL_EXPRESSION, False)):
        chosen = [i for i in own if (views.keys[i].expression in state.z_exp) == fitted]
        chosen = evenly(chosen, protocol.images or len(chosen))
        named = lambda key, kind=kind: kind  # noqa: E731
        rows += evaluate(views, chosen, state.render, judge, named, keep, journal)
    cameras = sorted({views.keys[i].camera for i in given})
    return rows, {"subject": subject, "cameras": cameras} | effort


def fit_unseen(
    loaded: Checkpoint, views: HeadViews, given: list[int], folder: Path | None = None
) -> tuple[FitState, dict[str, Any]]:
    """Fit a person to be measured at once; returns the fit and its effort.

    The fit is saved in ``folder``, if one is given, and continues from there if it was stopped. It
    is named after its inputs and settings, so another fit never continues from it.
    """
    state = start(loaded, views, given)
    if folder is None:
        return state, run_stages(state, dict)
    made_from = inputs(state)
    settings = as_tables(state.config)
    settings.pop("metrics")  # a fit does not depend on how it is measured
    name = hashlib.sha256(dump_json({"inputs": made_from, "settings": settings})).hexdigest()
    path = folder / name[:16] / "checkpoint.pt"
    if path.exists():
        resume(state, path, made_from)
    path.parent.mkdir(parents=True, exist_ok=True)
    effort = run_stages(state, dict, partial(_kept, state, path, made_from))
    state.optimizer = None  # a finished fit takes a third of the space without it
    save_unfinished(state, path, made_from)
    return state, effort


def unseen_views(
    trained: Collection[str],
    views: HeadViews,
    subject: str,
    protocol: FitProtocol,
    among: Sequence[int] | None = None,
) -> tuple[list[int], list[int]]:
    """Choose a person's views to fit from and to measure, and log what cannot be measured.

    Expressions can be drawn if they are fitted or among those ``trained``.
    """
    given = given_views(views, subject, protocol)
    cameras = {views.keys[i].camera for i in given}
    known = {*(views.keys[i].expression for i in given), *trained}
    own = [
        i
        for i in (range(len(views.keys)) if among is None else among)
        if views.keys[i].subject == subject and views.keys[i].camera not in cameras
    ]
    if not any(views.keys[i].expression in known for i in own):
        raise ConfigError(
            f"{subject}: no view is left to measure: cameras {', '.join(sorted(cameras))} are "
            f"used for the fit, and only expressions {', '.join(sorted(known))} can be drawn; "
            "fit from fewer cameras (--fit-cameras) or measure other views"
        )
    return given, with_codes(views.keys, own, [subject], known)


def given_views(views: HeadViews, subject: str, protocol: FitProtocol) -> list[int]:
    """Choose the views to fit from; a ConfigError says that the shards have none."""
    cameras = ",".join(protocol.cameras) or "*"
    try:
        given = select(views.keys, subject, protocol.expression, cameras)
    except ConfigError as error:
        raise ConfigError(
            f"{error}; --fit-cameras and --fit-expression choose the views to fit {subject} from"
        ) from error
    if protocol.cameras:
        return given
    first = min(views.keys[i].camera for i in given)
    return [i for i in given if views.keys[i].camera == first]
