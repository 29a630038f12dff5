"""Exports of heads far away, turned by half a turn, seen by a single camera."""

from __future__ import annotations

import json

import numpy as np
import pytest

from express50.__main__ import main
from express50.head.load import load_head
from tests.express50.dataset.tracked import track_arrays, world_vertices, write_track
from tests.express50.head.flame_reader import flame_vertices
from tests.pipelines.bump_dataset import make_dataset


def exported(tmp_path, arrays):
    """Vertices (E, V, 3) that a reader of FLAME's convention puts into the user's world."""
    dataset = make_dataset(tmp_path, cameras=1, size=32)
    write_track(dataset.track_file("S001"), arrays)
    out = tmp_path / "out"
    arguments = ["export", str(dataset.root), str(out), "--format=gaussian-avatars"]
    assert main(arguments) == 0
    move = np.array(json.loads((out / "S001/export.json").read_text())["world_from_export"])
    model = load_head("procedural")
    found = []
    for step in range(len(arrays["expressions"])):
        with np.load(out / "S001" / f"flame_param/{step:05d}.npz") as parameters:
            found.append(flame_vertices(model, dict(parameters)))
    table = json.loads((out / "S001/transforms.json").read_text())
    return np.stack(found) @ move[:3, :3].T + move[:3, 3], move, table


@pytest.mark.parametrize("distance", [15.0, 1000.0, 1e5])
def test_far_from_the_origin_single_precision_is_enough(tmp_path, distance) -> None:
    arrays = track_arrays("procedural", offsets_mm=1.0)
    arrays["t"] = arrays["t"] + [distance, 0.4, -distance]
    exact = world_vertices(load_head("procedural"), arrays, arrays["offsets"])
    arrays["vertices"] = exact.astype(np.float32)
    found, move, table = exported(tmp_path, arrays)
    assert np.abs(found - exact).max() < 1e-5
    assert (move[:3, 3] == np.rint(move[:3, 3])).all()
    # The cameras moved with the head: with the same shift, the first stands where it stood.
    matrix = np.array(table["frames"][0]["transform_matrix"])
    assert np.abs(move[:3, 3] + matrix[:3, 3]).max() < 10.0


@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi - 1e-7, np.pi])
def test_half_turns_and_none(tmp_path, angle) -> None:
    arrays = track_arrays("procedural", turn=0.0)
    c, s = np.cos(angle), np.sin(angle)
    arrays["R"] = np.stack([[[c, 0, s], [0, 1, 0], [-s, 0, c]], [[1, 0, 0], [0, c, -s], [0, s, c]]])
    exact = world_vertices(load_head("procedural"), arrays, arrays["offsets"])
    arrays["vertices"] = exact.astype(np.float32)
    found, move, table = exported(tmp_path, arrays)
    assert np.abs(found - exact).max() < 1e-5 and (move == np.eye(4)).all()
    assert table["camera_indices"] == [0]
