"""The locality loss of a fit's second stage, and L_rec as a fit uses it (paper, supplement)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from grmm import losses
from grmm.data import Item, Tracked, pose_state
from grmm.edit import interpolate_tracked
from grmm.perceptual import random_crop
from grmm.scene import HeadState, View

if TYPE_CHECKING:
    from grmm.fit import Fit


def reconstruction(state: Fit, image: Tensor, target: Tensor) -> Tensor:
    """L_rec of (3, H, W) images: L1, SSIM and, where weights are given, the perceptual term."""
    loss = losses.reconstruction(image, target, state.weights)
    if state.perceptual is None:
        return loss
    pair = random_crop((image, target), state.weights.perceptual_crop_px, state.generator)
    return loss + state.weights.perceptual * state.perceptual(*pair)


def locality_loss(state: Fit, item: Item, rng: np.random.Generator) -> Tensor:
    """L_rec between the tuned and the frozen model between a training identity and the subject.

    Codes and coefficients are blended at a fixed t (weight of the subject), jaw and neck by SLERP
    (paper, supplement); the mesh is posed again from the blend; the camera is a random one of the
    training set; refined and rasterised images both count, as in L_rec's other uses.
    """
    frames = sorted(f for f in state.loaded.gallery.frames if f[0] in state.frozen.subjects)
    subject, expression = frames[int(rng.integers(len(frames)))]
    view = random_camera(state, rng)
    t = state.settings.locality_t
    mine = state.views.sample(_index_of(state, item)).tracked
    head_state, z_id, z_exp = blend(
        state, (subject, expression), mine, state.z_exp[item.key.expression], t
    )
    tuned = state.model.render(z_id, z_exp, head_state, view, state.views.background)
    with torch.no_grad():
        before = state.frozen.render(z_id, z_exp, head_state, view, state.views.background)
    loss = reconstruction(state, tuned.rgb, before.rgb)
    if state.model.refinement is not None:
        loss = loss + reconstruction(state, tuned.image, before.image)
    return loss


def random_camera(state: Fit, rng: np.random.Generator) -> View:
    """One of the training cameras."""
    cameras = state.loaded.gallery.cameras
    return cameras[sorted(cameras)[int(rng.integers(len(cameras)))]]


def blend(
    state: Fit, frame: tuple[str, str], mine: Tracked, z_exp: Tensor, t: float
) -> tuple[HeadState, Tensor, Tensor]:
    """Parameters and codes between a training frame (t = 0) and the fitted subject (t = 1)."""
    model, gallery = state.frozen, state.loaded.gallery
    tracked = interpolate_tracked(gallery.frames[frame], mine, t)
    subject, expression = model.subjects.index(frame[0]), model.expressions.index(frame[1])
    return (
        pose_state(state.views.head, tracked),
        torch.lerp(model.z_id[subject], state.z_id, t),
        torch.lerp(model.z_exp[expression], z_exp, t),
    )


def _index_of(state: Fit, item: Item) -> int:
    return next(i for i in state.given if state.views.keys[i] == item.key)
