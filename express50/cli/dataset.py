"""Run the commands on finished data.

``express50 shards`` verifies packed shards, lists and shows samples, splits and merges; ``check``
audits a dataset, ``prune`` frees space, ``subject`` withdraws a person.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from express50.console import (
    FAILED,
    OK,
    add_command,
    answer,
    count,
    group_lines,
    log,
    number,
    say,
    say_json,
    stdout_to_stderr,
)
from express50.contract.layout import (
    Dataset,
    check_folder,
    check_results_file,
    check_results_folder,
    existing_dataset,
)
from express50.contract.stage import hook, stages
from express50.errors import FormatError, advised


def add_commands(subparsers: Any) -> None:
    """Add ``shards``, ``check``, ``prune`` and ``subject withdraw``."""
    add_shards(subparsers)
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


def add_shards(subparsers: Any) -> None:
    """Add ``shards`` with its actions."""
    parser = subparsers.add_parser(
        "shards", help="verify, list, show, split or merge packed shards"
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    words = "check every file and member against checksums"
    verify = add_command(actions, "verify", run_verify, words, dataset=False)
    listing = add_command(actions, "ls", run_ls, "list the samples", dataset=False)
    show = add_command(
        actions, "show", run_show, "print a sample's metadata, or draw the sample", dataset=False,
        example="express50 shards show data/pack/shards S001_smile_cam03 --out a.png",
    )  # fmt: skip
    split = add_command(
        actions, "split", run_split, "write some of the samples as new shards",
        dataset=False, json=False,
        example="express50 shards split data/pack/shards test_only --split test",
    )  # fmt: skip
    words = "write the samples of several folders into one folder"
    merge = add_command(actions, "merge", run_merge, words, dataset=False, json=False)
    for action in (verify, listing, show, split):
        action.add_argument("directory", type=Path, metavar="DIR", help="folder of shards")
    show.add_argument("key", nargs="?", metavar="KEY", help="sample to show (default: the first)")
    words = "also draw colours, matte and depth into this picture, .png or .jpg"
    show.add_argument("--out", type=Path, metavar="FILE", help=words)
    merge.add_argument("directories", type=Path, nargs="+", metavar="DIR", help="folders of shards")
    for action, names in ((listing, ("subject",)), (split, ("subject", "expression", "camera"))):
        for name in names:
            words = f"only this {name}; may be repeated (default: all)"
            action.add_argument(f"--{name}", action="append", metavar="ID", help=words)
    for action in (listing, split):
        action.add_argument(
            "--split",
            metavar="NAME",
            help="only samples of this split, such as test (default: all)",
        )
    for action in (split, merge):
        action.add_argument("out", type=Path, metavar="OUT", help="folder to make, or an empty one")
        words = "begin a new shard after this size, MB (default: 256)"
        action.add_argument("--shard-mb", type=number(1), default=256, metavar="MB", help=words)


def run_split(args: argparse.Namespace) -> int:
    """Copy the samples that match."""
    from express50.shards.reader import ShardReader
    from express50.shards.writer import copy_samples

    check_results_folder(args.out)
    wanted = (args.subject, args.expression, args.camera, args.split)
    reader = ShardReader(args.directory).select(*wanted)
    say(f"{args.out}: {count(copy_samples([reader], args.out, args.shard_mb), 'sample')}")
    return OK


def run_merge(args: argparse.Namespace) -> int:
    """Copy the samples of all folders."""
    from express50.shards.reader import ShardReader
    from express50.shards.writer import copy_samples

    check_results_folder(args.out)
    readers = [ShardReader(directory) for directory in args.directories]
    say(f"{args.out}: {count(copy_samples(readers, args.out, args.shard_mb), 'sample')}")
    return OK


def run_verify(args: argparse.Namespace) -> int:
    """Print every fault; return exit code 1 if there is one."""
    from express50.shards.writer import verify

    faults = verify(args.directory)
    verdict = f"{args.directory}: {count(len(faults), 'fault') if faults else 'no faults'}"
    answer(args, {"directory": str(args.directory), "faults": faults}, *faults, verdict)
    return FAILED if faults else OK


def run_ls(args: argparse.Namespace) -> int:
    """List keys with their split and shard."""
    from express50.shards.reader import ShardReader

    reader = ShardReader(args.directory).select(subjects=args.subject, split=args.split)
    data = [{"key": e.key, "split": e.split, "shard": e.shard} for e in reader.entries]
    lines = ("  ".join(row.values()) for row in data)
    return answer(args, data, *lines, count(len(reader), "sample"))


def run_show(args: argparse.Namespace) -> int:
    """Print one sample's meta; with --out write its pictures side by side."""
    from express50.files.images import write_image
    from express50.shards.reader import ShardReader, sample_picture

    reader = ShardReader(args.directory)
    keys = reader.keys
    if not keys or (args.key is not None and args.key not in keys):
        what = f"no sample {args.key!r}; 'express50 shards ls' lists them" if keys else "no samples"
        raise FormatError(f"{args.directory}: {what}")
    sample = reader.sample(keys.index(args.key) if args.key else 0)
    if args.out is not None:
        check_results_file(args.out)
        write_image(args.out, sample_picture(sample))
    say_json(sample["meta"] | {"key": sample["key"]})
    return OK


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
    rows = (
        (one.where, f"{one.what}; {'FIXED' if one.fixed else 'fix'}: {one.fix}")
        for one in result.findings
    )
    lines = [*group_lines(rows)]
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
    if is_running(dataset, "run"):  # within a budget, or `tune`
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
        end = "add --yes to remove" if lines else f"nothing of {args.subject} is left"
        return answer(args, data, *lines, end)
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
    run = advised("express50 run", args.dataset)
    report = advised("express50 report", args.dataset)
    lines.append(
        f"run {run} with the settings of your last run to make again what was removed, then"
        f" {report}; train models that saw the person again (their other weights keep an"
        " influence), and delete exports outside the dataset"
        if lines
        else f"nothing of {done.subject} is left"
    )
    answer(args, data, *lines)
    return FAILED if done.remaining else OK
