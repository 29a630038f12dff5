"""``express50 shards``: verify packed shards, list their samples, look at one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from express50.console import FAILED, OK, say, say_json
from express50.errors import FormatError
from express50.images import contact_sheet, write_image
from express50.parts import COLOURS
from express50.shards import ShardReader
from express50.shards_write import verify


def add_commands(subparsers: Any) -> None:
    """Add the ``shards`` command."""
    parser = subparsers.add_parser("shards", help="look into packed shards and verify them")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    checking = actions.add_parser("verify", help="check every file and member against checksums")
    checking.set_defaults(handler=run_verify)
    listing = actions.add_parser("ls", help="list the samples")
    listing.add_argument("--subject", action="append", help="only this subject; may be repeated")
    listing.add_argument("--split", help="only this split")
    listing.set_defaults(handler=run_ls)
    showing = actions.add_parser(
        "show",
        help="print a sample's meta and write it as a picture",
        epilog="example: express50 shards show data/pack/shards --key S001_smile_cam03 --out a.png",
    )
    showing.add_argument("--key", help="sample; the first by default")
    showing.add_argument("--out", type=Path, help="picture of rgb, alpha and depth to write")
    showing.set_defaults(handler=run_show)
    for action in (checking, listing, showing):
        action.add_argument("directory", type=Path, metavar="DIR", help="folder of shards")
        action.add_argument("--json", action="store_true", help="print as JSON")


def run_verify(args: argparse.Namespace) -> int:
    """Print every fault; exit code 1 when there is one."""
    faults = verify(args.directory)
    if args.json:
        say_json({"directory": str(args.directory), "faults": faults})
    else:
        say(*faults, f"{args.directory}: {len(faults)} faults" if faults else "all is well")
    return FAILED if faults else OK


def run_ls(args: argparse.Namespace) -> int:
    """List keys with their split and shard."""
    reader = ShardReader(args.directory).select(subjects=args.subject, split=args.split)
    if args.json:
        say_json([{"key": e.key, "split": e.split, "shard": e.shard} for e in reader.entries])
    else:
        say(*(f"{e.key}  {e.split}  {e.shard}" for e in reader.entries))
        say(f"{len(reader)} samples")
    return OK


def run_show(args: argparse.Namespace) -> int:
    """Print one sample's meta; with --out write its pictures side by side."""
    reader = ShardReader(args.directory)
    keys = reader.keys
    if not keys or (args.key is not None and args.key not in keys):
        raise FormatError(f"{args.directory}: no sample {args.key!r}; 'express50 shards ls' lists")
    sample = reader.sample(keys.index(args.key) if args.key else 0)
    if args.out is not None:
        write_image(args.out, sample_picture(sample))
    say_json(sample["meta"] | {"key": sample["key"]})
    return OK


def sample_picture(sample: dict) -> np.ndarray:
    """Picture (H, 3 W or 4 W, 3) uint8: rgb, alpha, depth (near is bright), parts if labelled."""
    depth, valid = sample["depth"], sample["valid"]
    shade = np.zeros(depth.shape, np.uint8)
    if valid.any():
        low, high = np.percentile(depth[valid], [1, 99])
        near = np.clip((high - depth) / max(float(high - low), 1e-6), 0, 1)
        shade = np.where(valid, 55 + 200 * near, 0).astype(np.uint8)
    alpha = (sample["alpha"] * 255).astype(np.uint8)
    parts = [] if sample["parts"] is None else [COLOURS[sample["parts"]]]
    return contact_sheet([[sample["rgb"], alpha, shade, *parts]], tile=depth.shape)
