"""Ingest indexes the footage, drops bad cameras and fails bad captures one by one."""

import json
import shutil
from functools import partial

import imagecodecs
import numpy as np
import pytest
from PIL import Image

from annotations.labels import lost_frame, make_mark
from express50.__main__ import main
from express50.capture.frames import FrameReader, decode_proxy, dhash, read_proxy
from express50.capture.index import UNKNOWN_HASH, Cue, Peak, check_peak, read_index
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset
from express50.contract.stage import Note
from express50.errors import CaptureError, ConfigError, StageError
from express50.files.images import read_image
from express50.files.video import iterate_video
from pipelines import ingest
from pipelines.calibrate.footage import has_one_lens
from pipelines.ingest.scan import time_gaps
from pipelines.ingest.stage import usual_count
from tests.stages import metrics_of, notes_of, run_here
from tests.synth import make_capture, noise_video_images, turn_video, write_frames, write_video

run = partial(run_here, ingest.STAGE)
metrics = partial(metrics_of, stage="ingest", item="S001")
notes = partial(notes_of, stage="ingest", item="S001")


@pytest.fixture
def dataset(tmp_path):
    make_capture(tmp_path / "S001", cameras=3, frames=8, video=True)
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [tmp_path / "S001"])
    return dataset


def camera_folder(dataset, name):
    return dataset.captures()["S001"] / "cameras" / name


def test_a_good_capture_gives_full_counts(dataset):
    assert run(dataset).ok
    assert metrics(dataset) == {
        "cameras": 3,
        "frames": 24,
        "expressions": 2,
        "frame_count": 8,
        "frame_count_differs": {},
        "time_gaps": {},
        "plates": 3,
        "dropped": [],
        "warnings": [],
    }
    index = read_index(dataset, "S001")
    pts = index.cameras["cam00"].pts
    assert len(set(np.diff(pts))) == 1  # constant rate
    sheet = read_image(dataset.item_dir("ingest", "S001") / "qc" / "cameras.jpg")
    assert sheet.shape == (3 * 160, 6 * 160, 3)
    assert sheet.std() > 20


def test_proxy_size_follows_the_config_and_never_enlarges(dataset):
    run(dataset, proxy_long_side=32)
    folder = dataset.proxies_dir("S001")
    assert decode_proxy(folder, "cam00", 7).shape == (32, 32, 3)
    run(dataset, proxy_long_side=640)
    assert decode_proxy(folder, "cam00", 7).shape == (64, 64, 3)


def test_proxy_keeps_the_identity_of_its_frame(dataset):
    run(dataset)
    index = read_index(dataset, "S001")
    proxy = decode_proxy(dataset.proxies_dir("S001"), "cam01", 4)
    bits = int(dhash(proxy), 16) ^ int(index.cameras["cam01"].dhash[4], 16)
    assert bits.bit_count() <= 8


def test_truncated_camera_is_dropped_with_its_reason(dataset):
    video = camera_folder(dataset, "cam01") / "video.mp4"
    video.write_bytes(video.read_bytes()[:-200])
    summary = run(dataset)
    assert summary.ok
    (dropped,) = metrics(dataset)["dropped"]
    assert dropped["what"] == "camera cam01"
    assert "truncated" in dropped["why"]
    assert list(read_index(dataset, "S001").cameras) == ["cam00", "cam02"]
    names = {p.name for p in dataset.proxies_dir("S001").iterdir()}
    assert names == {"cam00.tar", "cam00.json", "cam02.tar", "cam02.json"}
    assert summary.outcomes[0].dropped == (Note(**dropped),)


def test_a_copied_camera_is_reported(dataset):
    assert run(dataset).ok and not metrics(dataset)["warnings"]
    shutil.copyfile(
        camera_folder(dataset, "cam00") / "video.mp4", camera_folder(dataset, "cam02") / "video.mp4"
    )
    assert run(dataset).ok
    (warning,) = metrics(dataset)["warnings"]
    assert warning["what"] == "camera cam02"
    assert "camera cam00" in warning["why"]


def test_camera_names_that_clash_in_later_stages_are_refused(dataset):
    camera_folder(dataset, "cam02").rename(camera_folder(dataset, "cam00_head"))
    (dataset.captures()["S001"] / "calibration.json").unlink(missing_ok=True)
    assert "cameras cam00 and cam00_head" in run(dataset).outcomes[0].reason


def test_missing_camera_is_dropped(dataset):
    (camera_folder(dataset, "cam02") / "video.mp4").unlink()
    camera_folder(dataset, "cam02").rmdir()
    assert run(dataset).ok
    assert [*notes(dataset, kind="dropped")] == ["camera cam02"]


def test_capture_without_a_usable_camera_fails(dataset):
    for name in ("cam00", "cam01", "cam02"):
        (camera_folder(dataset, name) / "video.mp4").write_bytes(b"junk")
    summary = run(dataset)
    assert summary.count("failed") == 1
    assert summary.outcomes[0].reason.count("video.mp4") == 1, "one reason of three cameras"
    assert not dataset.item_dir("ingest", "S001").exists()


def test_a_rig_of_which_every_camera_is_damaged_fails_with_the_reasons(tmp_path):
    for name in ("cam0", "cam1"):
        write_frames(tmp_path / "rig" / name, noise_video_images(3))
        (tmp_path / "rig" / name / "000001.png").write_bytes(b"junk")
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [tmp_path / "rig"])
    (outcome,) = run(dataset).outcomes
    assert "no usable camera: camera cam0, cam1: " in outcome.reason
    assert outcome.reason.count("/rig/*/000001.png") == outcome.reason.count("000001.png") == 1


def test_a_frame_that_several_cameras_lack_is_one_line(tmp_path):
    make_capture(tmp_path / "raw", cameras=3)
    for name in ("cam00", "cam02"):
        (tmp_path / "raw" / "cameras" / name / "frames" / "000003.png").unlink()
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [tmp_path / "raw"])
    lines = [line for line in run(dataset).lines() if "frame 3 is missing" in line]
    assert len(lines) == 1
    assert "dropped camera cam00, camera cam02 of S001: " in lines[0]
    assert "cameras/*/frames: " in lines[0]


def test_wrong_calibration_fails_its_item_only(dataset, tmp_path):
    make_capture(tmp_path / "S002", subject="S002", cameras=2, frames=4)
    ingest.add_captures(dataset, [tmp_path / "S002"])
    path = dataset.captures()["S001"] / "calibration.json"
    table = json.loads(path.read_text())
    table["cam00"]["params"] = table["cam00"]["params"][:5]
    path.write_text(json.dumps(table))
    summary = run(dataset)
    assert {o.item: o.status for o in summary.outcomes} == {"S001": "failed", "S002": "done"}
    assert "CalibrationError" in summary.outcomes[0].reason
    assert "cam00 has params: got shape (5,), expected (8,)" in summary.outcomes[0].reason


def test_calibration_for_another_size_fails_the_item(dataset):
    path = dataset.captures()["S001"] / "calibration.json"
    table = json.loads(path.read_text())
    table["cam00"]["width"] = 128
    path.write_text(json.dumps(table))
    assert "calibrated for 128x64, its footage is 64x64" in run(dataset).outcomes[0].reason


def test_different_frame_counts_are_reported_and_short_cameras_dropped(dataset):
    write_video(camera_folder(dataset, "cam00") / "video.mp4", noise_video_images(10))
    write_video(camera_folder(dataset, "cam01") / "video.mp4", noise_video_images(5))
    make = camera_folder(dataset, "cam03")
    make.mkdir()
    write_video(make / "video.mp4", noise_video_images(8))
    (dataset.captures()["S001"] / "calibration.json").unlink()
    assert run(dataset).ok
    found = metrics(dataset)
    assert found["frame_count"] == 8
    assert found["frame_count_differs"] == {"cam00": 10}
    (dropped,) = found["dropped"]
    assert dropped["what"] == "camera cam01"
    assert "has 5 frames, the cues need 8" in dropped["why"]


def test_a_camera_that_shows_nothing_is_dropped(dataset):
    write_video(camera_folder(dataset, "cam01") / "video.mp4", np.zeros((8, 64, 64, 3), np.uint8))
    assert run(dataset).ok
    (dropped,) = metrics(dataset)["dropped"]
    assert dropped["what"] == "camera cam01" and "all of its frames are black" in dropped["why"]
    assert "cam01" not in read_index(dataset, "S001").cameras


def test_a_capture_without_cues_is_ingested_with_a_warning(dataset):
    cues = dataset.captures()["S001"] / "cues.csv"
    cues.unlink()
    assert run(dataset).ok
    (warning,) = metrics(dataset)["warnings"]
    assert warning["what"] == "expressions" and "cues.csv is missing" in warning["why"]
    for rows, what in (("", "names none"), ("anger,90,95\n", "names no expression inside")):
        cues.write_text(f"expression_id,start_frame,end_frame\n{rows}")
        assert run(dataset).ok
        assert what in metrics(dataset)["warnings"][0]["why"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('cameras = ["cam00"]', "cameras: only read for other layouts"),
        ("metres_per_unit = 0.001", "metres_per_unit: read for colmap and transforms only"),
        ('licens = "CC0"', "'licens' (did you mean 'license'?); keys are"),
        ('units = "mm"', "units is 'mm', but lengths are taken as metres"),
        ('color_space = "ACEScg"', "color_space is 'ACEScg', but pictures are taken as sRGB"),
        ("focal_px = {cam09 = 900}", "focal_px names cam09, but cameras are cam00, cam01, cam02"),
    ],
)
def test_keys_that_nothing_reads_are_named(dataset, text, words):
    with (dataset.captures()["S001"] / "capture.toml").open("a") as file:
        file.write(text + "\n")
    assert run(dataset).ok
    (warning,) = metrics(dataset)["warnings"]
    assert warning["what"] == "capture.toml" and words in warning["why"]


def test_a_lens_that_cameras_share_is_known_after_ingest(dataset):
    with (dataset.captures()["S001"] / "capture.toml").open("a") as file:
        file.write("same_lens = true\n")
    assert run(dataset).ok and metrics(dataset)["warnings"] == []
    assert has_one_lens(read_index(dataset, "S001"))


def test_ids_too_long_for_shards_are_refused_before_anything_is_decoded(dataset):
    path = dataset.captures()["S001"]
    (path / "cameras" / "cam01").rename(path / "cameras" / ("c" * 76))
    (path / "calibration.json").unlink()
    (outcome,) = run(dataset).outcomes
    assert outcome.status == "failed"
    assert "(subject 4, expression 7, camera 76 characters), expected at most 80" in outcome.reason


def test_cues_outside_the_footage_are_dropped_and_reported(dataset):
    cues = dataset.captures()["S001"] / "cues.csv"
    cues.write_text("expression_id,start_frame,end_frame\nneutral,0,7\nsmile,6,8\nanger,90,95\n")
    assert run(dataset).ok
    assert read_index(dataset, "S001").cues == (Cue("neutral", 0, 7),)
    dropped = metrics(dataset)["dropped"]
    assert [d["what"] for d in dropped] == ["expression anger", "expression smile"]
    assert "from frame 6 to 8, the footage has frames 0 to 7" in dropped[1]["why"]


def test_frames_of_different_size_drop_the_camera(dataset):
    folder = camera_folder(dataset, "cam01")
    (folder / "video.mp4").unlink()
    images = [np.zeros((64, 64, 3), np.uint8)] * 7 + [np.zeros((32, 64, 3), np.uint8)]
    write_frames(folder / "frames", images)
    assert run(dataset).ok
    assert "frame 7 is 64x32, the first is 64x64" in metrics(dataset)["dropped"][0]["why"]


def test_capture_that_changed_is_ingested_again(dataset):
    assert run(dataset).count("done") == 1
    assert run(dataset).count("skipped") == 1
    cues = dataset.captures()["S001"] / "cues.csv"
    cues.write_text("expression_id,start_frame,end_frame\nneutral,0,7\n")
    assert run(dataset).count("done") == 1
    assert len(read_index(dataset, "S001").cues) == 1


def test_register_checks_before_it_writes(dataset, tmp_path):
    make_capture(tmp_path / "other", subject="S001", cameras=1)
    with pytest.raises(CaptureError, match=r"has the same subject \(S001\) as"):
        ingest.add_captures(dataset, [dataset.captures()["S001"], tmp_path / "other"])
    with pytest.raises(CaptureError, match="no such folder"):
        ingest.add_captures(dataset, [tmp_path / "absent"])


def test_another_capture_of_a_known_subject_is_refused_unless_it_replaces_the_first(
    dataset, tmp_path, capsys
):
    known, other = tmp_path / "S001", tmp_path / "other"
    make_capture(other, subject="S001", cameras=1)
    before = dataset.captures_file.read_bytes()
    with pytest.raises(CaptureError) as error:
        ingest.add_captures(dataset, [other])
    assert all(str(path) in str(error.value) for path in (known, other, "--replace"))
    assert dataset.captures_file.read_bytes() == before
    (tmp_path / "link").symlink_to(known)
    assert ingest.add_captures(dataset, [tmp_path / "link"]) == ["S001"]  # the same folder

    command = ["ingest", str(dataset.root), str(other), "--workers=0"]
    assert main(command) == 1 and main([*command, "--replace"]) == 0
    assert dataset.captures()["S001"] == other
    other.rename(known.with_name("moved"))  # no choice is left, so none is asked for
    assert ingest.add_captures(dataset, [known.with_name("moved")]) == ["S001"]
    assert f"S001: {other} is gone" in capsys.readouterr().err


def test_a_moved_capture_or_a_changed_subject_fails_its_item_only(dataset, tmp_path):
    (tmp_path / "S001" / "capture.toml").write_text('subject = "S009"\nfps = 24\n')
    advice = f"take S001 out ('express50 subject withdraw {dataset.root} S001')"
    assert advice in run(dataset).outcomes[0].reason
    before = dataset.captures()
    with pytest.raises(CaptureError, match="'S009', but the dataset has this capture as 'S001'"):
        ingest.add_captures(dataset, [tmp_path / "S001"])  # one person under two ids
    assert dataset.captures() == before
    (tmp_path / "S001").rename(tmp_path / "elsewhere")
    assert "no such folder; run 'express50 ingest" in run(dataset).outcomes[0].reason
    with pytest.raises(StageError, match="no capture of 'S009'"):
        ingest.inputs(dataset, "S009", ingest.IngestConfig())


def test_config_ranges():
    for text in ("proxy_long_side=5", "proxy_quality=0", "proxy_quality=101"):
        with pytest.raises(ConfigError, match="expected"):
            resolve_config(ingest.STAGE, "standard", None, [f"ingest.{text}"])


def test_usual_count_prefers_the_common_then_the_larger():
    assert [usual_count(c) for c in ((), (5,), (5, 9, 5), (4, 6))] == [0, 5, 5, 6]


def test_lost_frames_count_as_time_gaps():
    assert time_gaps((0, 10, 20, 30)) == 0
    assert time_gaps((0, 10, 30, 40, 70, 80)) == 2
    assert time_gaps((5,)) == time_gaps(()) == 0


def test_real_size_captures(shared, tmp_path):
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [shared("captures/H900")])
    assert run(dataset).ok
    assert metrics(dataset, item="H900")["frames"] == 8 * 48
    assert metrics(dataset, item="H900")["dropped"] == []


def test_cameras_of_another_rate_are_dropped_unless_only_their_statement_is_wrong(tmp_path):
    """The second is twice as fast, the third half; the fourth only says that it is slower."""
    root = tmp_path / "S001"
    make_capture(root, cameras=6, frames=24, video=True)
    for name, step, rate in (("cam01", 0.5, 48), ("cam02", 2, 12), ("cam03", 1, 20)):
        video = root / "cameras" / name / "video.mp4"
        images = [image for _, image in iterate_video(video)]
        chosen = np.arange(0, len(images), step).astype(int)
        write_video(video, [images[n] for n in chosen], rate=rate)
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [root])
    assert run(dataset).ok
    dropped = {note["what"]: note["why"] for note in metrics(dataset)["dropped"]}
    assert set(dropped) == {"camera cam01", "camera cam02"}
    assert "at 48 frames per second, most cameras at 24" in dropped["camera cam01"]
    assert "at 12 frames per second" in dropped["camera cam02"]
    assert "video at 20 fps, the capture says 24" in notes(dataset)["camera cam03"]


def test_footage_that_differs_from_its_description_is_a_warning(tmp_path):
    root = tmp_path / "S001"
    make_capture(root, cameras=3, frames=24, video=True)
    turned, clear, uneven = (root / f"cameras/cam0{n}/video.mp4" for n in range(3))
    turn_video(turned)
    images = [image for _, image in iterate_video(clear)]
    ticks = [4 * n + (n % 3 == 0) * 2 for n in range(24)]
    write_video(uneven, images, b_frames=0, ticks=ticks)
    clear.unlink()
    write_frames(clear.parent / "frames", [np.dstack([i, i[..., :1]]) for i in images])
    (root / "capture.toml").write_text('subject = "S001"\nfps = 12\n')
    (root / "cues.csv").write_text(
        "expression_id,start_frame,end_frame\nneutral,0,11\nsmile,8,23\n"
    )
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [root])
    assert run(dataset).ok
    said = notes(dataset)
    assert "video at 24 fps, the capture says 12" in said["camera cam00"]
    assert "used as stored" in said["camera cam00"] and "stored" not in said["camera cam01"]
    assert "variable" not in said["camera cam00"]
    assert "alpha channel left out" in said["camera cam01"]
    assert "variable frame rate" in said["camera cam02"]
    assert "shares frames 8 to 11 with neutral" in said["expression smile"]


def test_colour_profiles_of_footage_and_plates_are_named_and_change_no_hash(tmp_path):
    for name in ("S001", "S002"):
        make_capture(tmp_path / name, subject=name, cameras=2)
    profile = imagecodecs.cms_profile("adobergb")
    for path in [
        *(tmp_path / "S002").glob("cameras/*/frames/*"),
        tmp_path / "S002/plates/cam01.png",
    ]:
        Image.fromarray(read_image(path)).save(path, icc_profile=profile)
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [tmp_path / "S001", tmp_path / "S002"])
    assert run(dataset).ok
    said = notes_of(dataset, "ingest", "S002")
    assert said.keys() - notes_of(dataset, "ingest", "S001").keys() == {"colours"}
    assert said["colours"].startswith(
        "cameras/cam00/frames/000000.png and 2 more: ICC profile 'Adobe"
    )
    hashes = [read_index(dataset, name).cameras["cam00"].dhash for name in ("S001", "S002")]
    assert hashes[0] == hashes[1]


def test_videos_whose_pictures_are_not_what_they_seem_are_warned_of(tmp_path):
    root = tmp_path / "S001"
    make_capture(root, cameras=4, frames=6, video=True)
    hdr, interlaced, plain, grey = (root / f"cameras/cam0{n}/video.mp4" for n in range(4))
    images = [image for _, image in iterate_video(plain)]
    write_video(hdr, images, options={"x264-params": "transfer=arib-std-b67"})
    write_video(interlaced, images, options={"x264-params": "interlaced=1:sar=16/15"})
    # FFmpeg encodes grey as 0 to 255, and sets no flag.
    write_video(grey, [np.uint8(255) * (image > 120) for image in images], pix_fmt="gray")
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [root])
    assert run(dataset).ok
    said = notes(dataset)
    assert "no stated range: read as 16 to 235" in said["camera cam03"]
    assert "HDR (HLG)" in said["camera cam00"]
    assert "interlaced:" in said["camera cam01"]
    assert "pixels 1.07 times as wide as high" in said["camera cam01"]
    assert "camera cam02" not in said


def test_a_camera_without_colours_among_others_is_warned_of(dataset):
    for grey in ("cam01", "cam00", "cam02"):
        video = camera_folder(dataset, grey) / "video.mp4"
        images = [image.mean(-1, keepdims=True).repeat(3, -1) for _, image in iterate_video(video)]
        video.unlink()
        write_video(video, [image.astype(np.uint8) for image in images])
        if grey == "cam01":
            assert run(dataset).ok
            said = notes(dataset)
            assert "no colours, unlike other cameras" in said["camera cam01"] and list(said) == [
                "camera cam01"
            ]
    assert run(dataset).ok
    assert not notes(dataset), "a rig of grey cameras knows that it is"


def test_pictures_of_twelve_bits_in_sixteen_are_warned_of(dataset):
    source = camera_folder(dataset, "cam01") / "video.mp4"
    images = [image.astype(np.uint16) * 16 for _, image in iterate_video(source)]
    source.unlink()
    write_frames(source.parent / "frames", images)
    assert run(dataset).ok
    said = notes(dataset)
    assert "is very dark" in said["camera cam01"] and list(said) == ["camera cam01"]


@pytest.mark.parametrize("focal", ["-1", "true", "{cam00 = 0}"])
def test_a_focal_length_that_is_none_fails_at_once(dataset, focal):
    toml = dataset.captures()["S001"] / "capture.toml"
    toml.write_text(f'subject = "S001"\nfps = 24\nfocal_px = {focal}\n')
    (outcome,) = run(dataset).outcomes
    assert "capture.toml: focal_px of" in outcome.reason


@pytest.mark.parametrize("subject", ["CON", "nul", "Com7"])
def test_subjects_named_like_a_device_are_refused(tmp_path, subject):
    make_capture(tmp_path / "a", subject=subject, cameras=1)
    with pytest.raises(CaptureError, match="a name that Windows reserves for a device"):
        ingest.add_captures(Dataset(tmp_path / "data"), [tmp_path / "a"])


def test_subjects_that_differ_by_case_alone_are_refused(dataset, tmp_path):
    make_capture(tmp_path / "small", subject="s001", cameras=1)
    with pytest.raises(CaptureError, match="s001 differs from S001 only in letter case"):
        ingest.add_captures(dataset, [tmp_path / "small"])
    ingest.add_captures(dataset, [tmp_path / "S001"])


def sparse_and_whole(tmp_path, video):
    """Ingest one capture of 8 frames twice: one of 3 frames decoded, and all."""
    make_capture(tmp_path / "S001", cameras=3, frames=8, video=video)
    sparse, whole = Dataset(tmp_path / "sparse"), Dataset(tmp_path / "whole")
    for dataset, every in ((sparse, 3), (whole, 1)):
        ingest.add_captures(dataset, [tmp_path / "S001"])
        assert run(dataset, every=every).ok
    return sparse, whole


@pytest.mark.parametrize("video", [True, False])
def test_frames_that_were_not_decoded_can_be_seen_labelled_and_read(tmp_path, video):
    sparse, whole = sparse_and_whole(tmp_path, video)
    some, every = read_index(sparse, "S001"), read_index(whole, "S001")
    source, known = some.cameras["cam01"], every.cameras["cam01"]
    assert source.pts == known.pts and source.sha256 == known.sha256
    decoded = [n for n, value in enumerate(source.dhash) if value != UNKNOWN_HASH]
    assert decoded == ([0] if video else [0, 3, 6])  # the video has one key frame
    for frame in (7, 2, 4, 0):
        proxies = [read_proxy(d, "S001", "cam01", frame).astype(int) for d in (sparse, whole)]
        assert np.abs(proxies[0] - proxies[1]).mean() < 6  # JPEG
        read = [FrameReader(index, "cam01").read(frame) for index in (some, every)]
        assert np.array_equal(*read)
    mark = make_mark(some, some.cues[0].expression_id, 1, "cam01", "ann")
    assert not lost_frame(every, mark)
    figures = json.loads((sparse.item_dir("ingest", "S001") / "checks.json").read_text())
    assert figures["sync"]["unjudged"]["cam00"] == "not all frames were decoded (ingest.every)"
    check_peak(every, "e", Peak(1, "cam01", mark.pts, mark.dhash))
    with pytest.raises(CaptureError, match="the label has changed"):
        check_peak(every, "e", Peak(2, "cam01", mark.pts, mark.dhash))


def test_footage_that_changed_after_a_sparse_ingest_is_refused_where_it_was_decoded(tmp_path):
    sparse, _ = sparse_and_whole(tmp_path, video=False)
    folder = camera_folder(sparse, "cam01") / "frames"
    names = sorted(path.name for path in folder.iterdir())
    other = camera_folder(sparse, "cam02") / "frames" / names[0]
    shutil.copy(other, folder / names[3])
    with pytest.raises(CaptureError, match="frame 3 has hash"):
        FrameReader(read_index(sparse, "S001"), "cam01").read(3)


def test_a_camera_with_an_unreadable_frame_that_is_not_decoded_is_dropped(tmp_path):
    make_capture(tmp_path / "S001", frames=8)
    dataset = Dataset(tmp_path / "data")
    ingest.add_captures(dataset, [tmp_path / "S001"])
    frame = camera_folder(dataset, "cam01") / "frames/000004.png"
    frame.unlink()
    frame.mkdir()
    assert run(dataset, every=3).ok
    why = f"{frame}: cannot be read (Is a directory); copy it again"
    assert metrics(dataset)["dropped"] == [{"what": "camera cam01", "why": why}]
