"""Every layout is recognised, read where it lies, and accounted for by ingest."""

import json

import numpy as np
import pytest

from express50.capture.colour_correction import correct_srgb
from express50.capture.frames import FrameReader, read_proxy, read_recorded_plate
from express50.capture.index import Cue, calibration_file, read_index
from express50.capture.readers.read import detect, read_any, read_people, subject_of
from express50.capture.readers.selection import common_timeline
from express50.errors import CalibrationError, CaptureError
from express50.files.calibration import read_cameras, write_cameras
from express50.files.images import encode_png
from express50.geometry.cameras import project
from pipelines import calibrate
from tests.express50.capture import layouts
from tests.express50.capture.layouts import picture, rig
from tests.stages import ingest_captures, notes_of, run_here
from tests.synth import noise_video_images, read_frame, turn_video, write_video

HEAD = np.array([[0.02, 1.22, 0.05], [-0.05, 1.15, -0.03], [0.0, 1.2, 0.0]])


def ingested(tmp_path, *captures, every=1):
    """Return a dataset of captures, and the first one's subject."""
    dataset = ingest_captures(tmp_path / "data", *captures, every=every)
    return dataset, subject_of(captures[0])


def assert_rig(dataset, subject, expected):
    """The translated cameras see the head where the true ones do, to a thousandth of a pixel."""
    found = read_cameras(calibration_file(dataset, read_index(dataset, subject)))
    assert sorted(found) == sorted(expected)
    for name, camera in expected.items():
        assert (found[name].width, found[name].height) == (camera.width, camera.height)
        np.testing.assert_allclose(
            project(found[name], HEAD)[0], project(camera, HEAD)[0], atol=1e-3
        )


def near(image, expected, level=4.0):
    assert image.shape == expected.shape
    return np.abs(image.astype(float) - expected).mean() < level


def test_renderme_full_release(tmp_path):
    path = layouts.write_renderme(tmp_path)
    assert (detect(path).name, subject_of(path)) == ("renderme360", "0026")
    dataset, subject = ingested(tmp_path, path)
    index = read_index(dataset, subject)
    assert index.cues == (Cue("neutral", 0, 4), Cue("e1", 5, 9), Cue("e2", 10, 14))
    assert index.cameras["cam02"].pts == (0, 1, 2, 3, 4) * 3
    assert near(read_frame(dataset, subject, "cam02", 8, False), picture(2, 3))
    assert near(read_proxy(dataset, subject, "cam01", 14), picture(1, 4), 8)
    assert index.meta["renderme360"]["e2"] == {
        "performance": "e2", "release": "full", "num_frame": 5, "last_frame": 4,
    }  # fmt: skip
    assert read_people(dataset, [subject]) == [{"age": 27, "gender": "female"}]
    assert not {"age", "gender", "weight"} & set(index.meta)
    assert str(tmp_path) not in dataset.index_file(subject).read_text()
    assert_rig(dataset, subject, rig([f"cam{n:02d}" for n in range(4)]))
    assert run_here(calibrate.STAGE, dataset, preset="draft", check_frame_sets=0).ok


def test_renderme_key_frames_and_what_is_left_out(tmp_path):
    names = [f"cam{n:02d}" for n in range(4)]
    path = tmp_path / "0041"
    frames = (0, 40, 80, 119)
    layouts.write_smc(path / "0041_e0.smc", names, frames)
    layouts.write_smc(path / "0041_e10.smc", names, frames, lacking={(3, 119)})
    layouts.write_smc(path / "0041_e2.smc", names, (0, 40), num=13)  # its end is missing
    layouts.write_smc(path / "0041_s1_all.smc", names, frames)
    dataset, subject = ingested(tmp_path, path)
    index = read_index(dataset, subject)
    assert index.cues == (Cue("neutral", 0, 3), Cue("e10", 4, 7))
    assert index.meta["renderme360"]["e10"]["release"] == "key frames"
    assert index.cameras["cam00"].pts[7] == index.meta["renderme360"]["e10"]["last_frame"] == 119
    lost = notes_of(dataset, "ingest", subject, "dropped")
    assert "e10 119" in lost["camera cam03"]
    assert "num_frame is 13" in lost["sequence e2"]
    assert "not a scripted expression" in lost["sequence s1_all"]
    assert_rig(dataset, subject, {k: c for k, c in rig(names).items() if k != "cam03"})


def test_renderme_of_two_actors_annotations_alone_or_an_unknown_camera_is_refused(tmp_path):
    layouts.write_renderme(tmp_path, expressions=1)
    with pytest.raises(CaptureError, match="anno/0026"):
        read_any(tmp_path / "anno" / "0026")
    (tmp_path / "wishes").mkdir()
    wish = 'source = "../raw/0026"\ncameras = ["cam99"]\n'
    (tmp_path / "wishes/capture.toml").write_text(wish)
    with pytest.raises(
        CaptureError, match="'cam99', which matches nothing; expected some of cam00"
    ):
        read_any(tmp_path / "wishes")
    (tmp_path / "wishes/capture.toml").write_text(
        'source = "../raw/0026"\n[expressions]\ne99 = "a"\n'
    )
    with pytest.raises(CaptureError, match=r"\[expressions\] names 'e99'"):
        read_any(tmp_path / "wishes")
    (tmp_path / "raw/0026/0027_e0_raw.smc").write_bytes(b"")
    with pytest.raises(CaptureError, match="0026, 0027"):
        subject_of(tmp_path / "raw" / "0026")


def test_nersemble_colours_are_corrected_and_sizes_fitted(tmp_path):
    path = layouts.write_nersemble(tmp_path, write_video)
    (path / "sequences" / "@eaDir").mkdir()  # as some disks add
    assert (detect(path).name, subject_of(path)) == ("nersemble", "018")
    dataset, subject = ingested(tmp_path, path)
    index = read_index(dataset, subject)
    assert index.cues == (Cue("EMO_1_shout_laugh", 0, 4), Cue("EXP_1_head", 5, 9))
    assert (index.fps, len(index.plates)) == (24.0, 3)
    camera = index.cameras["222200037"]
    assert camera.clips == (5, 5) and camera.correction == tuple(map(tuple, layouts.CCM))
    shape = (160, 110, 3)
    true = correct_srgb(picture(1, 3, shape), layouts.CCM)
    raw = picture(1, 3, shape)
    found = read_frame(dataset, subject, "222200037", 8, False)
    assert near(found, true, 6) and not near(found, raw, 6)
    assert near(read_proxy(dataset, subject, "222200037", 3), true, 8)
    plate = read_recorded_plate(index, "222200037")
    assert near(plate, correct_srgb(picture(1, 99, shape), layouts.CCM), 5)
    reader = FrameReader(index, "222200036")
    for frame in (9, 0, 6, 4):  # over the joint of two videos and back
        assert near(reader.read(frame), correct_srgb(picture(0, frame % 5, shape), layouts.CCM), 6)
    assert_rig(dataset, subject, rig(["222200036", "222200037", "222200038"], (110, 160)))


@pytest.mark.parametrize("every", [1, 4])
def test_nersemble_cameras_of_unequal_length(tmp_path, every):
    path = layouts.write_nersemble(tmp_path, write_video)
    videos = path / "sequences/EMO-1-shout+laugh/images"
    write_video(videos / "cam_222200036.mp4", noise_frames(7))
    write_video(path / "sequences/EXP-1-head/images/cam_222200038.mp4", noise_frames(4))
    dataset, subject = ingested(tmp_path, path, every=every)
    index = read_index(dataset, subject)
    assert sorted(index.cameras) == ["222200036", "222200037"]
    assert index.cameras["222200036"].clips == (5, 5)
    # The second clip's frames stay its own, and so do their proxies.
    assert near(
        read_proxy(dataset, subject, "222200036", 6),
        correct_srgb(picture(0, 1, (160, 110, 3)), layouts.CCM), 8,
    )  # fmt: skip
    lost = notes_of(dataset, "ingest", subject, "dropped")
    assert "has 4 frames of EXP_1_head, most cameras have 5" in lost["camera 222200038"]
    assert lost["last frames of EMO_1_shout_laugh in camera 222200036"]


def test_links_to_videos_that_are_not_there_are_named(tmp_path):
    path = layouts.write_nersemble(tmp_path, write_video)
    videos = sorted(path.glob("sequences/E*/images/*.mp4"))
    for video in (*videos[:3], videos[4]):  # one sequence, and one camera of the other
        video.unlink()
        video.symlink_to("../.git/annex/objects/x.mp4")
    raw = read_any(path)
    assert sorted(raw.cameras) == ["222200036", "222200038"] and raw.clips == ("EXP_1_head",)
    assert "is a link to" in raw.dropped["222200037"]
    assert "no camera has a picture of EMO-1-shout+laugh 0" in raw.skipped.values()
    for video in (videos[3], videos[5]):
        video.unlink()
        video.symlink_to("../.git/annex/objects/x.mp4")
    with pytest.raises(CaptureError, match="222200036.*is a link to .* which is not there"):
        read_any(path)
    archive = layouts.write_ava(tmp_path) / "decoder/image/cam400981.zip"
    archive.unlink()
    archive.symlink_to("nowhere.zip")
    assert "is a link to" in read_any(archive.parents[2]).dropped["cam400981"]


def noise_frames(count):
    return [image[:, :110] for image in noise_video_images(count, 160)]


def test_ava_reads_transposed_millimetres_and_names_unpublished_frames(tmp_path):
    path = layouts.write_ava(tmp_path, missing={(2, 251)}, unpublished={103})
    assert (detect(path).name, subject_of(path)) == ("ava256", "ABC123")
    dataset, subject = ingested(tmp_path, path)
    index = read_index(dataset, subject)
    assert index.cameras["cam401045"].pts == (100, 106, 250, 260, 261)
    assert index.cues == (Cue("EXP_neutral_peak", 0, 1), Cue("EXP_free_face", 2, 4))
    assert near(read_frame(dataset, subject, "cam401031", 3, False), picture(1, 260, (256, 167, 3)))
    words = " ".join(notes_of(dataset, "ingest", subject, "dropped").values())
    assert "no camera has a picture of EXP_neutral_peak 103" in words
    assert "cam401045 has no picture of EXP_free_face 251" in words
    names = [f"cam{n}" for n in (400981, 401031, 401045, 401163)]
    assert_rig(dataset, subject, rig(names, (167, 256)))


def test_multiface(tmp_path):
    path = layouts.write_multiface(tmp_path)
    assert (detect(path).name, subject_of(path)) == ("multiface", "6795937")
    dataset, subject = ingested(tmp_path, path)
    index = read_index(dataset, subject)
    assert index.cues == (Cue("E001_Neutral_Eyes_Open", 0, 1), Cue("E010_Smile", 2, 2))
    expected = picture(2, 31, (512, 334, 3))
    assert np.array_equal(read_frame(dataset, subject, "400008", 2, False), expected)
    assert_rig(dataset, subject, rig(["400002", "400004", "400008"], (334, 512)))


def test_ravdess_names(tmp_path):
    path = tmp_path / "Actor_05"
    path.mkdir()
    for number, name in enumerate(("01-01-03-02-01-01-05", "01-02-04-01-02-01-05", "take")):
        write_video(path / f"{name}.mp4", noise_video_images(4 + number))
    write_video(path / "02-01-03-02-01-01-05.mp4", noise_video_images(4))
    dataset, subject = ingested(tmp_path, path)
    index = read_index(dataset, subject)
    assert (subject, index.fps) == ("Actor_05", 24.0) and "gender" not in index.meta
    assert read_people(dataset, [subject]) == [{"gender": "male"}]
    assert index.cues == (Cue("song_sad_normal_dogs_1", 0, 4), Cue("happy_strong_kids_1", 5, 8))
    lost = notes_of(dataset, "ingest", subject, "dropped")
    assert "the same clip as 01-01-03" in lost["file 02-01-03-02-01-01-05.mp4"]
    assert "not one of RAVDESS" in lost["file take.mp4"]


def test_transforms_and_colmap(tmp_path):
    path = layouts.write_transforms(tmp_path)
    dataset, subject = ingested(tmp_path, path, layouts.write_colmap(tmp_path))
    index = read_index(dataset, subject)
    assert index.cues == (Cue("photo", 0, 1),)
    found = read_frame(dataset, subject, "cam03", 1, False)
    assert np.array_equal(found, picture(3, 1))
    assert_rig(dataset, subject, rig([f"cam{n:02d}" for n in range(4)]))
    assert np.array_equal(read_frame(dataset, "scan", "p2", 0, False), picture(2, 0))
    assert_rig(dataset, "scan", rig([f"p{n}" for n in range(4)]))
    assert "metres_per_unit" in notes_of(dataset, "ingest", "scan")["scale"]


def test_photos_and_a_video(tmp_path):
    (tmp_path / "shots").mkdir()
    for number in range(3):
        (tmp_path / f"shots/IMG {number}.png").write_bytes(encode_png(picture(number, 0)))
    write_video(tmp_path / "talk.mp4", noise_video_images(6))
    dataset, _ = ingested(tmp_path, tmp_path / "shots", tmp_path / "talk.mp4")
    shots, talk = read_index(dataset, "shots"), read_index(dataset, "talk")
    assert list(shots.cameras) == ["IMG_0", "IMG_1", "IMG_2"]
    assert shots.calibration is None and shots.cues == (Cue("photo", 0, 0),)
    assert talk.cues == (Cue("clip", 0, 5),)
    assert read_frame(dataset, "talk", "video", 5, False).shape == (64, 64, 3)
    for name in ("board/IMG_1/0.png", "board/board.toml"):
        (tmp_path / "shots" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "shots" / name).touch()
    assert read_any(tmp_path / "shots").board["cameras"] == {"IMG_1": ["board/IMG_1/0.png"]}


def test_a_telephones_video_is_read_upright(tmp_path):
    images = noise_video_images(3)
    images = [np.ascontiguousarray(image[:48]) for image in images]  # upright: 48 high, 64 wide
    write_video(tmp_path / "talk.mp4", [np.ascontiguousarray(np.rot90(i)) for i in images])
    turn_video(tmp_path / "talk.mp4")
    dataset, _ = ingested(tmp_path, tmp_path / "talk.mp4")
    camera = read_index(dataset, "talk").cameras["video"]
    assert (camera.width, camera.height, camera.orientation) == (64, 48, 6)
    assert near(read_frame(dataset, "talk", "video", 2, False), images[2], 20)


def test_a_folder_of_videos_is_a_rig_with_what_lies_beside_them(tmp_path):
    folder, images = tmp_path / "rig", noise_video_images(4)
    folder.mkdir()
    for name in ("GoPro 1.MP4", "left.mov"):
        write_video(folder / name, images)
    assert (detect(folder).name, subject_of(folder)) == ("videos", "rig")
    index = read_index(*ingested(tmp_path, folder))
    assert list(index.cameras) == ["GoPro_1", "left"] and index.cues == (Cue("clip", 0, 3),)
    (folder / "cues.csv").write_text("expression_id,start_frame,end_frame\nsmile,1,2\n")
    write_cameras(folder / "calibration.json", rig(["left"]))
    found = read_any(folder)
    assert found.cues == (Cue("smile", 1, 2),) and list(found.calibration) == ["left"]
    assert list(found.cameras) == ["left"] and "GoPro_1" in found.dropped
    (folder / "calibration.json").unlink()
    for name in ("board/GoPro 1.mov", "board/board.toml", "plates/left.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    found = read_any(folder)
    assert found.board == {"config": {}, "cameras": {"GoPro_1": ["board/GoPro 1.mov"]}}
    assert found.plates == {"left": "plates/left.png"} and not found.warnings
    write_video(folder / "left.mp4", images)
    with pytest.raises(CaptureError, match="left.mov and left.mp4 both become camera left"):
        read_any(folder)


def test_a_file_that_is_not_a_video_drops_only_its_camera(tmp_path):
    folder = tmp_path / "rig"
    folder.mkdir()
    for name in ("left.mp4", "right.mp4"):
        write_video(folder / name, noise_video_images(4))
    (folder / "empty.mp4").touch()
    found = read_any(folder)  # the frame rate is not that of the first file by name
    assert (list(found.cameras), list(found.dropped)) == (["left", "right"], ["empty"])
    assert "empty.mp4: cannot be opened as a video" in found.dropped["empty"]
    for name in ("left.mp4", "right.mp4"):
        (folder / name).write_bytes(b"")
    with pytest.raises(CaptureError, match="empty.mp4: cannot be opened"):
        read_any(folder)


def test_a_participants_first_video_may_be_damaged(tmp_path):
    path = layouts.write_nersemble(tmp_path, write_video)
    (path / "sequences/EMO-1-shout+laugh/images/cam_222200036.mp4").write_bytes(b"")
    dataset, subject = ingested(tmp_path, path)
    assert sorted(read_index(dataset, subject).cameras) == ["222200037", "222200038"]


def test_a_video_that_one_camera_lacks_costs_the_camera_or_the_video_whichever_is_less(tmp_path):
    names = [f"c{n:02d}" for n in range(16)]
    for count, cameras, kept in ((2, 15, 2), (20, 16, 19)):
        moments = [(f"s{n:02d}", 0) for n in range(count)]
        videos = {name: dict.fromkeys(moments, "x.mp4") for name in names}
        del videos["c03"][moments[1]]
        line = common_timeline(tmp_path, videos, [sequence for sequence, _ in moments], "videos")
        assert (len(line.cameras), len(line.sequences)) == (cameras, kept)


def test_capture_toml_may_not_point_at_a_capture_in_our_own_layout(tmp_path, capture):
    (tmp_path / "wishes").mkdir()
    (tmp_path / "wishes/capture.toml").write_text(f'source = "{capture.as_posix()}"\n')
    with pytest.raises(CaptureError, match="our own layout"):
        read_any(tmp_path / "wishes")


def test_capture_toml_points_at_read_only_data_and_chooses(tmp_path):
    layouts.write_ava(tmp_path)
    wishes = tmp_path / "wishes"
    wishes.mkdir()
    (wishes / "capture.toml").write_text(
        'source = "../20220818--1122--ABC123"\nsubject = "S007"\nconsent_id = "C7"\n'
        'cameras = ["cam401*"]\nsequences = ["EXP_n*"]\nfps = 7.5\n'
        '[expressions]\nEXP_neutral_peak = "neutral"\n'
    )
    dataset, subject = ingested(tmp_path, wishes)
    index = read_index(dataset, subject)
    assert (subject, index.fps, index.meta["consent_id"]) == ("S007", 7.5, "C7")
    assert "source" not in index.meta
    assert len(index.cameras) == 3 and index.cues == (Cue("neutral", 0, 2),)
    assert (
        notes_of(dataset, "ingest", subject, "dropped")["sequence EXP_free_face"] == "not selected"
    )
    assert near(read_frame(dataset, subject, "cam401163", 2, False), picture(3, 106, (256, 167, 3)))
    file = wishes / "capture.toml"
    file.write_text(file.read_text().replace("EXP_n*", "EXP_x*"))
    with pytest.raises(CaptureError, match="EXP_x.*EXP_neutral"):
        read_any(wishes)


def test_nothing_fits_is_one_error_that_names_the_layouts(tmp_path):
    outer, tmp_path = tmp_path, tmp_path / "captures"
    tmp_path.mkdir()
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(CaptureError, match="notes.txt.*renderme360.*nersemble.*colmap"):
        detect(tmp_path)
    (tmp_path / "S001").mkdir()
    (tmp_path / "S001/capture.toml").touch()
    for folder in (tmp_path, outer):
        with pytest.raises(CaptureError, match=f"a folder of captures, .* give {tmp_path}/[*]$"):
            detect(folder)
    (tmp_path / "S001/cameras").mkdir()
    (tmp_path / "S001/cameras/cam00/frames").mkdir(parents=True)
    for part in ("cameras", "capture.toml", "cameras/cam00", "cameras/cam00/frames"):
        with pytest.raises(CaptureError, match=f"part of the capture {tmp_path / 'S001'}; give"):
            detect(tmp_path / "S001" / part)
    with pytest.raises(CaptureError, match="'avi'.*express50"):
        detect(tmp_path, "avi")


def test_cameras_read_the_wrong_way_round_are_refused(tmp_path):
    path = layouts.write_nersemble(tmp_path, write_video)
    file = path / "calibration/camera_params.json"
    table = json.loads(file.read_text())
    table["world_2_cam"] = {
        k: np.linalg.inv(np.array(v)).tolist() for k, v in table["world_2_cam"].items()
    }
    file.write_text(json.dumps(table))
    with pytest.raises(CalibrationError):
        read_any(path)


def test_the_last_frame_rule_knows_the_release(tmp_path):
    from annotations.exchange import last_frame_marks

    path = layouts.write_renderme(tmp_path, expressions=2)
    dataset, subject = ingested(tmp_path, path)
    marks = last_frame_marks(dataset, read_index(dataset, subject))
    assert [(m.expression, m.frame, m.pts) for m in marks] == [("neutral", 4, 4), ("e1", 9, 4)]
    assert marks[1].reason == "full release, frame 4 of 5"


def test_a_replaced_file_is_named(tmp_path):
    path = layouts.write_multiface(tmp_path)
    dataset, subject = ingested(tmp_path, path)
    file = path / "images/E010_Smile/400008/000031.png"
    file.write_bytes(encode_png(picture(5, 5, (512, 334, 3))))
    with pytest.raises(CaptureError, match="E010_Smile/400008/000031.png"):
        read_frame(dataset, subject, "400008", 2, False)
