"""Rasterise 3D Gaussians differentiably: one interface, three backends.

``reference`` is plain torch (the oracle), ``cpu`` the native C++ kernel (deterministic for any
number of threads), ``gsplat`` CUDA. All follow ``grmm.rasterize.projection`` and gsplat's guards,
so that a scene looks the same on each of them.
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from express50 import native
from express50.geometry.shapes import PIXEL_LIMIT
from grmm.rasterize.projection import (
    NotFiniteTensorError,
    Pinhole,
    RenderOptions,
    RenderOutput,
    Splats,
    rasterize_reference,
)

__all__ = ["BACKENDS", "NotFiniteTensorError", "RenderOutput", "rasterize", "resolve_backend"]

LIMIT = 1e30  # of the size of any value: its square stays finite
BACKENDS = ("auto", "reference", "cpu", "gsplat")


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,
    antialiased: bool = False,
    median_depth: bool = False,
    normals: bool = False,
    backend: str = "auto",
) -> RenderOutput:
    """Render Gaussians into one pinhole image; differentiable in every tensor argument.

    Args:
        means: (N, 3) metres, world. N may be 0; those nearer than NEAR_M are dropped.
        quats: (N, 4) wxyz, any length; a quaternion of zero length stands for no rotation.
        scales: (N, 3) standard deviations, metres, along the rotated axes; 0 is allowed.
        opacities: (N,) in [0, 1]; under 1/255 a Gaussian is invisible.
        colors: (N, C) any C >= 0 channels.
        K: (3, 3) pixels, corner origin, no skew; the principal point may lie anywhere.
        cam_from_world: (4, 4) rigid. Points are taken to the camera in float64, so a float64
            camera keeps float32 Gaussians precise far from the origin.
        width: pixels.
        height: pixels.
        background: (C,) colour behind the Gaussians, black if None. Depth has no background.
        antialiased: scale opacity by sqrt(det before / det after dilation) (Mip-Splatting, 2024).
        median_depth: also give the median depth.
        normals: also give blended normals.
        backend: ``auto`` takes gsplat for CUDA tensors, else the native kernel if it was built,
            else the reference.

    Raises:
        NotFiniteTensorError: an argument holds NaN or Inf.
        ValueError: wrong shape, dtype or device, or unknown backend; names the argument.
        RuntimeError: the requested backend is unavailable; says how to fix it.
    """
    splats = Splats(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors)
    camera = Pinhole(K=K, cam_from_world=cam_from_world, width=width, height=height)
    options = RenderOptions(antialiased=antialiased, median_depth=median_depth, normals=normals)
    _check(splats, camera, background)
    name = resolve_backend(backend, means.device)
    if name == "cpu":  # a backend is imported when it is used: gsplat may start a long build
        from grmm.rasterize.cpu import rasterize_cpu

        return rasterize_cpu(splats, camera, background, options)
    if name == "gsplat":
        from grmm.rasterize.gsplat_backend import rasterize_gsplat

        return rasterize_gsplat(splats, camera, background, options)
    return rasterize_reference(splats, camera, background, options)


def resolve_backend(backend: str = "auto", device: torch.device | str = "cpu") -> str:
    """Resolve ``auto`` to the backend for ``device``; a ValueError refuses unknown names."""
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}, expected one of {', '.join(BACKENDS)}")
    if backend != "auto":
        return backend
    if torch.device(device).type == "cuda":
        return "gsplat"
    if not native.why_missing():
        return "cpu"
    warnings.warn(f"rendering with the slow torch reference: {native.why_missing()}", stacklevel=3)
    return "reference"


def _check(splats: Splats, camera: Pinhole, background: Tensor | None) -> None:
    """Check shapes, dtypes, devices and values; the ValueError names the argument."""
    n, channels = splats.means.shape[0], splats.colors.shape[-1]
    tensors = vars(splats) | {"K": camera.K, "cam_from_world": camera.cam_from_world}
    if background is not None:
        tensors["background"] = background
    shapes = {
        "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,),
        "colors": (n, channels), "K": (3, 3), "cam_from_world": (4, 4), "background": (channels,),
    }  # fmt: skip
    dtype, device = splats.means.dtype, splats.means.device
    for name, tensor in tensors.items():
        if tuple(tensor.shape) != shapes[name]:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shapes[name]}")
        of_camera = name in ("K", "cam_from_world")
        if tensor.dtype not in (torch.float32, torch.float64) or (
            tensor.dtype != dtype and not of_camera
        ):
            raise ValueError(
                f"{name} is {tensor.dtype}, expected float32 or float64 and the same as means"
            )
        if tensor.device != device:
            raise ValueError(f"{name} is on {tensor.device}, expected {device} as means")
    K = _check_values(tensors)
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"image size is {camera.width} x {camera.height}, expected at least 1 x 1")
    if camera.width * camera.height > PIXEL_LIMIT:
        raise ValueError(
            f"image size is {camera.width} x {camera.height}, expected at most {PIXEL_LIMIT} pixels"
        )
    (fx, skew, _), (below, fy, _), bottom = K
    if fx <= 0 or fy <= 0 or skew != 0 or below != 0 or bottom != [0.0, 0.0, 1.0]:
        raise ValueError(
            f"K is {K}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0"
        )


def _check_values(tensors: dict[str, Tensor]) -> list[list[float]]:
    """Refuse NaN, Inf and numbers whose squares would overflow; returns K.

    All extremes are transferred at once, because each transfer waits for everything queued before.
    """
    parts = {name: torch.aminmax(t.detach()) for name, t in tensors.items() if t.numel()}
    ends = [end.double() for pair in parts.values() for end in pair]
    values = torch.cat([torch.stack(ends), tensors["K"].detach().double().flatten()]).tolist()
    for name, low, high in zip(parts, values[::2], values[1::2], strict=False):
        if not (low > -LIMIT and high < LIMIT):
            bad = ~(tensors[name].detach().abs() < LIMIT)
            raise NotFiniteTensorError(
                f"{name} has {int(bad.sum())} values that are not finite or over {LIMIT:g}, the"
                f" first at {tuple(bad.nonzero()[0].tolist())}; expected finite numbers, as of a"
                " trained model with moderate controls"
            )
    return [values[-9:-6], values[-6:-3], values[-3:]]
