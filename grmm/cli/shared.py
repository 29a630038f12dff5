"""The commands of ``grmm`` share these: checkpoints, shards, the choice of samples and heads."""

from __future__ import annotations

import argparse
import fnmatch
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from express50.errors import ConfigError

if TYPE_CHECKING:  # torch takes a second to import: --help must not wait for it
    from grmm.checkpoint import Loaded
    from grmm.data import HeadViews
    from grmm.edit import HeadCodes

CHANGEABLE = ("fit", "metrics", "loss")  # tables that may differ from those of training


def parse_seconds(text: str) -> float:
    """Parse the seconds of a budget: ``90``, ``60s``, ``5m`` or ``1.5h``.

    Raises:
        argparse.ArgumentTypeError: not a positive time.
    """
    unit = {"s": 1.0, "m": 60.0, "h": 3600.0}.get(text[-1:], 0.0)
    try:
        seconds = float(text[:-1]) * unit if unit else float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a time, expected for example 60s, 5m or 1h"
        )
    return seconds


def at_least(low: int, high: int = 1 << 20) -> Callable[[str], int]:
    """Make an argument type of whole numbers from ``low`` to ``high``."""

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f"{text!r}, expected a whole number of {low} to {high}"
            )
        return value

    return number


def no_file(out: Path) -> None:
    """Refuse, before any work, a folder to write to that cannot be one.

    Raises:
        ConfigError: it, or one above it, is a file.
    """
    for path in (out, *out.parents):
        if path.is_dir():
            return
        if path.exists():
            raise ConfigError(f"{path} is a file, expected a folder to write to; name another")


def add_checkpoint_and_shards(parser: argparse.ArgumentParser) -> None:
    """Add the positional arguments of commands that take a model and footage."""
    parser.add_argument("checkpoint", type=Path, help="checkpoint.pt of 'grmm train' or 'fit'")
    parser.add_argument("shards", type=Path, help="folder of shards")


def add_metrics(parser: argparse.ArgumentParser) -> None:
    """Add the flags for the weights of LPIPS and FID, which cannot be distributed."""
    parser.add_argument("--alexnet", default="", help="torchvision's alexnet state dict, for LPIPS")
    parser.add_argument("--inception", default="", help="Inception as TorchScript, for FID")


def metric_settings(args: argparse.Namespace) -> list[str]:
    """Translate the flags of `add_metrics` to assignments."""
    given = {"alexnet": args.alexnet, "inception": args.inception}
    return [f"metrics.{name}={path}" for name, path in given.items() if path]


def load(path: Path, assignments: Sequence[str] = (), seconds: float | None = None) -> Loaded:
    """Read a checkpoint; ``fit.*``, ``metrics.*`` and ``loss.*`` replace its own settings."""
    from express50.contract.config import parse_assignment
    from grmm.checkpoint import load_checkpoint
    from grmm.presets import as_tables, from_tables
    from grmm.train_state import best_device

    loaded = load_checkpoint(path, best_device())
    tables = as_tables(loaded.config)
    for text in assignments:
        table, key, value = parse_assignment(text)
        if table not in CHANGEABLE:
            raise ConfigError(
                f"--set {text!r}: only fit.*, metrics.* and loss.* can change after training"
            )
        tables[table][key] = value
    if seconds is not None:
        tables["fit"]["seconds"] = seconds
    return replace(loaded, config=from_tables(tables))


def open_views(loaded: Loaded, shards: Path) -> HeadViews:
    """Open all samples of a folder of shards, prepared as the checkpoint's training data were."""
    from grmm.data import HeadViews
    from grmm.shard_source import ShardSource

    data = loaded.config.data
    return HeadViews(
        ShardSource(shards, split="*"),
        loaded.head,
        background=data.background,
        torso=data.torso,
        device=loaded.model.z_id.device,
    )


def select(views: HeadViews, subject: str, expressions: str, cameras: str) -> list[int]:
    """Select samples whose ids match shell patterns, several joined by commas.

    Raises:
        ConfigError: a pattern, or all of them together, match nothing.
    """

    def fits(name: str, patterns: str) -> bool:
        return any(fnmatch.fnmatchcase(name, pattern) for pattern in split_names(patterns))

    for kind, patterns in (("subject", subject), ("expression", expressions), ("camera", cameras)):
        names = {getattr(key, kind) for key in views.keys}
        for pattern in split_names(patterns):
            if not fnmatch.filter(names, pattern):
                raise ConfigError(
                    f"no {kind} is {pattern}; the shards have {', '.join(sorted(names))}"
                )
    found = [
        i
        for i, key in enumerate(views.keys)
        if fits(key.subject, subject)
        and fits(key.expression, expressions)
        and fits(key.camera, cameras)
    ]
    if not found:
        known = {
            name: ", ".join(sorted({getattr(key, name) for key in views.keys}))
            for name in ("subject", "expression", "camera")
        }
        raise ConfigError(
            f"no sample has subject {subject}, expression {expressions} and camera {cameras}; "
            f"the shards have subjects {known['subject']}; expressions {known['expression']}; "
            f"cameras {known['camera']}"
        )
    return found


def add_edit(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that choose a training head and edit it parameter by parameter."""
    parser.add_argument("--subject", help="default: the first of the checkpoint")
    parser.add_argument("--expression", help="default: neutral, else the first")
    parser.add_argument(
        "--expression-of", metavar="SUBJECT/EXPRESSION", help="transfer: that frame's expression"
    )
    parser.add_argument("--z-id-of", metavar="SUBJECT", help="residual identity code only")
    parser.add_argument("--z-exp-of", metavar="EXPRESSION", help="residual expression code only")
    parser.add_argument(
        "--control",
        action="append",
        default=[],
        metavar="NAME=NUMBERS",
        help="jaw=0.3,0,0  neck.1=0.2  eyes=0,0.3,0  expression.NAME=1  shape.0=2  "
        "z_exp=0 (scale)  z_id.0=1.5 (principal direction, deviations); repeatable",
    )
    parser.add_argument("--camera", help="a camera of the checkpoint; default: the frontal one")
    parser.add_argument(
        "--size", type=at_least(0, 8192), default=0, help="longer side in pixels, 0 = as trained"
    )


def edited_head(loaded: Loaded, args: argparse.Namespace) -> HeadCodes:
    """Build the head that the arguments of `add_edit` describe."""
    from grmm.edit import controlled, trained_head, with_expression

    head = trained_head(loaded, *frame(loaded, args.subject, args.expression))
    if args.expression_of:
        head = with_expression(head, frame_head(loaded, args.expression_of))
    if args.z_id_of:
        _, expression = frame(loaded, args.z_id_of, None)
        head = replace(head, z_id=trained_head(loaded, args.z_id_of, expression).z_id)
    if args.z_exp_of:
        subject, _ = frame(loaded, None, None)
        head = replace(head, z_exp=trained_head(loaded, subject, args.z_exp_of).z_exp)
    return controlled(loaded, head, dict(_control(text) for text in args.control))


def frame_head(loaded: Loaded, text: str, expression: str | None = None) -> HeadCodes:
    """Build the head of ``SUBJECT/EXPRESSION``; ``expression`` replaces a missing second part."""
    from grmm.edit import trained_head

    subject, _, named = text.partition("/")
    return trained_head(loaded, *frame(loaded, subject, named or expression))


def frame(loaded: Loaded, subject: str | None, expression: str | None) -> tuple[str, str]:
    """Choose the subject and expression to draw, by default the first subject's neutral."""
    model = loaded.model
    subject = subject or model.subjects[0]
    if expression is None:
        own = [e for s, e in loaded.gallery.frames if s == subject]
        expression = "neutral" if "neutral" in own else (own or list(model.expressions))[0]
    return subject, expression


def _control(text: str) -> tuple[str, tuple[float, ...]]:
    name, equals, numbers = text.partition("=")
    try:
        values = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        values = ()
    if not equals or not values:
        raise ConfigError(f"--control {text!r}: expected NAME=NUMBER or NAME=NUMBER,NUMBER,NUMBER")
    return name.strip(), values


def split_names(text: str) -> tuple[str, ...]:
    """Split names joined by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
