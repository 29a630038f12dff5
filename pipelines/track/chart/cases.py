"""What the chart network learns from: painted heads seen on meshes that do not quite fit them.

A head is drawn twice: as it is, and as a tracker that is some millimetres off has it. What several
cameras see of the first is read at the places of the second, exactly as it is of footage; where
each place belongs is known. Nothing is rendered: rays are cast to the chart's texels, and from the
skin to what lights it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
import torch

from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_to_corner
from express50.geometry.raycast import mesh_scene
from express50.head.model import HeadModel, pose, vertex_normals
from express50.landmarks.training.poses import random_parameters
from express50.landmarks.training.skin import Canvas, deform, paint, waves
from pipelines.track.chart.disturb import Case, covered, photographed
from pipelines.track.chart.layout import Chart, sampled
from pipelines.track.chart.light import Lamps, draw_cameras, draw_lamps
from pipelines.track.samples import Visibility, sample_normals

Rng = np.random.Generator
# Root mean square of what the drawn trackers are off along the skin, metres: from least to most.
OFF_M = (0.0004, 0.005)
# Share of trackers that have the face but miss what some muscles do to it.
LATE = 0.5
# Further than this from the true skin a place of the wrong mesh shows nothing to learn from.
REACH_M = 0.008
# What lies further off along the skin is another part of the face, such as the other lip.
FAR_TEXELS = 12.0


@dataclass(frozen=True)
class Person:
    """Colours of a head: (HEIGHT, WIDTH, 3) of its chart, (V, 3) of what the chart does not show.

    The background's colour (3,) and the skin's gloss come with them.
    """

    map: np.ndarray
    vertices: np.ndarray
    background: np.ndarray
    gloss: float


def draw_person(model: HeadModel, chart: Chart, rng: Rng) -> Person:
    """Paint a head."""
    whole = Canvas.of(model)
    corners, bary = chart.samples.corners, chart.samples.bary
    region = {name: (mask[corners] * bary).sum(1) for name, mask in whole.region.items()}
    rest = (whole.rest[corners] * bary[..., None]).sum(1)
    # Lips end where they end, not where a mesh's edges happen to run.
    ragged = rng.uniform(0.0, 0.2) * waves(rest, rng, 8, 200.0, 900.0)
    inside = {name: share > 0.5 for name, share in region.items()}
    if "lips" in region:
        inside["lips"] = region["lips"] > 0.5 + ragged
    canvas = Canvas(rest, inside, whole.marks)
    background = rng.uniform(0.0, 1.0, 3)
    return Person(
        chart.image(paint(canvas, rng)[0]),
        paint(whole, rng)[0],
        background.astype(np.float32),
        float(rng.uniform(0.0, 0.3)),
    )


def draw_case(model: HeadModel, chart: Chart, person: Person, rng: Rng) -> Case:
    """Let a person act, look from some cameras and read the chart of a mesh that is off."""
    true, wrong = draw_meshes(model, chart, rng)
    lamps = draw_lamps(rng)
    head = _Head(model, chart, person, true, lamps, rng)
    places, normals = chart.samples.at(wrong), sample_normals(chart.samples, wrong)
    visibility = Visibility(wrong, model.faces.numpy())
    total, mass = np.zeros_like(places), np.zeros(len(places))
    for camera in draw_cameras(places, rng):
        weight = visibility.weights(camera, places, normals) ** 2
        chosen = np.flatnonzero(weight)
        color = head.seen(camera, places[chosen])
        total[chosen] += weight[chosen, None] * color
        mass[chosen] += weight[chosen]
    colors = chart.image(total / np.maximum(mass, 1e-6)[:, None])
    colors = photographed(covered(colors, rng), rng)
    flow, valid = head.flow(places, normals)
    return Case(
        np.rint(255.0 * np.clip(colors, 0.0, 1.0)).astype(np.uint8),
        chart.image(flow).astype(np.float16),
        chart.image((valid & chart.skin & (mass > 0.02))[:, None])[..., 0],
    )


def draw_meshes(model: HeadModel, chart: Chart, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), (V, 3) of an acting head and of a tracker's idea of it, float64."""
    draw = random_parameters(model, rng)
    other = {name: value.clone() for name, value in draw.items()}
    # A tracker soon has the face (0.1 of what it is off by is left then); what it misses longest
    # is what a few muscles do to it.
    early = 0.1 if rng.random() < LATE else 1.0
    other["shape"] += torch.from_numpy(
        early * rng.uniform(0.0, 0.6) * rng.normal(size=other["shape"].shape)
    ).float()
    other["expression"] += torch.from_numpy(_slips(draw["expression"].numpy(), early, rng)).float()
    other["jaw"] += torch.from_numpy(rng.uniform(0.0, 0.05) * rng.normal(size=(1, 3))).float()
    other["eyes"] += torch.from_numpy(0.05 * rng.normal(size=(1, 6))).float()
    with torch.inference_mode():
        played, tracked = (pose(model, **one)[0].double().numpy() for one in (draw, other))
    true = deform(played.astype(np.float32), rng).astype(np.float64)
    off = tracked - played
    for low, high, share in ((10.0, 60.0, 0.003), (60.0, 200.0, 0.001)):
        field = np.stack([waves(true, rng, 6, low, high) for _ in range(3)], axis=1)
        off += early * rng.uniform(0.0, share) * field
    normals = vertex_normals(torch.from_numpy(true)[None], model.faces)[0].numpy()
    # Along the normals the views agree better on where the skin is than along it.
    off -= rng.uniform(0.2, 1.0) * (off * normals).sum(1, keepdims=True) * normals
    face = np.unique(chart.samples.corners[chart.skin])
    size = np.sqrt((off[face] ** 2).sum(1).mean())
    wanted = np.exp(rng.uniform(*np.log(OFF_M)))
    return true, true + off * (wanted / max(float(size), 1e-9))


def _slips(expression: np.ndarray, early: float, rng: Rng) -> np.ndarray:
    """What a tracker has wrong of an expression (1, X): any muscle early, then such as act."""
    muscles = rng.random(expression.shape) < early * rng.uniform(0.0, 0.4)
    slips = rng.uniform(0.0, 0.5) * rng.normal(size=muscles.shape) * muscles
    missed = rng.random(expression.shape) < (1.0 - early) * rng.uniform(0.0, 0.8)
    return slips - missed * rng.uniform(-0.2, 1.0, expression.shape) * expression


class _Head:
    """A true, painted head in a ray caster, and the light that gets to its vertices."""

    def __init__(
        self,
        model: HeadModel,
        chart: Chart,
        person: Person,
        vertices: np.ndarray,
        lamps: Lamps,
        rng: Rng,
    ) -> None:
        self.chart, self.person, self.faces = chart, person, model.faces.numpy()
        self.scene = mesh_scene(vertices, self.faces)
        normals = vertex_normals(torch.from_numpy(vertices)[None], model.faces)[0]
        self.normals = normals.numpy().astype(np.float32)
        self.front = chart.front
        self.lamps = lamps
        self.reach = lamps.reach(self.scene, vertices, self.normals, rng)

    def seen(self, camera: Camera, places: np.ndarray) -> np.ndarray:
        """Root of light (N, 3) where a camera looks for places (N, 3)."""
        towards = places - camera.center
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        origin = np.broadcast_to(camera.center, places.shape)
        hit, face, bary = self._cast(np.concatenate([origin, towards], axis=1))
        color = np.tile(self.person.background, (len(places), 1))
        face, bary = face[hit], bary[hit]
        albedo = self._albedo(face, bary)
        normals = (self.normals[self.faces[face]] * bary[..., None]).sum(1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        reach = (self.reach[self.faces[face]] * bary[..., None]).sum(1)
        light = self.lamps.lit(albedo, normals, reach, -towards[hit], self.person.gloss)
        color[hit] = np.clip(light, 0.0, 1.0)
        return np.sqrt(color)

    def flow(self, places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the true skin at places (N, 3) of the wrong mesh belongs: (N, 2), known (N,)."""
        rays = np.concatenate([places + REACH_M * normals, -normals], axis=1)
        hit, face, bary = self._cast(rays, 2 * REACH_M)
        hit &= self.front[face]
        where = (self.chart.places[self.faces[face]] * bary[..., None]).sum(1)
        own = cell_to_corner(self.chart.texels[:, ::-1])
        hit &= np.linalg.norm(where - own, axis=1) < FAR_TEXELS
        return np.where(hit[:, None], where - own, 0.0), hit

    def _albedo(self, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        corners = self.faces[face]
        plain = (self.person.vertices[corners] * bary[..., None]).sum(1)
        mapped = sampled(self.person.map, (self.chart.places[corners] * bary[..., None]).sum(1))
        return np.where(self.front[face][:, None], mapped, plain)

    def _cast(
        self, rays: np.ndarray, far: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whether rays (N, 6) hit (N,), the faces (N,) and the shares of their corners (N, 3)."""
        cast = self.scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
        distance, u = cast["t_hit"].numpy(), cast["primitive_uvs"].numpy()
        hit = np.isfinite(distance) & (distance < far)
        face = np.where(hit, cast["primitive_ids"].numpy(), 0).astype(np.int64)
        return hit, face, np.stack([1 - u.sum(1), u[:, 0], u[:, 1]], axis=1)
