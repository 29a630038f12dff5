"""Depth and normal maps on disk: what each format's rounding costs, and what is refused."""

from __future__ import annotations

import time

import numpy as np
import pytest

from express50.dataset.depth_files import (
    depth_file,
    encode_depth,
    encode_normals,
    read_depth,
    read_normals,
    write_depth,
)
from express50.errors import FormatError
from express50.files.images import write_image

# Least depth, metres, by ending, and the rounding error of the metre above it, mm.
KINDS = {".png": (1.0, 0.025), ".exr": (4.0, 0.00025)}


@pytest.mark.parametrize("kind", KINDS)
def test_depth_comes_back_within_the_error_stated_and_not_much_better(tmp_path, kind):
    least, most_mm = KINDS[kind]
    depth = np.random.default_rng(0).uniform(least, least + 1, (64, 64))
    valid = np.arange(64)[:, None] % 3 > 0 * depth
    path = write_depth(tmp_path, "cam00", encode_depth(np.where(valid, depth, np.nan), valid))
    assert path.suffix == kind
    assert depth_file(tmp_path, "cam00") == path and depth_file(tmp_path, "cam01") is None
    back, known = read_depth(path)
    np.testing.assert_array_equal(known, valid)
    worst = 1e3 * np.abs(back - depth)[valid].max()
    assert 0.4 * most_mm < worst < 1.01 * most_mm
    assert (back[~valid] == 0).all() and back.dtype == np.float32


@pytest.mark.parametrize("kind", KINDS)
def test_depth_has_the_same_bytes_twice(tmp_path, kind):
    depth = np.random.default_rng(1).uniform(KINDS[kind][0], KINDS[kind][0] + 1, (32, 48))
    found = []
    for name in ("a", "b"):
        time.sleep(1.05 if kind == ".exr" else 0)  # its headers may hold the second of writing
        (tmp_path / name).mkdir()
        path = write_depth(tmp_path / name, "cam00", encode_depth(depth, depth > depth.mean()))
        found.append(path.read_bytes())
    assert found[0] == found[1]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, 0.0, 1e5])
def test_depth_that_is_none_is_refused(bad):
    with pytest.raises(ValueError, match="metres"):
        encode_depth(np.full((2, 2), bad), np.ones((2, 2), bool))


def test_a_view_without_depth_is_written(tmp_path):
    path = write_depth(tmp_path, "cam00", encode_depth(np.zeros((2, 2)), np.zeros((2, 2), bool)))
    assert path.suffix == ".png" and not read_depth(path)[1].any()


@pytest.mark.parametrize("values", [np.full((2, 2), -1.0), np.full((2, 2), np.nan),
                                    np.ones((2, 2, 3))])  # fmt: skip
def test_a_foreign_exr_is_refused_by_name(tmp_path, values):
    write_image(tmp_path / "cam00.exr", values.astype(np.float32))
    with pytest.raises(FormatError, match="cam00.exr"):
        read_depth(tmp_path / "cam00.exr")


def test_normals_come_back_within_the_error_stated(tmp_path):
    normals = np.random.default_rng(2).normal(size=(64, 64, 3))
    normals[0, :6] = np.concatenate([np.eye(3), -np.eye(3)])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    valid = np.ones((64, 64), bool)
    valid[10:20] = False
    write_image(tmp_path / "n.png", encode_normals(np.where(valid[..., None], normals, 0), valid))
    back, known = read_normals(tmp_path / "n.png")
    np.testing.assert_array_equal(known, valid)
    assert (back[~valid] == 0).all()
    apart = np.linalg.norm(np.cross(back.astype(float), normals), axis=-1)[valid]
    worst = np.degrees(np.arcsin(apart)).max()
    assert 0.16 < worst < 0.4 and (back * normals).sum(-1)[valid].min() > 0.99


def test_normals_without_length_and_foreign_pictures_are_refused(tmp_path):
    valid = np.ones((2, 2), bool)
    for bad in (np.zeros((2, 2, 3)), np.full((2, 2, 3), np.nan), np.full((2, 2, 3), 2.0)):
        with pytest.raises(ValueError, match="unit length"):
            encode_normals(bad, valid)
    write_image(tmp_path / "grey.png", np.zeros((2, 2), np.uint8))
    with pytest.raises(FormatError, match=r"grey.png"):
        read_normals(tmp_path / "grey.png")
