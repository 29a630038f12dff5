"""``express50 run --budget`` and ``--error``, and ``tune``, which measures error against time."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from express50.cli.stages import (
    add_run_options,
    exit_code,
    refuse_swapped,
    run_all,
    say_account,
    slurm_jobs,
)
from express50.console import (
    FAILED,
    USAGE,
    add_command,
    answer,
    log,
    say,
    say_json,
    stdout_to_stderr,
)
from express50.contract.config import distinct_settings, resolve_config
from express50.contract.layout import Dataset, check_folder
from express50.contract.stage import Stage, stages
from express50.errors import ConfigError


def add_commands(subparsers: Any) -> None:
    """Add ``tune``, and ``--budget`` and ``--error`` to ``run``."""
    run = subparsers.choices["run"]
    words = "choose the settings that fit this time: 45m, 2h, 1h30m, or 40ch (core hours); "
    words += "not with --preset or --print-job"
    run.add_argument("--budget", metavar="TIME", help=words)
    words = "choose the quickest settings that reach this expected error, such as 0.5mm; "
    words += "not with --preset or --print-job"
    run.add_argument("--error", metavar="ERROR", help=words)
    run.set_defaults(handler=run_chain)
    words = "measure the error of the whole chain against its time on this dataset"
    parser = add_command(
        subparsers, "tune", run_tune, words,
        description="Try every setting of every stage on a few expressions of one subject, print "
        "the choices that no other choice beats in both time and error, and write them to "
        "DATASET/dial/front.csv. Later, 'run --budget' and 'plan' use the measurements.",
        example="express50 tune DATASET && express50 report DATASET",
    )  # fmt: skip
    add_run_options(parser, captures=True, preset=False)


def run_chain(args: argparse.Namespace) -> int:
    """Run all stages, with settings chosen for the budget or the goal if one is given."""
    if args.budget is None and args.error is None:
        return run_all(args)
    from express50.dial.budget import parse_budget, parse_goal
    from express50.dial.run import closing_lines, run_within

    if args.first or args.last:
        raise ConfigError("--budget and --error run all stages; omit --first and --last")
    budget = None if args.budget is None else parse_budget(args.budget)
    goal = None if args.error is None else parse_goal(args.error)

    def ended(stage: Stage, summary: Any) -> None:
        if not args.json:
            say_account(stage, chain.dataset, summary)

    with _chain(args) as chain:
        if chain is None:
            return USAGE
        summaries, state = run_within(chain, budget, goal, ended)
    if args.json:
        say_json({"run": vars(state), "stages": [summary.to_json() for summary in summaries]})
    else:
        say(*closing_lines(state, summaries))
    return exit_code(summaries, args.strict) if state.finished else FAILED


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
    from express50.runner.preflight import problems
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
    refuse_swapped(dataset, args.captures, args.command)
    ladders = {
        stage.name: distinct_settings(
            stage, lambda s, preset: resolve_config(s, preset, args.config, args.set, stages())
        )
        for stage in known
    }
    slurm = slurm_jobs(args)
    with (
        stdout_to_stderr() if args.json else nullcontext(),
        Pool(args.workers, args.scheduler, args.threads, slurm) as pool,
    ):
        work = [(stage, config) for stage in known for config in ladders[stage.name].values()]
        if found := list(problems(dataset, work, pool)):
            for line in found:
                log(f"express50: {line}")
            yield None
            return
        if not args.captures:
            check_folder(dataset)
        for stage in known:
            if stage.prepare is not None and args.captures:
                stage.prepare(dataset, args.captures, args.replace)
        yield Chain(known, dataset, ladders, pool, log if args.json else say)
