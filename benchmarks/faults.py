"""Kill drivers, workers and schedulers at random moments, and measure what is lost.

``python -m benchmarks.faults`` runs a stage of slow items over and over, sends SIGKILL to one of
its processes at random moments and starts it again, until so many kills are done; then lets one run
end. After every kill each published item is compared with what an undisturbed run published.
`seconds_lost_percent` is work that was begun and not published, in percent of the work that was
needed; it grows with the kills a second, which are many here, so the loss a kill is beside it.
Starting again, up to the first item, is in `restart_seconds_median`. The last line
printed is one JSON object.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmarks.fault_stage import STAGE, FaultConfig, items
from express50.contract.layout import Dataset

KINDS = ("driver", "driver of workers", "worker", "scheduler")
SHARES = (0.5, 0.2, 0.2, 0.1)
PATIENCE = 120.0
LONGEST = 1.2  # seconds of work between two kills


@dataclass
class Account:
    """What was killed and what came of it."""

    kills: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))
    wrong: int = 0
    restarts: list[float] = field(default_factory=list)


def main(arguments: list[str] | None = None) -> int:
    """Kill and count."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        result = measure(Path(scratch), options.kills, random.Random(options.seed))
    print(json.dumps(result))
    return 0 if result["lost_items"] == result["wrong_bytes"] == result["last_run_exit"] == 0 else 1


def measure(scratch: Path, kills: int, rng: random.Random) -> dict:
    """Return the figures; see the module."""
    count = max(8, 4 * kills)
    calm, hurt = (make_dataset(scratch / name, count) for name in ("calm", "hurt"))
    if start(calm, scratch / "calm-notes", "--workers", "4").wait() != 0:
        raise SystemExit("the undisturbed run failed; run benchmarks.fault_stage to see why")
    expected = published(calm)
    account, notes = Account(), scratch / "notes"
    wanted = [round(share * kills) for share in SHARES]
    wanted[0] += kills - sum(wanted)
    for kind, times in zip(KINDS, wanted, strict=True):
        for _ in range(4 * times):
            if account.kills[kind] >= times:
                break
            hurt_once(kind, hurt, notes, rng, account)
            account.wrong += wrong_bytes(hurt, expected)
            check_work_is_left(hurt)
        print(f"{kind}: {account.kills[kind]} kills", file=sys.stderr, flush=True)
    ended = start(hurt, notes).wait()
    final = published(hurt)
    needed, lost = work_seconds(notes)
    account.restarts.sort()
    return {
        "kills": sum(account.kills.values()),
        "kills_by_kind": account.kills,
        "lost_items": len(set(expected) - set(final)),
        "wrong_bytes": account.wrong + wrong_bytes(hurt, expected),
        "last_run_exit": ended,
        "seconds_lost_percent": round(100 * lost / needed, 2),
        "seconds_lost_per_kill": round(lost / max(1, sum(account.kills.values())), 3),
        "seconds_an_item": FaultConfig.seconds,
        "restart_seconds_median": round(account.restarts[len(account.restarts) // 2], 2),
        "items": len(expected),
    }


def make_dataset(root: Path, count: int) -> Dataset:
    """Return a dataset of `count` small inputs."""
    (root / "in").mkdir(parents=True)
    for number in range(count):
        (root / "in" / f"item{number:04d}.txt").write_text(f"{number}")
    return Dataset(root)


def start(dataset: Dataset, notes: Path, *options: str) -> subprocess.Popen:
    """Return a driver, in a group of its own."""
    notes.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "benchmarks.fault_stage", str(dataset.root), str(notes)]
    return launch([*command, *options])


def launch(command: list[str]) -> subprocess.Popen:
    """Start a program, quietly."""
    root = str(Path(__file__).resolve().parents[1])
    return subprocess.Popen(
        command,
        cwd=root,
        env=os.environ | {"PYTHONPATH": root, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def hurt_once(
    kind: str, dataset: Dataset, notes: Path, rng: random.Random, account: Account
) -> None:
    """Start a run, kill one of its processes while it works, and see it end."""
    if kind == "scheduler":
        with_scheduler(dataset, notes, rng, account)
        return
    options = () if kind == "driver" else ("--workers", "2")
    began = time.monotonic()
    driver = start(dataset, notes, *options)
    if not at_work(driver, notes):
        return
    account.restarts += [time.monotonic() - began] if kind == "driver" else []
    time.sleep(rng.uniform(0.0, LONGEST))
    victims = [driver] if kind != "worker" else workers_of(driver)
    if victims and driver.poll() is None:
        rng.choice(victims).send_signal(signal.SIGKILL)
        account.kills[kind] += 1
    if kind == "worker":
        at_work(driver, notes)  # the driver goes on with another
    finish(driver)


def with_scheduler(dataset: Dataset, notes: Path, rng: random.Random, account: Account) -> None:
    """Do the same with a scheduler and a worker of their own, and kill the scheduler."""
    port = str(rng.randrange(20_000, 60_000))
    python = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
    scheduler = launch([*python, "--host", "127.0.0.1", "--port", port])
    address = f"tcp://127.0.0.1:{port}"
    worker = launch([sys.executable, "-m", "distributed.cli.dask_worker", address,
                     "--nthreads", "1", "--no-dashboard", "--death-timeout", "60"])  # fmt: skip
    driver = start(dataset, notes, "--scheduler", address)
    if at_work(driver, notes):
        time.sleep(rng.uniform(0.0, LONGEST))
        scheduler.send_signal(signal.SIGKILL)
        account.kills["scheduler"] += 1
        driver.wait(PATIENCE)
    for process in (driver, scheduler, worker):
        finish(process)


def at_work(driver: subprocess.Popen, notes: Path) -> bool:
    """Wait until an item is worked at; False if the run ended first."""
    before, give_up = set(notes.iterdir()), time.monotonic() + PATIENCE
    while time.monotonic() < give_up and driver.poll() is None:
        if set(notes.iterdir()) - before:
            return True
        time.sleep(0.005)
    finish(driver)
    return False


def workers_of(driver: subprocess.Popen) -> list[psutil.Process]:
    """Return processes that do a driver's work: the children of its nannies."""
    children = psutil.Process(driver.pid).children(recursive=True)
    return [one for one in children if "spawn_main" in " ".join(one.cmdline())]


def finish(process: subprocess.Popen) -> None:
    """Kill a program's whole group, and wait."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def check_work_is_left(dataset: Dataset) -> None:
    """Make sure that the next kill finds something to do."""
    names = items(dataset)
    done = sum((dataset.item_dir(STAGE.name, name) / "metrics.json").is_file() for name in names)
    if done > len(names) - 8:
        raise SystemExit(f"all but {len(names) - done} items are done before the last kill")


def published(dataset: Dataset) -> dict[str, dict[str, bytes]]:
    """Return every published item's files."""
    found = {}
    for name in items(dataset):
        folder = dataset.item_dir(STAGE.name, name)
        if folder.is_dir():
            found[name] = {path.name: path.read_bytes() for path in folder.iterdir()}
    return found


def wrong_bytes(dataset: Dataset, expected: dict[str, dict[str, bytes]]) -> int:
    """Return files that differ from those of an undisturbed run, are too many or too few."""
    count = 0
    for name, files in published(dataset).items():
        count += len(set(files.items()) ^ set(expected[name].items()))
    return count


def work_seconds(notes: Path) -> tuple[float, float]:
    """Return seconds that every item took once, and seconds of all other tries, from the notes."""
    tries: dict[str, list[tuple[bool, float]]] = {}
    for path in notes.iterdir():
        item, _, began = path.stem.split("-")
        spent = path.stat().st_mtime - 1e-9 * int(began)
        tries.setdefault(item, []).append((path.suffix == ".done", max(spent, 0.0)))
    once = sum(max(row)[1] for row in tries.values())
    return once, sum(seconds for row in tries.values() for _, seconds in row) - once


if __name__ == "__main__":
    sys.exit(main())
