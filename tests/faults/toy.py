"""A toy stage whose items misbehave by name, and a driver to be killed.

Run as ``python -m tests.faults.toy ROOT WORKERS``, or ``slurm`` for the workers.
"""

from __future__ import annotations

import errno
import hashlib
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result, Stage
from express50.errors import StageError
from express50.runner.executor import Pool
from express50.runner.runner import run_stage
from express50.runner.slurm import SlurmJob

SLOWER = "EXPRESS50_TOY_SLOWER"  # how many times as long to pause: no item's bytes depend on it


@dataclass(frozen=True, kw_only=True)
class ToyConfig:
    """Configuration."""

    files: int = 3
    """Files an item writes."""
    seconds: float = 0.0
    """Pause after each file."""
    word: str = "a"
    """Goes into the files."""


def items(dataset: Dataset) -> list[str]:
    return sorted(path.stem.replace("+", "/") for path in (dataset.root / "in").glob("*.txt"))


def inputs(dataset: Dataset, item: str, config: ToyConfig) -> dict[str, Path | str]:
    if item.startswith("noinput"):
        raise StageError(f"{item}: no input")
    return {"text": dataset.root / "in" / f"{item.replace('/', '+')}.txt", "kind": "toy"}


def run(dataset: Dataset, item: str, config: ToyConfig, out: Path) -> Result:
    text = (dataset.root / "in" / f"{item.replace('/', '+')}.txt").read_text()
    if config.files < 0:
        raise StageError(f"toy.files is {config.files}, expected files")
    (out / "deep").mkdir()
    for number in range(config.files):
        block = hashlib.sha256(f"{config.word}{item}{text}{number}".encode()).digest()
        (out / "deep" / f"{number}.bin").write_bytes(block * 2000)
        time.sleep(config.seconds * float(os.environ.get(SLOWER, "1")))
    while item.startswith("wait") and not (dataset.root / "go").exists():
        time.sleep(0.02)
    print("chatter of a library")
    return misbehave(dataset, item, text)


def misbehave(dataset: Dataset, item: str, text: str) -> Result:
    if item.startswith("bad") and text != "repaired":
        raise StageError(f"{item}: text is {text!r}, expected 'repaired'")
    if item.startswith("bug"):
        raise KeyError("absent")
    if item.startswith("denied"):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/raw/cam02")
    if item.startswith("nan"):
        return Result({"value": float("nan")})
    if item.startswith("full") and text != "repaired":
        Path("/dev/full").write_text("more than there is room for")
    if item.startswith("poison"):
        os.kill(os.getpid(), signal.SIGKILL)
    if item.startswith("once"):
        mark = dataset.root / f"{item}.mark"
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    dropped = [Note("cam03", "dark")] if item.startswith("drop") else []
    return Result({"length": len(text)}, dropped)


STAGE = Stage(
    name="toy",
    version=1,
    config=ToyConfig,
    presets={"draft": {"files": 2}, "reference": {"files": 5}},
    items=items,
    inputs=inputs,
    run=run,
)


def after_toy() -> Stage:
    """A stage that reads the toy's folders."""

    def copy(dataset: Dataset, item: str, config: ToyConfig, out: Path) -> Result:
        data = b"".join(
            path.read_bytes() for path in sorted((dataset.item_dir("toy", item) / "deep").iterdir())
        )
        (out / "sum.txt").write_text(hashlib.sha256(data).hexdigest())
        return Result()

    return Stage(
        name="after",
        version=1,
        config=ToyConfig,
        presets=STAGE.presets,
        items=items,
        inputs=lambda dataset, item, config: {"toy": dataset.item_dir("toy", item)},
        run=copy,
    )


def make_dataset(root: Path, names: list[str]) -> Dataset:
    (root / "in").mkdir(parents=True)
    for name in names:
        (root / "in" / f"{name.replace('/', '+')}.txt").write_text(name)
    return Dataset(root)


def run_toy_in_jobs(dataset: Dataset):
    job = SlurmJob(time="10", memory="1G", jobs=1, interface="lo")
    with Pool(slurm={"toy": job}) as pool:
        return run_stage(STAGE, dataset, ToyConfig(seconds=0.05), pool=pool, progress=False)


def run_toy(
    dataset: Dataset,
    workers: int = 0,
    stage: Stage = STAGE,
    items: list[str] | None = None,
    **values: Any,
):
    """Run the toy, or another stage with its settings."""
    with Pool(workers) as pool:
        return run_stage(stage, dataset, ToyConfig(**values), items, pool=pool, progress=False)


def tree(root: Path) -> dict[str, bytes]:
    """Content of every file below a folder by relative path."""
    files = (path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


if __name__ == "__main__":
    dataset = Dataset(Path(sys.argv[1]))
    jobs = sys.argv[2] == "slurm"
    summary = run_toy_in_jobs(dataset) if jobs else run_toy(dataset, int(sys.argv[2]), seconds=0.02)
    sys.exit(0 if summary.ok else 1)
