"""Rooms and rigs that charts are drawn in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.cameras import Camera

Rng = np.random.Generator
# At least the first, fewer than the second.
CAMERAS = (3, 8)


@dataclass(frozen=True)
class Lamps:
    """Light of a room.

    Attributes:
        even: (3,) from everywhere.
        sky: (3,) unit, where the even light is brightest.
        directions: (L, 3) unit, to the lamps.
        colors: (L, 3) of the lamps.
        shine: exponent of highlights.
    """

    even: np.ndarray
    sky: np.ndarray
    directions: np.ndarray
    colors: np.ndarray
    shine: float

    def lit(
        self, albedo: np.ndarray, normals: np.ndarray, towards: np.ndarray, gloss: float
    ) -> np.ndarray:
        """Light (N, 3) that skin of a colour (N, 3) sends towards the camera."""
        diffuse = self.even * (0.6 + 0.4 * (normals @ self.sky))[:, None]
        highlights = np.zeros_like(diffuse)
        for direction, color in zip(self.directions, self.colors, strict=True):
            cosine = np.clip(normals @ direction, 0.0, None)[:, None]
            diffuse = diffuse + cosine * color
            half = direction + towards
            half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-6)
            along = np.clip((normals * half).sum(1), 0.0, None)[:, None]
            highlights += along**self.shine * (cosine > 0) * color
        return albedo * diffuse + gloss * highlights


def draw_lamps(rng: Rng) -> Lamps:
    """A room with one to four lamps."""
    count = rng.integers(1, 5)
    directions = rng.normal(size=(count, 3)) + [0.0, 0.3, 0.8]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sky = rng.normal(size=3)
    return Lamps(
        rng.uniform(0.1, 0.8) * rng.uniform(0.8, 1.0, 3),
        sky / np.linalg.norm(sky),
        directions,
        rng.uniform(0.1, 0.8, (count, 1)) * rng.uniform(0.75, 1.0, (count, 3)),
        float(rng.uniform(8.0, 60.0)),
    )


def draw_cameras(places: np.ndarray, rng: Rng) -> list[Camera]:
    """Cameras about the face; only where they are counts."""
    cameras = []
    for index in range(int(rng.integers(*CAMERAS))):
        yaw, pitch = rng.uniform(-1.7, 1.7), rng.normal() * 0.3
        towards = np.array(
            [np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)]
        )
        pose_ = np.eye(4)
        pose_[:3, 3] = -(places.mean(0) + np.exp(rng.uniform(-0.7, 0.7)) * towards)
        cameras.append(Camera(str(index), 1, 1, "PINHOLE", (1.0, 1.0, 0.5, 0.5), pose_))
    return cameras
