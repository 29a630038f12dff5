"""Tiny networks of the published signatures, written as TorchScript and ONNX files."""

from __future__ import annotations

from pathlib import Path

import torch
from onnx import TensorProto, helper, save
from torch import nn


class Difference(nn.Module):
    """BackgroundMattingV2's signature: alpha is the blurred difference from the plate."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(8.0))
        self.refine_mode = "sampling"

    def forward(self, src: torch.Tensor, bgr: torch.Tensor):
        if src.shape[2] % 4 != 0 or src.shape[3] % 4 != 0:
            raise ValueError("sides must be multiples of 4")
        size = (src - bgr).abs().mean(1, keepdim=True)
        near = torch.nn.functional.avg_pool2d(size, 3, 1, 1)
        pha = (self.gain * near).clamp(0.0, 1.0)
        mode = torch.full_like(pha, 1.0 if self.refine_mode == "thresholding" else 0.0)
        return pha, src, mode


class Bright(nn.Module):
    """BiRefNet's signature: every scale, the finest last, as logits that grow with brightness."""

    def forward(self, image: torch.Tensor):
        logits = 40.0 * image.mean(1, keepdim=True)
        return [torch.nn.functional.avg_pool2d(logits, 4), logits]


class Thirds(nn.Module):
    """Sapiens' signature: hair above, face, then torso, by rows; background at the sides."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        rows = torch.linspace(0, 1, 256).view(1, 1, 256, 1)
        columns = torch.linspace(-1, 1, 192).view(1, 1, 1, 192)
        scores = torch.full((1, 28, 256, 192), -9.0)
        scores[:, 0:1] = (columns.abs() - 0.6) * 40 + 0 * rows
        scores[:, 3:4] = (0.25 - rows) * 40 + 0 * columns
        scores[:, 2:3] = 0.1 + 0 * rows + 0 * columns
        scores[:, 22:23] = (rows - 0.7) * 40 + 0 * columns
        return scores + 0 * image.mean()


def traced_thirds(path: Path) -> Path:
    """Sapiens' signature as it is published: traced, with weights, at a quarter of the size."""
    module = nn.Conv2d(3, 28, 4, stride=4)
    nn.init.zeros_(module.weight)
    nn.init.zeros_(module.bias)
    module.weight.data[3] = 1.0  # bright is hair, dark is clothes
    module.weight.data[22] = -1.0
    torch.jit.trace(module.eval(), torch.zeros(1, 3, 1024, 768)).save(str(path))
    return path


class Bad(nn.Module):
    """Takes one picture, or two, and gives what it should not."""

    def __init__(self, how: str) -> None:
        super().__init__()
        self.how = how

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        if self.how == "nan":
            return image[:, :1] * float("nan")
        if self.how == "shape":
            return image.mean()
        if self.how == "small":
            return image[:, :1, ::2, ::2]
        if self.how == "random":
            return torch.rand_like(image[:, :1])
        raise RuntimeError("out of luck")


class BadPair(Bad):
    def forward(self, src: torch.Tensor, bgr: torch.Tensor) -> torch.Tensor:
        if self.how == "nan":
            return src[:, :1] * float("nan")
        return src[:, :1, ::2, ::2] + bgr[:, :1, ::2, ::2]


def torchscript(module: nn.Module, path: Path) -> Path:
    """Save a scripted module."""
    torch.jit.script(module.eval()).save(str(path))
    return path


def onnx_difference(path: Path, order: tuple[str, str] = ("src", "bgr")) -> Path:
    """BackgroundMattingV2's signature as ONNX: alpha is 8 times the difference, named last."""
    pictures = [_tensor(name, ("batch", 3, "height", "width")) for name in order]
    outputs = [_tensor("fgr", ("batch", 3, "height", "width"))]
    outputs.append(_tensor("pha", ("batch", 1, "height", "width")))
    nodes = [
        helper.make_node("Identity", ["src"], ["fgr"]),
        helper.make_node("Sub", ["src", "bgr"], ["signed"]),
        helper.make_node("Abs", ["signed"], ["size"]),
        helper.make_node("ReduceMean", ["size", "axes"], ["mean"], keepdims=1),
        helper.make_node("Mul", ["mean", "gain"], ["wide"]),
        helper.make_node("Clip", ["wide", "zero", "one"], ["pha"]),
    ]
    constants = [
        helper.make_tensor("axes", TensorProto.INT64, [1], [1]),
        *(
            helper.make_tensor(name, TensorProto.FLOAT, [], [value])
            for name, value in (("gain", 8.0), ("zero", 0.0), ("one", 1.0))
        ),
    ]
    return _write(path, nodes, pictures, outputs, constants)


def onnx_bright(path: Path, side: int = 64, sigmoid: bool = True, half: bool = False) -> Path:
    """RMBG-2.0's signature as ONNX: opacity grows with brightness; without sigmoid, logits."""
    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    nodes = [
        helper.make_node("ReduceMean", ["pixel_values", "axes"], ["mean"], keepdims=1),
        helper.make_node("Mul", ["mean", "gain"], ["logits"]),
        helper.make_node("Sigmoid" if sigmoid else "Identity", ["logits"], ["alphas"]),
    ]
    constants = [
        helper.make_tensor("axes", TensorProto.INT64, [1], [1]),
        helper.make_tensor("gain", kind, [], [40.0]),
    ]
    picture = _tensor("pixel_values", (1, 3, side, side), kind)
    return _write(path, nodes, [picture], [_tensor("alphas", (1, 1, side, side), kind)], constants)


def _tensor(name: str, shape: tuple, kind: int = TensorProto.FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def _write(path: Path, nodes: list, inputs: list, outputs: list, constants: list) -> Path:
    graph = helper.make_graph(nodes, "stand_in", inputs, outputs, constants)
    opset = helper.make_opsetid("", 18)
    save(helper.make_model(graph, opset_imports=[opset], ir_version=9), str(path))
    return path
