"""What the pictures of a moment say of the surface: where views agree, and which colours it has."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from express50.geometry.cameras import Camera
from express50.head.model import HeadModel
from pipelines.track.appearance import (
    Appearance,
    Seen,
    estimate,
    residuals,
    spread_of,
    trust,
)
from pipelines.track.config import TrackConfig
from pipelines.track.outline import SignedDistance
from pipelines.track.photometry import OBSERVATIONS, Photometry, Picture, look, robust_mean
from pipelines.track.pinhole import inside_frame
from pipelines.track.relief import make_relief, sweep
from pipelines.track.samples import Samples, Visibility, sample_normals, spread
from pipelines.track.shots import Shot, detail, root_light
from pipelines.track.state import Target

# Light of so many moments tells as much as that of all.
LIGHT_MOMENTS = 8
DETAIL_PX = 3.0
NOISE_START = 0.02
SLANT = 0.4
# A sample seen by less than this, summed over views, has no colour to be held to.
LEAST_SEEN = 0.2


@dataclass(frozen=True)
class Moment:
    """The pictures of one expression: outlines of its mattes, crops about the head."""

    distances: tuple[SignedDistance, ...]
    shots: tuple[Shot, ...]


@dataclass(frozen=True)
class Skin:
    """What the peaks tell of a subject's skin, for its other frames.

    Attributes:
        samples: S places on it.
        appearance: light and gains.
        albedo: (S, 3) root of albedo, its detail alone; NaN where unknown.
        sigma: standard deviation of the pictures' detail.
    """

    samples: Samples
    appearance: Appearance
    albedo: np.ndarray
    sigma: float


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
    return Seen(names, _values(places, images, weights), weights, normals)


def inside_picture(shot: Shot, places: np.ndarray) -> np.ndarray:
    """(S,) 0 outside the picture or where the matte says that there is no subject, else to 1."""
    pixels, inside = inside_frame(shot.camera, places)
    if shot.alpha is None:
        return inside.astype(np.float64)
    size = np.array([shot.camera.width, shot.camera.height])
    column, row = np.clip(pixels.astype(np.int64), 0, size - 1).T
    return inside * (shot.alpha[row, column] / 255.0)


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


def with_photometry(
    samples: Samples,
    targets: list[Target],
    moments: list[Moment],
    sights: list[Seen],
    meshes: np.ndarray,
    before: Appearance | None,
    config: TrackConfig,
) -> tuple[list[Target], Appearance]:
    """The targets with photometric terms, and the appearance they rest on.

    Each moment is held to the colours of the others.
    """
    appearance = _appearance(sights, before)
    details = [
        _detail(samples, *seen, config) for seen in zip(moments, sights, meshes, strict=True)
    ]
    colours = _colours([fine for fine, _ in details], appearance)
    made = []
    for target, (fine, images), mass, mean in zip(
        targets, details, colours.mass, colours.mean, strict=True
    ):
        rest = colours.mass.sum(0) - mass
        albedo = _mean((colours.mass * colours.mean).sum(0) - mass * mean, rest)
        skin = Skin(samples, appearance, albedo, colours.sigma)
        made.append(_with_term(target, skin, fine, images, config))
    return made, appearance


def skin_of(
    model: HeadModel,
    moments: list[Moment],
    meshes: np.ndarray,
    appearance: Appearance,
    config: TrackConfig,
) -> Skin:
    """The skin's colours from all moments at their meshes (E, V, 3)."""
    samples = spread(model, config.samples)
    fine = []
    for moment, mesh in zip(moments, meshes, strict=True):
        sight = see(model, samples, moment, mesh)
        fine.append(_detail(samples, moment, sight, mesh, config)[0])
    colours = _colours(fine, appearance)
    albedo = _mean((colours.mass * colours.mean).sum(0), colours.mass.sum(0))
    return Skin(samples, appearance, albedo, colours.sigma)


def with_skin(
    target: Target, skin: Skin, moment: Moment, sight: Seen, mesh: np.ndarray, config: TrackConfig
) -> Target:
    """The target with a photometric term that holds a moment's pictures to known skin."""
    fine, images = _detail(skin.samples, moment, sight, mesh, config)
    return _with_term(target, skin, fine, images, config)


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


@dataclass(frozen=True)
class _Colours:
    """Root albedo `mean` (E, S, 3) of every moment, its `mass` (E, S, 1) and the noise."""

    mass: np.ndarray
    mean: np.ndarray
    sigma: float


def _colours(moments: list[Seen], appearance: Appearance) -> _Colours:
    """What every moment says of the detail of the skin's colours."""
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
    return _Colours(np.array(mass), np.array(means), sigma)


def _mean(total: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Means (S, 3) of sums (S, 3) over masses (S, 1); NaN where next to nothing was seen."""
    return np.where(mass > LEAST_SEEN, total / np.maximum(mass, 1e-9), np.nan)


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


def _detail(
    samples: Samples, moment: Moment, sight: Seen, mesh: np.ndarray, config: TrackConfig
) -> tuple[Seen, list[tuple[np.ndarray, Camera]]]:
    """What a moment's pictures show of the samples' detail, and the pictures of it."""
    images = _details(moment, mesh, config.detail_radius)
    return replace(sight, values=_values(samples.at(mesh), images, sight.weights)), images


def _details(moment: Moment, mesh: np.ndarray, radius: float) -> list[tuple[np.ndarray, Camera]]:
    """The pictures' detail below a radius in metres, but not below three pixels."""
    made = []
    for shot in moment.shots:
        image, camera = root_light(shot)
        depth = float((mesh @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]).mean())
        pixels = radius * camera.K[0, 0] / max(depth, 1e-6)
        made.append((detail(image, shot, max(pixels, DETAIL_PX)), camera))
    return made


def _values(
    places: np.ndarray, images: list[tuple[np.ndarray, Camera]], weights: np.ndarray
) -> np.ndarray:
    """What the pictures show (C, S, 3) at world points (S, 3); 0 where they do not see one."""
    values = np.zeros((len(images), *places.shape))
    for row, (image, camera) in enumerate(images):
        chosen = np.flatnonzero(weights[row])
        values[row, chosen] = look(camera, image, places[chosen])[0]
    return values


def _with_term(
    target: Target,
    skin: Skin,
    seen: Seen,
    images: list[tuple[np.ndarray, Camera]],
    config: TrackConfig,
) -> Target:
    """The target with its photometric term; the samples' vertices join the fit's points."""
    used = np.flatnonzero((seen.weights > 0.0).sum(0) >= 1)
    if not len(used):
        return target
    samples, shade = skin.samples, skin.appearance.shade
    ids, rows = np.unique(samples.corners[used], return_inverse=True)
    share = config.photo_weight * OBSERVATIONS / max(float(seen.weights.sum()), 1e-9)
    pictures = tuple(
        Picture(camera, image, weight[used] * min(share, 1.0), shade(name, seen.normals[used]))
        for name, weight, (image, camera) in zip(seen.cameras, seen.weights, images, strict=True)
    )
    photo = Photometry(
        rows.reshape(-1, 3) + 68 + len(target.vertices),
        samples.bary[used],
        pictures,
        skin.albedo[used],
        config.photo_tie,
        skin.sigma,
    )
    vertices = np.concatenate([target.vertices, ids])
    return replace(target, vertices=vertices, terms=(*target.terms, photo))
