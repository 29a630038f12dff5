"""Rigs whose footage lies in folders by camera, by expression or by frame."""

import numpy as np
import pytest

from express50.capture.index import Cue, read_index
from express50.capture.readers.read import detect, is_ours, read_any, subject_of
from express50.errors import CaptureError
from express50.files.calibration import write_cameras
from express50.files.images import write_image
from tests.express50.capture.layouts import picture, rig
from tests.stages import ingest_captures
from tests.synth import noise_video_images, read_frame, write_video

FRAMES = 3


def write(root, names):
    """Write a video, or a blank picture, of each of these names."""
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".mp4":
            write_video(path, noise_video_images(FRAMES))
        else:
            write_image(path, picture(0, 0))
    return root


@pytest.mark.parametrize(
    ("layout", "names"),
    [
        ("camera_folders", "cam{c}/{f:06d}.png"),
        ("camera_folders", "cam{c}/shot_{f}.png"),
        ("camera_folders", "2219{c}0/{f:06d}.png"),
        ("frame_folders", "{f:04d}/cam{c}.png"),
        ("frame_folders", "frame_{f:05d}/{c}.png"),
        ("frame_folders", "{f:06d}/2219{c}0.png"),
    ],
)
def test_folders_of_pictures_are_a_rig(tmp_path, layout, names):
    root, order = tmp_path / "rig", [(c, f) for c in (0, 1) for f in range(8, 11)]
    for c, f in order:
        write(root, [names.format(c=c, f=f)])
        write_image(root / names.format(c=c, f=f), picture(c, f))
    assert (detect(root).name, subject_of(root)) == (layout, "rig")
    dataset = ingest_captures(tmp_path / "data", root)
    index = read_index(dataset, "rig")
    assert len(index.cameras) == 2 and index.cues == (Cue("clip", 0, 2),)
    for c, camera in enumerate(sorted(index.cameras)):  # the tenth frame comes after the ninth
        assert index.cameras[camera].pts == (8, 9, 10)
        np.testing.assert_array_equal(read_frame(dataset, "rig", camera, 2, False), picture(c, 10))


@pytest.mark.parametrize(
    ("layout", "names"),
    [
        ("camera_folders", "GoPro {c}/{e}.mp4"),
        ("camera_folders", "GoPro {c}/GoPro {c}_{e}.mp4"),
        ("camera_folders", "22190{c}/{e}.mp4"),
        ("expression_folders", "{e}/22190{c}_cam.mp4"),
        ("expression_folders", "{e}/view {c}.png"),
    ],
)
def test_names_of_files_or_folders_are_expressions(tmp_path, layout, names):
    expressions = ("look left", "smile")
    names = [names.format(c=c, e=e) for c in (0, 1) for e in expressions]
    root = write(tmp_path / "rig", names)
    (root / "cues.csv").write_text("expression_id,start_frame,end_frame\nsmile,1,2\n")
    found = read_any(root)
    assert detect(root).name == layout and found.clips == ("look_left", "smile")
    assert len(found.cameras) == 2 and "cues.csv" in found.warnings
    index = read_index(ingest_captures(tmp_path / "data", root), "rig")
    length = FRAMES if names[0].endswith("mp4") else 1
    assert index.cues == (Cue("look_left", 0, length - 1), Cue("smile", length, 2 * length - 1))


@pytest.mark.parametrize(
    ("layout", "names"),
    [
        ("expression_folders", "{e}/cam{c}/{f:04d}.png"),
        ("expression_folders", "images/{e}/22190{c}/frames/{f}.png"),
        ("expression_folders", "{e}/cam{c}/GX01{f}.mp4"),
        ("camera_folders", "cam{c}/{e}/{f:04d}.png"),
        ("camera_folders", "cam{c}/{e}/video.mp4"),
    ],
)
def test_cameras_and_expressions_may_be_two_levels_of_folders(tmp_path, layout, names):
    frames = range(8, 11) if names.endswith("png") else [0]
    parts = [(c, e, f) for c in (0, 1) for e in ("neutral", "smile") for f in frames]
    root = write(tmp_path / "rig", [names.format(c=c, e=e, f=f) for c, e, f in parts])
    write(root, ["plates/cam0.png"])
    if names.endswith("png"):
        for c, e, f in parts:
            write_image(root / names.format(c=c, e=e, f=f), picture(c, f))
    assert (detect(root).name, read_any(root).clips) == (layout, ("neutral", "smile"))
    dataset = ingest_captures(tmp_path / "data", root)
    index = read_index(dataset, "rig")
    assert len(index.cameras) == 2
    assert index.cues == (Cue("neutral", 0, 2), Cue("smile", 3, 5))
    if names.endswith("png"):
        assert index.cameras[min(index.cameras)].pts == (8, 9, 10) * 2
        shown = read_frame(dataset, "rig", max(index.cameras), 5, False)
        np.testing.assert_array_equal(shown, picture(1, 10))


def test_rigs_of_people_are_not_expressions_of_one(tmp_path):
    names = [f"{who}/cam{c}/{f}.png" for who in ("anna", "bob") for c in (0, 1) for f in (0, 1)]
    root = write(tmp_path / "day", names)
    with pytest.raises(CaptureError, match="give each folder by itself if it is a person"):
        read_any(root)
    assert read_any(root / "anna").layout == "camera_folders"
    (root / "capture.toml").write_text('layout = "expression_folders"')
    assert read_any(root).clips == ("anna", "bob")


@pytest.mark.parametrize(
    ("layout", "footage"),
    [
        ("videos", "videos/cam{c}.mp4"),
        ("videos", "cameras/cam{c}.mp4"),
        ("camera_folders", "images/cam{c}/{f:06d}.png"),
        ("camera_folders", "cam{c}/frames/{f:06d}.png"),
        ("expression_folders", "smile{f}/videos/cam{c}.mp4"),
        ("frame_folders", "timesteps/frame_{f:05d}/images-2fps/cam{c}.png"),
        ("photos", "image/00{c}.png"),
    ],
)
def test_footage_may_lie_one_folder_deeper(tmp_path, layout, footage):
    names = [footage.format(c=c, f=f) for c in (0, 1) for f in range(FRAMES)]
    root = write(tmp_path / "rig", [*dict.fromkeys(names)])
    write(root, ["masks/cam0/0.png", "plates/cam0.png"])
    cameras = ["000", "001"] if layout == "photos" else ["cam0", "cam1"]
    write_cameras(root / "calibration.json", rig(cameras))
    found = read_any(root)
    assert (found.layout, found.subject, list(found.cameras)) == (layout, "rig", cameras)
    assert list(found.calibration) == cameras and not found.dropped
    assert bool(found.plates) == (layout != "photos")
    if footage.endswith("png"):
        ingest_captures(tmp_path / "data", root)


def test_pictures_beside_our_own_layout_change_nothing(tmp_path):
    root = write(tmp_path / "rig", ["cameras/cam0/frames/000000.png", "images/overview.png"])
    assert is_ours(root)
    write(root, ["videos/turntable.mp4"])
    assert is_ours(root)


def test_a_rig_further_below_is_named(tmp_path):
    write(tmp_path / "day/take", ["video/cam0.mp4", "video/cam1.mp4"])
    with pytest.raises(CaptureError, match=r"no known layout, but .*/day/take has one .* give th"):
        read_any(tmp_path)


def test_folders_beside_each_other_are_not_chosen_from(tmp_path):
    root = write(tmp_path / "rig", ["images/left.png", "other/left.png"])
    with pytest.raises(CaptureError, match="its folders .images, other. hold footage"):
        read_any(root)


def test_a_video_per_camera_folder_is_one_clip_whatever_its_name(tmp_path):
    root = write(tmp_path / "rig", ["cam_a/GX010023.mp4", "cam_b/GX010456.mp4"])
    (root / "cam_a/GX010023.THM").touch()
    (root / "cues.csv").write_text("expression_id,start_frame,end_frame\nsmile,1,2\n")
    found = read_any(root)
    assert list(found.cameras) == ["cam_a", "cam_b"] and found.cues == (Cue("smile", 1, 2),)


def test_a_calibration_says_which_names_are_cameras(tmp_path):
    root = write(tmp_path / "rig", ["left/01.mp4", "left/02.mp4", "right/01.mp4", "right/02.mp4"])
    for cameras, layout in ((["left", "right"], "camera"), (["01", "02"], "expression")):
        write_cameras(root / "calibration.json", rig(cameras))
        assert detect(root).name == f"{layout}_folders"
        found = read_any(root)
        assert list(found.cameras) == list(found.calibration) == cameras


def test_names_that_do_not_tell_are_not_guessed_at(tmp_path):
    """Folders of people would be read as expressions of one."""
    pairs = [(s, c) for s in (1, 2) for c in (0, 1)]
    for kind in ("png", "mp4"):
        root = write(tmp_path / kind, [f"S00{s}/cam{c}.{kind}" for s, c in pairs])
        with pytest.raises(CaptureError, match="or else write 'layout' into a capture.toml beside"):
            read_any(root)
    (root / "capture.toml").write_text('layout = "expression_folders"\nsequences = ["S001"]')
    found = read_any(root)
    assert found.clips == ("S001",) and list(found.cameras) == ["cam0", "cam1"]
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "capture.toml").write_text('layout = "frame_folders"')
    with pytest.raises(CaptureError, match="its cameras share no frames .it has no cameras"):
        read_any(empty)


def test_cues_count_the_frames_that_one_camera_lacks(tmp_path):
    """Otherwise all later expressions would be looked for one frame late."""
    names = [f"cam{c}/{1001 + f}.png" for c in (0, 1) for f in range(9)]
    root = write(tmp_path / "rig", [name for name in names if name != "cam1/1004.png"])
    cues = "expression_id,start_frame,end_frame\nneutral,0,2\nsmile,3,3\nfrown,4,5\njaw,2,8\n"
    (root / "cues.csv").write_text(cues + "late,7,9\n")
    found = read_any(root)
    assert found.cameras["cam0"].stamps == (1001, 1002, 1003, 1005, 1006, 1007, 1008, 1009)
    assert {c.expression_id: (c.start_frame, c.end_frame) for c in found.cues} == {
        "neutral": (0, 2), "frown": (3, 4), "jaw": (2, 7), "late": (6, 8)
    }  # fmt: skip
    assert "expression smile" in found.skipped


def test_a_camera_folder_without_footage_is_named(tmp_path):
    root = write(tmp_path / "rig", ["cam0/1.png", "cam1/1.png"])
    for name in ("cam2", "notes"):
        (root / name).mkdir()
    found = read_any(root)
    assert list(found.cameras) == ["cam0", "cam1"] and list(found.dropped) == ["cam2"]
    write_cameras(root / "calibration.json", rig(["cam0", "cam1", "cam2", "cam3"]))
    write(root, ["plates/cam2.png", "plates/cam3.png"])
    found = read_any(root)
    assert list(found.dropped) == ["cam2", "cam3"] and "plates" not in found.warnings


def test_a_cameras_folder_of_our_own_layout_is_not_a_capture(tmp_path):
    folder = write(tmp_path / "S001", ["cameras/cam0/video.mp4"]) / "cameras/cam0"
    (tmp_path / "S001/capture.toml").write_text('subject = "S001"\nfps = 24\n')
    with pytest.raises(CaptureError, match="part of the capture .*S001; give that folder"):
        subject_of(folder)


def test_a_picture_without_a_number_is_named(tmp_path):
    root = write(tmp_path / "rig", ["cam0/1.png", "cam1/1.png"])
    write_image(root / "cam1/dark.png", picture(0, 0))
    with pytest.raises(CaptureError, match="dark.png: has no number in its name"):
        read_any(root)


def test_pictures_that_have_to_be_converted_are_named_beside_others(tmp_path):
    write(tmp_path, ("cam0.jpg", "cam1.png", "plates/cam0.png"))
    for name in ("cam0.CR2", "cam2.HEIC", "plates/cam1.webp", ".cam3.heic"):
        (tmp_path / name).touch()
    named = "cam2.HEIC, plates/cam1.webp: not read: export them as JPEG, PNG, TIFF or .mp4"
    assert read_any(tmp_path).warnings == {"files": named}


@pytest.mark.parametrize("name", ["a.HEIC", "cam0/a.NEF", "a.ogv", "cam0/a.webp"])
def test_files_that_have_to_be_converted_are_named(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    with pytest.raises(CaptureError, match=r"such as \*\.\w+ are not read: export them as"):
        read_any(tmp_path)
