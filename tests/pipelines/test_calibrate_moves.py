"""A camera that moved after calibration is found in the footage, named and measured."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from express50.__main__ import main
from express50.contract.layout import Dataset
from express50.errors import CalibrationError, CaptureError
from express50.files.calibration import write_cameras
from express50.files.containers import read_picture
from express50.files.images import write_image
from express50.geometry.cameras import Camera, project, rays
from express50.geometry.transforms import look_at
from express50.landmarks.detector import Detection
from pipelines.calibrate.adjuster import RigPriors, adjust_rig, move_pose, triangulate_tracks
from pipelines.calibrate.footage import (
    find_features,
    find_points,
    read_raw_footage,
    reduced_camera,
    without_fixed,
)
from pipelines.calibrate.given_rig import check_footage
from pipelines.calibrate.tracks import (
    FrameSetPoints,
    PointTracks,
    epipolar_distance,
    mirror_features,
    mirrored_cameras,
)
from tests.balls import meet_ball
from tests.pipelines.face_rigs import face_cameras, see
from tests.synth import noise_video_images, turn_video, write_frames, write_video

pytestmark = pytest.mark.usefixtures("no_faces")
TURN, SHIFT = np.radians(0.3), 5e-3


def make_rig(count=7, size=320):
    rig = {}
    for i in range(count):
        angle = np.radians(18) * (i - (count - 1) / 2)
        eye = [np.sin(angle), 0.15 * (-1) ** i, np.cos(angle)]
        params = (2.3 * size, 2.3 * size, size / 2 + i, size / 2 - i, -0.1, 0.1, 1e-3, -1e-3)
        pose = look_at(np.array(eye), np.zeros(3))
        rig[f"cam{i:02d}"] = Camera(f"cam{i:02d}", size, size, "OPENCV", params, pose)
    return rig


def picture(camera):
    """A ball of 12 cm with a spotted skin, noise included."""
    rng = np.random.default_rng(0)
    volume = rng.uniform(0, 1, (40, 40, 40))
    origin, directions = rays(camera)
    depth, through = meet_ball(origin, directions, 0.12)
    hit = origin + depth[..., None] * directions
    tone = sum(
        map_coordinates(volume, np.moveaxis(hit * scale + 20, -1, 0), order=1, mode="wrap") / k
        for k, scale in ((1, 90.0), (2, 230.0))
    )
    image = np.where(through > 0, 170 * tone, 90) + rng.normal(size=tone.shape) * 2
    return np.repeat(np.clip(image, 0, 255)[..., None], 3, axis=2).astype(np.uint8)


@pytest.fixture(scope="module")
def footage():
    rig = make_rig()
    return rig, {name: picture(camera) for name, camera in rig.items()}


def features_of(images):
    features = {name: find_features(image) for name, image in images.items()}
    return {0: FrameSetPoints([], without_fixed(features))}


@pytest.fixture(scope="module")
def seen(footage):
    return features_of(footage[1])


def bumped(rig, name, turn=(0, 0, 0), shift=(0, 0, 0)):
    step = np.concatenate([turn, shift]).astype(float)
    return {
        **rig,
        name: replace(rig[name], cam_from_world=move_pose(rig[name].cam_from_world, step)),
    }


def test_a_rig_that_fits_is_quiet(footage, seen):
    rig, _ = footage
    verdict = check_footage(rig, seen)
    assert verdict.moved == {} and verdict.unchecked == {}
    assert verdict.points > 150 and verdict.error_px < 0.5
    for name, camera in rig.items():
        np.testing.assert_array_equal(verdict.cameras[name].cam_from_world, camera.cam_from_world)


@pytest.mark.parametrize(
    ("name", "turn", "shift"),
    [
        ("cam03", (0, TURN, 0), (0, 0, 0)),
        ("cam05", (0, 0, 0), (SHIFT, 0, 0)),
        ("cam04", (0, np.radians(2.0), 0), (0, 0, 0)),
    ],
)
def test_a_bump_is_named_and_put_right(footage, seen, name, turn, shift):
    rig, _ = footage
    wrong = bumped(rig, name, turn, shift)
    verdict = check_footage(wrong, seen)
    assert list(verdict.moved) == [name]
    towards = rig[name].center / np.linalg.norm(rig[name].center)
    points = towards + np.random.default_rng(1).normal(size=(200, 3)) * 0.3
    points *= 0.12 / np.linalg.norm(points, axis=1, keepdims=True)  # what it sees of the ball
    true, before, after = (project(r[name], points)[0] for r in (rig, wrong, verdict.cameras))
    off = float(np.median(np.linalg.norm(before - true, axis=1)))
    assert verdict.moved[name].shift_px == pytest.approx(off, rel=0.3)
    assert np.median(np.linalg.norm(after - true, axis=1)) < 0.5 * off


def test_two_bumped_cameras_are_both_named(footage, seen):
    rig, _ = footage
    wrong = bumped(bumped(rig, "cam01", (TURN, 0, 0)), "cam05", (0, -2 * TURN, 0))
    assert set(check_footage(wrong, seen).moved) == {"cam01", "cam05"}


def test_no_camera_is_named_where_any_other_may_have_moved_instead():
    """The outer ones of three cameras are off by as much, upwards and downwards."""
    rig = make_rig(3)
    points = np.random.default_rng(0).normal(size=(68, 3))
    points *= 0.09 / np.linalg.norm(points, axis=1, keepdims=True)
    views = [
        (name, project(camera, points)[0] + (0, up), np.full(68, 0.5))
        for (name, camera), up in zip(rig.items(), (-1, 0, 1), strict=True)
    ]
    assert check_footage(rig, {0: FrameSetPoints(views, {})}).moved == {}


def test_a_camera_without_common_points_is_reported_as_unchecked(footage):
    rig, images = footage
    blind = images | {"cam02": np.full_like(images["cam02"], 128)}
    verdict = check_footage(rig, features_of(blind))
    assert list(verdict.unchecked) == ["cam02"] and "shares 0 points" in verdict.unchecked["cam02"]
    assert verdict.moved == {}


def test_two_cameras_and_wrong_sizes_are_refused(footage, seen, tmp_path):
    rig, images = footage
    two = {name: rig[name] for name in ("cam00", "cam01")}
    with pytest.raises(CalibrationError, match="three or more"):
        check_footage(two, seen)
    small = images | {"cam00": np.zeros((10, 10, 3), np.uint8)}
    write_capture(tmp_path / "capture", rig, small)
    with pytest.raises(CalibrationError, match="cam00: frame 0 is 10x10, the camera is 320x320"):
        list(read_raw_footage(tmp_path / "capture", rig, 1))


def test_large_images_are_reduced_with_their_camera_one_by_one(footage, tmp_path, monkeypatch):
    camera = replace(make_rig(1)["cam00"], width=2560, height=1920)
    np.testing.assert_allclose(reduced_camera(camera).K[:2], 0.5 * camera.K[:2])
    rig, images = footage
    monkeypatch.setattr("pipelines.calibrate.footage.LONG_SIDE", 160)
    write_capture(tmp_path / "capture", rig, images)
    read = []

    def reading(*args):
        read.append(args)
        return read_picture(*args)

    monkeypatch.setattr("pipelines.calibrate.footage.read_picture", reading)
    for number, (frame, _, image) in enumerate(read_raw_footage(tmp_path / "capture", rig, 1), 1):
        assert frame == 0 and image.shape == (160, 160, 3)
        assert len(read) == number  # the next image is not read before this one is used


def test_noise_fixed_to_the_pixels_of_all_sensors_does_not_accuse(footage):
    rig, images = footage
    noise = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(320, 320, 1)) * 90, (0, 0), 1.5)
    same = {n: np.clip(i + noise[..., None], 0, 255).astype(np.uint8) for n, i in images.items()}
    verdict = check_footage(rig, features_of(same))
    assert verdict.moved == {}
    blank = {n: np.clip(128 + noise[..., None], 0, 255).repeat(3, 2).astype(np.uint8) for n in rig}
    left = without_fixed({name: find_features(image) for name, image in blank.items()})
    assert sum(len(pixels) for pixels, _ in left.values()) == 0
    scene = {name: find_features(image) for name, image in images.items()}
    kept = without_fixed(scene)
    for name in rig:
        assert len(kept[name][0]) > 0.9 * len(scene[name][0])


def test_an_epipolar_line_goes_through_every_depth():
    a, b = (make_rig()[n] for n in ("cam01", "cam03"))
    a, b = (replace(c, model="PINHOLE", params=c.params[:4]) for c in (a, b))
    origin, direction = a.center, a.cam_from_world[2, :3] + [0.05, -0.03, 0.0]
    points = origin + np.array([[0.7], [0.9], [1.3]]) * direction
    off = epipolar_distance(a, b, project(a, points[:1])[0], project(b, points)[0])
    assert off.max() < 1e-6


def test_freed_poses_return_to_the_truth():
    rig = {n: replace(c, model="PINHOLE", params=c.params[:4]) for n, c in make_rig().items()}
    points = np.random.default_rng(2).uniform(-0.1, 0.1, (80, 3))
    pixels = np.concatenate([project(camera, points)[0] for camera in rig.values()])
    camera, point = np.divmod(np.arange(len(pixels)), len(points))
    tracks = PointTracks(tuple(rig), camera, point, pixels, np.full(len(pixels), 0.01))
    assert np.abs(triangulate_tracks(rig, tracks) - points).max() < 1e-8
    wrong = bumped(rig, "cam02", (TURN, -TURN, TURN), (SHIFT, SHIFT, -SHIFT))
    priors = RigPriors(turn_rad=np.radians(1.0), move_m=0.01)
    points_then = triangulate_tracks(wrong, tracks)
    fit = adjust_rig(wrong, tracks, points_then, priors, (6.0, 1.5), free=("cam02",))
    pose = fit.cameras["cam02"].cam_from_world
    assert np.abs(pose - rig["cam02"].cam_from_world).max() < 1e-4
    held = [n for n in rig if n != "cam02"]
    assert all((fit.cameras[n].cam_from_world == wrong[n].cam_from_world).all() for n in held)
    assert np.abs(fit.points - points).max() < 1e-4


def test_blank_images_have_no_landmarks_and_no_features():
    found = find_points(lambda: [(3, "cam00", np.zeros((320, 320, 3), np.uint8))])
    assert found[3].landmarks == [] and found[3].features["cam00"][0].shape == (0, 2)


@pytest.mark.parametrize(("scores", "again"), [((0.9, 0.1, 0.1), True), ((0.9, 0.8, 0.1), False)])
def test_small_faces_are_searched_for_only_if_a_second_one_is_missing(monkeypatch, scores, again):
    """Scores are of three cameras in windows of the usual size; smaller ones show every face."""
    tried = []

    def find(net, image, smallest=0.25):
        camera = int(image[0, 0, 0])
        tried.append((camera, smallest))
        score = scores[camera] if smallest == 0.25 else 0.7
        return Detection(np.ones((68, 2)), np.ones(68), np.ones(68), score)

    monkeypatch.setattr("express50.landmarks.detector.detect", find)
    blank = [(0, f"cam{k}", np.full((32, 32, 3), k, np.uint8)) for k in range(3)]
    found = find_points(lambda: blank, small=True)[0].landmarks
    assert [name for name, _, _ in found] == [f"cam{k}" for k in range(3)][: 3 if again else 2]
    assert tried[3:] == ([(1, 0.08), (2, 0.08)] if again else [])


@pytest.mark.parametrize("deep", [0.0, 0.2])
def test_the_back_of_a_board_is_not_a_mirrored_camera(deep):
    """A board printed on both sides shows its mirror image to the camera behind it."""
    rng, rig = np.random.default_rng(5), make_rig(2)
    points = rng.uniform(-0.08, 0.08, (300, 3)) * [1, 1, deep / 0.08]
    described = np.sqrt(rng.dirichlet(np.ones(128), 300)).astype(np.float32)
    front, back = ((project(camera, points)[0], described) for camera in rig.values())
    seen = {0: FrameSetPoints([], {"cam00": front, "cam01": mirror_features(back, 320)})}
    found = mirrored_cameras(seen, dict.fromkeys(rig, 320), [("cam00", "cam01")])
    assert set(found) == (set(rig) if deep else set())


def write_capture(root, rig, images):
    root.mkdir()
    (root / "capture.toml").write_text('subject = "S001"\nfps = 24\n')
    for name in rig:
        (root / "cameras" / name / "frames").mkdir(parents=True)
        write_image(root / "cameras" / name / "frames" / "000000.png", images[name])


def test_the_command_names_the_camera(footage, tmp_path, capsys):
    rig, images = footage
    write_capture(tmp_path / "capture", rig, images)
    write_cameras(tmp_path / "c.json", rig)
    command = ["cameras", "check", str(tmp_path / "c.json"), "--footage", str(tmp_path / "capture")]
    assert main(command) == 0
    said = capsys.readouterr()
    assert (
        "moved" not in said.out and f"capture: looking for points in {len(rig)} cameras" in said.err
    )
    write_cameras(tmp_path / "c.json", bumped(rig, "cam03", (0, TURN, 0)))
    assert main([*command, "--json"]) == 1
    checked = json.loads(capsys.readouterr().out)["footage"]
    assert list(checked["moved"]) == ["cam03"] and checked["moved"]["cam03"]["shift_px"] > 2


def test_frame_sets_follow_the_cues_and_a_short_camera_is_named(footage, tmp_path):
    rig, images = footage
    write_capture(tmp_path / "capture", rig, images)
    assert {frame for frame, _, _ in read_raw_footage(tmp_path / "capture", rig, 3)} == {0}
    cues = "expression_id,start_frame,end_frame\nneutral,0,0\nsmile,2,4\n"
    (tmp_path / "capture" / "cues.csv").write_text(cues)
    with pytest.raises(CaptureError, match="has 1 frames, expected a frame 3"):
        list(read_raw_footage(tmp_path / "capture", rig, 2))


def test_footage_of_other_layouts_is_read(tmp_path):
    """Pictures and turned videos of a rig in folders, as `ingest` reads them."""
    rig = make_rig(2, 64)
    (tmp_path / "videos").mkdir()
    for name in rig:
        write_frames(tmp_path / "pictures" / name, noise_video_images(3))
        write_video(tmp_path / "videos" / f"{name}.mp4", noise_video_images(3))
        turn_video(tmp_path / "videos" / f"{name}.mp4")
    for layout in ("pictures", "videos"):
        (tmp_path / layout / "cues.csv").write_text(
            "expression_id,start_frame,end_frame\nsmile,1,1"
        )
        seen = list(read_raw_footage(tmp_path / layout, rig, 1))
        assert [(frame, name) for frame, name, _ in seen] == [(1, name) for name in rig]
        expected = noise_video_images(3)[1]
        turned = expected if layout == "pictures" else np.rot90(expected, -1)
        assert np.abs(seen[0][2].astype(int) - turned).mean() < 10


def test_calibrate_warns_of_the_camera_and_continues(footage, tmp_path, capsys):
    rig, images = footage
    write_capture(tmp_path / "capture", rig, images)
    write_cameras(tmp_path / "capture" / "calibration.json", bumped(rig, "cam03", (0, TURN, 0)))
    dataset = Dataset(tmp_path / "dataset")
    assert main(["ingest", str(dataset.root), str(tmp_path / "capture"), "--workers", "0"]) == 0
    assert main(["calibrate", str(dataset.root), "--workers", "0"]) == 0
    path = dataset.item_dir("calibrate", "S001") / "metrics.json"
    metrics = json.loads(path.read_text())
    assert [row["what"] for row in metrics["warnings"]] == ["cam03"]
    assert "px" in metrics["warnings"][0]["why"] and metrics["footage"]["points"] > 20
    quiet = ["--workers", "0", "--set", "calibrate.check_frame_sets=0"]
    assert main(["calibrate", str(dataset.root), *quiet]) == 0
    assert json.loads(path.read_text())["footage"] is None


@pytest.fixture(scope="module")
def faces():
    rig = face_cameras()
    return rig, see(rig, features=60, landmark_px=0.2)


def test_faces_find_nothing_odd_about_a_true_rig(faces):
    verdict = check_footage(*faces)
    assert verdict.exchanged == () and verdict.size == "" and verdict.moved == {}


@pytest.mark.parametrize(("count", "features", "at"), [(6, 0, (590, 180)), (4, 60, (40, 180))])
def test_a_face_of_another_person_says_nothing_about_the_other_cameras(count, features, at):
    """The outermost camera sees somebody in front of the wall more clearly than the subject."""
    rig = face_cameras(count)
    odd = {}
    for frame, points in see(rig, features=features, landmark_px=0.2).items():
        *views, (last, pixels, sigma) = points.landmarks
        views.append((last, 0.6 * (pixels - pixels.mean(0)) + at, sigma))
        odd[frame] = replace(points, landmarks=views)
    verdict = check_footage(rig, odd)
    assert verdict.exchanged == () and verdict.size == ""
    assert all(name == last and move.odd_face for name, move in verdict.moved.items())


@pytest.mark.parametrize(
    "pairs",
    [(("cam01", "cam04"),), (("cam02", "cam03"),), (("cam00", "cam02"), ("cam03", "cam05"))],
)
def test_exchanged_cameras_are_both_named(faces, pairs):
    rig, seen = faces
    wrong = dict(rig)
    for a, b in pairs:
        wrong |= {a: replace(rig[b], id=a), b: replace(rig[a], id=b)}
    verdict = check_footage(wrong, seen)
    assert sorted(verdict.exchanged) == sorted(pairs) and verdict.moved == {}


@pytest.mark.parametrize(
    ("focal", "scale", "words"),
    [
        (2.0, 1.0, "probably the focal lengths are 2 times too long"),
        (0.5, 1.0, "times too short: give focal lengths in pixels"),
        (1.0, 1000.0, "probably the rig's lengths are 1000 times too long"),
    ],
)
def test_a_face_shows_that_focal_lengths_or_units_are_wrong(faces, focal, scale, words):
    rig, seen = faces
    wrong = {}
    for name, camera in rig.items():
        pose = camera.cam_from_world.copy()
        pose[:3, 3] *= scale
        params = (camera.params[0] * focal, *camera.params[1:])
        wrong[name] = replace(camera, params=params, cam_from_world=pose)
    verdict = check_footage(wrong, seen)
    assert words in verdict.size and verdict.moved == {} and verdict.exchanged == ()
