"""Stage configuration: ``--set`` over TOML over preset, typed and checked, saved beside outputs."""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import math
import textwrap
import tomllib
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from express50.contract.stage import Stage
from express50.errors import ConfigError
from express50.files.text import read_toml

PRESETS = ("draft", "standard", "reference")


def resolve_config(
    stage: Stage,
    preset: str = "standard",
    file: Path | None = None,
    assignments: Sequence[str] = (),
    known_stages: Iterable[str] = (),
) -> Any:
    """Build the configuration of one stage.

    Args:
        stage: the stage.
        preset: ``draft``, ``standard`` or ``reference``.
        file: TOML file with one table a stage; tables of other stages are left alone.
        assignments: ``stage.key=value`` strings; those of other known stages are left alone.
        known_stages: names that a table may carry beside this stage's own.

    Returns:
        An instance of ``stage.config``.

    Raises:
        ConfigError: unknown preset, table or key (the nearest known one is named), wrong type,
            or a value that the dataclass refuses.
    """
    if preset not in stage.presets:
        raise ConfigError(
            f"{stage.name}: unknown preset {preset!r}{nearest(preset, stage.presets)}; "
            f"expected one of {', '.join(stage.presets)}"
        )
    tables = {stage.name, *known_stages}
    values: dict[str, object] = dict(stage.presets[preset])
    if given := _file_values(stage.name, file, tables):
        try:
            build_config(stage, values | given)
        except ConfigError as error:
            raise ConfigError(f"{file}: {error}") from None
        values |= given
    values |= _assigned_values(stage.name, assignments, tables)
    return build_config(stage, values)


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


def nearest(word: str, known: Iterable[str]) -> str:
    """Words ``, did you mean 'x'?`` when a known name is near, else nothing."""
    names = list(known)
    close = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    return f", did you mean {close[0]!r}?" if close else ""


def parse_assignment(text: str) -> tuple[str, str, object]:
    """Split ``stage.key=value``; the value is TOML, a bare word is a string.

    Raises:
        ConfigError: the text has not that form.
    """
    name, equals, raw = text.partition("=")
    table, dot, key = name.strip().partition(".")
    if not (equals and dot and table and key):
        raise ConfigError(
            f"--set {text!r}: expected TABLE.KEY=VALUE, for example track.iterations=200 or"
            " train.lr=1e-3"
        )
    try:
        return table, key, tomllib.loads(f"value = {raw}")["value"]
    except (ValueError, RecursionError):
        return table, key, raw.strip()


def _assigned_values(stage: str, assignments: Sequence[str], tables: set[str]) -> dict:
    values = {}
    for text in assignments:
        table, key, value = parse_assignment(text)
        if table not in tables:
            raise ConfigError(
                f"--set {text!r}: no stage {table!r} in this command"
                f"{nearest(table, sorted(tables))}; expected {', '.join(sorted(tables))}"
            )
        if table == stage:
            values[key] = value
    return values


def _file_values(stage: str, file: Path | None, tables: set[str]) -> dict:
    if file is None:
        return {}
    if not Path(file).exists():
        raise ConfigError(f"--config {file}: no such file")
    content = read_toml(file, ConfigError)
    for table, value in content.items():
        if table not in tables:
            raise ConfigError(
                f"{file}: unknown table [{table}]{nearest(table, sorted(tables))}; "
                f"expected {', '.join(sorted(tables))}"
            )
        if not isinstance(value, dict):
            raise ConfigError(f"{file}: {table} is a value, expected a table [{table}]")
    return content.get(stage, {})


def _coerce(name: str, value: object, kind: Any) -> object:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value not in arguments:
            choices = ", ".join(map(repr, arguments))
            hint = nearest(str(value), map(str, arguments))
            raise ConfigError(f"{name}: got {value!r}{hint}; expected one of {choices}")
        return value
    if origin in (typing.Union, types.UnionType):
        return _coerce_union(name, value, arguments)
    if origin is tuple:
        return _coerce_tuple(name, value, arguments)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        if math.isnan(value):
            raise ConfigError(f"{name}: got NaN, expected a number")
        return float(value)
    # bool is an int in Python, but true is no count
    if isinstance(kind, type) and type(value) is kind:
        return value
    raise ConfigError(
        f"{name}: got {value!r} ({type(value).__name__}), expected {_type_name(kind)}"
    )


def _coerce_union(name: str, value: object, arguments: tuple) -> object:
    if value in (None, "none") and type(None) in arguments:
        return None
    kinds = [kind for kind in arguments if kind is not type(None)]
    for kind in kinds[:-1]:
        try:
            return _coerce(name, value, kind)
        except ConfigError:
            continue
    return _coerce(name, value, kinds[-1])


def _coerce_tuple(name: str, value: object, arguments: tuple) -> tuple:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{name}: got {value!r}, expected a list such as [1, 2]")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(value) != len(arguments):
        raise ConfigError(f"{name}: got {len(value)} values, expected {len(arguments)}")
    return tuple(
        _coerce(f"{name}[{i}]", one, kind)
        for i, (one, kind) in enumerate(zip(value, arguments, strict=True))
    )


def _type_name(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)


def config_values(config: Any) -> dict[str, object]:
    """Field values of a config dataclass, in order."""
    return {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}


def config_toml(name: str, config: Any) -> str:
    """TOML table of a config, each field under the words that document it."""
    documents = field_documents(type(config))
    lines = [f"[{name}]"]
    for key, value in config_values(config).items():
        lines += [f"# {line}" for line in textwrap.wrap(documents.get(key, ""), 98)]
        lines.append(f'{key} = "none"' if value is None else f"{key} = {_toml_value(value)}")
    return "\n".join(lines) + "\n"


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
        return f'"{escaped}"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    return repr(value)


def field_documents(config: type) -> dict[str, str]:
    """Documentation strings that stand under the fields of a config dataclass."""
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
