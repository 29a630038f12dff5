"""Gather, per element of a result, the figures that a stage knows and the error that it made.

The figures are those that the stages themselves compute, from what they have published; errors are
against the twin's truth.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from annotations.align.stage import error_figures as peak_figures
from annotations.suggestions import read_suggestions
from benchmarks.truth import Truth, align_worlds
from express50.capture.expressions import NEUTRAL
from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.capture.index import read_peaks
from express50.contract.layout import Dataset
from express50.dataset.tracks import read_registration, read_track
from express50.error_model import HEAD_SIZE_SPREAD, ErrorModel, error_bounds, single_camera_sigma
from express50.files.images import read_alpha
from express50.geometry.cameras import Camera, transform_camera
from express50.geometry.meshes import read_surface
from express50.geometry.pixels import shrink
from express50.geometry.transforms import transform_points
from express50.head.load import load_head
from pipelines.depth.maps import picture_of, surface_maps
from pipelines.depth.prior import close_mesh
from pipelines.depth.surface import HeadSurface
from pipelines.matte.stage import SHOWN, rim_figures, rim_of, wall_noise
from pipelines.register.lay import LaidMesh, mesh_normals
from pipelines.register.stage import error_figures as laid_figures
from pipelines.register.stage import sigma_along_normals
from pipelines.track.report import error_figures as track_figures

SAMPLES = 6000  # elements of an item at most
TRACK = "track "  # before the names of the track's figures

Figures = dict[str, np.ndarray | float]


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Elements of one item."""

    stage: str
    item: str
    figures: dict[str, np.ndarray]  # by name (N,)
    errors: np.ndarray  # (N,) true ones
    shared: np.ndarray  # (N,) deviations that all elements share, as `error_bounds` takes them
    # (N,) where the truth shows the head's own surface; for depth only
    skin: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))


def sampled(
    stage: str,
    item: str,
    parts: Sequence[Figures],
    errors: Sequence[np.ndarray],
    shared: Sequence[np.ndarray] | None = None,
    **further: Sequence[np.ndarray],
) -> Sample:
    """Join the elements of an item's parts, and draw at most SAMPLES of them."""
    every = np.concatenate(errors)
    kept = np.random.default_rng(0).permutation(len(every))[:SAMPLES]
    figures = {
        name: np.concatenate(
            [np.broadcast_to(p[name], e.shape) for p, e in zip(parts, errors, strict=True)]
        )
        for name in parts[0]
    }
    joined = {name: np.concatenate(list(values))[kept] for name, values in further.items()}
    common = np.zeros(len(every)) if shared is None else np.concatenate(shared)
    return Sample(
        stage=stage,
        item=item,
        figures={name: values[kept].astype(np.float64) for name, values in figures.items()},
        errors=every[kept].astype(np.float64),
        shared=common[kept],
        **joined,
    )


def row_samples(dataset: Dataset, truth: Truth) -> Iterator[Sample]:
    """Yield the samples of mattes, depth, tracks and registrations of a row."""
    for subject in dataset.subjects():
        seen = read_cameras_of(dataset, subject)
        motion = align_worlds(seen, truth.cameras(subject))
        for expression, frame in read_peaks(dataset, subject).items():
            item = _Peak(dataset, truth, subject, expression, frame, seen, motion)
            for gather in (_matte, _depth, _meshes):
                yield from gather(item)


@dataclass(frozen=True)
class _Peak:
    """One expression of a subject; `motion` (4, 4) takes the estimated world to the true one."""

    dataset: Dataset
    truth: Truth
    subject: str
    expression: str
    frame: int
    cameras: dict[str, Camera]
    motion: np.ndarray

    @property
    def name(self) -> str:
        return f"{self.subject}/{self.expression}"

    def folder(self, stage: str) -> Path:
        return self.dataset.item_dir(stage, self.name)

    def true_camera(self, name: str) -> Camera:
        return transform_camera(self.cameras[name], self.motion)

    def moved(self, points: np.ndarray) -> np.ndarray:
        return transform_points(self.motion, points)

    def alpha(self, name: str) -> np.ndarray:
        return read_alpha(self.dataset.matte_file(self.subject, self.expression, name))

    def frame_of(self, name: str) -> np.ndarray:
        return read_peak_frame(self.dataset, self.subject, self.expression, name)


def _matte(peak: _Peak) -> Iterator[Sample]:
    file = peak.folder("matte") / "metrics.json"
    if not file.is_file():
        return
    facts = json.loads(file.read_text())
    parts, errors = [], []
    for name in facts["coverage"]:
        alpha, frame = peak.alpha(name), peak.frame_of(name)
        plated, noise = name not in facts["without_plate"], wall_noise(alpha, frame)
        rgb = shrink(frame, SHOWN)
        parts.append(rim_figures(alpha, rgb, noise, plated, len(facts["coverage"])))
        true = peak.truth.render_alpha(peak.subject, peak.frame, peak.true_camera(name))
        errors.append(np.abs(alpha / 255 - true)[rim_of(alpha)])
    yield sampled("matte", peak.name, parts, errors)


def _depth(peak: _Peak) -> Iterator[Sample]:
    folder = peak.folder("depth")
    if not (folder / "surface.ply").is_file():
        return
    cv2.setNumThreads(1)
    surface, solid = _surface(folder), None
    if surface.figures["track"]["used"]:
        track = read_track(peak.dataset.track_file(peak.subject))
        mesh = track.vertices[track.row(peak.expression)].astype(np.float64)
        solid = close_mesh(mesh, load_head(track.head).faces.numpy())
    names = surface.figures["cameras"]
    pictures = [picture_of(peak.cameras[n], peak.frame_of(n), peak.alpha(n)) for n in names]
    parts, errors, shared, skin = [], [], [], []
    lone = HEAD_SIZE_SPREAD if len(pictures) == 1 else 0.0
    for name, view, _ in surface_maps(surface, pictures, solid):
        place = peak.subject, peak.frame, peak.true_camera(name)
        true, there = (values[view.window] for values in peak.truth.render_depth(*place))
        both = there[view.valid]
        parts.append({k: np.broadcast_to(v, both.shape)[both] for k, v in view.figures.items()})
        errors.append(1e3 * np.abs(view.depth - true)[view.valid & there])
        shared.append(1e3 * lone * view.depth[view.valid & there])
        skin.append(peak.truth.skin(*place)[view.window][view.valid & there])
    yield sampled("depth", peak.name, parts, errors, shared, skin=skin)


def _surface(folder: Path) -> HeadSurface:
    """Read what the depth stage wrote, without the grid."""
    path = folder / "surface.ply"
    found, point = read_surface(path), o3d.t.io.read_point_cloud(str(path), format="ply").point
    figures = json.loads((folder / "metrics.json").read_text())
    normals = point["normals"].numpy().astype(np.float64)
    sure = found.confidence.astype(np.float32)
    parts = found.vertices, normals, found.faces, sure, found.colors
    return HeadSurface(*parts, None, figures)  # type: ignore[arg-type]


@dataclass(frozen=True)
class _Mesh:
    """A tracked or registered mesh (V, 3), its figures, and what its errors have in common."""

    vertices: np.ndarray
    figures: Figures
    shared: np.ndarray


def _meshes_of(
    dataset: Dataset, subject: str, expression: str, cameras: dict[str, Camera]
) -> dict[str, _Mesh]:
    """Return the tracked and the registered mesh of an expression by stage, those that are made."""
    path, found = dataset.track_file(subject), {}
    if not path.is_file():
        return {}
    track, facts = read_track(path), json.loads((path.parent / "metrics.json").read_text())
    if expression not in track.expressions:
        return {}
    row, views = track.row(expression), list(cameras.values())
    mesh, marks = track.vertices[row].astype(np.float64), facts["landmark_rms_px"][expression]
    tracked = track_figures(track.sigma[row], mesh, cameras, marks, facts["outline_views"])
    found["track"] = _Mesh(mesh, tracked, single_camera_sigma(views, mesh))
    path = dataset.registration_file(subject, expression)
    if path.is_file():
        one = read_registration(path)
        laid = LaidMesh(one.vertices.astype(np.float64), one.seen, one.residual, one.sigma)
        # What the track states is fitted first, and is then a figure of the registration.
        figures = laid_figures(laid, track, row) | {f"{TRACK}{k}": v for k, v in tracked.items()}
        shared = sigma_along_normals(laid, views, load_head(track.head))
        found["register"] = _Mesh(laid.vertices, figures, shared)
    return found


def _meshes(peak: _Peak) -> Iterator[Sample]:
    true, model = peak.truth.vertices(peak.subject, peak.frame), peak.truth.head_model(peak.subject)
    normals = mesh_normals(true.astype(np.float64), model.faces)
    place = peak.dataset, peak.subject, peak.expression, peak.cameras
    for stage, mesh in _meshes_of(*place).items():
        if true.shape != mesh.vertices.shape:  # another head model: no vertex has a true place
            return
        off = peak.moved(mesh.vertices) - true
        apart = np.linalg.norm(off, axis=1) if stage == "track" else np.abs((off * normals).sum(1))
        yield sampled(stage, peak.name, [mesh.figures], [1e3 * apart], [mesh.shared])


def with_tracked(sample: Sample, model: ErrorModel) -> Sample:
    """Return a registration's sample with what a model of tracks states in place of its figures."""
    own = {k: v for k, v in sample.figures.items() if not k.startswith(TRACK)}
    theirs = {k[len(TRACK) :]: v for k, v in sample.figures.items() if k.startswith(TRACK)}
    if not theirs:
        return sample
    return replace(
        sample, figures=own | {"tracked_mm": error_bounds("track", theirs, 0.0, model).bound}
    )


def peak_samples(dataset: Dataset, truth: Truth) -> Iterator[Sample]:
    """Yield a sample of the suggested peaks per subject; the resting face has no true peak."""
    for subject in dataset.subjects():
        true, found = truth.peaks(subject), read_suggestions(dataset, subject)
        rows = [(peak_figures(s), abs(s.frame - true[e])) for e, s in found.items() if e != NEUTRAL]
        parts: list[Figures] = [dict(figures) for figures, _ in rows]
        yield sampled("align", subject, parts, [np.array([off]) for _, off in rows])
