"""Inject faults into runs (kills, full disks, damaged files) at random, and measure what is lost.

``python -m benchmarks.faults --hours 1`` runs one case after the other until the time is over. A
case makes a dataset, runs a stage of slow items on it, injects faults, and runs it again until it
is complete; then every byte is compared with the expected one, and `express50.dataset.audit` must
find no fault. In a longer run every third case kills a real stage, or a training, on a small
recording, which takes some minutes to make. Each case has a number, which is the seed of all that
is random in it: ``--seed N`` runs one again. With ``--folder`` a stopped run continues.
`seconds_lost_per_kill` is work that was begun and not published; starting again, up to the first
item, is in `restart_seconds_median`. The last line printed is one JSON object.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import psutil

from benchmarks.common import make_parser
from benchmarks.fault_case import (
    LONGEST,
    PATIENCE,
    Case,
    at_work,
    compare,
    complete,
    environment,
    finish,
    folder_of,
    launch,
    make_dataset,
    small_disk,
    start,
    strike,
    work_seconds,
    workers_of,
)
from benchmarks.fault_stage import HUNGER, STAGE, FaultConfig, items
from express50.dataset.audit import audit
from express50.errors import Express50Error

KILLS = 3  # of one case
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


def main(arguments: list[str] | None = None) -> int:
    """Hurt and count."""
    parser = make_parser("faults", __doc__)
    parser.add_argument("--hours", type=float, default=1 / 60, help="how long (a minute)")
    parser.add_argument("--seed", type=int, help="run this case alone")
    parser.add_argument("--folder", type=Path, help="keep cases here, and continue with them")
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
    """Run one case; print its faults with its seed."""
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
    """Kill workers; the driver continues with others."""
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
