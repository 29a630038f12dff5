"""Draw shaded pictures of a head model by ray casting, coloured by region."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import open3d as o3d
import torch

from express50.errors import HeadModelError
from express50.geometry.conventions import cell_centres
from express50.geometry.raycast import barycentrics, join_rays, mesh_scene
from express50.geometry.transforms import unit
from express50.head.model import HeadModel, normals_of, pose

Array = np.ndarray

_SKIN = (0.58, 0.37, 0.28)
# Linear base colour by region; later entries paint over earlier ones.
_COLORS = {
    "scalp": (0.54, 0.35, 0.27), "lips": (0.47, 0.20, 0.18), "mouth_interior": (0.16, 0.04, 0.04),
    "gums": (0.42, 0.16, 0.15), "tongue": (0.45, 0.15, 0.15), "teeth": (0.85, 0.80, 0.68),
    "left_eyeball": (0.78, 0.77, 0.75), "right_eyeball": (0.78, 0.77, 0.75),
    "left_iris": (0.10, 0.16, 0.19), "right_iris": (0.10, 0.16, 0.19),
    "left_pupil": (0.01, 0.01, 0.01), "right_pupil": (0.01, 0.01, 0.01),
}  # fmt: skip
_BACKGROUND = (0.11, 0.12, 0.14)
# Metres: the point looked at, the width seen there, and the camera's distance.
_CENTER, _SPAN, _AWAY = (0.0, -0.012, 0.0), 0.34, 1.2

# Name -> (expression controls, jaw opening rad), for the contact sheet.
POSES: dict[str, tuple[dict[str, float], float]] = {
    "neutral": ({}, 0.0),
    "smile": ({"mouthSmile": 1.0, "cheekSquint": 0.4}, 0.0),
    "smile open": ({"mouthSmile": 1.0, "mouthUpperUp": 0.4, "mouthLowerDown": 0.3}, 0.08),
    "mouth open": ({}, 0.36),
    "eyes shut": ({"eyeBlink": 1.0}, 0.0),
    "pucker": ({"mouthPucker": 1.0}, 0.0),
    "anger": ({"browDown": 1.0, "noseSneer": 0.5, "eyeSquint": 0.4, "mouthPress": 0.6}, 0.0),
    "surprise": ({"browInnerUp": 1.0, "browOuterUp": 1.0, "eyeWide": 0.9}, 0.26),
    "frown": ({"mouthFrown": 1.0, "browInnerUp": 0.7}, 0.0),
    "shout": ({"mouthStretch": 0.5, "mouthUpperUp": 0.6, "mouthLowerDown": 0.7, "browDown": 0.5},
              0.36),
}  # fmt: skip


def expression_vector(model: HeadModel, controls: Mapping[str, float]) -> torch.Tensor:
    """Return the coefficients (1,X) of named controls; a name without _L or _R sets both sides.

    Raises:
        HeadModelError: the model does not have a name.
    """
    index = {name: i for i, name in enumerate(model.expression_names)}
    vector = torch.zeros(1, len(index), dtype=model.dtype)
    for name, value in controls.items():
        found = [n for n in (name, f"{name}_L", f"{name}_R") if n in index]
        if not found:
            raise HeadModelError(f"head model {model.name!r}: no expression {name!r}")
        for n in found:
            vector[0, index[n]] = value
    return vector


def render_preview(
    model: HeadModel, vertices: Array | torch.Tensor, *, yaw: float = 0.0, size: int = 384
) -> Array:
    """Render posed vertices (V, 3), metres, as (size, size, 3) uint8 sRGB, four rays per pixel.

    The camera is moved around the head to the subject's left by ``yaw`` degrees.
    """
    points = np.asarray(vertices, np.float32)
    faces = model.faces.cpu().numpy()
    scene = mesh_scene(points, faces)
    angle, side = np.radians(yaw), 2 * size
    back = np.array([np.sin(angle), 0.0, np.cos(angle)])
    right = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    up = np.cross(back, right)
    origin = np.array(_CENTER) + _AWAY * back
    step = cell_centres(side) / side * _SPAN - _SPAN / 2
    x, y = np.meshgrid(step, -step)
    directions = unit(x[..., None] * right + y[..., None] * up - _AWAY * back)
    hits = scene.cast_rays(join_rays(origin, directions))
    distance = hits["t_hit"].numpy()
    seen = np.isfinite(distance)
    corner = faces[hits["primitive_ids"].numpy()[seen]]
    weights = barycentrics(hits, seen)[:, :, None]
    normals = normals_of(points, model.faces.cpu())
    n = unit((normals[corner] * weights).sum(1))
    colors = np.tile(np.array(_SKIN), (len(points), 1))
    for region, color in _COLORS.items():
        if region in model.regions:
            colors[model.regions[region].cpu().numpy()] = color
    base = (colors[corner] * weights).sum(1)
    place = origin + distance[seen, None] * directions[seen]
    shade = _shade(scene, place, n, (right, up, back), -directions[seen])
    image = np.tile(np.array(_BACKGROUND), (*distance.shape, 1))
    image[seen] = base * shade[:, :1] + shade[:, 1:]
    image = image.reshape(size, 2, size, 2, 3).mean((1, 3))
    return (np.clip(image, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)


def _shade(
    scene: o3d.t.geometry.RaycastingScene, place: Array, n: Array, axes: tuple, view: Array
) -> Array:
    """Return the diffuse factor and gloss (N,2) of a key light, a fill light and a sky."""
    right, up, back = axes
    total = 0.18 + 0.10 * (n @ up)
    gloss = np.zeros(len(n))
    for light, power in (
        (-0.55 * right + 0.65 * up + 0.75 * back, 0.88),
        (0.8 * right + 0.15 * up + 0.5 * back, 0.24),
    ):
        light = unit(light)
        dark = scene.test_occlusions(join_rays(place + 8e-4 * n, light)).numpy()
        half = unit(light + view)
        lit = power * np.where(dark, 0.0, 1.0)
        total = total + lit * np.clip(n @ light, 0, 1)
        gloss += 0.07 * lit * np.clip((n * half).sum(1), 0, 1) ** 28
    return np.stack([total, gloss], 1)


def pose_sheet(
    model: HeadModel, yaws: tuple[float, ...] = (0.0, 40.0, 90.0), size: int = 256
) -> Array:
    """Render a row per pose of POSES and a column per yaw as one picture (H, W, 3) uint8."""
    rows = []
    known = set(model.expression_names) | {name[:-2] for name in model.expression_names}
    for controls, opening in POSES.values():
        if not known.issuperset(controls):
            continue
        vertices = pose(
            model,
            torch.zeros(1, len(model.shape_names)),
            expression_vector(model, controls),
            jaw=torch.tensor([[opening, 0.0, 0.0]]),
        )[0]
        rows.append([render_preview(model, vertices, yaw=yaw, size=size) for yaw in yaws])
    return np.concatenate([np.concatenate(row, 1) for row in rows], 0)
