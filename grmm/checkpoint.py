"""Checkpoints: one file that holds the model, its configuration and the whole state of the loop.

Written whole or not at all, read with ``weights_only``: nothing in a checkpoint is executed.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from express50.errors import ConfigError, FormatError, HeadModelError
from express50.files.atomic import write_bytes
from express50.files.pickles import read_weights
from express50.files.text import reason
from express50.geometry.shapes import PIXEL_LIMIT, check_shape
from express50.head.load import load_head
from express50.head.model import HeadModel
from grmm.config import Config, ModelConfig
from grmm.data import NO_OFFSETS, HeadViews, Tracked, check_tracked, pose_state
from grmm.model import GRMM
from grmm.networks import Networks
from grmm.presets import as_tables, from_tables
from grmm.scene import HeadState, PinholeView

FORMAT = "grmm.checkpoint/1"
# Settings of older checkpoints: the value that this version computes with.
RETIRED: dict[str, dict[str, object]] = {
    "model": {
        "displacement_scale": 1e-2, "view_channels": 8, "code_spread": 1.0,
        "opacity_from_expression": False, "thickness_init": 0.3, "scale_min_mm": 0.1,
        "scale_max_mm": 10.0, "depth_normalisation": "minmax", "precision": "float32",
        "refine_alpha": True,
    },
    "loss": {
        "l1": 0.8, "perceptual": 0.04, "depth_erode_px": 2, "perceptual_crop_px": 0,
        "perceptual_every": 1,
    },
    "data": {"crop_margin_px": 16},
    "train": {"ema": 0.0, "clip_norm": 0.0, "overfit": 0, "shuffle_directions": 0.0},
}  # fmt: skip
# Settings of older checkpoints that no result depends on.
DROPPED = {
    "model": ("backend",),
    "data": ("split", "cache_mb"),
    "train": (
        "betas", "tensorboard", "warm_start", "warm_start_images", "save_every", "log_every",
        "threads",
    ),
    "fit": (
        "stage1_share", "stage1_lr", "stage1_final_lr", "stage2_texel_lr_scale", "tune_refinement",
        "locality_t", "codes", "seed",
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Gallery:
    """Tracked frames and cameras of the training set, so that a checkpoint renders on its own.

    Attributes:
        frames: (subject, expression) -> parameters.
        cameras: camera id -> its view of the first frame it took.
    """

    frames: dict[tuple[str, str], Tracked]
    cameras: dict[str, PinholeView]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Loaded:
    """A checkpoint ready to use; ``loop`` and ``optimizer`` serve `train` alone."""

    config: Config
    head_spec: str
    head: HeadModel
    model: GRMM
    gallery: Gallery
    optimizer: dict[str, Any]
    loop: dict[str, Any]

    def state(self, subject: str, expression: str) -> HeadState:
        """Return the tracked head of a training frame.

        Raises:
            FormatError: the training set had no such frame.
        """
        if (subject, expression) not in self.gallery.frames:
            known = ", ".join(f"{s}/{e}" for s, e in list(self.gallery.frames)[:8])
            raise FormatError(
                f"the checkpoint knows no frame {subject}/{expression}; "
                f"expected one such as {known}"
            )
        return pose_state(self.head, self.gallery.frames[subject, expression])


def collect_gallery(views: HeadViews, indices: Sequence[int]) -> Gallery:
    """Collect every frame's parameters and one view per camera of the samples ``indices``."""
    frames: dict[tuple[str, str], Tracked] = {}
    cameras: dict[str, PinholeView] = {}
    for index in indices:
        key = views.keys[index]
        if (key.subject, key.expression) in frames and key.camera in cameras:
            continue
        sample = views.sample(index)
        frames.setdefault((key.subject, key.expression), sample.tracked)
        height, width = sample.alpha.shape
        cameras.setdefault(key.camera, views.view_of(sample, width, height))
    return Gallery(frames=frames, cameras=cameras)


def save_checkpoint(
    path: Path,
    *,
    model: GRMM,
    config: Config,
    head_spec: str,
    gallery: Gallery,
    optimizer: dict[str, Any] | None = None,
    loop: dict[str, Any] | None = None,
) -> None:
    """Write a checkpoint in one step; a former one stays until the new one is whole."""
    content = {
        "format": FORMAT,
        "config": as_tables(config),
        "head": head_spec,
        "subjects": list(model.subjects),
        "expressions": list(model.expressions),
        "model": model.state_dict(),
        "frames": [
            {
                "subject": s,
                "expression_id": e,
                "parameters": {
                    item.name: torch.from_numpy(np.ascontiguousarray(getattr(tracked, item.name)))
                    for item in fields(tracked)
                    if item.name != "offsets"
                },
            }
            for (s, e), tracked in gallery.frames.items()
        ],
        # Once per subject: offsets are larger than all other parameters together.
        "offsets": {
            s: torch.from_numpy(np.ascontiguousarray(tracked.offsets))
            for (s, _), tracked in gallery.frames.items()
        },
        "cameras": {
            name: {
                "K": view.K.cpu(),
                "cam_from_head": view.cam_from_head.cpu(),
                "width": view.width,
                "height": view.height,
            }
            for name, view in gallery.cameras.items()
        },
        "optimizer": optimizer or {},
        "loop": loop or {},
    }
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_bytes(path, buffer.getvalue())


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> Loaded:
    """Read a checkpoint and build its model.

    Raises:
        FormatError: no such file, not a checkpoint of this format, or one whose weights are not
            those of its configuration.
    """
    content = read_content(path)
    try:
        config = from_tables(_current_settings(path, content["config"]))
        _check_finite(path, content["model"])
        head = load_head(content["head"]).to(device)
        return Loaded(
            config=config,
            head_spec=content["head"],
            head=head,
            model=_build(path, config.model, head, content).to(device),
            gallery=_gallery(path, content, head, device),
            optimizer=content["optimizer"],
            loop=content["loop"],
        )
    except ConfigError as error:
        raise FormatError(f"{path}: its configuration: {error}; copy it again") from None
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        words = f"{type(error).__name__}: {error}"
        raise FormatError(f"{path}: not a whole checkpoint ({words}); copy it again") from error


def _current_settings(path: Path, tables: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Leave out settings that older versions had.

    Raises:
        FormatError: such a setting has a value that this version cannot compute with.
    """
    current = {}
    for table, values in tables.items():
        fixed = RETIRED.get(table, {})
        for key, value in fixed.items():
            if values.get(key, value) != value:
                raise FormatError(
                    f"{path}: was trained with {table}.{key} = {values[key]!r}, expected "
                    f"{value!r}: the setting is gone. Train again, or use commit c44aa77"
                )
        gone = {*fixed, *DROPPED.get(table, ())}
        current[table] = {key: value for key, value in values.items() if key not in gone}
    return current


def _build(path: Path, config: ModelConfig, head: HeadModel, content: dict[str, Any]) -> GRMM:
    """Build the model of a file's content, in the memory that its weights take there."""
    weights, names = content["model"], (content["subjects"], content["expressions"])
    try:
        _check_shapes(config, head, names, weights)
        model = GRMM(config, head, *names)
        model.load_state_dict(weights)
    except (HeadModelError, RuntimeError, ValueError, TypeError, ArithmeticError) as error:
        raise FormatError(
            f"{path}: its weights do not fit its configuration and head model {content['head']!r} "
            f"as it is here now ({reason(error)}); use the version that the model was trained "
            "with, or copy it again"
        ) from None
    return model


def _check_shapes(
    config: ModelConfig, head: HeadModel, names: tuple[list, list], weights: dict[str, Tensor]
) -> None:
    """Refuse weights of other names or shapes than the networks of a configuration have.

    The networks are built on torch's meta device: a damaged size asks for no memory.

    Raises:
        ValueError: names the first weight that differs.
    """
    layers = sum(map(len, (config.shared_widths, config.ladder, config.refine_widths)))
    if layers > len(weights) or config.n_g < 1:
        raise ValueError(f"{layers} layers, n_g = {config.n_g}; stored weights: {len(weights)}")
    with torch.device("meta"):
        networks = Networks(config, head, len(names[0]), len(names[1])).state_dict()
    expected = {name: tuple(tensor.shape) for name, tensor in networks.items()}
    stored = {name: tuple(tensor.shape) for name, tensor in weights.items()}
    for name in sorted(expected.keys() | stored.keys()):
        if expected.get(name) != stored.get(name):
            raise ValueError(
                f"{name}: stored shape {stored.get(name)}, expected {expected.get(name)}"
            )


def _gallery(
    path: Path, content: dict[str, Any], head: HeadModel, device: torch.device | str
) -> Gallery:
    """Return the frames and cameras of a file's content."""
    offsets = _arrays(content.get("offsets", {}))
    _check_finite(path, content.get("offsets", {}))
    frames = {}
    for row in content["frames"]:
        subject, expression = row["subject"], row["expression_id"]
        _check_finite(path, row["parameters"])
        tracked = Tracked(**_arrays(row["parameters"]), offsets=offsets.get(subject, NO_OFFSETS))
        check_tracked(f"{path}: {subject}/{expression}", tracked, head)
        frames[subject, expression] = tracked
    cameras = {name: _camera(path, name, row, device) for name, row in content["cameras"].items()}
    return Gallery(frames=frames, cameras=cameras)


def _camera(path: Path, name: str, row: dict[str, Any], device: torch.device | str) -> PinholeView:
    """Read one camera and check that an image may have its size."""
    matrices = {"K": row["K"], "cam_from_head": row["cam_from_head"]}
    _check_finite(path, matrices)
    check_shape("K", row["K"], (3, 3), f"camera {name}")
    check_shape("cam_from_head", row["cam_from_head"], (4, 4), f"camera {name}")
    width, height = size = row["width"], row["height"]
    if not all(type(n) is int and n > 0 for n in size) or width * height > PIXEL_LIMIT:
        raise FormatError(
            f"{path}: camera {name}: size {size}, expected two positive whole numbers of pixels, "
            f"together at most {PIXEL_LIMIT}; copy it again"
        )
    return PinholeView(
        K=row["K"].to(device),
        cam_from_head=row["cam_from_head"].to(device),
        width=width,
        height=height,
    )


def read_content(path: Path) -> dict[str, Any]:
    """Read the tables of a checkpoint as they were saved.

    Raises:
        FormatError: no such file, or not a checkpoint of this format.
    """
    if not Path(path).is_file():
        raise FormatError(f"{path}: no such checkpoint; 'grmm train' writes one")
    remedy = "'grmm train' writes one"
    content = read_weights(path, FormatError, str(path), "a checkpoint that it wrote", remedy)
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise FormatError(f"{path}: format is {found!r}, expected {FORMAT!r}")
    return content


def _check_finite(path: Path, tensors: dict[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise FormatError(f"{path}: {name} holds NaN or Inf; use an earlier checkpoint")


def _arrays(tensors: dict[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: tensor.numpy() for name, tensor in tensors.items()}
