"""Run one item of a stage in any process: publish its folder and return its receipt."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import json
import os
import resource
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import ThreadpoolController

from express50.console import system_error_line
from express50.contract.config import config_texts
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.errors import (
    CaptureError,
    DiskError,
    DiskFullError,
    Express50Error,
    StageError,
    advised,
)
from express50.files.atomic import check_disk, dump_json, naming_full_disk, write_bytes
from express50.files.digests import files_of, value_digest
from express50.runner.ledger import FileMark, Made, Receipt, mark_file
from express50.runner.publish import empty, keeping, publishing, restore

BATCH_SECONDS = 0.2  # after this time a batch begins no further item


@dataclass(frozen=True)
class Task:
    """An item to run, with all that a worker needs."""

    stage: Stage
    dataset: Dataset
    item: str
    config: Any
    fingerprint: str
    inputs: dict[str, str]
    threads: int = 1
    former: Receipt | None = None  # of its output
    folder: Path = Path()  # the run's (`run_folder`)


def input_digests(
    stage: Stage, dataset: Dataset, item: str, config: Any, digest: Callable[[Path], str]
) -> dict[str, str]:
    """Compute the digest of every input of an item, by name; ``digest`` digests a file or folder.

    Raises:
        CaptureError: footage cannot be reached: its disk may be away for a while.
        Express50Error: an input is missing or cannot be read.
    """
    found = stage.inputs(dataset, item, config)
    for path in found.values():
        if isinstance(path, Path) and not (path.is_relative_to(dataset.root) or path.exists()):
            raise CaptureError(
                f"{path}: no such file; if the capture has moved, run"
                f" {advised('express50 ingest', dataset.root, 'CAPTURE')} with its new path"
            )
    return {name: digest(at) if isinstance(at, Path) else at for name, at in found.items()}


def fingerprint(stage: Stage, config: Any, inputs: dict[str, str]) -> str:
    """Compute the digest of stage version, resolved config and inputs of an item."""
    return value_digest([stage.name, stage.version, vars(config), inputs])


def failure_reason(dataset: Dataset, stage: str, item: str, error: Exception) -> str:
    """Say why an item failed; the traceback of a defect goes to the item's log."""
    reason = f"{type(error).__name__}: {error}"
    if isinstance(error, Express50Error):
        return reason
    if isinstance(error, PermissionError):  # of the footage, most often: not a defect
        return system_error_line(error)
    log = dataset.log_file(stage, item)
    try:
        write_bytes(log, "".join(traceback.format_exception(error)).encode())
        return f"{reason} (unexpected; traceback in {log})"
    except (OSError, DiskFullError) as trouble:
        return f"{reason} (unexpected; its traceback could not be written to {log}: {trouble})"


def failed_receipt(task: Task, reason: str, attempts: int) -> Receipt:
    """Make the receipt of an item that no worker could run."""
    return Receipt(
        stage=task.stage.name,
        item=task.item,
        fingerprint=task.fingerprint,
        status="failed",
        reason=" ".join(reason.split()),
        attempts=attempts,
    )


def run_tasks(tasks: list[Task]) -> list[Receipt]:
    """Run items in turn for a while; returns the receipts of those begun, at least one.

    If the disk is full or broken, those made before are returned, and the next call says so.
    """
    began, receipts = time.perf_counter(), []
    for task in tasks:
        try:
            receipts.append(run_task(task))
        except DiskError:
            if not receipts:
                raise
            break
        if time.perf_counter() - began > BATCH_SECONDS:
            break
    return receipts


def run_task(task: Task) -> Receipt:
    """Run one item and publish its outputs; any failure of the item becomes a receipt.

    If an output with the same fingerprint was replaced earlier and kept, it is published again
    instead. Only a receipt travels back to the driver, never data.

    Raises:
        DiskError: the disk is full or cannot be written to; other items would fail as well.
    """
    where = task.folder, task.dataset, task.stage.name, task.item
    if (restored := restore(*where, task.fingerprint, task.former)) is not None:
        return restored
    cap_threads(task.threads)
    if allocator := keep_freed_memory():
        allocator.malloc_trim(0)  # memory that the previous item left must not count for this one
    reset_peak_memory()
    started, cores = time.perf_counter(), core_seconds()
    reason, made = "", None
    metrics: dict = {}
    try:
        with naming_full_disk(task.dataset.root):
            metrics, files = _run_and_publish(task)
        made = Made(task.inputs, files, config_texts(task.config), task.stage.version)
    except DiskFullError:
        if not empty(task.dataset.replaced_dir)[0]:
            raise
        return run_task(task)  # with the space that deleting replaced outputs gave
    except Exception as error:  # noqa: BLE001 (a defect that one item shows must not stop others)
        check_disk(task.dataset.staging_dir, task.dataset.root)
        reason = failure_reason(task.dataset, task.stage.name, task.item, error)
    return Receipt(
        stage=task.stage.name,
        item=task.item,
        fingerprint=task.fingerprint,
        status="failed" if reason else "done",
        reason=" ".join(reason.split()),
        metrics=metrics,
        seconds=time.perf_counter() - started,
        core_seconds=core_seconds() - cores,
        peak_memory=peak_memory(),
        made=made,
    )


def torch_sees_cuda() -> bool:
    """Say whether this process can use a GPU; importing torch takes seconds."""
    import torch

    return torch.cuda.is_available()


def _run_and_publish(task: Task) -> tuple[dict, dict[str, FileMark]]:
    if task.stage.needs_gpu(task.config) and not torch_sees_cuda():
        raise StageError(
            f"{task.stage.name} needs a GPU as it is configured; torch finds no CUDA device here"
        )
    keep = keeping(task.dataset, task.former)
    with publishing(task.folder, task.dataset, task.stage.name, task.item, keep) as out:
        # Standard output is for data; libraries' messages go to standard error.
        with contextlib.redirect_stdout(sys.stderr):
            result = task.stage.run(task.dataset, task.item, task.config, out)
        try:
            metrics = dump_json(result.to_json())
        except (TypeError, ValueError) as error:
            raise StageError(
                f"metrics cannot be written ({error}); expected finite numbers, texts, lists and"
                " tables"
            ) from error
        (out / "metrics.json").write_bytes(metrics)
        # Their bytes are still in memory; a rename changes neither time nor inode.
        files = {p.relative_to(out).as_posix(): mark_file(p) for p in files_of(out)}
    return json.loads(metrics), files


def core_seconds() -> float:
    """Return the processor time of this process and of its children that ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@functools.cache
def keep_freed_memory() -> ctypes.CDLL | None:
    """Let this process use freed memory again instead of giving it back to the system at once.

    An array of a 4K picture has 25 to 100 MB. By default the system maps and clears such blocks
    again for every operation, which took a fifth of the time of keying. Returns the allocator; None
    where it is not glibc's.

    Source: mallopt(3); M_TRIM_THRESHOLD is -1, M_MMAP_MAX -4.
    """
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt") or not hasattr(library, "malloc_trim"):
        return None
    library.mallopt(-1, 2**31 - 1)
    library.mallopt(-4, 0)
    return library


def reset_peak_memory() -> None:
    """Start a new peak for this process where the system can (Linux, see proc(5))."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Return the largest resident memory of this process since the last reset, bytes."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


def thread_environment(threads: int) -> dict[str, str]:
    """Return environment variables that cap every known pool.

    They work before a library is imported.
    """
    return dict.fromkeys(VARIABLES, str(threads))


def cap_threads(threads: int) -> None:
    """Cap pools in this process: by environment, and directly where a library is loaded already."""
    os.environ.update(thread_environment(threads))
    # A BLAS that is loaded already does not look at the environment; on other numbers of threads it
    # adds up in another order, and bytes would depend on where an item was worked on.
    if "numpy" in sys.modules:
        _libraries(len(sys.modules)).limit(limits=threads, user_api="blas")
    # sys.modules is asked, because importing torch only to cap it would cost seconds.
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(threads)


@functools.lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Find the libraries with a pool.

    Looking for them takes 1.5 ms, and only an import brings new ones.
    """
    return ThreadpoolController()
