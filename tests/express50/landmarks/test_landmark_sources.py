"""Irises, teeth, FAN and files of points: what stands beside the embedded network."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from express50.errors import ConfigError, FormatError
from express50.geometry.cameras import Camera, project
from express50.landmarks.detector import Detection, detect, points_in_crop
from express50.landmarks.irises import EYES, find_irises
from express50.landmarks.network import load_network
from express50.landmarks.sources import (
    FAN_CROP,
    SCHEMA,
    fan_window,
    find_with_fan,
    given_detection,
    load_fan,
    open_source,
    read_points,
    source_files,
)

SIZE = 200
LENS = Camera(
    "a", SIZE, SIZE, "OPENCV", (300.0, 300.0, 100.0, 100.0, -0.2, 0.05, 0.001, 0.0), np.eye(4)
)


def drawn_face(centre: tuple[float, float], opening: float = 14.0) -> tuple[np.ndarray, Detection]:
    """A picture with the left eye about (100, 100), 40 px wide, its iris at a place."""
    image = np.full((SIZE, SIZE, 3), (200, 150, 120), np.uint8)
    fine = 16
    x, y = np.meshgrid(*[(np.arange(SIZE * fine) + 0.5) / fine] * 2)
    lid = np.abs(y - 100) < 0.5 * opening * (1 - ((x - 100) / 20) ** 2)
    iris = np.hypot(x - centre[0], y - centre[1]) < 8.0
    for mask, colour in ((lid, (230, 230, 235)), (lid & iris, (60, 40, 30))):
        share = mask.reshape(SIZE, fine, SIZE, fine).mean((1, 3))[..., None]
        image = (image * (1 - share) + np.array(colour) * share).astype(np.uint8)
    points = np.tile([[150.0, 150.0]], (68, 1))
    first, last, upper, lower = EYES[0]
    points[first], points[last] = (80.0, 100.0), (120.0, 100.0)
    for side, ids in ((-0.45, upper), (0.45, lower)):
        points[ids[0]], points[ids[1]] = (93.0, 100 + side * opening), (107.0, 100 + side * opening)
    return image, Detection(points, np.ones(68), np.full(68, 0.9), 0.95)


@pytest.mark.parametrize("centre", [(100.0, 100.0), (106.3, 99.0), (92.5, 101.0)])
def test_an_iris_is_found_within_a_twentieth_of_the_eye(centre: tuple[float, float]) -> None:
    found = find_irises(*drawn_face(centre))
    assert np.linalg.norm(found.centres[0] - centre) < 2.0
    assert found.confidence[0] > 0.4
    assert 0.5 < found.sigma[0] < 6.0


def test_irises_turn_with_the_picture() -> None:
    image, face = drawn_face((105.0, 100.0))
    upright = find_irises(image, face)
    turned = face.points[:, ::-1] * [1, -1] + [0, SIZE]
    found = find_irises(np.ascontiguousarray(np.rot90(image)), replace(face, points=turned))
    back = np.array([SIZE - found.centres[0, 1], found.centres[0, 0]])
    np.testing.assert_allclose(back, upright.centres[0], atol=0.2)


def test_shut_tiny_and_plain_eyes_say_nothing() -> None:
    image, face = drawn_face((100.0, 100.0), opening=2.0)
    assert find_irises(image, face).confidence[0] == 0
    image, face = drawn_face((100.0, 100.0))
    assert np.isinf(find_irises(np.full_like(image, 128), face).sigma[0])
    small = replace(face, points=100 + 0.1 * (face.points - 100))
    assert find_irises(image, small).confidence[0] == 0
    # The other eye's points all lie on one spot.
    assert find_irises(image, face).confidence[1] == 0


def test_lips_are_seen_apart_over_teeth() -> None:
    seen = detect(load_network(), pytest.importorskip("skimage.data").astronaut())
    gap = (seen.points[66] - seen.points[62])[1]
    assert 3.5 < gap < 7.5  # her teeth show over five pixels


class StandIn(torch.nn.Module):
    """FAN's signature: heat peaks where the crop is brightest, the same for all points."""

    def forward(self, crops: torch.Tensor) -> list[torch.Tensor]:
        heat = torch.nn.functional.avg_pool2d(crops.mean(1, keepdim=True), 4)
        return [heat.expand(-1, 68, -1, -1), heat.expand(-1, 68, -1, -1)]


def fan_file(folder: Path, module: torch.nn.Module) -> Path:
    path = folder / "fan.pt"
    torch.jit.script(module).save(str(path))
    return path


def test_fan_gives_points_in_image_pixels(tmp_path: Path) -> None:
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    cv2.circle(image, (120, 90), 3, (255, 255, 255), -1)
    points = np.random.default_rng(0).uniform(60, 150, (68, 2))
    face = Detection(points, np.ones(68), np.full(68, 0.9), 0.8)
    found = find_with_fan(load_fan(fan_file(tmp_path, StandIn())), image, face)
    np.testing.assert_allclose(found.points, np.tile([120.5, 90.5], (68, 1)), atol=0.7)
    assert found.score == face.score
    assert (found.sigma > 0).all() and (found.confidence <= 0.8).all()


def test_fan_sees_the_whole_face() -> None:
    points = np.random.default_rng(1).uniform(400, 500, (68, 2))
    inside = points_in_crop(fan_window(points), points)
    assert inside.min() > 0.1 * FAN_CROP and inside.max() < 0.9 * FAN_CROP


def test_wrong_or_absent_weights_are_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        open_source(f"fan:{tmp_path / 'absent.pt'}", {})
    (tmp_path / "text.pt").write_text("no weights")
    with pytest.raises(ConfigError, match="cannot be loaded") as caught:
        open_source(f"fan:{tmp_path / 'text.pt'}", {})
    assert "miniz" not in str(caught.value)  # PyTorch guesses that the file is corrupted
    with pytest.raises(ConfigError, match=r"gives \(1, 3, 256, 256\)"):
        load_fan(fan_file(tmp_path, torch.nn.Identity()))


def given_rows(count: int = 68) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.concatenate([rng.uniform(60, 140, (count, 2)), np.ones((count, 1))], axis=1)


def write_json(path: Path, rows: np.ndarray, camera: str = "a") -> Path:
    points = [None if np.isnan(row[0]) else row.tolist() for row in rows]
    path.write_text(json.dumps({"schema": SCHEMA, "cameras": {camera: {"4": points}}}))
    return path


def test_points_of_a_file_are_undistorted(tmp_path: Path) -> None:
    place = np.array([[0.25, -0.2, 1.0]])
    rows = given_rows()
    rows[:, :2] = project(LENS, place)[0]
    np.savez(
        tmp_path / "p.npz", schema=SCHEMA, cameras=np.array(["a"]), frames=np.array([4]),
        points=rows[None, None, :, :2],
    )  # fmt: skip
    for path in (tmp_path / "p.npz", write_json(tmp_path / "p.json", rows)):
        read = read_points(path, {"a": LENS})["a", 4]
        ideal = 300.0 * place[0, :2] + 100.0
        np.testing.assert_allclose(read[:, :2], np.tile(ideal, (68, 1)), atol=1e-3)
        assert np.linalg.norm(ideal - rows[0, :2]) > 0.5


def test_unknown_points_and_frames_are_not_evidence(tmp_path: Path) -> None:
    rows = given_rows(70)
    rows[5] = np.nan
    source = open_source(str(write_json(tmp_path / "p.json", rows)), {"a": LENS})
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    seen = source(image, "a", 4)
    assert np.isinf(seen.face.sigma[5]) and seen.face.confidence[5] == 0
    assert np.isfinite(seen.face.points).all() and np.isfinite(np.delete(seen.face.sigma, 5)).all()
    assert (seen.irises.confidence == 1).all() and seen.visible_contour
    assert source(image, "a", 5).face.score == 0 and source(image, "b", 4).face.score == 0
    assert given_detection(np.full((68, 3), np.nan)).score == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:60], "expected 68 or 70"),
        (lambda rows: rows * [1, 1, 3], "out of range"),
        (lambda rows: rows * [50, 1, 1], "pixels of the footage"),
        (lambda rows: np.where(np.arange(68)[:, None] == 3, np.inf, rows), "infinite"),
    ],
)
def test_bad_points_are_refused(tmp_path: Path, change, message: str) -> None:
    path = write_json(tmp_path / "p.json", change(given_rows()))
    with pytest.raises(FormatError, match=message):
        read_points(path, {"a": LENS})


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    path = write_json(tmp_path / "p.json", given_rows(), camera="z")
    with pytest.raises(FormatError, match="cameras z"):
        read_points(path, {"a": LENS})
    path.write_text("{}")
    with pytest.raises(FormatError, match="not a file of landmarks"):
        read_points(path, {"a": LENS})
    assert source_files(str(path)) == {"landmarks": path}
