"""Rasterise on the CPU: a ``torch.autograd.Function`` over the native library.

Images and gradients are the same to the last bit for any number of threads, which is
``torch.get_num_threads()``. Large outputs ask for huge pages: mapping small ones takes a third of
the time of a large image with many channels.
"""

from __future__ import annotations

import ctypes
import threading
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from express50 import native
from grmm.rasterize.projection import (
    DILATION_PX2,
    NEAR_M,
    Pinhole,
    RenderOptions,
    RenderOutput,
    Splats,
    depth_of_rays,
    expected_depth,
)

_TILE = 16  # kTile of tiles.h
_SPLAT = 10  # numbers in Splat of blend.h
_MOMENTS = 9  # kMoments of gaussians.cpp
_HUGE = 1 << 22  # bytes from which huge pages save time
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
        ("normals", ctypes.c_int32),
        ("threads", ctypes.c_int32),
    ]


def rasterize_cpu(
    scene: Splats, camera: Pinhole, background: Tensor | None, options: RenderOptions
) -> RenderOutput:
    """Render; see ``grmm.rasterize``."""
    device = scene.means.device
    if device.type != "cpu":
        raise ValueError(f"backend 'cpu' got tensors on {device}; use 'auto' or 'gsplat'")
    image, weighted, alpha, median = _Rasterize.apply(
        *vars(scene).values(),
        camera.K,
        camera.cam_from_world,
        background,
        (camera.width, camera.height),
        options,
    )
    channels = scene.colors.shape[1]
    return RenderOutput(
        colors=image[..., :channels] if options.normals else image,
        depth=expected_depth(weighted, alpha, camera.K),
        alpha=alpha,
        median_depth=None if median is None else depth_of_rays(median, camera.K),
        normals=image[..., channels:] if options.normals else None,
    )


class _Rasterize(torch.autograd.Function):
    """Colours and normals, sum of weight * ray length, alpha and median ray length."""

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
        size: tuple[int, int],
        options: RenderOptions,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        ctx.set_materialize_grads(False)
        # The kernel reads raw memory, so tensors must be contiguous.
        geometry = [x.contiguous() for x in (means, quats, scales, opacities)]
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        pose = cam_from_world.tolist()
        camera = _Camera(
            intrinsics=(fx, fy, cx, cy),
            R=tuple(x for row in pose[:3] for x in row[:3]), t=tuple(row[3] for row in pose[:3]),
            near=NEAR_M, eps2d=DILATION_PX2, width=size[0], height=size[1],
            antialiased=options.antialiased, normals=options.normals,
            threads=torch.get_num_threads(),
        )  # fmt: skip
        if options.normals:  # three more channels, which the projection fills
            colors = torch.nn.functional.pad(colors, (0, 3))
            background = None if background is None else torch.nn.functional.pad(background, (0, 3))
        colors, background = colors.contiguous(), _contiguous(background)
        splats, boxes, starts, ids = _bin(camera, geometry, colors)
        used = torch.empty(starts.numel() - 1, dtype=torch.int32)
        blended = (splats, boxes, colors, background, starts, ids, used)
        shape, dtype = (camera.height, camera.width), means.dtype
        image = _empty((*shape, colors.shape[1]), dtype)
        weighted, alpha = _empty(shape, dtype), _empty(shape, dtype)
        median = _empty(shape, dtype) if options.median_depth else None
        _call("forward", dtype, camera, colors.shape[1], *blended, image, weighted, alpha, median)
        ctx.camera = camera
        ctx.save_for_backward(*geometry, *blended, alpha, K, cam_from_world)
        return image, weighted, alpha, median

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_images: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        geometry, blended, (alpha, K, cam_from_world) = saved[:4], saved[4:11], saved[11:]
        colors, background = blended[2:4]
        n, channels = colors.shape
        grads = [_empty(tuple(x.shape), x.dtype) for x in (*geometry, colors)]
        d_camera = torch.zeros(16, dtype=torch.float64)
        moments = getattr(_scratch, "moments", None)  # this thread's, kept for the next call
        if moments is None or moments.numel() < n * _MOMENTS:
            moments = _scratch.moments = _empty((n * _MOMENTS,), torch.float64)
        _call(
            "backward", colors.dtype, ctx.camera, n, channels, *geometry, *blended,
            *map(_contiguous, d_images),
            moments, *grads, d_camera,
        )  # fmt: skip
        d_K = torch.zeros(3, 3, dtype=torch.float64)
        d_K[[0, 1, 0, 1], [0, 1, 2, 2]] = d_camera[:4]
        d_pose = torch.zeros(4, 4, dtype=torch.float64)
        d_pose[:3, :3] = d_camera[4:13].reshape(3, 3)
        d_pose[:3, 3] = d_camera[13:]
        d_background, asked = None, channels - 3 * ctx.camera.normals
        if background is not None and d_images[0] is not None:
            d_background = torch.einsum("hwc,hw->c", d_images[0][..., :asked], 1.0 - alpha)
        grads[4] = grads[4][:, :asked]
        d_camera_inputs = d_K.to(K.dtype), d_pose.to(cam_from_world.dtype)
        return *grads, *d_camera_inputs, d_background, None, None


def _bin(
    camera: _Camera, geometry: list[Tensor], colors: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project, then sort into tiles: splats (N, 10), boxes (N, 4), tile starts and Gaussian ids.

    Writes the normals into the last channels of ``colors`` where the camera asks for them.
    """
    n, dtype = geometry[0].shape[0], geometry[0].dtype
    splats = torch.empty(n, _SPLAT, dtype=dtype)
    depths = torch.empty(n, dtype=dtype)
    boxes = torch.empty(n, 4, dtype=torch.int32)
    entries = _call(
        "project", dtype, camera, n, colors.shape[1], *geometry, splats, depths, boxes, colors
    )
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


def _empty(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Return an uninitialised tensor; a large one asks for huge pages."""
    tensor = torch.empty(shape, dtype=dtype)
    size = tensor.numel() * tensor.element_size()
    if size >= _HUGE:
        native.load().native_huge_pages(ctypes.c_void_p(tensor.data_ptr()), ctypes.c_int64(size))
    return tensor


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()


def _call(name: str, dtype: torch.dtype, camera: _Camera, *arguments: int | Tensor | None) -> int:
    """Call ``gaussians_<name>`` with tensors as pointers and integers as they are declared."""
    function = getattr(native.load(), f"gaussians_{name}_{_SUFFIX[dtype]}")
    function.restype = ctypes.c_int64 if name == "project" else None
    converted: list[Any] = [ctypes.byref(camera)]
    for argument in arguments:
        if isinstance(argument, int):
            converted.append(ctypes.c_int64(argument))
        else:
            converted.append(ctypes.c_void_p(None if argument is None else argument.data_ptr()))
    return function(*converted)
