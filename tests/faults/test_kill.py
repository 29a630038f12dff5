"""SIGKILL at any moment: every output is absent or whole, and a rerun gives the same bytes.

A killed run leaves no SLURM job behind that waits for it.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from express50.__main__ import main
from tests import slurm_stand_in
from tests.express50.dataset.tracked import track_arrays, write_track
from tests.express50.head.flame_files import write_flame
from tests.faults import toy
from tests.pipelines.bump_dataset import make_dataset

REPOSITORY = Path(__file__).resolve().parents[2]
NAMES = [f"item{number}" for number in range(6)] + ["S001/cam00", "S001/cam01"]


def start(arguments: list[str], **variables: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"} | variables
    return subprocess.Popen(
        [sys.executable, "-m", *arguments],
        cwd=REPOSITORY,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=_hear_interrupts,
    )


def _hear_interrupts() -> None:
    """A shell starts what it runs in the background deaf to Ctrl-C; children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def timed(arguments: list[str]) -> float:
    """Seconds that an undisturbed run takes on this machine, now."""
    began = time.monotonic()
    assert start(arguments).wait(timeout=300) == 0
    return time.monotonic() - began


def kill_until_done(arguments: list[str], check, delays: list[float]) -> int:
    """Start, kill after each delay, check what is there; then let one run end. Returns kills."""
    kills = 0
    for delay in delays:
        process = start(arguments)
        try:
            process.wait(delay)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
        check()
    assert start(arguments).wait(timeout=300) == 0
    return kills


def published(root: Path, names: list[str]) -> dict[str, dict[str, bytes]]:
    return {name: toy.tree(root / name) for name in names if (root / name).is_dir()}


# Moments as parts of an undisturbed run: import, start of the workers, and the work itself.
@pytest.mark.parametrize(
    ("workers", "parts"),
    [(0, [0.6, *(random.Random(n).uniform(0.1, 0.95) for n in range(9))]), (2, [0.5, 0.7, 0.9])],
    ids=["inline", "workers"],
)
def test_killed_driver_leaves_whole_items_and_a_rerun_completes(tmp_path, workers, parts):
    calm = toy.make_dataset(tmp_path / "calm", NAMES)
    seconds = timed(["tests.faults.toy", str(calm.root), str(workers)])
    expected = published(calm.stage_dir("toy"), NAMES)
    assert len(expected) == len(NAMES)
    hurt = toy.make_dataset(tmp_path / "hurt", NAMES)

    def check():
        for name, files in published(hurt.stage_dir("toy"), NAMES).items():
            assert files == expected[name], name

    arguments = ["tests.faults.toy", str(hurt.root), str(workers)]
    kills = kill_until_done(arguments, check, [seconds * part for part in parts])
    assert kills > 0
    assert toy.tree(hurt.stage_dir("toy")) == toy.tree(calm.stage_dir("toy"))
    assert [p for p in hurt.staging_dir.iterdir() if not p.name.endswith(".lock")] == []


def test_interrupt_stops_soon_and_is_resumable(tmp_path):
    dataset = toy.make_dataset(tmp_path / "data", [f"item{n}" for n in range(30)])
    # Slow enough that no busy machine lets it finish before it is interrupted.
    process = start(["tests.faults.toy", str(dataset.root), "2"], **{toy.SLOWER: "20"})
    give_up = time.monotonic() + 120
    while not list(dataset.root.glob("toy/*")) and time.monotonic() < give_up:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: driver and workers
    process.wait(timeout=120)
    finished = list(dataset.root.glob("toy/*"))
    assert process.returncode != 0
    assert 0 < len(finished) < 30
    summary = toy.run_toy(dataset, seconds=0.02)
    assert summary.count("done") + summary.count("skipped") == 30
    assert summary.count("skipped") >= len(finished) - 2


def test_a_glance_at_a_lock_keeps_no_stage_from_starting(tmp_path, monkeypatch):
    import fcntl

    from express50.runner import publish

    dataset = toy.make_dataset(tmp_path / "data", ["item0"])
    with publish.stage_lock(dataset, "toy"):
        pass
    glance = (dataset.staging_dir / ".toy.lock").open("r")
    fcntl.flock(glance, fcntl.LOCK_SH)
    monkeypatch.setattr(publish.time, "sleep", lambda _: glance.close())
    with publish.stage_lock(dataset, "toy"):
        assert publish.is_running(dataset, "toy")


def export_killed(arguments: list[str], out: Path, files: int) -> bool:
    """Run an export and kill it once that many files are there; False if it ended before."""
    process = start(["express50", *arguments])
    while sum(path.is_file() for path in (out / ".S001.part").rglob("*")) < files:
        if process.poll() is not None:
            return False
        time.sleep(0.0005)
    process.kill()
    return process.wait() == -signal.SIGKILL


def test_a_killed_export_is_absent_and_made_whole_by_the_next_run(tmp_path):
    dataset = make_dataset(tmp_path, cameras=8, size=48)
    write_track(dataset.track_file("S001"), track_arrays(write_flame(tmp_path)))
    out, again = tmp_path / "out", tmp_path / "again"
    arguments = ["export", str(dataset.root), str(out), "--format=gaussian-avatars"]
    for _ in range(5):  # on a busy machine the export may be through before anyone looks
        if export_killed(arguments, out, 5):
            break
        shutil.rmtree(out)
    assert not (out / "S001").exists() and (out / ".S001.part").exists()
    assert main(arguments) == 0
    assert main([*arguments[:2], str(again), arguments[3]]) == 0
    assert [path.name for path in out.iterdir()] == ["S001"]
    assert toy.tree(out) == toy.tree(again)


def test_killed_driver_leaves_no_slurm_job_and_a_rerun_completes(tmp_path):
    pytest.importorskip("dask_jobqueue")
    home = tmp_path / "cluster"
    commands = slurm_stand_in.install(home)
    dataset = toy.make_dataset(tmp_path / "data", [f"item{n}" for n in range(24)])
    arguments = ["tests.faults.toy", str(dataset.root), "slurm"]
    path = {"PATH": f"{commands}{os.pathsep}{os.environ['PATH']}"}
    process = start(arguments, **path)
    give_up = time.monotonic() + 60
    while len(list(dataset.root.glob("toy/*"))) < 3 and time.monotonic() < give_up:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    try:
        assert 3 <= len(list(dataset.root.glob("toy/*"))) < 24
        assert slurm_stand_in.all_end(home)
        assert start(arguments, **path).wait(timeout=90) == 0
        assert len(list(dataset.root.glob("toy/*"))) == 24
        assert slurm_stand_in.all_end(home)
    finally:
        for pid in slurm_stand_in.alive(home):
            slurm_stand_in.end_of_time(pid)
