"""The whole chain on a tiny recording: it runs, it is right, and kills do not change its bytes."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.accuracy import measure_dataset
from benchmarks.demo import pick_views
from express50.__main__ import main
from express50.capture.frames import FrameReader
from express50.capture.index import read_index, read_peaks
from express50.contract.layout import Dataset
from express50.files.images import decode_image
from express50.runner import worker
from express50.shards.reader import ShardReader
from tests.faults.toy import tree

pytestmark = pytest.mark.slow

STAGES = (
    "ingest", "calibrate", "observe", "align", "frames", "matte", "track", "depth",
    "register", "regions", "encode", "pack",
)  # fmt: skip
SIZE = ["--set", "encode.size=96"]
SETTINGS = {"encode": SIZE, "pack": [*SIZE, "--set", 'pack.test_subjects=["S002"]']}
RECORDING = [
    "--subjects=1", "--cameras=6", "--give-calibration", "--width=192", "--height=192",
    "--frames-per-expression=4", "--board-frames=0", "--seed=5", "--workers=1",
]  # fmt: skip
PEOPLE = [
    ["--first-subject=1", "--expressions=neutral,smile"],
    ["--first-subject=2", "--expressions=neutral,jaw_open"],
]


def _captures(twin: Path) -> list[str]:
    return [str(p) for p in sorted((twin / "captures").iterdir())]


def _stage(name: str, dataset: Path, twin: Path) -> list[str]:
    captures = _captures(twin) if name == "ingest" else []
    return [name, str(dataset), *captures, "--preset", "draft", *SETTINGS.get(name, [])]


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """Two people before six cameras; each shows the neutral expression and one of two others."""
    root = tmp_path_factory.mktemp("twin")
    for number, person in enumerate(PEOPLE):
        alone = root / f"alone{number}"
        assert main(["twin", "record", str(alone), *RECORDING, *person]) == 0
        shutil.copytree(alone, root, dirs_exist_ok=True)
    return root


@pytest.fixture(scope="module")
def reads() -> dict[str, list[tuple[str, int]]]:
    """Footage path and frame of every decode after ingest's scan, by stage."""
    return {name: [] for name in STAGES}


@pytest.fixture(scope="module")
def dataset(twin, reads, tmp_path_factory):
    """Every stage has run over the recording, in this process."""
    root = tmp_path_factory.mktemp("chain") / "dataset"
    original = FrameReader.read
    for name in STAGES:

        def counted(self, frame, exact=False, rows=reads[name]):
            rows.append((str(self.path), frame))
            return original(self, frame, exact)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(FrameReader, "read", counted)
            assert main([*_stage(name, root, twin), "--workers", "0"]) == 0, name
    return Dataset(root)


def test_each_peak_frame_is_decoded_once(dataset, reads):
    """Only `frames` opens the footage for peaks.

    `calibrate` checks cameras at moments of its own, but not with `draft`; with `draft`, `observe`
    decodes the frames that it watches.
    """
    expected = []
    for subject in dataset.subjects():
        index = read_index(dataset, subject)
        for frame in read_peaks(dataset, subject).values():
            expected += [(str(index.capture / c.source), frame) for c in index.cameras.values()]
    assert sorted(reads["frames"]) == sorted(expected)
    assert len(expected) == 2 * 2 * 6
    assert len({path for path, _ in reads["observe"]}) <= len(dataset.subjects())  # one camera
    others = reads.keys() - {"calibrate", "frames", "observe"}
    assert not [name for name in others if reads[name]]


def stage_bytes(root: Path) -> dict[str, bytes]:
    """Read every published file; the ledger and labels hold times of day and are left out."""
    return {f"{s}/{name}": data for s in STAGES for name, data in tree(root / s).items()}


def test_footage_alone_gives_figures_close_to_the_truth(dataset, twin, tmp_path):
    """Bounds are at most 1.5 times the measured errors; of shares, of what they lack to 1."""
    figures = measure_dataset(dataset, twin / "truth", tmp_path / "accuracy")
    assert figures["align.peak_error_frames_median"] <= 0.75
    assert figures["matte.mae"] < 0.0093
    assert figures["track.vertex_rmse_mm"] < 4.9
    assert figures["depth.abs_error_mm_median"] < 3.4
    assert figures["depth.coverage"] > 0.967
    assert figures["regions.head_mae"] < 0.0109 and figures["regions.iou_mean"] > 0.67
    assert (tmp_path / "accuracy" / "depth_error.jpg").exists()


def test_shards_hold_every_view_and_split_by_subject(dataset):
    reader = ShardReader(dataset.item_dir("pack", "shards"))
    assert len(reader) == 2 * 2 * 6
    sample = reader.sample(0)
    assert sample["rgb"].shape == (96, 96, 3)
    assert sample["parts"].shape == (96, 96) and sample["meta"]["torso"] == "removed"
    splits = json.loads((dataset.item_dir("pack", "shards") / "splits.json").read_text())
    assert splits["test"] == ["S002"]


def test_a_second_run_skips_everything(dataset, twin, capsys):
    for name in STAGES:
        assert main([*_stage(name, dataset.root, twin), "--workers", "0", "--json"]) == 0
        account = json.loads(capsys.readouterr().out)
        assert account["skipped"] == account["read"], name


def wrong_commands(root: Path, twin: Path, junk: Path) -> list[list[str]]:
    """List what goes wrong by a slip of the hand, for every stage, on a finished dataset."""
    (junk / "junk.npz").write_bytes(b"no weights")
    (junk / "junk.toml").write_text("[track\niterations = many")
    (junk / "old.toml").write_text("[track]\nrender_rounds = 3\n")
    (junk / "labels.json").write_text('[{"subject": "S001"}]')
    lost = str(junk / "lost" / "model.pth")
    wrong = [["--set", "{stage}.unknown=1"], ["--preset", "refrence"], ["--workers", "-1"]]
    wrong += [["--config", str(junk / name)] for name in ("lost.toml", "junk.toml")]
    rows = [[*_stage(stage, root, twin), *(w.format(stage=stage) for w in words)]
            for stage in STAGES for words in wrong]  # fmt: skip
    for stage, setting in [
        ("matte", 'method="bgmv2"'), ("matte", f'weights="{lost}"'),
        ("matte", f'weights="{junk / "junk.npz"}"'), ("matte", 'method="gren"'),
        ("track", f'landmarks="{junk / "junk.npz"}"'), ("track", 'landmarks="fan:lost.pt"'),
        ("track", f'head="{lost}"'), ("track", "clip_rounds=maybe"),
        ("depth", "voxel_mm=-1"), ("depth", "voxel_mm=nan"), ("register", "weight=few"),
        ("regions", f'segmentation="{lost}"'), ("encode", "size=-4"), ("encode", 'profile="gif"'),
        ("calibrate", 'camera_model="FISHEYE"'), ("align", 'accept="all"'),
    ]:  # fmt: skip
        rows.append([*_stage(stage, root, twin), "--set", f"{stage}.{setting}"])
    place = str(root)
    return [
        *rows,
        [*_stage("track", root, twin), "--config", str(junk / "old.toml")],
        ["ingest", place, str(junk / "lost")], ["ingest", place, place],
        ["track", str(junk / "nowhere")], ["depth", place, "--set", "matte.method=key"],
        ["subject", "withdraw", place, "S999"], ["dephts", place],
        ["annotate", "mark", place, "S009", "smile", "3", "--annotator", "me"],
        ["annotate", "mark", place, "S001", "smile", "99999", "--annotator", "me"],
        ["annotate", "import", place, str(junk / "labels.json")],
        ["cameras", "import", place, "S001", str(junk / "junk.npz")],
        ["export", place, "S001/nothing", str(junk / "out")],
    ]  # fmt: skip


def test_fifty_wrong_commands_change_nothing(dataset, twin, tmp_path, capsys, monkeypatch):
    before = stage_bytes(dataset.root)
    labels = {s: dataset.labels_file(s).read_bytes() for s in dataset.subjects()}
    for command in random.Random(0).sample(wrong_commands(dataset.root, twin, tmp_path), 50):
        if command[0] in STAGES:
            command += ["--workers", "0"] * ("--workers" not in command)
        capsys.readouterr()
        try:
            code = main(command)
        except SystemExit as end:
            code = end.code
        error = capsys.readouterr().err
        assert code in (1, 2), (command, error)
        assert "Traceback" not in error and "unexpected" not in error, (command, error)

    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:  # new settings by mistake, stopped half way
        patch.setattr(worker, "_run_and_publish", interrupted)
        again = [*_stage("depth", dataset.root, twin), "--set", "depth.voxel_mm=3", "--workers=0"]
        assert main(again) == 130
    assert stage_bytes(dataset.root) == before
    assert {s: dataset.labels_file(s).read_bytes() for s in dataset.subjects()} == labels
    code = main(["check", str(dataset.root)])
    assert code == 0, capsys.readouterr()
    capsys.readouterr()
    test_a_second_run_skips_everything(dataset, twin, capsys)


def test_kills_at_random_moments_change_no_byte(dataset, twin, tmp_path):
    """All of one person is made again, and stages that write most are killed, workers and all.

    They write videos read, mattes, surfaces and shards; then they run to their end in this process.
    `benchmarks.faults` kills at dozens of moments.
    """
    root = tmp_path / "again"
    shutil.copytree(dataset.root, root)
    moments, killed = random.Random(5), []
    for name in STAGES:
        again = [*_stage(name, root, twin), *(["--items=S001*"] if name != "pack" else [])]
        shutil.rmtree(root / name / ("S001" if name != "pack" else "shards"))
        if name in ("ingest", "matte", "depth", "encode"):
            moment = moments.uniform(0.0, 0.2)
            killed.append(kill_run(again, Dataset(root).staging_dir, name, moment))
        assert main([*again, "--workers", "0"]) == 0, name
    assert any(killed)  # on a quick machine one may be over before
    assert stage_bytes(root) == stage_bytes(dataset.root)


def kill_run(arguments: list[str], staging: Path, stage: str, seconds: float) -> bool:
    """Kill a stage's processes some seconds after they begin to write; return whether they ran."""
    process = subprocess.Popen(
        [sys.executable, "-m", "express50", *arguments, "--workers=1"], start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    give_up = time.monotonic() + 240
    while not list(staging.glob(f"{stage}-*/*")):
        assert time.monotonic() < give_up and process.poll() is None, stage
        time.sleep(0.02)
    time.sleep(seconds)
    os.killpg(process.pid, signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def test_report_and_training_follow(dataset, tmp_path):
    from grmm.cli import main as grmm

    held_out, given = pick_views(dataset, "S001")
    assert len({held_out, *given}) == 3
    shards = str(dataset.item_dir("pack", "shards"))
    out = dataset.root / "grmm" / "train"
    assert grmm(["train", shards, str(out), "--preset", "demo", "--seconds", "3"]) == 0
    assert json.loads((out / "metrics.json").read_text())["iterations"] >= 1
    assert main(["report", str(dataset.root), "--out", str(tmp_path)]) == 0
    page = (tmp_path / "index.html").read_text()
    assert "training" in page
    assert page.count("data:image/jpeg;base64,") > 10
    assert decode_image((dataset.item_dir("align", "S001") / "qc" / "peaks.jpg").read_bytes()).size
