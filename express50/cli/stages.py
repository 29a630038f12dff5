"""Commands of the stages (one each, ``run`` for all) and of the dataset (status, info, config)."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from express50.cli.status import add_status_command
from express50.console import FAILED, OK, format_table, say, say_json, stdout_to_stderr
from express50.contract.config import PRESETS, config_toml, resolve_config
from express50.contract.layout import Dataset, existing_dataset
from express50.contract.stage import Stage
from express50.errors import ConfigError, StageError
from express50.runner.threads import cap_threads

if TYPE_CHECKING:
    from express50.runner.runner import Summary
    from express50.runner.slurm import SlurmJob

HELP = {
    "ingest": "index raw captures: frames, hashes, proxies",
    "calibrate": "take or solve the cameras",
    "observe": "watch the face through every cue window (align runs it first)",
    "align": "suggest, match to the reference and take the frame of each expression",
    "alpha": "separate the head from the background, each camera alone (matte runs it first)",
    "matte": "let the cameras of a moment agree on their mattes",
    "track": "fit the head model to the peak frames",
    "depth": "estimate surface and depth maps",
    "regions": "label skin, hair, eyes, mouth, neck and torso; cut the head off the torso",
    "pack": "write shards, splits and dataset card",
}


def stages() -> dict[str, str]:
    """Module of every stage, in order."""
    return import_module("pipelines.order").STAGES


def load_stage(name: str) -> Stage:
    """Import one stage."""
    return import_module(stages()[name]).STAGE


def with_first(names: Iterable[str]) -> list[str]:
    """Stages in order, and those that the commands of any of them run first."""
    first = import_module("pipelines.order").FIRST
    wanted = {other for name in names for other in (*first.get(name, ()), name)}
    return [name for name in stages() if name in wanted]


def add_stage_commands(subparsers: Any) -> None:
    """Add one command a stage, and ``run``."""
    for name in stages():
        parser = _stage_parser(subparsers, name, HELP.get(name, ""))
        parser.set_defaults(handler=run_one, stage=name)
    parser = _stage_parser(subparsers, "run", "run all stages in order")
    parser.add_argument("--first", metavar="STAGE", choices=list(stages()), help="start here")
    parser.add_argument("--last", metavar="STAGE", choices=list(stages()), help="end here")
    parser.set_defaults(handler=run_all)


def _stage_parser(subparsers: Any, name: str, words: str) -> argparse.ArgumentParser:
    parser = subparsers.add_parser(
        name, help=words, description=words,
        epilog=f"options of a stage: express50 config {'STAGE' if name == 'run' else name}",
    )  # fmt: skip
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder of the dataset")
    if name in ("ingest", "run"):
        parser.add_argument(
            "captures", nargs="*", type=Path, metavar="CAPTURE", help="folders of raw captures"
        )
    add_config_options(parser)
    parser.add_argument(
        "--workers", type=int, default=2, metavar="N", help="local processes; 0 runs in this one"
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="dask scheduler, tcp://host:port")
    parser.add_argument(
        "--slurm",
        metavar="JOBS",
        help="run in SLURM jobs: partition=P,time=4:00:00,memory=16G,cores=4,jobs=8 or jobs.toml",
    )
    parser.add_argument(
        "--print-job", action="store_true", help="print the script of a SLURM job, and run nothing"
    )
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="threads an item may use (default 1)"
    )
    if name != "run":
        parser.add_argument("--items", metavar="GLOB", help="only items that match, such as 'S00*'")
    parser.add_argument("--json", action="store_true", help="print the account as JSON")
    return parser


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that make up a configuration."""
    parser.add_argument("--preset", default="standard", metavar="P", help=", ".join(PRESETS))
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML, one table a stage")
    parser.add_argument(
        "--set", action="append", default=[], metavar="STAGE.KEY=VALUE", help="set one value"
    )


def config_of(stage: Stage, args: argparse.Namespace) -> Any:
    """Configuration of a stage by the command's options; other stages' values are left alone."""
    return resolve_config(stage, args.preset, args.config, args.set, stages())


def run_one(args: argparse.Namespace) -> int:
    """Run one stage, and what its command runs first."""
    names = with_first([args.stage])
    for text in args.set:
        if not text.startswith(tuple(f"{name}." for name in names)):
            raise ConfigError(
                f"--set {text!r}: this command runs {' and '.join(names)} only; "
                f"expected {args.stage}.key=value"
            )
    return _run(args, names, args.items)


def run_all(args: argparse.Namespace) -> int:
    """Run all stages in order; one that fails for some items goes on with the others."""
    names = list(stages())
    first = names.index(args.first) if args.first else 0
    last = names.index(args.last) if args.last else len(names) - 1
    if first > last:
        raise ConfigError(f"--first {args.first} comes after --last {args.last}; swap them")
    return _run(args, with_first(names[first : last + 1]), None)


def _run(args: argparse.Namespace, names: list[str], pattern: str | None) -> int:
    from express50.runner.executor import Pool
    from express50.runner.runner import run_stage

    if args.workers < 0 or args.threads < 1:
        raise ConfigError(
            f"--workers {args.workers} --threads {args.threads}: expected at least 0 and 1"
        )
    # Before NumPy comes in with a stage: its BLAS reads the cap when it is loaded.
    cap_threads(args.threads)
    dataset = Dataset(args.dataset)
    slurm = _slurm(args)
    if args.print_job and slurm:
        return _print_jobs(dataset, args, names, slurm)
    summaries = []
    with (
        stdout_to_stderr() if args.json else nullcontext(),
        Pool(args.workers, args.scheduler, args.threads, slurm) as pool,
    ):
        # Every configuration is checked before the first stage spends hours.
        loaded = [load_stage(name) for name in names]
        configs = [config_of(stage, args) for stage in loaded]
        for stage, config in zip(loaded, configs, strict=True):
            chosen = _choose(stage, dataset, args, pattern)
            summaries.append(run_stage(stage, dataset, config, chosen, pool=pool))
            if not args.json:
                say(*summaries[-1].lines())
            if stage.name == "ingest" and not args.json:
                say(*_ingested(dataset, summaries[-1]))
    if args.json:
        accounts = [summary.to_json() for summary in summaries]
        before = {"before": accounts[:-1]} if len(accounts) > 1 else {}
        say_json(accounts if args.command == "run" else accounts[-1] | before)
    return OK if all(summary.ok for summary in summaries) else FAILED


def _slurm(args: argparse.Namespace) -> dict[str, SlurmJob] | None:
    """What the SLURM jobs of every stage ask for, where stages run in such jobs."""
    if args.slurm is None:
        if args.print_job:
            raise ConfigError("--print-job: expected --slurm JOBS beside it")
        return None
    if args.scheduler is not None:
        raise ConfigError("--slurm and --scheduler: expected one of them")
    from express50.runner.slurm import check_slurm, read_slurm

    check_slurm(submit=not args.print_job)
    return read_slurm(args.slurm, stages())


def _print_jobs(
    dataset: Dataset, args: argparse.Namespace, names: list[str], slurm: dict[str, SlurmJob]
) -> int:
    """Print each script that jobs of these stages would have, once."""
    from express50.runner.slurm import job_script

    logs = Dataset(dataset.root.resolve()).slurm_dir
    for job in dict.fromkeys(slurm[name] for name in names):
        address = "tcp://ADDRESS-OF-THE-RUN"
        say(job_script(job, address, "express50-N", args.threads, logs).rstrip())
    return OK


def _ingested(dataset: Dataset, summary: Summary) -> Iterable[str]:
    """What was found in the captures that were read."""
    module = import_module(stages()["ingest"])
    return module.account(dataset, [o.item for o in summary.outcomes if o.status == "done"])


def _choose(
    stage: Stage, dataset: Dataset, args: argparse.Namespace, pattern: str | None
) -> list[str] | None:
    """Items to run; None for all."""
    from express50.runner.schedule import select_items

    if stage.name == "ingest" and args.captures:
        register = import_module(stages()["ingest"]).register
        subjects = register(dataset, args.captures)
        if args.command == "ingest" and pattern is None:
            return subjects
    elif not dataset.root.is_dir():
        raise StageError(
            f"{dataset.root}: no such dataset; run 'express50 ingest {dataset.root} CAPTURE'"
        )
    if pattern is None:
        return None
    # A stage that another's command runs first may have other items: those of the same subjects.
    asked = select_items(load_stage(args.stage), dataset, pattern)
    if stage.name == args.stage:
        return asked
    subjects = {item.split("/")[0] for item in asked}
    return [item for item in stage.items(dataset) if item.split("/")[0] in subjects]


def add_dataset_commands(subparsers: Any) -> None:
    """Add status, info and config."""
    add_status_command(subparsers, stages())
    parser = subparsers.add_parser("info", help="subjects, cameras, frames and expressions")
    parser.add_argument("dataset", type=Path, metavar="DATASET")
    parser.add_argument("--json", action="store_true", help="print as JSON")
    parser.set_defaults(handler=show_info)
    parser = subparsers.add_parser("config", help="print the configuration of stages as TOML")
    parser.add_argument("stage", nargs="*", metavar="STAGE", help="all by default")
    add_config_options(parser)
    parser.set_defaults(handler=show_config)


def show_info(args: argparse.Namespace) -> int:
    """Print what was ingested."""
    from express50.capture.index import read_index

    dataset = existing_dataset(args.dataset)
    indices = [read_index(dataset, subject) for subject in dataset.subjects()]
    header = ["subject", "cameras", "size", "frames", "expressions", "plates", "calibration"]
    rows = [[str(value) for value in _info(index).values()] for index in indices]
    if args.json:
        say_json([_info(index) for index in indices])
    else:
        say(*format_table(header, rows))
    return OK


def _info(index: Any) -> dict[str, Any]:
    sizes = sorted({f"{c.width}x{c.height}" for c in index.cameras.values()})
    return {
        "subject": index.subject,
        "cameras": len(index.cameras),
        "size": ",".join(sizes),
        "frames": index.frames,
        "expressions": len(index.cues),
        "plates": len(index.plates),
        "calibration": "given" if index.calibration else "board" if index.board else "none",
    }


def show_config(args: argparse.Namespace) -> int:
    """Print resolved configurations; the output can be given to --config."""
    say("\n".join(_config_tables(args.stage or stages(), args)).rstrip())
    return OK


def _config_tables(names: Iterable[str], args: argparse.Namespace) -> Iterable[str]:
    for name in names:
        if name not in stages():
            raise ConfigError(f"unknown stage {name!r}; expected one of {', '.join(stages())}")
        stage = load_stage(name)
        yield config_toml(name, config_of(stage, args))
