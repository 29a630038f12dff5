"""Run tasks in worker processes; tasks whose worker died are tried again, then fail."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from express50.errors import DiskError, StageError
from express50.runner.clusters import GPU, LocalWorkers, RemoteWorkers, cuda_devices, no_gpu
from express50.runner.ledger import Receipt
from express50.runner.slurm import SlurmJob, SlurmWorkers, check_job_gpu
from express50.runner.worker import (
    BATCH_SECONDS,
    Task,
    failed_receipt,
    run_task,
    run_tasks,
    torch_sees_cuda,
)

ATTEMPTS = 2  # an item whose worker died this often fails
SLURM_ATTEMPTS = 3  # the same in SLURM jobs, where a worker may also have hit the time limit
LARGEST_BATCH = 32
POLL_SECONDS = 0.5


class Pool:
    """Runs tasks in worker processes; one pool serves all stages of a command."""

    def __init__(
        self,
        workers: int = 2,
        scheduler: str | None = None,
        threads: int = 1,
        slurm: Mapping[str, SlurmJob] | None = None,
    ) -> None:
        """Choose the workers; nothing is started yet.

        These are local processes (with 0, and for 1 item, this one), or those of a dask scheduler
        at an address, or SLURM jobs by stage. An item may use ``threads`` threads.
        """
        self.workers = workers
        self.scheduler = scheduler
        self.threads = threads
        self.slurm = slurm
        self._workers: LocalWorkers | RemoteWorkers | None = None

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()

    def reach(self) -> None:
        """Connect to the scheduler, if one was given; StageError if it cannot be reached."""
        if self.scheduler is not None and self._workers is None:
            self._workers = RemoteWorkers.reach(self.scheduler)

    def check_gpu(self, stage: str) -> None:
        """Raise StageError unless a stage that needs a GPU gets one."""
        if self.slurm is not None:
            check_job_gpu(self.slurm[stage], stage)
        elif self._workers is not None:
            self._workers.slots(stage, gpu=True)
        elif not cuda_devices() and (self.workers or not torch_sees_cuda()):
            raise no_gpu(stage, "nvidia-smi lists none on this machine")

    def run(
        self,
        tasks: Iterable[Task],
        settle: Callable[[Receipt], None],
        begin: Callable[[Task], None] = lambda task: None,
        closed: Callable[[], bool] = lambda: False,
    ) -> None:
        """Run tasks of one stage and configuration; hand each receipt to ``settle`` as it comes.

        ``begin`` is called when a task is handed to a worker; once ``closed`` returns True, no
        further task is. A task whose worker died is tried again when nothing else runs, so that
        neighbours that died with it are not blamed. If that fails too, it is set aside. SLURM jobs
        share a time limit but no memory, so there all such tasks are tried again together.

        Raises:
            StageError: the scheduler cannot be reached or went away, or offers no GPU that the
                stage needs.
            DiskError: the disk has no room for an item's outputs, or cannot be written to.
        """
        tasks = list(tasks)
        here = self.scheduler is None and self.slurm is None
        if here and (self.workers == 0 or len(tasks) <= 1):  # processes would cost more than gain
            for task in tasks:
                if closed():
                    return
                begin(task)
                settle(run_task(task))
            return
        if not tasks:
            return
        workers = self._workers = self._workers_for(tasks[0])
        job = workers.job if isinstance(workers, SlurmWorkers) else None
        last = SLURM_ATTEMPTS if job else ATTEMPTS
        left = self._run_window(workers, tasks, settle, begin, closed, 1)
        for attempt in range(2, last + 1):
            groups = [left] if job and left else [[task] for task in left]
            again = [self._run_window(workers, g, settle, begin, closed, attempt) for g in groups]
            left = [task for group in again for task in group]
        why, fix = "out of memory or a crash in native code", "give it more memory"
        if job is not None:
            why += f", or its job reached {job.time}"
            fix += f" than {job.memory}, or more time"
        words = (
            f"its worker process died {last} times ({why}); run "
            f"this item with --workers 0 to see why, or {fix}"
        )
        for killer in left:
            settle(failed_receipt(killer, words, last))

    def _run_window(
        self,
        workers: LocalWorkers | RemoteWorkers,
        tasks: list[Task],
        settle: Callable[[Receipt], None],
        begin: Callable[[Task], None],
        closed: Callable[[], bool],
        attempt: int,
    ) -> list[Task]:
        """Keep one batch per worker submitted; returns the tasks whose worker died."""
        from distributed.scheduler import KilledWorker

        waiting, killed, size = deque(tasks), [], 1
        full: DiskError | None = None
        name, gpu = tasks[0].stage.name, tasks[0].stage.needs_gpu(tasks[0].config)
        resources = {GPU: 1} if gpu else None
        running: dict[Any, list[Task]] = {}
        while waiting or running:
            with _loss_is_one_error():
                slots = workers.slots(name, gpu)
                if waiting and closed():
                    waiting.clear()
                workers.keep(len(waiting) + sum(map(len, running.values())))
                while waiting and len(running) < slots and not closed():
                    fair = max(1, len(waiting) // (2 * slots))  # the last ones end together
                    batch = [waiting.popleft() for _ in range(min(size, fair))]
                    for task in batch:
                        begin(task)
                    # The run's folder: others' runs on this scheduler may have the same items.
                    key = f"{name}-{batch[0].item}-{batch[0].folder.name}-{attempt}"
                    future = workers.client.submit(
                        run_tasks, batch, pure=False, key=key, resources=resources
                    )
                    running[future] = batch
                ended = _ended(workers.client, running)
            for future, receipts, failure in ended:
                batch = running.pop(future)
                if isinstance(failure, DiskError):
                    full = failure
                elif isinstance(failure, KilledWorker):
                    killed += batch
                elif failure is not None:  # the tasks did not even start
                    words = f"worker: {type(failure).__name__}: {failure}"
                    for task in batch:
                        settle(failed_receipt(task, words, attempt))
                else:
                    size = _next_size(size, batch, receipts)
                    waiting.extendleft(reversed(batch[len(receipts) :]))
                    for receipt in receipts:
                        # A restored output stays marked by 0 attempts.
                        settle(replace(receipt, attempts=receipt.attempts and attempt))
            if full is not None:  # only now, when all that others finished is recorded
                raise full
        return killed

    def _workers_for(self, task: Task) -> LocalWorkers | RemoteWorkers:
        """Return the workers for a task's stage; the previous stage's if they fit."""
        job = self.slurm[task.stage.name] if self.slurm else None
        if isinstance(self._workers, SlurmWorkers) and self._workers.job != job:
            self.close()
        if self._workers is not None:
            return self._workers
        if job is not None:
            return SlurmWorkers(job, self.threads, task.dataset.slurm_dir)
        if self.scheduler is not None:
            return RemoteWorkers.reach(self.scheduler)
        return LocalWorkers(self.workers, self.threads)

    def close(self) -> None:
        """Stop the local workers and cancel jobs; a scheduler of the user's stays as it is."""
        if self._workers is not None:
            self._workers.close()
        self._workers = None

    def width(self) -> int:
        """Return how many items can be worked on at once; StageError without the scheduler."""
        if self.slurm:
            return min(job.jobs * job.processes(self.threads) for job in self.slurm.values())
        if self.scheduler is None:
            return max(1, self.workers)
        if self._workers is None:
            self._workers = RemoteWorkers.reach(self.scheduler)
        return self._workers.slots("", False)


def _next_size(size: int, batch: list[Task], receipts: list[Receipt]) -> int:
    """Return the size of the next batches: larger while tasks are quick, else one.

    A round trip to a worker costs 10 ms, which the items of a batch share. Slow items get batches
    of their own, so that a worker that dies costs at most one of them.
    """
    if len(receipts) < len(batch):
        return len(receipts)
    quick = sum(receipt.seconds for receipt in receipts) < BATCH_SECONDS / 2
    return max(size, min(2 * len(batch), LARGEST_BATCH)) if quick else len(batch)


@contextmanager
def _loss_is_one_error() -> Iterator[None]:
    """Turn the errors that a lost scheduler causes into one StageError."""
    try:
        yield
    except (CancelledError, OSError) as error:  # dask's CommClosedError is an OSError
        reason = f"{type(error).__name__}: {error}".split("\n")[0]
        raise StageError(
            f"lost the dask scheduler ({reason}); start it and run the same command again"
        ) from error


def _ended(
    client: Any, running: Iterable[Any]
) -> list[tuple[Any, list[Receipt], BaseException | None]]:
    """Wait a moment for batches to end; returns their futures, receipts, and why one did not run.

    Raises:
        CancelledError: the scheduler is gone.
    """
    from distributed import wait

    try:
        with client.as_current():
            done = wait(list(running), POLL_SECONDS, "FIRST_COMPLETED").done
    except TimeoutError:
        return []
    failures = [(future, future.exception()) for future in done]
    for _, failure in failures:
        if isinstance(failure, CancelledError):
            raise failure
    return [(future, [] if failure else future.result(), failure) for future, failure in failures]
