"""Stages in SLURM jobs: scripts, options, and whole runs against a stand-in for SLURM."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("dask_jobqueue")

from express50.__main__ import main
from express50.errors import ConfigError, StageError
from express50.runner import executor as pool
from express50.runner import slurm
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger
from express50.runner.runner import run_stage
from express50.runner.slurm import SlurmJob, job_script, read_slurm
from tests import slurm_stand_in
from tests.faults import toy

STAGES = ("ingest", "depth")


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """A stand-in for SLURM on PATH; what its jobs leave behind is killed."""
    home = tmp_path / "cluster"
    monkeypatch.setenv("PATH", f"{slurm_stand_in.install(home)}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[3]))
    monkeypatch.setattr(slurm, "QUEUE_SECONDS", 0.3)
    yield home
    for pid in slurm_stand_in.alive(home):
        slurm_stand_in.end_of_time(pid)


def small(**values):
    return SlurmJob(**{"time": "10", "memory": "1G", "jobs": 1, "interface": "lo"} | values)


def run_toy(dataset, job, **values):
    with Pool(slurm={"toy": job}) as jobs:
        return run_stage(toy.STAGE, dataset, toy.ToyConfig(**values), pool=jobs, progress=False)


def test_writing_a_script_leaves_ctrl_c_alone():
    code = (
        "import signal; from pathlib import Path\n"
        "from express50.runner.slurm import SlurmJob, job_script\n"
        "job = SlurmJob(time='1:00:00', memory='1G', cores=1)\n"
        "job_script(job, 'tcp://host:1', 'name', 1, Path('logs'))\n"
        "assert signal.getsignal(signal.SIGINT) is signal.default_int_handler\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_script_asks_for_what_was_said_and_is_bash(tmp_path, monkeypatch):
    folder = tmp_path / "a b"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", "here:and there")
    job = SlurmJob(
        time="1-12:00:00",
        memory="16G",
        cores=8,
        partition="long",
        account="faces",
        options=("--qos=low",),
        setup=("module load python",),
    )
    lines = job_script(job, "tcp://host:1", "name", 2, tmp_path / "logs").splitlines()
    for directive in (
        "-p long",
        "-A faces",
        "-t 1-12:00:00",
        "--mem=16G",
        "--cpus-per-task=8",
        f"--chdir='{folder}'",
        f"--output={tmp_path}/logs/%j.out",
        "--qos=low",
    ):
        assert f"#SBATCH {directive}" in lines
    assert not [line for line in lines if "gres" in line]
    assert lines[-1].startswith(f"{sys.executable} -m distributed.cli.dask_worker tcp://host:1 ")
    # Eight cores at two threads an item: four items, each with its share of the memory.
    assert "--nthreads 1 --memory-limit 4.00GiB --nworkers 4 " in lines[-1]
    assert lines.index("module load python") < len(lines) - 1
    script = tmp_path / "job.sh"
    script.write_text("\n".join(lines))
    assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
    echoing = "\n".join([*lines[:-1], 'echo "$OMP_NUM_THREADS,$OPENBLAS_NUM_THREADS,$PYTHONPATH"'])
    echoing = echoing.replace("module load python", ":")
    done = subprocess.run(["bash"], input=echoing, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "2,2,here:and there"


def test_gpu_job_asks_for_one_device_and_works_at_one_item(tmp_path):
    script = job_script(small(gpus=1, cores=8), "tcp://host:1", "name", 1, tmp_path)
    assert "#SBATCH --gres=gpu:1\n" in script
    assert "#SBATCH --cpus-per-task=8\n" in script
    assert "--nworkers" not in script
    assert "--resources GPU=1" in script


def test_jobs_work_at_as_many_items_as_they_have_workers():
    jobs = {"cores": small(cores=8, jobs=3), "gpu": small(cores=8, jobs=3, gpus=1)}
    assert Pool(threads=2, slurm={"depth": jobs["cores"]}).width() == 12
    assert Pool(threads=2, slurm={"depth": jobs["gpu"]}).width() == 3


def test_options_of_a_file_and_of_one_line(tmp_path):
    line = read_slurm("partition=cpu,time=4:00:00,memory=16G,cores=4", STAGES)
    assert line["depth"] == SlurmJob(partition="cpu", time="4:00:00", memory="16G", cores=4)
    file = tmp_path / "jobs.toml"
    file.write_text(
        'partition = "cpu"\ntime = "4:00:00"\nmemory = "16G"\ncores = 4\n'
        '[depth]\npartition = "gpu"\ngpus = 1\noptions = ["--qos=low"]\n'
    )
    jobs = read_slurm(str(file), STAGES)
    assert jobs["ingest"] == line["ingest"]
    expected = {"partition": "gpu", "gpus": 1, "options": ("--qos=low",)}
    assert jobs["depth"] == SlurmJob(time="4:00:00", memory="16G", cores=4, **expected)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("memory=16G", "no time; .*partition=cpu,time=4:00:00"),
        ("time=4h,memory=16G", "time is '4h', .*4:00:00"),
        ("time=4,memory=16", "memory is '16', .*16G"),
        ("time=4,memory=16G,core=2", "unknown key slurm.core .did you mean 'cores'"),
        ("time=4,memory=16G,cores=two", r"slurm.cores: got 'two', expected a whole number"),
        ("time=4,memory=16G,gpus=2", "gpus is 2, expected 0 or 1; ask for more jobs"),
        ("time=4,memory=16G,jobs=0", "jobs 0: expected at least 1"),
        ("jobs", "'jobs' is not key=value"),
        ("none.toml", "none.toml: cannot be read"),
    ],
)
def test_wrong_options_are_one_error(text, words):
    with pytest.raises(ConfigError, match=words):
        read_slurm(text, STAGES)


def test_unknown_stage_in_a_file_is_one_error(tmp_path):
    file = tmp_path / "jobs.toml"
    file.write_text('time = "4"\nmemory = "1G"\n[dept]\ngpus = 1\n')
    with pytest.raises(ConfigError, match=r"unknown table \[dept\] .did you mean 'depth'"):
        read_slurm(str(file), STAGES)


def test_a_stage_runs_in_jobs_from_the_command_line(cluster, tmp_path, capture, capsys):
    line = "time=10,memory=1G,jobs=1,interface=lo"
    assert main(["ingest", str(tmp_path / "data"), str(capture), "--slurm", line]) == 0
    assert "ingest: 1 item = 1 done + 0 skipped + 0 failed" in capsys.readouterr().out
    (script,) = cluster.glob("*.sh")
    assert f"#SBATCH --chdir={Path.cwd()}\n" in script.read_text()
    (log,) = (tmp_path / "data" / "logs" / "slurm").iterdir()
    assert "Start Nanny" in log.read_text()
    assert slurm_stand_in.all_end(cluster)


def test_a_wrapper_of_sbatch_may_say_more_than_the_number(cluster, tmp_path):
    (cluster / "wrapped").touch()
    dataset = toy.make_dataset(tmp_path / "data", ["a", "b"])
    assert {o.status for o in run_toy(dataset, small()).outcomes} == {"done"}
    assert slurm_stand_in.all_end(cluster)


def test_a_limit_on_jobs_is_reported_once(cluster, tmp_path, capsys):
    (cluster / "one").touch()
    dataset = toy.make_dataset(tmp_path / "data", ["a", "b", "c"])
    summary = run_toy(dataset, small(jobs=3), seconds=0.5)
    assert {o.status for o in summary.outcomes} == {"done"}
    said = capsys.readouterr().err
    assert said.count("QOSMaxSubmitJobPerUserLimit; continuing with 1 job\n") == 1
    assert slurm_stand_in.all_end(cluster)


def test_items_of_a_job_at_its_time_limit_are_tried_again(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(pool, "SLURM_ATTEMPTS", 2)
    names = [f"item{n}" for n in range(5)] + ["bad1", "poison1"]
    calm = toy.make_dataset(tmp_path / "calm", names)
    hurt = toy.make_dataset(tmp_path / "hurt", names)

    def limit():
        while not list(hurt.staging_dir.glob("toy-*/item*")):
            time.sleep(0.05)
        slurm_stand_in.end_of_time(slurm_stand_in.pids(cluster)[0])

    thread = threading.Thread(target=limit, daemon=True)
    thread.start()
    summary = run_toy(hurt, small(cores=2), seconds=0.4)
    thread.join()
    assert {o.item for o in summary.outcomes if o.status == "failed"} == {"bad1", "poison1"}
    with Ledger(hurt.ledger) as ledger:
        receipts = ledger.read("toy")
    assert max(receipts[name].attempts for name in names[:5]) == 2
    assert receipts["bad1"].attempts in (1, 2)
    reason = receipts["poison1"].reason
    assert "died 2 times" in reason and "its job reached 10" in reason
    assert len(slurm_stand_in.pids(cluster)) >= 2
    (calm.root / "in" / "poison1.txt").unlink()
    toy.run_toy(calm)
    assert toy.tree(hurt.stage_dir("toy")) == toy.tree(calm.stage_dir("toy"))
    assert slurm_stand_in.all_end(cluster)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("stillborn", r"3 SLURM jobs in a row ended before .*100\d.out"),
        ("refuse", "sbatch refused: .*Invalid partition name"),
    ],
)
def test_jobs_that_end_at_once_or_are_refused_are_one_error(cluster, tmp_path, fault, words):
    (cluster / fault).touch()
    dataset = toy.make_dataset(tmp_path / "data", ["a", "b"])
    with pytest.raises(StageError, match=words):
        run_toy(dataset, small())


def test_without_sbatch_is_one_error_before_anything_runs(tmp_path, monkeypatch, capsys, capture):
    monkeypatch.setenv("PATH", str(tmp_path))
    line = ["--slurm", "time=10,memory=1G"]
    assert main(["ingest", str(tmp_path / "data"), str(capture), *line]) == 1
    assert "there is no sbatch on PATH" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()
    # A script can be looked at anywhere.
    assert main(["ingest", str(tmp_path / "data"), str(capture), *line, "--print-job"]) == 0
    assert "#SBATCH -t 10\n" in capsys.readouterr().out


def test_without_dask_jobqueue_is_one_error(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(slurm, "find_spec", lambda name: None)
    assert main(["depth", str(tmp_path), "--slurm", "time=10,memory=1G"]) == 1
    assert "pip install 'express50[slurm]'" in capsys.readouterr().err


def test_options_that_exclude_each_other(tmp_path, capsys):
    assert main(["depth", str(tmp_path), "--print-job"]) == 2
    assert "needs --slurm JOBS" in capsys.readouterr().err
    slurm_and = ["--slurm", "time=10,memory=1G", "--scheduler", "tcp://host:1"]
    assert main(["depth", str(tmp_path), *slurm_and]) == 2
    assert "give only one of them" in capsys.readouterr().err
