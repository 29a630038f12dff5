"""Who gets a GPU: one item at a time on each, and a clear word where there is none."""

import dataclasses
import os
import signal
import subprocess
import sys
import time

import pytest

from express50.errors import StageError
from express50.runner import clusters
from express50.runner.clusters import LocalWorkers, RemoteWorkers, cuda_devices, holding_interrupts
from express50.runner.executor import Pool
from express50.runner.runner import run_stage
from express50.runner.slurm import SlurmJob
from pipelines import matte, regions
from tests.faults import toy


def always(config):
    return True


GREEDY = dataclasses.replace(toy.STAGE, needs_gpu=always)


@pytest.fixture
def devices(tmp_path, monkeypatch):
    """A stand-in for nvidia-smi that lists so many devices."""

    def make(count):
        (tmp_path / "bin").mkdir()
        program = tmp_path / "bin" / "nvidia-smi"
        lines = "".join(f"echo 'GPU {n}: H100'; echo '  MIG 1g'\n" for n in range(count))
        program.write_text(f"#!/bin/sh\n{lines}")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)

    return make


def seen_and_when(seconds):
    began = time.time()
    time.sleep(seconds)
    return os.environ.get("CUDA_VISIBLE_DEVICES"), began, time.time()


def test_devices_are_those_that_the_driver_lists_and_the_environment_leaves(devices, monkeypatch):
    devices(3)
    assert cuda_devices() == ["0", "1", "2"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, GPU-7a")
    assert cuda_devices() == ["2", "GPU-7a"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")
    assert cuda_devices() == []


def test_workers_that_a_busy_machine_stops_slowly_do_not_fail_the_run():
    class Slow:
        def close(self, timeout):
            raise TimeoutError(f"timed out after {timeout} s.")

    workers = object.__new__(LocalWorkers)
    workers.client = workers._cluster = Slow()
    workers.close()


def blocked_signals():
    return signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_workers_never_see_the_interrupt_that_a_terminal_sends_to_all():
    """Not even while they start: each would print a traceback."""
    workers = LocalWorkers(2, threads=1)
    try:
        assert all(
            signal.SIGINT in blocked for blocked in workers.client.run(blocked_signals).values()
        )
    finally:
        workers.close()
    assert signal.SIGINT not in blocked_signals()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_while_workers_start_comes_after_their_start(number):
    started = False
    former = signal.signal(number, signal.default_int_handler)  # others may have changed it
    try:
        with pytest.raises(KeyboardInterrupt), holding_interrupts():
            os.kill(os.getpid(), number)
            started = True
    finally:
        signal.signal(number, former)
    assert started


def test_one_item_at_a_time_on_each_device(devices):
    devices(1)
    workers = LocalWorkers(2, threads=1)
    try:
        assert (workers.slots("toy", gpu=True), workers.slots("toy", gpu=False)) == (1, 2)
        tasks = [
            workers.client.submit(seen_and_when, 0.05, pure=False, resources={"GPU": 1})
            for _ in range(4)
        ]
        found = sorted(workers.client.gather(tasks), key=lambda one: one[1])
    finally:
        workers.close()
    assert {visible for visible, *_ in found} == {"0"}
    assert all(a[2] <= b[1] for a, b in zip(found, found[1:], strict=False))


def test_no_device_on_this_machine_is_one_error(tmp_path, devices):
    devices(0)
    dataset = toy.make_dataset(tmp_path / "data", ["a", "b"])
    with (
        Pool(2) as pool,
        pytest.raises(StageError, match="toy needs a GPU .* nvidia-smi lists none"),
    ):
        run_stage(GREEDY, dataset, toy.ToyConfig(), pool=pool, progress=False)


def test_item_without_cuda_is_refused_rather_than_done_on_the_processor(tmp_path, monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    dataset = toy.make_dataset(tmp_path / "data", ["a"])
    (outcome,) = run_stage(GREEDY, dataset, toy.ToyConfig(), pool=Pool(0), progress=False).outcomes
    assert "torch finds no CUDA device here" in outcome.reason


class Scheduler:
    """A client as far as the question is who offers what."""

    def __init__(self):
        self.workers = {}

    def scheduler_info(self, n_workers):
        return {"workers": dict(enumerate(self.workers))}

    def nthreads(self):
        return {"a": 2, "b": 3}


def test_a_scheduler_without_a_gpu_is_an_error_and_one_that_lost_it_is_waited_for(monkeypatch):
    plain, offering = {"resources": {}}, {"resources": {"GPU": 1.0}}
    client = Scheduler()
    workers = RemoteWorkers(client)
    assert workers.slots("toy", gpu=False) == 5
    client.workers = []
    assert workers.slots("toy", gpu=True) == 1  # nobody is there yet
    client.workers = [plain, plain]
    with pytest.raises(StageError, match="none of the scheduler's 2 workers offers one"):
        workers.slots("toy", gpu=True)
    client.workers = [plain, offering, offering]
    assert workers.slots("toy", gpu=True) == 2
    client.workers = [plain]  # its nanny starts it again
    assert workers.slots("toy", gpu=True) == 1
    monkeypatch.setattr(clusters, "GPU_SECONDS", -1.0)
    with pytest.raises(StageError, match="none of the scheduler's 1 workers"):
        workers.slots("toy", gpu=True)


def test_jobs_without_a_gpu_are_refused_before_the_first_is_submitted(tmp_path, monkeypatch):
    submitted = tmp_path / "submitted"
    program = tmp_path / "sbatch"
    program.write_text(f"#!/bin/sh\ntouch {submitted}; echo 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    dataset = toy.make_dataset(tmp_path / "data", ["a"])
    job = SlurmJob(time="10", memory="1G", interface="lo")
    with (
        Pool(slurm={"toy": job}) as jobs,
        pytest.raises(StageError, match=r"toy needs a GPU .*add gpus=1, or a table \[toy\]"),
    ):
        run_stage(GREEDY, dataset, toy.ToyConfig(), pool=jobs, progress=False)
    assert not submitted.exists()


@pytest.mark.parametrize(
    ("stage", "without", "more"),
    [
        (matte.STAGE, {"method": "salient", "weights": "x.pt"}, {"device": "cuda"}),
        (regions.STAGE, {"segmentation": "x.pt"}, {"device": "cuda"}),
        (regions.STAGE, {"device": "cuda"}, {"segmentation": "x.pt"}),
    ],
)
def test_a_configuration_that_asks_for_cuda_needs_it(stage, without, more):
    assert not stage.needs_gpu(stage.config(**without))
    assert stage.needs_gpu(stage.config(**without | more))


@pytest.mark.parametrize("threads", [1, 2])
def test_workers_of_several_threads_are_warned_about(threads, capsys):
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=threads, processes=False, dashboard_address=None,
        protocol="tcp://",
    ) as cluster:  # fmt: skip
        RemoteWorkers.reach(cluster.scheduler_address).close()
    assert ("a worker has 2 threads" in capsys.readouterr().err) == (threads == 2)


def test_a_killed_run_leaves_no_warning_of_semaphores():
    code = (
        "import multiprocessing, os\n"
        "from express50.runner.clusters import _start_tracker\n"
        "_start_tracker()\n"
        "held = multiprocessing.get_context('spawn').Semaphore()\n"
        "os.kill(os.getpid(), 9)\n"
    )
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (killed.returncode, killed.stderr) == (-9, "")
