"""Random heads rendered for the training of the landmark detector.

Domain randomisation on purpose: shapes, skins, hair and light far beyond what is usual, so that the
detector learns where things are on a face and not how one renderer or one head model paints them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
import torch

from express50.head.model import HeadModel, landmarks, pose, vertex_normals

FRAME_SIDE_M = 0.38
Rng = np.random.Generator


@dataclass(frozen=True)
class RandomHead:
    """One random head: vertices and normals (V, 3), colours (V, 3) in [0, 1], landmarks (68, 3)."""

    vertices: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    landmarks: np.ndarray
    gloss: float


@dataclass(frozen=True)
class View:
    """A rendered view: rgba (S, S, 4) uint8, landmarks (68, 2) pixels, facing: cosine to camera."""

    rgba: np.ndarray
    points: np.ndarray
    facing: float


def random_head(model: HeadModel, rng: Rng) -> RandomHead:
    """Draw shape, expression, pose, smooth deformation, hair and colours."""
    draw = _random_parameters(model, rng)
    with torch.no_grad():
        vertices = pose(model, **draw)
    vertices = torch.from_numpy(_deform(vertices[0].numpy(), rng))[None]
    points = landmarks(model, vertices)[0].numpy()
    colors, hair = _paint(model, rng)
    normals = vertex_normals(vertices, model.faces)
    if hair is not None:
        vertices = vertices + normals * torch.from_numpy(hair)[None, :, None]
        normals = vertex_normals(vertices, model.faces)
    gloss = float(rng.uniform(0.0, 0.5))
    return RandomHead(vertices[0].numpy(), normals[0].numpy(), colors, points, gloss)


def _random_parameters(model: HeadModel, rng: Rng) -> dict[str, torch.Tensor]:
    """Random arguments for `pose`, batch of one."""
    names = model.expression_names
    shape = rng.normal(size=len(model.shape_names)) * rng.uniform(0.5, 1.4)
    expression = np.zeros(len(names))
    if model.unit_expressions:
        active = rng.choice(len(names), size=rng.integers(0, 9), replace=False)
        expression[active] = rng.beta(1.0, 1.2, size=active.size)
        if rng.random() < 0.15:
            for name in ("eyeBlink_L", "eyeBlink_R"):
                if name in names:
                    expression[names.index(name)] = rng.uniform(0.5, 1.0)
    else:
        expression = rng.normal(size=len(names))
    jaw = rng.normal(size=3) * np.array([0.03, 0.03, 0.02])
    if rng.random() < 0.35:
        jaw[0] = rng.uniform(0.0, 0.45)
    gaze = rng.normal(size=2) * np.array([0.2, 0.3])
    eyes = np.concatenate([gaze, [0.0], gaze, [0.0]])
    neck = rng.normal(size=3) * 0.15

    def batch(value: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(value.astype(np.float32))[None]

    return {
        "shape": batch(shape), "expression": batch(expression),
        "neck": batch(neck), "jaw": batch(jaw), "eyes": batch(eyes),
    }  # fmt: skip


def _waves(points: np.ndarray, rng: Rng, count: int, low: float, high: float) -> np.ndarray:
    """Smooth random field (N,) of about unit variance; wave numbers low..high radians a metre."""
    directions = rng.normal(size=(count, 3))
    directions *= (np.exp(rng.uniform(np.log(low), np.log(high), count)))[:, None] / (
        np.linalg.norm(directions, axis=1, keepdims=True)
    )
    phases = rng.uniform(0, 2 * np.pi, count)
    return np.sin(points @ directions.T + phases).sum(1) * np.sqrt(2.0 / count)


def _deform(vertices: np.ndarray, rng: Rng) -> np.ndarray:
    """Anisotropic scale and a smooth random displacement of a few millimetres."""
    centre = vertices.mean(0)
    scaled = (vertices - centre) * rng.uniform(0.9, 1.1, size=3) * rng.uniform(0.9, 1.1)
    amplitude = rng.uniform(0.0, 0.003)
    moved = np.stack([_waves(vertices, rng, 6, 15.0, 60.0) for _ in range(3)], axis=1)
    return (scaled + centre + amplitude * moved).astype(np.float32)


def _paint(model: HeadModel, rng: Rng) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours (V, 3) in [0, 1] and hair thickness (V,) metres or None, from the rest shape."""
    rest = model.template.numpy()
    region = {name: mask.numpy() for name, mask in model.regions.items()}
    marks = landmarks(model, model.template[None])[0].numpy()
    colors = np.tile(_skin_color(rng), (len(rest), 1))
    # Anything in no region is a small part such as lashes: dark.
    nothing = ~np.any(list(region.values()), axis=0)
    colors *= 1 + rng.uniform(0, 0.15) * _waves(rest, rng, 12, 20.0, 150.0)[:, None]
    colors *= 1 + rng.uniform(0, 0.12) * _waves(rest, rng, 24, 150.0, 900.0)[:, None]
    blush = _blob(rest, marks[[2, 14, 30, 8]][rng.integers(4)], rng.uniform(0.02, 0.05))
    colors = _mix(colors, rng.uniform(0.2, 1.0, 3), blush * rng.uniform(0, 0.3))
    _tint_features(colors, region, rest, marks, rng)
    colors[nothing] = rng.uniform(0.02, 0.25)
    hair = _grow_hair(colors, region, rest, marks, rng)
    _tint_beard(colors, region, rest, marks, rng)
    _color_eyes_and_mouth(colors, region, rest, rng)
    return np.clip(colors, 0.0, 1.0).astype(np.float32), hair


def _skin_color(rng: Rng) -> np.ndarray:
    if rng.random() < 0.15:
        return rng.uniform(0.15, 0.95, 3)
    light = rng.uniform(0.0, 1.0)
    skin = (1 - light) * np.array([0.25, 0.15, 0.10]) + light * np.array([0.95, 0.78, 0.68])
    return np.clip(skin * rng.uniform(0.85, 1.15, 3), 0.05, 1.0)


def _mix(colors: np.ndarray, color: np.ndarray, amount: np.ndarray) -> np.ndarray:
    return colors + (color - colors) * amount[:, None]


def _blob(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    return np.exp(-((points - centre) ** 2).sum(1) / radius**2)


def _line_distance(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance (N,) of points (N, 3) to a polyline (L, 3)."""
    start, along = line[:-1], np.diff(line, axis=0)
    relative = points[:, None] - start[None]
    share = (relative * along).sum(2) / np.maximum((along**2).sum(1), 1e-12)
    return np.linalg.norm(relative - np.clip(share, 0, 1)[..., None] * along, axis=2).min(1)


def _tint_features(
    colors: np.ndarray, region: dict[str, np.ndarray], rest: np.ndarray, marks: np.ndarray, rng: Rng
) -> None:
    """Lips, brows and eye make-up, in place."""
    lips = region["lips"].astype(float) * rng.uniform(0.0, 0.9)
    colors[:] = _mix(colors, colors * rng.uniform([0.7, 0.3, 0.3], [1.2, 0.9, 0.9]), lips)
    brow_color = rng.uniform(0.0, 0.5) * np.array([1.0, rng.uniform(0.5, 1), rng.uniform(0.3, 1)])
    skin = np.flatnonzero(region["face"])
    width, strength = (
        rng.uniform(0.002, 0.006),
        rng.choice([0.0, rng.uniform(0.2, 1.0)], p=[0.2, 0.8]),
    )
    for line in (marks[17:22], marks[22:27]):
        near = _line_distance(rest[skin], line)
        ragged = 1 + 0.4 * _waves(rest[skin], rng, 8, 300.0, 1500.0)
        amount = strength / (1 + np.exp((near - width * ragged) / 0.001))
        colors[skin] = _mix(colors[skin], brow_color, amount)
    for side in ("left", "right"):
        shade = region[f"{side}_eye_region"] * rng.uniform(0.0, 0.4)
        colors[:] = _mix(colors, rng.uniform(0.0, 0.8, 3), shade)


def _grow_hair(
    colors: np.ndarray, region: dict[str, np.ndarray], rest: np.ndarray, marks: np.ndarray, rng: Rng
) -> np.ndarray | None:
    """Paint a hair cap above a tilted plane, in place; returns its thickness or None for bald."""
    if rng.random() < 0.3:
        return None
    brows, crown = marks[17:27, 1].max(), rest[:, 1].max()
    front = np.array([0.0, brows + rng.uniform(0.15, 0.8) * (crown - brows), marks[27, 2]])
    tilt = rng.uniform(0.2, 1.25)
    height = (rest - front) @ np.array([0.0, np.cos(tilt), -np.sin(tilt)])
    height += 0.006 * _waves(rest, rng, 10, 40.0, 300.0)
    keep = np.zeros(len(rest))
    keep[region["scalp"] | region["forehead"] | region["neck"]] = 1.0
    keep[region["neck"] & (rest[:, 1] < marks[8, 1] - 0.03)] = 0.0
    amount = keep / (1 + np.exp(-height / 0.004))
    hair_color = rng.uniform(0.02, 0.75) * np.array([1.0, rng.uniform(0.6, 1), rng.uniform(0.3, 1)])
    strands = 1 + 0.4 * _waves(rest, rng, 30, 200.0, 1500.0)
    colors[:] += (hair_color * strands[:, None] - colors) * amount[:, None]
    thickness = rng.uniform(0.0, 0.03) * (1 + 0.4 * _waves(rest, rng, 10, 30.0, 200.0))
    return (amount * np.maximum(thickness, 0.0)).astype(np.float32)


def _tint_beard(
    colors: np.ndarray, region: dict[str, np.ndarray], rest: np.ndarray, marks: np.ndarray, rng: Rng
) -> None:
    """Stubble, moustache or full beard, in place."""
    if rng.random() < 0.6:
        return
    below = 1 / (1 + np.exp((rest[:, 1] - marks[33, 1] + rng.uniform(0, 0.02)) / 0.003))
    cheek = 1 / (1 + np.exp((marks[33, 2] - rng.uniform(0.02, 0.09) - rest[:, 2]) / 0.004))
    amount = below * cheek * (region["face"] & ~region["lips"]) * rng.uniform(0.2, 0.9)
    grain = 1 + 0.5 * _waves(rest, rng, 20, 400.0, 2000.0)
    colors[:] = _mix(colors, rng.uniform(0.0, 0.4) * np.ones(3), np.clip(amount * grain, 0, 1))


def _color_eyes_and_mouth(
    colors: np.ndarray, region: dict[str, np.ndarray], rest: np.ndarray, rng: Rng
) -> None:
    """Sclera, iris, pupil, teeth and mouth cavity, in place."""
    iris = rng.uniform(0.05, 0.7) * np.array(
        [rng.uniform(0.4, 1), rng.uniform(0.5, 1), rng.uniform(0.3, 1)]
    )
    sclera = rng.uniform(0.6, 1.0) * np.array([1.0, rng.uniform(0.9, 1), rng.uniform(0.85, 1)])
    for side in ("left", "right"):
        ball = region[f"{side}_eyeball"]
        colors[ball] = sclera
        centre = rest[ball].mean(0)
        arm = rest[ball] - centre
        angle = np.arccos(np.clip(arm[:, 2] / np.linalg.norm(arm, axis=1), -1, 1))
        colors[np.flatnonzero(ball)[angle < rng.uniform(0.42, 0.55)]] = iris
        colors[np.flatnonzero(ball)[angle < rng.uniform(0.15, 0.28)]] = 0.02
    inside = region["mouth_interior"] | region["tongue"]
    colors[inside] = rng.uniform(0.05, 0.6) * np.array(
        [1.0, rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.8)]
    )
    colors[region["teeth"]] = rng.uniform(0.5, 1.0) * np.array([1.0, 0.97, rng.uniform(0.8, 1.0)])


class HeadScene:
    """A random head in a ray caster, to be seen from many sides."""

    def __init__(self, model: HeadModel, head: RandomHead) -> None:
        self.faces = model.faces.numpy()
        self.head = head
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(
            o3d.core.Tensor(head.vertices), o3d.core.Tensor(self.faces.astype(np.uint32))
        )

    def render(self, rng: Rng, side: int, turned: bool) -> View:
        """Render from a random direction; `turned` draws yaw from the full circle."""
        points = self.head.landmarks
        K, cam_from_world = _random_camera(points, rng, side, turned)
        pixels = (points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]) @ K.T
        rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
            intrinsic_matrix=o3d.core.Tensor(K),
            extrinsic_matrix=o3d.core.Tensor(cam_from_world),
            width_px=side,
            height_px=side,
        )
        rgba = self._shade(rays, rng, side)
        eye = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
        return View(rgba, pixels[:, :2] / pixels[:, 2:], _facing(points, eye))

    def _shade(self, rays: o3d.core.Tensor, rng: Rng, side: int) -> np.ndarray:
        """Cast rays and light the hits: rgba (side, side, 4) uint8."""
        cast = self.scene.cast_rays(rays)
        distance = cast["t_hit"].numpy()
        hit = np.isfinite(distance)
        face = self.faces[cast["primitive_ids"].numpy()[hit]]
        bary = cast["primitive_uvs"].numpy()[hit]
        weights = np.stack([1 - bary.sum(1), bary[:, 0], bary[:, 1]], axis=1)[..., None]
        albedo = (self.head.colors[face] * weights).sum(1)
        normals = (self.head.normals[face] * weights).sum(1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        rays_hit = rays.numpy()[hit]
        towards = -rays_hit[:, 3:] / np.linalg.norm(rays_hit[:, 3:], axis=1, keepdims=True)
        points = rays_hit[:, :3] + rays_hit[:, 3:] * distance[hit][:, None]
        light = self._light(points, normals, towards, rng)
        image = np.zeros((side, side, 4), np.uint8)
        shaded = np.clip(albedo * light[0] + light[1], 0, 1) ** rng.uniform(0.7, 1.4)
        image[hit, :3] = (255 * shaded).astype(np.uint8)
        image[hit, 3] = 255
        return image

    def _light(
        self, points: np.ndarray, normals: np.ndarray, towards: np.ndarray, rng: Rng
    ) -> tuple[np.ndarray, np.ndarray]:
        """Diffuse and specular light (N, 3) each of ambient and one to three lamps."""
        sky = 0.5 + 0.5 * normals @ _unit(rng.normal(size=3))
        diffuse = rng.uniform(0.1, 0.8) * (0.6 + 0.4 * sky[:, None]) * rng.uniform(0.8, 1.0, 3)
        specular = np.zeros_like(diffuse)
        for lamp in range(rng.integers(1, 4)):
            direction = _unit(rng.normal(size=3) + towards.mean(0) * rng.uniform(0.0, 2.0))
            color = rng.uniform(0.2, 1.0) * rng.uniform(0.75, 1.0, 3)
            cosine = np.clip(normals @ direction, 0, None)
            if lamp == 0 and rng.random() < 0.35:
                shadow = np.concatenate(
                    [points + 1e-3 * normals, np.broadcast_to(direction, points.shape)], axis=1
                )
                blocked = self.scene.test_occlusions(o3d.core.Tensor(shadow.astype(np.float32)))
                cosine = cosine * np.where(blocked.numpy(), rng.uniform(0, 0.6), 1.0)
            half = _unit(direction + towards)
            shine = np.clip((normals * half).sum(1), 0, None) ** rng.uniform(8, 60)
            diffuse = diffuse + cosine[:, None] * color
            specular = specular + self.head.gloss * (shine * (cosine > 0))[:, None] * color
        return diffuse, specular


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-9)


def _facing(points: np.ndarray, eye: np.ndarray) -> float:
    """Cosine between the face's forward direction and the direction to the camera centre."""
    across = points[45] - points[36]
    down = points[8] - points[27]
    forward = _unit(np.cross(down, across))
    # Right eye to left eye is +x, brow to chin is -y: (-y) x (+x) = +z.
    return float(forward @ _unit(eye - points[30]))


def _random_camera(
    points: np.ndarray, rng: Rng, side: int, turned: bool
) -> tuple[np.ndarray, np.ndarray]:
    """K (3,3) and cam_from_world (4,4) that frame the whole head, landmarks (68, 3) given."""
    yaw = rng.uniform(-np.pi, np.pi) if turned else rng.normal() * 0.65
    pitch = np.clip(rng.normal() * 0.28, -0.8, 0.8)
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    target = points.mean(0) + np.array([0.0, 0.02, -0.06]) + rng.normal(size=3) * 0.008
    distance = np.exp(rng.uniform(np.log(0.45), np.log(2.0)))
    right = _unit(np.cross(np.array([0.0, 1.0, 0.0]), forward))
    rotation = np.stack([right, -np.cross(forward, right), -forward])
    roll = rng.normal() * 0.12
    turn = np.array(
        [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]]
    )
    rotation = turn @ rotation
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation
    cam_from_world[:3, 3] = -rotation @ (target + distance * forward)
    focal = side * distance / FRAME_SIDE_M * rng.uniform(0.85, 1.15)
    return np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]]), cam_from_world
