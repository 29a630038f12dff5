"""Finds what other packages bring: stages, commands and hooks, declared as entry points.

The core imports no package above it. A package names what it offers in its ``pyproject.toml``::

    [project.entry-points."express50.stages"]
    mine = "my_package.stages:STAGES"

- ``express50.stages``: a tuple of `Stage`, in the order in which they run;
- ``express50.commands``: a `Command` of the entry point's name;
- ``express50.hooks``: functions that audits and withdrawals call, see `hook`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from express50.contract.stage import Stage
from express50.errors import ConfigError, StageError

OWN = "toolkit"  # the entry point of this project's own stages, which come first
INSTALL = "run 'pip install -e .' in the folder of the sources"


@dataclass(frozen=True)
class Command:
    """A command of ``express50`` that another package brings.

    Attributes:
        help: one line for the list of commands.
        add: ``add(subparsers)`` adds the command's parser; called when the command is asked for.
    """

    help: str
    add: Callable[[Any], None]


def _load(point: EntryPoint) -> Any:
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"entry point {point.name} = {point.value} of {point.group} does not load ({error}); "
            "fix or uninstall its package"
        ) from error


@functools.cache
def stages() -> dict[str, Stage]:
    """Return every installed stage by name, in the order in which they run.

    Raises:
        StageError: none is installed.
        ConfigError: two stages have one name.
    """
    found: dict[str, Stage] = {}
    points = entry_points(group="express50.stages")
    for point in sorted(points, key=lambda p: (p.name != OWN, p.name)):
        for stage in _load(point):
            if stage.name in found:
                raise ConfigError(
                    f"entry point {point.name} = {point.value}: a stage {stage.name!r} is installed"
                    " already; give the new one another name"
                )
            found[stage.name] = stage
    if not found:
        raise StageError(f"express50 is not installed, so that no stage is known; {INSTALL}")
    return found


def with_required(names: Iterable[str]) -> list[Stage]:
    """Return the named stages and those that their commands run first, in order."""
    known = stages()
    wanted = {other for name in names for other in (*known[name].runs_first, name)}
    return [stage for name, stage in known.items() if name in wanted]


def commands() -> dict[str, Command]:
    """Return the commands that other packages bring, by name."""
    return {p.name: _load(p) for p in sorted(entry_points(group="express50.commands"))}


def hook(name: str) -> Callable[..., Any]:
    """Return an installed hook.

    Args:
        name: ``label_problems(dataset, subjects)`` checks labels against their footage;
            ``read_checkpoint(path)`` reads a trained model or refuses it;
            ``redact_checkpoint(path, subject)`` takes a person out of one.

    Raises:
        StageError: no package brings it.
    """
    for point in entry_points(group="express50.hooks", name=name):
        return _load(point)
    raise StageError(f"no installed package has the hook {name!r}; {INSTALL}")
