"""``grmm`` trains, fits, renders, exports, views, evaluates, scores, ablates and studies.

This file defines what a user may type: each option once in OPTIONS, and each command as a list
of options. `grmm.cli.commands` implements the commands.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from express50 import __version__
from express50.console import Parser, add_command, number, run_handler
from express50.dial.budget import parse_budget
from express50.errors import ConfigError
from grmm.cli import commands
from grmm.config import PRESETS, TABLES

DESCRIPTION = "Train the Gaussian Residual Morphable Model on packed shards, and use it."
EPILOG = """example:
  grmm train DATASET/pack/shards OUT --budget 10m
exit codes: 0 all done; 1 failed; 2 wrong usage or settings"""
MOST_PX = 8192  # of a picture's side
ANGLE = number(-36000, 36000, float)  # degrees: a hundred turns


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the ``grmm`` command; returns the exit code (0 ok, 1 failed, 2 usage)."""
    args = build_parser().parse_args(arguments)
    return run_handler("grmm", args.handler, args)


def parse_seconds(text: str) -> float:
    """Parse a time as `parse_budget` does, or a number of seconds; ArgumentTypeError otherwise."""
    with contextlib.suppress(ConfigError):
        budget = parse_budget(f"{text}s" if text[-1:].isdigit() else text)
        if not budget.cores:
            return budget.seconds
    raise argparse.ArgumentTypeError(
        f"{text!r} is not a time; expected a number of seconds above 0, or 60s, 5m, 1h30m"
    )


def value(metavar: str, words: str, **settings: Any) -> dict[str, Any]:
    """Describe an argument with a value: its name in the help, and what it is."""
    return {"metavar": metavar, "help": words} | settings


def flag(words: str) -> dict[str, Any]:
    """Describe an argument that is either given or not."""
    return {"action": "store_true", "help": words}


REPEATED: dict[str, Any] = {"action": "append", "default": []}
OPTIONS: dict[str, dict[str, Any]] = {
    # Positional
    "checkpoint": value("CHECKPOINT", "checkpoint.pt of 'grmm train' or 'grmm fit'", type=Path),
    "renders": value(
        "PICTURES", "folder of SUBJECT_EXPRESSION_CAMERA.png, in the samples' size", type=Path
    ),
    "shards": value("SHARDS", "folder of shards (DATASET/pack/shards)", type=Path),
    "out": value("OUT", "folder for evaluation.csv and evaluation.json", type=Path),
    "table": value("TABLE", f"{', '.join(TABLES)} (default: all)", nargs="*"),
    # Training
    "--preset": value(
        "PRESET",
        f"{', '.join(PRESETS)}, or {commands.AUTO}, which chooses one for the machine and"
        " the --budget (default: %(default)s)",
        default="paper",
    ),
    "--config": value("FILE", "TOML file of settings, one table per part", type=Path),
    "--set": value(
        "TABLE.KEY=VALUE", "change one setting, such as train.lr=1e-3; may be repeated", **REPEATED
    ),
    "--also": value(
        "SHARDS", "also train on this folder of shards; may be repeated", type=Path, **REPEATED
    ),
    "--budget": value(
        "TIME",
        "stop after this time: 60s, 4m, 2h; training also ends after train.iterations steps"
        " (default: these steps alone)",
        type=parse_seconds,
        dest="seconds",
    ),
    "--holdout-cameras": value(
        "ID,...",
        "cameras to hold out for testing, ids or patterns: cam02,cam05 (default: none)",
        default="",
    ),
    "--holdout-expressions": value(
        "SUBJECT/EXPRESSION,...",
        "expressions to hold out for testing, ids or patterns: S002/smile (default: none)",
        default="",
    ),
    "--paper-diff": flag("print the differences from the paper instead"),
    "--overwrite": flag("start over even if OUT has a checkpoint"),
    # Measuring
    "--alexnet": value(
        "FILE", "torchvision's alexnet state dict, for LPIPS (default: LPIPS is n/a)", default=""
    ),
    "--inception": value(
        "FILE", "Inception as TorchScript, for FID (default: FID is n/a)", default=""
    ),
    "--subjects": value(
        "ID,...", "only these, ids or patterns: S001,S002 (default: all)", default="*"
    ),
    "--expressions": value(
        "ID,...", "only these, ids or patterns: smile,jaw* (default: all)", default="*"
    ),
    "--cameras": value(
        "ID,...", "only these, ids or patterns: cam02,cam05 (default: all)", default="*"
    ),
    "--images": value(
        "N",
        "measure at most this many images, evenly spread; for fitted people, the limit is per"
        " person and kind of view (default: all)",
        type=number(0),
        default=0,
    ),
    "--heldout": flag("leave out samples that training saw"),
    "--save": value("FOLDER", "also write the pictures, as 'grmm score' reads them", type=Path),
    "--fit-subjects": value(
        "ID,...", "people to fit (default: everyone that training did not see)", default=""
    ),
    "--fit-cameras": value(
        "ID,...",
        "fit people that training did not see from these cameras (default: fit nobody)",
        default="",
    ),
    "--fit-expression": value(
        "ID", "with --fit-cameras: fit from this expression (default: neutral)"
    ),
    "--fit-budget": value(
        "TIME",
        "with --fit-cameras: time per fit, 60s, 5m (default: all steps of the fit)",
        type=parse_seconds,
    ),
    "--background": value(
        "GREY",
        "grey behind the pictures, 0 to 1 (default: 0)",
        type=number(0, 1, float),
        default=0.0,
    ),
    "--partial": flag("score only the pictures that exist"),
    "--seeds": value("N", "train each row this many times (default: 1)", type=number(1), default=1),
    "--test": value(
        "SHARDS",
        "shards whose people are fitted, not trained on; may be repeated",
        type=Path,
        **REPEATED,
    ),
    "--rows": value(
        "ROW,...", "rows of the table, such as full,no_residuals (default: all)", default=""
    ),
    "--json": flag("print as JSON"),
    # The head to draw and the view of it
    "--subject": value("ID", "person to show (default: the first of the checkpoint)"),
    "--expression": value("ID", "expression to show (default: neutral, else the first)"),
    "--expression-of": value(
        "SUBJECT/EXPRESSION", "show another person's expression, from training"
    ),
    "--z-id-of": value("SUBJECT", "take only the residual identity code from this person"),
    "--z-exp-of": value("EXPRESSION", "take only the residual code from this expression"),
    "--control": value(
        "NAME=NUMBERS",
        "change a parameter: jaw=0.3,0,0 (radians), neck.1=0.2, eyes=0,0.3,0,"
        " expression.NAME=1, shape.0=2, z_exp=0 (a factor on the code), z_id.0=1.5 (standard"
        " deviations along a principal direction); may be repeated",
        **REPEATED,
    ),
    "--camera": value("ID", "camera of the checkpoint to draw from (default: a frontal one)"),
    "--size": value(
        "N", "longer side, pixels (default: as trained)", type=number(0, MOST_PX), default=0
    ),
    "--yaw": value(
        "DEG", "move the camera around the head, degrees (default: 0)", type=ANGLE, default=0.0
    ),
    "--pitch": value("DEG", "move the camera up, degrees (default: 0)", type=ANGLE, default=0.0),
    "--turntable": flag("write turntable.mp4"),
    "--degrees": value(
        "DEG", "with --turntable: angle to cover, degrees (default: 360)", type=ANGLE
    ),
    "--frames": value(
        "N",
        f"with --turntable or --to: frames of the video (default: {commands.VIDEO_FRAMES})",
        type=number(1),
    ),
    "--to": value("SUBJECT/EXPRESSION", "write interpolation.mp4, which ends at this expression"),
    "--drive": value(
        "SEQUENCE.NPZ", "write driven.mp4: the head moves as in these tracked clips", type=Path
    ),
    "--drive-cue": value("ID", "with --drive: use only this clip (default: all)"),
    "--views": flag("write views.jpg: novel views"),
    "--controls": flag("write controls.jpg: one control changed at a time"),
    "--samples": value(
        "N", "write samples.jpg with this many new heads (default: 0)", type=number(0), default=0
    ),
    "--spread": value(
        "FACTOR",
        "with --samples: their spread (default: 1, as in training)",
        type=number(0, 100, float),
    ),
    "--seed": value("N", "random seed (default: 0)", type=number(0)),
    "--columns": value(
        "N", "number of expressions in grid.jpg (default: %(default)s)", type=number(1), default=8
    ),
    "--format": {"choices": commands.FORMATS, "help": "format (default: by FILE's name)"},
    "--shards": value("SHARDS", "with .html: measure its loss on this footage", type=Path),
    "--still": value(
        "N",
        "height of still pictures, pixels (default: %(default)s)",
        type=number(16, MOST_PX),
        default=512,
    ),
    "--host": value(
        "ADDRESS", "address to listen on (default: this machine only)", default="127.0.0.1"
    ),
    "--port": value(
        "N", "port to listen on (default: %(default)s)", type=number(1, 65535), default=8080
    ),
    # Studies
    "--reference": value("FOLDER", "pictures of the footage", type=Path, required=True),
    "--ours": value(
        "FOLDER", "one method's pictures, with the same names", type=Path, required=True
    ),
    "--theirs": value("FOLDER", "the other method's pictures", type=Path, required=True),
    "--names": value(
        "NAME",
        "names of the two methods (default: Ours Theirs)",
        nargs=2,
        default=["Ours", "Theirs"],
    ),
    "--examples": value(
        "N", "examples per participant (default: %(default)s)", type=number(1), default=15
    ),
    "--participants": value(
        "N", "number of participants (default: %(default)s)", type=number(1), default=20
    ),
}
ALIASES = {"--budget": ["--seconds"]}

METRICS = "--alexnet --inception"
SETTINGS = f"--preset --config --set --budget --holdout-cameras --holdout-expressions {METRICS}"
CHOICE = "--subjects --expressions --cameras --images"
PROTOCOL = "--fit-cameras --fit-expression --fit-budget"
EDIT = "--subject --expression --expression-of --z-id-of --z-exp-of --control --camera"


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
        options=f"shards out --also {SETTINGS} --overwrite --json",
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
        "      --cameras cam02,cam03 --budget 60s\n"
        "the same command again continues a fit that was stopped",
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
            "--budget": {
                "help": "stop after this time: 60s, 4m, 2h (default: after all steps of the fit)"
            },
            "--overwrite": {"help": "start over even if OUT has a fit"},
        },
    ),
    "config": GrmmCommand(
        handler=commands.config,
        options=f"table {SETTINGS} --paper-diff",
        help="print every setting with its meaning, in the form that --config reads",
        example="grmm config train fit --preset demo",
    ),
    "render": GrmmCommand(
        handler=commands.render,
        options=f"checkpoint out {EDIT} --size --yaw --pitch --turntable --degrees --frames --to "
        "--drive --drive-cue --views --controls --samples --spread --seed --columns",
        help="draw a head, optionally edited, as pictures, sheets or videos",
        example="grmm render run/checkpoint.pt pictures --subject S002 --turntable --views \\\n"
        "      --expression-of S001/smile --control jaw.0=0.2",
        changes={
            "out": {"help": "folder for pictures and videos"},
            "--seed": {"help": "with --samples: random seed (default: 0)"},
        },
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
                "--format splats hold splats; .glb a textured mesh, with --format arkit one with "
                "ARKit's blend shapes; .npz all arrays and codes",
            },
            "--camera": {
                "help": "camera whose colours to write, not with .html (default: a frontal one)"
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
                "type": number(16, MOST_PX),
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
        changes={"--images": {"help": "measure at most this many images, evenly spread"}},
    ),
    "ablate": GrmmCommand(
        handler=commands.ablate,
        options=f"shards out --also {SETTINGS} --rows --seeds --test --fit-subjects --images"
        f" {PROTOCOL} --json",
        help="train and measure the paper's ablations under one budget",
        example="grmm ablate express/pack/shards out --also renderme/pack/shards \\\n"
        "      --preset small --budget 2h --fit-cameras cam03 --fit-budget 60s",
        changes={"out": {"help": "folder for ablation.md, ablation.json and a folder per row"}},
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
