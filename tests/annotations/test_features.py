"""Features of synthetic faces: head motion, light and unrest do not count; expressions do."""

import tracemalloc
import weakref

import numpy as np
import pytest

from annotations.align.features import (
    LIDS,
    displacements,
    expression_values,
    in_noise,
    landmark_weights,
    local_contrast,
    measure,
    shared_columns,
)
from annotations.align.suggest import strongest_event
from annotations.observe import stage
from annotations.observe.stage import FACE, FaceObservations, face_side, find_points, steady
from express50.capture.expressions import load_script
from express50.landmarks.detector import SMALLEST
from express50.landmarks.network import load_network

FACE_POINTS = np.random.default_rng(0).uniform(0, 100, (68, 2))
SCRIPT = {e.id: e for e in load_script()}
WINDOW = 16


def observations(points, faces=None, cameras=("a",)):
    """What one camera (or several of the same view) saw."""
    faces = np.full((len(points), FACE, FACE), 128, np.uint8) if faces is None else faces
    count = len(cameras)
    return FaceObservations(
        cameras, np.arange(len(points)), np.stack([points] * count),
        np.ones((count, len(points))), np.stack([faces] * count),
    )  # fmt: skip


def still(windows, seed=1):
    """Points of so many windows at rest, with a detector's noise."""
    noise = np.random.default_rng(seed).normal(0, 0.2, (windows * WINDOW, 68, 2))
    return FACE_POINTS + noise


def windows_of(*names):
    return {name: np.arange(n * WINDOW, (n + 1) * WINDOW) for n, name in enumerate(names)}


def test_head_motion_causes_no_displacement():
    angle = 0.3
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = np.stack([1.4 * FACE_POINTS @ R.T + [30, -20]] * 3)
    found = displacements(moved, FACE_POINTS, {"x": np.arange(3)})
    np.testing.assert_allclose(found, 0.0, atol=1e-9)


def test_blink_is_not_taken_for_a_smile():
    points = still(2)
    smile = np.exp(-0.5 * ((np.arange(WINDOW) - 11.0) / 1.5) ** 2)
    points[WINDOW:, 48:68] += 3.0 * smile[:, None, None]
    points[WINDOW + 3 : WINDOW + 5, LIDS] += 6.0  # the blink, stronger than the smile
    features = measure(observations(points), windows_of("neutral", "smile"))
    values = expression_values(features, SCRIPT["smile"], np.arange(WINDOW, 2 * WINDOW))
    assert strongest_event(values).apex == pytest.approx(11, abs=1)


def test_appearance_alone_reveals_a_peak():
    points, rng = still(2), np.random.default_rng(4)
    skin = np.kron(rng.integers(60, 200, (FACE // 4, FACE // 4)), np.ones((4, 4)))
    faces = (skin + rng.normal(0, 2, (2 * WINDOW, FACE, FACE))).astype(np.uint8)
    patch = rng.integers(0, 255, (10, 10))
    for frame, share in ((8, 0.5), (9, 1.0), (10, 0.5)):
        area = faces[WINDOW + frame, 20:30, 20:30]
        faces[WINDOW + frame, 20:30, 20:30] = (area * (1 - share) + patch * share).astype(np.uint8)
    features = measure(observations(points, faces), windows_of("neutral", "tongue_out"))
    values = expression_values(features, SCRIPT["tongue_out"], np.arange(WINDOW, 2 * WINDOW))
    assert strongest_event(values).apex == pytest.approx(9, abs=1)


def test_appearance_features_ignore_brightness():
    rng = np.random.default_rng(2)
    face = rng.integers(0, 100, (1, FACE, FACE)).astype(np.uint8)
    bright, _ = local_contrast(2 * face + 20, FACE_POINTS)
    dark, _ = local_contrast(face, FACE_POINTS)
    np.testing.assert_allclose(bright, dark, atol=0.25)
    assert np.abs(dark).max() > 0.5


def test_motion_seen_at_rest_is_shrunk():
    rng = np.random.default_rng(5)
    points = still(3)
    way = rng.normal(size=(68, 2))
    points[:WINDOW] += 2.0 * rng.normal(size=(WINDOW, 1, 1)) * way  # a sway at rest
    points[WINDOW + 2 : WINDOW + 6] += 2.0 * way  # the same sway in the clip
    chin = np.zeros((68, 2))
    chin[5:12] = 1.5
    points[WINDOW + 9 : WINDOW + 13] += chin
    windows = windows_of("neutral", "jaw_open", "rest")
    features = measure(observations(points), windows)
    values = expression_values(features, SCRIPT["jaw_open"], np.arange(3 * WINDOW))
    raw = np.linalg.norm(features.values, axis=1)
    kept = np.linalg.norm(values, axis=1)
    sway, jaw = slice(WINDOW + 2, WINDOW + 6), slice(WINDOW + 9, WINDOW + 13)
    assert kept[sway].mean() / kept[jaw].mean() < 0.5 * raw[sway].mean() / raw[jaw].mean()


def test_noise_scale_ignores_slow_motion():
    rng = np.random.default_rng(0)
    slow = 50 * np.sin(np.linspace(0, 3, 200))[:, None] * np.ones(2)
    values = slow + rng.normal(0, [1.0, 5.0], (200, 2))
    scaled = in_noise(values, {"x": np.arange(200)})
    still_noise = np.diff(scaled, n=2, axis=0).std(0) / np.sqrt(6)
    assert still_noise[1] > still_noise[0]
    assert (still_noise < 1.0).all()
    assert np.ptp(scaled[:, 0]) > 10


@pytest.mark.parametrize("entry", SCRIPT.values(), ids=lambda e: e.id)
def test_every_scripted_expression_weights_some_points(entry):
    weights = landmark_weights(entry)
    assert weights.shape == (68,)
    assert weights.sum() > 0


def test_cameras_pair_by_name_or_else_best_with_best():
    rest, windows = still(1), windows_of("neutral")
    one = measure(observations(rest, cameras=("a", "b")), windows)
    two = measure(observations(rest, cameras=("c", "b")), windows)
    other = measure(observations(rest, cameras=("x",)), windows)
    size = one.values.shape[1] // 2
    np.testing.assert_array_equal(shared_columns(one, two), [np.arange(size) + size] * 2)
    np.testing.assert_array_equal(shared_columns(one, other), [np.arange(size)] * 2)


def test_watching_an_empty_picture_gives_finite_points_with_a_low_score():
    images = [np.zeros((40, 30, 3), np.uint8)] * 3
    points, scores = find_points(load_network(), images.__getitem__, range(len(images)), SMALLEST)
    assert points.shape == (3, 68, 2)
    assert np.isfinite(points).all()
    assert (scores < 0.5).all()


def test_steady_keeps_constants_and_single_frames():
    np.testing.assert_allclose(steady(np.full((5, 2), 3.0)), 3.0)
    np.testing.assert_allclose(steady(np.array([[2.0]])), 2.0)
    assert face_side(np.array([[0.0, 0], [10, 4]])) == pytest.approx(11)


def test_long_clips_need_memory_in_proportion_to_their_length():
    values = np.sin(np.arange(20_000) / 50.0)[:, None] * np.ones(3)
    tracemalloc.start()
    try:
        even = steady(values)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 20 * values.nbytes
    np.testing.assert_allclose(even[5:-5], values[5:-5], atol=1e-3)


def test_a_long_window_is_not_held_in_memory(dataset, monkeypatch):
    read, pictures, alive = stage.read_proxy, [], []

    def counted(*which):
        image = read(*which)
        pictures.append(weakref.ref(image))
        alive.append(sum(one() is not None for one in pictures))
        return image

    def watch_one():
        numbers = np.arange(12)
        return stage._observe_camera(
            dataset, "S001", load_network(), "cam00", [numbers], numbers[:1], SMALLEST
        )

    whole = watch_one()
    monkeypatch.setattr(stage, "read_proxy", counted)
    monkeypatch.setattr(stage, "CACHED_FRAMES", 2)
    monkeypatch.setattr(stage, "BATCH", 2)
    for one, other in zip(watch_one(), whole, strict=True):
        rounded = 1 if one.dtype == np.uint8 else 1e-3  # batches of other sizes round otherwise
        np.testing.assert_allclose(one, other, atol=rounded)
    assert len(alive) > 12 and max(alive) <= 6
