"""The frames stage: peaks are decoded once, undistorted, corrected and kept without loss."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import skimage.data

from express50.capture import frames as frames_module
from express50.capture.frames import (
    picture_sizes,
    read_peak_frame,
    read_plate_image,
    read_recorded_plate,
    write_frame,
)
from express50.capture.index import read_index, read_peaks
from express50.contract.layout import PLATES, Dataset
from express50.errors import CaptureError, ConfigError, FormatError
from express50.files.calibration import write_cameras
from express50.files.images import read_image, write_image
from express50.geometry.cameras import pinhole, project
from express50.geometry.pixels import LIGHT_OF_LEVEL, reduce_light, shrink, shrunk_size
from express50.geometry.sampling import undistort_image
from pipelines.calibrate import footage
from pipelines.frames import STAGE, stage
from pipelines.matte import wall
from tests.pipelines.test_matte_stage import make_dataset
from tests.stages import metrics_of, notes_of, run_here
from tests.synth import make_capture, make_rig, read_frame


def run(dataset, **settings):
    return run_here(STAGE, dataset, **settings)


@pytest.fixture(scope="module")
def bent(tmp_path_factory, capture):
    """S001 with a lens that bends; only copied."""
    dataset = make_dataset(tmp_path_factory.mktemp("bent"), [capture])
    rig = {
        name: replace(camera, params=(*camera.params[:4], -0.2, 0.05, 0.01, 0.0))
        for name, camera in make_rig().items()
    }
    write_cameras(dataset.cameras_file("S001"), rig)
    assert run(dataset).ok
    return dataset


@pytest.fixture
def dataset(tmp_path, bent):
    """S001 with a lens that bends."""
    return Dataset(shutil.copytree(bent.root, tmp_path / "dataset"))


def test_a_lens_that_folds_leaves_black_pixels_and_a_warning(dataset):
    rig = make_rig()
    name = next(iter(rig))
    rig[name] = replace(rig[name], params=(*rig[name].params[:4], -3.0, 0.0, 0.0, 0.0))
    write_cameras(dataset.cameras_file("S001"), rig)
    assert run(dataset).ok
    [warning] = metrics_of(dataset, "frames", "S001/neutral")["warnings"]
    assert warning["what"] == name and "folds within the image" in warning["why"]
    written = read_peak_frame(dataset, "S001", "neutral", name)
    assert not written[0, 0].any() and written[written.shape[0] // 2].any()


def test_a_dark_corner_that_hides_nobody_gives_no_warning(dataset, monkeypatch):
    monkeypatch.setattr("pipelines.frames.stage.pictured_share", lambda camera: 0.9995)
    summary = run(dataset, image_side=64)
    assert summary.ok and not notes_of(dataset, "frames", "S001/neutral")


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

    def counted(self, frame, exact=False):
        read.append((self.camera_id, frame))
        return original(self, frame, exact)

    monkeypatch.setattr(frames_module.FrameReader, "read", counted)
    shutil.rmtree(dataset.stage_dir("frames"))
    assert run(dataset).ok
    peaks = read_peaks(dataset, "S001")
    assert sorted(read) == sorted((c, f) for c in make_rig() for f in peaks.values())
    assert run_here(MATTE, dataset).ok
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
    assert [*notes_of(dataset, "frames", "S001/smile", "dropped")] == ["cam01"]
    assert [*notes_of(dataset, "frames", f"S001/{PLATES}", "dropped")] == ["cam02"]
    with pytest.raises(CaptureError):
        read_peak_frame(dataset, "S001", "smile", "cam01")
    assert read_plate_image(dataset, "S001", "cam02") is None


def test_plates_stand_while_the_capture_is_away(tmp_path):
    make_capture(tmp_path / "raw")
    dataset = make_dataset(tmp_path, [tmp_path / "raw"])
    (tmp_path / "raw").rename(tmp_path / "away")
    summary = run(dataset)
    assert [o.item for o in summary.outcomes if o.status == "failed"] == [f"S001/{PLATES}"]
    assert read_plate_image(dataset, "S001", "cam02") is not None


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
        write_frame(tmp_path / f"{name}.tif", image)
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()
    assert np.array_equal(read_image(tmp_path / "a.tif"), image)


@pytest.mark.parametrize("cut", [0, 10, 300, -3])
def test_a_damaged_peak_frame_is_one_clear_line(tmp_path, cut):
    make_capture(tmp_path / "raw", cameras=1)
    dataset = make_dataset(tmp_path, [tmp_path / "raw"])
    path = dataset.frame_file("S001", "smile", "cam00")
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(CaptureError, match=r"cam00\.tif: truncated or damaged.*again"):
        read_peak_frame(dataset, "S001", "smile", "cam00")


def whole_light(image):
    return LIGHT_OF_LEVEL[image].astype(np.float64).mean((0, 1))


@pytest.mark.parametrize("size", [(64, 48), (63, 47), (640, 1), (17, 31), (1, 1)])
def test_reduced_pictures_keep_their_light_and_are_never_enlarged(size):
    image = np.random.default_rng(2).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    for side in (16, 25, 1000):
        width, height = shrunk_size(*size, side)
        assert (width, height) == (size if side >= max(size) else (width, height))
        assert max(width, height) == min(side, max(size))
        small = reduce_light(image, width, height)
        assert small.shape == (height, width, 3)
        assert np.allclose(whole_light(small), whole_light(image), atol=0.01)
        if (width, height) == size:
            assert np.array_equal(small, image)


def test_cameras_follow_their_pictures_exactly(dataset):
    recorded = frames_module.read_recorded_cameras(dataset, "S001")
    assert run(dataset, image_side=37).ok
    seen = frames_module.read_cameras_of(dataset, "S001", undistorted=False)
    pinholes = frames_module.read_cameras_of(dataset, "S001")
    points = np.random.default_rng(3).normal(0, 0.05, (50, 3))
    assert frames_module.read_recorded_cameras(dataset, "S001") == recorded
    for name, camera in recorded.items():
        small = seen[name]
        assert max(small.width, small.height) == 37 and (small.dist == camera.dist).all()
        scale = np.array([small.width / camera.width, small.height / camera.height])
        for one, two in ((camera, small), (pinhole(camera), pinholes[name])):
            expected = project(one, points)[0] * scale
            np.testing.assert_allclose(project(two, points)[0], expected, rtol=0, atol=1e-9)
        shape = (small.height, small.width, 3)
        assert read_peak_frame(dataset, "S001", "smile", name).shape == shape
        assert read_plate_image(dataset, "S001", name).shape == shape
        again = read_frame(dataset, "S001", name, read_peaks(dataset, "S001")["smile"])
        assert np.array_equal(again, read_peak_frame(dataset, "S001", "smile", name))


def test_a_side_longer_than_the_footage_changes_nothing(dataset):
    cameras = frames_module.read_cameras_of(dataset, "S001")
    files = sorted(dataset.stage_dir("frames").rglob("*.tif"))
    before = [path.read_bytes() for path in files]
    assert run(dataset, image_side=4000).ok
    assert [path.read_bytes() for path in files] == before
    after = frames_module.read_cameras_of(dataset, "S001")
    assert {n: (c.params, c.width, c.height) for n, c in after.items()} == {
        n: (c.params, c.width, c.height) for n, c in cameras.items()
    }


def test_a_frame_left_at_another_size_is_named(dataset):
    old = dataset.frame_file("S001", "smile", "cam00").read_bytes()
    assert run(dataset, image_side=32).ok
    dataset.frame_file("S001", "smile", "cam00").write_bytes(old)
    with pytest.raises(CaptureError, match=r"cam00\.tif: \d+x\d+, expected 32x.*image_side"):
        read_peak_frame(dataset, "S001", "smile", "cam00")


def test_later_stages_work_at_the_reduced_size_and_rerun_with_it_alone(dataset):
    from pipelines.matte import STAGE as MATTE

    def matte():
        return run_here(MATTE, dataset)

    def shape():
        return read_image(dataset.matte_file("S001", "smile", "cam00")).shape

    assert matte().count("done") == 2
    native = shape()
    assert run(dataset, image_side=max(native) // 2).count("done") == 3
    assert matte().count("done") == 2
    assert shape() == tuple(round(n * (max(native) // 2) / max(native)) for n in native)
    assert run(dataset, image_side=max(native) // 2).count("skipped") == 3
    assert matte().count("skipped") == 2
    with pytest.raises(ConfigError):
        STAGE.config(image_side=8)


def test_unreadable_sizes_of_pictures_are_one_clear_line(dataset):
    path = dataset.picture_sizes_file("S001")
    for text in ("[]", '{"cam00": [0, 4]}', '{"cam00": 3}', "{"):
        path.write_text(text)
        with pytest.raises(FormatError, match=r"pictures\.json"):
            frames_module.read_cameras_of(dataset, "S001")


def test_a_plate_that_shows_a_face_is_named(tmp_path):
    make_capture(tmp_path / "S001", size=128)
    face = shrink(skimage.data.astronaut()[:256, 100:356], 128)
    write_image(tmp_path / "S001" / "plates" / "cam01.png", face)
    dataset = make_dataset(tmp_path, [tmp_path / "S001"])
    (outcome,) = run_here(STAGE, dataset, ["S001/_plates"], preset="draft", image_side=120).outcomes
    (note,) = outcome.warnings
    assert note.what == "cam01" and "its plate shows a face" in note.why


def test_a_damaged_camera_does_not_hide_the_walls_of_the_others(dataset, monkeypatch):
    index = replace(read_index(dataset, "S001"), plates={})
    seen = {}

    def damaged(*unused):
        raise CaptureError("damaged")

    def learn(cameras, read, frames, wanted):
        seen.update(frames=list(frames), wanted=wanted)
        return iter(())

    monkeypatch.setattr(stage, "read_index", lambda *unused: index)
    monkeypatch.setattr(footage, "instants", damaged)
    monkeypatch.setattr(wall, "learn_walls", learn)
    stage._write_walls(dataset, "S001", picture_sizes(dataset, "S001"), dataset.root)
    assert seen["wanted"] == sorted(index.cameras)
    assert len(seen["frames"]) == 4 and max(seen["frames"]) < index.frames
