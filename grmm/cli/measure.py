"""``grmm evaluate``, ``grmm score`` and ``grmm ablate``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from express50.console import OK, log, say, say_json
from express50.errors import ConfigError
from grmm.cli.learn import add_training, train_config
from grmm.cli.shared import (
    add_checkpoint_and_shards,
    add_metrics,
    at_least,
    load,
    metric_settings,
    no_file,
    open_views,
    parse_seconds,
    select,
    split_names,
)

if TYPE_CHECKING:
    from grmm.checkpoint import Loaded
    from grmm.data import HeadViews
    from grmm.identity_evaluation import FitProtocol


def add_evaluate(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm evaluate``."""
    parser = commands.add_parser(
        "evaluate",
        help="measure a checkpoint on shards",
        epilog="example: grmm evaluate run/checkpoint.pt shards out --fit-cameras cam03",
    )
    add_checkpoint_and_shards(parser)
    parser.add_argument("out", type=Path, help="folder for evaluation.csv and evaluation.json")
    _add_choice(parser)
    parser.add_argument("--heldout", action="store_true", help="leave out what training saw")
    parser.add_argument("--save", type=Path, metavar="FOLDER", help="write pictures for 'score'")
    _add_protocol(parser)
    add_metrics(parser)
    parser.add_argument("--json", action="store_true", help="print the means as JSON")
    parser.set_defaults(handler=_evaluate)


def _add_choice(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--subjects", default="*", help="ids or patterns, for example S001,S002")
    parser.add_argument("--expressions", default="*", help="ids or patterns")
    parser.add_argument("--cameras", default="*", help="ids or patterns, for example cam02,cam05")
    parser.add_argument("--images", type=at_least(0), default=0, help="at most so many, 0 = all")


def _add_protocol(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--fit-cameras", default="", help="fit unseen people from these views")
    parser.add_argument("--fit-expression", default="neutral", help="and this expression")
    parser.add_argument("--fit-budget", type=parse_seconds, help="time for a fit: 60s, 5m")


def _evaluate(args: argparse.Namespace) -> int:
    from grmm.evaluate import SEEN, evaluate, kind_of, training_render, write_evaluation
    from grmm.identity_evaluation import evaluate_unseen
    from grmm.perceptual_metrics import PerceptualMetrics
    from grmm.sampler import spread
    from grmm.score import save_pictures
    from grmm.shard_source import ShardSource

    no_file(args.out)
    loaded = load(args.checkpoint, metric_settings(args), args.fit_budget)
    views = open_views(loaded, args.shards)
    background = loaded.config.data.background
    source = ShardSource(args.shards, split="*")
    keep = save_pictures(args.save, source, background) if args.save else None
    judge = PerceptualMetrics(loaded.config.metrics)
    known, unseen = _split(loaded, views, args)
    if args.heldout:
        subjects, gallery = loaded.model.subjects, loaded.gallery
        known = [i for i in known if kind_of(views.keys[i], subjects, gallery) != SEEN]
    if args.images:
        known = spread(known, args.images)
    if not known and not unseen:
        raise ConfigError(
            f"{args.shards}: training saw all that was chosen; leave --heldout out, or train with "
            "--holdout-cameras"
        )
    rows = evaluate(
        views,
        known,
        training_render(loaded.model, views),
        judge,
        lambda key: kind_of(key, loaded.model.subjects, loaded.gallery),
        keep,
    )
    for subject, chosen in unseen.items():
        found, effort = evaluate_unseen(
            loaded, views, subject, _protocol(args), judge, keep, chosen
        )
        log(f"{subject}: fitted from {', '.join(effort['cameras'])} in {effort['seconds']} s")
        rows += found
    summary = write_evaluation(args.out, rows, judge)
    _tell(summary, args.json)
    return OK


def _split(
    loaded: Loaded, views: HeadViews, args: argparse.Namespace
) -> tuple[list[int], dict[str, list[int]]]:
    """Split samples into those that codes can draw and, by person, those to fit first."""
    chosen = select(views, args.subjects, args.expressions, args.cameras)
    people, expressions = loaded.model.subjects, loaded.model.expressions
    known = [
        i
        for i in chosen
        if views.keys[i].subject in people and views.keys[i].expression in expressions
    ]
    unseen: dict[str, list[int]] = {}
    for i in chosen:
        if views.keys[i].subject not in people:
            unseen.setdefault(views.keys[i].subject, []).append(i)
    if args.fit_cameras:
        return known, dict(sorted(unseen.items()))
    if not known:
        raise ConfigError(
            f"{args.shards}: training saw none of {', '.join(sorted(unseen)) or args.expressions}; "
            "people whom it never saw are fitted first: name --fit-cameras"
        )
    return known, {}


def _protocol(args: argparse.Namespace) -> FitProtocol:
    from grmm.identity_evaluation import FitProtocol

    return FitProtocol(
        cameras=split_names(args.fit_cameras), expression=args.fit_expression, images=args.images
    )


def _tell(summary: dict, as_json: bool) -> None:
    from grmm.evaluate import summary_lines

    if as_json:
        say_json(summary)
    else:
        say(*summary_lines(summary))


def add_score(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm score``."""
    parser = commands.add_parser(
        "score",
        help="measure another method's pictures on shards",
        epilog="example: grmm score headnerf/ shards out --cameras cam06",
    )
    parser.add_argument("renders", type=Path, help="SUBJECT_EXPRESSION_CAMERA.png, as packed")
    parser.add_argument("shards", type=Path, help="folder of shards")
    parser.add_argument("out", type=Path, help="folder for evaluation.csv and evaluation.json")
    _add_choice(parser)
    parser.add_argument("--background", type=float, default=0.0, help="grey, 0 to 1")
    parser.add_argument("--torso", default="ignore", choices=("ignore", "keep"), help="its pixels")
    parser.add_argument("--partial", action="store_true", help="score the pictures that exist")
    add_metrics(parser)
    parser.add_argument("--json", action="store_true", help="print the means as JSON")
    parser.set_defaults(handler=_score)


def _score(args: argparse.Namespace) -> int:
    from express50.head.load import load_head
    from grmm.config import DataConfig, MetricsConfig
    from grmm.data import HeadViews
    from grmm.evaluate import write_evaluation
    from grmm.perceptual_metrics import PerceptualMetrics
    from grmm.sampler import spread
    from grmm.score import score
    from grmm.shard_source import ShardSource

    data = DataConfig(background=args.background, torso=args.torso)
    source = ShardSource(args.shards, split="*")
    views = HeadViews(source, load_head(source.head), background=data.background, torso=data.torso)
    chosen = select(views, args.subjects, args.expressions, args.cameras)
    chosen = spread(chosen, args.images) if args.images else chosen
    judge = PerceptualMetrics(MetricsConfig(alexnet=args.alexnet, inception=args.inception))
    rows = score(args.renders, source, views, chosen, judge, partial=args.partial)
    summary = write_evaluation(args.out, rows, judge)
    _tell(summary, args.json)
    if len(rows) < len(chosen):
        log(f"scored {len(rows)} of {len(chosen)} samples: the others have no picture")
    return OK


def add_ablate(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm ablate``."""
    parser = commands.add_parser(
        "ablate",
        help="train and measure the paper's ablations under one budget",
        epilog="example: grmm ablate express/pack/shards out --also renderme/pack/shards "
        "--preset small --budget 2h --fit-cameras cam03 --fit-budget 60s",
    )
    parser.add_argument("shards", type=Path, help="folder of shards")
    parser.add_argument(
        "out", type=Path, help="for a folder per row, ablation.md and ablation.json"
    )
    add_training(parser)
    parser.add_argument("--rows", default="", help="full,no_residuals,..; default: all")
    parser.add_argument("--fit-subjects", default="", help="default: all not trained")
    parser.add_argument(
        "--images", type=at_least(0), default=0, help="measured a protocol, 0 = all"
    )
    _add_protocol(parser)
    parser.add_argument("--json", action="store_true", help="print the table as JSON")
    parser.set_defaults(handler=_ablate)


def _ablate(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from grmm.ablate import ablate

    config = train_config(args)
    if args.fit_budget is not None:
        config = replace(config, fit=replace(config.fit, seconds=args.fit_budget))
    roots = [args.shards, *args.also]
    subjects, names = split_names(args.fit_subjects), split_names(args.rows)
    table = ablate(roots, args.out, config, _protocol(args), subjects, names)
    if args.json:
        say_json(table)
    else:
        say((args.out / "ablation.md").read_text(encoding="utf-8"))
    return OK
