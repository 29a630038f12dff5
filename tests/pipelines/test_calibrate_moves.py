"""A camera that moved after calibration is found in the footage, named and measured."""

import json
import weakref
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from express50.cli.main import main
from express50.contract.layout import Dataset
from express50.errors import CalibrationError, CaptureError
from express50.files.calibration import write_cameras
from express50.files.images import write_image
from express50.geometry.cameras import Camera, project, rays
from express50.geometry.transforms import look_at
from pipelines.calibrate.adjuster import RigPriors, adjust_rig, move_pose, triangulate_tracks
from pipelines.calibrate.camera_moves import check_footage
from pipelines.calibrate.footage import read_capture_frames, reduce_image, reduced_camera
from pipelines.calibrate.tracks import (
    PointTracks,
    epipolar_distance,
    find_features,
    find_points,
    without_fixed,
)

TURN, SHIFT = np.radians(0.3), 5e-3


def make_rig(count=7, size=320):
    rig = {}
    for i in range(count):
        angle = np.radians(18) * (i - (count - 1) / 2)
        eye = [np.sin(angle), 0.15 * (-1) ** i, np.cos(angle)]
        params = (2.3 * size, 2.3 * size, size / 2 + i, size / 2 - i, -0.1, 0.1, 1e-3, -1e-3)
        pose = look_at(np.array(eye), np.zeros(3), np.array([0.0, 1.0, 0.0]))
        rig[f"cam{i:02d}"] = Camera(f"cam{i:02d}", size, size, "OPENCV", params, pose)
    return rig


def picture(camera):
    """A ball of 12 cm with a spotted skin, noise included."""
    rng = np.random.default_rng(0)
    volume = rng.uniform(0, 1, (40, 40, 40))
    origin, directions = rays(camera)
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    b = d @ origin
    root = b**2 - (origin @ origin - 0.12**2)
    hit = origin + (-b - np.sqrt(np.maximum(root, 0)))[..., None] * d
    tone = sum(
        map_coordinates(volume, np.moveaxis(hit * scale + 20, -1, 0), order=1, mode="wrap") / k
        for k, scale in ((1, 90.0), (2, 230.0))
    )
    image = np.where(root > 0, 170 * tone, 90) + rng.normal(size=tone.shape) * 2
    return np.repeat(np.clip(image, 0, 255)[..., None], 3, axis=2).astype(np.uint8)


@pytest.fixture(scope="module")
def footage():
    rig = make_rig()
    return rig, {0: {name: picture(camera) for name, camera in rig.items()}}


def bumped(rig, name, turn=(0, 0, 0), shift=(0, 0, 0)):
    step = np.concatenate([turn, shift]).astype(float)
    return {
        **rig,
        name: replace(rig[name], cam_from_world=move_pose(rig[name].cam_from_world, step)),
    }


def test_a_rig_that_fits_is_quiet(footage):
    rig, frames = footage
    verdict = check_footage(rig, frames, None)
    assert verdict.moved == {} and verdict.unchecked == {}
    assert verdict.points > 150 and verdict.error_px < 0.5
    for name, camera in rig.items():
        np.testing.assert_array_equal(verdict.cameras[name].cam_from_world, camera.cam_from_world)


@pytest.mark.parametrize(
    ("name", "turn", "shift"),
    [
        ("cam03", (0, TURN, 0), (0, 0, 0)),
        ("cam01", (TURN, 0, 0), (0, 0, 0)),
        ("cam05", (0, 0, 0), (SHIFT, 0, 0)),
        ("cam04", (0, np.radians(2.0), 0), (0, 0, 0)),
    ],
)
def test_a_bump_is_named_and_put_right(footage, name, turn, shift):
    rig, frames = footage
    wrong = bumped(rig, name, turn, shift)
    verdict = check_footage(wrong, frames, None)
    assert list(verdict.moved) == [name]
    towards = rig[name].center / np.linalg.norm(rig[name].center)
    points = towards + np.random.default_rng(1).normal(size=(200, 3)) * 0.3
    points *= 0.12 / np.linalg.norm(points, axis=1, keepdims=True)  # what it sees of the ball
    true, before, after = (project(r[name], points)[0] for r in (rig, wrong, verdict.cameras))
    off = float(np.median(np.linalg.norm(before - true, axis=1)))
    assert verdict.moved[name].shift_px == pytest.approx(off, rel=0.3)
    assert np.median(np.linalg.norm(after - true, axis=1)) < 0.5 * off


def test_two_bumped_cameras_are_both_named(footage):
    rig, frames = footage
    wrong = bumped(bumped(rig, "cam01", (TURN, 0, 0)), "cam05", (0, -2 * TURN, 0))
    assert set(check_footage(wrong, frames, None).moved) == {"cam01", "cam05"}


def test_a_camera_without_common_points_is_said_to_be_unchecked(footage):
    rig, frames = footage
    blind = {0: {**frames[0], "cam02": np.full_like(frames[0]["cam02"], 128)}}
    verdict = check_footage(rig, blind, None)
    assert list(verdict.unchecked) == ["cam02"] and "shares 0 points" in verdict.unchecked["cam02"]
    assert verdict.moved == {}


def test_two_cameras_and_wrong_sizes_are_refused(footage):
    rig, frames = footage
    two = {name: rig[name] for name in ("cam00", "cam01")}
    with pytest.raises(CalibrationError, match="three or more"):
        check_footage(two, frames, None)
    with pytest.raises(CalibrationError, match="cam00: frame 0 is 10x10, the camera is 320x320"):
        check_footage(rig, {0: {**frames[0], "cam00": np.zeros((10, 10, 3), np.uint8)}}, None)


def test_large_images_are_reduced_with_their_camera():
    camera = replace(make_rig(1)["cam00"], width=2560, height=1920)
    image = reduce_image(camera, np.zeros((1920, 2560, 3), np.uint8), "frame 3")
    assert image.shape == (960, 1280, 3)
    np.testing.assert_allclose(reduced_camera(camera).K[:2], 0.5 * camera.K[:2])


def test_reduced_images_pass_again_and_the_full_ones_are_let_go(footage, tmp_path, monkeypatch):
    rig, frames = footage
    monkeypatch.setattr("pipelines.calibrate.footage.LONG_SIDE", 160)
    write_capture(tmp_path / "capture", rig, frames[0])
    alive = []

    def reduce(name, image):
        alive[:] = [ref for ref in alive if ref() is not None]
        assert len(alive) <= 1  # the image read before this one at most
        alive.append(weakref.ref(image))
        return reduce_image(rig[name], image, "frame 0")

    found = read_capture_frames(tmp_path / "capture", 1, reduce)
    assert {image.shape for image in found[0].values()} == {(160, 160, 3)}
    assert all(reduce_image(rig[n], found[0][n], "frame 0") is found[0][n] for n in rig)


def test_noise_fixed_to_the_pixels_of_all_sensors_does_not_accuse(footage):
    rig, frames = footage
    noise = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(320, 320, 1)) * 90, (0, 0), 1.5)
    same = {n: np.clip(i + noise[..., None], 0, 255).astype(np.uint8) for n, i in frames[0].items()}
    verdict = check_footage(rig, {0: same}, None)
    assert verdict.moved == {}
    blank = {n: np.clip(128 + noise[..., None], 0, 255).repeat(3, 2).astype(np.uint8) for n in rig}
    left = without_fixed({name: find_features(image) for name, image in blank.items()})
    assert sum(len(pixels) for pixels, _ in left.values()) == 0
    scene = {name: find_features(image) for name, image in frames[0].items()}
    kept = without_fixed(scene)
    for name in rig:
        assert len(kept[name][0]) > 0.95 * len(scene[name][0])


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


def test_no_network_means_no_landmarks_and_blank_images_no_features(footage):
    rig, frames = footage
    seen = find_points({"cam00": np.zeros((320, 320, 3), np.uint8)}, None)
    assert seen.landmarks == [] and seen.features["cam00"][0].shape == (0, 2)


def write_capture(root, rig, images):
    root.mkdir()
    (root / "capture.toml").write_text('subject = "S001"\nfps = 24\n')
    for name in rig:
        (root / "cameras" / name / "frames").mkdir(parents=True)
        write_image(root / "cameras" / name / "frames" / "000000.png", images[name])


def test_the_command_names_the_camera(footage, tmp_path, capsys):
    rig, frames = footage
    write_capture(tmp_path / "capture", rig, frames[0])
    write_cameras(tmp_path / "c.json", rig)
    command = ["cameras", "check", str(tmp_path / "c.json"), "--footage", str(tmp_path / "capture")]
    assert main(command) == 0
    assert "moved" not in capsys.readouterr().out
    write_cameras(tmp_path / "c.json", bumped(rig, "cam03", (0, TURN, 0)))
    assert main([*command, "--json"]) == 1
    told = json.loads(capsys.readouterr().out)["footage"]
    assert list(told["moved"]) == ["cam03"] and told["moved"]["cam03"]["shift_px"] > 2


def test_moments_follow_the_cues_and_a_short_camera_is_named(footage, tmp_path):
    rig, frames = footage
    write_capture(tmp_path / "capture", rig, frames[0])
    assert list(read_capture_frames(tmp_path / "capture", 3, lambda name, image: image)) == [0]
    cues = "expression_id,start_frame,end_frame\nneutral,0,0\nsmile,2,4\n"
    (tmp_path / "capture" / "cues.csv").write_text(cues)
    with pytest.raises(CaptureError, match="has 1 frames, frame 3 was expected"):
        read_capture_frames(tmp_path / "capture", 2, lambda name, image: image)


def test_calibrate_warns_of_the_camera_and_goes_on(footage, tmp_path, capsys):
    rig, frames = footage
    write_capture(tmp_path / "capture", rig, frames[0])
    write_cameras(tmp_path / "capture" / "calibration.json", bumped(rig, "cam03", (0, TURN, 0)))
    dataset = Dataset(tmp_path / "dataset")
    assert main(["ingest", str(dataset.root), str(tmp_path / "capture"), "--workers", "0"]) == 0
    assert main(["calibrate", str(dataset.root), "--workers", "0"]) == 0
    path = dataset.item_dir("calibrate", "S001") / "metrics.json"
    told = json.loads(path.read_text())
    assert [row["what"] for row in told["warnings"]] == ["cam03"]
    assert "px" in told["warnings"][0]["why"] and told["footage"]["points"] > 20
    quiet = ["--workers", "0", "--set", "calibrate.check_moments=0"]
    assert main(["calibrate", str(dataset.root), *quiet]) == 0
    assert json.loads(path.read_text())["footage"] is None
