"""A cluster of one machine: sbatch, squeue and scancel of local processes."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from pathlib import Path

import psutil

from express50.runner.slurm import ALONE_SECONDS

SBATCH = """#!{python}
import os, pathlib, re, shutil, subprocess, sys
home = pathlib.Path({home!r})
if (home / "refuse").exists():
    sys.exit("sbatch: error: Batch job submission failed: Invalid partition name specified")
if (home / "one").exists() and list(home.glob("*.sh")):
    sys.exit("sbatch: error: QOSMaxSubmitJobPerUserLimit")
number = str(1000 + len(list(home.glob("*.sh"))))
script = home / (number + ".sh")
shutil.copy(sys.argv[-1], script)
options = dict(re.findall(r"^#SBATCH --(chdir|output)=(.*)$", script.read_text(), re.M))
strip = lambda text: text.strip("'")
output = strip(options["output"]).replace("%j", number)
command = ["true"] if (home / "stillborn").exists() else ["bash", str(script)]
with open(output, "w") as file:
    job = subprocess.Popen(command, cwd=strip(options["chdir"]), stdout=file, stderr=file,
                           stdin=subprocess.DEVNULL, start_new_session=True)
(home / (number + ".pid")).write_text(str(job.pid))
if (home / "wrapped").exists():
    print("faces has 12 core hours left")
    print("Submitted batch job " + number)
else:
    print(number + ";stand-in")
"""

SQUEUE = """#!{python}
import os, pathlib
for path in sorted(pathlib.Path({home!r}).glob("*.pid")):
    try:
        state = open("/proc/" + path.read_text() + "/stat").read().rpartition(")")[2].split()[0]
    except OSError:
        continue
    if state != "Z":
        print(path.stem)
"""

# SLURM kills what is left KillWait seconds after SIGTERM, 30 by default. Python may lose the
# signal, as an exception within a callback of the garbage collector is only printed.
SCANCEL = """#!{python}
import os, pathlib, signal, subprocess, sys
for number in sys.argv[1:]:
    group = (pathlib.Path({home!r}) / (number + ".pid")).read_text()
    try:
        os.killpg(int(group), signal.SIGTERM)
    except ProcessLookupError:
        continue
    quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    subprocess.Popen(["sh", "-c", "sleep 10; kill -KILL -- -" + group], start_new_session=True,
                     **quiet)
"""


def install(home: Path) -> Path:
    """Write the three programs; returns the folder to put on PATH."""
    (home / "bin").mkdir(parents=True)
    for name, text in (("sbatch", SBATCH), ("squeue", SQUEUE), ("scancel", SCANCEL)):
        path = home / "bin" / name
        path.write_text(text.format(python=sys.executable, home=str(home)))
        path.chmod(0o755)
    return home / "bin"


def pids(home: Path) -> list[int]:
    """Processes of the jobs submitted so far, in order; each leads a group."""
    return [int(path.read_text()) for path in sorted(home.glob("*.pid"))]


def end_of_time(pid: int) -> None:
    """What SLURM does to a job at its time limit: SIGTERM, and SIGKILL when it is still there."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(pid, number)
        except ProcessLookupError:
            return
        time.sleep(0.5)


def alive(home: Path) -> list[int]:
    """Jobs of which a process is left."""
    groups = set()
    for process in psutil.process_iter(["status"]):
        with contextlib.suppress(ProcessLookupError):
            if process.info["status"] != psutil.STATUS_ZOMBIE:
                groups.add(os.getpgid(process.pid))
    return [pid for pid in pids(home) if pid in groups]


def all_end(home: Path, patience: float = ALONE_SECONDS + 30.0) -> bool:
    """Whether every job ends within so many seconds; a worker may wait for its lost scheduler."""
    give_up = time.monotonic() + patience
    while alive(home) and time.monotonic() < give_up:
        time.sleep(0.1)
    return not alive(home)
