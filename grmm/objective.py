"""One step of training: views rendered, the paper's objective, one move of the optimiser."""

from __future__ import annotations

import torch
from torch import Tensor

from express50.errors import TrainError
from grmm import losses
from grmm.config import Config
from grmm.data import Item
from grmm.perceptual import random_crop
from grmm.run import Run
from grmm.scene import Rendering, View


def step(run: Run, parallel: torch.nn.Module, config: Config) -> None:
    """One optimiser step over ``accumulate`` views."""
    run.optimizer.zero_grad(set_to_none=True)
    for _ in range(config.train.accumulate):
        item = run.views.item(run.shuffle.next(), config.data.crop_margin_px)
        subject = run.model.subjects.index(item.key.subject)
        expression = run.model.expressions.index(item.key.expression)
        shade_view = other_direction(run, config.train.shuffle_directions)
        try:
            rendering = parallel(
                subject, expression, item.state, item.view, run.views.background, shade_view
            )
        except ValueError as error:
            if "not finite" not in str(error):
                raise
            raise TrainError(
                f"iteration {run.iteration}: training diverged ({error}); lower train.lr and start "
                "over with --anew"
            ) from None
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
    if run.average is not None:
        run.average.update_parameters(run.model)


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
