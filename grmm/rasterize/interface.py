"""The records that the rasteriser's backends share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


class NotFiniteTensorError(ValueError):
    """An argument of ``rasterize`` holds NaN, Inf or numbers too large to square."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """N Gaussians as ``rasterize`` takes them; see there for shapes and units."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Pinhole:
    """The camera of ``rasterize``; see there."""

    K: Tensor
    cam_from_world: Tensor
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """The settings of ``rasterize``; see there."""

    near: float
    eps2d: float
    antialiased: bool
    median_depth: bool
    normals: bool


@dataclass(frozen=True)
class RenderOutput:
    """The images that ``rasterize`` returns.

    Attributes:
        colors: (H, W, C) blended colours (any channels), background included.
        depth: (H, W) RaDe expected depth, camera z in metres; 0 where alpha is 0.
        alpha: (H, W) in [0, 1).
        median_depth: (H, W) camera z in metres of the plane of the Gaussian at which the
            transmittance falls to one half or less; 0 where it never does. None unless asked for.
        normals: (H, W, 3) blended unit normals of those planes, camera axes, towards the camera,
            without background; divide by their length for a direction. None unless asked for.
    """

    colors: Tensor
    depth: Tensor
    alpha: Tensor
    median_depth: Tensor | None = None
    normals: Tensor | None = None


class RenderBuffers:
    """Memory of the native backend's images that is used again, call after call.

    At 1024 px and 38 channels, fresh pages cost as much as a third of the blending. The images of
    a call are valid until the next call with the same buffers: copy what must live longer. Where
    autograd still needs an image that was overwritten, its backward raises RuntimeError.
    """

    def __init__(self) -> None:
        """Start without memory."""
        self._flat: dict[str, Tensor] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Return an uninitialised tensor in the memory that ``name`` had, grown if needed."""
        size = torch.Size(shape).numel()
        flat = self._flat.get(name)
        if flat is None or flat.dtype != dtype or flat.numel() < size:
            flat = self._flat[name] = torch.empty(size, dtype=dtype)
        torch.autograd.graph.increment_version(flat)
        return flat[:size].view(shape).detach()  # no view for autograd, but one version with it
