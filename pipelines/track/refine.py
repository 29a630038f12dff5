"""Rounds of refinement: find on the current mesh what each camera should see, fit, look again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from express50.cameras import Camera
from express50.head.model import HeadModel, pose
from pipelines.track.appearance import (
    Appearance,
    Seen,
    estimate,
    residuals,
    spread_of,
    trust,
)
from pipelines.track.config import TrackConfig
from pipelines.track.fit import State, Target, fit
from pipelines.track.hair import is_bald
from pipelines.track.marks import Eyes, with_marks
from pipelines.track.outline import Outline, SignedDistance, outline_regions, outline_vertices
from pipelines.track.photometry import OBSERVATIONS, Photometry, Picture, look, robust_mean
from pipelines.track.pinhole import project_pinhole
from pipelines.track.relief import Relief, make_relief, sweep
from pipelines.track.samples import Samples, Visibility, sample_normals, spread
from pipelines.track.shots import Shot, detail, root_light
from pipelines.track.sparse_head import POSE_SIZE, Basis

# Light of so many moments tells as much as that of all.
LIGHT_MOMENTS = 8
DETAIL_PX = 3.0
# Irises, and jaw lines where they are seen, are found anew at least so often.
MARK_ROUNDS = 2
NOISE_START = 0.02
SLANT = 0.4


@dataclass(frozen=True)
class Moment:
    """The pictures of one expression: outlines of its mattes, crops about the head."""

    distances: tuple[SignedDistance, ...]
    shots: tuple[Shot, ...]


def refine(
    basis: Basis,
    targets: list[Target],
    state: State,
    moments: list[Moment],
    eyes: Eyes | None,
    config: TrackConfig,
) -> tuple[State, list[Target], Appearance | None]:
    """Alternate between reading the pictures with the current meshes and fitting to what was read.

    First the relief, searched over millimetres; then colours, which are finer and need to be near.
    """
    model = basis.model
    samples = spread(model, config.samples)
    appearance: Appearance | None = None
    rounds = config.relief_rounds + config.photo_rounds
    rounds = max(rounds, config.silhouette_rounds, MARK_ROUNDS)
    plain = targets
    bald = _bald(model, moments, all_vertices(model, state))
    for index in range(rounds):
        meshes = all_vertices(model, state)
        targets = plain
        looking = config.relief_rounds or config.photo_rounds
        sights = (
            [see(model, samples, *seen) for seen in zip(moments, meshes, strict=True)]
            if looking
            else []
        )
        if rounds - index <= config.silhouette_rounds:
            targets = with_outlines(model, targets, moments, meshes, bald)
        targets = [
            with_marks(model, target, mesh, rotation, eyes)
            for target, mesh, rotation in zip(targets, meshes, rotations(state), strict=True)
        ]
        if config.relief_rounds:
            # Far off, whole patches of skin may match wrongly together: little trust at first.
            left = max(config.relief_rounds - 1 - index, 0)
            reach = config.relief_reach * 0.6 ** min(index, 3)
            weight = config.relief_weight * 0.3**left
            targets = with_relief(model, samples, targets, moments, sights, meshes, reach, weight)
        if index >= config.relief_rounds and config.photo_rounds:
            targets, appearance = with_photometry(
                samples, targets, moments, sights, meshes, appearance, config
            )
        # Only a searched surface can tell what the detector errs.
        free = any(isinstance(term, Relief) for target in targets for term in target.terms)
        state, _ = fit(basis, targets, state, config, config.round_iterations, free)
    return state, targets, appearance


def _bald(model: HeadModel, moments: list[Moment], meshes: np.ndarray) -> bool:
    """Whether the first moment that has pictures shows a bare skull."""
    for moment, mesh in zip(moments, meshes, strict=True):
        if moment.shots:
            return is_bald(model, [root_light(shot) for shot in moment.shots], mesh)
    return False


def with_relief(
    model: HeadModel,
    samples: Samples,
    targets: list[Target],
    moments: list[Moment],
    sights: list[Seen],
    meshes: np.ndarray,
    reach: float,
    weight: float,
) -> list[Target]:
    """The targets with points of the surface that the views agree on."""
    made = []
    for target, moment, seen, mesh in zip(targets, moments, sights, meshes, strict=True):
        images = [root_light(shot) for shot in moment.shots]
        grey = [(image.mean(2), camera) for image, camera in images]
        places = samples.at(mesh)
        # Seen at a slant a patch is another picture; two views are the least.
        weights = np.where(seen.weights > SLANT, seen.weights**2, 0.0)
        found = sweep(grey, weights, places, seen.normals, mesh, model.faces.numpy(), reach)
        ids, rows = np.unique(samples.corners, return_inverse=True)
        rows = rows.reshape(-1, 3) + 68 + len(target.vertices)
        relief = make_relief(found, rows, samples.bary, places, seen.normals, weight)
        if relief is not None:
            vertices = np.concatenate([target.vertices, ids])
            target = replace(target, vertices=vertices, terms=(*target.terms, relief))
        made.append(target)
    return made


def with_outlines(
    model: HeadModel,
    targets: list[Target],
    moments: list[Moment],
    meshes: np.ndarray,
    bald: bool,
) -> list[Target]:
    """The targets with the outlines of the current meshes (E, V, 3)."""
    allowed, covered = outline_regions(model, bald)
    faces = model.faces.numpy()
    pictures = sum(len(moment.distances) for moment in moments)
    found = []
    for target, moment, mesh in zip(targets, moments, meshes, strict=True):
        outlines, ids, offset = [], [], 68
        for distance in moment.distances:
            chosen = outline_vertices(mesh, faces, distance.camera, allowed)
            if len(chosen) < 8:
                continue
            outlines.append(
                Outline.of(distance, offset, mesh[chosen], covered[chosen], pictures, bald)
            )
            ids.append(chosen)
            offset += len(chosen)
        vertices = np.concatenate(ids) if ids else np.zeros(0, dtype=np.int64)
        found.append(replace(target, outlines=tuple(outlines), vertices=vertices))
    return found


def with_photometry(
    samples: Samples,
    targets: list[Target],
    moments: list[Moment],
    sights: list[Seen],
    meshes: np.ndarray,
    before: Appearance | None,
    config: TrackConfig,
) -> tuple[list[Target], Appearance]:
    """The targets with photometric terms, and the appearance they rest on."""
    appearance = _appearance(sights, before)
    images = [
        _details(moment, mesh, config.detail_radius)
        for moment, mesh in zip(moments, meshes, strict=True)
    ]
    fine = [
        replace(one, values=_values(samples.at(mesh), pictures))
        for one, pictures, mesh in zip(sights, images, meshes, strict=True)
    ]
    return _with_terms(targets, samples, fine, images, appearance, config), appearance


def _appearance(moments: list[Seen], before: Appearance | None) -> Appearance:
    """Light and gains, the second time without what disagrees: hair, highlights, shadows."""
    some = moments[:: -(-len(moments) // LIGHT_MOMENTS)]
    appearance = estimate(some, before)
    lengths = [residuals(appearance, one, appearance.albedo) for one in some]
    sigma = spread_of(np.concatenate([*lengths]), np.concatenate([one.weights for one in some]))
    some = [
        replace(one, weights=one.weights * trust(length, sigma))
        for one, length in zip(some, lengths, strict=True)
    ]
    return estimate(some, appearance)


def _with_terms(
    targets: list[Target],
    samples: Samples,
    moments: list[Seen],
    images: list[list[tuple[np.ndarray, Camera]]],
    appearance: Appearance,
    config: TrackConfig,
) -> list[Target]:
    """Photometric terms from the pictures' detail."""
    shades = [
        np.array([appearance.shade(name, one.normals) for name in one.cameras]).reshape(
            one.values.shape
        )
        for one in moments
    ]
    sigma = _noise(moments, shades)
    means = [
        robust_mean(one.values, shade, one.weights, sigma)
        for one, shade in zip(moments, shades, strict=True)
    ]
    mass = [one.weights.sum(0)[:, None] for one in moments]
    all_mass = np.sum(mass, axis=0)
    total = np.sum([m * mean for m, mean in zip(mass, means, strict=True)], axis=0)
    made = []
    for target, one, pictures, own, mean in zip(targets, moments, images, mass, means, strict=True):
        rest = all_mass - own
        albedo = np.where(rest > 0.2, (total - own * mean) / np.maximum(rest, 1e-9), np.nan)
        made.append(_with_term(target, samples, one, pictures, appearance, albedo, sigma, config))
    return made


def _noise(moments: list[Seen], shades: list[np.ndarray]) -> float:
    """Standard deviation of the pictures' detail about its mean over the views."""
    sigma = NOISE_START
    for _ in range(3):
        lengths = []
        for one, shade in zip(moments, shades, strict=True):
            mean = robust_mean(one.values, shade, one.weights, sigma)
            lengths.append(np.sqrt(((one.values - shade * mean) ** 2).sum(2)))
        weights = np.concatenate([one.weights for one in moments])
        sigma = spread_of(np.concatenate(lengths), weights)
    return sigma


def _details(moment: Moment, mesh: np.ndarray, radius: float) -> list[tuple[np.ndarray, Camera]]:
    """The pictures' detail below a radius in metres, but not below three pixels."""
    made = []
    for shot in moment.shots:
        image, camera = root_light(shot)
        depth = float((mesh @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]).mean())
        pixels = radius * camera.K[0, 0] / max(depth, 1e-6)
        made.append((detail(image, shot, max(pixels, DETAIL_PX)), camera))
    return made


def _values(places: np.ndarray, images: list[tuple[np.ndarray, Camera]]) -> np.ndarray:
    """What the pictures show (C, S, 3) at world points (S, 3)."""
    if not images:
        return np.zeros((0, *places.shape))
    return np.stack([look(camera, image, places)[0] for image, camera in images])


def see(model: HeadModel, samples: Samples, moment: Moment, mesh: np.ndarray) -> Seen:
    """Look every sample up in every picture of a moment."""
    places, normals = samples.at(mesh), sample_normals(samples, mesh)
    visibility = Visibility(mesh, model.faces.numpy())
    images = [root_light(shot) for shot in moment.shots]
    weights = np.zeros((len(images), len(places)))
    for row, shot in enumerate(moment.shots):
        weights[row] = visibility.weights(shot.camera, places, normals) * inside_picture(
            shot, places
        )
    names = tuple(shot.camera_id for shot in moment.shots)
    return Seen(names, _values(places, images), weights, normals)


def inside_picture(shot: Shot, places: np.ndarray) -> np.ndarray:
    """(S,) 0 outside the picture or where the matte says that there is no subject, else to 1."""
    camera = shot.camera
    pixels, depth = project_pinhole(camera, places)
    size = np.array([camera.width, camera.height])
    inside = (depth > 1e-3) & (pixels >= 1.0).all(1) & (pixels <= size - 1.0).all(1)
    if shot.alpha is None:
        return inside.astype(np.float64)
    column, row = np.clip(pixels.astype(np.int64), 0, size - 1).T
    return inside * (shot.alpha[row, column] / 255.0)


def _with_term(
    target: Target,
    samples: Samples,
    seen: Seen,
    images: list[tuple[np.ndarray, Camera]],
    appearance: Appearance,
    albedo: np.ndarray,
    sigma: float,
    config: TrackConfig,
) -> Target:
    """The target with its photometric term; the samples' vertices join the fit's points."""
    used = np.flatnonzero((seen.weights > 0.0).sum(0) >= 1)
    if not len(used):
        return target
    ids, rows = np.unique(samples.corners[used], return_inverse=True)
    share = config.photo_weight * OBSERVATIONS / max(float(seen.weights.sum()), 1e-9)
    pictures = tuple(
        Picture(
            camera,
            image,
            weight[used] * min(share, 1.0),
            appearance.shade(name, seen.normals[used]),
        )
        for name, weight, (image, camera) in zip(seen.cameras, seen.weights, images, strict=True)
    )
    photo = Photometry(
        rows.reshape(-1, 3) + 68 + len(target.vertices),
        samples.bary[used],
        pictures,
        albedo[used],
        config.photo_tie,
        sigma,
    )
    vertices = np.concatenate([target.vertices, ids])
    return replace(target, vertices=vertices, terms=(*target.terms, photo))


def rotations(state: State) -> np.ndarray:
    """World from head (E, 3, 3)."""
    return np.stack([item.rotation for item in state.poses])


def all_vertices(model: HeadModel, state: State) -> np.ndarray:
    """World vertices (E, V, 3) of every expression."""
    own = torch.from_numpy(np.stack([item.own for item in state.poses])).clone()
    count = model.expression_dirs.shape[2]
    shape = torch.from_numpy(state.shape).clone()[None].expand(len(own), -1)
    angles = own[:, count : count + POSE_SIZE - 6]
    with torch.inference_mode():
        head = pose(
            model, shape, own[:, :count], neck=angles[:, :3], jaw=angles[:, 3:6], eyes=angles[:, 6:]
        ).numpy()
    rotation = np.stack([item.rotation for item in state.poses])
    return np.einsum("eij,evj->evi", rotation, head) + own[:, None, -3:].numpy()
