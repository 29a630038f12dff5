"""Presets of the configuration, TOML files and assignments over them, and plain tables.

Presets: ``paper`` (the dimensions of P), ``small`` (one GPU or a patient CPU) and ``demo`` (two CPU
cores, minutes). Precedence: ``--set table.key=value`` > TOML > preset >
the defaults of :mod:`grmm.config`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
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
    "paper": {"train": {"accumulate": 1, "warm_start": True}},
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
            "stage2_texel_lr_scale": 5.0,
            "texture_warm_start": True,
            "shuffle_directions": 0.5,
            "locality_every": 2,
        },
    },
}

TABLES = {
    "model": ModelConfig,
    "loss": LossConfig,
    "data": DataConfig,
    "train": TrainConfig,
    "fit": FitConfig,
    "metrics": MetricsConfig,
}


def preset(name: str) -> Config:
    """Return the configuration of a preset.

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
    for table, values in _read_toml(file).items():
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
    """Plain nested dictionary of a configuration; tuples become lists."""
    return {
        table: {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in config_values(getattr(config, table)).items()
        }
        for table in TABLES
    }


def _read_toml(file: Path | None) -> dict[str, dict[str, object]]:
    if file is None:
        return {}
    if not file.exists():
        raise ConfigError(f"--config {file}: no such file")
    return read_toml(file, ConfigError)


def _known_table(table: str, where: str) -> None:
    if table not in TABLES:
        raise ConfigError(
            f"{where} is unknown{nearest(table, TABLES)}; expected {', '.join(TABLES)}"
        )
