import csv
import dataclasses
import errno
import fcntl
import hashlib
import json
import os
import tomllib

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from express50.__main__ import main
from express50.capture.raw import read_capture
from express50.console import USAGE
from express50.errors import CaptureError, ConfigError
from express50.files.images import read_image
from express50.files.video import VideoFootage, iterate_video
from express50.twin import TwinConfig
from express50.twin.record import check_out, print_progress, record
from express50.twin.studio import film_board, film_subject
from tests.faults.toy import tree
from tests.synth import make_capture


def test_capture_follows_the_raw_layout(recording, small_config):
    capture = read_capture(recording / "captures" / "S001")
    assert capture.subject == "S001" and capture.fps == small_config.fps
    assert not capture.dropped and len(capture.cameras) == 3
    assert capture.calibration is None
    assert set(capture.plates) == set(capture.cameras) == set(capture.board["cameras"])
    assert [cue.expression_id for cue in capture.cues] == ["neutral", "jaw_open"]
    meta = tomllib.loads((capture.root / "capture.toml").read_text())
    assert meta["synthetic"] and meta["consent"] and meta["licence"]


def test_truth_lies_apart_from_the_footage(recording):
    names = {path.name for path in (recording / "captures").rglob("*") if path.is_file()}
    truth = {path.name for path in (recording / "truth").rglob("*") if path.is_file()}
    assert not names & truth
    assert "peaks.json" in truth and "calibration.json" not in names


def test_frames_are_noisy_and_differ_from_the_plate_where_the_head_is(recording):
    root = recording / "captures" / "S001"
    first, second = (
        read_image(root / f"cameras/cam01/frames/{k:06d}.png").astype(float) for k in (0, 1)
    )
    plate = read_image(root / "plates/cam01.png").astype(float)
    difference = np.abs(first - plate).mean(-1)
    assert difference[:8, :8].mean() < 4.0 < 25.0 < difference[40:56, 40:56].mean()
    noise = (first - second)[:12, :12]
    assert 0.3 < noise.std() < 6.0 and abs(noise.mean()) < 1.0


def test_same_seed_gives_the_same_bytes_however_cameras_are_shared_out(tiny_config, tmp_path):
    for name, groups in {"a": [[0, 1]], "b": [[1], [0]]}.items():
        root = tmp_path / name
        for group in groups:
            film_subject(tiny_config, "S001", group, root / "capture", root / "truth", int)
            film_board(tiny_config, group, root / "board", int)
    assert len(tree(tmp_path / "a")) == 2 * (4 + 1 + 1) + 5
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


@pytest.mark.slow
def test_processes_do_not_change_the_bytes(tiny_config, tmp_path):
    record(tiny_config, tmp_path / "a", workers=1)
    record(tiny_config, tmp_path / "b", workers=2)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


def test_video_repeats_its_bytes_and_another_seed_does_not(tiny_config, tmp_path):
    config = dataclasses.replace(tiny_config, cameras=1, footage="video", board_frames=0)
    for name, one in {"a": config, "b": config, "c": dataclasses.replace(config, seed=4)}.items():
        record(one, tmp_path / name, workers=1)
    path = "captures/S001/cameras/cam00/video.mp4"
    a, b, c = ((tmp_path / name / path).read_bytes() for name in "abc")
    assert a == b != c
    frames = [image for _, image in iterate_video(tmp_path / "a" / path)]
    assert len(frames) == 4 and frames[0].shape == (40, 48, 3)


def test_recording_again_keeps_what_is_there_and_adds_the_rest(tiny_config, tmp_path):
    config = dataclasses.replace(tiny_config, cameras=1, board_frames=0, plates=False)
    assert record(config, tmp_path, workers=1) == ["S001"]
    before = tree(tmp_path / "captures" / "S001")
    assert record(config, tmp_path, workers=1) == []
    more = dataclasses.replace(config, subjects=2)
    assert record(more, tmp_path, workers=1) == ["S002"]
    assert tree(tmp_path / "captures" / "S001") == before
    with pytest.raises(CaptureError, match="seed differ"):
        record(dataclasses.replace(config, seed=9), tmp_path, workers=1)
    (tmp_path / "captures").rename(tmp_path / "moved")
    with pytest.raises(CaptureError, match="seed differ"):
        record(dataclasses.replace(config, seed=9), tmp_path, workers=1)


def test_settings_of_which_nothing_was_recorded_do_not_bind(tiny_config, tmp_path):
    config = dataclasses.replace(tiny_config, cameras=1, board_frames=0, plates=False)
    (tmp_path / "twin.json").write_text("{}")
    assert record(config, tmp_path, workers=1) == ["S001"]
    with pytest.raises(ConfigError, match="twin.seed is -1"):
        dataclasses.replace(config, seed=-1)


def test_nothing_is_recorded_among_other_files(tmp_path, capsys):
    make_capture(tmp_path / "S001")
    (tmp_path / "data/track").mkdir(parents=True)
    (tmp_path / "data/ledger.sqlite").touch()
    refused = {
        "S001": "S001: is a capture; name another folder",
        "data": "data: belongs to the dataset",
        ".": "holds S001, data, expected an earlier recording or nothing; name another folder",
    }
    before = tree(tmp_path)
    for name, words in refused.items():
        assert main(["twin", "record", str(tmp_path / name)]) == USAGE
        assert words in capsys.readouterr().err
    assert tree(tmp_path) == before
    (tmp_path / "twin.json").touch()
    check_out(tmp_path)


def test_the_same_pictures_make_the_same_video(tmp_path):
    """The bytes do not depend on what was in memory: an encoder's lookahead once did."""
    rng = np.random.default_rng(0)
    ground = gaussian_filter(rng.uniform(0, 255, (120, 200, 3)), (3, 3, 0)) * 2
    pictures = [
        np.clip(ground[:, k : k + 160] + rng.normal(0, 2, (120, 160, 3)), 0, 255).astype(np.uint8)
        for k in (0, 0, 1, 3, 6, 9, 11, 12)
    ]
    videos = set()
    for _ in range(30):
        junk = [rng.integers(0, 255, rng.integers(1000, 200_000), np.uint8) for _ in range(5)]
        with VideoFootage(tmp_path, 160, 120, 24.0, 10) as footage:
            for picture in pictures:
                footage.write(picture)
        del junk
        videos.add(hashlib.sha256((tmp_path / "video.mp4").read_bytes()).hexdigest())
    assert len(videos) == 1


def test_command_line_records_also_where_files_have_one_name(tmp_path, capsys, monkeypatch):
    def link(*paths):
        raise OSError(errno.EPERM, "Operation not permitted")  # as on exFAT

    monkeypatch.setattr(os, "link", link)
    flags = "--subjects 1 --cameras 1 --width 40 --height 40 --expressions neutral"
    flags += " --frames-per-expression 4 --board-frames 1 --frames jpg --give-calibration --json"
    assert main(["twin", "record", str(tmp_path / "t"), *flags.split(), "--workers", "1"]) == 0
    assert json.loads(capsys.readouterr().out)["recorded"] == ["S001"]
    root = tmp_path / "t" / "captures" / "S001"
    assert len(list((root / "cameras/cam00/frames").glob("*.jpg"))) == 4
    assert set(read_capture(root).calibration) == {"cam00"}
    with (root / "cues.csv").open() as file:
        assert [row["end_frame"] for row in csv.DictReader(file)] == ["3"]


def test_two_recordings_into_one_folder_are_refused(tmp_path, capsys):
    folder = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_EX)
    assert main(["twin", "record", str(tmp_path), "--subjects=1"]) == 2
    assert "another process writes into this folder" in capsys.readouterr().err
    os.close(folder)
    assert not list(tmp_path.iterdir())


def test_pictures_too_small_to_calibrate_from_are_warned_of(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("express50.twin.record.record", lambda *given: [])
    small = ["twin", "record", str(tmp_path), "--width=160", "--height=400"]
    for more, warned in (
        ([], True),
        (["--give-calibration"], False),
        (["--board-frames=0"], False),
    ):
        assert main([*small, *more]) == 0
        assert ("160 px the board is too small" in capsys.readouterr().err) == warned


def test_wrong_settings_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="cameras is 0"):
        TwinConfig(cameras=0)
    with pytest.raises(ConfigError, match="even sizes"):
        TwinConfig(width=321)
    assert main(["twin", "record", str(tmp_path), "--subjects", "0"]) == USAGE


def test_no_line_of_progress_is_printed_twice(capsys):
    report = print_progress()
    for done in (0, 5, 10, 10, 10):
        report(done, 10)
    assert len(capsys.readouterr().err.splitlines()) == 1
