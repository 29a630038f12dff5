"""An export killed half-way leaves no half-written one, and the next run makes it whole."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from express50.__main__ import main
from tests.express50.dataset.tracked import track_arrays, write_track
from tests.express50.head.flame_files import write_flame
from tests.pipelines.bump_dataset import make_dataset


def killed(arguments: list[str], out: Path, files: int) -> bool:
    """Run an export and kill it once that many files are there; False if it ended before."""
    process = subprocess.Popen([sys.executable, "-m", "express50", *arguments])
    while sum(path.is_file() for path in (out / ".S001.part").rglob("*")) < files:
        if process.poll() is not None:
            return False
        time.sleep(0.0005)
    process.kill()
    return process.wait() == -signal.SIGKILL


def test_a_killed_export_is_absent_and_made_whole_by_the_next_run(tmp_path) -> None:
    dataset = make_dataset(tmp_path, cameras=8, size=48)
    arrays = track_arrays(write_flame(tmp_path))
    write_track(dataset.track_file("S001"), arrays)
    out, again = tmp_path / "out", tmp_path / "again"
    arguments = ["export", str(dataset.root), str(out), "--format=gaussian-avatars"]
    for _ in range(5):  # on a busy machine the export may be through before anyone looks
        if killed(arguments, out, 5):
            break
        shutil.rmtree(out)
    assert not (out / "S001").exists() and (out / ".S001.part").exists()
    assert main(arguments) == 0
    assert main([*arguments[:2], str(again), arguments[3]]) == 0
    assert [path.name for path in out.iterdir()] == ["S001"]
    assert files_of(out) == files_of(again)


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }
