"""Clips: the frozen shape, windows, smoothing both ways, and going on after a crash."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from express50.capture.frames import FrameReader, make_picture, read_cameras_of
from express50.capture.index import Cue
from express50.dataset.tracks import SEQUENCE_SCHEMA
from express50.errors import StageError
from express50.files.atomic import write_json
from express50.geometry.cameras import project
from express50.geometry.pixels import shrunk_size
from express50.geometry.transforms import axis_angle_to_matrix
from express50.landmarks.detector import Detection
from express50.landmarks.irises import Irises
from express50.landmarks.sources import Marked
from pipelines.track import sequence
from pipelines.track.basis import Points, freeze_shape
from pipelines.track.observe import LandmarkView, Observation, triangulate_views
from pipelines.track.read_inputs import read_clip
from pipelines.track.sequence import (
    ClipTracker,
    Observed,
    _expected,
    jitter_mm,
    make_windows,
    track_window,
    write_clips,
)
from pipelines.track.state import Pose
from pipelines.track.surface import FrameSetCrops
from pipelines.track.terms import landmark_anchors
from tests.express50.capture.test_frames import write_calibration
from tests.pipelines.test_track import RIG, make_scene
from tests.synth import make_rig, render_ball

FRAMES = 10


def true_poses(scene, frames: int = FRAMES) -> list[Pose]:
    """A slow nod with a growing expression."""
    poses = []
    for frame in range(frames):
        own = scene.own.copy()
        own[0] = 0.1 + 0.04 * frame
        own[-3:] += [0.001 * frame, 0.0, 0.0]
        turn = axis_angle_to_matrix(np.array([0.02 * frame, 0.0, 0.0]))
        poses.append(Pose(own, turn @ scene.rotation))
    return poses


def observations(scene, noise: float, cameras=RIG, order: int = 1) -> list[Observation]:
    points = Points(scene.basis, np.arange(90))
    rng = np.random.default_rng(5)
    found = []
    for frame, pose in enumerate(true_poses(scene)):
        mesh = points.evaluate(np.concatenate([scene.shape, pose.own]), pose.rotation)
        marks = landmark_anchors(scene.basis.model).at(mesh)
        views = []
        for camera in cameras:
            pixels = project(camera, marks)[0] + noise * rng.normal(size=(68, 2))
            views.append(LandmarkView(camera, pixels, np.ones(68), 0.9))
        found.append(triangulate_views("clip", frame, views)[0])
    return found if order > 0 else found[::-1]


def meshes(person, poses: list[Pose]) -> np.ndarray:
    points = Points(person, np.arange(len(person.model.template)))
    return np.stack([points.evaluate(pose.own, pose.rotation) for pose in poses])


def unseen(mesh: np.ndarray) -> FrameSetCrops:
    return FrameSetCrops((), ())


def found(one: Observation | None):
    """What a look at a frame finds, wherever it looks."""
    return lambda expected: one


def tracked(tracker: ClipTracker, seen: list[Observation]) -> list[Pose]:
    return list(track_window(tracker, ((found(one), unseen) for one in seen)).values())


def test_a_frozen_shape_is_the_same_head() -> None:
    scene = make_scene()
    person = freeze_shape(scene.basis, scene.shape, np.zeros((68, 3)))
    assert person.shape_size == 0 and person.expression_size == scene.basis.expression_size
    np.testing.assert_allclose(
        Points(person, np.arange(90)).evaluate(scene.own, scene.rotation),
        scene.vertices, atol=1e-12,
    )  # fmt: skip


@pytest.mark.parametrize(("count", "window", "sweeps"), [(1, 48, 2), (13, 4, 0), (50, 7, 3)])
def test_every_frame_is_kept_by_one_window(count: int, window: int, sweeps: int) -> None:
    windows = make_windows(range(100, 100 + count), sweeps, window)
    assert [frame for _, kept in windows for frame in kept] == list(range(100, 100 + count))
    assert all(set(kept) <= set(fitted) for fitted, kept in windows)
    for (before, _), (after, _) in zip(windows, windows[1:], strict=False):
        shared = set(before) & set(after)
        assert len(shared) > 2 * sweeps


def test_smoothing_takes_noise_and_leaves_motion() -> None:
    scene = make_scene()
    person = freeze_shape(scene.basis, scene.shape, np.zeros((68, 3)))
    seen = observations(scene, 1.5)
    truth = meshes(person, true_poses(scene))
    results = {}
    for sweeps in (0, 2):
        results[sweeps] = meshes(person, tracked(ClipTracker(person, sweeps=sweeps), seen))
    assert jitter_mm(results[2]) < 0.4 * jitter_mm(results[0])
    error = {n: np.linalg.norm(mesh - truth, axis=2).mean() for n, mesh in results.items()}
    assert error[2] < error[0]
    # The last frame is no worse than the first by more than noise explains.
    ends = np.linalg.norm(results[2] - truth, axis=2).mean(1)[[0, -1]]
    assert ends.max() < 3 * ends.min()


def test_sweeps_know_no_direction_of_time() -> None:
    """An odd number of frames, reversed, is smoothed to the same."""
    scene = make_scene()
    person = freeze_shape(scene.basis, scene.shape, np.zeros((68, 3)))
    seen = observations(scene, 1.0)[:7]
    tracker = ClipTracker(person)
    ahead = tracked(tracker, seen)
    mirrored = [dataclasses.replace(one, frame=100 - one.frame) for one in reversed(seen)]
    back = tracked(tracker, mirrored)[::-1]
    np.testing.assert_allclose(meshes(person, ahead), meshes(person, back), atol=3e-4)


def test_neighbours_beyond_a_gap_are_none() -> None:
    points = [np.full((3, 3), float(k)) for k in range(3)]
    assert _expected(points, [0, 1, 2], 1, 3)[0] is not None
    assert _expected(points, [0, 3, 6], 1, 3)[0] is not None
    for frames in ([0, 5, 6], [0, 1, 6], [0, 5, 10]):
        assert all(_expected(points, frames, n, 3)[0] is None for n in range(3)), frames


CUES = (Cue("smile", 0, 4), Cue("frown", 5, 9))


def run(scene, keep: Path, watched: list[int], fail_at: int | None = None, hide: int | None = None):
    """Track the cues: arrays, metrics and notes."""
    seen = observations(scene, 0.5)

    def read(cue: str, frames: Sequence[int]) -> list[Observed]:
        if fail_at in frames:
            raise KeyboardInterrupt
        watched.extend(frames)
        return [(found(seen[frame] if frame != hide else None), unseen) for frame in frames]

    out = keep.with_name(keep.name + "-out")
    out.mkdir(exist_ok=True)
    metrics, dropped = write_clips(
        out, quick(scene), "tiny", scene.shape, CUES, 60.0, read, keep, "inputs"
    )
    with np.load(out / "sequence.npz", allow_pickle=False) as data:
        return dict(data), metrics, dropped


def quick(scene) -> ClipTracker:
    person = freeze_shape(scene.basis, scene.shape, np.zeros((68, 3)))
    return ClipTracker(person, sweeps=0)


def test_a_stopped_run_goes_on_to_the_same_result(tmp_path: Path) -> None:
    scene = make_scene()
    whole, account, dropped = run(scene, tmp_path / "a", [])
    assert whole["frames"].tolist() == list(range(FRAMES))
    assert whole["cues"].tolist() == ["smile"] * 5 + ["frown"] * 5
    assert str(whole["schema"]) == SEQUENCE_SCHEMA and dropped == []
    assert set(account["jitter_mm"]) == {"smile", "frown"}
    watched: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        run(scene, tmp_path / "b", watched, fail_at=8)
    assert 0 in watched
    watched.clear()
    resumed, *_ = run(scene, tmp_path / "b", watched)
    assert min(watched) == 5, "the first cue is not looked at again"
    for name in whole:
        np.testing.assert_array_equal(whole[name], resumed[name])


def test_frames_without_a_face_are_left_out_and_said(tmp_path: Path) -> None:
    arrays, _, dropped = run(make_scene(), tmp_path / "windows", [], hide=3)
    assert 3 not in arrays["frames"] and len(arrays["frames"]) == FRAMES - 1
    assert "1 of 5 frames" in dropped[0].why
    with pytest.raises(StageError, match="no frame of any clip"):
        write_clips(
            tmp_path, quick(make_scene()), "tiny", np.zeros(5), CUES, 60.0, lambda c, f: [],
            tmp_path / "n", "",
        )  # fmt: skip


@pytest.mark.parametrize("side", [0, 40])
def test_a_clip_is_decoded_once_and_its_crops_are_of_its_pictures(
    ingested, monkeypatch, side
) -> None:
    recorded = make_rig()
    write_calibration(ingested, recorded)
    sizes = {n: shrunk_size(c.width, c.height, side or c.width) for n, c in recorded.items()}
    write_json(ingested.picture_sizes_file("S001"), sizes)
    rig = read_cameras_of(ingested, "S001")
    places = 0.05 * np.random.default_rng(0).normal(size=(68, 3))
    decoded: Counter[tuple[str, int]] = Counter()
    original = FrameReader.read

    def counted(self, frame):
        decoded[self.camera_id, frame] += 1
        return original(self, frame)

    def find(image, camera_id: str, frame: int) -> Marked:
        assert image.shape == (rig[camera_id].height, rig[camera_id].width, 3)
        points = project(rig[camera_id], places)[0]
        face = Detection(points, np.ones(68), np.ones(68), 0.9 if frame != 2 else 0.0)
        return Marked(face, Irises(np.zeros((2, 2)), np.full(2, np.inf), np.zeros(2)), True)

    monkeypatch.setattr(FrameReader, "read", counted)
    clip = read_clip(ingested, "S001", find, None, [], 64, "smile", [1, 2, 4])
    for frame, (look, cut_crops) in zip((1, 2, 4), clip, strict=True):
        seen = look(None)
        assert seen is None if frame == 2 else seen.frame == frame
        for crop in cut_crops(places).crops:
            row, column = np.array(crop.camera.K[:2, 2] - rig[crop.camera.id].K[:2, 2]).astype(int)
            camera = recorded[crop.camera.id]
            whole = make_picture(render_ball(camera, frame), camera, sizes[camera.id])
            height, width = crop.image.shape[:2]
            assert np.array_equal(crop.image, whole[-column:, -row:][:height, :width])
    assert decoded == {(camera, frame): 1 for camera in rig for frame in (1, 2, 4)}


def test_kept_windows_go_when_the_sequence_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, keep = make_scene(), tmp_path / ".windows" / "S001"
    seen = observations(scene, 0.5)
    kept = []
    savez = sequence.np.savez
    monkeypatch.setattr(
        sequence.np, "savez", lambda *a, **k: (kept.append(keep.is_dir()), savez(*a, **k))
    )
    write_clips(
        tmp_path, quick(scene), "tiny", scene.shape, CUES, 60.0,
        lambda c, f: [(found(seen[k]), unseen) for k in f], keep, "inputs",
    )  # fmt: skip
    assert kept[-1] and not keep.exists()
    with np.load(tmp_path / "sequence.npz", allow_pickle=False) as data:
        assert data["R"].shape == (FRAMES, 3, 3) and data["shape"].shape == (5,)
        assert data["rate"] == 60
