"""A painted sphere before cameras, its pictures solved ray by ray, and a head of that shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from express50.geometry.cameras import Camera, rays
from express50.geometry.transforms import look_at
from express50.head.model import HeadModel
from pipelines.track.surface import Visibility, sample_normals
from pipelines.track.terms import MeshPlaces
from tests.balls import meet_ball
from tests.express50.head.tiny_head import tiny_head

RADIUS = 0.1
ORIGIN = np.zeros(3)


def sphere(rings: int = 12, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of 2 * rings segments, faces counter-clockwise from outside."""
    segments = 2 * rings
    polar = np.pi * np.arange(1, rings) / rings
    around = 2 * np.pi * np.arange(segments) / segments
    y, ring = np.cos(polar)[:, None] + 0 * around, np.sin(polar)[:, None]
    middle = np.stack([ring * np.sin(around), y, ring * np.cos(around)], -1).reshape(-1, 3)
    vertices = np.concatenate([middle, [[0, 1, 0], [0, -1, 0]]]) * radius
    at = np.arange((rings - 1) * segments).reshape(rings - 1, segments)
    a, b = at[:-1], np.roll(at, -1, 1)[:-1]
    c, d = at[1:], np.roll(at, -1, 1)[1:]
    top, bottom = len(vertices) - 2, len(vertices) - 1
    first, last = at[0], at[-1]
    faces = [
        np.stack([a, c, d], -1).reshape(-1, 3),
        np.stack([a, d, b], -1).reshape(-1, 3),
        np.stack([np.full(segments, top), first, np.roll(first, -1)], -1),
        np.stack([np.full(segments, bottom), np.roll(last, -1), last], -1),
    ]
    return vertices, np.concatenate(faces)


def rig(
    angles: tuple[float, ...] = (-0.5, -0.2, 0.15, 0.5),
    size: int = 256,
    focal: float = 2.2 * 256,
    distance: float = 1.0,
    centre: np.ndarray = ORIGIN,
) -> list[Camera]:
    """Cameras on an arc before the sphere."""
    params = (focal, focal, size / 2 + 0.7, size / 2 - 0.4)
    made = []
    for index, angle in enumerate(angles):
        eye = distance * np.array([np.sin(angle), 0.2 * np.cos(7 * angle), np.cos(angle)])
        pose = look_at(eye + centre, centre)
        made.append(Camera(f"cam{index}", size, size, "PINHOLE", params, pose))
    return made


def paint(places: np.ndarray, wave: float = 0.016) -> np.ndarray:
    """Root colours (N, 3) of points about the sphere's centre: bumps of about a wave's length."""
    rng = np.random.default_rng(5)
    total = np.zeros((len(places), 3))
    for _ in range(9):
        way = rng.normal(size=3)
        way *= 2 * np.pi / (wave * np.linalg.norm(way))
        total += np.sin(places @ way + rng.uniform(0, 6, 1))[:, None] * rng.uniform(0.02, 0.07, 3)
    return np.clip(0.5 + total, 0.0, 1.0)


def picture(
    camera: Camera, centre: np.ndarray = ORIGIN, colour=paint, radius: float = RADIUS
) -> np.ndarray:
    """Root of light (H, W, 3) float32 of a sphere before black, one ray a pixel."""
    origin, ways = rays(camera)
    depth, through = meet_ball(origin - centre, ways, radius)
    hit = (through > 0) & (depth > 0)
    image = np.zeros((*hit.shape, 3), np.float32)
    image[hit] = colour(origin - centre + depth[hit][:, None] * ways[hit])
    return image


def ball(radius: float = RADIUS, rings: int = 40, centre: np.ndarray = ORIGIN):
    """Vertices and faces of the sphere's mesh."""
    vertices, faces = sphere(rings, radius)
    return vertices + centre, faces


def places_on(faces: np.ndarray, vertices: np.ndarray) -> MeshPlaces:
    """Draw 400 samples on faces that look along +z."""
    rng = np.random.default_rng(0)
    way = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    front = np.flatnonzero(way[:, 2] > 0.6 * np.linalg.norm(way, axis=1).clip(1e-12))
    chosen = rng.choice(front, 400)
    return MeshPlaces(faces[chosen], rng.dirichlet(np.ones(3), 400))


def seen_weights(
    cameras: list[Camera], samples: MeshPlaces, vertices: np.ndarray, faces: np.ndarray
):
    """Places, normals and weights (C, S)."""
    places, normals = samples.at(vertices), sample_normals(samples, vertices)
    visibility = Visibility(vertices, faces)
    weights = [visibility.weights(camera, places, normals) for camera in cameras]
    return places, normals, np.array(weights).reshape(-1, len(places))


def true_heights(places: np.ndarray, normals: np.ndarray, centre: np.ndarray = ORIGIN):
    """How far along their normals the places miss the sphere (S,)."""
    about = places - centre
    half = (about * normals).sum(1)
    return -half + np.sqrt(half**2 - (about**2).sum(1) + RADIUS**2)


def ball_head(rings: int = 24, regions: dict[str, np.ndarray] | None = None) -> HeadModel:
    """A head that is the sphere, its map latitude over longitude; all face if nothing else."""
    vertices, faces = ball(rings=rings)
    model = tiny_head(vertices=len(vertices), seed=3)
    given = regions or {"face": np.ones(len(vertices), bool)}
    masks = {name: torch.from_numpy(given.get(name, np.zeros(len(vertices), bool)))
             for name in set(model.regions) | set(given)}  # fmt: skip
    corners = vertices[faces]
    u = 0.5 + np.arctan2(corners[..., 0], corners[..., 2]) / (2 * np.pi)
    # The seam runs down the back; the poles take their faces' longitude.
    u = np.where((u.max(1) - u.min(1) > 0.5)[:, None] & (u < 0.5), u + 1.0, u)
    pole = np.abs(corners[..., 1]) > RADIUS * (1 - 1e-9)
    u = np.where(pole, (np.where(pole, 0, u).sum(1) / (~pole).sum(1))[:, None], u)
    v = 1.0 - np.arccos(np.clip(corners[..., 1] / RADIUS, -1, 1)) / np.pi
    uv = np.stack([np.clip(u, 0, 1), v], -1).reshape(-1, 2)
    return replace(
        model,
        name="ball",
        template=torch.from_numpy(vertices),
        faces=torch.from_numpy(faces),
        uv=torch.from_numpy(uv),
        uv_faces=torch.arange(len(uv)).reshape(-1, 3),
        regions=masks,
    )
