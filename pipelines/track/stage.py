"""The track stage: detect, triangulate, align, fit; writes track.npz and overlays."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from express50.capture.frames import frame_inputs, read_cameras_of, read_peaks
from express50.capture.index import index_path, read_index
from express50.contract.layout import Dataset
from express50.errors import ConfigError, StageError
from express50.head.load import load_head
from express50.head.model import HeadModel, landmarks
from express50.landmarks.sources import Source, source_files
from pipelines.track.bake import write_texture
from pipelines.track.chart.network import WEIGHTS as CHART_WEIGHTS
from pipelines.track.clips import write_clips
from pipelines.track.config import TrackConfig
from pipelines.track.fit import consistent_sigma, fit
from pipelines.track.footage import (
    frame_moment,
    observe_frame,
    observe_peaks,
    open_landmarks,
    peak_moments,
)
from pipelines.track.frame import held_to_pictures
from pipelines.track.lids import lid_terms, shut_lids
from pipelines.track.marks import Eyes, measure_eyes
from pipelines.track.observe import Observation
from pipelines.track.offsets import with_modes
from pipelines.track.overlay import draw_overlays
from pipelines.track.pictures import Skin, skin_of
from pipelines.track.refine import refine
from pipelines.track.result import track_metrics, write_track
from pipelines.track.sequence import Closer
from pipelines.track.sheet import write_sheet
from pipelines.track.sparse_head import Basis, make_basis
from pipelines.track.start import RigScaleError, initial_pose, posed_sigma
from pipelines.track.state import Pose, State, Target, all_vertices, rotations, rounded, start_state
from pipelines.track.suspects import suspect_cameras, warnings

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
    for expression in read_peaks(dataset, item):
        found |= frame_inputs(dataset, item, expression)
    mattes = dataset.item_dir("matte", item)
    rounds = (config.silhouette_rounds, config.relief_rounds, config.photo_rounds)
    if any(rounds) and mattes.is_dir():
        found["mattes"] = mattes
    if config.chart_rounds:
        found["chart"] = CHART_WEIGHTS
    if config.head != "procedural":
        found["head"] = Path(config.head).expanduser()
    for name, setting in (("head", "head"), ("landmarks", "landmarks"), ("fan", "landmarks")):
        if name in found and not Path(found[name]).exists():
            raise ConfigError(
                f"track.{setting} is {getattr(config, setting)}: there is no such file; give its"
                " path, or leave the setting out"
            )
    return found


def run(dataset: Dataset, item: str, config: TrackConfig, out: Path) -> dict:
    """Track one subject; see the module docstring of `fit` for the method."""
    torch.set_num_threads(1)
    cameras = read_cameras_of(dataset, item)
    dropped: list[dict[str, str]] = []
    basis = _basis(config)
    source = open_landmarks(dataset, item, config)
    observations = observe_peaks(dataset, item, cameras, source, config, dropped)
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
    moments = peak_moments(dataset, item, targets, meshes, config)
    state, targets, appearance = refine(basis, targets, state, moments, eyes, config)
    state = rounded(state, DECIMALS)
    vertices = all_vertices(basis.model, state)
    write_track(out / "track.npz", config.head, basis, targets, state, vertices)
    if appearance is not None and config.texture_side:
        write_texture(out, basis.model, targets, vertices, moments, appearance, config.texture_side)
    metrics = track_metrics(basis.model, targets, vertices, dropped)
    turns = rotations(state)
    tiles = draw_overlays(dataset, item, out / "qc", basis.model, targets, vertices, turns)
    write_sheet(out / "qc", tiles, metrics["landmark_rms_px"])
    marks = _marks(basis.model, state)
    suspects = suspect_cameras(targets, marks, turns, vertices.mean(1))
    metrics |= {"suspect_cameras": suspects, "warnings": warnings(suspects)}
    if config.frames == "clips":
        skin = None
        if config.clip_rounds and appearance is not None:
            skin = skin_of(basis.model, moments, vertices, appearance, config)
        clips = _clips(dataset, item, basis, state, observations, source, eyes, skin, config, out)
        clips["held_to_pictures"] = skin is not None
        metrics |= {"dropped": dropped + clips.pop("dropped"), "clips": clips}
    return metrics


def _clips(
    dataset: Dataset,
    subject: str,
    basis: Basis,
    state: State,
    peaks: list[Observation],
    source: Source,
    eyes: Eyes | None,
    skin: Skin | None,
    config: TrackConfig,
    out: Path,
) -> dict:
    """Write sequence.npz: every frame of the cue windows with the peaks' shape."""
    cameras = read_cameras_of(dataset, subject)

    def observe(cue: str, frame: int) -> Observation | None:
        found = observe_frame(dataset, subject, cameras, cue, frame, source, config)
        # A clip may be one long blink: the peaks tell what open eyes look like.
        return None if found is None else shut_lids([found], peaks)[0]

    closer = None
    if skin is not None:
        closer = _closer(dataset, subject, skin, config)
    keep = dataset.windows_dir(subject)
    paths, cues = inputs(dataset, subject, config), read_index(dataset, subject).cues
    return write_clips(out, basis, state, cues, observe, config, keep, paths, eyes, closer)


def _closer(dataset: Dataset, subject: str, skin: Skin, config: TrackConfig) -> Closer:
    """What holds a clip's frames to their pictures."""
    cameras = read_cameras_of(dataset, subject)

    def closer(person: Basis, target: Target, pose: Pose) -> tuple[Target, Pose]:
        mesh = all_vertices(person.model, State(np.zeros(0), (pose,)))[0]
        frame = target.observation.frame
        moment = frame_moment(dataset, subject, cameras, frame, mesh, config)
        return held_to_pictures(person, target, pose, moment, skin, config)

    return closer


def _basis(config: TrackConfig) -> Basis:
    # Only the chart can tell where along itself the skin is.
    along = config.offset_along if config.chart_rounds else 0
    offsets = (config.offset_modes, config.offset_sigma, config.offset_length, along)
    return _basis_of(config.head, *offsets)


@lru_cache(maxsize=2)
def _basis_of(head: str, modes: int, sigma: float, length: float, along: int) -> Basis:
    return make_basis(with_modes(load_head(head), modes, sigma, length, along))


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
        except RigScaleError:
            raise
        except StageError as error:
            dropped.append({"what": observation.expression, "why": str(error)})
            continue
        poses.append(pose_found)
        sigma = posed_sigma(observation, config, *pose_found)
        neutral = observation.expression == config.neutral
        targets.append(Target(observation, sigma, neutral, terms=lid_terms(observation)))
    return targets, poses


def _marks(model: HeadModel, state: State) -> np.ndarray:
    """Fitted landmarks (E, 68, 3) in the world."""
    return landmarks(model, torch.from_numpy(all_vertices(model, state))).numpy()
