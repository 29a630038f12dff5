"""The native CPU backend: ``torch.autograd.Function`` over the C ABI of express50/native.

Deterministic: images and gradients are the same bits for any number of threads, which is taken
from ``torch.get_num_threads()``. A third of the time of a large image with many channels goes into
fresh memory pages for it: THP_MEM_ALLOC_ENABLE=1 in the environment makes torch use huge pages.
"""

from __future__ import annotations

import ctypes
import threading
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from express50 import native
from grmm.rasterize.projection import expected_depth

_TILE = 16  # kTile of tiles.h
_SPLAT = 10  # numbers in Splat of blend.h
_MOMENTS = 9  # numbers in Moments of blend.h
_SUFFIX = {torch.float32: "f32", torch.float64: "f64"}
_scratch = threading.local()  # grown, never shrunk: fresh pages cost more than the sums in them


class _Camera(ctypes.Structure):
    """Mirror of ``Camera`` in projection.h."""

    _fields_ = [
        ("intrinsics", ctypes.c_double * 4),
        ("R", ctypes.c_double * 9),
        ("t", ctypes.c_double * 3),
        ("near", ctypes.c_double),
        ("eps2d", ctypes.c_double),
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("antialiased", ctypes.c_int32),
        ("threads", ctypes.c_int32),
    ]


def rasterize_cpu(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    width: int,
    height: int,
    background: Tensor | None,
    near: float,
    eps2d: float,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours (H, W, C), depth (H, W) and alpha (H, W); arguments as ``grmm.rasterize``.

    Raises:
        ValueError: the tensors are not on the CPU, or the Gaussians are too large to be binned.
        express50.native.NativeLibraryError: the library was not built; says how to mend it.
    """
    if means.device.type != "cpu":
        raise ValueError(f"backend 'cpu' got tensors on {means.device}; use 'auto' or 'gsplat'")
    options = (width, height, near, eps2d, antialiased)
    image, weighted, alpha = _Rasterize.apply(
        means, quats, scales, opacities, colors, K, cam_from_world, background, options
    )
    return image, expected_depth(weighted, alpha, K), alpha


class _Rasterize(torch.autograd.Function):
    """Colours, sum of weight * ray length, and alpha."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        K: Tensor,
        cam_from_world: Tensor,
        background: Tensor | None,
        options: tuple[int, int, float, float, bool],
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.set_materialize_grads(False)
        # The kernel reads raw memory: a strided view would be read as other numbers.
        geometry = [x.contiguous() for x in (means, quats, scales, opacities)]
        camera = _camera(K, cam_from_world, *options)
        splats, boxes, starts, ids = _bin(camera, geometry)
        used = torch.empty(starts.numel() - 1, dtype=torch.int32)
        blended = (splats, boxes, colors.contiguous(), _contiguous(background), starts, ids, used)
        size, channels = (camera.height, camera.width), colors.shape[1]
        image = torch.empty(*size, channels, dtype=means.dtype)
        weighted = torch.empty(size, dtype=means.dtype)
        alpha = torch.empty(size, dtype=means.dtype)
        ctx.records = _call(
            "forward", means.dtype, camera, channels, *blended, image, weighted, alpha
        )
        ctx.camera = camera
        ctx.save_for_backward(*geometry, *blended, alpha, K, cam_from_world)
        return image, weighted, alpha

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, d_image: Tensor | None, d_weighted: Tensor | None, d_alpha: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        geometry, blended, (alpha, K, cam_from_world) = saved[:4], saved[4:11], saved[11:]
        colors, background = blended[2:4]
        n, channels = colors.shape
        grads = [torch.empty_like(x) for x in (*geometry, colors)]
        d_camera = torch.zeros(16, dtype=torch.float64)
        records = _workspace(ctx.records * (channels + _MOMENTS), colors.dtype)
        _call(
            "backward", colors.dtype, ctx.camera, n, channels, *geometry, *blended,
            *map(_contiguous, (d_image, d_weighted, d_alpha)),
            records[_MOMENTS * ctx.records :], records, *grads, d_camera,
        )  # fmt: skip
        d_K = torch.zeros(3, 3, dtype=torch.float64)
        d_K[[0, 1, 0, 1], [0, 1, 2, 2]] = d_camera[:4]
        d_pose = torch.zeros(4, 4, dtype=torch.float64)
        d_pose[:3, :3] = d_camera[4:13].reshape(3, 3)
        d_pose[:3, 3] = d_camera[13:]
        d_background = None
        if background is not None and d_image is not None:
            d_background = torch.einsum("hwc,hw->c", d_image, 1.0 - alpha)
        return *grads, d_K.to(K.dtype), d_pose.to(cam_from_world.dtype), d_background, None


def _bin(camera: _Camera, geometry: list[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project, then sort into tiles: splats (N, 10), boxes (N, 4), tile starts and Gaussian ids."""
    n, dtype = geometry[0].shape[0], geometry[0].dtype
    splats = torch.empty(n, _SPLAT, dtype=dtype)
    depths = torch.empty(n, dtype=dtype)
    boxes = torch.empty(n, 4, dtype=torch.int32)
    entries = _call("project", dtype, camera, n, *geometry, splats, depths, boxes)
    if entries >= 2**31:
        raise ValueError(
            f"the Gaussians cover {entries} tiles in all, expected under 2^31; scales is too large"
            " for this image"
        )
    tiles = -(-camera.width // _TILE) * -(-camera.height // _TILE)
    starts = torch.empty(tiles + 1, dtype=torch.int64)
    ids = torch.empty(entries, dtype=torch.int32)
    _call("bin", dtype, camera, n, depths, boxes, starts, ids)
    return splats, boxes, starts, ids


def _camera(
    K: Tensor,
    cam_from_world: Tensor,
    width: int,
    height: int,
    near: float,
    eps2d: float,
    antialiased: bool,
) -> _Camera:
    """The camera as the kernel reads it, in float64."""
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    pose = cam_from_world.tolist()
    return _Camera(
        intrinsics=(fx, fy, cx, cy),
        R=tuple(x for row in pose[:3] for x in row[:3]),
        t=tuple(row[3] for row in pose[:3]),
        near=near,
        eps2d=eps2d,
        width=width,
        height=height,
        antialiased=antialiased,
        threads=torch.get_num_threads(),
    )


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    """The tensor in one block of memory, or None."""
    return None if tensor is None else tensor.contiguous()


def _workspace(size: int, dtype: torch.dtype) -> Tensor:
    """Uninitialised scratch of this thread, valid until the next call."""
    buffers = _scratch.__dict__
    if dtype not in buffers or buffers[dtype].numel() < size:
        buffers[dtype] = torch.empty(size, dtype=dtype)
    return buffers[dtype]


def _call(name: str, dtype: torch.dtype, camera: _Camera, *arguments: int | Tensor | None) -> int:
    """Call ``gaussians_<name>`` with tensors as pointers and integers as they are declared."""
    function = getattr(native.load(), f"gaussians_{name}_{_SUFFIX[dtype]}")
    function.restype = None if name in ("bin", "backward") else ctypes.c_int64
    converted: list[Any] = [ctypes.byref(camera)]
    for argument in arguments:
        if isinstance(argument, int):
            converted.append(ctypes.c_int64(argument))
        else:
            converted.append(ctypes.c_void_p(None if argument is None else argument.data_ptr()))
    return function(*converted)
