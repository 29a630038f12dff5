"""Rooms and rigs that charts are drawn in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from express50.geometry.cameras import Camera

Rng = np.random.Generator
# At least the first, fewer than the second.
CAMERAS = (3, 8)
# Rays that tell how much of the even light and of each lamp a place has.
EVEN_RAYS, LAMP_RAYS = 16, 4
# What is further off than this leaves the even light as it is, metres.
NEAR_M = 0.1
# Rays start this far off the skin, metres.
OFF_SKIN_M = 3e-4


@dataclass(frozen=True)
class Lamps:
    """Light of a room.

    Attributes:
        even: (3,) from everywhere.
        sky: (3,) unit, where the even light is brightest.
        directions: (L, 3) unit, to the lamps.
        colors: (L, 3) of the lamps.
        sizes: (L,) radians, how far from the directions their light still comes.
        shine: exponent of highlights.
    """

    even: np.ndarray
    sky: np.ndarray
    directions: np.ndarray
    colors: np.ndarray
    sizes: np.ndarray
    shine: float

    def lit(
        self,
        albedo: np.ndarray,
        normals: np.ndarray,
        reach: np.ndarray,
        towards: np.ndarray,
        gloss: float,
    ) -> np.ndarray:
        """Light (N, 3) that skin of a colour (N, 3) sends towards the camera.

        `reach` (N, 1 + L) are the shares of the even light and of the lamps' that get there.
        """
        diffuse = self.even * ((0.6 + 0.4 * (normals @ self.sky)) * reach[:, 0])[:, None]
        highlights = np.zeros_like(diffuse)
        lamps = zip(self.directions, self.colors, reach[:, 1:].T, strict=True)
        for direction, color, share in lamps:
            cosine = (share * np.clip(normals @ direction, 0.0, None))[:, None]
            diffuse = diffuse + cosine * color
            half = direction + towards
            half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-6)
            along = np.clip((normals * half).sum(1), 0.0, None)[:, None]
            highlights += along**self.shine * (cosine > 0) * share[:, None] * color
        return albedo * diffuse + gloss * highlights

    def reach(
        self,
        scene: o3d.t.geometry.RaycastingScene,
        places: np.ndarray,
        normals: np.ndarray,
        rng: Rng,
    ) -> np.ndarray:
        """Shares (N, 1 + L) of the even light and of the lamps' that get to places (N, 3)."""
        starts = places + OFF_SKIN_M * normals
        even = np.zeros(len(places))
        for ray in _unit(rng.normal(size=(EVEN_RAYS, 3))):
            # Unit vectors about the normal's end are weighted by the cosine.
            even += ~_blocked(scene, starts, _unit(1.001 * normals + ray), NEAR_M)
        shares = [even / EVEN_RAYS]
        for direction, size in zip(self.directions, self.sizes, strict=True):
            seen = np.zeros(len(places))
            for ray in _unit(direction + size * rng.normal(size=(LAMP_RAYS, 3))):
                seen += ~_blocked(scene, starts, np.broadcast_to(ray, starts.shape), np.inf)
            shares.append(seen / LAMP_RAYS)
        return np.stack(shares, axis=1)


def draw_lamps(rng: Rng) -> Lamps:
    """A room with one to four lamps."""
    count = rng.integers(1, 5)
    directions = rng.normal(size=(count, 3)) + [0.0, 0.3, 0.8]
    sky = rng.normal(size=3)
    return Lamps(
        rng.uniform(0.1, 0.8) * rng.uniform(0.8, 1.0, 3),
        _unit(sky),
        _unit(directions),
        rng.uniform(0.1, 0.8, (count, 1)) * rng.uniform(0.75, 1.0, (count, 3)),
        rng.uniform(0.02, 0.3, count),
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


def _blocked(
    scene: o3d.t.geometry.RaycastingScene, starts: np.ndarray, towards: np.ndarray, far: float
) -> np.ndarray:
    rays = np.concatenate([starts, towards], axis=1).astype(np.float32)
    return scene.test_occlusions(o3d.core.Tensor(rays), tfar=far).numpy()


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6)
