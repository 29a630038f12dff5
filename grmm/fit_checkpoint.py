"""The checkpoint that a fit leaves: one person, with all expressions of training."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from grmm.checkpoint import Gallery, collect_gallery, save_checkpoint
from grmm.data import NO_OFFSETS, Tracked
from grmm.model import GRMM
from grmm.scene import View

if TYPE_CHECKING:
    from grmm.fit import Fit


def save_fit(state: Fit, out: Path) -> None:
    """A checkpoint of the tuned model, in which the fitted subject is the only one.

    It keeps the expressions of training (their codes, and one frame of parameters each), so that
    they can be transferred to the subject.
    """
    subject = state.views.keys[state.given[0]].subject
    known = {
        name: code
        for name, code in zip(state.frozen.expressions, state.frozen.z_exp.detach(), strict=True)
        if name not in state.z_exp
    }
    model = GRMM(state.model.config, state.views.head, [subject], [*state.z_exp, *known])
    content = state.model.state_dict()
    content["z_id"] = state.z_id[None]
    content["z_exp"] = torch.stack([*state.z_exp.values(), *known.values()])
    model.load_state_dict(content)
    own = collect_gallery(state.views, state.given)
    # Training cameras stay for rendering; the subject's own come first.
    cameras: dict[str, View] = own.cameras | {
        f"training_{name}": view for name, view in state.loaded.gallery.cameras.items()
    }
    save_checkpoint(
        out / "checkpoint.pt",
        model=model,
        config=state.loaded.config,
        head_spec=state.loaded.head_spec,
        gallery=Gallery(frames=own.frames | _donors(state, known), cameras=cameras),
    )


def _donors(state: Fit, expressions: Container[str]) -> dict[tuple[str, str], Tracked]:
    """One training frame of each expression; nobody's offsets: only its expression is of use."""
    found: dict[str, tuple[str, str]] = {}
    for frame in state.loaded.gallery.frames:
        if frame[1] in expressions:
            found.setdefault(frame[1], frame)
    frames = state.loaded.gallery.frames
    return {frame: replace(frames[frame], offsets=NO_OFFSETS) for frame in found.values()}
