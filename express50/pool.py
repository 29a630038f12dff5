"""Worker processes: a local dask cluster that starts when first needed, or any scheduler."""

from __future__ import annotations

import logging
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from express50.errors import StageError
from express50.ledger import Receipt
from express50.threads import thread_environment
from express50.work import Task, run_task

ATTEMPTS = 2  # an item that killed its worker this often is set aside
POLL_SECONDS = 0.5
CONNECT_SECONDS = 20.0


class Pool:
    """Runs tasks in worker processes; one pool serves all stages of a command."""

    def __init__(self, workers: int = 2, scheduler: str | None = None, threads: int = 1) -> None:
        self.workers = workers
        self.scheduler = scheduler
        self.threads = threads
        self._client: Any = None
        self._cluster: Any = None

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()

    def runs_inline(self, count: int) -> bool:
        """Whether starting processes would cost more than it brings."""
        return self.scheduler is None and (self.workers == 0 or count <= 1)

    def run(
        self, tasks: Iterable[Task], settle: Callable[[Receipt], None], tick: Callable[[], None]
    ) -> None:
        """Run every task and hand each receipt to ``settle`` as it comes.

        A task whose worker died is tried again when nothing else runs, so that neighbours that
        died with it are not blamed, and is set aside when that fails too.

        Raises:
            StageError: the scheduler cannot be reached or went away.
        """
        tasks = list(tasks)
        if self.runs_inline(len(tasks)):
            for task in tasks:
                settle(run_task(task))
            return
        suspects = self._run_window(tasks, settle, tick, attempt=1)
        for task in suspects:
            for killer in self._run_window([task], settle, tick, attempt=ATTEMPTS):
                settle(_killed(killer))

    def _run_window(
        self,
        tasks: list[Task],
        settle: Callable[[Receipt], None],
        tick: Callable[[], None],
        attempt: int,
    ) -> list[Task]:
        """Keep as many tasks submitted as there are workers; returns those whose worker died."""
        from distributed.scheduler import KilledWorker

        client = self._connect()
        waiting, killed = deque(tasks), []
        running: dict[Any, Task] = {}
        while waiting or running:
            with _loss_is_one_error():
                while waiting and len(running) < self._window():
                    task = waiting.popleft()
                    future = client.submit(run_task, task, pure=False, key=_key(task, attempt))
                    running[future] = task
                ended = [(future, *_outcome(future)) for future in _finished(client, running)]
            for future, receipt, failure in ended:
                task = running.pop(future)
                if receipt is not None:
                    settle(replace(receipt, attempts=attempt))
                elif isinstance(failure, KilledWorker):
                    killed.append(task)
                else:  # the task did not even start
                    settle(_failed(task, f"worker: {type(failure).__name__}: {failure}", attempt))
            tick()
        return killed

    def _window(self) -> int:
        if self.scheduler is None:
            return self.workers
        return max(1, sum(self._client.nthreads().values()))

    def _connect(self) -> Any:
        if self._client is not None:
            return self._client
        import dask
        from distributed import Client, LocalCluster

        if self.scheduler is not None:
            try:
                self._client = Client(self.scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
                has_workers = bool(self._client.nthreads())
            except (OSError, TimeoutError, ValueError) as error:
                raise StageError(
                    f"scheduler {self.scheduler}: cannot connect ({error}); expected an address "
                    "such as tcp://host:8786 of a running dask scheduler"
                ) from error
            if not has_workers:
                sys.stderr.write(f"scheduler {self.scheduler} has no workers yet; waiting\n")
            return self._client
        with dask.config.set(local_settings(self.threads)):
            self._cluster = LocalCluster(
                n_workers=self.workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,
                memory_limit=0.9 / self.workers,
                silence_logs=logging.CRITICAL,
            )
            self._client = Client(self._cluster, set_as_default=False)
            self._client.register_plugin(_ignore_interrupts())
        return self._client

    def close(self) -> None:
        """Stop the local workers; a scheduler of the user's stays as it is."""
        if self._client is not None:
            self._client.close(timeout=5)
        if self._cluster is not None:
            self._cluster.close(timeout=10)
        self._client = self._cluster = None


@contextmanager
def _loss_is_one_error() -> Iterator[None]:
    """Any call to a scheduler may be the one that finds it gone, each with an error of its own."""
    try:
        yield
    except (CancelledError, OSError) as error:  # dask's CommClosedError is an OSError
        reason = f"{type(error).__name__}: {error}".split("\n")[0]
        raise StageError(
            f"lost the dask scheduler ({reason}); start it, run the same again"
        ) from error


def _finished(client: Any, running: Iterable[Any]) -> set[Any]:
    """The futures that ended, after a wait of at most ``POLL_SECONDS``."""
    from distributed import wait

    try:
        with client.as_current():
            return wait(list(running), POLL_SECONDS, "FIRST_COMPLETED").done
    except TimeoutError:
        return set()


def _outcome(future: Any) -> tuple[Receipt | None, BaseException | None]:
    """What a finished task returned, or why it did not run."""
    failure = future.exception()
    if isinstance(failure, CancelledError):
        raise failure
    return (None, failure) if failure is not None else (future.result(), None)


def local_settings(threads: int) -> dict[str, object]:
    """Settings of dask for a local cluster."""
    return {
        "distributed.scheduler.allowed-failures": 0,
        # A stage may hold the interpreter for minutes in native code; that is not death.
        "distributed.scheduler.worker-ttl": None,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.nanny.pre-spawn-environ": thread_environment(threads),
    }


def _ignore_interrupts() -> Any:
    """Plug-in by which workers leave Ctrl-C to the driver, which stops them in order."""
    from distributed import WorkerPlugin

    class IgnoreInterrupts(WorkerPlugin):
        name = "ignore-interrupts"

        def setup(self, worker: object) -> None:
            import signal
            import threading

            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, signal.SIG_IGN)

    return IgnoreInterrupts()


def _key(task: Task, attempt: int) -> str:
    return f"{task.stage.name}-{task.item}-{task.fingerprint[:16]}-{attempt}"


def _killed(task: Task) -> Receipt:
    reason = (
        f"its worker process died {ATTEMPTS} times (out of memory or a crash in native code); run "
        "this item with --workers 0 to see, or give it more memory"
    )
    return _failed(task, reason, ATTEMPTS)


def _failed(task: Task, reason: str, attempts: int) -> Receipt:
    return Receipt(
        stage=task.stage.name,
        item=task.item,
        fingerprint=task.fingerprint,
        status="failed",
        reason=" ".join(reason.split()),
        attempts=attempts,
    )
