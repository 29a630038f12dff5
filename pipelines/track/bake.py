"""The subject's colours as a picture: what the views agree on at every texel of the texture map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from express50.errors import StageError
from express50.files.images import linear_to_srgb, write_image
from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_to_corner
from express50.geometry.raycast import visible_faces
from express50.head.model import HeadModel, vertex_normals
from pipelines.track.appearance import Appearance, Seen
from pipelines.track.photometry import look, robust_mean
from pipelines.track.pictures import Moment, inside_picture
from pipelines.track.samples import Samples, Visibility, flat_barycentrics, sample_normals
from pipelines.track.shots import Shot, root_light
from pipelines.track.state import Target

SCHEMA = "express50.appearance/1"
MOMENTS = 3
# Two moments never lie quite on one another, and their mean is blurred: the first one's views count
# so many times as much, so that the others tell only what it does not show.
FIRST = 20.0
# Standard deviation, root of light, of what matt skin under distant light does not explain.
SPREAD = 0.02
# Sum of squared cosines to the cameras from which on a texel is known.
LEAST_MASS = 0.3
CHUNK = 10_000


def write_texture(
    out: Path,
    model: HeadModel,
    targets: list[Target],
    meshes: np.ndarray,
    moments: list[Moment],
    appearance: Appearance,
    side: int,
) -> None:
    """Bake the neutral moment and two others, which show what it hides, and write what was found.

    Where no picture shows any of it, nothing is written.
    Arguments are as `bake_albedo` has them, all expressions' in the order of the targets.
    """
    order = sorted(range(len(targets)), key=lambda index: not targets[index].neutral)
    used = [
        order[index] for index in np.unique(np.linspace(0, len(order) - 1, MOMENTS).astype(int))
    ]
    albedo, known = bake_albedo(model, meshes[used], [moments[i] for i in used], appearance, side)
    if not known.any():
        return
    names = [targets[index].observation.expression for index in used]
    write_appearance(out, albedo, appearance, names)


def bake_albedo(
    model: HeadModel,
    meshes: np.ndarray,
    moments: list[Moment],
    appearance: Appearance,
    side: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The head's colours freed of light and gains, and which of them were seen.

    Args:
        model: the head.
        meshes: (E, V, 3) world.
        moments: what the cameras saw of each; the first (best the neutral one) counts most.
        appearance: light and gains.
        side: texels a side.

    Returns:
        (side, side, 3) uint8 sRGB, first row at v = 1, continued over what was not seen; and
        (side, side) bool, where it was seen.
    """
    texels, texture = texel_samples(model, side)
    scenes = [_scene(model, *pair) for pair in zip(moments, meshes, strict=True)]
    known = np.zeros((side, side), dtype=bool)
    root = np.zeros((side, side, 3))
    for start in range(0, len(texels.faces), CHUNK):
        some = slice(start, start + CHUNK)
        part = texels.some(some)
        seen = [_seen(scene, part) for scene in scenes]
        colour, mass = _agreed(seen, appearance)
        row, column = texture[some].T
        root[row, column], known[row, column] = colour, mass > LEAST_MASS
    light = np.where(known[..., None], root**2, 0.0)
    srgb = linear_to_srgb(np.clip(_continued(light, known), 0.0, 1.0))
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
        raise StageError("light or gains hold NaN or infinite values; look at the mattes")
    write_image(out / "albedo.png", albedo)
    np.savez(
        out / "appearance.npz",
        schema=np.array(SCHEMA),
        light=appearance.light,
        cameras=np.array(cameras),
        gains=gains,
        expressions=np.array(expressions),
    )


def texel_samples(model: HeadModel, side: int) -> tuple[Samples, np.ndarray]:
    """Places on the mesh of the texels that the map covers, and their rows and columns (S, 2)."""
    uv, uv_faces = model.uv.double().numpy(), model.uv_faces.numpy()
    # The map a metre before a camera whose focal length is its side: a metre is the map's width.
    flat = np.column_stack([uv[:, 0], 1.0 - uv[:, 1], np.ones(len(uv))])
    camera = Camera("map", side, side, "PINHOLE", (side, side, 0.0, 0.0), np.eye(4))
    face_id = visible_faces(flat, uv_faces, camera)[0]
    texture = np.argwhere(face_id >= 0)
    faces = face_id[tuple(texture.T)]
    at = cell_to_corner(texture[:, ::-1]) / side
    bary = flat_barycentrics(flat[uv_faces[faces], :2], at)
    return Samples(faces, model.faces.numpy()[faces], bary), texture


@dataclass(frozen=True)
class _Scene:
    """A moment's mesh with its smooth normals, its pictures, and what hides what."""

    mesh: np.ndarray
    normals: np.ndarray
    shots: tuple[Shot, ...]
    images: list[tuple[np.ndarray, Camera]]
    visibility: Visibility


def _scene(model: HeadModel, moment: Moment, mesh: np.ndarray) -> _Scene:
    normals = vertex_normals(torch.from_numpy(mesh)[None], model.faces)[0].numpy()
    images = [root_light(shot) for shot in moment.shots]
    return _Scene(mesh, normals, moment.shots, images, Visibility(mesh, model.faces.numpy()))


def _seen(scene: _Scene, texels: Samples) -> Seen:
    """What a moment's cameras see of the texels.

    Facets judge what is hidden; light falls on the smooth surface.
    """
    places, facets = texels.at(scene.mesh), sample_normals(texels, scene.mesh)
    weights = np.zeros((len(scene.shots), len(places)))
    values = np.zeros((*weights.shape, 3))
    for row, (shot, (image, camera)) in enumerate(zip(scene.shots, scene.images, strict=True)):
        weight = scene.visibility.weights(camera, places, facets) * inside_picture(shot, places)
        chosen = np.flatnonzero(weight)
        weights[row] = weight
        values[row, chosen] = look(camera, image, places[chosen])[0]
    normals = texels.at(scene.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-9, normals / np.maximum(length, 1e-9), facets)
    return Seen(tuple(shot.camera_id for shot in scene.shots), values, weights, normals)


def _agreed(moments: list[Seen], appearance: Appearance) -> tuple[np.ndarray, np.ndarray]:
    """Root albedo (S, 3) that most views agree on, and how well it was seen (S,)."""
    count = len(moments[0].normals)
    shade = [appearance.shade(name, one.normals) for one in moments for name in one.cameras]
    values = [value for one in moments for value in one.values]
    if not values:
        return np.zeros((count, 3)), np.zeros(count)
    mass = np.concatenate([one.weights**2 for one in moments])
    trust = mass.copy()
    trust[: len(moments[0].cameras)] *= FIRST
    return robust_mean(np.stack(values), np.stack(shade), trust, SPREAD), mass.sum(0)


def _continued(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """An image (H, W, 3) whose unknown pixels follow their surroundings, by a pyramid of means.

    Known pixels stay. Gortler et al. 1996 ("The Lumigraph") fill holes like this.
    """
    mass = known.astype(np.float64)[..., None]
    if not mass.any():
        return np.full_like(image, 0.5)
    return _pulled(image * mass, mass)


def _pulled(total: np.ndarray, mass: np.ndarray) -> np.ndarray:
    height, width = mass.shape[:2]
    if mass.all() or min(height, width) == 1:
        return total / np.maximum(mass, 1e-12)
    size = (max(1, width // 2), max(1, height // 2))
    less, few = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (total, mass))
    few = few.reshape(*few.shape[:2], 1)
    share = np.minimum(4.0 * few, 1.0) / np.maximum(few, 1e-12)
    coarse = cv2.resize(
        _pulled(less * share, few * share), (width, height), interpolation=cv2.INTER_LINEAR
    )
    return total + (1.0 - mass) * coarse
