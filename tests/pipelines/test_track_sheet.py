"""The track's contact sheet names every expression and every camera, and marks the odd ones."""

from __future__ import annotations

import numpy as np
import pytest

from express50.files.images import read_image
from express50.geometry.pixels import ALARM
from pipelines.track.report import (
    DIM,
    SHEET_TILE,
    camera_bars,
    camera_residuals,
    expression_residuals,
    expression_sheet,
    write_sheet,
)

TABLE = {"neutral": {"cam00": 1.0, "cam01": 2.0}, "smile": {"cam01": 4.0}, "wink": {}}


def flat(level: int, height: int = 50, width: int = 50) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)


def has(image: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((image == np.array(colour, np.uint8)).all(-1).any())


def test_residuals_are_means_of_squares() -> None:
    assert expression_residuals(TABLE) == pytest.approx({"neutral": 2.5**0.5, "smile": 4.0})
    found = camera_residuals(TABLE)
    assert list(found) == ["cam00", "cam01"]
    assert found["cam00"] == (1.0, 1)
    assert found["cam01"] == (pytest.approx(10**0.5), 2)


@pytest.mark.parametrize("count", [1, 2, 5, 7, 60])
def test_every_expression_has_its_tile(count) -> None:
    tiles = {f"e{k}": flat(60 + 3 * k) for k in range(count)}
    sheet = expression_sheet(tiles, {})
    rows, columns = sheet.shape[0] // SHEET_TILE, sheet.shape[1] // SHEET_TILE
    assert (rows - 1) * columns < count <= rows * columns
    middles = sheet[SHEET_TILE // 2 :: SHEET_TILE, SHEET_TILE // 2 :: SHEET_TILE, 0].ravel()
    assert middles[:count].tolist() == [60 + 3 * k for k in range(count)]


def test_odd_expressions_and_cameras_stand_out() -> None:
    tiles = {name: flat(90) for name in ("a", "b", "c")}
    assert not has(expression_sheet(tiles, {"a": 1.0, "b": 1.1, "c": 1.2}), ALARM)
    assert has(expression_sheet(tiles, {"a": 1.0, "b": 1.1, "c": 5.0}), ALARM)
    even = {"a": {"c0": 1.0, "c1": 1.1, "c2": 0.9}}
    chart = camera_bars(even)
    assert has(chart, DIM) and not has(chart, ALARM)
    assert has(camera_bars({"a": even["a"] | {"c2": 4.0}}), ALARM)


def test_bars_are_as_long_as_the_residuals() -> None:
    chart = camera_bars({"a": {"c0": 1.0, "c1": 1.25, "c2": 1.0}})
    lengths = [(row == np.array(DIM, np.uint8)).all(-1).sum() for row in chart]
    found = sorted({int(n) for n in lengths if n})
    assert len(found) == 2 and found[0] / found[1] == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize(
    ("tiles", "table"),
    [
        ({}, {}),
        ({"a": flat(50, 300, 100)}, {}),
        ({"a": flat(50, 1, 1)}, {"a": {}}),
        ({"a" * 70: flat(50)}, {"a" * 70: {"a_camera_with_a_long_name": 0.0}}),
        ({"a": flat(50)}, {"a": {"c": 1e-12, "d": 1e9}}),
    ],
)
def test_any_track_gives_a_page(tmp_path, tiles, table) -> None:
    write_sheet(tmp_path / "qc", tiles, table)
    page = read_image(tmp_path / "qc" / "sheet.jpg")
    assert page.shape[1] >= SHEET_TILE and page.max() > 100  # words at least


def test_the_same_track_gives_the_same_bytes(tmp_path) -> None:
    tiles = {"neutral": flat(50), "smile": flat(70)}
    for name in ("one", "two"):
        write_sheet(tmp_path / name, tiles, TABLE)
    assert (tmp_path / "one/sheet.jpg").read_bytes() == (tmp_path / "two/sheet.jpg").read_bytes()
