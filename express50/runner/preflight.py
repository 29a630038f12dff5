"""Check before a run that files, folders, memory, space, GPU and scheduler are available."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
from rich.filesize import decimal

from express50.console import count, not_writable
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.errors import ConfigError, Express50Error, FormatError, few
from express50.files.atomic import LEAST_FREE, check_folder_writable, free_space, nearest_existing
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger
from express50.runner.publish import size_of

WORKER_SHARE = 0.9 * 0.95  # share of the memory that workers get, and at which dask stops one
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of containers and jobs


def problems(
    dataset: Dataset, work: Sequence[tuple[Stage, Any]], pool: Pool, all_items: bool = True
) -> Iterator[str]:
    """Yield, one line each, what would stop stages with these configurations; nothing is written.

    Memory and disk space are judged by the receipts of items that were made in this dataset; the
    space for some of the items is left to `expected_shortage`.
    """
    chosen = list({stage.name: stage for stage, _ in work}.values())  # of several settings, once
    yield from _folder_problems(dataset, chosen)
    for stage, config in work:
        yield from _refusal(stage.try_files, config)
    if unreachable := _refusal(pool.reach):
        yield from unreachable
    else:
        for stage, config in work:
            if stage.needs_gpu(config):
                yield from _refusal(pool.check_gpu, stage.name)
    needs = []
    with suppress(FormatError):  # a damaged ledger: the first stage reports it
        if dataset.ledger.is_file():
            with Ledger(dataset.ledger, read_only=True) as ledger:
                yield from _memory_problems(ledger, chosen, pool)
                for stage in chosen if all_items else ():
                    with suppress(Express50Error):  # a damaged list of items: the stage reports it
                        needs.append(expected_bytes(ledger, stage.name, stage.items(dataset)))
    yield from _space_problems(dataset, [need for need in needs if need])


def _folder_problems(dataset: Dataset, stages: Iterable[Stage]) -> Iterator[str]:
    """Yield a line per reason for which folders that the stages write to are not writable."""
    inside = [dataset.stage_dir(stage.name) for stage in stages]
    inside += [dataset.staging_dir, dataset.config_file("").parent]
    root, refused = nearest_existing(dataset.root), dict[str, tuple[OSError, list[str]]]()
    for folder in [root, *(one for one in inside if one.exists())]:
        try:
            check_folder_writable(folder)
        except ConfigError as error:
            yield str(error)
        except OSError as error:
            refused.setdefault(str(error.strerror), (error, []))[1].append(str(folder))
            if folder == root:
                break  # on a read-only disk, those inside are refused too
    for first, folders in refused.values():
        yield not_writable(few(folders), first)


def _refusal(check: Callable[..., object], *args: object) -> list[str]:
    """Call a check; return the line with which it refuses, if it does."""
    try:
        check(*args)
    except Express50Error as error:
        return [str(error)]
    return []


def _memory_problems(ledger: Ledger, stages: Iterable[Stage], pool: Pool) -> Iterator[str]:
    if pool.scheduler is not None or pool.slurm is not None:
        return
    total = psutil.virtual_memory().total
    if CGROUP_LIMIT.is_file() and (text := CGROUP_LIMIT.read_text().strip()).isdigit():
        total = min(total, int(text))
    receipts = [receipt for stage in stages for receipt in ledger.read(stage.name).values()]
    done = [(r.peak_memory, r.stage) for r in receipts if r.status == "done"]
    peak, stage = max(done, default=(0, ""))
    fit = max(math.floor(total * WORKER_SHARE / max(peak, 1)), 1)
    if pool.workers > fit:
        yield (
            f"{stage}: {pool.workers} workers need {decimal(peak)} each (as the largest "
            f"item did), and this machine has {decimal(total)}; use --workers {fit}"
        )


def expected_bytes(
    ledger: Ledger, stage: str, items: Iterable[str]
) -> tuple[str, int, float] | None:
    """Return the stage, how many items have no output yet, and the mean bytes of those that have.

    None if nothing is left to do, or nothing was measured.
    """
    made = ledger.made(stage)
    new = len(set(items) - made.keys())
    sizes = [sum(mark.size for mark in row.files.values()) for row in made.values()]
    return (stage, new, sum(sizes) / len(sizes)) if new and sizes else None


def expected_shortage(
    dataset: Dataset, ledger: Ledger, stage: str, items: Iterable[str]
) -> str | None:
    """Say that a stage's outputs will not fit, judging by those it made; None if they will."""
    need = expected_bytes(ledger, stage, items)
    return next(_space_problems(dataset, [need]), None) if need else None


def _space_problems(dataset: Dataset, needs: Sequence[tuple[str, int, float]]) -> Iterator[str]:
    free = free_space(dataset.root)
    need = sum(new * size for _, new, size in needs)
    # Replaced outputs are deleted when space is needed.
    room = free - LEAST_FREE + size_of(dataset.replaced_dir)[1]
    if room < 0:
        yield (
            f"{dataset.root}: the disk is nearly full: {decimal(int(free))} are left, expected "
            f"{decimal(int(LEAST_FREE))}; free some space"
        )
    elif need > room:
        largest = max(needs, key=lambda one: one[1] * one[2])
        yield (
            f"{dataset.root}: about {decimal(int(need))} of disk are needed, most by {largest[0]} "
            f"({count(largest[1], 'item')} of {decimal(int(largest[2]))}), and "
            f"{decimal(int(room))} are free; free some space, or run single stages with --items"
        )
