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
from express50.console import Parser, add_command, run_handler
from grmm.cli import commands
from grmm.config import PRESETS, TABLES

DESCRIPTION = "Train the Gaussian Residual Morphable Model on packed shards, and use it."
EPILOG = """example:
  grmm train DATASET/pack/shards OUT --budget 10m
exit codes: 0 all done; 1 failed; 2 wrong usage or configuration"""


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
            f"{text!r} is not a time; expected a number of seconds, or 60s, 5m, 1h"
        )
    return seconds


def at_least(low: int, high: int = 1 << 20) -> Callable[[str], int]:
    """Make an argument type of whole numbers from ``low`` to ``high``."""

    def number(text: str) -> int:
        if text.lstrip("-").isdecimal() and low <= int(text) <= high:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number, {low} to {high}")

    return number


def finite(text: str) -> float:
    """Parse a number that is neither NaN nor infinite."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}, expected a finite number")
    return value


FLAG: dict[str, Any] = {"action": "store_true"}
REPEATED: dict[str, Any] = {"action": "append", "default": []}
OPTIONS: dict[str, dict[str, Any]] = {
    # Positional
    "checkpoint": {
        "type": Path, "metavar": "CHECKPOINT",
        "help": "checkpoint.pt of 'grmm train' or 'grmm fit'",
    },
    "renders": {
        "type": Path, "metavar": "PICTURES",
        "help": "folder of SUBJECT_EXPRESSION_CAMERA.png, in the samples' size",
    },
    "shards": {"type": Path, "metavar": "SHARDS", "help": "folder of shards (DATASET/pack/shards)"},
    "out": {
        "type": Path, "metavar": "OUT", "help": "folder for evaluation.csv and evaluation.json",
    },
    "table": {
        "nargs": "*", "metavar": "TABLE", "help": f"{', '.join(TABLES)} (default: all)",
    },
    # Training
    "--preset": {
        "default": "paper",
        "metavar": "PRESET",
        "help": f"{', '.join(PRESETS)}, or {commands.AUTO}, which chooses one for the machine and"
        " the --budget (default: %(default)s)",
    },
    "--config": {
        "type": Path, "metavar": "FILE", "help": "TOML file of settings, one table per part",
    },
    "--set": REPEATED | {
        "metavar": "TABLE.KEY=VALUE",
        "help": "change one setting, such as train.lr=1e-3; may be repeated",
    },
    "--also": REPEATED | {
        "type": Path, "metavar": "SHARDS", "help": "another folder of shards; may be repeated",
    },
    "--budget": {"type": parse_seconds, "dest": "seconds", "metavar": "TIME",
                 "help": "stop after this time: 60s, 4m, 2h"},
    "--holdout-cameras": {
        "default": "", "metavar": "ID,...", "help": "cameras to hold out for testing: cam02,cam05",
    },
    "--holdout-expressions": {
        "default": "", "metavar": "SUBJECT/EXPRESSION,...",
        "help": "expressions to hold out for testing: S002/smile",
    },
    "--paper-diff": FLAG | {"help": "print the differences from the paper instead"},
    "--overwrite": FLAG | {"help": "start over even if OUT has a checkpoint"},
    # Measuring
    "--alexnet": {
        "default": "", "metavar": "FILE", "help": "torchvision's alexnet state dict, for LPIPS",
    },
    "--inception": {
        "default": "", "metavar": "FILE", "help": "Inception as TorchScript, for FID",
    },
    "--subjects": {
        "default": "*", "metavar": "ID,...", "help": "only these, ids or patterns: S001,S002",
    },
    "--expressions": {
        "default": "*", "metavar": "ID,...", "help": "only these, ids or patterns: smile,jaw*",
    },
    "--cameras": {
        "default": "*", "metavar": "ID,...", "help": "only these, ids or patterns: cam02,cam05",
    },
    "--images": {
        "type": at_least(0), "default": 0, "metavar": "N",
        "help": "measure at most this many images, evenly spread (default: all)",
    },
    "--heldout": FLAG | {"help": "leave out samples that training saw"},
    "--save": {
        "type": Path, "metavar": "FOLDER",
        "help": "also write the pictures, as 'grmm score' reads them",
    },
    "--fit-subjects": {
        "default": "", "metavar": "ID,...",
        "help": "people to fit (default: everyone that training did not see)",
    },
    "--fit-cameras": {
        "default": "", "metavar": "ID,...",
        "help": "fit people that training did not see from these cameras",
    },
    "--fit-expression": {
        "default": "neutral", "metavar": "ID",
        "help": "fit them from this expression (default: %(default)s)",
    },
    "--fit-budget": {"type": parse_seconds, "metavar": "TIME", "help": "time per fit: 60s, 5m"},
    "--background": {
        "type": finite, "default": 0.0, "metavar": "GREY",
        "help": "grey behind the pictures, 0 to 1 (default: 0)",
    },
    "--partial": FLAG | {"help": "score only the pictures that exist"},
    "--seeds": {
        "type": at_least(1), "default": 1, "metavar": "N",
        "help": "train each row this many times (default: 1)",
    },
    "--test": REPEATED | {
        "type": Path, "metavar": "SHARDS",
        "help": "shards whose people are fitted, not trained on; may be repeated",
    },
    "--rows": {
        "default": "", "metavar": "ROW,...",
        "help": "rows of the table, such as full,no_residuals (default: all)",
    },
    "--json": FLAG | {"help": "print as JSON"},
    # The head to draw and the view of it
    "--subject": {
        "metavar": "ID", "help": "person to show (default: the first of the checkpoint)",
    },
    "--expression": {
        "metavar": "ID", "help": "expression to show (default: neutral, else the first)",
    },
    "--expression-of": {
        "metavar": "SUBJECT/EXPRESSION",
        "help": "show another person's expression, from training",
    },
    "--z-id-of": {
        "metavar": "SUBJECT", "help": "take the residual identity code alone from this person",
    },
    "--z-exp-of": {
        "metavar": "EXPRESSION", "help": "take the residual code alone from this expression",
    },
    "--control": REPEATED | {
        "metavar": "NAME=NUMBERS",
        "help": "change a parameter: jaw=0.3,0,0 (radians), neck.1=0.2, eyes=0,0.3,0,"
        " expression.NAME=1, shape.0=2, z_exp=0 (a factor on the code), z_id.0=1.5 (standard"
        " deviations along a principal direction); may be repeated",
    },
    "--camera": {"metavar": "ID", "help": "camera of the checkpoint (default: a frontal one)"},
    "--size": {
        "type": at_least(0, 8192), "default": 0, "metavar": "N",
        "help": "longer side, pixels (default: as trained)",
    },
    "--yaw": {
        "type": finite, "default": 0.0, "metavar": "DEG",
        "help": "move the camera around the head, degrees",
    },
    "--pitch": {"type": finite, "default": 0.0, "metavar": "DEG", "help": "move it up, degrees"},
    "--turntable": FLAG | {"help": "write turntable.mp4"},
    "--degrees": {
        "type": finite, "default": 360.0, "metavar": "DEG",
        "help": "angle that the turntable covers (default: 360)",
    },
    "--frames": {
        "type": at_least(1), "default": 72, "metavar": "N",
        "help": "number of frames of a video (default: %(default)s)",
    },
    "--to": {
        "metavar": "SUBJECT/EXPRESSION", "help": "write interpolation.mp4, which ends there",
    },
    "--drive": {
        "type": Path, "metavar": "SEQUENCE.NPZ",
        "help": "write driven.mp4: the head moves as in these tracked clips",
    },
    "--drive-cue": {"metavar": "ID", "help": "use only this clip of --drive"},
    "--views": FLAG | {"help": "write views.jpg: novel views"},
    "--controls": FLAG | {"help": "write controls.jpg: one control changed at a time"},
    "--samples": {
        "type": at_least(0), "default": 0, "metavar": "N",
        "help": "write samples.jpg with this many new heads",
    },
    "--spread": {
        "type": finite, "default": 1.0, "metavar": "FACTOR",
        "help": "spread of the samples (default: 1, as in training)",
    },
    "--seed": {
        "type": at_least(0), "default": 0, "metavar": "N", "help": "random seed (default: 0)",
    },
    "--columns": {
        "type": at_least(1), "default": 8, "metavar": "N",
        "help": "number of expressions in grid.jpg (default: %(default)s)",
    },
    "--format": {"choices": commands.FORMATS, "help": "format (default: by FILE's name)"},
    "--shards": {
        "type": Path, "metavar": "SHARDS", "help": "with .html: measure its loss on this footage",
    },
    "--still": {
        "type": at_least(16), "default": 512, "metavar": "N",
        "help": "height of still pictures, pixels (default: %(default)s)",
    },
    "--host": {
        "default": "127.0.0.1", "metavar": "ADDRESS",
        "help": "address to listen on (default: this machine alone)",
    },
    "--port": {
        "type": at_least(1, 65535), "default": 8080, "metavar": "N",
        "help": "port to listen on (default: %(default)s)",
    },
    # Studies
    "--reference": {
        "type": Path, "required": True, "metavar": "FOLDER", "help": "true pictures",
    },
    "--ours": {
        "type": Path, "required": True, "metavar": "FOLDER",
        "help": "one method's pictures, with the same names",
    },
    "--theirs": {
        "type": Path, "required": True, "metavar": "FOLDER", "help": "the other method's pictures",
    },
    "--names": {
        "nargs": 2, "default": ["Ours", "Theirs"], "metavar": "NAME",
        "help": "names of the two methods (default: Ours Theirs)",
    },
    "--examples": {
        "type": at_least(1), "default": 15, "metavar": "N",
        "help": "examples per participant (default: %(default)s)",
    },
    "--participants": {
        "type": at_least(1), "default": 20, "metavar": "N",
        "help": "number of participants (default: %(default)s)",
    },
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
        example="grmm train data/pack/shards run --preset demo --budget 4m\n"
        "the same command again continues from run/checkpoint.pt",
        changes={
            "out": {"help": "folder for checkpoint.pt, metrics.json, preview/"},
            "--preset": {"default": commands.AUTO},
        },
    ),
    "fit": GrmmCommand(
        handler=commands.fit,
        options="checkpoint shards out --subject --expression --cameras --budget --set "
        f"--overwrite {METRICS} --json",
        help="fit an unseen subject",
        example="grmm fit run/checkpoint.pt shards out --subject S004 --expression neutral \\\n"
        "      --cameras cam02,cam03 --budget 60s",
        changes={
            "out": {"help": "folder for checkpoint.pt, metrics.json, pictures"},
            "--subject": {"required": True, "help": "person to fit"},
            "--expression": {
                "default": "*",
                "metavar": "ID,...",
                "help": "fit to these, ids or patterns: neutral,smile (default: all)",
            },
            "--cameras": {"help": "fit to these, ids or patterns: cam02,cam05 (default: all)"},
            "--set": {
                "metavar": "fit.KEY=VALUE",
                "help": "change one setting of the fit; may be repeated",
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
        example="grmm render run/checkpoint.pt pictures --subject S002 --turntable --views \\\n"
        "      --expression-of S001/smile --control jaw.0=0.2",
        changes={"out": {"help": "folder for pictures and videos"}},
    ),
    "export": GrmmCommand(
        handler=commands.export,
        options=f"checkpoint out {EDIT} --format --shards --drive --drive-cue",
        help="write a head as a page that plays in a browser, a mesh, splats or arrays",
        example="grmm export run/checkpoint.pt head.glb --expression smile",
        changes={
            "out": {
                "metavar": "FILE",
                "help": "file to write: .html plays in a browser; .ply, .spz, and .glb with "
                "--format splats hold splats; .glb a textured mesh; .npz all arrays and codes",
            },
            "--drive": {"help": "with .html: tracked clips for it to play"},
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
                "help": "height while the picture moves, pixels (default: %(default)s)",
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
        example="grmm ablate express/pack/shards out --also renderme/pack/shards \\\n"
        "      --preset small --budget 2h --fit-cameras cam03 --fit-budget 60s",
        changes={
            "out": {"help": "folder for ablation.md, ablation.json and a folder per row"},
        },
    ),
}
STUDY_ACTIONS = {
    "make": GrmmCommand(
        handler=commands.study_make,
        options="out --reference --ours --theirs --names --examples --participants --seed",
        help="choose the examples, and which method is A and which is B in each",
        example="grmm study make study --reference truth --ours grmm --theirs md",
        changes={"out": {"help": "folder for study.json and pictures/"}},
    ),
    "serve": GrmmCommand(
        handler=commands.study_serve,
        options="out --host --port",
        help="show participants the page, and collect their answers",
        changes={"out": {"help": "folder of the study"}, "--port": {"default": 8000}},
    ),
    "table": GrmmCommand(
        handler=commands.study_table,
        options="out --json",
        help="print the paper's table, with confidence intervals",
        changes={"out": {"help": "folder of the study"}},
    ),
}


def build_parser() -> argparse.ArgumentParser:
    """Build the argument parser with all commands."""
    parser = Parser(prog="grmm", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"grmm {__version__}")
    group = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        _add(group, name, command)
    study = group.add_parser("study", help="let people judge which of two methods is better")
    actions = study.add_subparsers(required=True, metavar="ACTION")
    for name, command in STUDY_ACTIONS.items():
        _add(actions, name, command)
    return parser


def _add(group: argparse._SubParsersAction, name: str, command: GrmmCommand) -> None:
    parser = add_command(
        group, name, command.handler, command.help,
        dataset=False, json=False, example=command.example or None,
    )  # fmt: skip
    for option in command.options.split():
        entry = OPTIONS[option] | command.changes.get(option, {})
        parser.add_argument(option, *ALIASES.get(option, []), **entry)
