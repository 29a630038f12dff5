"""Define GRMM's settings and presets, and change them by files and flags.

The defaults are the paper's numbers. Where the paper is silent, docs/GRMM.md says what was chosen
and why; G1 to G23 are its sections. Precedence: ``--set table.key=value``, then TOML, then the
preset, then the defaults.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from express50.contract.config import build_dataclass, check_ranges, known_assignments, read_tables
from express50.errors import ConfigError, nearest

FRAMES = ("head", "tangent")
NOT_NEGATIVE, COUNT = (0, math.inf), (1, math.inf)
SCALE_RANGE_MM = (0.1, 10.0)  # of Gaussians, from the paper; its unit is G2's


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Sizes of the networks."""

    n_g: int = 512
    """Side of the UV map of Gaussians, texels. 0 chooses it from the head's size in the training
    images, at most 512."""
    z_id: int = 512
    """Length of the residual identity code."""
    z_exp: int = 256
    """Length of the residual expression code."""
    features: int = 32
    """Learned features per Gaussian, besides its colour."""
    shared_widths: tuple[int, ...] = (512, 256)
    """Widths of the mesh decoder's shared perceptron. G8."""
    film_width: int = 256
    """Hidden width of the FiLM perceptron. G8."""
    mesh_width: int = 256
    """Hidden width of both displacement heads. G8."""
    mesh_decoder: bool = True
    """False: no vertex displacements (the paper's ablation "without mesh decoder")."""
    mouth: bool = True
    """False: no Gaussians on teeth, tongue and the inside of the mouth (the supplement's ablation
    of the extended UV map)."""
    residual_codes: bool = True
    """False: the decoders read tracked parameters instead of codes (the ablation "without
    residuals")."""
    seed_channels: int = 256
    """Channels of the decoders' 8 x 8 seed. G6."""
    ladder: tuple[int, ...] = (256, 128, 128, 64, 32)
    """Channels after each doubling except the last. G6."""
    identity_modes: int = 0
    """Linear modes per texel, driven by the first entries of z_id; 0 is the paper's model. The
    convolutions share their weights over all texels, so they learn one person's details slowly.
    Modes act on geometry, opacity and colour. G6."""
    frame: str = "head"
    """Axes of the decoded offsets: ``head`` (the paper) or ``tangent``, the posed triangle's own
    axes. G5."""
    opacity_init: float = 0.5
    """Opacity before training. G3."""
    scale_init: float = 1.0
    """Standard deviation of a Gaussian before training, in texels. G2."""
    refine_widths: tuple[int, ...] = (32, 48, 64, 96)
    """Channels of the refinement U-Net per level; empty for the ablation "without refinement".
    G9."""
    refine_alpha: bool = False
    """Give the refinement alpha too: normalised depth is 0 both at the nearest pixel and in the
    background. G9."""
    refine_unshuffle: int = 1
    """Pixel-unshuffle factor before the refinement; 2 makes it four times cheaper. G9."""

    def __post_init__(self) -> None:
        side = self.n_g / 2 ** (len(self.ladder) + 1)
        if self.n_g and (side < 2 or side != int(side)):
            raise ConfigError(
                f"model.n_g is {self.n_g}, expected a multiple of {2 ** (len(self.ladder) + 1)}, "
                f"at least twice it: a ladder of {len(self.ladder)} widths doubles that often"
            )
        if self.frame not in FRAMES:
            raise ConfigError(f"model.frame is {self.frame!r}, expected one of {', '.join(FRAMES)}")
        check_ranges(
            "model", self, opacity_init=(0.01, 0.99), scale_init=(1e-3, 1e3), z_id=COUNT,
            z_exp=COUNT, features=NOT_NEGATIVE, film_width=COUNT, mesh_width=COUNT,
            seed_channels=COUNT, identity_modes=NOT_NEGATIVE, refine_unshuffle=COUNT,
        )  # fmt: skip
        for name in ("shared_widths", "ladder", "refine_widths"):
            if min(getattr(self, name), default=1) < 1:
                raise ConfigError(
                    f"model.{name} is {list(getattr(self, name))}, expected widths of 1 or more"
                )
        if self.identity_modes > self.z_id:
            raise ConfigError(
                f"model.identity_modes is {self.identity_modes}, "
                f"expected at most z_id = {self.z_id}"
            )


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the objective; the paper's, in the units that `grmm.losses` names.

    The mean absolute error of colours has the fixed weight 0.8: Adam ignores a common factor.
    """

    ssim: float = 0.2
    """Weight of 1 - SSIM."""
    vgg16: str = ""
    """Path of torchvision's vgg16 state dict; empty switches the perceptual term off. G14."""
    depth: float = 0.5
    """Weight of the squared depth error, dm^2. G11."""
    scale: float = 0.1
    """Weight of the penalty on scales outside their range, millimetres. G2."""
    laplacian: float = 0.01
    """Weight of the squared Laplacian of the deformed mesh, mm^2. G12."""
    displacement: float = 0.0
    """Weight of the mean squared displacement of vertices, mm^2: the mesh stays as tracked where
    the footage gives no evidence. G12."""
    codes: float = 0.001
    """Weight of the sum of squares of both codes. G13."""

    def __post_init__(self) -> None:
        check_ranges(
            "loss", self, ssim=NOT_NEGATIVE, depth=NOT_NEGATIVE, scale=NOT_NEGATIVE,
            laplacian=NOT_NEGATIVE, displacement=NOT_NEGATIVE, codes=NOT_NEGATIVE,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """Settings that choose what training reads from the shards."""

    holdout_cameras: tuple[str, ...] = ()
    """Cameras that training never sees, as ids or shell patterns; metrics.json reports on them."""
    holdout_expressions: tuple[str, ...] = ()
    """SUBJECT/EXPRESSION frames that training never sees, as shell patterns (S002/smile, */wink*).
    Another subject must show the expression, or it has no code."""
    background: float = 0.0
    """Grey behind footage and renderings, sRGB in [0, 1]. G15."""
    skip_hidden_neck: bool = False
    """Ignore pixels where the torso is in front of the neck: each camera sees a different side
    of the collar. The paper treats them as background, which contradicts other views."""
    hide_behind_torso: bool = False
    """Draw the background where the footage's torso is nearer than what was drawn, if the shards
    have the torso's depth. Otherwise all cameras must agree on where the neck ends."""

    def __post_init__(self) -> None:
        check_ranges("data", self, background=(0, 1))


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """The optimiser and the loop."""

    iterations: int = 250_000
    """Optimiser steps."""
    seconds: float = 0.0
    """Also stop after this much training time, summed over resumed runs; 0 sets no limit."""
    lr: float = 1e-4
    """Adam's rate."""
    code_lr_scale: float = 1.0
    """Factor on the codes' learning rate. G13."""
    texel_lr_scale: float = 1.0
    """Factor on the learning rate of per-texel parameters (biases and modes of the last
    layers), in training and in the second stage of a fit."""
    refine_lr_scale: float = 1.0
    """Factor on the refinement's learning rate. At the demo's 2e-3 its first steps overshoot,
    and it then learns to do nothing."""
    final_lr: float = 1.0
    """Final learning rate over the initial one, along a half cosine. G16."""
    warm_start: bool = False
    """Start from the footage's mean texture instead of grey. G17."""
    accumulate: int = 1
    """Views whose gradients are averaged per step; 4 stands for the paper's four GPUs."""
    seed: int = 0
    """Seed of the initial weights, the sample order and a fit's random cameras."""
    save_seconds: float = 120.0
    """Time between checkpoints of training and of a fit, the most that a kill can lose, unless
    saving would take over a twentieth of the time. 0 saves only at the end."""
    evaluate_images: int = 32
    """Images evaluated for metrics.json, evenly spaced."""

    def __post_init__(self) -> None:
        check_ranges(
            "train", self, iterations=COUNT, accumulate=COUNT, evaluate_images=COUNT,
            seed=(0, 2**63 - 1), lr=(1e-12, 1),
            seconds=NOT_NEGATIVE, save_seconds=NOT_NEGATIVE, final_lr=NOT_NEGATIVE,
            code_lr_scale=NOT_NEGATIVE, texel_lr_scale=NOT_NEGATIVE, refine_lr_scale=NOT_NEGATIVE,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """The two-stage fit of an unseen person. G22."""

    stage1_iterations: int = 500
    """Steps that optimise the codes."""
    stage2_iterations: int = 350
    """Steps that fine-tune the decoders."""
    seconds: float = 0.0
    """Stop after this much time in total; 0 sets no limit."""
    stage2_lr: float = 1e-4
    """Adam's learning rate for the decoders."""
    shuffle_directions: float = 0.0
    """Share of stage-2 steps whose colours are decoded for another training camera's direction:
    one or two views say little about how colours change with the direction."""
    texture_warm_start: bool = False
    """Start stage 2 from the colours that the given images show."""
    locality: float = 0.1
    """Weight of the locality loss."""
    locality_every: int = 1
    """Steps per evaluation of the locality loss; its weight grows by the same factor."""

    def __post_init__(self) -> None:
        check_ranges(
            "fit", self, seconds=NOT_NEGATIVE, locality=NOT_NEGATIVE, stage2_lr=(1e-12, 1),
            shuffle_directions=(0, 1), locality_every=COUNT, stage1_iterations=NOT_NEGATIVE,
            stage2_iterations=NOT_NEGATIVE,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class MetricsConfig:
    """Networks that LPIPS and FID compare images with; the user supplies their weights. G23."""

    alexnet: str = ""
    """Path of torchvision's alexnet state dict for LPIPS; empty: n/a."""
    inception: str = ""
    """Path of the FID Inception network as TorchScript (inception-2015-12-05.pt); empty: n/a."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """All settings; each checkpoint stores the instance that it was trained with."""

    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    data: DataConfig = field(default_factory=DataConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    metrics: MetricsConfig = field(default_factory=MetricsConfig)


Preset = dict[str, dict[str, Any]]
# Our additions to the paper, at any size; docs/PAPER.md lists the measured effect of each.
PLUS: Preset = {
    "data": {"skip_hidden_neck": True, "hide_behind_torso": True},
    "model": {"refine_alpha": True},
    "loss": {"laplacian": 0.0, "displacement": 0.01},
    "train": {"warm_start": True},
    "fit": {"texture_warm_start": True},
}


def _plus(changes: Preset) -> Preset:
    return {table: PLUS.get(table, {}) | changes.get(table, {}) for table in {**PLUS, **changes}}


# ``paper`` has the paper's settings, ``paper-plus`` adds our changes at its sizes, ``small`` suits
# one GPU, ``demo`` a few minutes on two CPU cores.
PRESETS: dict[str, Preset] = {
    "paper": {},
    "paper-plus": PLUS,
    "small": _plus({
        "model": {
            "n_g": 256,
            "z_id": 128,
            "z_exp": 64,
            "seed_channels": 128,
            "ladder": (128, 64, 64, 32),
            "shared_widths": (256, 128),
            "mesh_width": 128,
            "film_width": 128,
            "refine_unshuffle": 2,
            "identity_modes": 12,
            "frame": "tangent",
        },
        "train": {"iterations": 20_000, "lr": 5e-4, "code_lr_scale": 10.0, "final_lr": 0.1},
        "fit": {"stage1_iterations": 200, "stage2_iterations": 200},
    }),
    "demo": _plus({
        "model": {
            "n_g": 128,
            "z_id": 32,
            "z_exp": 16,
            "features": 8,
            "seed_channels": 32,
            "ladder": (32, 32, 24),
            "shared_widths": (64, 64),
            "mesh_width": 48,
            "film_width": 32,
            "refine_widths": (24, 32, 48),
            "refine_unshuffle": 4,
            "identity_modes": 8,
            "frame": "tangent",
            "opacity_init": 0.8,
            "scale_init": 0.7,
        },
        "train": {
            "iterations": 4000,
            "lr": 2e-3,
            "code_lr_scale": 2.0,
            "texel_lr_scale": 5.0,
            "refine_lr_scale": 0.25,
            "final_lr": 0.05,
        },
        "fit": {
            "stage1_iterations": 120,
            "stage2_iterations": 200,
            "shuffle_directions": 0.5,
            "locality_every": 2,
        },
    }),
}  # fmt: skip

MEASURED = Path(__file__).with_name("measured.json")  # written by benchmarks.grmm_trade
TABLES: dict[str, Any] = {table.name: table.default_factory for table in fields(Config)}


def resolve(
    name: str = "paper",
    file: Path | None = None,
    assignments: Sequence[str] = (),
    changes: Mapping[str, Mapping[str, Any]] | None = None,
) -> Config:
    """Build a configuration: assignments over a TOML file over ``changes`` over a preset.

    Assignments read ``table.key=value``.

    Raises:
        ConfigError: unknown preset, table or key, a wrong type, or a value out of range.
    """
    if name not in PRESETS:
        raise ConfigError(
            f"unknown preset {name!r}{nearest(name, PRESETS)}; expected one of {', '.join(PRESETS)}"
            " (of 'grmm train': or auto)"
        )
    tables = as_tables(Config())
    for layer in (PRESETS[name], changes or {}, read_tables(file, list(TABLES)) if file else {}):
        for table, values in layer.items():
            tables[table] |= values
    for table, key, value in known_assignments(assignments, list(TABLES)):
        tables[table][key] = value
    return from_tables(tables)


def from_tables(tables: Mapping[str, Mapping[str, object]]) -> Config:
    """Make a configuration from plain tables, as a checkpoint holds them."""
    hint = "; 'grmm config' lists all"
    return Config(
        **{t: build_dataclass(t, TABLES[t], values, hint) for t, values in tables.items()}
    )


def as_tables(config: Config) -> dict[str, dict[str, Any]]:
    """Convert a configuration to a nested dictionary."""
    return asdict(config)


@dataclass(frozen=True, kw_only=True)
class BudgetChoice:
    """The setting that scored best in a budget of CPU seconds, and its held-out PSNR."""

    setting: str  # its name in docs/TRADEOFFS.md
    changes: dict[str, dict[str, Any]]  # table -> key -> value over the demo preset
    budget_s: float
    psnr_db: float


def choose(seconds: float, measured: Path = MEASURED) -> BudgetChoice:
    """Choose the best setting of the longest measured budget that fits in ``seconds``.

    Less time than any measured budget gets the choice of the shortest. The speed of the machine
    is ignored: a faster one trains the same setting for longer.
    """
    rows = sorted(json.loads(measured.read_text("utf-8")), key=lambda row: row["budget_s"])
    fitting = [row for row in rows if row["budget_s"] <= seconds]
    return BudgetChoice(**(fitting or rows[:1])[-1])
