"""The track stage: detect, triangulate, align, fit; writes track.npz and overlays."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from express50.cameras import Camera
from express50.errors import CaptureError, StageError
from express50.frames import read_cameras_of, read_frame, read_peaks
from express50.head.load import load_head
from express50.head.model import HeadModel, landmarks
from express50.images import read_alpha
from express50.index import index_path, read_index
from express50.landmarks.sources import Source, open_source, source_files
from express50.layout import Dataset
from express50.stage import Stage
from pipelines.track.bake import write_texture
from pipelines.track.clips import write_clips
from pipelines.track.config import PRESETS, TrackConfig
from pipelines.track.fit import (
    State,
    Target,
    consistent_sigma,
    fit,
    landmark_sigma,
    rounded,
    start_state,
)
from pipelines.track.marks import Eyes, measure_eyes
from pipelines.track.observe import (
    Marks,
    Observation,
    View,
    agree,
    facing,
    make_view,
)
from pipelines.track.offsets import split_shape, with_modes
from pipelines.track.outline import Outline, signed_distance
from pipelines.track.overlay import draw_overlays
from pipelines.track.pinhole import project_pinhole
from pipelines.track.refine import Moment, all_vertices, refine, rotations
from pipelines.track.render import rendered_like_pictures
from pipelines.track.sheet import write_sheet
from pipelines.track.shots import Shot, cut_shot
from pipelines.track.sparse_head import Basis, make_basis
from pipelines.track.start import initial_pose
from pipelines.track.suspects import suspect_cameras

SCHEMA = "express50.track/2"
MIN_FACING = 0.05
DECIMALS = 7


def items(dataset: Dataset) -> list[str]:
    """Subjects: the shape is shared by all expressions of one."""
    return dataset.subjects()


def inputs(dataset: Dataset, item: str, config: TrackConfig) -> dict[str, Path | str]:
    """Index, cameras, peaks, mattes, the detector's weights and the head model's file."""
    found: dict[str, Path | str] = {
        "index": index_path(dataset, item),
        "cameras": dataset.item_dir("calibrate", item) / "cameras.json",
        "peaks": dataset.item_dir("align", item) / "peaks.json",
        **source_files(config.landmarks),
    }
    mattes = dataset.item_dir("matte", item)
    rounds = (config.silhouette_rounds, config.relief_rounds, config.photo_rounds)
    if any(rounds) and mattes.is_dir():
        found["mattes"] = mattes
    if config.head != "procedural":
        found["head"] = Path(config.head).expanduser()
    return found


def run(dataset: Dataset, item: str, config: TrackConfig, out: Path) -> dict:
    """Track one subject; see the module docstring of `fit` for the method."""
    torch.set_num_threads(1)
    cameras = read_cameras_of(dataset, item)
    dropped: list[dict[str, str]] = []
    basis = _basis(config.head, config.offset_modes, config.offset_sigma, config.offset_length)
    source = _open_source(dataset, item, config)
    observations = _observe(dataset, item, cameras, source, config, dropped)
    targets, poses = _targets(basis, observations, config, dropped)
    if not targets:
        reasons = "; ".join(f"{row['what']}: {row['why']}" for row in dropped[:3])
        raise StageError(f"{item}: no expression could be tracked ({reasons})")
    state, _ = fit(basis, targets, start_state(basis, poses), config, config.iterations)
    targets = [
        replace(target, sigma=consistent_sigma(target, marks))
        for target, marks in zip(targets, _marks(basis.model, state), strict=True)
    ]
    meshes = all_vertices(basis.model, state)
    eyes = measure_eyes(basis.model, targets, meshes, rotations(state))
    moments = _moments(dataset, item, targets, meshes, config)
    state, targets, appearance = refine(basis, targets, state, moments, eyes, config)
    if config.render_rounds and appearance is not None:
        state = rendered_like_pictures(basis.model, targets, state, moments, appearance, config)
    state = rounded(state, DECIMALS)
    vertices = all_vertices(basis.model, state)
    _write_track(out / "track.npz", config.head, basis, targets, state, vertices)
    if appearance is not None and config.texture_side:
        write_texture(out, basis.model, targets, vertices, moments, appearance, config.texture_side)
    metrics = _metrics(basis.model, targets, vertices, dropped)
    tiles = draw_overlays(dataset, item, out / "qc", basis.model, targets, vertices)
    write_sheet(out / "qc", tiles, metrics["landmark_rms_px"])
    marks = _marks(basis.model, state)
    metrics["suspect_cameras"] = suspect_cameras(targets, marks, rotations(state), vertices.mean(1))
    if config.frames == "clips":
        clips = _clips(dataset, item, basis, state, source, eyes, config, out)
        metrics |= {"dropped": dropped + clips.pop("dropped"), "clips": clips}
    return metrics


def _clips(
    dataset: Dataset,
    subject: str,
    basis: Basis,
    state: State,
    source: Source,
    eyes: Eyes | None,
    config: TrackConfig,
    out: Path,
) -> dict:
    """Write sequence.npz: every frame of the cue windows with the peaks' shape."""
    cameras = read_cameras_of(dataset, subject)

    def observe(cue: str, frame: int) -> Observation | None:
        try:
            views = _views(dataset, subject, cameras, frame, source, config)
        except CaptureError:
            return None
        observation = agree(cue, frame, views)[0] if views else None
        enough = observation and observation.inliers.sum(1).max() >= config.min_landmarks
        return observation if enough else None

    keep = dataset.windows_dir(subject)
    paths, cues = inputs(dataset, subject, config), read_index(dataset, subject).cues
    return write_clips(out, basis, state, cues, observe, config, keep, paths, eyes)


def _open_source(dataset: Dataset, subject: str, config: TrackConfig) -> Source:
    """The source of landmarks; files of points are of the footage as recorded."""
    recorded = read_cameras_of(dataset, subject, undistorted=False)
    return open_source(config.landmarks, recorded, config.refinements)


@lru_cache(maxsize=2)
def _basis(head: str, modes: int, sigma: float, length: float) -> Basis:
    return make_basis(with_modes(load_head(head), modes, sigma, length))


def _observe(
    dataset: Dataset,
    subject: str,
    cameras: dict[str, Camera],
    source: Source,
    config: TrackConfig,
    dropped: list[dict[str, str]],
) -> list[Observation]:
    """Detect landmarks at every peak in every camera and reject what does not agree."""
    peaks = read_peaks(dataset, subject)
    # The neutral frame shows which cameras see the face; the others need not look again.
    order = sorted(peaks, key=lambda name: (name != config.neutral, list(peaks).index(name)))
    chosen = list(cameras)
    found = {}
    for expression in order:
        now = {name: cameras[name] for name in chosen}
        try:
            views = _views(dataset, subject, now, peaks[expression], source, config)
        except CaptureError as error:
            dropped.append({"what": expression, "why": str(error)})
            continue
        if config.cameras and len(chosen) > config.cameras and len(views) >= config.cameras:
            views = sorted(views, key=lambda view: float(np.median(view.sigma)) / view.score)
            views = views[: config.cameras]
            chosen = sorted(view.camera_id for view in views)
        if not views:
            dropped.append({"what": expression, "why": "no camera sees a face"})
            continue
        observation, refused = agree(expression, peaks[expression], views)
        for camera_id in refused:
            why = "its landmarks disagree with the other cameras"
            dropped.append({"what": f"{expression}/{camera_id}", "why": why})
        if observation.inliers.sum(1).max() < config.min_landmarks:
            count = int(observation.inliers.sum(1).max())
            dropped.append({"what": expression, "why": f"{count} landmarks agree between cameras"})
            continue
        found[expression] = observation
    return [found[name] for name in peaks if name in found]


def _views(
    dataset: Dataset,
    subject: str,
    cameras: dict[str, Camera],
    frame: int,
    source: Source,
    config: TrackConfig,
) -> list[View]:
    """Views with a face in them; a camera whose footage lacks the frame is skipped.

    Raises:
        CaptureError: no camera's footage has it.
    """
    views, missing = [], []
    for camera_id, camera in cameras.items():
        try:
            image = read_frame(dataset, subject, camera_id, frame)
        except CaptureError as error:
            missing.append(error)
            continue
        seen = source(image, camera_id, frame)
        if seen.face.score >= config.min_score:
            views.append(make_view(camera, seen))
    if missing and len(missing) == len(cameras):
        raise missing[0]
    return views


def _targets(
    basis: Basis,
    observations: list[Observation],
    config: TrackConfig,
    dropped: list[dict[str, str]],
) -> tuple[list[Target], list[tuple[np.ndarray, np.ndarray]]]:
    """Fit targets with their initial rotation and translation."""
    template = landmarks(basis.model, basis.model.template[None])[0].numpy()
    targets, poses = [], []
    for observation in observations:
        try:
            pose_found = initial_pose(observation, template)
        except StageError as error:
            if "rig seems" in str(error):
                raise
            dropped.append({"what": observation.expression, "why": str(error)})
            continue
        poses.append(pose_found)
        sigma = landmark_sigma(observation, config)
        # From behind, the detector can only guess; the pose tells which views those are.
        behind = [facing(view, *pose_found) < MIN_FACING for view in observation.views]
        sigma[np.array(behind)] = np.inf
        neutral = observation.expression == config.neutral
        targets.append(Target(observation, sigma, neutral))
    return targets, poses


def _moments(
    dataset: Dataset, subject: str, targets: list[Target], meshes: np.ndarray, config: TrackConfig
) -> list[Moment]:
    """Outlines and crops of every expression, of all cameras: those behind it see the skull."""
    cameras = read_cameras_of(dataset, subject)
    moments = []
    for target, mesh in zip(targets, meshes, strict=True):
        observation = target.observation
        distances, shots = [], []
        for camera_id, camera in cameras.items():
            path = dataset.matte_file(subject, observation.expression, camera_id)
            alpha = read_alpha(path) if path.is_file() else None
            if alpha is not None and config.silhouette_rounds:
                distances.append(signed_distance(alpha, camera))
            if config.photo_rounds or config.relief_rounds:
                shots.append(
                    _shot(dataset, subject, camera, observation.frame, alpha, mesh, config)
                )
        moments.append(
            Moment(tuple(d for d in distances if d), tuple(shot for shot in shots if shot))
        )
    return moments


def _shot(
    dataset: Dataset,
    subject: str,
    camera: Camera,
    frame: int,
    alpha: np.ndarray | None,
    mesh: np.ndarray,
    config: TrackConfig,
) -> Shot | None:
    """A camera's crop about the head; None where its footage lacks the frame or the head."""
    try:
        image = read_frame(dataset, subject, camera.id, frame)
    except CaptureError:
        return None
    return cut_shot(camera, image, alpha, mesh, config.photo_side)


def _marks(model: HeadModel, state: State) -> np.ndarray:
    """Fitted landmarks (E, 68, 3) in the world."""
    return landmarks(model, torch.from_numpy(all_vertices(model, state))).numpy()


def _write_track(
    path: Path,
    head: str,
    basis: Basis,
    targets: list[Target],
    state: State,
    vertices: np.ndarray,
) -> None:
    """Write track.npz; no pickled objects."""
    own = np.stack([item.own for item in state.poses])
    count = basis.expression_size
    shape, offsets = split_shape(basis.model, state.shape)
    arrays = {
        "schema": np.array(SCHEMA),
        "head": np.array(head),
        "expressions": np.array([target.observation.expression for target in targets]),
        "frames": np.array([target.observation.frame for target in targets], dtype=np.int64),
        "shape": shape,
        "offsets": offsets.astype(np.float32),
        "expression": own[:, :count],
        "neck": own[:, count : count + 3],
        "jaw": own[:, count + 3 : count + 6],
        "eyes": own[:, count + 6 : count + 12],
        "R": np.stack([item.rotation for item in state.poses]),
        "t": own[:, -3:],
        "vertices": vertices.astype(np.float32),
    }
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StageError(f"{name} holds NaN or infinite values; the fit diverged")
    np.savez(path, **arrays)  # type: ignore[arg-type]  # numpy types its options only


def _metrics(
    model: HeadModel, targets: list[Target], vertices: np.ndarray, dropped: list[dict[str, str]]
) -> dict:
    """Reprojection of inlier landmarks, RMS pixels by expression and camera."""
    marks = landmarks(model, torch.from_numpy(vertices)).numpy()
    table: dict[str, dict[str, float]] = {}
    used, total = 0, 0
    for target, points in zip(targets, marks, strict=True):
        row = {}
        for view, inliers in zip(target.observation.views, target.observation.inliers, strict=True):
            pixels, _ = project_pinhole(view.camera, points)
            squared = ((pixels - view.points) ** 2).sum(1)
            chosen = inliers.copy()
            chosen[:17] = False
            if chosen.any():
                row[view.camera_id] = round(float(np.sqrt(squared[chosen].mean())), 4)
            used, total = used + int(inliers.sum()), total + inliers.size
        table[target.observation.expression] = row
    values = [value for row in table.values() for value in row.values()]
    return {
        "expressions": len(targets),
        "landmark_rms_px": table,
        "landmark_rms_px_mean": round(float(np.mean(values)), 4) if values else None,
        "landmarks_used": used,
        "landmarks_seen": total,
        "outline_views": _count(targets, Outline),
        "marked_views": _count(targets, Marks),
        "head": model.name,
        "dropped": dropped,
    }


def _count(targets: list[Target], kind: type) -> int:
    return sum(isinstance(one, kind) for target in targets for one in target.outlines)


STAGE = Stage(
    name="track",
    version=2,
    config=TrackConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
)
