"""The track stage: detect, triangulate, fit to landmarks, refine in rounds, write, check.

docs/TRACKING.md describes the method.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from express50.capture.frames import read_cameras_of
from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.errors import StageError
from express50.files.digests import path_digest, value_digest
from express50.head.load import load_head
from express50.head.model import HeadModel, landmarks
from express50.landmarks.sources import Source
from pipelines.track.appearance import write_texture
from pipelines.track.basis import Basis, make_basis, split_shape, with_modes
from pipelines.track.clips import write_clips
from pipelines.track.config import TrackConfig
from pipelines.track.eyes_and_jaw import lid_terms, measure_eyes, shut_lids
from pipelines.track.fit import consistent_sigma, fit
from pipelines.track.observe import Observation
from pipelines.track.read_inputs import (
    frame_pictures,
    observe_frame,
    observe_peaks,
    open_landmarks,
    peak_pictures,
)
from pipelines.track.report import draw_overlays, track_metrics, write_sheet
from pipelines.track.schedule import (
    LANDMARK_STEPS,
    gather,
    make_schedule,
    refine,
    schedule_table,
)
from pipelines.track.sequence import ClipTracker, freeze_shape
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
from pipelines.track.suspects import camera_warnings, suspect_cameras

SCHEMA = "express50.track/2"
DECIMALS = 7
# Modes along the skin, for each of three axes, per mode along the normals: the skin's texture
# locates it less finely than patches do.
ALONG_SHARE = 4 / 15


def run(
    dataset: Dataset,
    item: str,
    config: TrackConfig,
    out: Path,
    inputs: Mapping[str, Path | str],
) -> Result:
    """Track one subject; `inputs` is what the item reads, as the stage declares it.

    Raises:
        StageError: no expression shows a face, or the rig's unit is not the metre.
    """
    torch.set_num_threads(1)
    schedule = make_schedule(config.outline_rounds, config.patch_rounds, config.uv_rounds)
    cameras = read_cameras_of(dataset, item)
    # Only the UV map can show where along itself the skin is.
    along = round(ALONG_SHARE * config.offset_modes) if config.uv_rounds else 0
    basis = _basis(config.head, config.offset_modes, along)
    source = open_landmarks(dataset, item, config.landmarks, config.search)
    peaks, dropped = observe_peaks(dataset, item, cameras, source, config.neutral, config.cameras)
    targets, state, lost = fit_landmarks(basis, peaks, config.neutral)
    dropped += lost
    if not targets:
        reasons = "; ".join(f"{note.what}: {note.why}" for note in dropped[:3])
        raise StageError(f"{item}: no expression could be tracked ({reasons})")
    meshes = all_vertices(basis.model, state)
    eyes = measure_eyes(basis.model, targets, meshes, rotations(state))
    pictures = [
        peak_pictures(dataset, item, target.observation, mesh, config.photo_side)
        for target, mesh in zip(targets, meshes, strict=True)
    ]
    evidence = gather(basis.model, pictures, meshes, eyes, config.samples, schedule)
    state, targets = refine(basis, targets, state, evidence, schedule)
    state = rounded(state, DECIMALS)
    meshes, turns = all_vertices(basis.model, state), rotations(state)
    write_track(out / "track.npz", config.head, basis, targets, state, meshes)
    if config.texture_side:
        sides = (config.samples, config.texture_side)
        write_texture(out, basis.model, targets, meshes, pictures, *sides)
    metrics = track_metrics(basis.model, targets, meshes)
    tiles = draw_overlays(dataset, item, out / "qc", basis.model, targets, meshes, turns)
    write_sheet(out / "qc", tiles, metrics["landmark_rms_px"])
    suspects = suspect_cameras(targets, _marks(basis.model, state), turns, meshes.mean(1))
    metrics |= {"schedule": schedule_table(schedule), "suspect_cameras": suspects}
    if config.frames == "clips":
        person = freeze_shape(basis, state.shape, state.bias)
        tracker = ClipTracker(
            person, config.stride, eyes, evidence.skin, evidence.uv_map, rounds=config.clip_rounds
        )
        shape = split_shape(basis.model, state.shape)[0]
        digests = {k: path_digest(v) if isinstance(v, Path) else v for k, v in inputs.items()}
        identity = f"{value_digest(digests)} {asdict(config)}"
        clips = _clips(dataset, item, tracker, shape, peaks, source, config, out, identity)
        metrics["clips"], lost = clips
        dropped += lost
    return Result(metrics, dropped, camera_warnings(suspects))


def fit_landmarks(
    basis: Basis, peaks: list[Observation], neutral: str
) -> tuple[list[Target], State, list[Note]]:
    """Fit to landmarks alone and leave out those that contradict the fit.

    Returns:
        Targets, the fitted state, and the expressions without a start.

    Raises:
        RigScaleError: the rig's unit is not the metre.
    """
    template = landmarks(basis.model, basis.model.template[None])[0].numpy()
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
        terms = lid_terms(basis.model, observation)
        sigma = posed_sigma(observation, *pose)
        targets.append(Target(observation, sigma, observation.expression == neutral, terms))
    state = start_state(basis, poses)
    if targets:
        state, _ = fit(basis, targets, state, LANDMARK_STEPS)
        targets = [
            replace(target, sigma=consistent_sigma(target, marks))
            for target, marks in zip(targets, _marks(basis.model, state), strict=True)
        ]
    return targets, state, lost


def write_track(
    path: Path,
    head: str,
    basis: Basis,
    targets: list[Target],
    state: State,
    vertices: np.ndarray,
) -> None:
    """Write track.npz (docs/FORMAT.md); no pickled objects."""
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
        "R": rotations(state),
        "t": own[:, -3:],
        "vertices": vertices.astype(np.float32),
    }
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StageError(f"{name} holds NaN or infinite values; the fit diverged")
    np.savez(path, **arrays)  # type: ignore[arg-type]  # numpy types its options only


def _clips(
    dataset: Dataset,
    subject: str,
    tracker: ClipTracker,
    shape: np.ndarray,
    peaks: list[Observation],
    source: Source,
    config: TrackConfig,
    out: Path,
    identity: str,
) -> tuple[dict, list[Note]]:
    """Write sequence.npz: every frame of the cue windows with the peaks' shape."""
    cameras = read_cameras_of(dataset, subject)

    def observe(cue: str, frame: int) -> Observation | None:
        found = observe_frame(dataset, subject, cameras, cue, frame, source)
        # A clip may be one long blink: the peaks show what open eyes look like.
        return None if found is None else shut_lids([found], peaks)[0]

    tracker = replace(
        tracker,
        pictures=lambda frame, mesh: frame_pictures(
            dataset, subject, frame, mesh, config.photo_side
        ),
    )
    # The peaks' fit follows from the inputs and settings, up to how the machine rounds.
    fitted = (shape.tobytes(), tracker.person.bias.tobytes())
    identity = repr((identity, fitted, tracker.eyes and vars(tracker.eyes)))
    keep, cues = dataset.windows_dir(subject), read_index(dataset, subject).cues
    return write_clips(out, tracker, config.head, shape, cues, observe, keep, identity)


@lru_cache(maxsize=2)
def _basis(head: str, modes: int, along: int) -> Basis:
    return make_basis(with_modes(load_head(head), modes, along))


def _marks(model: HeadModel, state: State) -> np.ndarray:
    """Return the fitted landmarks (E, 68, 3), world."""
    return landmarks(model, torch.from_numpy(all_vertices(model, state))).numpy()
