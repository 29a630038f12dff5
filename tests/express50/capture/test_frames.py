"""Pixels of a dataset: exact frames, identity checks, proxies, undistortion, peaks."""

import json
import tarfile

import cv2
import numpy as np
import pytest

from express50.capture.frames import (
    FootageReader,
    FrameReader,
    dhash,
    read_cameras_of,
    read_proxy,
    read_recorded_plate,
)
from express50.capture.index import check_peak, read_index, read_peak_rows, read_peaks
from express50.errors import CaptureError, FormatError, StageError
from express50.files.calibration import write_cameras
from express50.files.containers import to_srgb
from express50.files.images import write_image
from express50.files.video import VideoReader
from express50.geometry.sampling import undistort_image
from tests.stages import ingest_captures
from tests.synth import make_capture, make_rig, read_frame, render_ball


def write_calibration(dataset, rig):
    folder = dataset.item_dir("calibrate", "S001")
    folder.mkdir(parents=True, exist_ok=True)
    write_cameras(folder / "cameras.json", rig)


def test_frames_and_plates_are_the_recorded_pixels(ingested):
    rig = make_rig()
    for frame in (0, 5, 2):
        expected = render_ball(rig["cam01"], frame)
        assert np.array_equal(read_frame(ingested, "S001", "cam01", frame, False), expected)
    plate = read_recorded_plate(read_index(ingested, "S001"), "cam02")
    assert np.array_equal(plate, render_ball(rig["cam02"], None))


def test_video_frames_are_exact_in_any_order(tmp_path):
    make_capture(tmp_path / "S001", frames=30, video=True, size=64)
    dataset = ingest_captures(tmp_path / "data", tmp_path / "S001", preset="standard")
    reader = FrameReader(read_index(dataset, "S001"), "cam00")
    sequential = [reader.read(n) for n in range(30)]
    for frame in (29, 0, 17, 16, 3):
        assert np.array_equal(read_frame(dataset, "S001", "cam00", frame, False), sequential[frame])
    truth = render_ball(make_rig()["cam00"], 17).astype(float)
    assert np.abs(sequential[17] - truth).mean() < 6  # 4:2:0 chroma at 64 px


def test_each_video_is_opened_once_and_closed_at_the_end(tmp_path, monkeypatch):
    opened, closed = [], []
    monkeypatch.setattr(VideoReader, "restart", lambda self: pytest.fail("read back"))
    start, stop = VideoReader.__init__, VideoReader.close
    monkeypatch.setattr(VideoReader, "__init__", lambda *a: (opened.append(1), start(*a))[1])
    monkeypatch.setattr(VideoReader, "close", lambda self: (closed.append(1), stop(self))[1])
    make_capture(tmp_path / "S001", cameras=4, video=True)
    dataset = ingest_captures(tmp_path / "data", tmp_path / "S001", preset="standard")
    write_calibration(dataset, make_rig(4))
    with FootageReader(dataset, "S001") as footage:
        for frame in range(3):
            for name in read_index(dataset, "S001").cameras:
                footage.read(name, frame)
        assert len(opened) == 4 and not closed
    assert len(closed) == 4


def test_changed_footage_is_noticed(tmp_path):
    make_capture(tmp_path / "S001", cameras=1)
    dataset = ingest_captures(tmp_path / "data", tmp_path / "S001", preset="standard")
    noise = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    other = np.kron(noise, np.ones((8, 8, 1), np.uint8))
    write_image(tmp_path / "S001/cameras/cam00/frames/000002.png", other)
    with pytest.raises(CaptureError, match="frame 2 has hash .* changed since it was ingested"):
        read_frame(dataset, "S001", "cam00", 2, undistort=False)
    (tmp_path / "S001").rename(tmp_path / "moved")
    with pytest.raises(CaptureError, match="S001: no such folder .* has moved, run 'express50 in"):
        read_frame(dataset, "S001", "cam00", 2, undistort=False)


def test_unknown_camera_and_frame_are_refused(ingested):
    with pytest.raises(CaptureError, match="no camera 'cam9'; expected one of cam00, cam01"):
        read_frame(ingested, "S001", "cam9", 0, undistort=False)
    for frame in (-1, 6):
        with pytest.raises(CaptureError, match=f"frame {frame} does not exist, expected 0 to 5"):
            read_frame(ingested, "S001", "cam00", frame, undistort=False)
        with pytest.raises(CaptureError, match="no frame"):
            read_proxy(ingested, "S001", "cam00", frame)


def test_undistortion_goes_by_the_calibrated_camera(ingested):
    rig = make_rig()
    camera = rig["cam00"]
    params = (*camera.params[:4], -0.3, 0.1, 0.01, 0.0)
    bent = type(camera)("cam00", 64, 64, "OPENCV", params, camera.cam_from_world)
    with pytest.raises(StageError, match="not calibrated; run 'express50 calibrate"):
        read_frame(ingested, "S001", "cam00", 0)
    write_calibration(ingested, rig | {"cam00": bent})
    expected = undistort_image(render_ball(camera, 0), bent)
    assert np.array_equal(read_frame(ingested, "S001", "cam00", 0), expected)
    assert not np.array_equal(expected, render_ball(camera, 0))
    straight = read_cameras_of(ingested, "S001")
    assert list(straight) == sorted(rig)
    assert not straight["cam00"].dist.any()
    assert read_cameras_of(ingested, "S001", undistorted=False)["cam00"].dist.any()


def test_proxies_are_plain_tar_members(ingested):
    folder = ingested.proxies_dir("S001")
    with tarfile.open(folder / "cam00.tar") as tar:
        assert tar.getnames() == [f"{n:06d}.jpg" for n in range(6)]
        assert {(m.mtime, m.uid, m.uname) for m in tar.getmembers()} == {(0, 0, "")}
        data = tar.extractfile("000003.jpg").read()
    offset, size = json.loads((folder / "cam00.json").read_text())[3]
    assert (folder / "cam00.tar").read_bytes()[offset : offset + size] == data
    proxy = read_proxy(ingested, "S001", "cam00", 3)
    assert np.abs(proxy - render_ball(make_rig()["cam00"], 3).astype(float)).mean() < 8


def test_peaks_are_checked_against_the_footage(ingested):
    index = read_index(ingested, "S001")
    row = {"frame": 1, "camera": "cam00", "pts": 1, "dhash": index.cameras["cam00"].dhash[1]}
    path = ingested.peaks_file("S001")
    with pytest.raises(StageError, match="not aligned"):
        read_peaks(ingested, "S001")
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"smile": row}))
    assert read_peaks(ingested, "S001") == {"smile": 1}
    check_peak(index, "smile", read_peak_rows(ingested, "S001")["smile"])
    for change in ({"dhash": "0" * 16}, {"camera": "cam9"}, {"frame": 99}):
        path.write_text(json.dumps({"smile": row | change}))
        with pytest.raises(CaptureError):
            check_peak(index, "smile", read_peak_rows(ingested, "S001")["smile"])
    path.write_text('{"smile": 3}')
    with pytest.raises(FormatError, match="not a table of peaks"):
        read_peaks(ingested, "S001")


@pytest.mark.parametrize("size", [(360, 640), (320, 320), (97, 131), (8, 9), (8, 5)])
def test_dhash_has_the_bits_of_opencv(size):
    rng = np.random.default_rng(0)
    for level in (0, 20, 200):
        image = rng.integers(level, level + 30, (*size, 3)).astype(np.uint8)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        cells = cv2.resize(grey, (9, 8), interpolation=cv2.INTER_AREA)
        assert dhash(image) == np.packbits(cells[:, :-1] < cells[:, 1:]).tobytes().hex()


def test_dhash_bits_follow_their_definition():
    rising = np.repeat(np.repeat(np.arange(9, dtype=np.uint8) * 20, 7)[None], 40, 0)
    image = np.stack([rising] * 3, -1)
    assert dhash(image) == "f" * 16
    assert dhash(image[:, ::-1]) == "0" * 16
    half = image.copy()
    half[20:] = half[20:, ::-1]
    assert dhash(half) == "f" * 8 + "0" * 8


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (np.full((2, 2), 7, np.uint8), 7),
        (np.full((2, 2, 4), 9, np.uint8), 9),
        (np.full((2, 2, 2), 9, np.uint8), 9),
        (np.full((2, 2, 3), 65535, np.uint16), 255),
        (np.full((2, 2, 3), 257 * 3, np.uint16), 3),
        (np.full((2, 2, 3), 2.0, np.float32), 255),
        # IEC 61966-2-1: 128 of 255 is linear 0.2159
        (np.full((2, 2, 3), 0.2159, np.float32), 128),
    ],
)
def test_any_image_becomes_8_bit_srgb(image, expected):
    result = to_srgb(image)
    assert (result.shape, result.dtype) == ((2, 2, 3), np.uint8)
    assert set(result.reshape(-1).tolist()) == {expected}


@pytest.mark.parametrize(("value", "message"), [(np.nan, "NaN"), (120, "light from 0 to 1")])
def test_light_that_is_not_finite_or_on_another_scale_is_refused(value, message):
    with pytest.raises(ValueError, match=message):
        to_srgb(np.full((2, 2, 3), value, np.float32))


def test_a_plate_of_another_size_is_one_clear_error(tmp_path):
    make_capture(tmp_path / "raw")
    dataset = ingest_captures(tmp_path / "data", tmp_path / "raw", preset="standard")
    write_image(tmp_path / "raw" / "plates" / "cam01.png", np.zeros((20, 30, 3), np.uint8))
    with pytest.raises(CaptureError, match="30x20.*64x64"):
        read_recorded_plate(read_index(dataset, "S001"), "cam01")
