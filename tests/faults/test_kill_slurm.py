"""A driver that is killed leaves no SLURM job behind that waits for it, and a rerun goes on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("dask_jobqueue")

from tests import slurm_stand_in
from tests.faults import toy

REPOSITORY = Path(__file__).resolve().parents[2]


def start(dataset, bin_folder):
    environment = os.environ | {
        "PYTHONPATH": str(REPOSITORY),
        "PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}",
    }
    command = [sys.executable, "-m", "tests.faults.toy", str(dataset.root), "slurm"]
    return subprocess.Popen(command, cwd=REPOSITORY, env=environment, stderr=subprocess.DEVNULL)


def test_killed_driver_leaves_no_job_and_a_rerun_completes(tmp_path):
    home = tmp_path / "cluster"
    bin_folder = slurm_stand_in.install(home)
    dataset = toy.make_dataset(tmp_path / "data", [f"item{n}" for n in range(24)])
    process = start(dataset, bin_folder)
    give_up = time.monotonic() + 60
    while len(list(dataset.root.glob("toy/*"))) < 3 and time.monotonic() < give_up:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    try:
        assert 3 <= len(list(dataset.root.glob("toy/*"))) < 24
        assert slurm_stand_in.all_end(home)
        assert start(dataset, bin_folder).wait(timeout=90) == 0
        assert len(list(dataset.root.glob("toy/*"))) == 24
        assert slurm_stand_in.all_end(home)
    finally:
        for pid in slurm_stand_in.alive(home):
            slurm_stand_in.end_of_time(pid)
