"""Three rows of a face, weighed anew for each of its pixels: what rendering spends its time on.

On the CPU the native library does it in one pass. Other devices and dtypes, and machines without
the library, take two torch operations with temporaries of many times the size.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from express50 import native
from express50.geometry.shapes import check_shape

_SUFFIX = {torch.float32: "f32", torch.float64: "f64"}


def weigh_rows(rows: Tensor, coefficients: Tensor, group: Tensor, counts: Tensor) -> Tensor:
    """Sums (N, C) over k of coefficients (N, 3) times the rows (G, 3, C) of each pixel's group.

    Args:
        rows: (G, 3, C).
        coefficients: (N, 3).
        group: (N,) int64, ascending ids of rows.
        counts: (G,) int64, pixels of each group.

    Raises:
        ValueError: shapes or dtypes do not fit each other.
    """
    check_shape("rows", rows, (len(counts), 3, None))
    check_shape("coefficients", coefficients, (len(group), 3))
    if rows.dtype != coefficients.dtype:
        raise ValueError(
            f"rows are {rows.dtype} and coefficients {coefficients.dtype}, expected one dtype;"
            " convert attributes, K and cam_from_world to that of the vertices"
        )
    return _WeighRows.apply(rows, coefficients, group, counts)


class _WeighRows(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, coefficients: Tensor, group: Tensor, counts: Tensor
    ) -> Tensor:
        rows, coefficients = rows.contiguous(), coefficients.contiguous()
        ctx.save_for_backward(rows, coefficients, group, counts)
        if not _native(rows):
            return (coefficients[:, None] @ rows.index_select(0, group))[:, 0]
        out = rows.new_empty(len(coefficients), rows.shape[2])
        _call("mesh_weigh", rows, coefficients, group, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        rows, coefficients, group, counts = ctx.saved_tensors
        if _native(rows):
            of_rows = torch.zeros_like(rows) if ctx.needs_input_grad[0] else None
            of_coefficients = torch.empty_like(coefficients) if ctx.needs_input_grad[1] else None
            inputs = (rows, coefficients, group, gradient.contiguous())
            _call("mesh_weigh_gradient", *inputs, of_rows, of_coefficients)
            return of_rows, of_coefficients, None, None
        of_rows = of_coefficients = None
        if ctx.needs_input_grad[0]:
            outer = (coefficients[:, :, None] * gradient[:, None, :]).flatten(1)
            sums = torch.segment_reduce(outer, "sum", lengths=counts, axis=0, unsafe=True)
            of_rows = sums.reshape(rows.shape)
        if ctx.needs_input_grad[1]:
            of_coefficients = (rows.index_select(0, group) @ gradient[:, :, None])[..., 0]
        return of_rows, of_coefficients, None, None


def _native(rows: Tensor) -> bool:
    return rows.device.type == "cpu" and rows.dtype in _SUFFIX and native.available()


def _call(name: str, rows: Tensor, coefficients: Tensor, *arrays: Tensor | None) -> None:
    """Call a function of the library with the sizes and the addresses of the arrays."""
    function = getattr(native.load(), f"{name}_{_SUFFIX[rows.dtype]}")
    function.restype = None
    every = (rows, coefficients, *arrays)
    addresses = [ctypes.c_void_p(None if a is None else a.data_ptr()) for a in every]
    sizes = (ctypes.c_int64(len(coefficients)), ctypes.c_int64(rows.shape[2]))
    function(*sizes, *addresses)
