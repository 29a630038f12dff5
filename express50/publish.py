"""Crash-safe outputs: written aside, synced, renamed; after a kill a file is absent or whole."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from express50.layout import Dataset


def dump_json(value: object) -> bytes:
    """Deterministic JSON bytes: sorted keys, no NaN or infinity.

    Raises:
        ValueError: the value holds a number that is not finite.
    """
    text = json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode()


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file so that a reader or a crash sees the old bytes or the new, nothing between."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with aside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)
    sync_directory(path.parent)


def write_json(path: Path, value: object) -> None:
    """Write deterministic JSON in one step."""
    write_bytes(path, dump_json(value))


@contextmanager
def publishing(dataset: Dataset, stage: str, item: str) -> Iterator[Path]:
    """Yield an empty folder aside; on a clean exit it becomes the item's folder in one rename.

    When the body raises, the item's former folder stays as it was.
    """
    aside = dataset.staging_dir / f"{stage}-{item.replace('/', '+')}-{uuid.uuid4().hex}"
    aside.mkdir(parents=True)
    try:
        yield aside
        sync_tree(aside)
        replace_directory(aside, dataset.item_dir(stage, item))
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def replace_directory(source: Path, target: Path) -> None:
    """Rename ``source`` to ``target``; a former target is moved out of the way and deleted.

    A kill between the two renames leaves the target absent, never mixed.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    former = source.with_name(source.name + ".former")
    if target.exists():
        target.rename(former)
    source.rename(target)
    sync_directory(target.parent)
    shutil.rmtree(former, ignore_errors=True)


def set_aside(dataset: Dataset, stage: str, item: str) -> bool:
    """Move a published item to the stale folder, so that no later stage reads it."""
    target = dataset.item_dir(stage, item)
    if not target.exists():
        return False
    discard_stale(dataset, stage, item)
    stale = dataset.stale_dir / stage / item
    stale.parent.mkdir(parents=True, exist_ok=True)
    target.rename(stale)
    sync_directory(target.parent)
    _remove_empty(target.parent, dataset.stage_dir(stage))
    return True


def _remove_empty(folder: Path, top: Path) -> None:
    """Remove empty folders of nested items, so that no stage takes one for an item."""
    while folder != top and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent


def discard_stale(dataset: Dataset, stage: str, item: str) -> None:
    """Delete what a former failure of an item set aside."""
    shutil.rmtree(dataset.stale_dir / stage / item, ignore_errors=True)


def clean_leftovers(dataset: Dataset, stage: str) -> int:
    """Delete unfinished outputs of killed runs of one stage; returns how many there were."""
    leftovers = sorted(dataset.staging_dir.glob(f"{stage}-*"))
    for path in leftovers:
        shutil.rmtree(path, ignore_errors=True)
    return len(leftovers)


def sync_tree(root: Path) -> None:
    """Flush every file and folder below ``root`` to the disk."""
    for folder, _, names in os.walk(root, topdown=False):
        for name in names:
            _sync(Path(folder) / name, os.O_RDONLY)
        sync_directory(Path(folder))


def sync_directory(path: Path) -> None:
    """Flush a folder's entries to the disk."""
    _sync(path, os.O_RDONLY | os.O_DIRECTORY)


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
