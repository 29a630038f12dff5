"""Colour gains of cameras, from what they make of the board's white squares."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from express50.capture.frames import read_gains
from express50.contract.layout import Dataset
from express50.errors import FormatError
from express50.files.atomic import write_json
from express50.files.images import write_image
from express50.geometry.cameras import pinhole_camera
from express50.geometry.pixels import scale_light, srgb_to_linear
from express50.geometry.transforms import make_transform
from pipelines.calibrate import STAGE as CALIBRATE
from pipelines.calibrate.board import detect_corners, make_detector
from pipelines.calibrate.colour_gains import WhiteCollector, fit_gains, white_light, white_squares
from tests.pipelines.board_rigs import BOARD, render_board
from tests.stages import ingest_captures, metrics_of, run_here
from tests.synth import make_capture

FACING = make_transform(np.eye(3), np.array([-0.14, -0.1, 0.55]))


def patches(gain: np.ndarray, count: int = 200, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Light (count, C, 3) of patches of various brightness, each seen by most cameras."""
    rng = np.random.default_rng(seed)
    level = rng.uniform(0.2, 0.8, (count, 1, 3))
    light = level * gain * np.exp(noise * rng.normal(size=(count, len(gain), 3)))
    light[rng.uniform(size=light.shape[:2]) < 0.3] = np.nan
    return light


def centred(gain: np.ndarray) -> np.ndarray:
    """Gains with a geometric mean of 1."""
    return gain / np.exp(np.log(gain).mean(0))


@settings(deadline=None, max_examples=25)
@given(
    gain=st.lists(st.tuples(*[st.floats(0.2, 5.0)] * 3), min_size=2, max_size=6),
    seed=st.integers(0, 99),
)
def test_any_gains_are_found_whatever_the_patches(gain, seed):
    true = np.array(gain)
    found, _, after = fit_gains(patches(true, seed=seed))
    np.testing.assert_allclose(found, centred(true), rtol=1e-6)
    assert after < 1e-6


def test_glare_in_one_camera_does_not_spoil_the_others():
    true = np.random.default_rng(1).uniform(0.9, 1.1, (6, 3))
    light = patches(true, noise=0.01)
    light[:50, 2] *= 3.0
    found, before, after = fit_gains(light)
    assert np.abs(np.log(found / centred(true))).max() < 0.01
    assert after < before


def test_cameras_that_share_too_little_keep_their_colours():
    light = patches(np.array([[1.0] * 3, [1.2] * 3, [0.7] * 3]))
    light[5:, 2] = np.nan
    found = fit_gains(light)[0]
    assert np.isnan(found[2]).all()
    np.testing.assert_allclose(found[1] / found[0], 1.2, rtol=1e-6)


@pytest.mark.parametrize("shape", [(0, 4, 3), (10, 1, 3), (0, 0, 3)])
def test_gains_without_common_points_are_unknown(shape):
    found, before, after = fit_gains(np.ones(shape))
    assert np.isnan(found).all() and before is None and after is None


def test_gains_over_six_decades_stay_finite():
    true = np.array([[1e-3] * 3, [1.0] * 3, [1e3] * 3])
    found = fit_gains(patches(true))[0]
    np.testing.assert_allclose(found, centred(true), rtol=1e-6)


def seen_squares(image: np.ndarray) -> dict:
    """Paper's light by square of an image of the board."""
    ids, pixels = detect_corners(image, make_detector(BOARD), BOARD)
    assert len(ids) > 10
    return white_light(image, ids, pixels, white_squares(BOARD))


@pytest.fixture(scope="module")
def board_image() -> np.ndarray:
    """The board seen face on."""
    K = np.array([[900.0, 0, 320.0], [0, 900.0, 240.0], [0, 0, 1]])
    return render_board(pinhole_camera("a", K, 640, 480, np.eye(4)), FACING)


def test_the_papers_light_is_read_off_the_board(board_image):
    seen = seen_squares(board_image)
    assert len(seen) >= 4
    paper = srgb_to_linear(np.array((40 + 0.7 * 255) / 255))
    np.testing.assert_allclose(list(seen.values()), paper, rtol=0.02)


def test_clipped_or_dark_paper_is_not_asked(board_image):
    ids, pixels = detect_corners(board_image, make_detector(BOARD), BOARD)
    for level in (255, 11):
        image = np.where(board_image > 200, level, board_image // 8).astype(np.uint8)
        assert not white_light(image, ids, pixels, white_squares(BOARD))


def test_gains_of_two_cameras_come_back_from_their_pictures(board_image):
    true = np.array([1.1, 0.97, 0.9])
    whites = WhiteCollector(BOARD)
    for number in range(4):
        for name, gain in (("a", true**0.5), ("b", true**-0.5)):
            image = scale_light(board_image, gain)
            ids, pixels = detect_corners(image, make_detector(BOARD), BOARD)
            whites.look(name, str(number), image, ids, pixels)
    found = whites.gains(["a", "b", "c"])
    np.testing.assert_allclose(found.gain["a"] / found.gain["b"], true, rtol=0.01)
    assert set(found.gain) == {"a", "b"}
    assert found.after < 0.5 < found.before


@pytest.mark.parametrize("row", ["[1, 2]", '{"a": [1, 2]}', '{"a": [1, 0, 1]}', "{"])
def test_a_broken_table_of_gains_is_one_clear_error(tmp_path, row):
    path = tmp_path / "calibrate" / "S001" / "gains.json"
    path.parent.mkdir(parents=True)
    path.write_text(row)
    with pytest.raises(FormatError, match="calibrate again"):
        read_gains(Dataset(tmp_path), "S001")


@settings(deadline=None, max_examples=25)
@given(gain=st.tuples(*[st.floats(0.5, 1.0)] * 3))
def test_scaling_light_there_and_back_is_lossless_to_a_step_or_two(gain):
    image = np.arange(30, 256, dtype=np.uint8)[:, None, None].repeat(3, 2)
    back = scale_light(scale_light(image, np.array(gain)), 1 / np.array(gain))
    assert np.abs(back.astype(int) - image).max() <= 2


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_gains_that_cannot_be_are_refused(bad):
    with pytest.raises(ValueError, match="above 0"):
        scale_light(np.zeros((2, 2, 3), np.uint8), np.array([1.0, bad, 1.0]))


def test_gains_of_a_subject_without_a_board_are_none(tmp_path):
    assert read_gains(Dataset(tmp_path), "S001") == {}
    write_json(tmp_path / "calibrate" / "S001" / "gains.json", {})
    assert read_gains(Dataset(tmp_path), "S001") == {}
    assert json.loads((tmp_path / "calibrate" / "S001" / "gains.json").read_text()) == {}


def test_a_bad_board_beside_given_cameras_leaves_out_the_colours_only(tmp_path):
    root = tmp_path / "raw"
    rig = make_capture(root)
    table = {"squares_x": 7, "squares_y": 5, "square_length_m": 0.04, "marker_length_m": 0.03}
    lines = [f"{key} = {value}" for key, value in table.items()] + ['dictionary = "DICT_4X4_50"']
    for name in rig:
        (root / "board" / name).mkdir(parents=True)
        write_image(root / "board" / name / "000000.png", np.zeros((20, 30, 3), np.uint8))
    (root / "board" / "board.toml").write_text("\n".join(lines) + "\n")
    dataset = ingest_captures(tmp_path / "data", root, preset="standard")
    assert run_here(CALIBRATE, dataset).ok
    metrics = metrics_of(dataset, "calibrate", "S001")
    (warning,) = [row for row in metrics["warnings"] if row["what"] == "board"]
    assert "30x20" in warning["why"]
    assert read_gains(dataset, "S001") == {}
