"""Minimise a network's loss over places in pictures, in a run that may be interrupted."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from express50.errors import TrainError
from express50.files.arrays import read_weights
from express50.landmarks.network import heat_loss

WARM_UP = 100  # steps
HIGH_SHARE = 0.65  # of the run; then the learning rate falls linearly
KEEP_EVERY = 100  # steps
Net = TypeVar("Net", bound=torch.nn.Module)


def minimise(
    net: Net, steps: int, rate: float, state: Path, loss_at: Callable[[int], torch.Tensor]
) -> Net:
    """Minimise the loss of every step; an interrupted run continues from the file `state`.

    Parameters that require no gradient do not change.
    """
    trained = [part for part in net.parameters() if part.requires_grad]
    optimiser = torch.optim.AdamW(trained, lr=rate, weight_decay=1e-3)
    first = load_state(state, net, optimiser)
    began, losses = time.monotonic(), []
    for step in range(first, steps):
        fall = (steps - step) / (steps * (1.0 - HIGH_SHARE))
        optimiser.param_groups[0]["lr"] = rate * min(1.0, (step + 1) / WARM_UP, max(fall, 0.01))
        loss = loss_at(step)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained, 5.0)
        optimiser.step()
        losses.append(loss.item())
        if (step + 1) % KEEP_EVERY == 0:
            seconds = (time.monotonic() - began) / (step + 1 - first)
            recent = np.mean(losses[-KEEP_EVERY:])
            print(f"step {step + 1}: loss {recent:.3f}, {seconds:.2f} s", flush=True)
            part, content = state.with_suffix(".part"), {"step": step + 1}
            content |= {"net": net.state_dict(), "optimiser": optimiser.state_dict()}
            torch.save(content, part)
            part.replace(state)
    return net.eval()


def load_state(path: Path, net: Net, optimiser: torch.optim.Optimizer) -> int:
    """Read the state of a stopped run if there is one; return the next step."""
    if not path.exists():
        return 0
    state = read_weights(path, TrainError, str(path), "a training state", "delete it")
    net.load_state_dict(state["net"])
    optimiser.load_state_dict(state["optimiser"])
    print(f"continuing from step {state['step']} ({path}; delete it to start over)")
    return state["step"]


def laplace_loss(
    found: torch.Tensor, log_scale: torch.Tensor, points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return losses and distances (B, N) of found points (B, N, 2), pixels.

    The loss sums the distance and the negative log-likelihood of a Laplace distribution.
    """
    # The added 0.01 px^2 bounds the slope at zero distance.
    distance = ((found - points).square().sum(-1) + 0.01).sqrt()
    return 0.2 * distance + (2 * log_scale + distance * torch.exp(-log_scale)), distance


def place_loss(
    found: torch.Tensor, log_scale: torch.Tensor, heat: torch.Tensor, points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return losses and distances (B, N) of found points (B, N, 2), in pixels of the crop.

    The loss sums distance, likelihood and cross entropy.
    """
    loss, distance = laplace_loss(found, log_scale, points)
    return loss + heat_loss(heat, points), distance
