"""Start workers of dask: local processes that share the GPUs, or those of a given scheduler."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from typing import Any
from urllib.parse import urlsplit

from express50.errors import StageError
from express50.runner.worker import thread_environment

GPU = "GPU"  # name of the resource; a worker offers 1 for the device that it sees
GPU_SECONDS = 60.0  # a GPU worker that died may need this long to come back
CONNECT_SECONDS = 20.0
KNOCK_SECONDS = 3.0


class LocalWorkers:
    """Processes on this machine; the first ones get one GPU each."""

    def __init__(self, count: int, threads: int) -> None:
        from distributed import Nanny

        devices = cuda_devices()
        self.count, self.gpus = count, min(count, len(devices))
        shared = {
            "nthreads": 1, "host": "127.0.0.1", "protocol": "tcp://", "dashboard": False,
            "memory_limit": 0.9 / count, "silence_logs": logging.CRITICAL,
        }  # fmt: skip
        workers: dict[int, dict] = {
            number: {"cls": Nanny, "options": dict(shared)} for number in range(count)
        }
        for number, device in enumerate(devices[:count]):
            gpu = {"env": {"CUDA_VISIBLE_DEVICES": device}, "resources": {GPU: 1}}
            workers[number]["options"] |= gpu
        self.client, self._cluster = start_cluster(workers, threads, host="127.0.0.1")

    def keep(self, tasks: int) -> None:
        """Do nothing: nannies replace workers that died."""

    def slots(self, stage: str, gpu: bool) -> int:
        """Return how many tasks may run at once; StageError if the stage lacks the GPU it needs."""
        if gpu and not self.gpus:
            raise no_gpu(stage, "nvidia-smi lists none on this machine")
        return self.gpus if gpu else self.count

    def close(self) -> None:
        """Stop them."""
        close_within(5, self.client)
        close_within(10, self._cluster)


class RemoteWorkers:
    """Workers of a scheduler that the user started."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self._gpu_seen: float | None = None

    @classmethod
    def reach(cls, address: str) -> RemoteWorkers:
        """Connect to a scheduler that runs; StageError if there is none."""
        from distributed import Client

        # It logs a lost scheduler with tracebacks; the pool says it in one line.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        try:
            parts = urlsplit(address if "://" in address else f"tcp://{address}")
            if parts.hostname is None or parts.port is None:
                raise ValueError("it has no port")
            # Without an answer, dask itself would try for half a minute.
            if parts.scheme in ("tcp", "tls"):
                socket.create_connection((parts.hostname, parts.port), KNOCK_SECONDS).close()
            client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
            threads = client.nthreads().values()
        except (OSError, TimeoutError, ValueError, MemoryError) as error:  # of another server, too
            raise StageError(
                f"scheduler {address}: cannot connect ({error}); expected the address of a running"
                " dask scheduler, such as tcp://host:8786"
            ) from error
        if not threads:
            sys.stderr.write(f"scheduler {address} has no workers yet; waiting\n")
        elif max(threads) > 1:
            sys.stderr.write(
                f"scheduler {address}: a worker has {max(threads)} threads, so items share a"
                " process and each receipt counts the time and memory of all of them; start workers"
                " with --nthreads 1\n"
            )
        return cls(client)

    def keep(self, tasks: int) -> None:
        """Do nothing, because the user manages these workers."""

    def slots(self, stage: str, gpu: bool) -> int:
        """Return the number of tasks that may run at once; 1 while there are no workers yet.

        Raises:
            StageError: the stage needs a GPU and no worker offers one, nor has for a minute.
        """
        if not gpu:
            return max(1, sum(self.client.nthreads().values()))
        table = self.table()
        offered = sum(int(worker["resources"].get(GPU, 0)) for worker in table)
        now = time.monotonic()
        if offered:
            self._gpu_seen = now
        elif table and (self._gpu_seen is None or now - self._gpu_seen > GPU_SECONDS):
            words = f"none of the scheduler's {len(table)} workers offers one; start some with"
            raise no_gpu(stage, f"{words} 'dask worker --resources GPU=1'")
        return max(1, offered)

    def table(self) -> list[dict]:
        """Return what the scheduler knows of each worker."""
        return list(self.client.scheduler_info(n_workers=-1)["workers"].values())

    def close(self) -> None:
        """Disconnect from the scheduler."""
        close_within(5, self.client)


@contextmanager
def holding_interrupts() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM back until the end; processes begun meanwhile never see Ctrl-C.

    Stopped while workers start, dask would print tracebacks. Processes inherit that Ctrl-C is
    blocked; here it could still reach another thread, so handlers note it.
    """
    received: list[int] = []
    main = threading.current_thread() is threading.main_thread()  # only it may set handlers
    held = (signal.SIGINT, signal.SIGTERM) if main else ()
    former = {number: signal.signal(number, lambda n, _: received.append(n)) for number in held}
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)  # hands over what is pending
        for number, handler in former.items():
            signal.signal(number, handler)
        for one in received:
            signal.raise_signal(one)


def close_within(seconds: float, part: Any) -> None:
    """Close a client or cluster; one that a busy machine closes more slowly ends with the run."""
    with suppress(TimeoutError):
        part.close(timeout=seconds)


def no_gpu(stage: str, words: str) -> StageError:
    """Return the error of a stage that needs a GPU when there is none."""
    return StageError(f"{stage} needs a GPU as it is configured, and {words}")


def start_cluster(workers: dict[int, dict], threads: int, **scheduler: object) -> tuple[Any, Any]:
    """Start a scheduler with local workers, if any; returns its client and the cluster."""
    import dask
    from distributed import Client, Scheduler, SpecCluster

    settings = {
        "distributed.scheduler.allowed-failures": 0,
        # A stage may hold the interpreter for minutes in native code; that is not death.
        "distributed.scheduler.worker-ttl": None,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.nanny.pre-spawn-environ": thread_environment(threads),
    }
    options = {"dashboard": False, "dashboard_address": ":0", "port": 0, "protocol": "tcp://"}
    _start_tracker()  # before: its start lets interrupts through again
    # A terminal sends Ctrl-C to workers, too; the driver stops them in order.
    with holding_interrupts(), dask.config.set(settings):
        cluster = SpecCluster(
            workers=workers,
            scheduler={"cls": Scheduler, "options": options | scheduler},
            silence_logs=logging.CRITICAL,
        )
        return Client(cluster, set_as_default=False), cluster


def _start_tracker() -> None:
    """Start the process that frees semaphores; after a kill it must not warn that it frees them."""
    name, quiet = "PYTHONWARNINGS", "ignore:resource_tracker:UserWarning"
    former = os.environ.get(name)
    os.environ[name] = f"{former},{quiet}" if former else quiet
    try:
        resource_tracker.ensure_running()
    finally:
        if former is None:
            del os.environ[name]
        else:
            os.environ[name] = former


def cuda_devices() -> list[str]:
    """List this machine's CUDA devices as ``CUDA_VISIBLE_DEVICES`` takes them.

    The driver's own program is asked: torch takes seconds to import.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if shutil.which("nvidia-smi") is None:
        return []
    if visible is not None:
        return [name.strip() for name in visible.split(",") if name.strip() not in ("", "-1")]
    try:
        listing = subprocess.run(
            ["nvidia-smi", "-L"], capture_output=True, text=True, timeout=60, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):  # a driver that does not answer has no device
        return []
    return [str(n) for n, _ in enumerate(x for x in listing.splitlines() if x.startswith("GPU "))]
