"""``grmm`` trains, fits, renders, exports, views, evaluates, scores, ablates and studies.

This file defines what a user may type: each option once in OPTIONS, and each command as a list
of options. `grmm.cli.commands` implements the commands.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from express50 import __version__
from express50.console import Parser, run_handler
from grmm.cli import commands
from grmm.config import PRESETS, TABLES

DESCRIPTION = "Train the Gaussian Residual Morphable Model on packed shards, and use it."
EPILOG = """example:
  grmm train DATASET/pack/shards OUT --budget 10m
exit codes: 0 done, 1 failed, 2 wrong usage or configuration"""
PATTERNS = "ids or patterns, separated by commas"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the ``grmm`` command; returns the exit code (0 ok, 1 failed, 2 usage)."""
    args = build_parser().parse_args(arguments)
    return run_handler("grmm", args.handler, args)


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
        if text.lstrip("-").isdecimal() and low <= int(text) <= high:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number of {low} to {high}")

    return number


def finite(text: str) -> float:
    """Parse a number that is neither NaN nor infinite; a ValueError if it is not one."""
    if not math.isfinite(value := float(text)):
        raise ValueError
    return value


FLAG: dict[str, Any] = {"action": "store_true"}
REPEATED: dict[str, Any] = {"action": "append", "default": []}
OPTIONS: dict[str, dict[str, Any]] = {
    # Positional
    "checkpoint": {"type": Path, "help": "checkpoint.pt of 'grmm train' or 'grmm fit'"},
    "renders": {"type": Path, "help": "folder of SUBJECT_EXPRESSION_CAMERA.png, size as packed"},
    "shards": {"type": Path, "help": "folder of shards"},
    "out": {"type": Path, "help": "folder for evaluation.csv and evaluation.json"},
    "table": {"nargs": "*", "help": f"{', '.join(TABLES)}; default: all"},
    # Training
    "--preset": {
        "default": "paper",
        "help": f"{', '.join(PRESETS)} (paper), or {commands.AUTO}: chosen for the machine and the"
        " --budget",
    },
    "--config": {"type": Path, "help": "TOML file; replaces values of the preset"},
    "--set": REPEATED | {
        "metavar": "TABLE.KEY=VALUE",
        "help": "set one value, such as train.lr=1e-3; overrides preset and file; may be repeated",
    },
    "--also": REPEATED | {"type": Path, "metavar": "SHARDS", "help": "more shards; repeatable"},
    "--budget": {"type": parse_seconds, "dest": "seconds", "metavar": "TIME",
                 "help": "stop after this long: 240, 4m, 2h"},
    "--holdout-cameras": {"default": "", "help": "camera ids to hold out for testing: cam02,cam05"},
    "--holdout-expressions": {
        "default": "", "metavar": "SUBJECT/EXPRESSION,..", "help": "expressions to test on",
    },
    "--paper-diff": FLAG | {"help": "print differences from the paper instead"},
    "--overwrite": FLAG | {"help": "start over even if OUT has a checkpoint"},
    # Measuring
    "--alexnet": {"default": "", "help": "torchvision's alexnet state dict, for LPIPS"},
    "--inception": {"default": "", "help": "Inception as TorchScript, for FID"},
    "--subjects": {"default": "*", "help": f"{PATTERNS}: S001,S002"},
    "--expressions": {"default": "*", "help": PATTERNS},
    "--cameras": {"default": "*", "help": f"{PATTERNS}: cam02,cam05"},
    "--images": {"type": at_least(0), "default": 0, "help": "at most this many, 0 = all"},
    "--heldout": FLAG | {"help": "leave out samples that training saw"},
    "--save": {"type": Path, "metavar": "FOLDER", "help": "write pictures for 'score'"},
    "--fit-subjects": {
        "default": "", "help": "people to fit (default: everyone that training did not see)",
    },
    "--fit-cameras": {"default": "", "help": "fit unseen people from these views"},
    "--fit-expression": {
        "default": "neutral", "help": "fit from this expression (neutral)",
    },
    "--fit-budget": {"type": parse_seconds, "help": "time per fit: 60s, 5m"},
    "--background": {"type": finite, "default": 0.0, "help": "grey, 0 to 1"},
    "--partial": FLAG | {"help": "score only the pictures that exist"},
    "--seeds": {"type": at_least(1), "default": 1, "help": "train each row this many times (1)"},
    "--test": REPEATED | {
        "type": Path, "metavar": "SHARDS", "help": "shards whose people are fitted, not trained on",
    },
    "--rows": {"default": "", "help": "rows of the table, full,no_residuals,.. (default: all)"},
    "--json": FLAG | {"help": "print the result as JSON"},
    # The head to draw and the view of it
    "--subject": {"help": "person to show (default: the first of the checkpoint)"},
    "--expression": {"help": "expression to show (default: neutral, else the first)"},
    "--expression-of": {
        "metavar": "SUBJECT/EXPRESSION", "help": "transfer the expression of this training frame",
    },
    "--z-id-of": {
        "metavar": "SUBJECT", "help": "use only this person's residual identity code",
    },
    "--z-exp-of": {
        "metavar": "EXPRESSION", "help": "use only this expression's residual code",
    },
    "--control": REPEATED | {
        "metavar": "NAME=NUMBERS",
        "help": "jaw=0.3,0,0  neck.1=0.2  eyes=0,0.3,0  expression.NAME=1  shape.0=2  "
        "z_exp=0 (scale)  z_id.0=1.5 (principal direction, deviations); may be repeated",
    },
    "--camera": {"help": "a camera of the checkpoint; default: the frontal one"},
    "--size": {
        "type": at_least(0, 8192), "default": 0, "help": "longer side in pixels, 0 = as trained",
    },
    "--yaw": {"type": finite, "default": 0.0, "help": "degrees the camera moves around the head"},
    "--pitch": {"type": finite, "default": 0.0, "help": "degrees the camera moves up"},
    "--turntable": FLAG | {"help": "write turntable.mp4"},
    "--degrees": {"type": finite, "default": 360.0, "help": "angle that the turntable covers"},
    "--frames": {"type": at_least(1), "default": 72, "help": "number of frames of a video"},
    "--to": {"metavar": "SUBJECT/EXPRESSION", "help": "write interpolation.mp4, ending there"},
    "--drive": {
        "type": Path, "metavar": "SEQUENCE.NPZ", "help": "write driven.mp4: moved by these clips",
    },
    "--drive-cue": {"metavar": "ID", "help": "use only this clip of --drive"},
    "--views": FLAG | {"help": "write views.jpg: novel views"},
    "--controls": FLAG | {"help": "write controls.jpg: one control changed at a time"},
    "--samples": {
        "type": at_least(0), "default": 0, "help": "write samples.jpg with this many new heads",
    },
    "--spread": {
        "type": finite, "default": 1.0, "help": "spread of the samples, 1 = as in training",
    },
    "--seed": {"type": at_least(0), "default": 0, "help": "seed of random choices"},
    "--columns": {"type": at_least(1), "default": 8, "help": "number of expressions in grid.jpg"},
    "--format": {"choices": commands.FORMATS, "help": "format (default: from the file name)"},
    "--shards": {"type": Path, "help": ".html: measure the loss on this footage"},
    "--still": {"type": at_least(16), "default": 512, "help": "height of still pictures, pixels"},
    "--host": {"default": "127.0.0.1", "help": "address to listen on (this machine)"},
    "--port": {"type": at_least(1, 65535), "default": 8080, "help": "port to listen on"},
    # Studies
    "--reference": {"type": Path, "required": True, "help": "true pictures"},
    "--ours": {"type": Path, "required": True, "help": "one method's pictures, same names"},
    "--theirs": {"type": Path, "required": True, "help": "the other method's pictures"},
    "--names": {"nargs": 2, "default": ["Ours", "Theirs"], "metavar": "NAME"},
    "--examples": {"type": at_least(1), "default": 15, "help": "examples per participant (15)"},
    "--participants": {"type": at_least(1), "default": 20, "help": "number of participants (20)"},
}  # fmt: skip
ALIASES = {"--budget": ["--seconds"]}

METRICS = "--alexnet --inception"
TRAINING = (
    f"--preset --config --set --also --budget --holdout-cameras --holdout-expressions {METRICS}"
)
CHOICE = "--subjects --expressions --cameras --images"
PROTOCOL = "--fit-cameras --fit-expression --fit-budget"
EDIT = "--subject --expression --expression-of --z-id-of --z-exp-of --control --camera --size"


@dataclass(frozen=True, kw_only=True)
class GrmmCommand:
    """One command of ``grmm``: ``options`` are names in OPTIONS, ``changes`` to their entries."""

    handler: Callable[[argparse.Namespace], int]
    options: str
    help: str
    example: str = ""
    changes: Mapping[str, dict[str, Any]] = field(default_factory=dict)


COMMANDS = {
    "train": GrmmCommand(
        handler=commands.train,
        options=f"shards out {TRAINING} --overwrite --json",
        help="train on packed shards",
        example="grmm train data/pack/shards run --preset demo --budget 4m; the same command again "
        "continues from run/checkpoint.pt",
        changes={
            "out": {"help": "folder for checkpoint.pt, metrics.json, preview/"},
            "--preset": {
                "default": commands.AUTO,
                "help": f"{', '.join(PRESETS)}, or {commands.AUTO}: chosen for the machine and the"
                " --budget (auto)",
            },
        },
    ),
    "fit": GrmmCommand(
        handler=commands.fit,
        options="checkpoint shards out --subject --expression --cameras --budget --set "
        f"--overwrite {METRICS} --json",
        help="fit an unseen subject",
        example="grmm fit run/checkpoint.pt shards out --subject S004 --expression neutral "
        "--cameras cam02,cam03 --budget 60s",
        changes={
            "out": {"help": "folder for checkpoint.pt, metrics.json, pictures"},
            "--subject": {"required": True, "help": "person to fit"},
            "--expression": {"default": "*", "help": PATTERNS},
            "--set": {
                "metavar": "fit.KEY=VALUE",
                "help": "one setting of the fit; may be repeated",
            },
            "--overwrite": {"help": "replace the fit in OUT"},
        },
    ),
    "config": GrmmCommand(
        handler=commands.config,
        options=f"table {TRAINING} --paper-diff",
        help="print every setting with its meaning, in the form that --config reads",
        example="grmm config train fit --preset demo",
    ),
    "render": GrmmCommand(
        handler=commands.render,
        options=f"checkpoint out {EDIT} --yaw --pitch --turntable --degrees --frames --to --drive "
        "--drive-cue --views --controls --samples --spread --seed --columns",
        help="draw a head, optionally edited, as pictures, sheets or videos",
        example="grmm render run/checkpoint.pt pictures --subject S002 --expression-of S001/smile "
        "--control jaw.0=0.2 --turntable --views",
        changes={"out": {"help": "folder for pictures and videos"}},
    ),
    "export": GrmmCommand(
        handler=commands.export,
        options=f"checkpoint out {EDIT} --format --shards --drive --drive-cue",
        help="write a head as a page that plays it (.html), .ply, .glb or .npz",
        example="grmm export run/checkpoint.pt head.glb --expression smile",
        changes={
            "out": {
                "help": ".html: a player; .ply, .spz, .glb with --format splats: splats; .glb: "
                "textured mesh; .npz: all arrays, codes too"
            },
            "--drive": {"help": ".html: tracked clips that it plays"},
        },
    ),
    "view": GrmmCommand(
        handler=commands.view,
        options="checkpoint --host --port --size --still",
        help="turn, move and blend a head in the browser",
        example="grmm view run/checkpoint.pt",
        changes={
            "--size": {
                "type": at_least(16),
                "default": 320,
                "help": "height while the picture moves, pixels",
            }  # fmt: skip
        },
    ),
    "evaluate": GrmmCommand(
        handler=commands.evaluate,
        options=f"checkpoint shards out {CHOICE} --heldout --save {PROTOCOL} {METRICS} --json",
        help="measure a checkpoint on shards",
        example="grmm evaluate run/checkpoint.pt shards out --fit-cameras cam03",
    ),
    "score": GrmmCommand(
        handler=commands.score,
        options=f"renders shards out {CHOICE} --background --partial {METRICS} --json",
        help="measure another method's pictures on shards",
        example="grmm score headnerf/ shards out --cameras cam06",
    ),
    "ablate": GrmmCommand(
        handler=commands.ablate,
        options=f"shards out {TRAINING} --rows --seeds --test --fit-subjects --images {PROTOCOL}"
        " --json",
        help="train and measure the paper's ablations under one budget",
        example="grmm ablate express/pack/shards out --also renderme/pack/shards --preset small "
        "--budget 2h --fit-cameras cam03 --fit-budget 60s",
        changes={"out": {"help": "for a folder per row, ablation.md and ablation.json"}},
    ),
}
STUDY_ACTIONS = {
    "make": GrmmCommand(
        handler=commands.study_make,
        options="out --reference --ours --theirs --names --examples --participants --seed",
        help="choose examples and assign A and B, counterbalanced",
        example="grmm study make study --reference truth --ours grmm --theirs md",
        changes={"out": {"help": "folder for study.json and pictures/"}},
    ),
    "serve": GrmmCommand(
        handler=commands.study_serve,
        options="out --host --port",
        help="show the page and collect answers",
        changes={"out": {"help": "folder of the study"}, "--port": {"default": 8000}},
    ),
    "table": GrmmCommand(
        handler=commands.study_table,
        options="out --json",
        help="the paper's table, with confidence intervals",
        changes={"out": {"help": "folder of the study"}},
    ),
}


def build_parser() -> argparse.ArgumentParser:
    """Build the argument parser with all commands."""
    parser = Parser(
        prog="grmm",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"grmm {__version__}")
    group = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        _add(group, name, command)
    study = group.add_parser("study", help="ask people which of two methods is better")
    actions = study.add_subparsers(required=True, metavar="ACTION")
    for name, command in STUDY_ACTIONS.items():
        _add(actions, name, command)
    return parser


def _add(group: argparse._SubParsersAction, name: str, command: GrmmCommand) -> None:
    epilog = f"example: {command.example}" if command.example else None
    parser = group.add_parser(name, help=command.help, epilog=epilog)
    for option in command.options.split():
        entry = OPTIONS[option] | command.changes.get(option, {})
        parser.add_argument(option, *ALIASES.get(option, []), **entry)
    parser.set_defaults(handler=command.handler)
