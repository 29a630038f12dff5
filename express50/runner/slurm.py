"""Start workers as SLURM jobs: their requests, their script, and the jobs of a run.

dask-jobqueue writes the script. Jobs are submitted and watched here, because its own cluster
ignores an ``sbatch`` that refuses, and jobs of several workers that have ended.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from express50.console import count
from express50.contract.config import build_dataclass
from express50.errors import ConfigError, StageError, nearest
from express50.files.text import read_toml
from express50.runner.clusters import GPU, RemoteWorkers, close_within, no_gpu, start_cluster
from express50.runner.worker import thread_environment

QUEUE_SECONDS = 10.0  # between two looks at the queue
SILENT_JOBS = 3  # jobs in a row that end before their worker is seen, until the run gives up
ALONE_SECONDS = 60  # a worker that cannot reach its scheduler for this long ends its job

TIME = re.compile(r"\d+(:\d\d){0,2}|\d+-\d+(:\d\d){0,2}")
MEMORY = re.compile(r"(\d+)([MGT])(i?B)?")
# Wrappers of sbatch may print more lines, or ignore --parsable.
SUBMITTED = re.compile(r"^(?:Submitted batch job )?(\d+)(?:;.*)?$", re.MULTILINE)


@dataclass(frozen=True, kw_only=True)
class SlurmJob:
    """The resources that each job of a stage asks SLURM for."""

    time: str
    """Time limit in SLURM's forms, such as 4:00:00 or 1-12:00:00."""
    memory: str
    """Memory of a job, such as 16G (units of 1024, as in SLURM)."""
    cores: int = 1
    """Cores of a job. It works on cores / --threads items at a time, or on one with a GPU."""
    jobs: int = 4
    """Most jobs at a time."""
    gpus: int = 0
    """1 for a GPU per job."""
    partition: str = ""
    """Partition; SLURM's default when empty."""
    account: str = ""
    """Account that is charged."""
    interface: str = ""
    """Network interface between workers and this machine, such as ib0."""
    options: tuple[str, ...] = ()
    """Further options of sbatch, such as "--qos=long"."""
    setup: tuple[str, ...] = ()
    """Lines of shell before the worker starts, such as "module load cuda"."""

    def __post_init__(self) -> None:
        """Check forms and ranges."""
        if not TIME.fullmatch(self.time):
            raise ValueError(f"time is {self.time!r}, expected a time like 4:00:00 or 1-12:00:00")
        if not MEMORY.fullmatch(self.memory):
            raise ValueError(f"memory is {self.memory!r}, expected a size like 16G")
        if self.cores < 1 or self.jobs < 1:
            raise ValueError(f"cores {self.cores}, jobs {self.jobs}: expected at least 1")
        if self.gpus not in (0, 1):
            raise ValueError(f"gpus is {self.gpus}, expected 0 or 1; ask for more jobs instead")
        for text in (self.partition, self.account, self.interface, *self.options, *self.setup):
            if "\n" in text:
                raise ValueError(f"{text!r} has a line break")

    def processes(self, threads: int) -> int:
        """Return the number of workers of a job, each with ``threads`` threads."""
        return 1 if self.gpus else max(1, self.cores // threads)


def read_slurm(text: str, stages: Iterable[str]) -> dict[str, SlurmJob]:
    """Read what the jobs of every stage ask for: ``key=value,...``, or a TOML file of such keys.

    In the file, a table named after one of the ``stages`` replaces some for that stage.

    Raises:
        ConfigError: no such file, unknown keys, wrong values, or time or memory are missing.
    """
    names = list(stages)
    if text.endswith(".toml"):
        values = read_toml(Path(text), ConfigError)
    else:
        values = dict[str, Any]()
        for part in text.split(","):
            key, equals, value = (word.strip() for word in part.partition("="))
            if not equals or not key:
                raise ConfigError(f"--slurm: {part!r} is not key=value; use a file for lists")
            whole = key in ("cores", "jobs", "gpus") and value.isdigit()
            values[key] = int(value) if whole else value
    tables = {key: value for key, value in values.items() if isinstance(value, dict)}
    common = {key: value for key, value in values.items() if key not in tables}
    for name in tables:
        if name not in names:
            raise ConfigError(f"--slurm {text}: unknown table [{name}]{nearest(name, names)}")
    hint = f"; expected one of {', '.join(field.name for field in fields(SlurmJob))}"
    jobs = {}
    for name in names:
        merged = common | tables.get(name, {})
        missing = [key for key in ("time", "memory") if key not in merged]
        if missing:
            raise ConfigError(
                f"--slurm {text}: no {' and no '.join(missing)}; expected something like "
                "partition=cpu,time=4:00:00,memory=16G,cores=4,jobs=8, or a file jobs.toml of these"
            )
        jobs[name] = build_dataclass("slurm", SlurmJob, merged, hint=hint)
    return jobs


def check_slurm(submit: bool = True) -> None:
    """Raise StageError unless jobs can be written and submitted from here."""
    if find_spec("dask_jobqueue") is None:
        raise StageError(
            "--slurm needs dask-jobqueue, which is not installed; run "
            "pip install 'express50[slurm]'"
        )
    if submit and shutil.which("sbatch") is None:
        raise StageError(
            "--slurm: there is no sbatch on PATH; run this where jobs are submitted, on a login "
            "node, or use --workers"
        )


def job_script(job: SlurmJob, address: str, name: str, threads: int, logs: Path) -> str:
    """Write the script of one job, whose workers have a name and report to a scheduler's address.

    An item may use ``threads`` threads; the job's output goes to the folder ``logs``.
    """
    interrupted = signal.getsignal(signal.SIGINT)
    from dask_jobqueue.slurm import SLURMJob

    if signal.getsignal(signal.SIGINT) is not interrupted:
        signal.signal(signal.SIGINT, interrupted)  # the import made Ctrl-C end with exit code 0
    processes = job.processes(threads)
    environment = thread_environment(threads)
    if "PYTHONPATH" in os.environ:
        environment["PYTHONPATH"] = os.environ["PYTHONPATH"]
    exports = [f"export {name}={shlex.quote(value)}" for name, value in environment.items()]
    size, unit = MEMORY.fullmatch(job.memory).groups()[:2]  # type: ignore[union-attr]
    # Relative paths of a configuration are those of the folder that the run was started in.
    folder, output = shlex.quote(str(Path.cwd())), shlex.quote(str(logs / "%j.out"))
    directives = [f"--chdir={folder}", f"--output={output}"]
    return SLURMJob(
        scheduler=address,
        name=name,
        job_name="express50",
        queue=job.partition or None,
        account=job.account or None,
        walltime=job.time,
        cores=processes,  # to dask: one item at a time and process, whatever threads it uses
        job_cpu=job.cores,
        memory=f"{size}{unit}iB",
        job_mem=size + unit,
        processes=processes,
        interface=job.interface or None,
        death_timeout=ALONE_SECONDS,
        python=shlex.quote(sys.executable),
        job_extra_directives=[*directives, *["--gres=gpu:1"] * job.gpus, *job.options],
        job_script_prologue=[*exports, *job.setup],
        worker_extra_args=["--no-dashboard", *(["--resources", f"{GPU}=1"] if job.gpus else [])],
    ).job_script()


def check_job_gpu(job: SlurmJob, stage: str) -> None:
    """Raise StageError if a stage that needs a GPU would run in jobs without one."""
    if not job.gpus:
        raise no_gpu(stage, f"--slurm asks for none; add gpus=1, or a table [{stage}] with it")


class SlurmWorkers(RemoteWorkers):
    """A scheduler here and the jobs that work for it; one that has ended is replaced."""

    def __init__(self, job: SlurmJob, threads: int, logs: Path) -> None:
        check_slurm()
        client, self._cluster = start_cluster({}, threads, interface=job.interface or None)
        super().__init__(client)
        self.job, self.threads, self.logs = job, threads, logs
        self._names: dict[str, str] = {}  # of workers, by id of the job
        self._seen: set[str] = set()
        self._count = self._silent = 0
        self._refusal = ""  # what sbatch last said
        self._next_look = 0.0

    def slots(self, stage: str, gpu: bool) -> int:
        """Return the number of tasks that may run at once; 1 before the first worker is there."""
        if gpu:
            check_job_gpu(self.job, stage)
        return super().slots(stage, gpu)

    def keep(self, tasks: int) -> None:
        """Submit the jobs that this many unfinished tasks need; looks at the queue seldom.

        Raises:
            StageError: ``sbatch`` refuses and no job is left, or job after job ends at once.
        """
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + QUEUE_SECONDS
        here = {str(worker["name"]) for worker in self.table()}
        here |= {name.rpartition("-")[0] for name in here}  # dask numbers the workers of one job
        self._seen |= {number for number, name in self._names.items() if name in here}
        queue = _call("squeue", "--noheader", "--format=%A", f"--user={os.getuid()}")
        there = queue.stdout.split() if queue.returncode == 0 else self._names  # else no answer
        for number in sorted(set(self._names) - set(there)):
            del self._names[number]
            self._silent = 0 if number in self._seen else self._silent + 1
            if self._silent >= SILENT_JOBS:
                raise StageError(
                    f"{SILENT_JOBS} SLURM jobs in a row ended before their workers reached "
                    f"this machine; {self.logs / f'{number}.out'} may say why, --print-job "
                    "shows their script"
                )
        processes = self.job.processes(self.threads)
        while len(self._names) < min(self.job.jobs, -(-tasks // processes)):
            try:
                self._submit()
            except StageError as error:
                if not self._names:
                    raise
                if str(error) != self._refusal:  # it may refuse at every look, for hours
                    jobs = count(len(self._names), "job")
                    sys.stderr.write(f"{error}; continuing with {jobs}\n")
                self._refusal = str(error)
                return
            if self._count == 1:
                sys.stderr.write(f"SLURM jobs are submitted; their output is in {self.logs}\n")

    def _submit(self) -> None:
        name = f"express50-{os.getpid()}-{self._count}"
        self._count += 1
        address = self._cluster.scheduler_address
        script = job_script(self.job, address, name, self.threads, self.logs)
        self.logs.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", suffix=".sh") as file:
            file.write(script)
            file.flush()
            done = _call("sbatch", "--parsable", file.name)
        words = " ".join((done.stderr or done.stdout).split())
        if done.returncode != 0:
            raise StageError(f"sbatch refused: {words or f'exit code {done.returncode}'}")
        numbers = SUBMITTED.findall(done.stdout)
        if not numbers:
            raise StageError(f"sbatch printed {words!r}, expected a line with the job's number")
        self._names[numbers[-1]] = name

    def close(self) -> None:
        """Cancel the jobs that are left, and stop."""
        if self._names:
            _call("scancel", *sorted(self._names))
        self._names.clear()
        super().close()
        close_within(10, self._cluster)


def _call(*command: str) -> subprocess.CompletedProcess:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return subprocess.CompletedProcess(command, 1, "", f"{command[0]}: {error}")
