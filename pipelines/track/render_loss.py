"""What one step of render-and-compare minimises: how far rendered views are from their pictures.

Both terms are shares: the mean difference of a covered pixel, and the area between two outlines
over the area covered. They do not depend on resolution or on the number of views.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from express50.files.images import resize_area
from express50.geometry.cameras import Camera, resized
from express50.geometry.mesh_render import (
    Covered,
    antialias,
    barycentrics,
    compose,
    interpolate,
    sample_texture,
    sh_light,
)
from express50.geometry.shapes import check_finite, check_shape
from express50.head.model import HeadModel, vertex_normals

OUTLINE_SOFTNESS = 0.1  # blended coverage is right to some hundredths: less counts squared
STALE = 0.5  # weights so far outside [0, 1] belong to a pixel that its face has left


@dataclass(frozen=True, eq=False)
class Shot:
    """One camera's picture of an expression.

    Attributes:
        camera: pinhole camera of the picture.
        image: (H, W, 3) float32 in [0, 1], in the space that albedo, light and gains multiply in.
        weight: (H, W) float32 in [0, 1], how far to trust the colour of a pixel: 1 on bare skin, 0
            on background, hair, clothes and pixels that mix them.
        alpha: (H, W) float32 share of the pixel that shows the subject, NaN where nothing is known
            (hair, clothes, a doubtful matte); None for no outline at all.
    """

    camera: Camera
    image: np.ndarray
    weight: np.ndarray
    alpha: np.ndarray | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        where = f"shot of camera {self.camera.id}"
        check_shape("image", self.image, (*size, 3), where)
        check_shape("weight", self.weight, size, where)
        check_finite("image", self.image, where)
        check_finite("weight", self.weight, where)
        if self.alpha is not None:
            check_shape("alpha", self.alpha, size, where)


@dataclass(frozen=True, eq=False)
class Appearance:
    """How the subject looks under the rig's light.

    Attributes:
        albedo: (T, T, 3) float32, v up; about as fine as the pictures see the face.
        light: (9, 3) as `sh_light` takes it, in the world's axes.
        gains: camera id -> (3,), what its pictures are multiplied by; ones where missing.
    """

    albedo: np.ndarray
    light: np.ndarray
    gains: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Look:
    """A head model's surface and its appearance as float32 tensors."""

    faces: Tensor
    uv: Tensor
    uv_faces: Tensor
    bare: Tensor
    albedo: Tensor
    light: Tensor


@dataclass(frozen=True, eq=False)
class Target:
    """A shot at one resolution, as float32 tensors; `known` marks pixels whose alpha is known."""

    camera: Camera
    K: Tensor
    cam_from_world: Tensor
    image: Tensor
    weight: Tensor
    alpha: Tensor
    known: Tensor
    gain: Tensor


def make_look(model: HeadModel, appearance: Appearance, divisor: int = 1) -> Look:
    """Tensors of a head and its appearance for pictures reduced by a divisor.

    The albedo is reduced as the pictures are: one sample a pixel would alias a finer one. Outlines
    of the scalp, where hair stands, and of the neck's end are not compared.
    """
    check_shape("albedo", appearance.albedo, (None, None, 3), "appearance")
    check_shape("light", appearance.light, (9, 3), "appearance")
    bare = torch.ones(len(model.template), dtype=torch.bool)
    for name in ("boundary", "scalp"):
        if name in model.regions:
            bare &= ~model.regions[name]
    height, width = (max(1, round(n / divisor)) for n in appearance.albedo.shape[:2])
    albedo = resize_area(np.asarray(appearance.albedo, dtype=np.float32), width, height)
    surface = (model.faces, model.uv.float(), model.uv_faces, bare)
    return Look(*surface, _tensor(albedo), _tensor(appearance.light))


def make_target(shot: Shot, gain: np.ndarray, divisor: int) -> Target:
    """A shot reduced by a divisor; pixels whose alpha is known in part are not known."""
    camera = shot.camera
    width = max(1, round(camera.width / divisor))
    height = max(1, round(camera.height / divisor))
    small = resized(camera, width, height)

    def reduced(array: np.ndarray) -> np.ndarray:
        return resize_area(np.ascontiguousarray(array, dtype=np.float32), width, height)

    known = (
        np.zeros((camera.height, camera.width)) if shot.alpha is None else np.isfinite(shot.alpha)
    )
    alpha = np.zeros(known.shape) if shot.alpha is None else np.nan_to_num(shot.alpha)
    return Target(
        small,
        _tensor(small.K),
        _tensor(small.cam_from_world),
        _tensor(reduced(shot.image)),
        _tensor(reduced(shot.weight)).reshape(-1),
        _tensor(reduced(alpha)).reshape(-1),
        torch.from_numpy(reduced(known) > 0.999).reshape(-1),
        _tensor(gain),
    )


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))


def vertex_light(look: Look, vertices: Tensor) -> Tensor:
    """Light (V, 3) at the vertices: all views of a step share it."""
    return sh_light(vertex_normals(vertices[None], look.faces)[0], look.light)


def photometric(
    look: Look, target: Target, seen: Covered, vertices: Tensor, light: Tensor, softness: float
) -> tuple[Tensor, float]:
    """Mean difference of the trusted covered pixels, and their share of the covered ones.

    Differences are Charbonnier's sqrt(d^2 + s^2) - s. Outlines against the background are left to
    `outline`: blended with any background they would pull the mesh in or out.
    """
    weights = barycentrics(seen, vertices, look.faces, target.K, target.cam_from_world)
    near_by = ((weights.detach() - 0.5).abs().amax(1) < 0.5 + STALE).float()
    trust = target.weight[seen.pixels] * near_by
    total = float(trust.sum())
    if total <= 0:
        return vertices.new_zeros(()), 0.0
    uv = interpolate(seen, weights, look.uv, look.uv_faces)
    shade = interpolate(seen, weights, light, look.faces)
    colors = sample_texture(look.albedo, uv) * shade * target.gain
    picture = compose(seen, colors, target.image)
    inner = replace(seen, pairs=seen.pairs[~_against_background(seen)])
    picture = antialias(picture, inner, vertices, target.K, target.cam_from_world)
    apart = picture.reshape(-1, 3)[seen.pixels] - target.image.reshape(-1, 3)[seen.pixels]
    apart = (apart.square() + softness**2).sqrt().mean(1) - softness
    return (trust * apart).sum() / total, total / len(seen.pixels)


def outline(look: Look, target: Target, seen: Covered, vertices: Tensor) -> Tensor:
    """Area between the bare outlines of mesh and matte over the covered area, beside the rim.

    Only pixels beside the mesh's rim have a gradient, so only they are summed: outlines further
    apart than a pixel pull as the whole area would, but are not measured.
    """
    bare = look.bare[seen.pairs[:, 2:]].all(1) & _against_background(seen)
    rim = replace(seen, pairs=seen.pairs[bare])
    pixels = torch.unique(rim.pairs[:, :2])
    pixels = pixels[target.known[pixels]]
    if not len(pixels):
        return vertices.new_zeros(())
    cover = torch.zeros(seen.height * seen.width, 1)
    cover[seen.pixels] = 1.0
    cover = cover.reshape(seen.height, seen.width, 1)
    cover = antialias(cover, rim, vertices, target.K, target.cam_from_world).reshape(-1)
    apart = cover[pixels] - target.alpha[pixels]
    apart = (apart.square() + OUTLINE_SOFTNESS**2).sqrt() - OUTLINE_SOFTNESS
    return apart.sum() / len(seen.pixels)


def _against_background(seen: Covered) -> Tensor:
    """Which pairs (P,) part the mesh from nothing."""
    covered = torch.zeros(seen.height * seen.width, dtype=torch.bool)
    covered[seen.pixels] = True
    return ~covered[seen.pairs[:, 1]]
