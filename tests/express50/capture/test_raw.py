"""Raw captures: what is read, and what each kind of damage is answered with."""

import errno
import json
import shutil
from pathlib import Path

import pytest

from express50.capture.index import Cue
from express50.capture.raw import read_capture, read_cues, read_meta
from express50.capture.readers.read import read_any
from express50.errors import CalibrationError, CaptureError
from tests.synth import make_capture, make_rig, render_ball, write_video


@pytest.fixture
def raw(tmp_path):
    make_capture(tmp_path / "S001")
    return tmp_path / "S001"


def test_whole_capture_is_read(raw):
    capture = read_capture(raw)
    assert (capture.subject, capture.fps) == ("S001", 24.0)
    assert list(capture.cameras) == ["cam00", "cam01", "cam02"]
    assert capture.cameras["cam00"].names[:2] == ("000000.png", "000001.png")
    assert capture.cues == (Cue("neutral", 0, 2), Cue("smile", 3, 5))
    assert capture.dropped == {}
    assert capture.board is None
    assert set(capture.plates) == set(capture.cameras) == set(capture.calibration)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("subject = 3\nfps = 24", "subject is 3, expected at most 120 letters"),
        ('subject = "../x"\nfps = 24', "subject is '../x'"),
        ('subject = "a"\nfps = true', "fps is True"),
        ('subject = "a"\nfps = 0', "fps is 0, expected more than 0"),
        ('subject = "a"\nfps = nan', "line 2 holds nan"),
        ("subject = ", "not TOML"),
    ],
)
def test_bad_capture_toml_says_what_is_wrong(raw, text, message):
    (raw / "capture.toml").write_text(text)
    with pytest.raises(CaptureError, match=message):
        read_meta(raw)


def test_videos_state_the_frame_rate_that_capture_toml_leaves_out(tmp_path):
    raw = tmp_path / "S002"
    make_capture(raw, subject="S002", video=True)
    (raw / "capture.toml").write_text('subject = "S002"\n')
    (raw / "cameras/cam01/video.mp4").write_bytes(b"")  # ingest drops it; the others count
    capture = read_capture(raw)
    assert (capture.fps, capture.meta["fps"], read_meta(raw)) == (24, 24, {"subject": "S002"})
    write_video(raw / "cameras/cam01/video.mp4", [render_ball(make_rig()["cam01"], 0)] * 3, rate=30)
    with pytest.raises(CaptureError, match=r"cam00/video.mp4 says 24, .*cam01/video.mp4 says 30"):
        read_capture(raw)


def test_images_without_a_frame_rate_are_refused(raw):
    (raw / "capture.toml").write_text('subject = "S001"\n')
    with pytest.raises(CaptureError, match="no fps, and no video states it; add it"):
        read_capture(raw)
    for name in ("cam00", "cam01"):
        (raw / "cameras" / name / "frames").rename(raw / "cameras" / name / "photos")
        (raw / "cameras" / name / "video.mp4").write_bytes(b"no video")
    with pytest.raises(CaptureError, match=r"states it \(.*cam00/video.mp4: cannot be opened"):
        read_capture(raw)


def test_missing_parts_are_named(tmp_path, raw):
    with pytest.raises(CaptureError, match="no such folder"):
        read_capture(tmp_path / "absent")
    (raw / "cameras").rename(raw / "kameras")
    with pytest.raises(CaptureError, match="expected cameras/<id>/video.mp4"):
        read_capture(raw)
    (raw / "capture.toml").unlink()
    with pytest.raises(CaptureError, match="has no capture.toml"):
        read_capture(raw)


def test_dates_in_meta_become_text(raw):
    with (raw / "capture.toml").open("a") as file:
        file.write("recorded = 2024-05-01\n[rig]\nlenses = [35, 50]\n")
    meta = read_meta(raw)
    assert json.loads(json.dumps(meta)) == meta
    assert (meta["recorded"], meta["rig"]["lenses"]) == ("2024-05-01", [35, 50])


def test_gap_in_frames_drops_the_camera_and_names_the_frame(raw):
    (raw / "cameras/cam01/frames/000003.png").unlink()
    capture = read_capture(raw)
    assert list(capture.cameras) == ["cam00", "cam02"]
    assert "frame 3 is missing: found 000004.png" in capture.dropped["cam01"]


def test_frame_numbers_need_no_leading_zeros(raw):
    frames = raw / "cameras/cam01/frames"
    for path in frames.iterdir():
        path.rename(frames / f"{int(path.stem)}.png")
    for number in range(6, 12):
        shutil.copy(frames / "0.png", frames / f"{number}.png")
    assert read_capture(raw).cameras["cam01"].names == tuple(f"{n}.png" for n in range(12))


def test_camera_without_or_with_two_kinds_of_footage_is_dropped(raw):
    (raw / "cameras/cam00/video.mp4").touch()
    (raw / "cameras/cam01/frames").rename(raw / "cameras/cam01/photos")
    (raw / "cameras/cam01/video.ogv").touch()
    dropped = read_capture(raw).dropped
    assert "holds video.mp4, frames/, expected only one" in dropped["cam00"]
    assert "holds no footage, expected video.mp4 or frames/000000.png" in dropped["cam01"]
    assert "got photos, video.ogv" in dropped["cam01"]


@pytest.mark.parametrize("name", ["cam.00", "cam+00", "cam 00", "\u043a\u0430\u043c00"])
def test_a_camera_whose_name_is_not_an_id_fails_the_capture(raw, name):
    """Without them the chain would run for hours on half of the rig."""
    (raw / "cameras" / "cam00").rename(raw / "cameras" / name)
    with pytest.raises(CaptureError, match="expected at most 120 letters"):
        read_capture(raw)
    (raw / "cameras" / name).rename(raw / "cameras" / "cam00")
    given = raw / "calibration.json"
    given.write_text(given.read_text().replace("cam00", name))
    with pytest.raises(CalibrationError, match="expected an id of at most 120 letters"):
        read_capture(raw)


def test_files_that_systems_add_are_not_cameras(raw):
    (raw / "cameras" / "@eaDir" / "cam00").mkdir(parents=True)
    (raw / "cameras" / ".DS_Store").touch()
    (raw / "cameras" / "empty one").mkdir()
    assert set(read_capture(raw).dropped) == {"empty one"}


def test_endings_may_be_upper_case_and_other_names_are_pointed_out(raw):
    folder = raw / "cameras" / "cam01"
    shutil.rmtree(folder / "frames")
    (folder / "GX010001.MP4").touch()
    assert "rename GX010001.MP4 to video.MP4" in read_capture(raw).dropped["cam01"]
    (folder / "GX010001.MP4").rename(folder / "VIDEO.MP4")
    assert read_capture(raw).cameras["cam01"].path.name == "VIDEO.MP4"


def test_cameras_on_one_side_of_the_calibration_only_are_dropped(raw):
    path = raw / "calibration.json"
    table = json.loads(path.read_text())
    table["cam77"] = table.pop("cam00")
    path.write_text(json.dumps(table))
    capture = read_capture(raw)
    assert list(capture.cameras) == ["cam01", "cam02"]
    assert "not in calibration.json" in capture.dropped["cam00"]
    assert "the capture has no footage of it" in capture.dropped["cam77"]
    table["CAM00"] = table.pop("cam77")
    path.write_text(json.dumps(table))
    assert "did you mean 'CAM00'" in read_capture(raw).dropped["cam00"]


def test_board_is_listed_by_camera(raw):
    for name in ("cam00", "cam02", "stranger"):
        (raw / "board" / name).mkdir(parents=True)
        (raw / "board" / name / "000.png").touch()
    with pytest.raises(CaptureError, match=r"no board\.toml"):
        read_capture(raw)
    (raw / "board/board.toml").write_text("squares_x = 5\n")
    (raw / "plates").mkdir(exist_ok=True)
    (raw / "plates/cam1.png").touch()
    found = read_capture(raw)
    cameras = "cameras are cam00, cam01, cam02; rename it after its camera"
    assert found.warnings == {
        "plates": f"holds cam1.png, but {cameras}", "board": f"holds stranger, but {cameras}"
    }  # fmt: skip
    board = found.board
    assert board["config"] == {"squares_x": 5}
    assert board["cameras"] == {"cam00": ["board/cam00/000.png"], "cam02": ["board/cam02/000.png"]}
    (raw / "board/cam01").mkdir()
    (raw / "board/cam01/wand.mp4").touch()
    assert read_capture(raw).board["cameras"]["cam01"] == ["board/cam01/wand.mp4"]
    (raw / "board/cam00.mp4").touch()
    message = "cam00 has cam00.mp4, 000.png, expected one video or only images"
    with pytest.raises(CaptureError, match=message):
        read_capture(raw)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("expression,start_frame,end_frame\n", "no column expression_id"),
        ("", "no column expression_id, start_frame, end_frame; got '', expected"),
        ("expression_id,start_frame,end_frame\nsmile,0,x\n", ":2: frames are '0' and 'x'"),
        ("expression_id,start_frame,end_frame\nsmile,0\n", ":2: frames are '0' and None"),
        ("expression_id,start_frame,end_frame\nsmile,5,4\n", ":2: smile runs from 5 to 4"),
        ("expression_id,start_frame,end_frame\nsmile,-1,4\n", "0 <= start <= end"),
        ("expression_id,start_frame,end_frame\na.b,0,4\n", "expression_id is 'a.b'"),
        (f"expression_id,start_frame,end_frame\n{'y' * 300},0,4\n", "at most 120 letters"),
        ("expression_id,start_frame,end_frame\na,0,4\na,5,6\n", "a appears twice"),
    ],
)
def test_bad_cues_name_the_line(tmp_path, text, message):
    path = tmp_path / "cues.csv"
    path.write_text(text)
    with pytest.raises(CaptureError, match=message):
        read_cues(path)


def test_cues_may_come_from_a_spreadsheet(tmp_path):
    path = tmp_path / "cues.csv"
    path.write_bytes(
        b"\xef\xbb\xbfexpression_id, start_frame, end_frame, note\r\nsmile, 0, 4, ok\r\n"
    )
    assert read_cues(path) == (Cue("smile", 0, 4),)
    for between in (";", "\t"):
        table = "expression_id,start_frame,end_frame\nsmile,0,4\n,,\n,,\n"
        path.write_text(table.replace(",", between))
        assert read_cues(path) == (Cue("smile", 0, 4),)
    assert read_cues(tmp_path / "absent.csv") == ()


def test_a_file_that_may_not_be_read_is_not_called_damaged(raw, monkeypatch):
    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(CaptureError, match=r"\(Permission denied\); check its owner and perm"):
        read_capture(raw)


@pytest.mark.parametrize(
    "name", ["cues.csv", "capture.toml", "calibration.json", "board/board.toml"]
)
def test_a_folder_in_place_of_a_file_is_not_taken_for_a_missing_file(raw, name):
    (raw / name).unlink(missing_ok=True)
    (raw / name).mkdir(parents=True)
    with pytest.raises(CaptureError, match=rf"{name}: is a folder, expected a file; put the file"):
        read_any(raw)


def test_tables_and_calibrations_that_nothing_reads_are_named(raw):
    for name in ("cue.csv", "camera_array.toml", "notes.txt", ".hidden.json"):
        (raw / name).touch()
    what = "holds camera_array.toml, cue.csv, which nothing reads; cues come from cues.csv"
    assert read_capture(raw).warnings["folder"].startswith(what)
