"""The command line: output, exit codes, one line for an error, only one area imported."""

import argparse
import dataclasses
import errno
import gc
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from express50.__main__ import main
from express50.console import log, run_handler, say
from express50.contract.stage import Note, Result, stages
from express50.errors import advised
from tests.synth import make_capture

COMMANDS = [
    "annotate",
    "cameras",
    "photo",
    "shards",
    "check",
    "plan",
    "subject",
    "export",
    "report",
]
REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture
def run(capsys):
    def call(*arguments):
        code = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture
def data(tmp_path):
    return tmp_path / "data"


@pytest.mark.parametrize("words", [[], ["annotate"]], ids=["express50", "annotate"])
def test_without_a_command_the_help_lists_all_in_aligned_columns(run, words):
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    listed = [line for line in err.splitlines() if line.startswith("    ")]
    names = {line.split()[0] for line in listed if line[4] != " "}
    assert names > ({"run", "ingest", "annotate"} if not words else {"ui", "reference"})
    begins = {len(line) - len(line[4:].partition(" ")[2].lstrip()) for line in listed}
    assert len(begins) == 1


def test_arguments_of_the_process_are_read_where_none_are_given(monkeypatch, capsys):
    from grmm.cli import main as grmm

    monkeypatch.setattr(sys, "argv", ["grmm", "config", "--preset", "demo"])
    assert grmm() == 0
    assert "n_g = 128" in capsys.readouterr().out


def test_ingest_then_skip_then_status(run, data, capture):
    code, out, err = run("ingest", data, capture)
    assert code == 0
    assert out.startswith("ingest: 1 item = 1 done + 0 skipped + 0 failed in ")
    assert err.startswith("ingest 1/1 S001 done ")
    code, out, err = run("ingest", data)
    assert (code, err) == (0, "")
    assert "0 done + 1 skipped" in out
    code, out, _ = run("status", data)
    assert code == 0
    assert out.splitlines()[1].split()[:3] == ["ingest", "1", "0"]


@pytest.mark.parametrize(
    "settings",
    [
        ["matte.method=bgmv2", "matte.weights"],
        ["track.landmarks"],
        ["track.head"],
        ["regions.segmentation"],
    ],
    ids=lambda settings: settings[-1],
)
def test_a_mistyped_file_is_refused_before_anything_is_done(run, data, capture, settings):
    """The file is there and is not what it should be: it has to be opened to know."""
    bad = data.parent / "bad.npz"
    bad.write_bytes(b"mistyped")
    *others, name = settings
    sets = [f"--set={text}" for text in (*others, f"{name}={bad}")]
    code, _, err = run("run", data, capture, *sets, "--workers", "0")
    assert code == 2 and str(bad) in err and err.count("\n") == 1
    assert not data.exists()


@pytest.mark.parametrize("debug", ["", "1"])
def test_a_defect_is_one_line_unless_its_traceback_is_asked_for(capsys, monkeypatch, debug):
    def handler(args):
        return {}["absent\nkey"]

    monkeypatch.setenv("EXPRESS50_DEBUG", debug)
    assert run_handler("express50", handler, argparse.Namespace()) == 1
    line, *more = capsys.readouterr().err.splitlines()
    assert line.startswith("express50: KeyError: 'absent") and "in test_cli.py line " in line
    assert "set EXPRESS50_DEBUG=1" in line
    assert more[:1] == (["Traceback (most recent call last):"] if debug else [])


@pytest.mark.parametrize(
    ("error", "amount"),
    [
        (MemoryError(), ""),
        (MemoryError("Unable to allocate 8.00 GiB for an array with shape (1,)"), " for 8.00 GiB"),
        (RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0"), " for 2.00 GiB"),
        (RuntimeError("can't allocate memory: you tried to allocate 24 bytes."),
         " for 24 bytes"),
    ],
    ids=["python", "numpy", "gpu", "cpu"],
)  # fmt: skip
def test_too_little_memory_is_not_called_a_defect(error, amount, capsys):
    def handler(args):
        raise error

    assert run_handler("grmm", handler, argparse.Namespace()) == 1
    said = capsys.readouterr().err
    assert f": not enough memory{amount}; end other programs" in said and said.count("\n") == 1
    assert "unexpected" not in said


def test_names_from_outside_send_no_control_sequences(capsys):
    say("camera \x1b[31mred \u202eevil", "tab\tä \udcff")
    log("cleared \x1b[2J\r\x9b")
    both = capsys.readouterr()
    assert both.out == "camera \\x1b[31mred \\u202eevil\ntab\tä \\udcff\n"
    assert both.err == "cleared \\x1b[2J\\r\\x9b\n"


def test_standard_output_holds_only_the_json(data, capture):
    command = [sys.executable, "-m", "express50", "ingest", str(data), str(capture), "--json"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    account = json.loads(done.stdout)
    counts = [account[k] for k in ("stage", "read", "done", "skipped", "failed")]
    assert counts == ["ingest", 1, 1, 0, 0]
    assert account["items"][0]["item"] == "S001"


def test_bad_item_gives_exit_code_1_and_is_named(run, data, capture, tmp_path):
    make_capture(tmp_path / "S002", subject="S002", cameras=1)
    (tmp_path / "S002/cues.csv").write_text("nonsense\n")
    code, out, _ = run("ingest", data, capture, tmp_path / "S002", "--workers", 0)
    assert code == 1
    assert "2 items = 1 done + 0 skipped + 1 failed" in out
    assert "failed S002: CaptureError: " in out
    assert run("status", data)[0] == 1
    code, out, _ = run("ingest", data, "--items", "S001")
    assert (code, "1 item = 0 done + 1 skipped + 0 failed" in out) == (0, True)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["ingest", "DATA", "absent"], 1, "CaptureError: "),
        (["ingest", "DATA"], 2, "no such dataset"),
        (["status", "DATA"], 2, "no such dataset"),
        (["ingest", "DATA", "CAP", "--set", "ingest.proxy_long=3"], 2, "mean 'proxy_long_side'"),
        (["ingest", "DATA", "CAP", "--set", "track.x=3"], 2, "only runs ingest"),
        (["ingest", "DATA", "CAP", "--preset", "fast"], 2, "unknown preset"),
        (["ingest", "DATA", "CAP", "--workers", "-1"], 2, "argument --workers: got '-1', exp"),
        (["ingest", "DATA", "CAP", "--items", "Z*"], 2, "no item of ingest matches"),
        (["run", "DATA", "CAP", "--first", "track", "--last", "ingest"], 2, "comes after"),
        (["run", "DATA", "CAP", "--first", "calibrate"], 2, "read no captures, but"),
        (["prune", ""], 2, "argument DATASET: got '', expected a value; is a variable"),
        (["annotate", "status", "~/data"], 2, "DATASET: got '~/data', whose ~ no shell has"),
        (["report", "DATA", "--out=~/page"], 2, "--out: got '~/page', whose ~ no shell has"),
        (["ingest", "DATA", "CAP", "--slurm=~/jobs.toml"], 2, "'~/jobs.toml', whose ~ no shell"),
        (["run", "DATA", "CAP", "--config", ""], 2, "argument --config: got ''"),
        (["run", "DATA", "CAP", "--preset", ""], 2, "argument --preset: got ''"),
        (["twin", "record", "DATA", "--expressions", " ,"], 2, "--expressions: got ' ,', expected"),
        (["subject", "withdraw", "DATA", "S001"], 2, "no such dataset"),
        (["annotate", "status", "DATA"], 2, "no such dataset"),
        (["annotate", "status", "FILE"], 2, "is a file, expected the folder of a dataset"),
        (["check", "FILE"], 2, "is a file, expected the folder of a dataset"),
        (["shards", "ls", "FILE"], 1, "cues.csv: is a file, not a folder; name the folder that"),
        (["head", "preview", "DATA/x.xyz"], 1, "expected .png, .jpg, .tif or .exr as its ending"),
        (["config", "trak"], 2, "no stage 'trak'"),
        (["ingest"], 2, "required: DATASET"),
        (["nonsense"], 2, "unknown 'nonsense'; expected run, ingest, "),
        (["ingset"], 2, "did you mean 'ingest'?"),
        (["shards", "vrify"], 2, "did you mean 'verify'?"),
        (
            ["run", "DATA", "--buget", "1h"],
            2,
            "unknown argument '--buget' (did you mean '--budget'",
        ),
        (["run", "DATA", "--buget=1h"], 2, "(did you mean '--budget'?)"),
        (["status", "DATA", "more"], 2, "express50 status: error: unknown argument 'more'"),
        (["config", "ingets"], 2, "no stage 'ingets' (did you mean 'ingest'?)"),
        (["ingest", "DATA", "--workers=-1"], 2, "got '-1', expected a whole number, 0 to"),
        (["ingest", "DATA", "--threads", "-1"], 2, "got '-1', expected a whole number, 1 to"),
        (["twin", "record", "DATA", "--workers", "0"], 2, "--workers: got '0', expected a whole"),
        (["shards", "split", "DATA", "OUT", "--shard-mb", "0"], 2, "--shard-mb: got '0'"),
        (["status", "DATA", "--serve=-1"], 2, "expected a whole number, 0 to 65535"),
        (["plan", "DATA", "--size=-9x-9"], 2, "got '-9x-9', expected WIDTHxHEIGHT"),
        (["ingest", "CAP"], 2, "is a capture; expected 'express50 ingest DATASET "),
        (["matte", "CAP"], 2, "is a capture; expected 'express50 matte DATASET'"),
        (["ingest", "CAP", "CAP"], 2, "is a capture; expected"),
    ],
)
def test_errors_are_one_line_with_their_exit_code(run, data, capture, arguments, code, message):
    places = {"DATA": data, "CAP": capture, "FILE": capture / "cues.csv"}
    found, out, err = run(*[places.get(a, a) for a in arguments])
    assert (found, out) == (code, "")
    last = err.strip().splitlines()[-1]
    assert message in last
    assert last.startswith("express50")
    assert "Traceback" not in err


def test_a_file_whose_name_begins_as_an_option_is_named(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("-smile.jpg").touch()
    for arguments in (["photo", "-smile.jpg", "OUT"], ["head", "preview", "--model", "-smile.jpg"]):
        assert "-smile.jpg begins as options do; write ./-smile.jpg" in run(*arguments)[2]


def test_a_chain_that_cannot_go_on_ends_with_the_cause(run, data, tmp_path):
    make_capture(tmp_path / "S002", subject="S002", cameras=1)
    (tmp_path / "S002" / "cues.csv").write_text("expression_id\n")
    code, _, err = run("run", data, tmp_path / "S002", "--workers", "0")
    assert code == 1
    assert "calibrate has nothing to do, because ingest failed" in err.splitlines()[-1]


def test_the_one_item_of_pack_needs_every_subject_encoded(run, data, capture):
    """`encode` has no item of that name, so it was said to have nothing to do."""
    run("ingest", data, capture)
    code, out, _ = run("pack", data, "--items", "shards", "--workers", "0")
    assert code == 1 and "encode: 1 item = 0 done + 0 skipped + 1 failed" in out


def test_a_stage_of_a_folder_that_is_no_dataset_says_so(run, tmp_path):
    for pattern in ([], ["--items", "S001/*"]):
        assert "not a dataset" in run("matte", tmp_path, *pattern)[2]


ADVICE = [
    ("status", "DATA"),
    ("report", "DATA"),
    ("plan", "DATA"),
    ("run", "DATA", "--first", "track", "--last", "track"),
    ("matte", "DATA", "--items", "S001/*"),
    ("annotate", "status", "DATA"),
    ("cameras", "check", "DATA/a.json"),
    ("ingest", "CAP"),
    ("check", "DATA"),
]


@pytest.mark.parametrize("state", ["new", "empty", "ingested", "moved"])
def test_advised_commands_quote_folders_for_a_shell(run, tmp_path, capture, state):
    root, footage = tmp_path / "a b'c" / "data", tmp_path / "a b'c" / "S001"
    footage.parent.mkdir()
    shutil.copytree(capture, footage)
    if state != "new":
        root.mkdir()
        (root / "a.json").write_text("{}")
    if state in ("ingested", "moved"):
        assert run("ingest", root, footage)[0] == 0
    if state == "moved":
        footage.rename(footage.parent / "S002")
    advised = 0
    places = {"DATA": root, "CAP": footage, "DATA/a.json": root / "a.json"}
    for arguments in ADVICE:
        _, out, err = run(*[places.get(word, word) for word in arguments])
        for place in (root, footage):
            assert not re.search(rf"express50 [a-z ]+{re.escape(str(place))}", out + err)
            advised += len(re.findall(rf"express50 .*{re.escape(shlex.quote(str(place)))}", err))
    assert advised > 1


def test_an_advised_folder_is_one_word_and_no_option():
    command = advised("express50 run", Path("a b'c"), Path("-d"), "--first ingest")
    assert shlex.split(command[1:-1])[2:] == ["a b'c", "./-d", "--first", "ingest"]
    assert advised("express50 run", Path("data")) == "'express50 run data'"


def test_a_dataset_in_the_place_of_a_capture_is_refused(run, data, capture):
    assert run("ingest", data, capture)[0] == 0
    code, _, err = run("ingest", data.parent / "new", data)
    assert code == 2 and f"{data} is a dataset; expected 'express50 ingest DATASET CAPTURE'" in err
    assert not (data.parent / "new").exists()


def test_a_dataset_inside_its_capture_is_refused(run, capture):
    code, _, err = run("ingest", capture / "data", capture)
    assert code == 2 and "lies inside the capture" in err
    assert not (capture / "data").exists()


def test_the_first_ingest_needs_a_capture(run, data):
    data.mkdir()
    for command in ("ingest", "run"):
        code, _, err = run(command, data)
        assert code == 2 and "has no captures yet; run 'express50" in err


def test_one_of_a_thing_is_singular(run, tmp_path):
    make_capture(tmp_path / "one", subject="S001", cameras=1, frames=1, expressions=("smile",))
    code, out, _ = run("ingest", tmp_path / "data", tmp_path / "one")
    assert code == 0 and "1 camera, 1 frame each, 1 expression\n" in out
    (tmp_path / "data/ingest/S001/proxies/cam00.tar").unlink()
    code, out, _ = run("check", tmp_path / "data")
    assert code == 1 and "1 finding, 0 fixed, 1 left" in out


def test_a_dropped_camera_ends_a_strict_run_with_1(run, data, capture):
    def dropping(dataset, item, config, out):
        return Result({}, [Note("camera cam01", "dark")])

    ingest = dataclasses.replace(stages()["ingest"], run=dropping, account=None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(stages(), "ingest", ingest)
        assert run("ingest", data, capture)[0] == 0
        code, out, _ = run("ingest", data, "--strict")
        assert code == 1 and "1 skipped" in out and "dropped camera cam01 of S001: dark" in out


def test_config_prints_toml_that_config_accepts(run, data, capture, tmp_path):
    code, out, _ = run("config", "ingest", "--preset", "draft", "--set", "ingest.proxy_quality=70")
    assert code == 0
    assert "# JPEG quality of proxies, 1 to 100.\nproxy_quality = 70" in out
    (tmp_path / "c.toml").write_text(out)
    assert run("ingest", data, capture, "--config", tmp_path / "c.toml")[0] == 0
    assert "proxy_long_side = 320" in (data / "config/ingest.toml").read_text()


def test_run_goes_through_the_stages_in_order(run, data, capture):
    code, out, _ = run("run", data, capture, "--last", "ingest", "--json")
    assert code == 0
    assert [account["stage"] for account in json.loads(out)] == ["ingest"]


def test_what_the_system_refuses_is_one_line(run, data, capture):
    assert run("ingest", data, capture)[0] == 0
    code, _, err = run("report", data, "--out", "/proc/none/report.html")
    assert code == 1 and err.count("\n") == 1
    assert "/proc/none" in err and "Traceback" not in err


def test_a_dataset_whose_name_is_not_utf_8_keeps_its_ledger(run, tmp_path, capture):
    code, out, err = run("ingest", tmp_path / "data\udcff", capture)
    assert code == 1 and "is not UTF-8" in out + err and "delete" not in out + err


@pytest.mark.parametrize("command", [["calibrate"], ["annotate", "status"]])
def test_a_link_to_itself_and_a_name_that_is_too_long_are_one_line(run, tmp_path, command):
    loop, long = tmp_path / "loop", tmp_path / ("n" * 300)
    loop.symlink_to(loop)
    for path, words in ((loop, "which leads back to itself"), (long, "; give a shorter name")):
        code, _, err = run(*command, path)
        assert code in (1, 2) and err.count("\n") == 1 and "unexpected" not in err
        assert err.rstrip().endswith(words) or "no such dataset" in err


def test_a_read_only_disk_is_named_as_before_a_run(run, data, capture, monkeypatch):
    assert run("ingest", data, capture)[0] == 0
    page = data / "report/index.html"
    real = Path.open

    def read_only(path, mode="r", **options):
        if path.parent == page.parent and "w" in mode:
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        return real(path, mode, **options)

    monkeypatch.setattr(Path, "open", read_only)
    line = f"express50: {page}: not writable (Read-only file system); make its disk writable, or"
    assert run("report", data)[2] == f"{line} use another one\n"


def test_a_reader_that_leaves_stops_nothing(data, capture):
    command = [sys.executable, "-m", "express50", "ingest", str(data), str(capture)]
    read, write = os.pipe()
    os.close(read)
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    ended = subprocess.run(command, stdout=write, stderr=write, env=environment, check=False)
    os.close(write)
    assert ended.returncode == 0 and (data / "ingest" / "S001" / "metrics.json").is_file()


def test_version_and_help(run):
    assert run("--version")[:2] == (0, "express50 0.1.0\n")
    code, out, _ = run("--help")
    assert code == 0
    for name in ["ingest", "calibrate", "run", "status", "config", *COMMANDS]:
        assert f"\n    {name}" in out


def test_only_the_module_of_the_asked_command_is_imported(data):
    """Seconds of imports must not stand before a short command."""
    code = (
        "import sys; from express50.__main__ import main; main(['status', sys.argv[1]]);"
        "heavy = {'torch', 'open3d', 'pycolmap', 'cv2', 'av', 'dask', 'distributed', 'numpy'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-c", code, str(data)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_within_a_garbage_collection_stops(number, capsys):
    def stop(phase, info):
        gc.callbacks.remove(stop)
        signal.raise_signal(number)

    signal.signal(signal.SIGINT, signal.default_int_handler)  # libraries change it

    def handler(args):
        gc.callbacks.append(stop)
        gc.collect()
        time.sleep(5)
        return 0

    assert run_handler("express50", handler, argparse.Namespace()) == 130
    assert capsys.readouterr().err.count("\n") == 1


def test_interrupt_keeps_what_is_finished_and_says_so(run, data, capture, monkeypatch):
    def stop(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("express50.runner.runner.run_stage", stop)
    code, out, err = run("ingest", data, capture)
    assert (code, out) == (130, "")
    assert "interrupted" in err


def test_a_librarys_warning_is_one_line_without_its_place():
    code = (
        "import argparse, warnings\n"
        "from express50.console import run_handler\n"
        "run_handler('grmm', lambda args: warnings.warn('slow') or 0, argparse.Namespace())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr == "grmm: warning: slow\n"


@pytest.mark.parametrize("stream", [">/dev/full", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_standard_streams_that_are_full_or_closed_are_one_line_at_most(stream):
    python, full = shlex.quote(sys.executable), "full" in stream
    command = f"{python} -m express50 config depth {stream}"
    done = subprocess.run(["/bin/sh", "-c", command], capture_output=True, text=True)
    words = "express50: OSError: standard output: No space left on device; free some space\n"
    assert (done.returncode, done.stderr) == ((1, words) if full else (0, ""))


def test_work_goes_on_where_progress_cannot_be_written(monkeypatch):
    worked = False
    with suppress(OSError), Path("/dev/full").open("w", buffering=1) as full:  # of its end
        monkeypatch.setattr(sys, "stderr", full)
        log("item 1 of 2")
        worked = True
    assert worked


def made_by(*arguments: str) -> list[str]:
    """Return the words of the last command that make would run."""
    command = ["make", "--dry-run", "--no-print-directory", "READY=", *arguments]
    # The suite itself is run by make, whose settings are not for this one.
    outer = {name: text for name, text in os.environ.items() if not name.startswith("MAKE")}
    done = subprocess.run(
        command, cwd=REPOSITORY, env=outer, capture_output=True, text=True, check=True
    )
    return shlex.split(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("target", ["ingest", "depth", "run", "tune", "train", "report"])
def test_make_takes_a_dataset_of_any_name(target):
    words = made_by(target, """DATASET=my "dat`a's" """, r"CAPTURES='caps/S 1' caps/S\ 2")
    assert words[2].split("/")[0] == """my "dat`a's" """
    assert words[3:5] == ["caps/S 1", "caps/S 2"] or target in ("depth", "train", "report")


def test_make_clean_keeps_datasets(tmp_path):
    for name in ("build/dataset/labels", "build/my data", "build/demo/data/demo"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("build/dataset/captures.json", "build/my data/captures.json", "build/log.txt"):
        (tmp_path / name).touch()
    clean = ["make", "-f", REPOSITORY / "Makefile", "clean"]
    assert subprocess.run(clean, cwd=tmp_path).returncode and (tmp_path / "build/log.txt").exists()
    (tmp_path / "express50").mkdir()  # only in a repository of this name
    subprocess.run(clean, cwd=tmp_path, check=True)
    assert sorted(path.name for path in (tmp_path / "build").iterdir()) == ["dataset", "my data"]
    assert (tmp_path / "build/dataset/labels").is_dir()
    (tmp_path / "build/demo/data/S001+S002").mkdir(parents=True)  # make demo CAPTURES=...
    subprocess.run(clean, cwd=tmp_path, check=True)
    assert (tmp_path / "build/demo/data/S001+S002").is_dir()


def test_make_takes_a_dataset_in_the_home_folder(monkeypatch):
    """Not every shell expands ~ in an argument to make."""
    monkeypatch.setenv("HOME", "/home/someone")
    assert made_by("report", "DATASET=~/data")[-1] == "/home/someone/data"
