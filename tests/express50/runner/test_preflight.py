"""What would stop a run is said before its first item: a line each, exit code 2, nothing begun."""

import contextlib
import dataclasses
import shutil
import socket
import tempfile
import threading
import time
from types import SimpleNamespace

import psutil
import pytest

from express50.__main__ import main
from express50.cli import stages as stage_commands
from express50.contract import stage as contract
from express50.errors import NotReadyError, StageError
from express50.runner import clusters, executor, preflight
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger
from express50.runner.preflight import problems
from express50.runner.slurm import SlurmJob
from tests.faults import toy
from tests.faults.toy import make_dataset, run_toy, tree

WORK = [(toy.STAGE, toy.ToyConfig())]


@pytest.fixture
def dataset(tmp_path):
    return make_dataset(tmp_path / "data", ["a", "b", "c", "d"])


def found(dataset, work=WORK, **pool):
    with Pool(**pool) as workers:
        return list(problems(dataset, work, workers))


def test_nothing_is_printed_or_written_where_all_is_well(dataset):
    assert found(dataset) == []
    run_toy(dataset)
    before = tree(dataset.root)
    assert found(dataset) == []
    after = tree(dataset.root)
    assert {k: v for k, v in after.items() if k in before or "ledger" not in k} == before


def test_all_problems_are_reported_at_once_and_nothing_is_started(dataset, monkeypatch, capsys):
    def bad_file(config):
        raise StageError("toy.word: /nope.bin: no such file")

    greedy = dataclasses.replace(toy.STAGE, needs_gpu=lambda config: True, try_files=bad_file)
    monkeypatch.setattr(executor, "cuda_devices", list)
    monkeypatch.setattr(stage_commands, "stages", lambda: {"toy": greedy})
    monkeypatch.setattr(contract, "stages", lambda: {"toy": greedy})
    before = tree(dataset.root)
    assert main(["toy", str(dataset.root)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "express50: toy.word: /nope.bin: no such file",
        "express50: toy needs a GPU as it is configured, and nvidia-smi lists none on this machine",
    ]
    assert tree(dataset.root) == before


@pytest.mark.parametrize(
    ("refused", "named"),
    [
        (["toy"], "{0}/toy"),
        ([".staging", "config"], "{0}/.staging, {0}/config"),
        (["", "toy", ".staging", "config"], "{0}"),
    ],
    ids=["stage", "two", "disk"],
)
def test_folders_are_tried_and_named_in_one_line(dataset, refused, named, monkeypatch):
    run_toy(dataset)
    root = dataset.root.resolve()
    real = tempfile.TemporaryFile

    def read_only(dir):  # noqa: A002  (tests may run as root, to whom everything is permitted)
        if dir in [root / folder for folder in refused]:
            raise PermissionError(13, "Permission denied")
        return real(dir=dir)

    monkeypatch.setattr(tempfile, "TemporaryFile", read_only)
    line = f"{named.format(root)}: not writable (Permission denied); check its owner and"
    assert found(type(dataset)(root)) == [f"{line} permissions"]


def test_a_file_in_place_of_a_dataset(tmp_path, capsys):
    (tmp_path / "data").write_text("x")
    assert main(["matte", str(tmp_path / "data")]) == 2
    assert "data: is a file, expected a folder to write to" in capsys.readouterr().err


def test_space_is_compared_with_what_items_took(dataset, monkeypatch):
    """Two of four items are made, of 192 kB each."""
    run_toy(dataset, items=["a", "b"])
    usage = SimpleNamespace(total=1e12, free=100e6 + 400e3)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    assert found(dataset) == []
    assert found(dataset, 2 * WORK) == [], "a budget tries several settings and runs one"
    usage.free = 100e6 + 300e3
    (line,) = found(dataset)
    assert "about 384.1 kB of disk are needed, most by toy (2 items of 192.1 kB), and 300.0" in line
    with pytest.raises(NotReadyError, match="2 items of 192"):
        run_toy(dataset)
    assert not dataset.item_dir("toy", "c").exists()
    run_toy(dataset, items=["a", "b", "c"])
    usage.free = 99e6
    (line,) = found(dataset)
    assert "the disk is nearly full: 99.0 MB are left, expected 100.0 MB" in line


def test_what_was_replaced_counts_as_space(dataset, monkeypatch):
    config = toy.ToyConfig(word="b")
    for word in ("a", "b"):
        run_toy(dataset, items=["a", "b"], word=word)
    usage = SimpleNamespace(total=1e12, free=100e6 + 1e3)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    assert found(dataset, [(toy.STAGE, config)]) == []
    shutil.rmtree(dataset.replaced_dir)
    assert len(found(dataset, [(toy.STAGE, config)])) == 1


def test_memory_of_workers_is_compared_with_the_machine(dataset, monkeypatch):
    run_toy(dataset)
    with Ledger(dataset.ledger) as ledger:
        receipt, made = ledger.read("toy")["a"], ledger.made("toy")["a"]
        ledger.write(dataclasses.replace(receipt, peak_memory=3_000_000_000, made=made))
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(total=16_000_000_000))
    monkeypatch.setattr(preflight, "CGROUP_LIMIT", dataset.root / "memory.max")
    words = "toy: {} workers need 3.0 GB each (as the largest item did), and this machine has {}"
    assert found(dataset, workers=4) == []
    assert found(dataset, workers=5) == [words.format(5, "16.0 GB; use --workers 4")]
    (dataset.root / "memory.max").write_text("max\n")
    assert found(dataset, workers=4) == []
    (dataset.root / "memory.max").write_text("8000000000\n")  # of a container
    assert found(dataset, workers=4) == [words.format(4, "8.0 GB; use --workers 2")]
    assert found(dataset, workers=0) == []


def test_gpus_are_asked_for_of_every_stage(dataset, monkeypatch):
    greedy = dataclasses.replace(toy.STAGE, needs_gpu=lambda config: True)
    work = [(greedy, toy.ToyConfig())]
    monkeypatch.setattr(executor, "cuda_devices", list)
    monkeypatch.setattr(executor, "torch_sees_cuda", lambda: False)
    for workers in (0, 2):
        assert "nvidia-smi lists none" in found(dataset, work, workers=workers)[0]
    monkeypatch.setattr(executor, "torch_sees_cuda", lambda: True)
    assert found(dataset, work, workers=0) == []
    jobs = {"toy": SlurmJob(time="10", memory="1G")}
    assert "add gpus=1" in found(dataset, work, slurm=jobs)[0]
    assert found(dataset, work, slurm={"toy": SlurmJob(time="10", memory="1G", gpus=1)}) == []


@pytest.mark.parametrize("address", ["foo", "tcp://127.0.0.1:9", "127.0.0.1:9", "tcp://127.0.0.1"])
def test_a_missing_scheduler_is_reported_at_once(dataset, address):
    began = time.monotonic()
    (line,) = found(dataset, scheduler=address)
    assert line.startswith(f"scheduler {address}: cannot connect (")
    assert time.monotonic() - began < 10  # it was 26 to 43 s


def test_a_port_of_another_service_is_not_a_scheduler(dataset, monkeypatch):
    monkeypatch.setattr(clusters, "CONNECT_SECONDS", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    connection.sendall(b"HTTP/1.0 200 OK\r\n\r\n")
                    connection.close()

        threading.Thread(target=answer, daemon=True).start()
        (line,) = found(dataset, scheduler=f"tcp://127.0.0.1:{server.getsockname()[1]}")
        server.shutdown(socket.SHUT_RDWR)
    assert "cannot connect" in line


def test_a_stage_that_was_never_run_warns_after_some_items(tmp_path, monkeypatch, capsys):
    dataset = make_dataset(tmp_path / "data", list("abcdefgh"))
    usage = SimpleNamespace(total=1e12, free=100e6 + 800e3)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    assert run_toy(dataset).ok
    err = capsys.readouterr().err
    assert f"toy: warning: {dataset.root}: about 960" in err
    assert "kB of disk are needed, most by toy (5 items of 192" in err
    usage.free += 1e6
    dataset = make_dataset(tmp_path / "other", list("abcdefgh"))
    assert run_toy(dataset).ok
    assert "warning" not in capsys.readouterr().err
