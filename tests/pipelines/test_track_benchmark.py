"""The benchmark of tracking: no error for the truth itself, known ones for known damage."""

from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path

import numpy as np
import pytest

import benchmarks
from benchmarks.track import HELD_OUT, benchmark, narrowed, parse, prepare, twin_config
from benchmarks.track_truth import clip_errors, compare, r_squared, summary
from benchmarks.track_views import held_out_views
from express50.capture.frames import read_cameras_of
from express50.capture.index import read_index, read_peaks
from express50.dataset.tracks import SCHEMA, SEQUENCE_SCHEMA

CAMERAS, SUBJECT = 7, "S041"
SHIFT = np.array([0.0, 0.008, 0.0])
OWN = ("expression", "neck", "jaw", "eyes", "R", "t")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    config = twin_config(1, CAMERAS, 160)
    config = dataclasses.replace(config, expressions=("neutral", "smile"))
    return prepare(config, tmp_path_factory.mktemp("twin"))


def write_truth_as_track(truth, frames: list[int], path: Path, shift: np.ndarray) -> None:
    """The true parameters as a track, its vertices moved."""
    rows = [truth.parameters(SUBJECT, frame) for frame in frames]
    vertices = np.stack([truth.vertices(SUBJECT, frame) for frame in frames]) + shift
    np.savez(
        path,
        schema=np.array(SCHEMA),
        head=np.array("procedural"),
        expressions=np.array([f"e{frame}" for frame in frames]),
        frames=np.array(frames),
        shape=rows[0]["shape"],
        offsets=rows[0]["offsets"].astype(np.float32),
        vertices=vertices.astype(np.float32),
        **{name: np.stack([row[name] for row in rows]) for name in OWN},
    )


def figures_of(source, path: Path, shift) -> dict:
    dataset, truth, captures = source
    write_truth_as_track(truth, list(truth.peaks(SUBJECT).values()), path, shift)
    views = held_out_views(dataset, truth, SUBJECT, captures)
    return summary(compare(dataset, truth, SUBJECT, path, views))


def test_the_truth_has_no_error_and_a_shifted_head_its_shift(source, tmp_path) -> None:
    exact = figures_of(source, tmp_path / "track.npz", np.zeros(3))
    moved = figures_of(source, tmp_path / "track.npz", SHIFT)
    assert max(exact["vertex_rmse_mm"].values()) < 1e-2
    assert exact["silhouette_iou"] == 1.0
    assert exact["expression_r2"] == exact["expression_motion_r2"] == 1.0
    assert exact["landmark_px_true"] < 1e-2 and exact["jaw_error_deg"] < 1e-3
    assert list(moved["vertex_rmse_mm"].values()) == pytest.approx([8.0] * 3, abs=0.02)
    # Eight millimetres are about 3 of the 160 pixels that show 0.43 m.
    assert 2.0 < moved["landmark_px_true"] < 4.5 and 0.85 < moved["silhouette_iou"] < 0.99
    assert exact["heldout_camera_psnr_db"] > 26.0
    assert exact["heldout_camera_psnr_db"] > moved["heldout_camera_psnr_db"] + 1.0


def test_held_out_cameras_are_hidden_from_the_stages(source) -> None:
    dataset, truth, captures = source
    seen, true = read_cameras_of(dataset, SUBJECT), truth.cameras(SUBJECT)
    assert len(true) == CAMERAS and len(seen) == CAMERAS - HELD_OUT and set(seen) < set(true)
    assert set(read_index(dataset, SUBJECT).cameras) == set(seen)
    views = held_out_views(dataset, truth, SUBJECT, captures)
    ids = {view.camera.id for rows in views.values() for view in rows}
    assert ids == set(true) - set(seen)
    assert all(view.image is None for view in held_out_views(dataset, truth, SUBJECT, None)[1])


def test_jitter_is_of_the_error_not_of_the_motion(source, tmp_path) -> None:
    dataset, truth, _ = source
    frames = [4, 5, 6, 7]
    write_truth_as_track(truth, frames, tmp_path / "track.npz", np.zeros(3))
    with np.load(tmp_path / "track.npz") as track:
        rows = {name: track[name] for name in OWN}
        shared = {"schema": SEQUENCE_SCHEMA, "head": track["head"], "shape": track["shape"]}

    def jitter(wobble: float, count: int = 4) -> dict:
        t = rows["t"] + wobble * np.array([[1.0], [-1.0], [1.0], [-1.0]]) * [1.0, 0.0, 0.0]
        sequence = {k: v[:count] for k, v in (rows | {"t": t, "frames": np.array(frames)}).items()}
        sequence |= {"cues": np.array(["smile"] * count), "rate": np.array(24.0)}
        np.savez(tmp_path / "sequence.npz", **shared, **sequence)
        return clip_errors(dataset, truth, SUBJECT, "smile", tmp_path)

    assert jitter(0.0)["jitter_mm"] < 1e-2
    shaken = jitter(1e-3)
    assert shaken["jitter_mm"] == pytest.approx(4.0, abs=1e-2)
    assert shaken["clip_face_rmse_mm"] == pytest.approx(1.0, abs=1e-2)
    few = jitter(0.0, 2)
    assert few["jitter_mm"] is few["clip_face_rmse_mm"] is None
    assert few["jitter_reason"] == "smile: 2 frames in a row were tracked, fewer than 3"


def test_a_run_without_pictures_says_what_is_missing(source) -> None:
    dataset, truth, _ = source
    result = benchmark((dataset, truth, None), (), 1, False)
    assert result["true_mesh"] == {"heldout_camera_psnr_db": None}
    row = result["landmark_only"]
    assert row["frames"] == 2 and 0 < row["seconds_per_frame"] < 60
    assert row["vertex_rmse_mm"]["face"] < 6.0 and row["silhouette_iou"] > 0.85
    assert row["heldout_camera_psnr_db"] is None and "captures" in row["heldout_camera_psnr_reason"]
    assert row["jitter_mm"] is None and row["jitter_reason"]
    assert result["photometric_improves"] is None
    assert result["baseline"]["vertex_rmse_mm"]["face"] > 0.5


def test_a_narrowed_dataset_leaves_the_other_as_it_was(source, tmp_path) -> None:
    dataset, _, _ = source
    few = narrowed(dataset, SUBJECT, tmp_path / "few", views=3)
    one = narrowed(dataset, SUBJECT, tmp_path / "one", cues=("neutral", "smile"))
    assert len(read_cameras_of(few, SUBJECT)) == 3
    assert [cue.expression_id for cue in read_index(one, SUBJECT).cues] == ["smile"]
    assert len(read_cameras_of(dataset, SUBJECT)) == CAMERAS - HELD_OUT
    assert len(read_index(dataset, SUBJECT).cues) == len(read_peaks(dataset, SUBJECT)) == 2


def test_r_squared_of_the_mean_is_zero() -> None:
    true = np.array([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0]])
    assert r_squared(true, true) == 1.0
    assert r_squared(np.ones((3, 2)), true) == 0.0
    assert r_squared(true, np.ones((3, 2))) is None


@pytest.mark.parametrize(
    "line", ["--dataset x", "--captures x", "--subjects 0", "--presets fast", "--cameras 3"]
)
def test_command_lines_that_cannot_work_are_refused(line: str, capsys) -> None:
    with pytest.raises(SystemExit):
        parse(line.split())
    assert "error:" in capsys.readouterr().err


def test_every_benchmark_can_be_imported() -> None:
    names = sorted(path.stem for path in Path(benchmarks.__file__).parent.glob("*.py"))
    assert len(names) > 20
    for name in names:
        importlib.import_module(f"benchmarks.{name}")
