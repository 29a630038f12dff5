"""Run the stages (one command each, ``run`` for all), ``tune`` and ``config`` their settings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from express50.console import (
    FAILED,
    OK,
    USAGE,
    add_command,
    answer,
    log,
    number,
    say,
    say_json,
    stdout_to_stderr,
)
from express50.contract.config import PRESETS, config_toml, distinct_settings, resolve_config
from express50.contract.layout import Dataset, check_folder, check_results_folder
from express50.contract.stage import Stage, stages, with_required
from express50.errors import ConfigError, advised, check_known

if TYPE_CHECKING:
    from express50.runner.executor import Pool


def add_commands(subparsers: Any) -> None:
    """Add ``run``, one command per stage, ``config`` and ``tune``."""
    names = list(stages())
    words = f"run all stages in order, from {names[0]} to {names[-1]}"
    parser = add_command(
        subparsers, "run", run_chain, words,
        description="Run all stages in order, and skip items that are up to date. With --budget "
        "or --error, first measure a few expressions, then choose the settings of every stage.",
        example="express50 run DATASET CAPTURE... --budget 2h\n"
        "settings of a stage: express50 config STAGE",
    )  # fmt: skip
    _add_run_options(parser, captures=True)
    for option, name in (("first", names[0]), ("last", names[-1])):
        words = f"{option} stage to run (default: {name})"
        parser.add_argument(f"--{option}", metavar="STAGE", choices=names, help=words)
    without = "not with --preset, --first, --last or --print-job"
    words = "choose the settings that fit this time: 45m, 2h, 1h30m, or 40ch (core hours); "
    words += without
    parser.add_argument("--budget", metavar="TIME", help=words)
    words = "choose the quickest settings that reach this expected error, such as 0.5mm; "
    words += without
    parser.add_argument("--error", metavar="ERROR", help=words)
    for stage in stages().values():
        parser = add_command(
            subparsers, stage.name, run_one, stage.help,
            epilog=f"settings of the stage: express50 config {stage.name}",
        )  # fmt: skip
        _add_run_options(parser, captures=stage.prepare is not None)
        words = "only items that match, such as 'S00*' (default: all)"
        parser.add_argument("--items", metavar="GLOB", help=words)
        parser.set_defaults(stage=stage.name)
    words = "print the settings of stages as TOML"
    parser = add_command(subparsers, "config", show_config, words, dataset=False, json=False)
    parser.add_argument("stage", nargs="*", metavar="STAGE", help="stages to print (default: all)")
    add_config_options(parser)
    words = "measure the error of the whole chain against its time on this dataset"
    parser = add_command(
        subparsers, "tune", run_tune, words,
        description="Try every setting of every stage on a few expressions of one subject, print "
        "the choices that no other choice beats in both time and error, and write them to "
        "DATASET/dial/front.csv. Later, 'run --budget' and 'plan' use the measurements.",
        example="express50 tune DATASET && express50 report DATASET",
    )  # fmt: skip
    _add_run_options(parser, captures=True, preset=False)


def _add_run_options(parser: argparse.ArgumentParser, captures: bool, preset: bool = True) -> None:
    """Add the options that say on what, where and with which settings stages run.

    Without ``preset``, the command chooses the settings itself, so options that need them are
    left out.
    """
    add = parser.add_argument
    if captures:
        words = "captures to add to the dataset: folders or videos"
        add("captures", nargs="*", default=[], type=Path, metavar="CAPTURE", help=words)
        words = "let CAPTURE replace the capture that its subject already has"
        add("--replace", action="store_true", help=words)
    add_config_options(parser, preset)
    words = "local worker processes (default: 2); 0: work in this process"
    add("--workers", type=number(0), default=2, metavar="N", help=words)
    add("--scheduler", metavar="ADDRESS", help="run on this dask scheduler: tcp://host:port")
    words = "run in SLURM jobs: partition=P,time=4:00:00,memory=16G,cores=4,jobs=8, or a TOML file"
    add("--slurm", type=str, metavar="JOBS", help=words)  # a type: ~ in its value is refused
    parser.set_defaults(print_job=False)
    if preset:
        words = "with --slurm: print the script of a job, and run nothing"
        add("--print-job", action="store_true", help=words)
        words = "exit with code 1 also if part of an item, such as a camera, was dropped"
        add("--strict", action="store_true", help=words)
    words = "threads that each worker may use for its item (default: 1)"
    add("--threads", type=number(1), default=1, metavar="N", help=words)


def add_config_options(parser: argparse.ArgumentParser, preset: bool = True) -> None:
    """Add the options that make up a configuration."""
    add = parser.add_argument
    parser.set_defaults(preset=None)
    if preset:
        add("--preset", metavar="PRESET", help=f"{', '.join(PRESETS)} (default: standard)")
    add("--config", type=Path, metavar="FILE", help="TOML file of settings, one table per stage")
    words = "change one setting, such as depth.voxel_mm=1.5; may be repeated"
    add("--set", action="append", default=[], metavar="STAGE.KEY=VALUE", help=words)


def config_of(stage: Stage, args: argparse.Namespace) -> Any:
    """Build the configuration of a stage from the command's options."""
    return resolve_config(stage, args.preset or "standard", args.config, args.set, stages())


def run_one(args: argparse.Namespace) -> int:
    """Run one stage, after the stages that its command runs first."""
    chosen = with_required([args.stage])
    for text in args.set:
        if not text.startswith(tuple(f"{stage.name}." for stage in chosen)):
            raise ConfigError(
                f"--set {text!r}: this command only runs {' and '.join(s.name for s in chosen)}; "
                f"expected {args.stage}.key=value"
            )
    return _run(args, chosen, args.items)


def _run_all(args: argparse.Namespace) -> int:
    """Run all stages in order; a stage that fails for some items continues with the others."""
    names = list(stages())
    first = names.index(args.first) if args.first else 0
    last = names.index(args.last) if args.last else len(names) - 1
    if first > last:
        raise ConfigError(f"--first {args.first} comes after --last {args.last}; swap them")
    chosen = with_required(names[first : last + 1])
    if args.captures and all(stage.prepare is None for stage in chosen):
        raise ConfigError(
            f"--first {args.first}: the stages from there on read no captures, but"
            f" {args.captures[0]} was given; omit --first, or the captures"
        )
    return _run(args, chosen, None)


def _run(args: argparse.Namespace, chosen: Sequence[Stage], pattern: str | None) -> int:
    from express50.runner.executor import Pool
    from express50.runner.runner import Summary, run_stage
    from express50.runner.worker import cap_threads

    # Set before a stage imports NumPy, whose BLAS reads the thread limit when it is loaded.
    cap_threads(args.threads)
    dataset = Dataset(args.dataset)
    _check_places(dataset, args)
    slurm = _slurm_jobs(args)
    if slurm is not None and args.print_job:
        from express50.runner.slurm import job_script

        logs = Dataset(dataset.root.resolve()).slurm_dir
        for job in dict.fromkeys(slurm[stage.name] for stage in chosen):
            address, name = "tcp://ADDRESS-OF-THE-RUN", "express50-N"
            say(job_script(job, address, name, args.threads, logs).rstrip())
        return OK
    summaries: list[Summary] = []
    with (
        stdout_to_stderr() if args.json else nullcontext(),
        Pool(args.workers, args.scheduler, args.threads, slurm) as pool,
    ):
        # Everything is checked before the first stage spends hours.
        work = [(stage, config_of(stage, args)) for stage in chosen]
        if not _is_ready(dataset, work, pool, all_items=pattern is None):
            return USAGE
        for stage, config in work:
            items = _items(stage, dataset, args, pattern)
            failed = [summary.stage for summary in summaries if not summary.ok]
            if failed and not (stage.items(dataset) if items is None else items):
                why = f"because {failed[-1]} failed (see above)"
                log(f"express50: {stage.name} has nothing to do, {why}")
                break
            summaries.append(run_stage(stage, dataset, config, items, pool=pool))
            if not args.json:
                _say_account(stage, dataset, summaries[-1])
    if args.json:
        accounts = [summary.to_json() for summary in summaries]
        before = {"before": accounts[:-1]} if len(accounts) > 1 else {}
        say_json(accounts if args.command == "run" else accounts[-1] | before)
    return _exit_code(summaries, args.strict)


def _is_ready(
    dataset: Dataset, work: Sequence[tuple[Stage, Any]], pool: Pool, all_items: bool = True
) -> bool:
    """Say what would stop stages with these configurations; return whether nothing would."""
    from express50.runner.preflight import problems

    found = dict.fromkeys(problems(dataset, work, pool, all_items))  # settings share some
    for line in found:
        log(f"express50: {line}")
    return not found


def run_chain(args: argparse.Namespace) -> int:
    """Run all stages, with settings chosen for the budget or the goal if one is given."""
    if args.budget is None and args.error is None:
        return _run_all(args)
    from express50.dial.budget import parse_budget, parse_goal
    from express50.dial.run import closing_lines, run_within

    if args.first or args.last:
        raise ConfigError("--budget and --error run all stages; omit --first and --last")
    budget = None if args.budget is None else parse_budget(args.budget)
    goal = None if args.error is None else parse_goal(args.error)

    def ended(stage: Stage, summary: Any) -> None:
        if not args.json:
            _say_account(stage, chain.dataset, summary)

    with _chain(args) as chain:
        if chain is None:
            return USAGE
        summaries, state = run_within(chain, budget, goal, ended)
    if args.json:
        say_json({"run": vars(state), "stages": [summary.to_json() for summary in summaries]})
    else:
        say(*closing_lines(state, summaries))
    return _exit_code(summaries, args.strict) if state.finished else FAILED


def run_tune(args: argparse.Namespace) -> int:
    """Measure every setting of every stage on a few items, and write the Pareto front."""
    from express50.dial.measuring import tune

    with _chain(args) as chain:
        if chain is None:
            return USAGE
        table, lines = tune(chain)
    return answer(args, table, *lines)


@contextmanager
def _chain(args: argparse.Namespace) -> Iterator[Any]:
    """Open a dataset's chain with all settings of its stages; yield None if it cannot run."""
    from express50.dial.pilot import Chain
    from express50.runner.executor import Pool
    from express50.runner.publish import stage_lock
    from express50.runner.worker import cap_threads

    if args.preset is not None:
        raise ConfigError(
            "--preset: --budget and --error choose the settings; leave it out, or use --set"
        )
    if args.print_job:
        raise ConfigError(
            "--print-job: the settings are not chosen yet; give --preset instead of --budget"
        )
    cap_threads(args.threads)
    known, dataset = list(stages().values()), Dataset(args.dataset.resolve())
    _check_places(dataset, args)
    ladders = {
        stage.name: distinct_settings(stage, args.config, args.set, stages()) for stage in known
    }
    slurm = _slurm_jobs(args)
    with (
        stdout_to_stderr() if args.json else nullcontext(),
        Pool(args.workers, args.scheduler, args.threads, slurm) as pool,
    ):
        work = [(stage, config) for stage in known for config in ladders[stage.name].values()]
        if not _is_ready(dataset, work, pool):
            yield None
            return
        if not args.captures:
            check_folder(dataset)
        for stage in known:
            if stage.prepare is not None and args.captures:
                stage.prepare(dataset, args.captures, args.replace)
        with stage_lock(dataset, "run"):  # two would delete each other's trials
            yield Chain(known, dataset, ladders, pool, log if args.json else say)


def _exit_code(summaries: Sequence[Any], strict: bool) -> int:
    """Return whether no item failed or, with ``strict``, lost a part."""
    dropped = strict and any(o.dropped for summary in summaries for o in summary.outcomes)
    return OK if all(summary.ok for summary in summaries) and not dropped else FAILED


def _check_places(dataset: Dataset, args: argparse.Namespace) -> None:
    """Raise ConfigError if dataset and captures are swapped, or a new dataset lies in either."""
    from express50.capture.readers.read import is_capture

    captures: Sequence[Path] = getattr(args, "captures", ())
    command, root, new = args.command, dataset.root, not dataset.ledger.exists()
    if root.is_dir() and new and is_capture(root):
        raise ConfigError(
            f"the first argument is the dataset, and {root} is a capture; expected "
            + advised(f"express50 {command} DATASET", *[root] * (command in ("ingest", "run")))
        )
    if new:
        check_results_folder(root)
    if not captures and getattr(args, "replace", False):
        raise ConfigError("--replace needs the CAPTURE that replaces another; give it")
    for path in captures:
        if Dataset(path).ledger.exists():
            raise ConfigError(
                f"captures come after the dataset, and {path} is a dataset; expected "
                f"'express50 {command} DATASET CAPTURE'"
            )
        if new and path.resolve() in root.resolve().parents:
            raise ConfigError(
                f"{root}: lies inside the capture {path}, which would change with every run; name"
                " a dataset outside of it"
            )


def _say_account(stage: Stage, dataset: Dataset, summary: Any) -> None:
    say(*summary.lines())
    if stage.account is not None:
        done = [o.item for o in summary.outcomes if o.status == "done"]
        say(*stage.account(dataset, done))


def _slurm_jobs(args: argparse.Namespace) -> Mapping[str, Any] | None:
    """Return the resources that SLURM jobs ask for, per stage; None if stages run elsewhere."""
    if args.slurm is None:
        if args.print_job:
            raise ConfigError("--print-job needs --slurm JOBS")
        return None
    if args.scheduler is not None:
        raise ConfigError("--slurm and --scheduler: give only one of them")
    from express50.runner.slurm import check_slurm, read_slurm

    check_slurm(submit=not args.print_job)
    return read_slurm(args.slurm, stages())


def _items(
    stage: Stage, dataset: Dataset, args: argparse.Namespace, pattern: str | None
) -> list[str] | None:
    """Choose the items to run; None for all."""
    from express50.runner.runner import select_items

    if stage.prepare is not None and args.captures:
        prepared = stage.prepare(dataset, args.captures, args.replace)
        if args.command != "run" and pattern is None:
            return prepared
    else:
        check_folder(dataset)
        if stage.prepare is not None and not stage.items(dataset):
            call = advised(f"express50 {args.command}", dataset.root, "CAPTURE")
            raise ConfigError(f"{dataset.root}: has no captures yet; run {call}")
    if pattern is None:
        return None
    # A stage that runs first in another's command may have other items; take the same subjects',
    # or all if an item is not a subject's.
    asked = select_items(stages()[args.stage], dataset, pattern)
    if stage.name == args.stage:
        return asked
    subjects = {item.split("/")[0] for item in asked}
    if not subjects <= {*dataset.subjects()}:
        return None
    return [item for item in stage.items(dataset) if item.split("/")[0] in subjects]


def show_config(args: argparse.Namespace) -> int:
    """Print resolved configurations; the output can be given to --config."""
    names = args.stage or list(stages())
    check_known("express50 config", "stage", names, stages())
    tables = [config_toml(name, config_of(stages()[name], args)) for name in names]
    say("\n".join(tables).rstrip())
    return OK
