"""Bare photographs and videos: from one file to a track, without calibration."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from express50.__main__ import main
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.errors import CaptureError
from express50.files.atomic import write_json
from express50.files.calibration import read_cameras
from express50.files.containers import read_picture
from express50.files.images import write_image
from express50.files.video import iterate_video
from express50.geometry.pixels import hdr_to_srgb
from express50.head.load import load_head
from express50.head.model import landmarks, pose
from pipelines.calibrate.footage import has_one_lens
from pipelines.photo import capture
from pipelines.photo.capture import find_faces, make_photo_capture, open_picture, subject_id
from pipelines.track.config import TrackConfig
from tests.synth import turn_video, write_in_adobe_rgb, write_photo, write_video

data = pytest.importorskip("skimage.data")


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return data.astronaut()


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory, astronaut: np.ndarray) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("photo")
    write_image(folder / "eva (1).png", astronaut)
    assert main(["photo", str(folder / "eva (1).png"), str(folder / "out")]) == 0
    metrics = json.loads((folder / "out/track/eva_1/metrics.json").read_text())
    return folder / "out", metrics


def test_a_bare_photograph_is_tracked(tracked: tuple[Path, dict], capsys) -> None:
    out, metrics = tracked
    assert (out / "panels/eva_1/panel.jpg").stat().st_size > 30_000
    assert main(["ingest", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["skipped"] == 1, "nothing that ingest read changed"
    # A face 120 px tall: 2 px are 8 mm of a face's 24 cm at the very most.
    assert metrics["landmark_rms_px_mean"] < 2.0
    assert metrics["marked_views"] == 1
    meta = (out / "photos/eva_1/capture.toml").read_text()
    assert 'focal_source = "guess"' in meta
    found = json.loads((out / "ingest/eva_1/metrics.json").read_text())
    assert not found["warnings"], "what we wrote ourselves is not odd"


def test_the_head_has_the_dimensions_of_an_adults(tracked: tuple[Path, dict]) -> None:
    """No dimension of a head leaves what adults have, depth least of all."""
    with np.load(tracked[0] / "track/eva_1/track.npz") as track:
        head = (track["vertices"][0] - track["t"][0]) @ track["R"][0]
        assert np.abs(track["shape"]).max() < 3.0
        assert track["R"][0][1, 1] > 0.9  # upright in a world whose y is up
        assert 0.5 < -track["t"][0, 2] < 3.0
    from express50.head.load import load_head

    skull = head[load_head("procedural").regions["scalp"].numpy()]
    face = head[load_head("procedural").regions["face"].numpy()]
    depth = max(skull[:, 2].max(), face[:, 2].max()) - skull[:, 2].min()
    assert 0.16 < depth < 0.25
    assert 0.12 < np.ptp(skull[:, 0]) < 0.19


def test_the_camera_is_at_the_origin_with_its_point_in_the_middle(tracked) -> None:
    camera = read_cameras(tracked[0] / "photos/eva_1/calibration.json")["photo"]
    np.testing.assert_allclose(camera.center, 0.0, atol=1e-12)
    np.testing.assert_allclose(camera.K[:2, 2], [256.0, 256.0])
    film = camera.K[0, 0] / np.hypot(512, 512) * np.hypot(36, 24)
    assert film == pytest.approx(50.0, rel=0.01)


def test_a_picture_without_a_face_is_one_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    write_image(tmp_path / "wall.png", np.repeat(data.brick()[..., None], 3, axis=2))
    assert main(["photo", str(tmp_path / "wall.png"), str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err.strip()
    assert "no face found" in said and "\n" not in said
    assert not (tmp_path / "out").exists()


def test_a_video_without_a_face_is_refused_after_few_searches(monkeypatch) -> None:
    """A small face that appears late is found all the same."""
    searched, detect = [], capture.detect
    config = TrackConfig(search=0.08)
    rng = np.random.default_rng(0)
    wall = np.repeat(data.brick()[:360, :480, None], 3, axis=2)
    noise = rng.normal(0, 5, (6, *wall.shape))
    still = list(np.clip(wall + noise, 0, 255).astype(np.uint8))
    pan = [np.roll(wall, 60 * n, axis=1) for n in range(6)]
    with monkeypatch.context() as patch:
        blind = lambda *inputs: searched.append(inputs) or detect(*inputs[:3], 1.0)  # noqa: E731
        patch.setattr(capture, "detect", blind)
        for images, searches in ((still, 1), (pan, capture.THOROUGH)):
            searched.clear()
            with pytest.raises(CaptureError, match="no face found"):
                find_faces(Path("wall.mp4"), images, config)
            assert [inputs[3] for inputs in searched] == [config.search] * searches
    still[-1][40:150, 300:410] = cv2.resize(data.astronaut()[:220, 110:330], (110, 110))
    (face,) = find_faces(Path("late.mp4"), still, config)
    np.testing.assert_allclose(face.points.mean(0), (357, 100), atol=8)


def test_wrong_options_and_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("no picture")
    for arguments in (["--focal-px", "-3"], ["--windows", "0"], ["--subject", "a b"]):
        assert main(["photo", str(tmp_path / "a.txt"), str(tmp_path / "o"), *arguments]) == 2
    with pytest.raises(CaptureError, match="not a photograph or video"):
        open_picture(tmp_path / "a.txt")
    with pytest.raises(CaptureError, match="no such file"):
        open_picture(tmp_path / "b.png")
    (tmp_path / "c.png").write_text("no picture")
    with pytest.raises(CaptureError, match="cannot be read"):
        open_picture(tmp_path / "c.png")


def test_a_walk_around_a_person_gives_its_sharpest_pictures_as_one_rig(tmp_path, capsys) -> None:
    scene = cv2.resize(data.astronaut(), (640, 640))
    images = [scene[:480, 4 * n : 4 * n + 320] for n in range(20)]
    blurred = [cv2.blur(image, (1, 9)) for image in images]
    film = [images[n] if n % 5 == 3 else blurred[n] for n in range(20)]
    write_video(tmp_path / "walk.mp4", film)
    out, walk = tmp_path / "out", ["photo", str(tmp_path / "walk.mp4"), str(tmp_path / "out")]
    assert main([*walk, "--walk", "2"]) == 2 and main([*walk, "--walk", "21"]) == 1
    assert "has 20 frames, expected 21" in capsys.readouterr().err
    for count in (5, 4):  # the second replaces the first
        assert main([*walk, "--walk", str(count), "--focal-px", "500"]) == 0
    pictures = sorted(path.name for path in (out / "photos/walk").glob("*.jpg"))
    assert pictures == [f"{n:05d}.jpg" for n in (3, 8, 13, 18)]
    assert str(out / "photos/walk") in capsys.readouterr().out
    assert main(["ingest", str(out), str(out / "photos/walk")]) == 0
    index = read_index(Dataset(out), "walk")
    assert [*index.cameras] == ["00003", "00008", "00013", "00018"]
    assert has_one_lens(index) and index.meta["focal_px"] == 500
    assert main(walk) == 1 and "was made with --walk" in capsys.readouterr().err
    assert main([*walk, "--walk", "--matte"]) == main([*walk, "--walk", "--windows", "3"]) == 2


def test_a_walk_in_hdr_gives_pictures_in_srgb(tmp_path, capsys, astronaut) -> None:
    path = tmp_path / "phone.mp4"
    write_video(path, [astronaut] * 3, options={"x264-params": "transfer=arib-std-b67"})
    assert main(["photo", str(path), str(tmp_path / "out"), "--walk", "3"]) == 0
    assert "its colours are converted from 'HLG' to sRGB" in capsys.readouterr().err
    picture = read_picture(tmp_path / "out/photos/phone", "00000.jpg")
    as_read = next(iterate_video(path))[1]
    assert np.abs(picture.astype(int) - hdr_to_srgb(as_read, "HLG")).mean() < 2
    assert np.abs(picture.astype(int) - as_read).mean() > 10


def test_a_second_picture_of_the_same_name_takes_nobodys_place(
    tmp_path: Path, astronaut: np.ndarray
) -> None:
    config = TrackConfig()
    for folder, image in (("a", astronaut), ("b", astronaut[:, ::-1])):
        (tmp_path / folder).mkdir()
        write_image(tmp_path / folder / "eva.png", np.ascontiguousarray(image))
    out = tmp_path / "out"
    make_photo_capture(open_picture(tmp_path / "a/eva.png"), out, "eva", config)
    stored = out / "cameras/photo/frames/000000.png"
    before = stored.read_bytes()
    with pytest.raises(CaptureError, match="made from another picture; name this one"):
        make_photo_capture(open_picture(tmp_path / "b/eva.png"), out, "eva", config)
    assert stored.read_bytes() == before
    make_photo_capture(open_picture(stored), out, "eva", config)
    assert stored.read_bytes() == before


def test_a_subject_with_a_capture_elsewhere_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    write_image(tmp_path / "eva.png", data.astronaut())
    (tmp_path / "rig").mkdir()
    write_json(tmp_path / "out" / "captures.json", {"S001": str(tmp_path / "rig")})
    photo = ["photo", str(tmp_path / "eva.png"), str(tmp_path / "out"), "--subject", "S001"]
    assert main(photo) == 2
    assert "another id with --subject, or name another OUT" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["captures.json"]


@pytest.mark.parametrize("own", ["capture.toml", "notes.txt"])
def test_a_capture_that_somebody_else_made_is_kept(
    tmp_path: Path, astronaut: np.ndarray, own: str
) -> None:
    footage = tmp_path / "out/cameras/photo/frames/000000.png"
    write_image(tmp_path / "eva.png", astronaut)
    footage.parent.mkdir(parents=True)
    footage.write_text("mine")
    (tmp_path / "out" / own).write_text('subject = "eva"')
    with pytest.raises(CaptureError, match="is not a capture of this picture"):
        make_photo_capture(open_picture(tmp_path / "eva.png"), tmp_path / "out", "e", TrackConfig())
    assert footage.read_text() == "mine"


def test_folders_and_focal_lengths_of_no_lens_are_refused(
    tmp_path: Path, astronaut: np.ndarray
) -> None:
    with pytest.raises(CaptureError, match="is a folder.*express50 ingest"):
        open_picture(tmp_path)
    write_image(tmp_path / "eva.png", astronaut)
    for lens in ({"focal_px": 50.0}, {"focal_px": 1e6}, {"film_mm": 0.001}):
        with pytest.raises(CaptureError, match="expected 51.2 to 51200 for a picture 512 px long"):
            make_photo_capture(
                open_picture(tmp_path / "eva.png"), tmp_path / "out", "eva", TrackConfig(),
                **lens,
            )  # fmt: skip
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("suffix", ["webp", "bmp"])
def test_photographs_of_kinds_that_no_rig_writes_are_read(
    tmp_path: Path, astronaut: np.ndarray, suffix: str
) -> None:
    path = tmp_path / f"eva.{suffix}"
    cv2.imwrite(str(path), astronaut[..., ::-1])
    make_photo_capture(open_picture(path), tmp_path / "out", "eva", TrackConfig())
    stored = read_picture(tmp_path / "out/cameras/photo/frames", "000000.png")
    assert np.abs(stored.astype(int) - astronaut).mean() < 4


def test_a_photograph_with_a_colour_profile_is_stored_in_srgb(
    tmp_path: Path, astronaut: np.ndarray
) -> None:
    for name in ("a.jpg", "b.png"):
        write_in_adobe_rgb(tmp_path / name, astronaut)
        make_photo_capture(open_picture(tmp_path / name), tmp_path / name[0], "a", TrackConfig())
        stored = read_picture(tmp_path / name[0] / "cameras/photo/frames", "000000.png")
        assert np.abs(stored.astype(int) - astronaut).mean() < 2
        assert open_picture(tmp_path / name[0] / "cameras/photo/frames/000000.png").profile is None


def test_a_photograph_on_its_side_is_tracked_as_an_upright_one(
    tmp_path: Path, astronaut: np.ndarray
) -> None:
    """Size, principal point, focal length and face are those of the upright picture."""
    upright = np.ascontiguousarray(astronaut[:360, 80:360])
    tags = {"Orientation": 6, "Exif_FocalLengthIn35mmFilm": 50}
    write_photo(tmp_path / "a.tif", np.rot90(upright, 1), **tags)
    picture = open_picture(tmp_path / "a.tif")
    config = TrackConfig()
    capture = make_photo_capture(picture, tmp_path / "out", "a", config)
    focal = capture.focal
    assert capture.search == config.search  # a photograph is searched once
    camera = read_cameras(tmp_path / "out/calibration.json")["photo"]
    assert (camera.width, camera.height) == (280, 360)
    np.testing.assert_allclose(camera.K[:2, 2], [140, 180])
    assert focal.source == "exif"
    assert focal.pixels == pytest.approx(50 / np.hypot(36, 24) * np.hypot(280, 360))
    stored = read_picture(tmp_path / "out/cameras/photo/frames", "000000.png")
    np.testing.assert_array_equal(stored, upright)


def test_subject_ids_are_made_of_file_names() -> None:
    assert subject_id(Path("my face.jpg")) == "my_face"
    assert subject_id(Path("???.jpg")) == "photo"


def test_a_telephones_video_is_stored_upright(tmp_path: Path, astronaut: np.ndarray) -> None:
    upright = np.ascontiguousarray(astronaut[:360, 80:360])
    write_video(tmp_path / "a.mp4", [np.ascontiguousarray(np.rot90(upright))] * 3, rate=30)
    turn_video(tmp_path / "a.mp4")
    picture = open_picture(tmp_path / "a.mp4")
    config = TrackConfig(search=0.08)
    capture = make_photo_capture(picture, tmp_path / "out", "a", config, windows=1)
    assert capture.search == 0.25  # the face is wider: smaller windows would show none
    camera = read_cameras(tmp_path / "out/calibration.json")["photo"]
    assert (camera.width, camera.height) == (280, 360)
    stored = [image for _, image in iterate_video(tmp_path / "out/cameras/photo/video.mp4")]
    assert len(stored) == 3 and stored[0].shape == upright.shape
    assert np.abs(stored[2].astype(int) - upright).mean() < 6
    assert "fps = 30" in (tmp_path / "out/capture.toml").read_text()


def test_a_video_is_searched_in_windows_as_small_as_its_faces(tmp_path, astronaut) -> None:
    small = cv2.resize(astronaut, (96, 96), interpolation=cv2.INTER_AREA)
    wide = np.full((240, 480, 3), 90, np.uint8)
    wide[60:156, 200:296] = small
    write_video(tmp_path / "a.mp4", [wide] * 3)
    config = TrackConfig(search=0.02)
    capture = make_photo_capture(open_picture(tmp_path / "a.mp4"), tmp_path / "out", "a", config)
    assert 0.04 < capture.search < 0.12


def test_a_video_is_tracked_in_every_frame(tmp_path: Path, astronaut: np.ndarray) -> None:
    """The photograph moves sideways a pixel per frame; so does the face."""
    images = [np.ascontiguousarray(astronaut[20:260, 90 - n : 350 - n]) for n in range(5)]
    write_video(tmp_path / "clip.mp4", images)
    settings = ["--preset", "draft", "--windows", "2"]
    command = ["photo", str(tmp_path / "clip.mp4"), str(tmp_path / "out"), "--focal-px", "700"]
    assert main([*command, *settings]) == 0
    with np.load(tmp_path / "out/track/clip/sequence.npz", allow_pickle=False) as sequence:
        assert sequence["frames"].tolist() == [0, 1, 2, 3, 4]
        parts = {
            name: torch.from_numpy(sequence[name]).float()
            for name in ("expression", "neck", "jaw", "eyes")
        }
        head, shape = load_head("procedural"), torch.from_numpy(sequence["shape"]).float()
        marks = landmarks(head, pose(head, shape.expand(5, -1), **parts)).numpy()[:, 17:]
        face = marks @ sequence["R"].transpose(0, 2, 1) + sequence["t"][:, None]
    # The origin lies in the neck: one view can hardly say whether that moves or the head turns.
    moved = (face[..., 0] / -face[..., 2] * 700).mean(1)
    np.testing.assert_allclose(np.diff(moved), 1.0, atol=0.6)
    assert moved[-1] - moved[0] == pytest.approx(4.0, abs=0.5)


def test_a_video_is_tracked_where_a_face_half_hidden_gets_no_matte(
    tmp_path: Path, astronaut: np.ndarray, monkeypatch, capsys
) -> None:
    shown = np.ascontiguousarray(astronaut[20:260, 90:350])
    hidden = shown.copy()
    hidden[140:] = 90
    write_video(tmp_path / "clip.mp4", [shown, hidden])
    monkeypatch.setattr("pipelines.matte.cutout.FACE_SCORE", 0.78)  # between the two scores
    command = ["photo", str(tmp_path / "clip.mp4"), str(tmp_path / "out"), "--matte"]
    assert main([*command, "--preset", "draft", "--windows", "2"]) == 0
    assert "failed clip/clip_01: StageError: clip/clip_01: no face" in "".join(capsys.readouterr())
    assert (tmp_path / "out/matte/clip/clip_00/photo.png").is_file()
    figures = json.loads((tmp_path / "out/matte/clip/clip_00/metrics.json").read_text())
    assert figures["unchanged"] == "it is the only camera"  # of which none can look elsewhere
    assert (tmp_path / "out/track/clip/sequence.npz").is_file()


@pytest.mark.parametrize(
    "setting",
    ["head=flame.pkl", "head=~nobody-here/x.pkl", "landmarks=points.npz", "landmarks=fan:x.pt"],
)
def test_a_missing_file_is_reported_with_the_setting_that_names_it(
    tracked: tuple[Path, dict], tmp_path: Path, setting: str, capsys: pytest.CaptureFixture
) -> None:
    shutil.copytree(tracked[0], tmp_path / "out")
    assert main(["track", str(tmp_path / "out"), "--set", f"track.{setting}"]) == 2
    name, value = setting.split("=")  # a head model's path is made absolute
    words = rf"track.{name} is (/.*/)?{value}: no such file"
    assert re.search(words, "".join(capsys.readouterr()))
    assert (tmp_path / "out/track/eva_1/track.npz").is_file()
