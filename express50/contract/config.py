"""Resolve a stage's configuration: ``--set`` over TOML over preset, typed, checked, saved."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import json
import math
import textwrap
import tomllib
import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from express50.contract.stage import Stage
from express50.errors import ConfigError, nearest
from express50.files.text import is_number, read_toml

PRESETS = ("draft", "standard", "reference")
_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


def resolve_config(
    stage: Stage,
    preset: str = "standard",
    file: Path | None = None,
    assignments: Sequence[str] = (),
    known_stages: Iterable[str] = (),
) -> Any:
    """Build the configuration of one stage, an instance of ``stage.config``.

    `preset` is ``draft``, ``standard`` or ``reference``. The TOML `file` has one table per stage;
    `assignments` are ``stage.key=value`` strings. Those of other `known_stages` are left alone.

    Raises:
        ConfigError: unknown preset, table or key (the nearest known one is named), wrong type,
            or a value that the dataclass refuses.
    """
    if preset not in PRESETS:
        raise ConfigError(
            f"{stage.name}: unknown preset {preset!r}{nearest(preset, PRESETS)}; "
            f"expected one of {', '.join(PRESETS)}"
        )
    tables = sorted({stage.name, *known_stages})
    values: dict[str, object] = dict(stage.presets.get(preset, {}))
    if file is not None:
        values |= read_tables(file, tables).get(stage.name, {})
    for table, key, value in known_assignments(assignments, tables, "stage"):
        if table == stage.name:
            values[key] = value
    return build_config(stage, values)


def distinct_settings(
    stage: Stage,
    file: Path | None = None,
    assignments: Sequence[str] = (),
    known_stages: Iterable[str] = (),
) -> dict[str, Any]:
    """Return what `resolve_config` builds by preset, without those that equal standard's."""
    given = file, assignments, known_stages
    found = {preset: resolve_config(stage, preset, *given) for preset in PRESETS}
    return {k: c for k, c in found.items() if k == "standard" or c != found["standard"]}


def read_tables(file: Path, known: Sequence[str]) -> dict[str, dict[str, object]]:
    """Return a TOML file's tables; ConfigError for unknown ones, and for values outside of them."""
    if not Path(file).exists():
        raise ConfigError(f"--config {file}: no such file")
    content = read_toml(file, ConfigError)
    for table, given in content.items():
        _check_table(table, known, f"{file}: unknown table [{table}]")
        if not isinstance(given, dict):
            raise ConfigError(f"{file}: {table} is a value, expected a table [{table}]")
    return content


def known_assignments(
    texts: Iterable[str], known: Sequence[str], kind: str = "table"
) -> list[tuple[str, str, object]]:
    """Split ``table.key=value`` as `parse_assignment` does; ConfigError if a table is unknown."""
    found = [(text, *parse_assignment(text)) for text in texts]
    for text, table, _, _ in found:
        _check_table(table, known, f"--set {text!r}: no {kind} {table!r} in this command")
    return [(table, key, value) for _, table, key, value in found]


def _check_table(table: str, known: Sequence[str], words: str) -> None:
    if table not in known:
        raise ConfigError(f"{words}{nearest(table, known)}; expected {', '.join(known)}")


def build_config(stage: Stage, values: Mapping[str, object]) -> Any:
    """Make the config dataclass of a stage from plain values, checking names and types."""
    return build_dataclass(
        stage.name, stage.config, values, hint=f"; 'express50 config {stage.name}' lists all"
    )


def build_dataclass(table: str, kind: type, values: Mapping[str, object], hint: str = "") -> Any:
    """Make a config dataclass from the plain values of one table, checking names and types.

    Raises:
        ConfigError: unknown key (the nearest known one is named), wrong type, or a value that the
            dataclass refuses.
    """
    hints = typing.get_type_hints(kind)
    fields = {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    checked = {}
    for key, value in values.items():
        if key not in fields:
            raise ConfigError(f"unknown key {table}.{key}{nearest(key, fields)}{hint}")
        checked[key] = _coerce(f"{table}.{key}", value, fields[key])
    try:
        return kind(**checked)
    except ValueError as error:
        raise ConfigError(f"{table}: {error}") from error


def check_ranges(table: str, config: object, **ranges: tuple[float, float]) -> None:
    """Refuse fields of a config that lie outside their ranges; both ends belong to a range.

    Raises:
        ConfigError: a field lies outside, or is not finite.
    """
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if not (low <= value <= high and abs(value) < math.inf):
            expected = f"{low} or more" if high == math.inf else f"{low} to {high}"
            raise ConfigError(f"{table}.{name} is {value}, expected {expected}")


def parse_assignment(text: str) -> tuple[str, str, object]:
    """Split ``stage.key=value``; the value is TOML, a bare word is a string.

    Raises:
        ConfigError: the text does not have that form.
    """
    name, equals, raw = text.partition("=")
    table, dot, key = name.strip().partition(".")
    if not (equals and dot and table and key):
        raise ConfigError(
            f"--set {text!r}: expected TABLE.KEY=VALUE, for example depth.voxel_mm=2 or"
            " train.lr=1e-3"
        )
    try:
        return table, key, tomllib.loads(f"value = {raw}")["value"]
    except (ValueError, RecursionError):
        return table, key, raw.strip()


def _coerce(name: str, value: object, kind: Any) -> object:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value not in arguments:
            choices = ", ".join(map(repr, arguments))
            hint = nearest(str(value), map(str, arguments))
            raise ConfigError(f"{name}: got {value!r}{hint}; expected one of {choices}")
        return value
    if origin is tuple:  # of any length and one type
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{name}: got {value!r}, expected a list such as [1, 2]")
        return tuple(_coerce(f"{name}[{i}]", one, arguments[0]) for i, one in enumerate(value))
    if kind is float and is_number(value):
        if math.isnan(value):
            raise ConfigError(f"{name}: got NaN, expected a number")
        return float(value)
    # bool is an int in Python, but true is not a count
    if type(value) is kind:
        return value
    raise ConfigError(f"{name}: got {value!r}, expected {_KINDS.get(kind, kind.__name__)}")


def config_texts(config: Any) -> dict[str, str]:
    """Return field values of a config dataclass, in order, as TOML has them."""
    # TOML writes numbers, texts, lists, true and false as JSON does.
    return {
        field.name: json.dumps(getattr(config, field.name), ensure_ascii=False)
        for field in dataclasses.fields(config)
    }


def config_toml(name: str, config: Any) -> str:
    """Return the TOML table of a config, each field below a comment with its documentation."""
    documents = field_documents(config.__class__)
    lines = [f"[{name}]"]
    for key, text in config_texts(config).items():
        lines += [f"# {line}" for line in textwrap.wrap(documents.get(key, ""), 98)]
        lines.append(f"{key} = {text}")
    return "\n".join(lines) + "\n"


def made_with(path: Path, stage: Stage, known: Mapping[str, Any]) -> str | None:
    """Return which of the ``known`` configurations a stage's file holds; None if it is another one.

    Comments are ignored: the settings' documentation may be that of another version.
    """
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""

    def values(text: str) -> list[str]:
        return [line for line in text.splitlines() if not line.startswith("#")]

    found = values(text)
    return next((k for k, c in known.items() if values(config_toml(stage.name, c)) == found), None)


@functools.cache
def field_documents(config: type) -> dict[str, str]:
    """Return the documentation strings below the fields of a config dataclass, by field."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(config)))
    except OSError:  # classes made at run time have no source
        return {}
    body = typing.cast(ast.ClassDef, tree.body[0]).body
    documents = {}
    for field, below in zip(body, body[1:], strict=False):
        if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
            continue
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            documents[field.target.id] = " ".join(str(below.value.value).split())
    return documents
