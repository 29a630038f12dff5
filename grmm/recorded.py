"""Play a function's GPU kernels again as one CUDA graph.

A head is drawn by many small kernels, and a GPU runs most of them faster than a processor launches
them. A recorded function needs one launch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from express50.console import log

Result = TypeVar("Result")
KEPT = 4  # recordings of a function and module; each holds its own memory


@dataclass(frozen=True, eq=False)
class _Recording(Generic[Result]):
    play: Callable[[], None]
    inputs: list[Tensor]
    outputs: Result


PLAIN: _Recording[Any] = _Recording(play=lambda: None, inputs=[], outputs=None)
"""Stands for a function that cannot be recorded."""


class Recorded(Generic[Result]):
    """A function of tensors, and of a module if one is given, recorded on its second call.

    The function must not read from the GPU or copy to it, and returns a tensor or a dataclass of
    tensors. Numbers may differ between calls: the function gets them as tensors. It is called as
    usual on a CPU, where gradients are wanted and where recording fails.
    """

    def __init__(self, function: Callable[..., Result]) -> None:
        """Wrap a function, whose documentation stays; nothing is recorded yet."""
        self._function, self.__doc__ = function, function.__doc__
        self._recordings: WeakKeyDictionary[object, dict[Any, _Recording[Result] | None]]
        self._recordings = WeakKeyDictionary()
        self._lock = Lock()

    def __call__(self, *values: Tensor | float, module: nn.Module | None = None) -> Result:
        """Call the function; the caller may keep and change what it returns."""
        function = self._function if module is None else partial(self._function, module)
        if not _can_record(values):
            return function(*values)
        with self._lock:
            known = self._recordings.setdefault(self if module is None else module, {})
            # Training changes weights in place. Weights that were moved lie elsewhere.
            weights = [] if module is None else [*module.parameters(), *module.buffers()]
            shapes = [
                (v.shape, v.dtype, v.device) if isinstance(v, Tensor) else None for v in values
            ]
            key = (*shapes, *(weight.data_ptr() for weight in weights))
            if key not in known:  # recording does not pay for a single call
                for old in list(known)[: max(0, len(known) - KEPT + 1)]:
                    del known[old]
                known[key] = None
                return function(*values)
            recording = known[key]
            if recording is None:
                try:
                    recording = _record(function, values)
                except RuntimeError as error:  # torch's: too little memory, unsupported operations
                    why = str(error).splitlines()[0]
                    log(f"drawing is slower, because the GPU cannot record it: {why}")
                    recording = PLAIN
                known[key] = recording
            if recording is PLAIN:
                return function(*values)
            for mine, value in zip(recording.inputs, values, strict=True):
                if isinstance(value, Tensor):
                    mine.copy_(value)
                else:
                    mine.fill_(value)
            recording.play()
            outputs: Any = recording.outputs
            if isinstance(outputs, Tensor):
                return outputs.clone()
            copies = {name: value.clone() for name, value in vars(outputs).items()}
            return replace(outputs, **copies)


def _can_record(values: Sequence[Tensor | float]) -> bool:
    """Say whether the tensors are on a GPU and no gradient is wanted."""
    return not torch.is_grad_enabled() and all(v.is_cuda for v in values if isinstance(v, Tensor))


def _record(
    function: Callable[..., Result], values: Sequence[Tensor | float]
) -> _Recording[Result]:
    """Record a function's kernels for inputs of these shapes."""
    device = next(v.device for v in values if isinstance(v, Tensor))
    inputs = [
        v.clone()
        if isinstance(v, Tensor)
        else torch.full((), v, dtype=torch.float64, device=device)
        for v in values
    ]
    # A capture that fails leaves its own stream behind as the current one.
    with torch.cuda.device(device), torch.cuda.stream(torch.cuda.current_stream(device)):
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):  # libraries take their memory now, not within the graph
            function(*inputs)
        torch.cuda.current_stream().wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            outputs = function(*inputs)
    return _Recording(play=graph.replay, inputs=inputs, outputs=outputs)
