"""Measure tracked meshes against the twin's truth: millimetres, pixels, coefficients, views.

Everything is compared in the true world. One rigid motion per subject takes the estimated world
there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.common import rms
from benchmarks.track_views import HeldOut, face_of, mask_of, psnr_db
from benchmarks.truth import Truth, align_worlds
from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.dataset.export import clip_vertices
from express50.dataset.tracks import Track, read_sequence, read_track
from express50.errors import Express50Error
from express50.geometry.cameras import Camera, pinhole, project, transform_camera
from express50.geometry.transforms import axis_angle_to_matrix, rigid_fit, transform_points
from express50.head.load import load_head
from express50.head.model import HeadModel, in_regions, landmarks

NO_SKIN = ("mouth_interior", "teeth", "neck", "boundary")


@dataclass(frozen=True)
class Errors:
    """One tracked frame."""

    distances: dict[str, float]  # root mean square distance of face, head and neck, metres
    baseline: dict[str, float]  # the same of the template laid rigidly on the true landmarks
    landmark_px: float  # distances of 68 landmarks in the tracking cameras, root mean square
    jaw_deg: float  # angle between the jaw's rotations
    # expression, true_expression: (X,) coefficients
    expression: np.ndarray
    true_expression: np.ndarray
    # motion, true_motion: (3 F,) how far these coefficients move the face's vertices, metres
    motion: np.ndarray
    true_motion: np.ndarray
    ious: list[float]  # of the head's mask, one per held-out camera
    psnrs: list[float]  # decibels, one per held-out camera that shows enough of the face
    true_psnrs: list[float]  # of the true mesh in their place: highlights, noise and gains alone


def compare(
    dataset: Dataset, truth: Truth, subject: str, path: Path, held_out: Mapping[int, list[HeldOut]]
) -> list[Errors]:
    """Return errors of every frame of a track.

    Args:
        dataset: what was tracked.
        truth: of the recording.
        subject: its id.
        path: of track.npz.
        held_out: cameras that the stages did not see, by frame (`held_out_views`).

    Raises:
        Express50Error: the track is of another head model than the recording.
    """
    track = read_track(path)
    model = load_head(track.head)
    check_topology(model, truth, subject)
    motion = align_worlds(read_cameras_of(dataset, subject), truth.cameras(subject))
    cameras = {
        name: transform_camera(camera, motion)
        for name, camera in read_cameras_of(dataset, subject).items()
    }
    return [
        frame_errors(dataset, truth, subject, model, track, row, motion, cameras, held_out)
        for row in range(len(track.frames))
    ]


def check_topology(model: HeadModel, truth: Truth, subject: str) -> None:
    """Refuse a track whose mesh has another number of vertices than the truth."""
    got, expected = len(model.template), len(truth.head_model(subject).template)
    if got != expected:
        raise Express50Error(
            f"{subject}: tracked {got} vertices, the truth has {expected}; vertex errors need the"
            " twin's own head model, so track with track.head as it was recorded"
        )


def frame_errors(
    dataset: Dataset,
    truth: Truth,
    subject: str,
    model: HeadModel,
    track: Track,
    row: int,
    motion: np.ndarray,
    cameras: Mapping[str, Camera],
    held_out: Mapping[int, list[HeldOut]],
) -> Errors:
    """Return errors of one row of a track; `cameras` are the estimated ones in the true world."""
    frame = int(track.frames[row])
    moved = transform_points(motion, track.vertices[row].astype(np.float64))
    true = truth.vertices(subject, frame)
    parameters = truth.parameters(subject, frame)
    R, t = rigid_fit(marks_of(model, model.template.double().numpy()), marks_of(model, true))
    template = model.template.double().numpy() @ R.T + t
    views = held_out.get(frame, [])
    psnrs, true_psnrs = (
        [psnr_db(dataset, subject, frame, model, mesh, cameras, view) for view in views]
        for mesh in (moved, true)
    )
    return Errors(
        distances=region_errors(model, moved, true),
        baseline=region_errors(model, template, true),
        landmark_px=landmark_px(cameras, truth.cameras(subject), model, moved, true),
        jaw_deg=angle_deg(track.jaw[row], parameters["jaw"]),
        expression=track.expression[row],
        true_expression=parameters["expression"],
        motion=face_motion(model, track.expression[row]),
        true_motion=face_motion(model, parameters["expression"]),
        ious=[iou(mask_of(model, moved, view.camera), view.mask) for view in views],
        psnrs=[value for value in psnrs if value is not None],
        true_psnrs=[value for value in true_psnrs if value is not None],
    )


def region_errors(model: HeadModel, vertices: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Return rms distances of face, head (no mouth, neck or cut edge) and neck, metres."""
    distance = np.linalg.norm(vertices - true, axis=1)
    return {name: rms(distance[chosen]) for name, chosen in regions_of(model).items()}


def regions_of(model: HeadModel) -> dict[str, np.ndarray]:
    """Return vertices (V,) bool of face, head and neck."""
    skin, neck = ~in_regions(model, NO_SKIN), model.regions["neck"].numpy()
    return {"face": face_of(model), "head": skin, "neck": neck}


def face_motion(model: HeadModel, expression: np.ndarray) -> np.ndarray:
    """Return the displacement (3 F,) of the face's vertices by coefficients (X,), metres."""
    directions = model.expression_dirs.double().numpy()[face_of(model)]
    return (directions @ expression).ravel()


def landmark_px(
    cameras: Mapping[str, Camera],
    true_cameras: Mapping[str, Camera],
    model: HeadModel,
    vertices: np.ndarray,
    true: np.ndarray,
) -> float:
    """Return the rms distance of 68 landmarks' projections in all tracking cameras, pixels."""
    errors = []
    for name, camera in cameras.items():
        found, _ = project(camera, marks_of(model, vertices))
        expected, _ = project(pinhole(true_cameras[name]), marks_of(model, true))
        errors.append(np.linalg.norm(found - expected, axis=1))
    return rms(np.concatenate(errors))


def marks_of(model: HeadModel, vertices: np.ndarray) -> np.ndarray:
    """Return the 68 landmarks (68, 3) of vertices (V, 3)."""
    return landmarks(model.to(dtype=torch.float64), torch.from_numpy(vertices)[None])[0].numpy()


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle between two axis-angle rotations (3,), degrees."""
    R = axis_angle_to_matrix(a).T @ axis_angle_to_matrix(b)
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1.0, 1.0))))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Return the intersection over union of two masks; 1 where both are empty."""
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0


def summary(rows: list[Errors]) -> dict:
    """Average figures over frames: mm and pixels as root mean squares, others as means."""
    tracked, true = (
        np.stack([getattr(row, name) for row in rows]) for name in ("motion", "true_motion")
    )
    return {
        "vertex_rmse_mm": pooled([row.distances for row in rows]),
        "landmark_px_true": round(rms(np.array([row.landmark_px for row in rows])), 3),
        "silhouette_iou": mean([value for row in rows for value in row.ious]),
        "expression_r2": r_squared(
            np.stack([row.expression for row in rows]),
            np.stack([row.true_expression for row in rows]),
        ),
        # Coefficients that move the face alike trade places; what they move together is this.
        "expression_motion_r2": r_squared(tracked, true),
        "jaw_error_deg": round(rms(np.array([row.jaw_deg for row in rows])), 3),
        "heldout_camera_psnr_db": mean([value for row in rows for value in row.psnrs]),
    }


def pooled(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the root mean square over frames, millimetres."""
    return {name: round(1e3 * rms(np.array([row[name] for row in rows])), 3) for name in rows[0]}


def mean(values: list[float]) -> float | None:
    """Return the mean; None of nothing."""
    return round(float(np.mean(values)), 4) if values else None


def r_squared(found: np.ndarray, true: np.ndarray) -> float | None:
    """Return 1 - squared error / variance about each coefficient's mean over frames, (E, X).

    Pooled over coefficients; None if nothing varies.
    """
    spread = float(((true - true.mean(0)) ** 2).sum())
    return round(1.0 - float(((found - true) ** 2).sum()) / spread, 4) if spread else None


def clip_errors(dataset: Dataset, truth: Truth, subject: str, cue: str, folder: Path) -> dict:
    """Return `jitter_mm` and `clip_face_rmse_mm` over a clip, or None with `jitter_reason`.

    Jitter is the mean second difference of the face's error, tracked minus true, so that true
    motion does not count. `folder` holds sequence.npz and the track.npz of the same run.
    """
    track = read_track(folder / "track.npz")
    clips = read_sequence(folder / "sequence.npz")
    chosen = [i for i, name in enumerate(clips.cues) if name == cue]
    frames = clips.frames[chosen]
    if len(frames) < 3 or (np.diff(frames) != 1).any():
        why = f"{cue}: {len(frames)} frames in a row were tracked, fewer than 3"
        return {"jitter_mm": None, "clip_face_rmse_mm": None, "jitter_reason": why}
    motion = align_worlds(read_cameras_of(dataset, subject), truth.cameras(subject))
    model = load_head(track.head)
    every = list(clip_vertices(model, track, clips))
    meshes = transform_points(motion, np.stack([every[i] for i in chosen]))
    true = np.stack([truth.vertices(subject, int(frame)) for frame in frames])
    error = 1e3 * (meshes - true)[:, face_of(model)]
    return {
        "jitter_mm": round(float(np.linalg.norm(np.diff(error, n=2, axis=0), axis=2).mean()), 4),
        "clip_face_rmse_mm": round(rms(np.linalg.norm(error, axis=2)), 3),
    }
