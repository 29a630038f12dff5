"""Register a given scan: find the face by looking at it, fit the head model, lay the mesh onto it.

The scan is drawn from all sides, the landmark detector finds the face in these pictures, and the
cameras that drew them triangulate it. So neither a pose nor landmarks nor a texture is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from express50.errors import FormatError, StageError
from express50.files.images import linear_to_srgb, srgb_to_linear
from express50.geometry.cameras import Camera, pinhole_camera, rays
from express50.geometry.raycast import barycentrics, join_rays, mesh_scene
from express50.geometry.transforms import look_at
from express50.head.load import load_head
from express50.head.model import HeadModel
from express50.landmarks.sources import EMBEDDED, open_source
from pipelines.register.lay import (
    GivenSurface,
    LaidMesh,
    SurfaceSearch,
    folded,
    lay,
    mesh_normals,
    trusted_vertices,
)
from pipelines.register.skin import skin_trust
from pipelines.track.basis import OFF, Basis, make_basis
from pipelines.track.fit import fit
from pipelines.track.observe import LandmarkView, Observation, agree
from pipelines.track.stage import fit_landmarks
from pipelines.track.state import State, Target, all_vertices
from pipelines.track.terms import MeshPlaces, NormalTerm

KINDS = (".obj", ".ply", ".glb", ".stl")
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
SMALLEST_M, LARGEST_M = 0.12, 1.2  # longest side of a scan of a face, or of a head with shoulders
LEAST_FACES = 500
GREY = 0.5  # of scans without colours, linear light
SIDE, AWAY_M, SPAN_M = 400, 1.2, 0.34  # of the pictures: pixels, distance, what is seen across
YAWS, PITCHES = (-50.0, -25.0, 0.0, 25.0, 50.0), (-15.0, 15.0)
LEAST_SCORE = 0.2
CHIN, NOSE_BRIDGE = 8, 27
HALF_HEAD_M = 0.06
REACHES = (0.015, 0.010, 0.006, 0.004)  # of the search, per round of the fit of parameters; metres
ROUND_STEPS, SIGMA_M = 4, 0.0012
DETAIL_M = 0.008  # wavelength of the finest detail that is followed: scans have few errors


@dataclass(frozen=True)
class Scan:
    """A scan in metres: vertices (N, 3), faces (F, 3), colors (N, 3) in linear light.

    `unit` is the one of the file, a key of UNITS; `textured` says whether the file has colours.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    unit: str
    textured: bool


@dataclass(frozen=True)
class FittedScan:
    """Parameters of a head model for a scan, and the mesh laid onto it."""

    basis: Basis
    targets: list[Target]
    state: State
    start: np.ndarray
    laid: LaidMesh


def read_scan(path: Path) -> Scan:
    """Read a scan; its unit is recognised by its size.

    Raises:
        FormatError: it is not a mesh, is damaged, too coarse, or of no size that a head has.
    """
    import trimesh

    if path.suffix.lower() not in KINDS:
        raise FormatError(f"{path}: expected a mesh file, one of {', '.join(KINDS)}")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        shades = read_colours(mesh)
    except Exception as error:  # noqa: BLE001  # trimesh raises what the damage leads to
        raise FormatError(f"{path}: cannot be read as a mesh ({error}); export it again") from None
    if len(faces) < LEAST_FACES:
        raise FormatError(
            f"{path}: {len(faces)} triangles, expected at least {LEAST_FACES} for a face"
        )
    if not np.isfinite(vertices[faces]).all():
        raise FormatError(f"{path}: NaN or infinity in the vertices; remove these vertices")
    used, corners = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], corners.reshape(-1, 3)
    size = float(np.ptp(vertices, axis=0).max())
    unit = next((k for k, f in UNITS.items() if SMALLEST_M <= size * f < LARGEST_M), None)
    if unit is None:
        raise FormatError(
            f"{path}: its longest side is {size:.4g}; a scan of a head has {SMALLEST_M:g} to"
            f" {LARGEST_M:g} m, in {', '.join(UNITS)}: scale it, or cut away what is not the head"
        )
    light = np.full((len(used), 3), GREY)
    if shades is not None:
        light = srgb_to_linear(shades[used] / 255.0)
    return Scan(vertices * UNITS[unit], faces, light, unit, shades is not None)


def read_colours(mesh: Any) -> np.ndarray | None:
    """Return colours (N, 3), 0 to 255 sRGB, of a trimesh mesh's vertices; None if it has none."""
    visual, colours = mesh.visual, None
    if visual.kind == "vertex":
        colours = visual.vertex_colors
    elif visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        if image is not None and visual.uv is not None:
            colours = visual.to_color().vertex_colors
        else:
            colours = visual.vertex_attributes.get("color")
    if colours is None or len(colours) != len(mesh.vertices):
        return None
    return np.asarray(colours, np.float64)[:, :3]


def fit_scan(scan: Scan, head: str) -> FittedScan:
    """Fit a head model to a scan.

    Raises:
        StageError: no face is found.
        HeadModelError: the head model cannot be loaded.
    """
    torch.set_num_threads(1)
    basis = make_basis(load_head(head))
    observation = look(scan)
    targets, state, lost = fit_landmarks(basis, [observation], neutral="")  # it may be any face
    if lost:
        raise StageError(f"the scan's landmarks fit no head: {lost[0].why}")
    model, trust = basis.model, np.ones(len(scan.vertices))
    surface = GivenSurface(scan.vertices, scan.faces, trust)
    search = SurfaceSearch(surface)
    for reach in REACHES:
        mesh = all_vertices(model, state)[0]
        term = surface_term(model, search, mesh, reach)
        seen = replace(targets[0], terms=(*targets[0].terms, term))
        state, _ = fit(basis, [seen], state, ROUND_STEPS, (OFF,))
    start = all_vertices(model, state)[0]
    if scan.textured:
        shades = np.rint(255 * linear_to_srgb(scan.colors)).astype(np.uint8)
        trust = skin_trust(model, start, scan.vertices, shades, trust)
    laid = lay(model, start, replace(surface, trust=trust), DETAIL_M)
    return FittedScan(basis, targets, state, start, laid)


def surface_term(
    model: HeadModel, search: SurfaceSearch, mesh: np.ndarray, reach: float
) -> NormalTerm:
    """Make the term that pulls a mesh's (V, 3) vertices to the scan, as far as it is found."""
    normals = mesh_normals(mesh, model.faces)
    height, trust = search.heights(mesh, normals, reach)
    trust = trust * trusted_vertices(model) * ~folded(mesh, normals, model.faces.numpy())
    ids = np.flatnonzero(trust > 0)
    goals = mesh[ids] + height[ids, None] * normals[ids]
    sigma = SIGMA_M / np.sqrt(trust[ids])
    return NormalTerm(MeshPlaces.of_vertices(ids), goals, normals[ids], sigma, 0.5 * reach)


def look(scan: Scan) -> Observation:
    """Find the landmarks of a scan's face in pictures of it.

    Raises:
        StageError: no picture shows a face.
    """
    source = open_source(EMBEDDED, {})
    painter = ScanPainter(scan)
    low, high = scan.vertices.min(0), scan.vertices.max(0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    best, found = None, -1.0
    for way in np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), -1).reshape(-1, 3):
        if np.abs(way).sum() in (1.0, 3.0):  # the axes and the diagonals
            camera = place_camera(middle, way, np.eye(3)[np.abs(way).argmin()], 0.8 * size)
            face = source(painter.picture(camera), camera.id, 0).face
            if face.score > found:
                best, found = (camera, face), face.score
    if best is None or found < LEAST_SCORE:
        raise StageError("no side of the scan shows a face; is it a head, not inside out?")
    # The way that the face looks is known to 45 degrees, its top by the landmarks.
    camera, face = best
    axes = camera.cam_from_world[:3, :3]
    rise = face.points[NOSE_BRIDGE] - face.points[CHIN]
    up = rise @ axes[:2] / np.linalg.norm(rise)
    middle, towards = painter.middle_of(camera, face.points), -axes[2]
    right = np.cross(up, towards)
    views: list[LandmarkView] = []
    for yaw in np.radians(YAWS):
        for pitch in np.radians(PITCHES):
            flat = towards * np.cos(yaw) + right * np.sin(yaw)
            way = flat * np.cos(pitch) + up * np.sin(pitch)
            camera = place_camera(middle, way, up, SPAN_M, f"view{len(views):02d}")
            face = source(painter.picture(camera), camera.id, 0).face
            if face.score >= LEAST_SCORE:
                views.append(LandmarkView(camera.id, camera, face.points, face.sigma, face.score))
    if len(views) < 2:
        raise StageError("fewer than two sides of the scan show a face; is most of it missing?")
    return agree("scan", 0, views)[0]


def place_camera(
    middle: np.ndarray, way: np.ndarray, up: np.ndarray, span: float, name: str = "view"
) -> Camera:
    """Place a camera that looks at `middle` (3,) from `way` (3,) and sees `span` metres across."""
    away = max(AWAY_M, 2.0 * span)
    focal = SIDE * away / span
    K = np.array([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1.0]])
    pose = look_at(middle + away * way / np.linalg.norm(way), middle, up)
    return pinhole_camera(name, K, SIDE, SIDE, pose)


class ScanPainter:
    """Draws a scan by ray casting, lit from beside the camera; the ray tree is built once."""

    def __init__(self, scan: Scan) -> None:
        self.scan, self.centre = scan, scan.vertices.mean(0)
        self.scene = mesh_scene(scan.vertices - self.centre, scan.faces)
        self.normals = mesh_normals(scan.vertices, torch.from_numpy(scan.faces))

    def picture(self, camera: Camera) -> np.ndarray:
        """Draw a picture (H, W, 3) uint8 sRGB."""
        origin, directions = rays(camera)
        hit = self.scene.cast_rays(join_rays(origin - self.centre, directions))
        seen = np.isfinite(hit["t_hit"].numpy())
        corners = self.scan.faces[hit["primitive_ids"].numpy()[seen].astype(np.int64)]
        weights = barycentrics(hit, seen)[..., None]
        normals = (self.normals[corners] * weights).sum(1)
        right, down, ahead = camera.cam_from_world[:3, :3]
        light = 0.3 * right - 0.5 * down - ahead
        shade = 0.25 + 0.75 * np.clip(normals @ light / np.linalg.norm(light), 0, 1)
        image = np.full((*seen.shape, 3), 0.05)
        image[seen] = (self.scan.colors[corners] * weights).sum(1) * shade[:, None]
        return np.rint(255 * linear_to_srgb(np.clip(image, 0, 1))).astype(np.uint8)

    def middle_of(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return the middle (3,) of the scan's places at pixels (N, 2), half a head behind."""
        origin, directions = rays(camera)
        column, row = np.clip(points, 0, SIDE - 1).astype(np.int64).T
        hit = self.scene.cast_rays(join_rays(origin - self.centre, directions[row, column]))
        depth = hit["t_hit"].numpy()
        near = np.median(depth[np.isfinite(depth)]) if np.isfinite(depth).any() else AWAY_M
        ahead = camera.cam_from_world[2, :3]
        return (origin + near * directions[row, column]).mean(0) + HALF_HEAD_M * ahead
