"""Presets as data, and how TOML files and assignments change them.

``paper`` has the paper's sizes, ``small`` suits one GPU, ``demo`` two CPU cores and minutes.
``measured`` is the demo preset with what did best in a given time (measured.json). Precedence:
``--set table.key=value``, then TOML, then the preset, then the defaults of `grmm.config`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from express50.contract.config import build_dataclass, config_values, nearest, parse_assignment
from express50.errors import ConfigError
from express50.files.text import read_toml
from grmm.config import (
    Config,
    DataConfig,
    FitConfig,
    LossConfig,
    MetricsConfig,
    ModelConfig,
    TrainConfig,
)

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "paper": {},
    "small": {
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
        "fit": {"stage1_iterations": 200, "stage2_iterations": 200, "texture_warm_start": True},
    },
    "demo": {
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
            "stage2_lr": 1e-3,
            "texture_warm_start": True,
            "shuffle_directions": 0.5,
            "locality_every": 2,
        },
    },
}

MEASURED = Path(__file__).with_name("measured.json")  # written by benchmarks.grmm_trade

TABLES = {
    "model": ModelConfig,
    "loss": LossConfig,
    "data": DataConfig,
    "train": TrainConfig,
    "fit": FitConfig,
    "metrics": MetricsConfig,
}


def preset(name: str) -> Config:
    """Build the configuration of a preset.

    Raises:
        ConfigError: no preset has this name.
    """
    if name not in PRESETS:
        raise ConfigError(
            f"preset is {name!r}, expected one of {', '.join(PRESETS)} (of 'grmm train': or"
            " measured)"
        )
    config = Config()
    for table, values in PRESETS[name].items():
        config = replace(config, **{table: replace(getattr(config, table), **values)})
    return config


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
    tables = as_tables(preset(name))
    for table, values in (changes or {}).items():
        tables[table] |= values
    if file is not None and not file.exists():
        raise ConfigError(f"--config {file}: no such file")
    for table, values in ({} if file is None else read_toml(file, ConfigError)).items():
        _known_table(table, f"{file}: table [{table}]")
        if not isinstance(values, dict):
            raise ConfigError(f"{file}: {table} is a value, expected a table [{table}]")
        tables[table] |= values
    for text in assignments:
        table, key, value = parse_assignment(text)
        _known_table(table, f"--set {text!r}: table {table!r}")
        tables[table][key] = value
    return from_tables(tables)


def from_tables(tables: Mapping[str, Mapping[str, object]]) -> Config:
    """Make a configuration from plain tables, as a checkpoint holds them."""
    return Config(
        **{table: build_dataclass(table, TABLES[table], values) for table, values in tables.items()}
    )


def as_tables(config: Config) -> dict[str, dict[str, Any]]:
    """Convert a configuration to a nested dictionary; tuples become lists."""
    return {
        table: {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in config_values(getattr(config, table)).items()
        }
        for table in TABLES
    }


def _known_table(table: str, where: str) -> None:
    if table not in TABLES:
        raise ConfigError(
            f"{where} is unknown{nearest(table, TABLES)}; expected {', '.join(TABLES)}"
        )


@dataclass(frozen=True, kw_only=True)
class BudgetChoice:
    """The setting that did best in a budget.

    Attributes:
        setting: its name in docs/TRADEOFFS.md.
        changes: table -> key -> value over the demo preset.
        budget_s: the processor seconds it was measured with.
        psnr_db: on held-out cameras there.
    """

    setting: str
    changes: dict[str, dict[str, Any]]
    budget_s: float
    psnr_db: float

    def __str__(self) -> str:
        return f"{self.setting} ({self.psnr_db:.1f} dB in {self.budget_s:.0f} s where measured)"


def choose(seconds: float, measured: Path = MEASURED) -> BudgetChoice:
    """Choose the best setting of the longest measured budget that fits in ``seconds``.

    Less time than any that was measured gets the choice of the shortest. The
    speed of the machine is ignored: a faster one trains the same setting for longer.

    Raises:
        ConfigError: the budget is not positive.
    """
    if not seconds > 0:
        raise ConfigError(f"budget is {seconds} s, expected more than 0, such as 4m")
    rows = sorted(json.loads(measured.read_text("utf-8")), key=lambda row: row["budget_s"])
    fitting = [row for row in rows if row["budget_s"] <= seconds]
    return BudgetChoice(**(fitting or rows[:1])[-1])
