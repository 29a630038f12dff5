"""Load networks from the user's TorchScript or ONNX files, and label parts of the body with one.

``torch.load``, which executes pickles, is never called. ``torch.jit.load`` has an unpickler of its
own that refuses a file that names ``os.system``, as a test shows. This does not prove safety:
TorchScript is a program, part of which runs at loading, and PyTorch's documentation says to load
only files that one trusts.

Sapiens (Khirodkar et al. 2024), body-part segmentation as TorchScript: RGB at 1024 x 768 minus a
mean and divided by a deviation in 8-bit steps in, scores of 28 classes out (its
``lite/demo/vis_seg.py`` and ``docs/SEG_README.md``). Face and neck are one class there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from express50.contract.segmentation_labels import LABELS, label_mask
from express50.errors import ConfigError, StageError
from express50.files.arrays import DAMAGE
from express50.files.digests import cached_by_file
from express50.files.text import expanded, no_file
from express50.geometry.pixels import resize_area

TORCH_ERRORS = (*DAMAGE, torch.jit.Error)

Run = Callable[[Sequence[np.ndarray]], list[np.ndarray]]
"""Batches (1, 3, H, W) float32 in, the network's outputs in order."""


@dataclass(frozen=True, kw_only=True)
class Role:
    """The interface of a network: the pictures it takes, and the output that is the answer."""

    setting: str  # config key that names the file, such as matte.weights, for messages
    inputs: tuple[str, ...]  # names of the pictures; an ONNX file may order them otherwise
    outputs: tuple[str, ...] = ()  # names that mark the answer in an ONNX file
    place: int = 0  # index of the answer where no name marks it


@dataclass(frozen=True)
class Network:
    """A loaded network; ``size`` is the (height, width) it is bound to, None for any."""

    path: Path
    role: Role
    size: tuple[int, int] | None
    run: Run
    errors: tuple[type[BaseException], ...]  # what `run` raises if the network fails

    def __call__(self, *pictures: np.ndarray) -> np.ndarray:
        """Answer (C, H', W') float32 to pictures (H, W, 3) float32.

        Raises:
            StageError: the network failed, or answered with another shape or NaN or Inf.
        """
        batches = [np.ascontiguousarray(p.transpose(2, 0, 1)[None], np.float32) for p in pictures]
        try:
            answer = self.run(batches)[self.role.place]
        except self.errors as error:
            shape = tuple(batches[0].shape)
            raise self.error(f"failed on input {shape} ({_reason(error)})") from None
        shape = tuple(answer.shape)
        if len(shape) == 3 and shape[0] == 1:  # some exports drop the channel
            answer = answer[None]
        if answer.ndim != 4 or len(answer) != 1 or 0 in shape:
            raise self.error(f"gave shape {shape}, expected (1, channels, height, width)")
        if not np.isfinite(answer).all():
            share = 1 - np.isfinite(answer).mean()
            raise self.error(f"gave NaN or infinity in {share:.1%} of its output")
        return answer[0]

    def error(self, why: str) -> StageError:
        """Make an error about this network, in one line."""
        return _error(self.path, self.role, why)


def load_network(path: str | Path, role: Role) -> Network:
    """Load a network, or take it from those that this process loaded before.

    Raises:
        ConfigError: the file is missing.
        StageError: it is not such a network, or onnxruntime is not installed.
    """
    path = weights_file(path, role.setting)
    return _onnx(path, role) if path.suffix.lower() == ".onnx" else _torchscript(path, role)


def weights_file(path: str | Path, setting: str) -> Path:
    """Return the path of the weights that a setting names; ConfigError if the file is missing."""
    path = expanded(path)
    if not path.is_file():
        raise ConfigError(f"{setting} {path}: {no_file(path)}; expected TorchScript or .onnx")
    return path


def _error(path: Path, role: Role, why: str) -> StageError:
    return StageError(f"{role.setting} {path}: the network {why}")


def _reason(error: BaseException) -> str:
    """Return the last informative line of a library's message, which may run over pages."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__


def _check_inputs(path: Path, role: Role, least: int, most: int) -> None:
    if not least <= len(role.inputs) <= most:
        raise _error(
            path,
            role,
            f"takes {least} pictures, expected {len(role.inputs)} ({', '.join(role.inputs)});"
            " does the setting fit the file?",
        )


@cached_by_file(2)
def _torchscript(path: Path, role: Role) -> Network:
    """Load a TorchScript module: on CUDA in half precision if there is a GPU, else on the CPU."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        module = torch.jit.load(str(path), map_location=device).eval()
        arguments = module.forward.schema.arguments[1:]
    except TORCH_ERRORS:
        # PyTorch's message speaks of its own internals, and guesses what happened to the file.
        raise StageError(
            f"{role.setting} {path}: not TorchScript with a forward, or damaged; expected a file of"
            " torch.jit.save (not a state dict), or .onnx: export it, or download it again"
        ) from None
    needed = sum(not argument.has_default_value() for argument in arguments)
    _check_inputs(path, role, needed, len(arguments))
    if hasattr(module, "refine_mode"):
        # BackgroundMattingV2: as many patches as need it, not a fixed number; its documentation
        # advises so where quality counts before speed.
        module.refine_mode = "thresholding"
    if device.type == "cpu":
        module = module.float()  # few operators work in half precision there
    run = partial(_run_torchscript, path, role, module, device)
    return Network(path, role, None, run, TORCH_ERRORS)


def _run_torchscript(
    path: Path, role: Role, module: torch.jit.ScriptModule, device: torch.device, batches: Sequence
) -> list[np.ndarray]:
    """Return outputs of a module; the same pictures give the same numbers whatever ran before."""
    floats = (p.dtype for p in module.parameters() if p.is_floating_point())
    dtype = next(floats, torch.float32)
    cuda = device.type == "cuda"
    with contextlib.ExitStack() as stack:
        # A network with a random part starts from one seed; profiling would rewrite the graph
        # after its first runs, with other rounding.
        stack.enter_context(torch.random.fork_rng(devices=[device] if cuda else []))
        stack.enter_context(torch.inference_mode())
        stack.enter_context(torch.jit.optimized_execution(False))
        stack.enter_context(torch.backends.cudnn.flags(enabled=True, deterministic=True))
        if cuda and dtype == torch.float32:
            stack.enter_context(torch.autocast("cuda", torch.float16))
        torch.manual_seed(0)
        answer = module(*(torch.from_numpy(b).to(device, dtype) for b in batches))
        if isinstance(answer, torch.Tensor):
            answer = [answer]
        if not isinstance(answer, list | tuple) or not answer:
            raise _error(path, role, f"gave {type(answer).__name__}, expected tensors")
        tensors = [a for a in answer if isinstance(a, torch.Tensor)]
        if not tensors:
            # BiRefNet in training form wraps the list of its scales, the finest last, in another.
            tensors = answer[role.place]
            inside = isinstance(tensors, list | tuple)
            if not inside or not all(isinstance(a, torch.Tensor) for a in tensors):
                kind = type(tensors).__name__
                raise _error(path, role, f"gave {kind} inside its output, expected tensors")
        return [a.float().cpu().numpy() for a in tensors]


@cached_by_file(2)
def _onnx(path: Path, role: Role) -> Network:
    """Load an ONNX graph, on CUDA where onnxruntime has it, else on torch's threads."""
    try:
        import onnxruntime
        from onnxruntime.capi import onnxruntime_pybind11_state as state
    except ImportError:
        raise StageError(
            f"{role.setting} {path}: ONNX files need onnxruntime, which is not installed;"
            " run pip install 'express50[networks]'"
        ) from None
    # The exceptions of onnxruntime share no base class of their own.
    kinds = (kind for kind in vars(state).values() if isinstance(kind, type))
    errors = tuple(kind for kind in kinds if issubclass(kind, Exception))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = torch.get_num_threads(), 1
    options.log_severity_level = 3
    options.use_deterministic_compute = True
    wish = ("CUDAExecutionProvider", "CPUExecutionProvider")
    providers = [p for p in wish if p in onnxruntime.get_available_providers()]
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=providers)
    except errors as error:
        raise StageError(
            f"{role.setting} {path}: onnxruntime cannot load it ({_reason(error)});"
            " expected an ONNX network: export it, or download it again"
        ) from None
    slots = session.get_inputs()
    _check_inputs(path, role, len(slots), len(slots))
    if {s.name for s in slots} == set(role.inputs):
        slots = sorted(slots, key=lambda s: role.inputs.index(s.name))
    names = [o.name for o in session.get_outputs()]
    wanted = [n for n in names if n in role.outputs] or [names[role.place]]

    def run(batches: Sequence[np.ndarray]) -> list[np.ndarray]:
        given = {
            slot.name: batch.astype(np.float16 if "float16" in slot.type else np.float32)
            for slot, batch in zip(slots, batches, strict=True)
        }
        return [np.asarray(session.run(wanted[:1], given)[0], np.float32)]

    height, width = [*slots[0].shape, None, None, None, None][2:4]
    fixed = isinstance(height, int) and isinstance(width, int)
    return Network(path, role, (height, width) if fixed else None, run, errors)


SAPIENS = Role(setting="regions.segmentation", inputs=("image",))
HEIGHT, WIDTH = 1024, 768
MEAN = np.array([123.5, 116.5, 103.5], np.float32)
DEVIATION = np.array([58.5, 57.0, 57.5], np.float32)
CLASSES = 28
_IDS = {"background": (0,), "apparel": (1,), "skin": (2,), "hair": (3,), "lips": (23, 24)}
_IDS |= {"teeth": (25, 26), "tongue": (27,), "hand": (5, 14), "torso": tuple(range(4, 23))}
LABEL_OF_CLASS = np.array(
    [LABELS.index(next(name for name in _IDS if k in _IDS[name])) for k in range(CLASSES)], np.uint8
)


def segment(network: Network, frame: np.ndarray) -> np.ndarray:
    """Label a frame (H, W, 3) uint8: indices (H, W) uint8 into LABELS.

    Raises:
        StageError: the network failed, or did not give 28 finite scores per pixel.
    """
    height, width = network.size or (HEIGHT, WIDTH)
    small = cv2.resize(frame, (width, height), interpolation=cv2.INTER_LINEAR)
    scores = network((small.astype(np.float32) - MEAN) / DEVIATION)
    if scores.ndim != 3 or len(scores) != CLASSES:
        raise network.error(
            f"gave shape {scores.shape}, expected ({CLASSES}, height, width) of Sapiens' body parts"
        )
    best = np.full(frame.shape[:2], -np.inf, np.float32)
    labels = np.zeros(frame.shape[:2], np.uint8)
    # Class by class: 28 scores per pixel of a 4K frame would take a gigabyte.
    for part, score in zip(LABEL_OF_CLASS, scores, strict=True):
        large = resize_area(score, frame.shape[1], frame.shape[0])
        wins = large > best
        best[wins] = large[wins]
        labels[wins] = part
    return labels


def refined(labels: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """Refine the network's labels (H, W): its skin takes the finer labels (H, W) of the mesh.

    The network has no eyes, ears and neck, and an inner mouth only where it shows teeth or tongue.
    """
    skin = labels == LABELS.index("skin")
    finer = label_mask(mesh, "ears", "eyes", "teeth", "tongue", "mouth", "neck")
    return np.where(skin & finer, mesh, labels)
