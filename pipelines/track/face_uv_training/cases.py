"""Make training cases: painted heads seen on meshes that do not quite fit them.

Every case has a true head and a tracker's estimate of it that is some millimetres off. What several
cameras see of the first is read at the places of the second, as from footage; where each place
belongs is known. Nothing is rendered: rays are cast to the map's texels, and from the skin to the
lights.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
import torch

from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_to_corner
from express50.geometry.raycast import join_rays, mesh_scene
from express50.geometry.sampling import bilinear
from express50.geometry.transforms import make_transform, unit
from express50.head.model import HeadModel, normals_of, pose
from express50.landmarks.training.random_heads import (
    Canvas,
    deform,
    paint,
    random_parameters,
    waves,
)
from pipelines.track.face_uv import HEIGHT, WIDTH, FaceUvMap
from pipelines.track.surface import Visibility, sample_normals
from pipelines.track.terms import MeshPlaces

Rng = np.random.Generator
# At least the first, fewer than the second.
CAMERAS = (3, 8)
# Rays that measure a place's share of the even light and of each lamp.
EVEN_RAYS, LAMP_RAYS = 16, 4
# Occluders further away than this do not dim the even light, metres.
NEAR_M = 0.1
# Rays start this far off the skin, metres.
OFF_SKIN_M = 3e-4
# Root mean square of what the drawn trackers are off along the skin, metres: from least to most.
OFF_M = (0.0004, 0.005)
# Share of trackers that have the face but miss what some muscles do to it.
LATE = 0.5
# Further than this from the true skin a place of the wrong mesh shows nothing to learn from.
REACH_M = 0.008
# What lies further off along the skin is another part of the face, such as the other lip.
FAR_TEXELS = 12.0


@dataclass(frozen=True)
class Case:
    """One reading of a map (HEIGHT, WIDTH)."""

    colors: np.ndarray  # (..., 3) uint8, root of light
    flow: np.ndarray  # (..., 2) float16, texels to the right and down to where it belongs
    valid: np.ndarray  # whether the flow is known


@dataclass(frozen=True)
class Lamps:
    """Light of a room."""

    even: np.ndarray  # (3,) from everywhere
    sky: np.ndarray  # (3,) unit, where the even light is brightest
    directions: np.ndarray  # (L, 3) unit, to the lamps
    colors: np.ndarray  # (L, 3) their light
    sizes: np.ndarray  # (L,) radians, how far from the directions their light still comes
    shine: float  # exponent of highlights

    def lit(
        self,
        albedo: np.ndarray,
        normals: np.ndarray,
        reach: np.ndarray,
        towards: np.ndarray,
        gloss: float,
    ) -> np.ndarray:
        """Return the light (N, 3) that skin of a colour (N, 3) sends towards the camera.

        `reach` (N, 1 + L) are the shares of the even light and of the lamps' that get there.
        """
        diffuse = self.even * ((0.6 + 0.4 * (normals @ self.sky)) * reach[:, 0])[:, None]
        highlights = np.zeros_like(diffuse)
        lamps = zip(self.directions, self.colors, reach[:, 1:].T, strict=True)
        for direction, color, share in lamps:
            cosine = (share * np.clip(normals @ direction, 0.0, None))[:, None]
            diffuse = diffuse + cosine * color
            along = np.clip((normals * unit(direction + towards)).sum(1), 0.0, None)[:, None]
            highlights += along**self.shine * (cosine > 0) * share[:, None] * color
        return albedo * diffuse + gloss * highlights

    def reach(
        self,
        scene: o3d.t.geometry.RaycastingScene,
        places: np.ndarray,
        normals: np.ndarray,
        rng: Rng,
    ) -> np.ndarray:
        """Return the shares (N, 1 + L) of even light and lamps' light that get to places (N, 3)."""
        starts = places + OFF_SKIN_M * normals
        even = np.zeros(len(places))
        for ray in unit(rng.normal(size=(EVEN_RAYS, 3))):
            # Unit vectors about the normal's end are weighted by the cosine.
            rays = join_rays(starts, unit(1.001 * normals + ray))
            even += ~scene.test_occlusions(rays, tfar=NEAR_M).numpy()
        shares = [even / EVEN_RAYS]
        for direction, size in zip(self.directions, self.sizes, strict=True):
            seen = np.zeros(len(places))
            for ray in unit(direction + size * rng.normal(size=(LAMP_RAYS, 3))):
                seen += ~scene.test_occlusions(join_rays(starts, ray)).numpy()
            shares.append(seen / LAMP_RAYS)
        return np.stack(shares, axis=1)


def draw_lamps(rng: Rng) -> Lamps:
    """Draw a room with one to four lamps."""
    count = rng.integers(1, 5)
    directions = rng.normal(size=(count, 3)) + [0.0, 0.3, 0.8]
    sky = rng.normal(size=3)
    return Lamps(
        rng.uniform(0.1, 0.8) * rng.uniform(0.8, 1.0, 3),
        unit(sky),
        unit(directions),
        rng.uniform(0.1, 0.8, (count, 1)) * rng.uniform(0.75, 1.0, (count, 3)),
        rng.uniform(0.02, 0.3, count),
        float(rng.uniform(8.0, 60.0)),
    )


def draw_cameras(places: np.ndarray, rng: Rng) -> list[Camera]:
    """Draw cameras about the face; only where they are counts."""
    cameras = []
    for index in range(int(rng.integers(*CAMERAS))):
        yaw, pitch = rng.uniform(-1.7, 1.7), rng.normal() * 0.3
        towards = np.array(
            [np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)]
        )
        eye = places.mean(0) + np.exp(rng.uniform(-0.7, 0.7)) * towards
        at_eye = make_transform(np.eye(3), -eye)
        cameras.append(Camera(str(index), 1, 1, "PINHOLE", (1.0, 1.0, 0.5, 0.5), at_eye))
    return cameras


@dataclass(frozen=True)
class PaintedHead:
    """Colours of a head: (HEIGHT, WIDTH, 3) of its map, (V, 3) elsewhere, (3,) behind it; gloss."""

    map: np.ndarray
    vertices: np.ndarray
    background: np.ndarray
    gloss: float


def draw_person(model: HeadModel, uv_map: FaceUvMap, rng: Rng) -> PaintedHead:
    """Paint a head."""
    whole = Canvas.of(model)
    corners, bary = uv_map.samples.vertices, uv_map.samples.weights
    region = {name: (mask[corners] * bary).sum(1) for name, mask in whole.region.items()}
    rest = uv_map.samples.at(whole.rest)
    # Lips end where they end, not where a mesh's edges happen to run.
    ragged = rng.uniform(0.0, 0.2) * waves(rest, rng, 8, 200.0, 900.0)
    inside = {name: share > 0.5 for name, share in region.items()}
    if "lips" in region:
        inside["lips"] = region["lips"] > 0.5 + ragged
    canvas = Canvas(rest, inside, whole.marks)
    background = rng.uniform(0.0, 1.0, 3)
    return PaintedHead(
        uv_map.image(paint(canvas, rng)[0]),
        paint(whole, rng)[0],
        background.astype(np.float32),
        float(rng.uniform(0.0, 0.3)),
    )


def draw_case(model: HeadModel, uv_map: FaceUvMap, person: PaintedHead, rng: Rng) -> Case:
    """Let a person act, look from some cameras, and read the map of a mesh that is off."""
    true, wrong = draw_meshes(model, uv_map, rng)
    lamps = draw_lamps(rng)
    head = _PaintedScene(model, uv_map, person, true, lamps, rng)
    places, normals = uv_map.samples.at(wrong), sample_normals(uv_map.samples, wrong)
    visibility = Visibility(wrong, model.faces.numpy())
    total, mass = np.zeros_like(places), np.zeros(len(places))
    for camera in draw_cameras(places, rng):
        weight = visibility.weights(camera, places, normals) ** 2
        chosen = np.flatnonzero(weight)
        color = head.seen(camera, places[chosen])
        total[chosen] += weight[chosen, None] * color
        mass[chosen] += weight[chosen]
    colors = uv_map.image(total / np.maximum(mass, 1e-6)[:, None])
    colors = photographed(covered(colors, rng), rng)
    flow, valid = head.flow(places, normals)
    return Case(
        np.rint(255.0 * np.clip(colors, 0.0, 1.0)).astype(np.uint8),
        uv_map.image(flow).astype(np.float16),
        uv_map.image((valid & uv_map.skin & (mass > 0.02))[:, None])[..., 0],
    )


def covered(colors: np.ndarray, rng: Rng) -> np.ndarray:
    """Draw strands of hair and other things in front of the face, in some of the maps."""
    if rng.random() < 0.5:
        return colors
    out = np.ascontiguousarray(colors, dtype=np.float32)
    for _ in range(rng.integers(1, 5)):
        layer = out.copy()
        start = rng.uniform([0.0, -10.0], [WIDTH, 0.6 * HEIGHT])
        end = start + rng.normal(size=2) * [25.0, 40.0]
        ink = tuple(float(v) for v in rng.uniform(0.0, 0.8) * rng.uniform(0.6, 1.0, 3))
        points = np.rint([start, (start + end) / 2 + rng.normal(size=2) * 8, end]).astype(np.int32)
        cv2.polylines(layer, [points], False, ink, int(rng.integers(1, 9)))
        out += rng.uniform(0.3, 1.0) * (layer - out)
    return out


def photographed(colors: np.ndarray, rng: Rng) -> np.ndarray:
    """Add blur and noise of cameras, exposure and contrast of a room."""
    colors = cv2.GaussianBlur(np.float32(colors), (0, 0), rng.uniform(0.25, 1.4))
    colors = colors * rng.uniform(0.6, 1.3) + rng.normal(size=3) * 0.02
    return colors + rng.normal(size=colors.shape) * rng.uniform(0.0, 0.02)


def draw_meshes(model: HeadModel, uv_map: FaceUvMap, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Draw vertices (V, 3), (V, 3) of an acting head and of a tracker's idea of it, float64."""
    draw = random_parameters(model, rng)
    other = {name: value.clone() for name, value in draw.items()}
    # A tracker soon has the face (0.1 of what it is off by is left then); what it misses longest
    # is what a few muscles do to it.
    early = 0.1 if rng.random() < LATE else 1.0
    other["shape"] += torch.from_numpy(
        early * rng.uniform(0.0, 0.6) * rng.normal(size=other["shape"].shape)
    ).float()
    # Any muscle slips early, active ones later.
    expression = draw["expression"].numpy()
    muscles = rng.random(expression.shape) < early * rng.uniform(0.0, 0.4)
    slips = rng.uniform(0.0, 0.5) * rng.normal(size=muscles.shape) * muscles
    missed = rng.random(expression.shape) < (1.0 - early) * rng.uniform(0.0, 0.8)
    slips -= missed * rng.uniform(-0.2, 1.0, expression.shape) * expression
    other["expression"] += torch.from_numpy(slips).float()
    other["jaw"] += torch.from_numpy(rng.uniform(0.0, 0.05) * rng.normal(size=(1, 3))).float()
    other["eyes"] += torch.from_numpy(0.05 * rng.normal(size=(1, 6))).float()
    with torch.inference_mode():
        played, tracked = (pose(model, **one)[0].double().numpy() for one in (draw, other))
    true = deform(played.astype(np.float32), rng).astype(np.float64)
    off = tracked - played
    for low, high, share in ((10.0, 60.0, 0.003), (60.0, 200.0, 0.001)):
        field = np.stack([waves(true, rng, 6, low, high) for _ in range(3)], axis=1)
        off += early * rng.uniform(0.0, share) * field
    normals = normals_of(true, model.faces)
    # Along the normals the views agree better on where the skin is than along it.
    off -= rng.uniform(0.2, 1.0) * (off * normals).sum(1, keepdims=True) * normals
    face = np.unique(uv_map.samples.vertices[uv_map.skin])
    size = np.sqrt((off[face] ** 2).sum(1).mean())
    wanted = np.exp(rng.uniform(*np.log(OFF_M)))
    return true, true + off * (wanted / max(float(size), 1e-9))


class _PaintedScene:
    """Ray caster of a true, painted head, with the light that reaches its vertices."""

    def __init__(
        self,
        model: HeadModel,
        uv_map: FaceUvMap,
        person: PaintedHead,
        vertices: np.ndarray,
        lamps: Lamps,
        rng: Rng,
    ) -> None:
        self.uv_map, self.person, self.faces = uv_map, person, model.faces.numpy()
        self.scene = mesh_scene(vertices, self.faces)
        self.normals = normals_of(vertices, model.faces).astype(np.float32)
        self.lamps = lamps
        self.reach = lamps.reach(self.scene, vertices, self.normals, rng)

    def seen(self, camera: Camera, places: np.ndarray) -> np.ndarray:
        """Return the root of light (N, 3) where a camera looks for places (N, 3)."""
        towards = unit(places - camera.center)
        hit, face, spots = self._cast(join_rays(camera.center, towards))
        color = np.tile(self.person.background, (len(places), 1))
        face, spots = face[hit], spots.some(hit)
        mapped = bilinear(self.person.map, spots.at(self.uv_map.places))
        plain = spots.at(self.person.vertices)
        albedo = np.where(self.uv_map.front[face][:, None], mapped, plain)
        normals, reach = unit(spots.at(self.normals)), spots.at(self.reach)
        light = self.lamps.lit(albedo, normals, reach, -towards[hit], self.person.gloss)
        color[hit] = np.clip(light, 0.0, 1.0)
        return np.sqrt(color)

    def flow(self, places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find where the true skin at places (N, 3) of the mesh belongs: (N, 2), known (N,)."""
        hit, face, spots = self._cast(join_rays(places + REACH_M * normals, -normals), 2 * REACH_M)
        hit &= self.uv_map.front[face]
        where = spots.at(self.uv_map.places)
        own = cell_to_corner(self.uv_map.texels[:, ::-1])
        hit &= np.linalg.norm(where - own, axis=1) < FAR_TEXELS
        return np.where(hit[:, None], where - own, 0.0), hit

    def _cast(
        self, rays: o3d.core.Tensor, far: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray, MeshPlaces]:
        """Cast rays (N, 6): hit (N,), faces (N,) and places on them."""
        cast = self.scene.cast_rays(rays)
        distance, u = cast["t_hit"].numpy(), cast["primitive_uvs"].numpy()
        hit = np.isfinite(distance) & (distance < far)
        face = np.where(hit, cast["primitive_ids"].numpy(), 0).astype(np.int64)
        return hit, face, MeshPlaces(self.faces[face], np.column_stack([1 - u.sum(1), u]))
