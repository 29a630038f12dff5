"""``grmm train`` and ``grmm fit``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from express50.console import OK, log, say, say_json
from express50.errors import ConfigError
from grmm.cli.shared import (
    add_checkpoint_and_shards,
    add_metrics,
    load,
    metric_settings,
    no_file,
    open_views,
    parse_seconds,
    select,
    split_names,
)
from grmm.config import Config
from grmm.presets import PRESETS, TABLES, choose, resolve

MEASURED = "measured"  # in place of a preset


def add_train(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm train``."""
    parser = commands.add_parser(
        "train",
        help="train on packed shards",
        epilog="example: grmm train data/pack/shards run --preset demo --seconds 240; the same"
        " again goes on from run/checkpoint.pt",
    )
    parser.add_argument("shards", type=Path, help="folder of shards")
    parser.add_argument("out", type=Path, help="folder for checkpoint.pt, metrics.json, preview/")
    add_training(parser)
    parser.add_argument(
        "--anew", action="store_true", help="start over, though OUT has a checkpoint"
    )
    parser.add_argument("--json", action="store_true", help="print metrics as JSON")
    parser.set_defaults(handler=_train)


def add_training(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that `train_config` reads, and more folders of shards."""
    parser.add_argument(
        "--preset",
        default="paper",
        help=f"{', '.join(PRESETS)}, or {MEASURED}: the setting that did best in --budget (paper)",
    )
    parser.add_argument("--config", type=Path, help="TOML file over the preset")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="TABLE.KEY=VALUE",
        help="one value over everything else, for example train.lr=1e-3; repeatable",
    )
    parser.add_argument(
        "--also",
        type=Path,
        action="append",
        default=[],
        metavar="SHARDS",
        help="mix in; repeatable",
    )
    parser.add_argument(
        "--seconds", "--budget", type=parse_seconds, help="stop after this long: 240, 4m, 2h"
    )
    parser.add_argument("--holdout-cameras", default="", help="camera ids to test on: cam02,cam05")
    parser.add_argument(
        "--holdout-expressions", default="", metavar="SUBJECT/EXPRESSION,..", help="to test on"
    )
    add_metrics(parser)


def _train(args: argparse.Namespace) -> int:
    from express50.head.load import load_head
    from grmm.shard_source import open_shards
    from grmm.train import train

    no_file(args.out)
    config = train_config(args)
    source = open_shards([args.shards, *args.also], "train")
    resume = not args.anew and (args.out / "checkpoint.pt").exists()
    metrics = train(source, load_head(source.head), args.out, config, resume=resume)
    if args.json:
        say_json(metrics)
    else:
        for name in ("psnr_heldout_view_db", "psnr_train_db", "ssim", "iterations", "gaussians"):
            say(f"{name}: {metrics.get(name)}")
        say(f"wrote {args.out / 'checkpoint.pt'}")
    return OK


def train_config(args: argparse.Namespace) -> Config:
    """Return the resolved configuration of ``grmm train``: its own flags stand above --set."""
    name, changes = args.preset, {}
    if name == MEASURED:
        if args.seconds is None:
            raise ConfigError(f"--preset {MEASURED} needs a time, such as --budget 4m")
        choice = choose(args.seconds)
        log(f"measured: {choice}")
        name, changes = "demo", choice.changes
    config = resolve(name, args.config, [*args.set, *metric_settings(args)], changes)
    if args.seconds is not None:
        config = replace(config, train=replace(config.train, seconds=args.seconds))
    if args.holdout_cameras:
        cameras = split_names(args.holdout_cameras)
        config = replace(config, data=replace(config.data, holdout_cameras=cameras))
    if args.holdout_expressions:
        frames = split_names(args.holdout_expressions)
        config = replace(config, data=replace(config.data, holdout_expressions=frames))
    return config


def add_config(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm config``."""
    parser = commands.add_parser(
        "config",
        help="print every setting with its meaning, as --config takes them",
        epilog="example: grmm config train fit --preset demo",
    )
    parser.add_argument("table", nargs="*", help=f"{', '.join(TABLES)}; default: all")
    add_training(parser)
    parser.set_defaults(handler=_config)


def _config(args: argparse.Namespace) -> int:
    from express50.contract.config import config_toml

    config = train_config(args)
    for table in args.table or TABLES:
        if table not in TABLES:
            raise ConfigError(f"unknown table {table!r}; expected one of {', '.join(TABLES)}")
        say(config_toml(table, getattr(config, table)))
    return OK


def add_fit(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm fit``."""
    parser = commands.add_parser(
        "fit",
        help="fit an unseen subject",
        epilog="example: grmm fit run/checkpoint.pt shards out --subject S004 "
        "--expression neutral --cameras cam02,cam03 --budget 60s",
    )
    add_checkpoint_and_shards(parser)
    parser.add_argument("out", type=Path, help="folder for checkpoint.pt, metrics.json, pictures")
    parser.add_argument("--subject", required=True, help="whom to fit")
    parser.add_argument("--expression", default="*", help="ids or patterns of expressions to fit")
    parser.add_argument("--cameras", default="*", help="ids or patterns of the cameras to fit from")
    parser.add_argument(
        "--seconds", "--budget", type=parse_seconds, help="stop after this long: 60s, 5m"
    )
    parser.add_argument("--set", action="append", default=[], metavar="fit.KEY=VALUE")
    parser.add_argument("--anew", action="store_true", help="write over the fit that OUT has")
    add_metrics(parser)
    parser.add_argument("--json", action="store_true", help="print metrics as JSON")
    parser.set_defaults(handler=_fit)


def _fit(args: argparse.Namespace) -> int:
    from grmm.fit import fit

    no_file(args.out)
    made = args.out / "checkpoint.pt"
    if made.exists() and made.samefile(args.checkpoint):
        raise ConfigError(f"{made} is the checkpoint to fit from; name another folder")
    if made.exists() and not args.anew:
        raise ConfigError(f"{made} exists; name another folder, or overwrite it with --anew")
    loaded = load(args.checkpoint, [*args.set, *metric_settings(args)], args.seconds)
    if not loaded.loop and len(loaded.model.subjects) == 1:
        log(
            f"{args.checkpoint} is a fit of {loaded.model.subjects[0]}: it knows how one person "
            "looks; people are fitted from what 'grmm train' wrote"
        )
    views = open_views(loaded, args.shards)
    given = select(views, args.subject, args.expression, args.cameras)
    chosen = set(given)
    rest = [i for i in select(views, args.subject, args.expression, "*") if i not in chosen]
    metrics = fit(loaded, views, given, rest, args.out)
    if args.json:
        say_json(metrics)
    else:
        reached = f"{metrics['seconds']} s, {metrics['iterations']} iterations"
        say(
            f"psnr_db: {metrics['psnr_db']} ({metrics['psnr_is_of']}), after {reached}",
            f"wrote {args.out}",
        )
    return OK
