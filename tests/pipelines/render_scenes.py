"""A procedural head of known parameters, rendered by supersampling without any blending."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch

from express50.geometry.cameras import Camera, resized
from express50.geometry.mesh_raster import rasterize
from express50.geometry.mesh_render import barycentrics, covered, interpolate, sample_texture
from express50.geometry.transforms import axis_angle_to_matrix, look_at
from express50.head.builtin import load_builtin
from express50.head.model import HeadModel
from pipelines.track.render_loss import Appearance, Shot, make_look, vertex_light
from pipelines.track.render_refine import posed_vertices
from pipelines.track.state import Pose, State

FINE = 4  # rays a pixel, each way


@functools.cache
def head() -> HeadModel:
    return load_builtin()


def ring(
    size: int, place: np.ndarray, angles: tuple[float, ...] = (-0.8, 0.0, 0.8)
) -> list[Camera]:
    """Cameras a metre from a place."""
    cameras = []
    for index, angle in enumerate(angles):
        eye = place + [np.sin(angle), 0.1, np.cos(angle)]
        view = look_at(eye, place, np.array([0.0, 1.0, 0.0]))
        params = (2.6 * size, 2.6 * size, size / 2, size / 2)
        cameras.append(Camera(f"cam{index}", size, size, "PINHOLE", params, view))
    return cameras


def appearance() -> Appearance:
    """Spots and stripes of several sizes in a soft light from above."""
    v, u = np.mgrid[:256, :256] / 256.0
    albedo = np.stack(
        [
            0.6 + 0.2 * np.sin(43 * u) * np.cos(37 * v),
            0.5 + 0.2 * np.sin(71 * u + 29 * v),
            0.4 + 0.15 * np.cos(97 * v - 51 * u),
        ],
        axis=-1,
    )
    light = np.zeros((9, 3))
    light[0], light[1], light[2] = 0.8 * math.sqrt(4 * math.pi), 0.5, 0.4
    return Appearance(albedo.astype(np.float32), light, {"cam1": np.array([1.05, 1.0, 0.95])})


def random_state(expressions: int, place: np.ndarray, seed: int = 0) -> State:
    model, rng = head(), np.random.default_rng(seed)
    shape = 0.6 * rng.normal(size=model.shape_dirs.shape[2])
    poses = []
    for _ in range(expressions):
        count = model.expression_dirs.shape[2]
        own = np.zeros(count + 18)
        own[rng.choice(count, 6, replace=False)] = rng.uniform(0.3, 0.8, 6)
        own[count + 3] = 0.1
        own[-3:] = place + 0.01 * rng.normal(size=3)
        poses.append(Pose(own, axis_angle_to_matrix(0.1 * rng.normal(size=3))))
    return State(shape, tuple(poses))


def vertices_of(state: State, index: int) -> np.ndarray:
    """World vertices (V, 3) float64."""
    model = head().to(dtype=torch.float64)
    pose = state.poses[index]
    arrays = (state.shape, pose.own, pose.rotation)
    return posed_vertices(model, *(torch.from_numpy(a) for a in arrays)).numpy()


def shoot(vertices: np.ndarray, camera: Camera, look_of: Appearance) -> Shot:
    """A picture by many rays a pixel, before a grey wall."""
    model, look = head(), make_look(head(), look_of)
    big = resized(camera, FINE * camera.width, FINE * camera.height)
    seen = covered(rasterize(vertices, model.faces.numpy(), big, pairs=False))
    place = torch.from_numpy(vertices).float()
    K, pose = (torch.from_numpy(x) for x in (big.K, big.cam_from_world))
    weights = barycentrics(seen, torch.from_numpy(vertices), model.faces, K, pose).float()
    shade = interpolate(seen, weights, vertex_light(look, place), model.faces)
    uv = interpolate(seen, weights, look.uv, look.uv_faces)
    gain = look_of.gains.get(camera.id, np.ones(3))
    colors = (sample_texture(look.albedo, uv) * shade).numpy() * gain
    picture = np.full((big.height * big.width, 4), [0.3, 0.3, 0.3, 0.0])
    picture[seen.pixels.numpy()] = np.concatenate([colors, np.ones((len(colors), 1))], axis=1)
    picture = picture.reshape(camera.height, FINE, camera.width, FINE, 4).mean((1, 3))
    image, alpha = picture[..., :3].astype(np.float32), picture[..., 3].astype(np.float32)
    return Shot(camera, image, np.ones(alpha.shape, np.float32), alpha)
