"""The matte stage with networks and without plates, as the runner runs it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from express50.capture.frames import dhash, read_frame
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.errors import ConfigError
from express50.files.images import read_image, write_image
from express50.runner.runner import Summary, run_stage
from pipelines import calibrate, ingest
from pipelines.alpha import STAGE
from pipelines.alpha.config import AlphaConfig
from tests.pipelines.alpha_scenes import make_scene
from tests.pipelines.stand_ins import Bad, Difference, onnx_bright, torchscript
from tests.synth import make_capture, write_peak_frames


def run(dataset: Dataset, **settings) -> Summary:
    """The stage over every item, in this process."""
    return run_stage(STAGE, dataset, AlphaConfig(**settings), workers=0, progress=False)


def metrics_of(dataset: Dataset, item: str = "S001/cam00") -> dict:
    """Figures of one item."""
    return json.loads((dataset.item_dir("alpha", item) / "metrics.json").read_text())


def align(dataset: Dataset, subject: str) -> None:
    """Label the first frame of every cue."""
    index = read_index(dataset, subject)
    rows = {}
    for cue in index.cues:
        frame = read_frame(dataset, subject, "cam00", cue.start_frame, undistort=False)
        rows[cue.expression_id] = {
            "frame": cue.start_frame, "camera": "cam00",
            "pts": index.cameras["cam00"].pts[cue.start_frame], "dhash": dhash(frame),
            "confidence": 1.0, "annotator": "test",
        }  # fmt: skip
    folder = dataset.item_dir("align", subject)
    folder.mkdir(parents=True)
    (folder / "peaks.json").write_text(json.dumps(rows))


def make_dataset(root: Path, captures: list[Path]) -> Dataset:
    """Captures ingested, with given cameras, and labelled."""
    dataset = Dataset(root / "dataset")
    ingest.register(dataset, captures)
    for stage in (ingest.STAGE, calibrate.STAGE):
        assert run_stage(stage, dataset, stage.config(), workers=0, progress=False).ok
    for subject in dataset.subjects():
        align(dataset, subject)
    write_peak_frames(dataset)
    return dataset


@pytest.fixture
def aligned(tmp_path, capture) -> Dataset:
    """S001 with three cameras, two expressions and plates."""
    return make_dataset(tmp_path, [capture])


def unplated(root: Path) -> Path:
    """A capture with one camera and no plate."""
    path = root / "S001"
    make_capture(path, cameras=1, size=128, plates=False)
    rng = np.random.default_rng(0)
    alpha = make_scene(3, size=128).alpha[..., None]
    for frame in sorted((path / "cameras" / "cam00" / "frames").iterdir()):
        image = 200 * alpha + 40 * (1 - alpha) + rng.normal(0, 1, (128, 128, 3))
        write_image(frame, np.rint(image).astype(np.uint8))
    return path


def test_background_matting_sees_frame_and_plate(aligned, tmp_path) -> None:
    weights = torchscript(Difference(), tmp_path / "net.pt")
    assert run(aligned, method="bgmv2", weights=str(weights)).ok
    learned = read_image(aligned.item_dir("alpha", "S001/cam00") / "smile.png")
    figures = metrics_of(aligned)
    assert figures["method"] == "bgmv2" and figures["plate"] == "given"
    assert run(aligned).ok
    keyed = read_image(aligned.item_dir("alpha", "S001/cam00") / "smile.png")
    assert ((learned > 127) == (keyed > 127)).mean() > 0.97 and learned.shape == keyed.shape


def test_other_weights_run_again_and_the_same_do_not(aligned, tmp_path) -> None:
    settings = {"method": "bgmv2", "weights": str(tmp_path / "net.pt")}
    torchscript(Difference(), tmp_path / "net.pt")
    first = run(aligned, **settings)
    assert first.ok and run(aligned, **settings).count("skipped") == 3
    path = aligned.item_dir("alpha", "S001/cam00") / "neutral.png"
    before = path.read_bytes()
    other = Difference()
    other.gain.data.fill_(2.0)
    torchscript(other, tmp_path / "net.pt")
    assert run(aligned, **settings).count("done") == 3
    assert path.read_bytes() != before


def test_a_salient_network_needs_no_plate(tmp_path) -> None:
    dataset = make_dataset(tmp_path, [unplated(tmp_path / "raw")])
    settings = {
        "method": "salient",
        "weights": str(onnx_bright(tmp_path / "net.onnx", 128)),
    }
    assert run(dataset, **settings).ok
    folder = dataset.item_dir("alpha", "S001/cam00")
    names = {p.name for p in folder.glob("*.png")}
    assert names == {"neutral.png", "smile.png"}
    alpha = read_image(folder / "smile.png")
    assert alpha[64, 64] == 255 and alpha[2, 2] == 0
    assert metrics_of(dataset)["plate"] == "none"
    before = {p: p.read_bytes() for p in folder.rglob("*.*")}
    assert run(dataset, **settings, scale=0.9).count("done") == 1  # run anew, the same bytes
    assert {p: p.read_bytes() for p in folder.rglob("*.*")} == before


@pytest.mark.parametrize(("how", "message"), [("nan", "gave NaN"), ("pair", "takes 2")])
def test_a_bad_network_fails_items_in_one_line_each(aligned, tmp_path, how, message) -> None:
    path = tmp_path / "net.pt"
    if how == "nan":
        torchscript(Bad(how), path)
    if how == "pair":
        torchscript(Difference(), path)
    summary = run(aligned, method="salient", weights=str(path))
    assert summary.count("failed") == 3
    for outcome in summary.outcomes:
        assert outcome.reason.startswith("StageError: alpha.weights") and message in outcome.reason


def test_weights_that_are_not_there_are_said_once_and_cost_nothing(aligned, tmp_path) -> None:
    assert run(aligned).count("done") == 3
    with pytest.raises(ConfigError, match="alpha.weights .*no such file"):
        run(aligned, method="salient", weights=str(tmp_path / "net.pt"))
    assert run(aligned).count("skipped") == 3


def test_one_camera_that_fails_leaves_the_others_done(aligned) -> None:
    aligned.plate_file("S001", "cam01").unlink()
    status = {o.item: o.status for o in run(aligned).outcomes}
    assert status == {"S001/cam00": "done", "S001/cam01": "failed", "S001/cam02": "done"}


def test_a_frame_that_was_not_written_is_dropped(aligned) -> None:
    aligned.frame_file("S001", "smile", "cam01").unlink()
    assert run(aligned).ok
    assert [row["what"] for row in metrics_of(aligned, "S001/cam01")["dropped"]] == ["smile"]
    assert "smile" in metrics_of(aligned, "S001/cam00")["coverage"]


def test_keying_without_a_plate_is_refused(tmp_path) -> None:
    dataset = make_dataset(tmp_path, [unplated(tmp_path / "raw")])
    summary = run(dataset)
    assert [o.status for o in summary.outcomes] == ["failed"]
    assert "plates/cam00.png" in summary.outcomes[0].reason
