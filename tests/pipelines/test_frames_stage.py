"""The frames stage: peaks are decoded once, undistorted, corrected and kept without loss."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from express50.capture import frames as frames_module
from express50.capture.frames import (
    read_frame,
    read_peak_frame,
    read_plate_image,
    read_recorded_plate,
    write_frame,
)
from express50.capture.index import read_index, read_peaks
from express50.contract.layout import PLATES
from express50.errors import CaptureError
from express50.files.calibration import write_cameras
from express50.files.images import read_image, write_image
from express50.geometry.sampling import undistort_image
from express50.runner.runner import run_stage
from pipelines.frames import STAGE
from tests.pipelines.test_matte_stage import make_dataset
from tests.synth import make_capture, make_rig


def run(dataset, **settings):
    return run_stage(STAGE, dataset, STAGE.config(**settings), workers=0, progress=False)


def metrics_of(dataset, item):
    return json.loads((dataset.item_dir("frames", item) / "metrics.json").read_text())


@pytest.fixture
def dataset(tmp_path, capture):
    """S001 with a lens that bends."""
    dataset = make_dataset(tmp_path, [capture])
    rig = {
        name: replace(camera, params=(*camera.params[:4], -0.2, 0.05, 0.01, 0.0))
        for name, camera in make_rig().items()
    }
    write_cameras(dataset.cameras_file("S001"), rig)
    assert run(dataset).ok
    return dataset


def test_a_lens_that_folds_leaves_black_and_says_so(dataset):
    rig = make_rig()
    name = next(iter(rig))
    rig[name] = replace(rig[name], params=(*rig[name].params[:4], -3.0, 0.0, 0.0, 0.0))
    write_cameras(dataset.cameras_file("S001"), rig)
    assert run(dataset).ok
    [warning] = metrics_of(dataset, "S001/neutral")["warnings"]
    assert warning["what"] == name and "folds within the image" in warning["why"]
    written = read_peak_frame(dataset, "S001", "neutral", name)
    assert not written[0, 0].any() and written[written.shape[0] // 2].any()


def test_written_frames_are_the_undistorted_footage(dataset):
    peaks = read_peaks(dataset, "S001")
    rig = frames_module.read_cameras_of(dataset, "S001", undistorted=False)
    index = read_index(dataset, "S001")
    assert set(STAGE.items(dataset)) == {"S001/neutral", "S001/smile", f"S001/{PLATES}"}
    for camera in rig:
        for expression, frame in peaks.items():
            written = read_peak_frame(dataset, "S001", expression, camera)
            assert np.array_equal(written, read_frame(dataset, "S001", camera, frame))
        bare = undistort_image(read_recorded_plate(index, camera), rig[camera])
        assert np.array_equal(read_plate_image(dataset, "S001", camera), bare)


def test_each_peak_is_decoded_once_and_only_by_this_stage(dataset, monkeypatch):
    from pipelines.matte import STAGE as MATTE

    read: list[tuple[str, int]] = []
    original = frames_module.FrameReader.read

    def counted(self, frame):
        read.append((self.camera_id, frame))
        return original(self, frame)

    monkeypatch.setattr(frames_module.FrameReader, "read", counted)
    shutil.rmtree(dataset.stage_dir("frames"))
    assert run(dataset).ok
    peaks = read_peaks(dataset, "S001")
    assert sorted(read) == sorted((c, f) for c in make_rig() for f in peaks.values())
    assert run_stage(MATTE, dataset, MATTE.config(), workers=0, progress=False).ok
    assert len(read) == 6


def test_a_camera_whose_footage_changed_is_dropped(tmp_path):
    make_capture(tmp_path / "raw")
    dataset = make_dataset(tmp_path, [tmp_path / "raw"])
    peak = read_peaks(dataset, "S001")["smile"]
    noise = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    path = tmp_path / f"raw/cameras/cam01/frames/{peak:06d}.png"
    write_image(path, np.kron(noise, np.ones((8, 8, 1), np.uint8)))
    write_image(tmp_path / "raw/plates/cam02.png", np.zeros((20, 30, 3), np.uint8))
    shutil.rmtree(dataset.stage_dir("frames"))
    assert run(dataset).ok
    assert [row["what"] for row in metrics_of(dataset, "S001/smile")["dropped"]] == ["cam01"]
    assert [row["what"] for row in metrics_of(dataset, f"S001/{PLATES}")["dropped"]] == ["cam02"]
    with pytest.raises(CaptureError):
        read_peak_frame(dataset, "S001", "smile", "cam01")
    assert read_plate_image(dataset, "S001", "cam02") is None


def test_a_label_on_other_footage_fails_its_expression_alone(dataset):
    path = dataset.peaks_file("S001")
    rows = json.loads(path.read_text())
    rows["smile"]["dhash"] = "0" * 16
    path.write_text(json.dumps(rows))
    status = {o.item: o.status for o in run(dataset).outcomes}
    assert status == {
        "S001/neutral": "skipped", "S001/smile": "failed", f"S001/{PLATES}": "skipped",
    }  # fmt: skip


def test_footage_of_16_bits_is_written_with_8(tmp_path):
    make_capture(tmp_path / "raw", cameras=1)
    for path in (tmp_path / "raw/cameras/cam00/frames").iterdir():
        image = read_image(path).astype(np.uint16)
        write_image(path, image * 257 + (image % 7))
    dataset = make_dataset(tmp_path, [tmp_path / "raw"])
    peak = read_peaks(dataset, "S001")["smile"]
    truth = read_image(tmp_path / f"raw/cameras/cam00/frames/{peak:06d}.png")
    written = read_peak_frame(dataset, "S001", "smile", "cam00")
    assert written.dtype == np.uint8 and np.array_equal(written, truth // 257)


def test_the_same_image_gives_the_same_bytes(tmp_path):
    image = np.random.default_rng(1).integers(0, 65536, (40, 60, 3), dtype=np.uint16)
    for name in "ab":
        write_frame(tmp_path / f"{name}.jxl", image)
    assert (tmp_path / "a.jxl").read_bytes() == (tmp_path / "b.jxl").read_bytes()
    assert np.array_equal(read_image(tmp_path / "a.jxl"), image)


@pytest.mark.parametrize("cut", [0, 10, 300, -3])
def test_a_damaged_peak_frame_is_one_clear_line(tmp_path, cut):
    make_capture(tmp_path / "raw", cameras=1)
    dataset = make_dataset(tmp_path, [tmp_path / "raw"])
    path = dataset.frame_file("S001", "smile", "cam00")
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(CaptureError, match=r"cam00\.jxl: truncated or damaged.*again"):
        read_peak_frame(dataset, "S001", "smile", "cam00")
