"""Hurt runs in every way that we know, at random moments, and measure what is lost.

``python -m benchmarks.faults --hours 1`` runs one case after the other until the time is over. A
case makes a dataset, runs a stage of slow items on it, hurts it, and runs it again until it is
whole; then every byte is compared with what it must be, and `express50.dataset.audit` must find no
fault. In a longer storm every third case kills a real stage, or a training, on a small recording,
which takes some minutes to make. Each case has a number, which is the seed of all that is random in
it: ``--seed N`` runs one again. With ``--folder`` a stopped storm goes on. `seconds_lost_per_kill`
is work that was begun and not published; starting again, up to the first item, is in
`restart_seconds_median`. The last line printed is one JSON object.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmarks.fault_stage import HUNGER, STAGE, FaultConfig, expected, items
from express50.contract.layout import Dataset
from express50.dataset.audit import audit
from express50.errors import Express50Error

PATIENCE = 120.0
LONGEST = 1.2  # seconds of work between two kills
ITEMS, KILLS = 14, 3  # of one case
SMALL_DISK = 112  # MB; a run counts a disk with less than 100 MB left as full
CHAIN = (
    "ingest", "calibrate", "observe", "align", "frames", "matte", "track", "depth", "register",
    "regions", "encode", "pack", "train",
)  # fmt: skip
RECORDING = (
    "--subjects=2", "--cameras=5", "--give-calibration", "--width=160", "--height=160",
    "--frames-per-expression=4", "--expressions=neutral,smile", "--seed=3",
)  # fmt: skip
SIZE = ("--set", "encode.size=64")
SETTINGS = {"encode": SIZE, "pack": (*SIZE, "--set", 'pack.test_subjects=["S002"]')}
RECORDING_SECONDS = 600.0  # a storm that is shorter leaves the real stages out
ITERATIONS = 12


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


def main(arguments: list[str] | None = None) -> int:
    """Hurt and count."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=__doc__)
    parser.add_argument("--hours", type=float, default=1 / 60, help="how long (a minute)")
    parser.add_argument("--seed", type=int, help="run this case alone")
    parser.add_argument("--folder", type=Path, help="keep cases here, and go on with them")
    options = parser.parse_args(arguments)
    with contextlib.ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        result = storm(folder.resolve(), options.seed, time.monotonic() + 3600 * options.hours)
    print(json.dumps(result))
    return 1 if result["lost_items"] or result["wrong_bytes"] or result["failed"] else 0


def storm(folder: Path, seed: int | None, until: float) -> dict:
    """Run cases until the time is over, and return the figures of all that the folder has."""
    log = folder / "cases.jsonl"
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    done = {row["seed"] for row in rows}
    short = until - time.monotonic() < RECORDING_SECONDS
    for number in itertools.count() if seed is None else [seed]:
        if seed is None and (number in done or (short and kind_of(number) == "stage")):
            continue
        if seed is None and time.monotonic() > until:
            break
        row = run_case(folder, number)
        rows = [one for one in rows if one["seed"] != number] + [row]
        with log.open("a") as file:
            file.write(json.dumps(row) + "\n")
    return figures([row for row in rows if seed in (None, row["seed"])])


def kind_of(number: int) -> str:
    """Return what a case does."""
    return ORDER[number % len(ORDER)]


def run_case(folder: Path, number: int) -> dict:
    """Run one case; what is wrong with it is printed with its seed."""
    kind = kind_of(number)
    scratch, error = folder / f"case{number}", ""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    case = Case(number, scratch, folder / "chain", random.Random(number))
    try:
        KINDS[kind](case)
    except (AssertionError, Express50Error, OSError, subprocess.SubprocessError) as trouble:
        error = f"{type(trouble).__name__}: {trouble}"
    if case.notes.is_dir():
        case.needed, case.wasted = work_seconds(case.notes)
    bad = bool(case.lost or case.wrong or error)
    words = f"lost {case.lost}, wrong {case.wrong} {error}: run it again with --seed {number}"
    print(f"{number} {kind}: {words if bad else 'sound'}", file=sys.stderr, flush=True)
    if not bad:
        shutil.rmtree(scratch)
    names = ("seed", "lost", "wrong", "needed", "wasted", "restarts")
    values = {name: getattr(case, name) for name in names}
    return values | {"kind": kind, "faults": dict(case.faults), "error": error}


def figures(rows: list[dict]) -> dict:
    """Sum the cases up."""
    kinds: Counter[str] = Counter()
    for row in rows:
        kinds.update(row["faults"])
    kills = sum(sum(row["faults"].values()) for row in rows if row["kind"] in KILLED)
    wasted = sum(row["wasted"] for row in rows if row["kind"] in KILLED)
    restarts = sorted(itertools.chain.from_iterable(row["restarts"] for row in rows))
    return {
        "cases": len(rows),
        "faults": sum(kinds.values()),
        "faults_by_kind": dict(sorted(kinds.items())),
        "lost_items": sum(row["lost"] for row in rows),
        "wrong_bytes": sum(row["wrong"] for row in rows),
        "failed": [row["seed"] for row in rows if row["error"] or row["lost"] or row["wrong"]],
        "kills_of_slow_items": kills,
        "seconds_lost_per_kill": round(wasted / kills, 3) if kills else None,
        "seconds_per_item": FaultConfig.seconds,
        "restart_seconds_median": round(restarts[len(restarts) // 2], 2) if restarts else None,
    }


# Cases


def kill_driver(case: Case) -> None:
    """Kill a driver that does the work itself."""
    dataset = make_dataset(case)
    for _ in range(KILLS):
        began = time.monotonic()
        driver = start(case, dataset)
        if at_work(case, driver):
            case.restarts.append(time.monotonic() - began)
            strike(case, [driver], "driver")
        finish(driver)
        compare(case, dataset)
    complete(case, dataset)


def kill_driver_of_workers(case: Case) -> None:
    """Kill a driver whose workers live on for a moment, in which the next run begins."""
    dataset = make_dataset(case)
    drivers = []
    for _ in range(KILLS):
        drivers.append(start(case, dataset, "--workers", "2"))
        if at_work(case, drivers[-1]):
            strike(case, drivers[-1:], "driver of workers")
        compare(case, dataset)
    complete(case, dataset)
    for driver in drivers:
        finish(driver)
    compare(case, dataset)


def kill_worker(case: Case) -> None:
    """Kill workers; the driver goes on with others."""
    dataset = make_dataset(case)
    driver = start(case, dataset, "--workers", "2")
    for _ in range(KILLS):
        if at_work(case, driver):
            strike(case, workers_of(driver), "worker")
            compare(case, dataset)
    assert driver.wait(PATIENCE) in (0, 1), "the driver did not survive its worker"
    complete(case, dataset)


def kill_scheduler(case: Case) -> None:
    """Kill a scheduler; its worker may live on."""
    dataset = make_dataset(case)
    port = str(case.rng.randrange(20_000, 60_000))
    python = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
    scheduler = launch([*python, "--host", "127.0.0.1", "--port", port])
    address = f"tcp://127.0.0.1:{port}"
    worker = launch([sys.executable, "-m", "distributed.cli.dask_worker", address,
                     "--nthreads", "1", "--no-dashboard", "--death-timeout", "60"])  # fmt: skip
    driver = start(case, dataset, "--scheduler", address)
    if at_work(case, driver):
        strike(case, [scheduler], "scheduler")
        assert driver.wait(PATIENCE) == 2, "the driver did not say that its scheduler is gone"
    compare(case, dataset)
    complete(case, dataset)
    for process in (driver, scheduler, worker):
        finish(process)
    compare(case, dataset)


def out_of_memory(case: Case) -> None:
    """Kill the worker that has most memory, as the kernel does; its item is tried again."""
    dataset = make_dataset(case)
    hungry = case.rng.choice(items(dataset))
    driver = start(case, dataset, "--workers", "2", FAULT_HUNGRY=hungry)
    give_up = time.monotonic() + PATIENCE
    while time.monotonic() < give_up and driver.poll() is None:
        sizes = {}
        for worker in workers_of(driver):
            with contextlib.suppress(psutil.NoSuchProcess):
                sizes[worker] = worker.memory_info().rss
        largest = max(sizes, key=lambda worker: sizes[worker], default=None)
        if largest and sizes[largest] > min(sizes.values()) + 0.8 * HUNGER:
            largest.kill()
            case.faults["out of memory"] += 1
            break
        time.sleep(0.02)
    assert driver.wait(PATIENCE) == 0, "an item was not tried again after its worker's death"
    complete(case, dataset)


def full_disk(case: Case) -> None:
    """Fill the disk while an item is in work; nothing is lost, and the rest follows later."""
    with small_disk(case) as mounted:
        dataset = make_dataset(case, "disk/data" if mounted else "data")
        last = case.rng.choice(items(dataset)) if not mounted else ""
        options = ("--workers", case.rng.choice("02"))
        driver = start(case, dataset, *options, FAULT_FULL=last)
        if at_work(case, driver) and mounted:
            time.sleep(case.rng.uniform(0.0, LONGEST))
            with contextlib.suppress(OSError), (case.scratch / "disk/filler").open("wb") as file:
                while True:
                    file.write(bytes(1 << 16))
                    file.flush()
        assert driver.wait(PATIENCE) in (0, 2), "a full disk did not stop the run"
        case.faults["full disk"] += driver.returncode == 2
        finish(driver)
        compare(case, dataset)
        (case.scratch / "disk/filler").unlink(missing_ok=True)
        complete(case, dataset)


def torn_write(case: Case) -> None:
    """Cut a file short, as a power failure does, after a kill; a check finds it."""
    dataset = make_dataset(case)
    driver = start(case, dataset)
    if at_work(case, driver):
        strike(case, [driver], "driver before a torn write")
    finish(driver)
    ledgers = [one for one in sorted(dataset.root.glob("ledger.sqlite*")) if "-shm" not in one.name]
    outputs = [path for item in items(dataset) for path in folder_of(dataset, item)]
    # Files of one kind are as likely as those of the other.
    victim = case.rng.choice(case.rng.choice([ledgers, outputs or ledgers]))
    size = victim.stat().st_size
    os.truncate(victim, case.rng.randrange(size) if size else 0)
    case.faults["torn write"] += 1
    found = audit(dataset, [STAGE], fix=True, deep=True).findings
    if victim in outputs and not any(victim.parent.name in one.where for one in found):
        case.wrong += 1
    complete(case, dataset)


def bit_flip(case: Case) -> None:
    """Flip a bit of what was published; a check that reads every byte finds it."""
    dataset = make_dataset(case)
    complete(case, dataset)
    path = case.rng.choice(folder_of(dataset, case.rng.choice(items(dataset))))
    data, stat = bytearray(path.read_bytes()), path.stat()
    data[case.rng.randrange(len(data))] ^= 1 << case.rng.randrange(8)
    path.write_bytes(data)
    if case.rng.random() < 0.5:  # as a disk does it, which changes no time
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    case.faults["bit flip"] += 1
    found = audit(dataset, [STAGE], fix=True, deep=True).findings
    case.wrong += [one.where for one in found] != [f"{STAGE.name} {path.parent.name}"]
    complete(case, dataset)


def clock_back(case: Case) -> None:
    """Set the clock back between two runs, and change an input under the older time."""
    dataset = make_dataset(case)
    driver = start(case, dataset)
    if at_work(case, driver):
        time.sleep(case.rng.uniform(LONGEST, 2 * LONGEST))
    finish(driver)
    back = case.rng.uniform(60.0, 1e8)
    changed = dataset.root / "in" / f"{case.rng.choice(items(dataset))}.txt"
    old = time.time() - back
    changed.write_text(changed.read_text()[::-1])
    os.utime(changed, (old, old))
    case.faults["clock set back"] += 1
    complete(case, dataset, FAULT_CLOCK=str(-back))
    complete(case, dataset)


def late_rename(case: Case) -> None:
    """Kill a driver whose file server renames late: after its death, or in the next run."""
    dataset = make_dataset(case)
    for _ in range(KILLS):
        driver = start(case, dataset, FAULT_LATE=f"{case.rng.uniform(0.1, 0.6):.3f}")
        if at_work(case, driver):
            strike(case, [driver], "driver whose rename is late")
        compare(case, dataset)
    complete(case, dataset)
    time.sleep(0.6)
    compare(case, dataset)


def kill_stage(case: Case) -> None:
    """Kill a stage of the real chain, or a training, workers and all."""
    calm = calm_chain(case.chain)
    rounds, place = divmod(case.seed, len(ORDER))  # so that each stage has its turn
    stage = CHAIN[(rounds * ORDER.count("stage") + ORDER[:place].count("stage")) % len(CHAIN)]
    data = case.scratch / "data"
    shutil.copytree(calm / "data", data)
    command = chain_command(stage, data)
    spent = json.loads((calm / "seconds.json").read_text())[stage]
    for share in (1.0, 0.5, 0.25):  # until it is killed before its end
        shutil.rmtree(data / ("grmm" if stage == "train" else stage), ignore_errors=True)
        process = launch(command)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(case.rng.uniform(0.4, 0.9) * share * spent)
        killed = process.poll() is None
        finish(process)
        if killed:
            case.faults[f"kill of {stage}"] += 1
            break
    names = contents(calm / "data", stage)
    for name, there in contents(data, stage).items():
        case.wrong += there != names.get(name) and stage != "train"
    ended = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    assert ended.returncode == 0, f"{stage}: {ended.stderr[-500:]}"
    final = contents(data, stage)
    case.lost += len(names.keys() - final.keys())
    case.wrong += sum(final[name] != there for name, there in names.items() if name in final)


KINDS: dict[str, Callable[[Case], None]] = {
    "driver": kill_driver,
    "driver of workers": kill_driver_of_workers,
    "worker": kill_worker,
    "scheduler": kill_scheduler,
    "memory": out_of_memory,
    "disk": full_disk,
    "torn": torn_write,
    "flip": bit_flip,
    "clock": clock_back,
    "late": late_rename,
    "stage": kill_stage,
}
KILLED = ("driver", "driver of workers", "worker", "scheduler")  # of which the loss is measured
ORDER = (
    "driver", "flip", "stage", "driver of workers", "torn", "stage", "late", "disk", "stage",
    "worker", "memory", "stage", "scheduler", "clock", "stage",
)  # fmt: skip


# What cases are made of


def make_dataset(case: Case, name: str = "data") -> Dataset:
    """Return a dataset of a few small inputs."""
    root = case.scratch / name
    (root / "in").mkdir(parents=True)
    case.notes.mkdir()
    for number in range(ITEMS):
        (root / "in" / f"item{number:04d}.txt").write_text(f"{number + 10}")
    return Dataset(root)


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
    """Return a driver, in a group of its own."""
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
    """Return processes that do a driver's work: the children of its nannies."""
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


def calm_chain(folder: Path) -> Path:
    """Return a recording on which every stage has run undisturbed, and a training."""
    if (folder / "seconds.json").exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    record = [sys.executable, "-m", "express50", "twin", "record", str(folder), *RECORDING]
    subprocess.run(record, env=environment(), capture_output=True, check=True)
    captures = sorted(str(path) for path in (folder / "captures").iterdir())
    seconds = {}
    for stage in CHAIN:
        given = captures if stage == "ingest" else []
        command = chain_command(stage, folder / "data", *given)
        began = time.monotonic()
        subprocess.run(command, env=environment(), capture_output=True, check=True)
        seconds[stage] = time.monotonic() - began
    (folder / "seconds.json").write_text(json.dumps(seconds))
    return folder


def chain_command(stage: str, data: Path, *captures: str) -> list[str]:
    """Return the command of a stage, or of a training."""
    if stage == "train":
        train = [f"train.iterations={ITERATIONS}", "train.save_seconds=0.5"]
        return [sys.executable, "-m", "grmm", "train", str(data / "pack/shards"),
                str(data / "grmm"), "--preset=demo",
                *(word for one in train for word in ("--set", one))]  # fmt: skip
    words = (stage, str(data), *captures, "--preset", "draft", "--workers", "2")
    return [sys.executable, "-m", "express50", *words, *SETTINGS.get(stage, ())]


def contents(data: Path, stage: str) -> dict[str, bytes]:
    """Return the files of a stage, or the trained weights."""
    if stage != "train":
        files = (path for path in (data / stage).rglob("*") if path.is_file())
        return {path.relative_to(data).as_posix(): path.read_bytes() for path in files}
    import torch

    path = data / "grmm" / "checkpoint.pt"
    if not path.exists():
        return {}
    weights = torch.load(path, weights_only=True)["model"]
    return {name: value.numpy().tobytes() for name, value in weights.items()}


if __name__ == "__main__":
    sys.exit(main())
