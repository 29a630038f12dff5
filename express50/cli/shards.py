"""``express50 shards`` verifies packed shards, lists and shows samples, splits and merges."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from express50.console import FAILED, OK, add_command, answer, count, number, say, say_json
from express50.errors import FormatError


def add_commands(subparsers: Any) -> None:
    """Add the ``shards`` command."""
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
    words = "also draw colours, matte and depth into this picture"
    show.add_argument("--out", type=Path, metavar="FILE", help=words)
    merge.add_argument("directories", type=Path, nargs="+", metavar="DIR", help="folders of shards")
    for action, names in ((listing, ("subject",)), (split, ("subject", "expression", "camera"))):
        for name in names:
            words = f"only this {name}; may be repeated"
            action.add_argument(f"--{name}", action="append", metavar="ID", help=words)
    for action in (listing, split):
        action.add_argument("--split", metavar="NAME", help="only samples of this split")
    for action in (split, merge):
        action.add_argument("out", type=Path, metavar="OUT", help="folder to make, or an empty one")
        words = "size of a shard, MB (default: 256)"
        action.add_argument("--shard-mb", type=number(1), default=256, metavar="MB", help=words)


def run_split(args: argparse.Namespace) -> int:
    """Copy the samples that match."""
    from express50.shards.reader import ShardReader
    from express50.shards.writer import copy_samples

    wanted = (args.subject, args.expression, args.camera, args.split)
    reader = ShardReader(args.directory).select(*wanted)
    say(f"{args.out}: {count(copy_samples([reader], args.out, args.shard_mb), 'sample')}")
    return OK


def run_merge(args: argparse.Namespace) -> int:
    """Copy the samples of all folders."""
    from express50.shards.reader import ShardReader
    from express50.shards.writer import copy_samples

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
        write_image(args.out, sample_picture(sample))
    say_json(sample["meta"] | {"key": sample["key"]})
    return OK
