"""Bake the subject's albedo texture, freed of the light and of the cameras' gains.

Everything is in root light: picture = root gain x root light x root albedo. The three are found in
closed form, one after the other, at samples of the skin; the texture is then baked with the light
and gains from the neutral frame set and two others, which show what it hides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from express50.errors import StageError
from express50.files.images import write_image
from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_to_corner
from express50.geometry.pixels import linear_to_srgb
from express50.geometry.raycast import visible_faces
from express50.geometry.sampling import sh_polynomials
from express50.head.model import HeadModel, normals_of
from pipelines.track.state import Target
from pipelines.track.surface import (
    FrameSetCrops,
    Visibility,
    flat_barycentrics,
    sample_normals,
    spread_samples,
    view_colours,
    view_weights,
)
from pipelines.track.terms import MeshPlaces

LIGHT_FLOOR = 0.05
RIDGE = 0.02
# A round removes about a quarter of the gains' error: after two, 4 to 8 % was left.
ROUNDS = 10
OUTLIER = 2.5
NOISE_FLOOR = 0.002
VIEW_OUTLIER = 4.0  # standard deviations at which a view's colour is outvoted
LIGHT_FRAME_SETS = 8  # more frame sets do not improve the light
SCHEMA = "express50.appearance/1"
TEXTURE_FRAME_SETS = 3
# Two frame sets never align exactly, and their mean is blurred: the first one's views count this
# many times, so the others fill in what it does not show.
FIRST_WEIGHT = 20.0
SPREAD = 0.02  # root light; what matt skin under distant light does not explain
LEAST_WEIGHT = 0.3  # sum of squared cosines to the cameras from which on a texel is known
CHUNK = 10_000
EVEN_LIGHT = np.repeat(np.eye(9)[:, :1], 3, axis=1)


@dataclass(frozen=True)
class SampleColours:
    """The colours that C cameras show at S samples of a frame set."""

    cameras: tuple[str, ...]
    values: np.ndarray  # (C, S, 3) root of linear light
    weights: np.ndarray  # (C, S) 0 where a sample is not seen
    normals: np.ndarray  # (S, 3) world


@dataclass(frozen=True)
class Appearance:
    """Light (9, 3) of the room, root gain (3,) per camera, root albedo (S, 3), NaN where unseen."""

    light: np.ndarray
    gains: dict[str, np.ndarray]
    albedo: np.ndarray

    def shade(self, camera_id: str, normals: np.ndarray) -> np.ndarray:
        """Return the factor (S, 3) of root albedo at normals (S, 3) in a camera's pictures."""
        gain = self.gains.get(camera_id, np.ones(3))
        return gain * np.sqrt(np.maximum(sh_polynomials(normals) @ self.light, LIGHT_FLOOR))


def estimate(frame_sets: list[SampleColours], before: Appearance | None = None) -> Appearance:
    """Find albedo, light and gains that explain the frame sets; `before` gives a start."""
    cameras = sorted({name for seen in frame_sets for name in seen.cameras})
    light = _first_light(frame_sets) if before is None else before.light
    gains = {name: np.ones(3) for name in cameras} | (before.gains if before else {})
    count = frame_sets[0].normals.shape[0]
    appearance = Appearance(light, gains, np.full((count, 3), np.nan))
    for _ in range(ROUNDS):
        appearance = _with_albedo(appearance, frame_sets)
        appearance = _with_gains(appearance, frame_sets)
        appearance = _with_light(appearance, frame_sets)
    return _with_albedo(appearance, frame_sets)


def residuals(appearance: Appearance, seen: SampleColours, albedo: np.ndarray) -> np.ndarray:
    """Return lengths (C, S) of picture minus model over the channels; 0 where unknown."""
    rows = []
    for camera_id, value in zip(seen.cameras, seen.values, strict=True):
        model = appearance.shade(camera_id, seen.normals) * albedo
        rows.append(np.sqrt(np.nan_to_num((value - model) ** 2).sum(1)))
    return np.array(rows).reshape(-1, len(seen.normals))


def spread_of(lengths: np.ndarray, weights: np.ndarray) -> float:
    """Return the robust standard deviation of residual lengths (C, S) over three channels."""
    seen = lengths[weights > 0]
    # The median length of three unit normals is 1.538.
    return max(float(np.median(seen)) / 1.538, NOISE_FLOOR) if seen.size else NOISE_FLOOR


def trust(lengths: np.ndarray, sigma: float) -> np.ndarray:
    """Weigh residuals, 0..1 (Geman and McClure): hair, highlights, shadows count for little."""
    return 1.0 / (1.0 + (lengths / (3.0**0.5 * OUTLIER * sigma)) ** 2) ** 2


def _first_light(frame_sets: list[SampleColours]) -> np.ndarray:
    """Find the light (9, 3) if all skin had one colour, with mean 1 over the samples."""
    basis, light, weights = [], [], []
    for seen in frame_sets:
        mass = seen.weights.sum(0)
        mean = (seen.weights[..., None] * seen.values).sum(0) / np.maximum(mass, 1e-9)[:, None]
        basis.append(sh_polynomials(seen.normals))
        light.append(mean**2)
        weights.append(mass)
    B, L, w = np.concatenate(basis), np.concatenate(light), np.concatenate(weights)
    if not (w > 0).any():
        return EVEN_LIGHT
    L = L / np.maximum(np.average(L, axis=0, weights=w), 1e-6)
    start = EVEN_LIGHT
    for _ in range(3):
        off = np.linalg.norm(L - B @ start, axis=1)
        start = _ridge_fit(B, L, w / (1.0 + (off / 0.5) ** 2) ** 2, start)
    return start


def _ridge_fit(B: np.ndarray, target: np.ndarray, w: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Solve weighted least squares (9, 3), drawn gently to a start."""
    weighted = B * w[:, None]
    # Where nothing is seen the start stays.
    pull = (RIDGE * float(w.sum()) + 1e-9) * np.eye(9)
    return np.linalg.solve(weighted.T @ B + pull, weighted.T @ target + pull @ start)


def _with_albedo(appearance: Appearance, frame_sets: list[SampleColours]) -> Appearance:
    mass = total = np.zeros_like(frame_sets[0].normals)
    for seen in frame_sets:
        for camera_id, value, weight in zip(seen.cameras, seen.values, seen.weights, strict=True):
            shade = appearance.shade(camera_id, seen.normals)
            mass = mass + weight[:, None] * shade**2
            total = total + weight[:, None] * shade * value
    albedo = np.where(mass > 1e-6, total / np.maximum(mass, 1e-6), np.nan)
    return replace(appearance, albedo=albedo)


def _with_gains(appearance: Appearance, frame_sets: list[SampleColours]) -> Appearance:
    """Solve root gains by least squares with a geometric mean of one: the rest is albedo."""
    over: dict[str, np.ndarray] = {name: np.zeros(3) for name in appearance.gains}
    under: dict[str, np.ndarray] = {name: np.zeros(3) for name in appearance.gains}
    plain = replace(appearance, gains={})
    for seen in frame_sets:
        expected = np.nan_to_num(plain.shade("", seen.normals) * appearance.albedo)
        for camera_id, value, weight in zip(seen.cameras, seen.values, seen.weights, strict=True):
            over[camera_id] += (weight[:, None] * expected * value).sum(0)
            under[camera_id] += (weight[:, None] * expected**2).sum(0)
    gains = {n: np.clip((over[n] + 1e-3) / (under[n] + 1e-3), 0.25, 4.0) for n in over}
    if not gains:
        return appearance
    mean = np.exp(np.mean([np.log(gain) for gain in gains.values()], axis=0))
    return replace(appearance, gains={n: gain / mean for n, gain in gains.items()})


def _with_light(appearance: Appearance, frame_sets: list[SampleColours]) -> Appearance:
    """Solve the light by least squares about the light so far: heads turn, so normals vary."""
    basis, target, weights = [], [], []
    albedo = np.nan_to_num(appearance.albedo)
    for seen in frame_sets:
        for camera_id, value, weight in zip(seen.cameras, seen.values, seen.weights, strict=True):
            chosen = np.flatnonzero(weight > 0)
            scale = np.maximum((appearance.gains[camera_id] * albedo[chosen]) ** 2, 1e-4)
            basis.append(sh_polynomials(seen.normals[chosen]))
            target.append(np.clip(value[chosen] ** 2 / scale, 0.0, 4.0))
            weights.append(weight[chosen])
    if not basis:
        return appearance
    light = _ridge_fit(
        np.concatenate(basis), np.concatenate(target), np.concatenate(weights), appearance.light
    )
    return replace(appearance, light=light)


def robust_mean(
    values: np.ndarray, shade: np.ndarray, trust: np.ndarray, sigma: float
) -> np.ndarray:
    """Find root albedo (S, 3) on which most views agree: values (C, S, 3) = shade (C, S, 3) * mean.

    Hair, highlights and things that hide the skin in one view (trust (C, S)) count for little.
    """
    weights = trust
    for _ in range(3):
        mass = (weights[..., None] * shade**2).sum(0)
        mean = (weights[..., None] * shade * values).sum(0) / np.maximum(mass, 1e-12)
        off = ((values - shade * mean) ** 2).sum(2)
        weights = trust / (1.0 + off / (3.0 * sigma**2 * VIEW_OUTLIER**2)) ** 2
    return mean


def write_texture(
    out: Path,
    model: HeadModel,
    targets: list[Target],
    meshes: np.ndarray,
    pictures: list[FrameSetCrops],
    samples: int,
    side: int,
) -> None:
    """Estimate light and gains, bake albedo.png and write it with appearance.npz into `out`.

    Nothing is written if no picture shows any of the head. Meshes (E, V, 3) are of the E targets;
    light and gains are estimated at about `samples` places on the skin; the texture has `side`
    texels per side.
    """
    skin = spread_samples(model, samples)
    some = range(0, len(pictures), -(-len(pictures) // LIGHT_FRAME_SETS))
    seen = [_colours(_scene(model, pictures[k], meshes[k]), skin) for k in some]
    appearance = estimate(seen)
    # Hair, highlights and shadows disagree with it and are left out the second time.
    lengths = [residuals(appearance, one, appearance.albedo) for one in seen]
    sigma = spread_of(np.concatenate(lengths), np.concatenate([one.weights for one in seen]))
    seen = [
        replace(one, weights=one.weights * trust(length, sigma))
        for one, length in zip(seen, lengths, strict=True)
    ]
    appearance = estimate(seen, appearance)
    order = sorted(range(len(targets)), key=lambda index: not targets[index].neutral)
    places = np.unique(np.linspace(0, len(order) - 1, TEXTURE_FRAME_SETS).astype(int))
    used = [order[index] for index in places]
    albedo, known = bake_albedo(model, meshes[used], [pictures[k] for k in used], appearance, side)
    if known.any():
        names = [targets[index].observation.expression for index in used]
        write_appearance(out, albedo, appearance, names)


def bake_albedo(
    model: HeadModel,
    meshes: np.ndarray,
    pictures: list[FrameSetCrops],
    appearance: Appearance,
    side: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Bake the head's colours freed of light and gains, from frame sets with meshes (E, V, 3).

    The first frame set, best the neutral one, counts most. The colours (side, side, 3) are uint8
    sRGB, first row at v = 1, continued over what was not seen; a mask (side, side) says what was.
    """
    texels, texture = texel_samples(model, side)
    scenes = [_scene(model, *pair) for pair in zip(pictures, meshes, strict=True)]
    known = np.zeros((side, side), dtype=bool)
    root = np.zeros((side, side, 3))
    for start in range(0, len(texels.weights), CHUNK):
        some = slice(start, start + CHUNK)
        part = texels.some(some)
        seen = [_colours(scene, part) for scene in scenes]
        values = [value for one in seen for value in one.values]
        if not values:
            continue
        shade = [appearance.shade(name, one.normals) for one in seen for name in one.cameras]
        weight = np.concatenate([one.weights**2 for one in seen])
        row, column = texture[some].T
        known[row, column] = weight.sum(0) > LEAST_WEIGHT
        weight[: len(seen[0].cameras)] *= FIRST_WEIGHT
        root[row, column] = robust_mean(np.stack(values), np.stack(shade), weight, SPREAD)
    mass = known.astype(np.float64)[..., None]
    srgb = linear_to_srgb(np.clip(_filled(root**2 * mass, mass), 0.0, 1.0))
    return np.rint(255.0 * srgb).astype(np.uint8), known


def write_appearance(
    out: Path, albedo: np.ndarray, appearance: Appearance, expressions: list[str]
) -> None:
    """Write albedo.png and appearance.npz (docs/FORMAT.md); gains in linear light, not its root.

    Raises:
        StageError: light or gains are not finite.
    """
    cameras = sorted(appearance.gains)
    gains = np.array([appearance.gains[name] ** 2 for name in cameras]).reshape(-1, 3)
    if not (np.isfinite(appearance.light).all() and np.isfinite(gains).all()):
        raise StageError("light or gains hold NaN or infinite values; check the mattes")
    write_image(out / "albedo.png", albedo)
    np.savez(
        out / "appearance.npz",
        schema=np.array(SCHEMA),
        light=appearance.light,
        cameras=np.array(cameras),
        gains=gains,
        expressions=np.array(expressions),
    )


def texel_samples(model: HeadModel, side: int) -> tuple[MeshPlaces, np.ndarray]:
    """Find the places on the mesh of the texture's texels, and their rows and columns (S, 2)."""
    uv, uv_faces = model.uv.double().numpy(), model.uv_faces.numpy()
    # The map is a metre in front of a camera whose focal length is its side, so it is a metre wide.
    flat = np.column_stack([uv[:, 0], 1.0 - uv[:, 1], np.ones(len(uv))])
    camera = Camera("map", side, side, "PINHOLE", (side, side, 0.0, 0.0), np.eye(4))
    face_id = visible_faces(flat, uv_faces, camera)[0]
    texture = np.argwhere(face_id >= 0)
    faces = face_id[tuple(texture.T)]
    at = cell_to_corner(texture[:, ::-1]) / side
    bary = flat_barycentrics(flat[uv_faces[faces], :2], at)
    return MeshPlaces(model.faces.numpy()[faces], bary), texture


@dataclass(frozen=True)
class _Scene:
    """A frame set's mesh with its smooth normals, its pictures and its ray tree."""

    mesh: np.ndarray
    normals: np.ndarray
    pictures: FrameSetCrops
    images: list[tuple[np.ndarray, Camera]]
    visibility: Visibility


def _scene(model: HeadModel, pictures: FrameSetCrops, mesh: np.ndarray) -> _Scene:
    normals = normals_of(mesh, model.faces)
    images = pictures.images()
    return _Scene(mesh, normals, pictures, images, Visibility(mesh, model.faces.numpy()))


def _colours(scene: _Scene, samples: MeshPlaces) -> SampleColours:
    """Look samples up in every picture: facets decide visibility, light falls on smooth normals."""
    places, facets = samples.at(scene.mesh), sample_normals(samples, scene.mesh)
    weights = view_weights(scene.visibility, scene.pictures, places, facets)
    values = view_colours(scene.images, weights, places)
    normals = samples.at(scene.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-9, normals / np.maximum(length, 1e-9), facets)
    names = tuple(crop.camera.id for crop in scene.pictures.crops)
    return SampleColours(names, values, weights, normals)


def _filled(total: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Fill pixels of no mass (H, W, 1) from their surroundings by a pyramid of means (H, W, 3).

    Pixels of mass 1 stay. Gortler et al. 1996 ("The Lumigraph") fill holes like this.
    """
    height, width = mass.shape[:2]
    if mass.all() or min(height, width) == 1:
        return total / np.maximum(mass, 1e-12)
    size = (max(1, width // 2), max(1, height // 2))
    less, few = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (total, mass))
    few = few.reshape(*few.shape[:2], 1)
    share = np.minimum(4.0 * few, 1.0) / np.maximum(few, 1e-12)
    coarse = cv2.resize(
        _filled(less * share, few * share), (width, height), interpolation=cv2.INTER_LINEAR
    )
    return total + (1.0 - mass) * coarse
