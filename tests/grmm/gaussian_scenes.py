"""Scenes of Gaussians and a common way to run a backend on them, for the rasteriser's tests."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from grmm.rasterize import rasterize

GRADIENTS = (
    "means", "quats", "scales", "opacities", "colors", "K", "cam_from_world", "background"
)  # fmt: skip


@dataclass(frozen=True)
class Scene:
    tensors: dict[str, Tensor]  # arguments of rasterize that are tensors, float64
    width: int
    height: int
    antialiased: bool = False


def random_scene(
    n: int, channels: int, width: int = 61, height: int = 47, seed: int = 0, antialiased=False
) -> Scene:
    """A cloud that partly leaves the image, seen by a turned camera with an odd principal point."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    cos, sin = 0.9553364891256060, 0.2955202066613396  # 0.3 rad
    return Scene(
        {
            "means": (uniform(n, 3) - 0.5) * 0.5,
            "quats": uniform(n, 4) - 0.5,
            "scales": uniform(n, 3) ** 3 * 0.05 + 0.0005,
            "opacities": uniform(n),
            "colors": uniform(n, channels) * 2 - 0.5,
            "K": torch.tensor(
                [[1.1 * width, 0, 0.4 * width], [0, 1.2 * width, 0.55 * height], [0, 0, 1]],
                dtype=torch.float64,
            ),
            "cam_from_world": torch.tensor(
                [[cos, 0, sin, 0.02], [0, 1, 0, -0.01], [-sin, 0, cos, 0.6], [0, 0, 0, 1]],
                dtype=torch.float64,
            ),
            "background": uniform(channels),
        },
        width,
        height,
        antialiased,
    )


def render(scene: Scene, backend: str, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    """Images of a scene, and the gradients of a fixed random function of them, by name.

    The camera stays float64, which is what keeps float32 Gaussians precise.
    """
    camera = ("K", "cam_from_world")
    leaves = {
        name: tensor.to(torch.float64 if name in camera else dtype).clone().requires_grad_()
        for name, tensor in scene.tensors.items()
    }
    out = rasterize(
        **leaves,
        width=scene.width,
        height=scene.height,
        antialiased=scene.antialiased,
        median_depth=True,
        normals=True,
        backend=backend,
    )
    assert out.median_depth is not None and out.normals is not None
    generator = torch.Generator().manual_seed(7)
    images = {
        "image": out.colors,
        "depth": out.depth,
        "alpha": out.alpha,
        "median_depth": out.median_depth,
        "normals": out.normals,
    }
    loss = torch.zeros((), dtype=dtype)
    for image in images.values():
        cotangent = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        loss = loss + (image * cotangent.to(dtype)).sum()
    grads = torch.autograd.grad(loss, [leaves[name] for name in GRADIENTS])
    result = {name: image.detach() for name, image in images.items()}
    result |= dict(zip(GRADIENTS, grads, strict=True))
    # The reference also differentiates by the constant entries of K, which mean nothing.
    result["K"] = result["K"] * torch.tensor([[1, 0, 1], [0, 1, 1], [0, 0, 0]])
    result["cam_from_world"] = result["cam_from_world"][:3]
    return result


def relative_error(expected: Tensor, got: Tensor) -> float:
    """Largest difference over the largest expected magnitude."""
    if expected.numel() == 0:
        return 0.0
    return float((expected - got).abs().max() / expected.abs().max().clamp(min=1e-9))
