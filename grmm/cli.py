"""``grmm``: train, fit, render, evaluate, export. Handlers parse, call the library, print."""

from __future__ import annotations

import argparse
import fnmatch
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from express50.console import OK, run_handler, say, say_json
from express50.errors import ConfigError
from grmm.config import PRESETS, Config, resolve

if TYPE_CHECKING:  # torch takes a second to import: --help must not wait for it
    from grmm.checkpoint import Loaded
    from grmm.data import HeadViews


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the ``grmm`` command; returns the exit code (0 ok, 1 failed, 2 usage)."""
    args = build_parser().parse_args(arguments)
    return run_handler("grmm", args.handler, args)


def build_parser() -> argparse.ArgumentParser:
    """The argument parser with all commands."""
    parser = argparse.ArgumentParser(prog="grmm", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_train(commands)
    _add_fit(commands)
    _add_render(commands)
    _add_evaluate(commands)
    _add_export(commands)
    return parser


def _add_train(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "train",
        help="train on packed shards",
        epilog="example: grmm train data/pack/shards run --preset demo --seconds 240",
    )
    parser.add_argument("shards", type=Path, help="folder of shards")
    parser.add_argument("out", type=Path, help="folder for checkpoint.pt, metrics.json, preview/")
    parser.add_argument("--preset", default="paper", help=f"{', '.join(PRESETS)} (paper)")
    parser.add_argument("--config", type=Path, help="TOML file over the preset")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="TABLE.KEY=VALUE",
        help="one value over everything else, for example train.lr=1e-3; repeatable",
    )
    parser.add_argument("--seconds", type=float, help="stop training after this long")
    parser.add_argument("--holdout-cameras", default="", help="camera ids to test on: cam02,cam05")
    parser.add_argument("--overfit", action="store_true", help="check: train on one view only")
    parser.add_argument("--resume", action="store_true", help="go on from OUT/checkpoint.pt")
    parser.add_argument("--json", action="store_true", help="print metrics as JSON")
    parser.set_defaults(handler=_train)


def _train(args: argparse.Namespace) -> int:
    from express50.head.load import load_head
    from grmm.shard_source import ShardSource
    from grmm.train import train

    config = train_config(args)
    source = ShardSource(args.shards, split=config.data.split)
    metrics = train(source, load_head(source.head), args.out, config, resume=args.resume)
    if args.json:
        say_json(metrics)
    else:
        for name in ("psnr_heldout_view_db", "psnr_train_db", "ssim", "iterations", "gaussians"):
            say(f"{name}: {metrics.get(name)}")
        say(f"wrote {args.out / 'checkpoint.pt'}")
    return OK


def train_config(args: argparse.Namespace) -> Config:
    """Resolved configuration of ``grmm train``: its own flags stand above --set."""
    config = resolve(args.preset, args.config, args.set)
    if args.seconds is not None:
        config = replace(config, train=replace(config.train, seconds=args.seconds))
    if args.holdout_cameras:
        cameras = _names(args.holdout_cameras)
        config = replace(config, data=replace(config.data, holdout_cameras=cameras))
    if args.overfit:
        config = replace(config, train=replace(config.train, overfit=1))
    return config


def _add_fit(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "fit",
        help="fit an unseen subject",
        epilog="example: grmm fit run/checkpoint.pt shards out --subject S004 "
        "--expression neutral --cameras cam02,cam03 --seconds 60",
    )
    _checkpoint_and_shards(parser)
    parser.add_argument("out", type=Path, help="folder for checkpoint.pt, metrics.json, pictures")
    parser.add_argument("--subject", required=True, help="whom to fit")
    parser.add_argument("--expression", default="*", help="ids or patterns of expressions to fit")
    parser.add_argument("--cameras", default="*", help="ids or patterns of the cameras to fit from")
    parser.add_argument("--seconds", type=float, help="stop after this long")
    parser.add_argument("--set", action="append", default=[], metavar="fit.KEY=VALUE")
    parser.add_argument("--json", action="store_true", help="print metrics as JSON")
    parser.set_defaults(handler=_fit)


def _fit(args: argparse.Namespace) -> int:
    from grmm.fit import fit

    loaded = _load(args.checkpoint, args.set, args.seconds)
    views = _views(loaded, args.shards)
    given = _select(views, args.subject, args.expression, args.cameras)
    chosen = set(given)
    rest = [i for i in _select(views, args.subject, args.expression, "*") if i not in chosen]
    metrics = fit(loaded, views, given, rest, args.out)
    if args.json:
        say_json(metrics)
    else:
        say(f"psnr_db: {metrics['psnr_db']} ({metrics['psnr_is_of']})", f"wrote {args.out}")
    return OK


def _add_render(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "render",
        help="draw a turntable, a grid or an interpolation",
        epilog="example: grmm render run/checkpoint.pt pictures --turntable",
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help="folder for pictures and videos")
    parser.add_argument("--subject", help="default: the first of the checkpoint")
    parser.add_argument("--expression", help="default: neutral, else the first")
    parser.add_argument("--turntable", action="store_true", help="turntable.mp4")
    parser.add_argument("--degrees", type=float, default=360.0, help="how far the turntable goes")
    parser.add_argument("--frames", type=int, default=72, help="frames of a video")
    parser.add_argument("--to", metavar="SUBJECT/EXPRESSION", help="interpolation.mp4 ending there")
    parser.add_argument("--columns", type=int, default=8, help="expressions in grid.jpg")
    parser.set_defaults(handler=_render)


def _render(args: argparse.Namespace) -> int:
    from express50.images import contact_sheet, write_image
    from grmm import render

    loaded = _load(args.checkpoint)
    subject, expression = _frame(loaded, args.subject, args.expression)
    args.out.mkdir(parents=True, exist_ok=True)
    if args.turntable:
        frames = render.turntable(loaded, subject, expression, args.frames, args.degrees)
        render.write_video(args.out / "turntable.mp4", frames)
        say(f"wrote {args.out / 'turntable.mp4'}")
    if args.to:
        goal, _, goal_expression = args.to.partition("/")
        end = _frame(loaded, goal, goal_expression or expression)
        frames = render.interpolation(loaded, (subject, expression), end, args.frames)
        render.write_video(args.out / "interpolation.mp4", frames)
        say(f"wrote {args.out / 'interpolation.mp4'}")
    expressions = loaded.model.expressions[: args.columns]
    rows = render.expression_grid(loaded, loaded.model.subjects[:8], expressions)
    write_image(args.out / "grid.jpg", contact_sheet(rows, None, rows[0][0].shape[:2]))
    say(f"wrote {args.out / 'grid.jpg'}")
    return OK


def _add_evaluate(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="measure a checkpoint on shards",
        epilog="example: grmm evaluate run/checkpoint.pt shards out --cameras cam02",
    )
    _checkpoint_and_shards(parser)
    parser.add_argument("out", type=Path, help="folder for evaluation.csv and evaluation.json")
    parser.add_argument("--cameras", default="*", help="ids or patterns, for example cam02,cam05")
    parser.add_argument("--images", type=int, default=0, help="at most so many, 0 = all")
    parser.add_argument("--json", action="store_true", help="print the means as JSON")
    parser.set_defaults(handler=_evaluate)


def _evaluate(args: argparse.Namespace) -> int:
    from grmm.data import spread
    from grmm.evaluate import evaluate, training_render, write_evaluation

    loaded = _load(args.checkpoint)
    views = _views(loaded, args.shards)
    known = {(s, e) for s in loaded.model.subjects for e in loaded.model.expressions}
    indices = [
        i
        for i in _select(views, "*", "*", args.cameras)
        if (views.keys[i].subject, views.keys[i].expression) in known
    ]
    if not indices:
        raise ConfigError(
            f"{args.shards}: no sample of subjects {', '.join(loaded.model.subjects)} by cameras "
            f"{args.cameras}; unseen subjects are measured by 'grmm fit'"
        )
    indices = spread(indices, args.images) if args.images else indices
    rows = evaluate(views, indices, training_render(loaded.model, views))
    summary = write_evaluation(args.out, rows)
    if args.json:
        say_json(summary)
    else:
        say(f"psnr_db: {summary['psnr_db']}  ssim: {summary['ssim']}  images: {len(rows)}")
    return OK


def _add_export(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "export",
        help="write the Gaussians of a frame",
        epilog="example: grmm export run/checkpoint.pt head.ply --expression smile",
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help=".ply for splat viewers, .npz for all arrays")
    parser.add_argument("--subject", help="default: the first of the checkpoint")
    parser.add_argument("--expression", help="default: neutral, else the first")
    parser.set_defaults(handler=_export)


def _export(args: argparse.Namespace) -> int:
    from grmm.export import cloud, write_cloud

    loaded = _load(args.checkpoint)
    gaussians = cloud(loaded, *_frame(loaded, args.subject, args.expression))
    write_cloud(args.out, gaussians)
    say(f"wrote {args.out}: {len(gaussians.means)} Gaussians")
    return OK


def _checkpoint_and_shards(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("checkpoint", type=Path, help="checkpoint.pt of 'grmm train'")
    parser.add_argument("shards", type=Path, help="folder of shards")


def _load(path: Path, assignments: Sequence[str] = (), seconds: float | None = None) -> Loaded:
    """Read a checkpoint; ``fit.*`` assignments replace what it was trained with."""
    from express50.config import build_dataclass, config_values, parse_assignment
    from grmm.checkpoint import load_checkpoint
    from grmm.config import FitConfig

    loaded = load_checkpoint(path)
    values = config_values(loaded.config.fit)
    for text in assignments:
        table, key, value = parse_assignment(text)
        if table != "fit":
            raise ConfigError(f"--set {text!r}: only fit.* can change after training")
        values[key] = value
    if seconds is not None:
        values["seconds"] = seconds
    settings = build_dataclass("fit", FitConfig, values)
    return replace(loaded, config=replace(loaded.config, fit=settings))


def _views(loaded: Loaded, shards: Path) -> HeadViews:
    from grmm.data import HeadViews
    from grmm.shard_source import ShardSource

    data = loaded.config.data
    source = ShardSource(shards, split="*")
    return HeadViews(
        source,
        loaded.head,
        background=data.background,
        torso=data.torso,
        cache_mb=data.cache_mb,
    )


def _select(views: HeadViews, subject: str, expressions: str, cameras: str) -> list[int]:
    """Indices of samples whose ids match; patterns as in a shell, several joined by commas."""

    def fits(name: str, patterns: str) -> bool:
        return any(fnmatch.fnmatchcase(name, pattern) for pattern in _names(patterns))

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


def _frame(loaded: Loaded, subject: str | None, expression: str | None) -> tuple[str, str]:
    """Subject and expression to draw, by default the first subject's neutral."""
    model = loaded.model
    subject = subject or model.subjects[0]
    if expression is None:
        own = [e for s, e in loaded.gallery.frames if s == subject]
        expression = "neutral" if "neutral" in own else (own or list(model.expressions))[0]
    loaded.state(subject, expression)  # raises if there is no such frame
    return subject, expression


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


if __name__ == "__main__":
    sys.exit(main())
