"""Start a run, inject one fault and check the result: a case of `benchmarks.faults`."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmarks.fault_stage import STAGE, expected, items, write_inputs
from express50.contract.layout import Dataset
from express50.dataset.audit import audit

PATIENCE = 120.0  # seconds
LONGEST = 1.2  # seconds of work between two kills
ITEMS = 14
SMALL_DISK = 112  # MB; a run counts a disk with less than 100 MB left as full


@dataclass
class Case:
    """One dataset that is hurt, and what came of it."""

    seed: int
    scratch: Path
    chain: Path
    rng: random.Random
    faults: Counter[str] = field(default_factory=Counter)
    lost: int = 0
    wrong: int = 0
    needed: float = 0.0
    wasted: float = 0.0
    restarts: list[float] = field(default_factory=list)

    @property
    def notes(self) -> Path:
        """Return the folder of the times of the work."""
        return self.scratch / "notes"


def make_dataset(case: Case, name: str = "data") -> Dataset:
    """Make a dataset of a few small inputs, and the folder of notes."""
    dataset = write_inputs(case.scratch / name, ITEMS)
    case.notes.mkdir()
    return dataset


@contextlib.contextmanager
def small_disk(case: Case) -> Iterator[bool]:
    """Mount a small disk; yields False where that is not allowed."""
    place = case.scratch / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={SMALL_DISK}m", "tmpfs", str(place)]
    mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(place)], check=True)


def environment(**variables: str) -> dict[str, str]:
    """Return the variables of a program that is started here."""
    root = str(Path(__file__).resolve().parents[1])
    return os.environ | {"PYTHONPATH": root, "OMP_NUM_THREADS": "1"} | variables


def start(case: Case, dataset: Dataset, *options: str, **variables: str) -> subprocess.Popen:
    """Start a driver, in a group of its own."""
    command = [sys.executable, "-m", "benchmarks.fault_stage", str(dataset.root), str(case.notes)]
    return launch([*command, *options], **variables)


def launch(command: list[str], **variables: str) -> subprocess.Popen:
    """Start a program, quietly."""
    return subprocess.Popen(
        command,
        cwd=Path(__file__).resolve().parents[1],
        env=environment(**variables),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def at_work(case: Case, driver: subprocess.Popen) -> bool:
    """Wait until an item is worked at; False if the run ended first."""
    before, give_up = set(case.notes.iterdir()), time.monotonic() + PATIENCE
    while time.monotonic() < give_up and driver.poll() is None:
        if set(case.notes.iterdir()) - before:
            return True
        time.sleep(0.005)
    finish(driver)
    return False


def strike(case: Case, victims: list[psutil.Process] | list[subprocess.Popen], kind: str) -> None:
    """Kill one of some processes at a random moment."""
    time.sleep(case.rng.uniform(0.0, LONGEST))
    victim = case.rng.choice(victims) if victims else None
    if victim is None or (isinstance(victim, subprocess.Popen) and victim.poll() is not None):
        return
    with contextlib.suppress(psutil.NoSuchProcess):
        victim.send_signal(signal.SIGKILL)
        victim.wait()
        case.faults[f"kill of {kind}"] += 1


def workers_of(driver: subprocess.Popen) -> list[psutil.Process]:
    """Return the processes that do a driver's work: the children of its nannies."""
    found = []
    with contextlib.suppress(psutil.NoSuchProcess):
        for one in psutil.Process(driver.pid).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                found += [one] if "spawn_main" in " ".join(one.cmdline()) else []
    return found


def finish(process: subprocess.Popen) -> None:
    """Kill a program's whole group, and wait."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def complete(case: Case, dataset: Dataset, **variables: str) -> None:
    """Run a stage to its end: then nothing is missing, wrong or left over."""
    driver = start(case, dataset, **variables)
    give_up = time.monotonic() + PATIENCE
    while (code := driver.wait(PATIENCE)) == 2 and time.monotonic() < give_up:
        time.sleep(0.2)  # a worker of a killed driver may hold the lock for a moment
        driver = start(case, dataset, **variables)
    assert code == 0, f"the last run ended with {code}"
    case.lost += len(set(expected(dataset)) - {i for i in items(dataset) if folder_of(dataset, i)})
    compare(case, dataset)
    found = audit(dataset, [STAGE], deep=True).findings
    assert not found, f"after the last run: {found[0]}"


def compare(case: Case, dataset: Dataset) -> None:
    """Count files that differ from what they must be, are too many or too few."""
    for name, files in expected(dataset).items():
        there = {path.name: path.read_bytes() for path in folder_of(dataset, name)}
        if dataset.item_dir(STAGE.name, name).exists():
            case.wrong += len(set(files.items()) ^ set(there.items()))


def folder_of(dataset: Dataset, item: str) -> list[Path]:
    """Return the published files of an item."""
    return sorted(dataset.item_dir(STAGE.name, item).glob("*"))


def work_seconds(notes: Path) -> tuple[float, float]:
    """Return seconds that every item took once, and seconds of all other tries, from the notes."""
    tries: dict[str, list[tuple[bool, float]]] = {}
    for path in notes.iterdir():
        item, _, began = path.stem.split("-")
        spent = path.stat().st_mtime - 1e-9 * int(began)
        tries.setdefault(item, []).append((path.suffix == ".done", max(spent, 0.0)))
    once = sum(max(row)[1] for row in tries.values())
    return once, sum(seconds for row in tries.values() for _, seconds in row) - once
