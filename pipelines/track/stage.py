"""Track a subject: detect, triangulate, fit to landmarks, refine in rounds, write, check.

docs/TRACKING.md describes the method.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch

from express50.capture.frames import read_cameras_of
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.contract.stage import ExpectedError, Note, Result
from express50.dataset.tracks import LARGEST_SPREAD, SCHEMA, shape_spread
from express50.error_model import Bounds, error_bounds, error_models, expect, single_camera_sigma
from express50.errors import StageError
from express50.files.digests import path_digest, value_digest
from express50.geometry.cameras import Camera
from express50.head.load import load_head
from express50.head.model import landmarks, landmarks_of
from pipelines.track.appearance import write_texture
from pipelines.track.basis import Basis, freeze_shape, make_basis, split_shape, with_modes
from pipelines.track.config import TrackConfig
from pipelines.track.eyes_and_jaw import shut_terms
from pipelines.track.fit import consistent_sigma, fit, vertex_sigma
from pipelines.track.observe import Observation
from pipelines.track.read_inputs import observe_peaks, open_follower, open_landmarks, read_clip
from pipelines.track.report import draw_overlays, error_figures, track_metrics, write_sheet
from pipelines.track.schedule import (
    LANDMARK_STEPS,
    SubjectEvidence,
    free_modes,
    make_schedule,
    read_evidence,
    refine,
    schedule_table,
)
from pipelines.track.sequence import ClipTracker, pose_arrays, write_clips, write_npz
from pipelines.track.state import (
    RigScaleError,
    State,
    Target,
    all_vertices,
    initial_pose,
    posed_sigma,
    rotations,
    rounded,
    start_state,
)
from pipelines.track.terms import Term

# Number of modes along the skin (for each of three axes) per mode along the normals: texture
# locates the skin less finely than patches do.
ALONG_SHARE = 4 / 15


def run(
    dataset: Dataset, item: str, config: TrackConfig, out: Path, inputs: Mapping[str, Path | str]
) -> Result:
    """Track one subject; `inputs` is what the item reads, as the stage declares it.

    Raises:
        StageError: no expression shows a face, or the rig's unit is not the metre.
    """
    torch.set_num_threads(1)
    schedule = make_schedule(config.outline_rounds, config.patch_rounds, config.uv_rounds)
    # Only the UV map shows how the skin slides along itself.
    along = round(ALONG_SHARE * config.offset_modes) if config.uv_rounds else 0
    basis = _basis(config.head, config.offset_modes, along)
    model, cameras = basis.model, read_cameras_of(dataset, item)
    peaks, dropped = observe_peaks(
        dataset, item, config.landmarks, config.search, config.neutral, config.cameras
    )
    targets, state, lost = fit_landmarks(basis, peaks, config.neutral)
    dropped += lost
    if not targets:
        reasons = "; ".join(map(str, dropped[:3]))
        raise StageError(f"{item}: no expression could be tracked ({reasons})")
    evidence = read_evidence(dataset, item, config, model, targets, state, schedule)
    state, targets, glasses = refine(basis, targets, state, evidence, schedule)
    state = rounded(state)
    meshes = all_vertices(model, state)
    metrics = track_metrics(model, targets, meshes)
    sigma = vertex_sigma(basis, targets, state, free_modes(targets))
    bounds = stated_bounds(cameras, sigma, meshes, metrics)
    uncertainty = {"sigma": sigma, "bound": 1e-3 * np.stack([one.bound for one in bounds])}
    write_track(out / "track.npz", config.head, basis, targets, state, meshes, uncertainty, glasses)
    if config.texture_side:
        sides = (config.samples, config.texture_side)
        write_texture(out, model, targets, meshes, evidence.pictures, *sides)
    tiles = draw_overlays(dataset, item, out / "qc", model, targets, meshes, rotations(state))
    write_sheet(out / "qc", tiles, metrics["landmark_rms_px"])
    metrics["schedule"] = schedule_table(schedule)
    if config.frames == "clips":
        metrics["clips"], lost = track_clips(
            dataset, item, config, out, inputs, basis, state, evidence, peaks
        )
        dropped += lost
    strange = shape_warnings(split_shape(model, state.shape)[0])
    # The error model knows people only: it cannot judge such a head.
    expected = None if strange else expected_error(cameras, meshes, bounds)
    return Result(metrics, dropped, single_view_warnings(peaks, cameras) + strange, expected)


def track_clips(
    dataset: Dataset,
    item: str,
    config: TrackConfig,
    out: Path,
    inputs: Mapping[str, Path | str],
    basis: Basis,
    state: State,
    evidence: SubjectEvidence,
    peaks: list[Observation],
) -> tuple[dict, list[Note]]:
    """Track the cue windows with the shape of the peaks' fit; return metrics and dropped frames."""
    person = freeze_shape(basis, state.shape, state.bias)
    eyes, skin, uv_map = evidence.eyes, evidence.skin, evidence.uv_map
    tracker = ClipTracker(person, config.stride, eyes, skin, uv_map, config.clip_rounds)
    source = open_landmarks(dataset, item, config.landmarks, config.search)
    follow = open_follower(config.landmarks)
    read = partial(read_clip, dataset, item, source, follow, peaks, config.photo_side)
    shape, index = split_shape(basis.model, state.shape)[0], read_index(dataset, item)
    # A run reuses the windows of an interrupted one that has the same identity, so this changes
    # with everything clips are tracked from. The peaks' fit counts because machines round
    # differently.
    fitted = (shape.tobytes(), state.bias.tobytes(), eyes and vars(eyes))
    digests = {k: path_digest(v) if isinstance(v, Path) else v for k, v in inputs.items()}
    identity = repr((value_digest(digests), asdict(config), fitted))
    return write_clips(
        out, tracker, config.head, shape, index.cues, index.fps, read, dataset.windows_dir(item),
        identity,
    )  # fmt: skip


def shape_warnings(shape: np.ndarray) -> list[Note]:
    """Warn of a shape that no person has; its coefficients (K,) are in standard deviations."""
    spread = shape_spread(shape)
    if spread <= LARGEST_SPREAD:
        return []
    why = (
        f"its coefficients are {math.ceil(100 * spread) / 100:.2f} standard deviations on average"
        f" (people's are about 0.5, expected {LARGEST_SPREAD} at most), so cameras,"
        " synchronisation, mattes or landmarks are wrong, and no error is stated; look at"
        " qc/overlay_*.jpg"
    )
    return [Note("head shape", why)]


def single_view_warnings(peaks: Sequence[Observation], cameras: Mapping[str, Camera]) -> list[Note]:
    """Warn of peaks whose face only one of several cameras sees."""
    why = (
        "landmarks were found in {1} alone of {0} cameras, so the face's distance from it is less"
        " sure; something may cover the face, as a mask does, or it turns away from the others"
    )
    return [
        Note(peak.expression, why.format(len(cameras), peak.views[0].camera_id))
        for peak in peaks
        if len(peak.views) == 1 < len(cameras)
    ]


def stated_bounds(
    cameras: Mapping[str, Camera], sigma: np.ndarray, meshes: np.ndarray, metrics: dict
) -> list[Bounds]:
    """Bound the vertices' errors of every expression, millimetres, from sigma (E, V), metres."""
    rows = zip(sigma, meshes, metrics["landmark_rms_px"].values(), strict=True)
    return [
        error_bounds(
            "track",
            error_figures(own, mesh, cameras, marks, metrics["outline_views"]),
            single_camera_sigma(list(cameras.values()), mesh),
        )
        for own, mesh, marks in rows
    ]


def expected_error(
    cameras: Mapping[str, Camera], meshes: np.ndarray, bounds: list[Bounds]
) -> ExpectedError | None:
    """State the error of a subject's vertices (E, V, 3) by their bounds."""
    shared = single_camera_sigma(list(cameras.values()), meshes.reshape(-1, 3))
    return expect(error_models()["track"], np.concatenate([one.typical for one in bounds]), shared)


def fit_landmarks(
    basis: Basis, peaks: list[Observation], neutral: str, further: tuple[Term, ...] = ()
) -> tuple[list[Target], State, list[Note]]:
    """Fit to landmarks alone and leave out those that contradict the fit.

    `further` terms are added to those of every expression. The third value are the expressions
    without a start.

    Raises:
        RigScaleError: the rig's unit is not the metre.
    """
    template = landmarks_of(basis.model)
    targets, poses, lost = [], [], []
    for observation in peaks:
        try:
            pose = initial_pose(observation, template)
        except RigScaleError:
            raise
        except StageError as error:
            lost.append(Note(observation.expression, str(error)))
            continue
        poses.append(pose)
        terms = (*shut_terms(basis.model, observation), *further)
        sigma = posed_sigma(observation, *pose)
        targets.append(Target(observation, sigma, observation.expression == neutral, terms))
    state = start_state(basis, poses)
    if targets:
        state, _ = fit(basis, targets, state, LANDMARK_STEPS)
        marks = landmarks(basis.model, torch.from_numpy(all_vertices(basis.model, state)))
        targets = [
            replace(target, sigma=consistent_sigma(target, points))
            for target, points in zip(targets, marks.numpy(), strict=True)
        ]
    return targets, state, lost


def write_track(
    path: Path,
    head: str,
    basis: Basis,
    targets: list[Target],
    state: State,
    vertices: np.ndarray,
    uncertainty: Mapping[str, np.ndarray] | None = None,
    glasses: Sequence[np.ndarray] = (),
) -> None:
    """Write track.npz (docs/FORMAT.md).

    `uncertainty` holds the vertices' deviations and bounds (E, V), `glasses` the places (n, 3) on
    every expression's glasses, if they were looked for.
    """
    shape, offsets = split_shape(basis.model, state.shape)
    arrays = {
        "schema": np.array(SCHEMA),
        "head": np.array(head),
        "expressions": np.array([target.observation.expression for target in targets]),
        "frames": np.array([target.observation.frame for target in targets], dtype=np.int64),
        "shape": shape,
        "offsets": offsets.astype(np.float32),
    }
    arrays |= pose_arrays(state.poses, basis.expression_size)
    further = {"vertices": vertices, **(uncertainty or {})}
    if len(glasses):
        further["glasses"] = np.concatenate(glasses)
        arrays["glasses_row"] = np.repeat(np.arange(len(glasses)), [len(one) for one in glasses])
    write_npz(path, arrays | {name: array.astype(np.float32) for name, array in further.items()})


@lru_cache(maxsize=2)
def _basis(head: str, modes: int, along: int) -> Basis:
    return make_basis(with_modes(load_head(head), modes, along))
