"""Crash-safe outputs of stages: an item's folder appears whole, in one rename."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from express50.contract.layout import Dataset
from express50.files.atomic import replace_directory, sync_directory, sync_tree


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
