"""Publish results of other tools as a stage's output, with a receipt that marks them as imported.

Later stages treat an imported item like the stage's own output. A run keeps it whatever the stage's
settings are. It is valid for the cameras and peak frames that it was imported for. If these change,
it is set aside, and the stage does not make the item until the import is repeated or removed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from express50.capture.index import read_peaks
from express50.contract.layout import Dataset
from express50.contract.stage import NoSettings, Result, Stage
from express50.errors import Express50Error, advised
from express50.files.digests import path_digest, value_digest
from express50.runner.ledger import IMPORTED, Ledger, Made, Receipt
from express50.runner.publish import record_published, run_folder, set_aside
from express50.runner.worker import Task, run_task

Digest = Callable[[Path], str]


def import_inputs(dataset: Dataset, item: str, digest: Digest = path_digest) -> dict[str, str]:
    """Return the digests of the cameras and of each peak frame that an import belongs to.

    ``item`` is a subject, or an expression of one, whose import also belongs to pictures of a size.

    Raises:
        Express50Error: cameras or peaks are missing or damaged.
    """
    subject, _, expression = item.partition("/")
    frames = read_peaks(dataset, subject).items()
    chosen = {f"frame of {e}": str(n) for e, n in frames if expression in ("", e)}
    found = {"cameras": digest(dataset.cameras_file(subject)), **chosen}
    if expression:
        from express50.capture.frames import read_cameras_of  # OpenCV would slow every command

        cameras = read_cameras_of(dataset, subject).values()
        found["size of pictures"] = repr({c.id: (c.width, c.height) for c in cameras})
    return found


def publish_import(
    dataset: Dataset, stage: Stage, item: str, write: Callable[[Path], Result], ledger: Ledger
) -> Receipt:
    """Publish an item that ``write`` writes into an empty folder; the caller holds the stage.

    An item whose receipt has a reason was not published; the previous output stays.
    """
    inputs, former = import_inputs(dataset, item), ledger.read_whole(stage.name, item)
    writer = replace(stage, run=lambda *given: write(given[-1]), needs_gpu=lambda config: False)
    # Every import counts as new: a replaced output of an earlier import must not come back.
    fingerprint = IMPORTED + value_digest([inputs, time.time_ns()])
    with run_folder(dataset, stage.name) as folder:
        settings = NoSettings()  # no stage's settings concern an import
        receipt = run_task(
            Task(writer, dataset, item, settings, fingerprint, inputs, 1, former, folder)
        )
    if not receipt.reason:
        record_published(dataset, ledger, receipt)
    return receipt


def remove_imports(dataset: Dataset, stage: str, pattern: Callable[[str], bool]) -> list[str]:
    """Set aside a stage's imported items whose id matches, so that it makes them; list them."""
    with Ledger(dataset.ledger) as ledger:
        found = ledger.read(stage).items()
        chosen = [item for item, receipt in found if receipt.imported and pattern(item)]
        for item in chosen:
            set_aside(dataset, stage, item)
        ledger.forget(stage, chosen)
    return chosen


def how_to_renew(dataset: Dataset, stage: str) -> str:
    """Return what to do about an imported item that no longer holds."""
    remove = advised("express50 import remove", dataset.root, stage)
    return f"import it again, or remove it with {remove}"


def import_trouble(
    dataset: Dataset, receipt: Receipt, made: Made | None, digest: Digest
) -> str | None:
    """Say why an imported item no longer holds; None if it does."""
    again = how_to_renew(dataset, receipt.stage)
    if receipt.status != "done" or made is None:
        return receipt.reason or f"it was imported, but its receipt is incomplete; {again}"
    try:
        now: Mapping[str, str] = import_inputs(dataset, receipt.item, digest)
    except Express50Error as error:
        return f"cannot compare it with the cameras and peaks it was imported for ({error})"
    # Peaks that were labelled later were not imported; they do not concern it.
    changed = [name for name, value in made.inputs.items() if now.get(name) != value]
    if changed:
        return f"imported, but since then these changed: {', '.join(changed[:3])}; {again}"
    return None
