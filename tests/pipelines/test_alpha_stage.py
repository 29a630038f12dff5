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
from tests.pipelines.alpha_scenes import clutter
from tests.pipelines.stand_ins import Bad, Difference, onnx_bright, torchscript
from tests.pipelines.test_alpha_footage import backdrop, shot
from tests.synth import make_capture


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
    return dataset


@pytest.fixture
def aligned(tmp_path, capture) -> Dataset:
    """S001 with three cameras, two expressions and plates."""
    return make_dataset(tmp_path, [capture])


def unplated(root: Path, subject: str, who: int, plate: np.ndarray) -> Path:
    """A capture with one camera and no plate, of a subject that sits still."""
    rng = np.random.default_rng(who)
    make_capture(root / subject, subject=subject, cameras=1, size=128, plates=False)
    for frame in sorted((root / subject / "cameras" / "cam00" / "frames").iterdir()):
        write_image(frame, shot(rng, plate, who)[0])
    return root / subject


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
    rng = np.random.default_rng(0)
    dataset = make_dataset(tmp_path, [unplated(tmp_path / "raw", "S001", 1, 0.3 * backdrop(rng))])
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


def test_one_camera_that_fails_leaves_the_others_done(aligned, tmp_path, monkeypatch) -> None:
    weights = torchscript(Difference(), tmp_path / "net.pt")
    index = read_index(aligned, "S001")
    monkeypatch.setattr("pipelines.alpha.source.read_plate", _wrong_for("cam01"))
    summary = run(aligned, method="bgmv2", weights=str(weights))
    status = {o.item: o.status for o in summary.outcomes}
    assert status == {f"S001/{c}": "failed" if c == "cam01" else "done" for c in index.cameras}
    assert "the plate is 10x10, the footage 64x64" in summary.outcomes[1].reason


def _wrong_for(camera: str):
    from express50.capture.frames import read_plate

    def read(dataset, subject, camera_id, undistort=True):
        if camera_id == camera:
            return np.zeros((10, 10, 3), np.uint8)
        return read_plate(dataset, subject, camera_id, undistort)

    return read


def test_without_plates_subjects_of_a_fixed_rig_stand_in_for_them(tmp_path) -> None:
    rng = np.random.default_rng(5)
    plate = backdrop(rng)
    captures = [unplated(tmp_path / "raw", f"S{k:03d}", k, plate) for k in range(2)]
    dataset = make_dataset(tmp_path, captures)
    assert run(dataset).ok
    figures = metrics_of(dataset)
    assert figures["plate"] == "footage of 2 subjects"
    words = [w["why"] for w in figures["warnings"] if w["what"] == "plate"]
    assert len(words) == 1 and "always covered and filled in" in words[0]
    truth = shot(np.random.default_rng(0), plate, 0)[1]
    alpha = read_image(dataset.item_dir("alpha", "S000/cam00") / "smile.png") / 255
    assert np.abs(alpha - truth).mean() < 0.01


def test_the_plate_of_another_subject_is_used_and_named(tmp_path) -> None:
    plate = clutter(np.random.default_rng(6), 128)
    captures = [unplated(tmp_path / "raw", f"S{k:03d}", k, plate) for k in range(2)]
    (captures[1] / "plates").mkdir()
    write_image(captures[1] / "plates" / "cam00.png", np.rint(plate).astype(np.uint8))
    dataset = make_dataset(tmp_path, captures)
    assert run(dataset).ok
    figures = metrics_of(dataset, "S000/cam00")
    assert figures["plate"] == "the plate of S001"
    assert [w["what"] for w in figures["warnings"]] == ["plate"]
    truth = shot(np.random.default_rng(0), plate, 0)[1]
    alpha = read_image(dataset.item_dir("alpha", "S000/cam00") / "smile.png") / 255
    assert np.abs(alpha - truth).mean() < 0.012
    assert metrics_of(dataset, "S001/cam00")["plate"] == "given"


def test_one_subject_that_sits_still_without_a_plate_fails_clearly(tmp_path) -> None:
    rng = np.random.default_rng(5)
    dataset = make_dataset(tmp_path, [unplated(tmp_path / "raw", "S001", 0, backdrop(rng))])
    summary = run(dataset)
    assert not summary.ok
    reason = summary.outcomes[0].reason
    assert "the subject moves too little" in reason and "plates/cam00.png" in reason
    assert "set alpha.method to salient" in reason
