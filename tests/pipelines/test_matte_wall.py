"""The wall behind a person who moves, learned from several moments."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.common import recorded, write_peaks
from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.errors import CaptureError
from express50.files.images import read_alpha, write_image
from express50.geometry.cameras import pinhole, pinhole_camera
from express50.twin import TwinConfig
from express50.twin.record import record
from pipelines import calibrate, frames
from pipelines.matte import STAGE as MATTE
from pipelines.matte.cutout import Cut, make_cut_view
from pipelines.matte.wall import (
    LEAST_SIDE,
    UNSEEN,
    Wall,
    learn_wall,
    read_wall,
    reduced_view,
    soft_alpha,
    valid_pixels,
)
from tests.stages import run_here

SIDE, RADIUS, DENSITY = 160, 40, 400.0  # pixels, and per metre of the head
VALID = np.ones((SIDE, SIDE), bool)
MOVED = (0, 3, -3, 6, -6)  # pixels of the person, by moment


def textured_wall() -> np.ndarray:
    rng = np.random.default_rng(5)
    return cv2.resize(rng.uniform(40, 220, (40, 40, 3)), (SIDE, SIDE))


def disc(shift: int, radius: float = RADIUS) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE]
    return np.hypot(x - SIDE / 2 - shift, y - SIDE / 2) < radius


def moments(moved=MOVED, gain: float = 1.0) -> tuple[list[np.ndarray], list[Cut], np.ndarray]:
    """Frames of a grainy disc that moves before a wall, its rough cuts, and the wall."""
    rng, wall = np.random.default_rng(6), textured_wall()
    skin = rng.normal((150, 110, 90), 12, (SIDE, SIDE, 3))
    shown, cuts = [], []
    for k, shift in enumerate(moved):
        person = cv2.GaussianBlur(disc(shift).astype(np.float64), (0, 0), 1.0)[..., None]
        image = person * np.roll(skin, shift, axis=1) + (1 - person) * wall
        light = gain**k * image + rng.normal(0, 1, image.shape)
        shown.append(np.rint(np.clip(light, 0, 255)).astype(np.uint8))
        cuts.append(Cut(disc(shift), DENSITY))
    return shown, cuts, wall


def test_the_wall_is_known_where_a_moment_shows_it() -> None:
    shown, cuts, wall = moments()
    learned = learn_wall(shown, cuts, VALID)
    ever = ~np.all([disc(shift, RADIUS + 3) for shift in MOVED], axis=0)
    assert (learned.error[disc(0, RADIUS - 12)] == UNSEEN).all()
    off = np.abs(learned.colour.astype(float) - wall).max(-1)
    stated = learned.error.astype(float)
    assert np.median(off[ever]) < 1.5
    assert (off < 3 * stated)[learned.error < UNSEEN].mean() > 0.97


def test_a_still_shirt_that_cuts_left_out_is_not_taken_for_the_wall() -> None:
    shown, cuts, _ = moments()
    shirt = np.zeros_like(VALID)
    shirt[130:] = True
    for image in shown:
        image[shirt] = (90, 80, 120)
    assert (learn_wall(shown, cuts, VALID).error[140:] < 4).all(), "nothing says that it is a shirt"
    body = np.zeros_like(VALID)
    body[120:] = True
    known = learn_wall(shown, [replace(cut, body=body) for cut in cuts], VALID)
    assert (known.error[140:] == UNSEEN).all()
    assert (known.error[10:30] < 4).all()


def test_only_views_with_small_pixels_are_reduced_before_the_wall_is_sought() -> None:
    camera = pinhole_camera("a", np.diag([400.0, 400.0, 1.0]), SIDE, SIDE, np.eye(4))
    view = make_cut_view(camera, np.zeros((SIDE, SIDE, 3), np.uint8), VALID)
    for density, side in ((200.0, SIDE), (500.0, round(SIDE / 1.5)), (1e9, LEAST_SIDE)):
        small = reduced_view(view, density)
        assert small.valid.shape == small.rgb.shape[:2] == (side, side)
        assert small.valid.all() and small.camera.width == side


def test_opacity_before_a_known_wall_is_closer() -> None:
    shown, cuts, _ = moments()
    true = cv2.GaussianBlur(disc(0).astype(np.float64), (0, 0), 1.0)
    cut = Cut(disc(0, RADIUS + 1.5), DENSITY)
    learned = learn_wall(shown, cuts, VALID)
    alone, helped = (
        np.abs(soft_alpha(shown[0], VALID, cut, wall) - true).mean() for wall in (None, learned)
    )
    assert helped < 0.8 * alone


def test_a_wall_of_another_room_does_not_fit() -> None:
    shown, cuts, _ = moments()
    learned = learn_wall(shown, cuts, VALID)
    assert learned.fits(shown[2], VALID)
    assert not learned.fits(np.ascontiguousarray(shown[2][::-1, ::-1]), VALID)


def test_a_wall_fits_where_the_body_leaves_at_the_top() -> None:
    shown, cuts, _ = moments()
    learned, frame = learn_wall(shown, cuts, VALID), shown[2].copy()
    frame[:30, 20:140] = 90
    assert learned.fits(frame, VALID)


@pytest.mark.parametrize("kind", ["another room", "never seen", "one colour"])
def test_a_wall_that_says_nothing_does_no_harm(kind: str) -> None:
    shown, cuts, _ = moments()
    wall = {
        "another room": Wall(shown[0][::-1, ::-1].copy(), np.full(VALID.shape, 2, np.uint8)),
        "never seen": Wall(np.zeros_like(shown[0]), np.full(VALID.shape, UNSEEN, np.uint8)),
        "one colour": Wall(np.full_like(shown[0], 128), np.full(VALID.shape, 2, np.uint8)),
    }[kind]
    true = cv2.GaussianBlur(disc(0).astype(np.float64), (0, 0), 1.0)
    cut = Cut(disc(0), DENSITY)
    alone, with_it = (soft_alpha(shown[0], VALID, cut, w) for w in (None, wall))
    assert np.isfinite(with_it).all()
    assert np.abs(with_it - true).mean() < 1.25 * np.abs(alone - true).mean()


def test_moments_of_other_exposure_are_evened() -> None:
    shown, cuts, wall = moments(gain=0.97)
    learned = learn_wall(shown, cuts, VALID)
    off = np.abs(learned.colour.astype(float) - wall).max(-1)
    assert np.median(off[learned.error < UNSEEN]) < 3


def test_a_wall_survives_its_file(tmp_path) -> None:
    dataset, rng = Dataset(tmp_path), np.random.default_rng(0)
    path = dataset.wall_file("S001", "cam01")
    assert read_wall(dataset, "S001", "cam01") is None
    error = rng.integers(0, 256, (9, 7), np.uint8)
    wall = Wall(rng.integers(0, 256, (9, 7, 3), np.uint8), error)
    path.parent.mkdir(parents=True)
    write_image(path, wall.picture())
    found = read_wall(dataset, "S001", "cam01")
    assert found is not None
    np.testing.assert_array_equal(found.colour, wall.colour)
    np.testing.assert_array_equal(found.error, wall.error)
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(CaptureError, match=r"wall\.png: truncated or damaged; delete its folder"):
        read_wall(dataset, "S001", "cam01")


def test_footage_without_plates_shows_its_wall(tmp_path) -> None:
    """A made-up person: the mattes gain, and a changed label does not change the wall."""
    twin = TwinConfig(
        subjects=1, first_subject=61, cameras=3, width=192, height=192, plates=False,
        expressions=("neutral", "smile", "jaw_open"), frames_per_expression=4,
        footage="jpg", board_frames=0, give_calibration=True,
    )  # fmt: skip
    record(twin, tmp_path, workers=1)
    dataset, truth = recorded(twin, tmp_path)
    subject = dataset.subjects()[0]
    assert run_here(calibrate.STAGE, dataset).ok
    write_peaks(dataset, subject, {"neutral": 1})
    assert run_here(frames.STAGE, dataset).ok
    cameras = read_cameras_of(dataset, subject, undistorted=False)
    assert all(dataset.wall_file(subject, name).is_file() for name in cameras)

    def error() -> float:
        assert run_here(MATTE, dataset).ok
        return float(np.mean([
            np.abs(
                read_alpha(dataset.matte_file(subject, "neutral", name)) / 255
                - truth.render_alpha(subject, 1, pinhole(camera)) * valid_pixels(camera)
            ).mean()
            for name, camera in cameras.items()
        ]))  # fmt: skip

    helped = error()
    kept = {name: dataset.wall_file(subject, name).read_bytes() for name in cameras}
    write_peaks(dataset, subject, {"neutral": 0})
    assert run_here(frames.STAGE, dataset).ok
    assert kept == {name: dataset.wall_file(subject, name).read_bytes() for name in cameras}
    write_peaks(dataset, subject, {"neutral": 1})
    assert run_here(frames.STAGE, dataset).ok
    for name in cameras:
        dataset.wall_file(subject, name).unlink()
    assert helped < error()
