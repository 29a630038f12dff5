"""Export the Gaussians of one frame: PLY for splat viewers, NPZ for everything else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from express50.errors import ConfigError
from grmm.checkpoint import Loaded
from grmm.render import frontal


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """N Gaussians with one colour each, head space.

    Attributes:
        means: (N, 3) metres.
        quats: (N, 4) wxyz, unit length.
        scales: (N, 3) standard deviations, metres.
        opacities: (N,).
        colors: (N, 3) in [0, 1], sRGB, as the frontal camera sees them.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray


@torch.no_grad()
def cloud(loaded: Loaded, subject: str, expression: str) -> Cloud:
    """Decode one training (or fitted) frame; colours are those of the frontal view."""
    model = loaded.model
    state = loaded.state(subject, expression)
    z_id, z_exp = model.codes(model.subjects.index(subject), model.expressions.index(expression))
    gaussians = model.geometry(z_id, z_exp, state)
    colours = model.appearance(z_id, state, frontal(loaded))[:, :3]
    low, high = loaded.config.model.scale_bounds_mm
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
    return Cloud(
        means=gaussians.means.cpu().numpy(),
        quats=quats.cpu().numpy(),
        scales=1e-3 * gaussians.scales_mm.clamp(low, high).cpu().numpy(),
        opacities=gaussians.opacities.cpu().numpy(),
        colors=colours.cpu().numpy(),
    )


def write_cloud(path: Path, gaussians: Cloud) -> None:
    """Write by extension: .ply (3DGS layout, degree 0) or .npz (arrays named as in `Cloud`).

    Raises:
        ConfigError: another extension.
    """
    if path.suffix == ".npz":
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, **vars(gaussians))
    elif path.suffix == ".ply":
        from grmm.ply import write_ply

        path.parent.mkdir(parents=True, exist_ok=True)
        write_ply(path, **vars(gaussians))
    else:
        raise ConfigError(f"{path}: cannot export to {path.suffix!r}, expected .ply or .npz")
