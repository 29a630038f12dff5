"""Photographs that lie on their side: pixels, sizes and focal lengths of the upright picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from express50.capture.frames import read_proxy
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.errors import FormatError
from express50.files.images import read_exif, upright
from pipelines.calibrate.footage import known_focals
from tests.stages import ingest_captures
from tests.synth import read_frame, write_photo

WIDTH, HEIGHT, FILM_MM = 64, 48, 28
# What a camera stores of the upright picture under each orientation, as EXIF defines them: where
# its row 0 and column 0 stand.
STORED = {
    1: lambda i: i,
    2: lambda i: i[:, ::-1],
    3: lambda i: i[::-1, ::-1],
    4: lambda i: i[::-1],
    5: lambda i: i.swapaxes(0, 1),
    6: lambda i: np.rot90(i, 1),
    7: lambda i: i[::-1, ::-1].swapaxes(0, 1),
    8: lambda i: np.rot90(i, -1),
}


def scene() -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([4 * x, 5 * y, 0 * x + 90], -1).astype(np.uint8)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    root = tmp_path_factory.mktemp("exif")
    (root / "shots").mkdir()
    for number, store in STORED.items():
        write_photo(
            root / "shots" / f"p{number}.jpg", store(scene()),
            Orientation=number, Exif_FocalLengthIn35mmFilm=FILM_MM,
        )  # fmt: skip
    return ingest_captures(root / "data", root / "shots")


@pytest.mark.parametrize("number", sorted(STORED))
def test_a_folder_of_photographs_is_upright(dataset: Dataset, number: int) -> None:
    index, name = read_index(dataset, "shots"), f"p{number}"
    source = index.cameras[name]
    assert (source.width, source.height, source.orientation) == (WIDTH, HEIGHT, number)
    for image in (
        read_frame(dataset, "shots", name, 0, undistort=False),
        read_proxy(dataset, "shots", name, 0),
    ):
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(image.astype(int) - scene()).mean() < 3.0
    diagonal = np.hypot(WIDTH, HEIGHT)
    assert known_focals(index)[name] == pytest.approx(FILM_MM / np.hypot(36, 24) * diagonal)


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".png"])
@pytest.mark.parametrize("number", sorted(STORED))
def test_every_orientation_of_every_kind_of_file(tmp_path: Path, number: int, suffix: str) -> None:
    path = write_photo(tmp_path / f"a{suffix}", STORED[number](scene()), Orientation=number)
    assert read_exif(path)[0] == number
    np.testing.assert_array_equal(upright(np.asarray(STORED[number](scene())), number), scene())


@pytest.mark.parametrize("value", [0, 9, -1, 60000])
def test_an_orientation_that_is_none_is_upright(tmp_path: Path, value: int) -> None:
    path = write_photo(tmp_path / "a.tif", scene(), Orientation=value)
    assert read_exif(path)[0] == 1


@pytest.mark.parametrize("orientation", [0, 9, True, "6", 1.0])
def test_a_forged_orientation_in_the_index_is_refused(dataset: Dataset, orientation) -> None:
    import json

    from express50.capture.index import index_from_json

    content = json.loads(dataset.index_file("shots").read_text())
    content["cameras"]["p6"]["orientation"] = orientation
    with pytest.raises(ValueError, match="p6: orientation"):
        index_from_json(content, Path())


def test_what_is_not_an_image_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("no image")
    with pytest.raises(FormatError, match=r"a\.jpg: cannot be read as an image"):
        read_exif(tmp_path / "a.jpg")
