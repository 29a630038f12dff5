"""Read and write checkpoints (model, configuration, state of the loop), and remove people.

Writes are atomic. Reads use ``weights_only``, so nothing in a checkpoint is executed.
"""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from express50.errors import ConfigError, DivergedError, FormatError, HeadModelError
from express50.files.arrays import DAMAGE, read_weights
from express50.files.atomic import write_with
from express50.files.text import reason
from express50.geometry.shapes import PIXEL_LIMIT, check_shape
from express50.head import BUILTIN_NAME
from express50.head.load import load_head
from express50.head.model import HeadModel
from grmm.config import Config, ModelConfig, as_tables, from_tables
from grmm.data import HeadViews, Source, Tracked, check_tracked, stacked
from grmm.model import GRMM, PinholeView
from grmm.networks import Networks

FORMAT = "grmm.checkpoint/1"
TRAINING = "training_"  # in a fit, before the names of training's cameras
PARAMETERS = ("shape", "expression", "neck", "jaw", "eyes", "R", "t")  # of a frame


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Gallery:
    """Tracked frames and cameras of the training set, so that a checkpoint renders on its own."""

    frames: dict[tuple[str, str], Tracked]  # (subject, expression) -> parameters
    cameras: dict[str, PinholeView]  # camera id -> its view of the first frame it took


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Checkpoint:
    """A trained or fitted model, ready to use; ``loop`` and ``optimizer`` are for resuming."""

    config: Config
    head_spec: str
    head: HeadModel
    model: GRMM
    gallery: Gallery
    optimizer: dict[str, Any]
    loop: dict[str, Any]
    seen_before: frozenset[tuple[str, str]] | None = None
    """Of a fit: expressions and cameras in which training saw the person. Of a training: None."""

    def views(self, source: Source) -> HeadViews:
        """Prepare the samples of a source as the training data were.

        Raises:
            FormatError: one is of the built-in head, the other is not. Models of other files are
                told apart by their numbers of coefficients (`grmm.data.check_tracked`).
        """
        if (source.head == BUILTIN_NAME) != (self.head.name == BUILTIN_NAME):
            raise FormatError(
                f"the shards were tracked with head model {source.head!r}, the checkpoint has"
                f" {self.head.name!r}; expected one model for both"
            )
        return HeadViews(source, self.head, self.config.data)


def collect_gallery(views: HeadViews, indices: Sequence[int]) -> Gallery:
    """Collect every frame's parameters and one view per camera of the samples ``indices``."""
    frames: dict[tuple[str, str], Tracked] = {}
    cameras: dict[str, PinholeView] = {}
    for index in indices:
        key = views.keys[index]
        if key.frame not in frames or key.camera not in cameras:
            place = views.place(index)
            frames.setdefault(key.frame, place.tracked)
            cameras.setdefault(key.camera, views.view_of(place))
    return Gallery(frames=frames, cameras=cameras)


def save_checkpoint(
    path: Path,
    *,
    model: GRMM,
    config: Config,
    head_spec: str,
    gallery: Gallery,
    seen_before: Collection[tuple[str, str]] | None = None,
    optimizer: dict[str, Any] | None = None,
    loop: dict[str, Any] | None = None,
) -> None:
    """Write a checkpoint atomically; the previous one stays until the new one is complete.

    Raises:
        DivergedError: a weight is NaN or Inf; `load_checkpoint` would refuse the file.
    """
    for name, tensor in model.state_dict().items():
        if not bool(torch.isfinite(tensor).all()):
            raise DivergedError(
                f"{path}: not saved, because {name} holds NaN or Inf: training diverged. What was "
                "saved before is kept; lower the learning rate and start over with --overwrite"
            )
    # One array per parameter: thousands of small ones take seconds to write. Offsets once per
    # subject: they are larger than all other parameters together.
    frames = gallery.frames
    parameters = {
        name: torch.from_numpy(stacked([getattr(frame, name) for frame in frames.values()]))
        for name in PARAMETERS
    }
    offsets = {s: torch.from_numpy(np.ascontiguousarray(t.offsets)) for (s, _), t in frames.items()}
    content = {
        "format": FORMAT,
        "config": as_tables(config),
        "head": head_spec,
        "subjects": list(model.subjects),
        "expressions": list(model.expressions),
        "model": model.state_dict(),
        "frames": [{"subject": s, "expression_id": e} for s, e in frames],
        "parameters": parameters,
        "offsets": offsets,
        "cameras": {
            name: vars(view) | {"K": view.K.cpu(), "cam_from_head": view.cam_from_head.cpu()}
            for name, view in gallery.cameras.items()
        },
        "seen_before": None if seen_before is None else sorted(seen_before),
        "optimizer": optimizer or {},
        "loop": loop or {},
    }
    write_content(path, content)


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> Checkpoint:
    """Read a checkpoint and build its model.

    Raises:
        FormatError: no such file, not a checkpoint of this format, or one whose weights are not
            those of its configuration.
    """
    content = read_content(path)
    try:
        for part in ("model", "frames", "parameters", "offsets", "cameras"):
            _check_finite(path, part, content[part])
        config = from_tables(content["config"])
        head = load_head(content["head"]).to(device)
        return Checkpoint(
            config=config,
            head_spec=content["head"],
            head=head,
            model=_build(path, config.model, head, content).to(device),
            gallery=_gallery(path, content, head, device),
            seen_before=seen_before(content),
            optimizer=content["optimizer"],
            loop=content["loop"],
        )
    except ConfigError as error:
        raise FormatError(
            f"{path}: its configuration: {error}; use the version that the model was trained with,"
            " or train it again"
        ) from None
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        words = f"{type(error).__name__}: {error}"
        raise FormatError(f"{path}: not a whole checkpoint ({words}); copy it again") from error


def read_content(path: Path) -> dict[str, Any]:
    """Read the tables of a checkpoint as they were saved.

    Raises:
        FormatError: no such file, not a checkpoint of this format, or bytes in it have changed.
    """
    remedy = "name the checkpoint.pt of 'grmm train' or 'grmm fit'"
    if path.is_file():
        remedy += "; if it is damaged, copy it again or make it again with --overwrite"
    content = read_weights(path, FormatError, str(path), "a checkpoint", remedy)
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise FormatError(f"{path}: format is {found!r}, expected {FORMAT!r}")
    try:  # torch writes a CRC-32 per tensor, but does not compare it
        with zipfile.ZipFile(path) as archive:
            changed = archive.testzip()
    except DAMAGE as error:
        changed = reason(error)
    if changed:
        raise FormatError(
            f"{path}: its bytes changed after it was written (CRC-32, {changed}); copy it again"
            " or make it again with --overwrite"
        )
    return content


def seen_before(content: dict[str, Any]) -> frozenset[tuple[str, str]] | None:
    """Return what `Checkpoint.seen_before` says of a file's content."""
    if "seen_before" in content:
        pairs = content["seen_before"]
        return None if pairs is None else frozenset(map(tuple, pairs))
    # Earlier versions' fits are known by the names of training's cameras in them alone.
    fitted = any(name.startswith(TRAINING) for name in content.get("cameras", {}))
    return frozenset() if fitted and "iteration" not in content.get("loop", {}) else None


def write_content(path: Path, content: dict[str, Any]) -> None:
    """Write the tables of a checkpoint atomically."""
    write_with(path, lambda file: torch.save(content, file))


def redact(path: Path, subject: str) -> bool:
    """Remove a subject from a checkpoint in place; return True if it was there.

    A checkpoint of this person alone is deleted. Otherwise the rest renders the other people as
    before, but cannot be resumed: the optimizer's state had a row for the person. The decoders'
    weights, which all people share, stay as they are.

    Raises:
        FormatError: the file is not a checkpoint of 'grmm train' or 'fit'.
    """
    content = read_content(path)
    # The first checkpoints have neither offsets nor parameters, but hold people, too.
    named = {*content["subjects"], *content.get("offsets", {})}
    named |= {frame["subject"] for frame in content["frames"]}
    if subject not in named:
        return False
    if content["subjects"] == [subject]:
        path.unlink()
        return True
    rows = [row for row, name in enumerate(content["subjects"]) if name != subject]
    places = [n for n, frame in enumerate(content["frames"]) if frame["subject"] != subject]
    frames = [content["frames"][n] for n in places]
    # No other person shows an expression that this person alone performed.
    lost = {f["expression_id"] for f in content["frames"]} - {f["expression_id"] for f in frames}
    kept = [row for row, name in enumerate(content["expressions"]) if name not in lost]
    # Indexing with a list copies: a view would carry the removed row to the disk.
    codes = {"z_id": content["model"]["z_id"][rows], "z_exp": content["model"]["z_exp"][kept]}
    rest = {
        "subjects": [content["subjects"][row] for row in rows],
        "expressions": [content["expressions"][row] for row in kept],
        "model": content["model"] | codes,
        "frames": frames,
        "parameters": {k: v[places] for k, v in content.get("parameters", {}).items()},
        "offsets": {k: v for k, v in content.get("offsets", {}).items() if k != subject},
        "optimizer": {},
        "loop": {},
    }
    write_content(path, content | rest)
    return True


def _check_finite(path: Path, name: str, value: object) -> None:
    """Refuse NaN and Inf in tensors, through nested tables and lists."""
    if isinstance(value, Tensor):
        if not bool(torch.isfinite(value).all()):
            raise FormatError(f"{path}: {name} holds NaN or Inf; use an earlier checkpoint")
    elif isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            _check_finite(path, f"{name}.{key}", part)


def _build(path: Path, config: ModelConfig, head: HeadModel, content: dict[str, Any]) -> GRMM:
    """Build the model of a file's content, in the memory that its weights take there.

    Shapes are compared first with networks on torch's meta device: a damaged size asks for no
    memory.
    """
    weights, subjects, expressions = (content[n] for n in ("model", "subjects", "expressions"))
    try:
        layers = sum(map(len, (config.shared_widths, config.ladder, config.refine_widths)))
        if layers > len(weights) or config.n_g < 1:
            raise ValueError(f"{layers} layers, n_g = {config.n_g}; stored weights: {len(weights)}")
        with torch.device("meta"):
            networks = Networks(config, head, len(subjects), len(expressions)).state_dict()
        for name in sorted(networks.keys() | weights.keys()):
            expected, stored = (
                tuple(table[name].shape) if name in table else None for table in (networks, weights)
            )
            if expected != stored:
                raise ValueError(f"{name}: stored shape {stored}, expected {expected}")
        model = GRMM(config, head, subjects, expressions)
        model.load_state_dict(weights)
    except (HeadModelError, RuntimeError, ValueError, TypeError, ArithmeticError) as error:
        raise FormatError(
            f"{path}: its weights do not fit its configuration and head model {content['head']!r} "
            f"as it is here now ({reason(error)}); use the version that the model was trained "
            "with, or copy it again"
        ) from None
    return model


def _gallery(
    path: Path, content: dict[str, Any], head: HeadModel, device: torch.device | str
) -> Gallery:
    """Return the frames and cameras of a file's content; refuse cameras with impossible sizes."""
    offsets = {name: tensor.numpy() for name, tensor in content["offsets"].items()}
    frames = {}
    stacks = {name: tensor.numpy() for name, tensor in content["parameters"].items()}
    for number, row in enumerate(content["frames"]):
        subject, expression = row["subject"], row["expression_id"]
        arrays = {name: stack[number] for name, stack in stacks.items()}
        tracked = Tracked(**arrays, offsets=offsets[subject])
        check_tracked(f"{path}: {subject}/{expression}", tracked, head)
        frames[subject, expression] = tracked
    cameras = {}
    for name, row in content["cameras"].items():
        check_shape("K", row["K"], (3, 3), f"camera {name}")
        check_shape("cam_from_head", row["cam_from_head"], (4, 4), f"camera {name}")
        width, height = size = row["width"], row["height"]
        if not all(type(n) is int and n > 0 for n in size) or width * height > PIXEL_LIMIT:
            raise FormatError(
                f"{path}: camera {name}: size {size}, expected two positive whole numbers of "
                f"pixels, together at most {PIXEL_LIMIT}; copy it again"
            )
        K, cam_from_head = row["K"].to(device), row["cam_from_head"].to(device)
        cameras[name] = PinholeView(K=K, cam_from_head=cam_from_head, width=width, height=height)
    return Gallery(frames=frames, cameras=cameras)
