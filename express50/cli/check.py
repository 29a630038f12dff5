"""``express50 check`` audits a dataset, ``prune`` frees space, ``subject`` withdraws a person."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from express50.console import FAILED, OK, add_command, answer, count, log, stdout_to_stderr
from express50.contract.layout import Dataset, check_folder, existing_dataset
from express50.contract.stage import hook, stages


def add_commands(subparsers: Any) -> None:
    """Add ``check``, ``prune`` and ``subject withdraw``."""
    words = "compare a dataset with its ledger, and repair it"
    check = add_command(
        subparsers, "check", run_check, words,
        description="Compare every output with what was published (presence and size; SHA-256 if "
        "the modification time differs; --deep reads every byte) and with the present "
        "inputs and settings. Look for unfinished and unknown outputs, labels of frames "
        "that do not exist, missing captures, and traces of withdrawn people. "
        "Exit code 0 if no problem is left, 1 otherwise.",
        example="express50 check DATASET --fix && express50 run DATASET",
    )  # fmt: skip
    check.add_argument("--deep", action="store_true", help="read every byte of every output")
    words = "set wrong outputs aside, so that the next run makes them again; delete leftovers"
    check.add_argument("--fix", action="store_true", help=words)
    words = "delete outputs that were replaced or set aside, and trials of budgets"
    add_command(
        subparsers, "prune", run_prune, words,
        description="Delete outputs that were replaced, or set aside because they were wrong, and "
        "what `run --budget` made to measure settings. The present outputs stay. As long as the "
        "disk has 2 GB left, stages keep the last two replaced outputs of each item, so that going "
        "back to old settings or inputs takes no work.",
    )  # fmt: skip
    subject = subparsers.add_parser("subject", help="withdraw a person from a dataset")
    actions = subject.add_subparsers(dest="action", metavar="ACTION", required=True)
    words = "remove everything that the dataset holds about a subject"
    withdraw = add_command(
        actions, "withdraw", run_withdraw, words,
        description="Remove a subject's index, derived files, labels and receipts, the packed "
        "shards, and everything else that names the person. Take codes and frames out "
        "of checkpoints, note the time in withdrawn.json, then search the rest for the "
        "subject's id. Without --yes, only list what would be removed. "
        "'express50 check' proves the removal at any later time.",
        example="express50 subject withdraw DATASET S001 --yes",
    )  # fmt: skip
    withdraw.add_argument("subject", metavar="SUBJECT", help="id of the subject to remove")
    withdraw.add_argument("--yes", action="store_true", help="remove; without it, only list")
    words = "a model outside the dataset that may name withdrawn people; may be repeated"
    for add in (check.add_argument, withdraw.add_argument):
        add("--checkpoint", type=Path, action="append", default=[], metavar="FILE", help=words)


def run_check(args: argparse.Namespace) -> int:
    """Print findings, notes and the amount of data checked."""
    from express50.dataset.audit import audit

    started = time.perf_counter()
    if args.deep:
        log(f"{args.dataset}: reading every file")
    if not (args.dataset / "ingest").exists():  # if it exists, a missing ledger is a finding
        existing_dataset(args.dataset)
    for path in args.checkpoint:
        hook("read_checkpoint")(path)
    with stdout_to_stderr():
        result = audit(
            Dataset(args.dataset), list(stages().values()), deep=args.deep, fix=args.fix,
            label_problems=hook("label_problems"), checkpoints=args.checkpoint,
        )  # fmt: skip
    seconds = time.perf_counter() - started
    data = {
        "sound": result.sound,
        "findings": [vars(finding) for finding in result.findings],
        "notes": result.notes,
        "files": result.files,
        "bytes": result.bytes,
        "bytes_read": result.hashed,
        "seconds": round(seconds, 3),
    }
    lines = [
        f"{one.where}: {one.what}; {'FIXED' if one.fixed else 'fix'}: {one.fix}"
        for one in result.findings
    ]
    lines += [f"note: {note}" for note in result.notes]
    found, fixed = len(result.findings), sum(one.fixed for one in result.findings)
    verdict = f"{count(found, 'finding')}, {fixed} fixed, {found - fixed} left"
    verdict = verdict if found else "sound"
    looked = f"{count(result.files, 'file')}, {result.bytes / 1e6:.1f} MB"
    read = f"{result.hashed / 1e6:.1f} MB read"
    answer(args, data, *lines, f"{args.dataset}: {verdict} ({looked}, {read}, {seconds:.1f} s)")
    return OK if result.sound else FAILED


def run_prune(args: argparse.Namespace) -> int:
    """Delete replaced and stale outputs and trials, and say what that freed."""
    from express50.runner.publish import empty, is_running

    dataset = existing_dataset(args.dataset)
    folders = [dataset.replaced_dir, dataset.stale_dir, dataset.pilot_dir]
    trials = map(Dataset, dataset.pilot_dir.glob("*"))
    if any(is_running(trial, name) for trial in trials for name in stages()):
        log("a trial is running, so trials are kept")
        folders.remove(dataset.pilot_dir)
    freed = map(empty, folders)
    files, size = map(sum, zip(*freed, strict=True))
    line = f"{args.dataset}: freed {decimal(size)} in {count(files, 'file')}"
    return answer(args, {"files": files, "bytes": size}, line)


def run_withdraw(args: argparse.Namespace) -> int:
    """Withdraw a subject; the exit code is 1 while a file still names it."""
    from express50.dataset.withdraw import plan, withdraw

    dataset = Dataset(args.dataset)
    check_folder(dataset)
    for path in args.checkpoint:  # refuses other files before anything is removed
        hook("read_checkpoint")(path)
    if not args.yes:
        paths = {str(path): why for path, why in plan(dataset, args.subject).items()}
        models = [*sorted((dataset.root / "grmm").rglob("*.pt")), *args.checkpoint]
        lines = [f"would remove {p}" + (f" ({why})" if why else "") for p, why in paths.items()]
        ways = "would take the person's codes and frames, if there are any, out of"
        lines += [f"{ways} {path}" for path in models]
        data = {"subject": args.subject, "would_remove": list(paths), "why": paths}
        return answer(args, data, *lines, "add --yes to remove")
    done = withdraw(dataset, args.subject, args.checkpoint, hook("redact_checkpoint"))
    data = {
        "subject": done.subject,
        "removed": [str(path) for path in done.removed],
        "files": done.files,
        "checkpoints": [str(path) for path in done.checkpoints],
        "remaining": [str(path) for path in done.remaining],
        "raw_capture": str(done.capture) if done.capture else None,
    }
    lines = [f"removed {path}" for path in done.removed]
    lines += [
        f"took codes and frames out of {path}"
        if path.exists()
        else f"removed {path}, which held this person alone"
        for path in done.checkpoints
    ]
    lines += [f"STILL NAMES {done.subject}: {path}" for path in done.remaining]
    if done.capture:
        lines.append(f"the raw capture {done.capture} is outside the dataset: delete it yourself")
    lines.append(
        "run 'express50 run' with the settings of your last run to make again what was removed, "
        "then 'express50 report'; train models that saw the person again (their other weights keep "
        "an influence), and delete exports outside the dataset"
    )
    answer(args, data, *lines)
    return FAILED if done.remaining else OK
