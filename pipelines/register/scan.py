"""Register a scan: find its face, fit a head model to it, and lay the mesh onto it.

No pose, landmarks or texture are needed. The scan is drawn from all sides, the landmark detector
finds the face in these pictures, and its points are triangulated. Given landmarks replace the
detector's and show where the face is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import open3d as o3d
import torch

from express50.errors import StageError
from express50.geometry.cameras import Camera, pinhole_camera, rays
from express50.geometry.pixels import linear_to_srgb
from express50.geometry.raycast import barycentrics, join_rays, mesh_scene
from express50.geometry.transforms import look_at, rigid_fit
from express50.head.load import load_head
from express50.head.model import HeadModel, landmarks_of
from express50.landmarks import EMBEDDED
from express50.landmarks.sources import Source, open_source
from pipelines.register.lay import (
    GivenSurface,
    LaidMesh,
    SurfaceSearch,
    bare_skin,
    folded,
    lay,
    mesh_normals,
    skin_trust,
    trusted_vertices,
)
from pipelines.register.scan_input import GIVEN_M, Scan, check_face
from pipelines.track.basis import OFF, Basis, make_basis
from pipelines.track.fit import fit
from pipelines.track.observe import JAW_LINE_WEIGHT, LandmarkView, Observation, triangulate_views
from pipelines.track.stage import fit_landmarks
from pipelines.track.state import INNER, MIN_TRIANGULATED, State, Target, all_vertices
from pipelines.track.terms import MeshPlaces, NormalTerm, PointTerm, landmark_anchors

REACHES = (0.015, 0.010, 0.006, 0.004)  # search distance per round of the parameters' fit, metres
ROUND_STEPS, SIGMA_M = 4, 0.0012
DETAIL_M = 0.008  # finest wavelength that the mesh follows; fine, because scans have little noise
SIDE, AWAY_M, SPAN_M = 400, 1.2, 0.34  # of a picture: pixels, camera's distance, width of the view
YAWS, PITCHES = (-50.0, -25.0, 0.0, 25.0, 50.0), (-15.0, 15.0)
LEAST_SCORE = 0.2
CHIN, NOSE_BRIDGE = 8, 27
HALF_HEAD_M = 0.06
OFF_SCAN_M = 0.02  # given landmarks must lie this near, even on hair or at the rim of a hole
INWARDS = (
    "its triangles face inwards: it is inside out, or mirrored; flip its triangles, or mirror it"
    " back"
)
FacePose = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Middle of a face, its direction up and the direction it looks in, each (3,)."""


@dataclass(frozen=True)
class FittedScan:
    """Parameters of a head model for a scan, and the mesh laid onto it."""

    basis: Basis
    targets: list[Target]
    state: State
    start: np.ndarray
    laid: LaidMesh


def fit_scan(scan: Scan, head: str, given: np.ndarray | None = None) -> FittedScan:
    """Fit a head model to a scan, helped by given landmarks (68, 3), NaN where unknown.

    Raises:
        StageError: no face is found, or the landmarks do not belong to the scan.
        HeadModelError: the head model cannot be loaded.
    """
    torch.set_num_threads(1)
    basis = make_basis(load_head(head))
    template = landmarks_of(basis.model)
    given = np.full((68, 3), np.nan) if given is None else given
    observation = find_landmarks(scan, template, given)
    check_face(observation.points, template, "the landmarks of the face that is seen")
    known, anchors = np.flatnonzero(np.isfinite(given[:, 0])), landmark_anchors(basis.model)
    rows = (known[known > 16], GIVEN_M), (known[known < 17], GIVEN_M / JAW_LINE_WEIGHT)
    terms = tuple(
        PointTerm(anchors.some(ids), given[ids], sigma) for ids, sigma in rows if len(ids)
    )
    # The scan may show any expression: none counts as neutral.
    targets, state, lost = fit_landmarks(basis, [observation], "", terms)
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
        skin = bare_skin(model, start, scan.vertices)
        trust = skin_trust(model, start, scan.vertices, shades, trust, skin)
    laid = lay(model, start, replace(surface, trust=trust), DETAIL_M)
    return FittedScan(basis, targets, state, start, laid)


def surface_term(
    model: HeadModel, search: SurfaceSearch, mesh: np.ndarray, reach: float
) -> NormalTerm:
    """Make the term that pulls a mesh's vertices (V, 3) to the scan within `reach` metres."""
    normals = mesh_normals(mesh, model.faces)
    height, trust = search.heights(mesh, normals, reach)
    trust = trust * trusted_vertices(model) * ~folded(mesh, normals, model.faces.numpy())
    ids = np.flatnonzero(trust > 0)
    goals = mesh[ids] + height[ids, None] * normals[ids]
    sigma = SIGMA_M / np.sqrt(trust[ids])
    return NormalTerm(MeshPlaces.of_vertices(ids), goals, normals[ids], sigma, 0.5 * reach)


def find_landmarks(scan: Scan, template: np.ndarray, given: np.ndarray) -> Observation:
    """Find the landmarks of a scan's face in pictures of it.

    Given landmarks (68, 3), NaN where unknown, replace those that are found; they are checked
    against those (68, 3) of a head model's template.

    Raises:
        StageError: no picture shows a face, or the given landmarks do not belong to the scan.
    """
    source, painter, known = open_source(EMBEDDED, {}), ScanPainter(scan), np.isfinite(given[:, 0])
    if known.any():
        painter.check_near(given)
        check_face(given, template, "the given landmarks")
        turn, shift = rigid_fit(template[known], given[known])
        middle = turn @ (template.mean(0) - [0.0, 0.0, HALF_HEAD_M]) + shift
        pose = middle, turn[:, 1], turn[:, 2]
    else:
        pose = find_face(source, painter)
    middle, up, ahead = pose
    if painter.picture(place_camera(middle, ahead, up, SPAN_M))[1] > 0.5:
        raise StageError(INWARDS)
    views = views_about_face(source, painter, pose)
    if len(views) >= 2:
        found = triangulate_views("scan", 0, views)[0]
    elif known[INNER].sum() >= MIN_TRIANGULATED:
        nothing = np.full((68, 3), np.nan), np.full((68, 3, 3), np.nan)
        found = Observation("scan", 0, (), np.zeros((0, 68), bool), *nothing)
    else:
        raise StageError(
            "fewer than two sides of the scan show a face; if most of it is missing, give at"
            f" least {MIN_TRIANGULATED} landmarks between brows and mouth"
        )
    return replace(
        found,
        points=np.where(known[:, None], given, found.points),
        covariance=np.where(known[:, None, None], GIVEN_M**2 * np.eye(3), found.covariance),
        inliers=found.inliers & ~known,
    )


def find_face(source: Source, painter: ScanPainter) -> FacePose:
    """Find a face in pictures from all sides; StageError if no picture shows one."""
    low, high = painter.scan.vertices.min(0), painter.scan.vertices.max(0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    best, found, turned = None, -1.0, []
    for way in np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), -1).reshape(-1, 3):
        if np.abs(way).sum() in (1.0, 3.0):  # the axes and the diagonals
            camera = place_camera(middle, way, np.eye(3)[np.abs(way).argmin()], 0.8 * size)
            picture, inwards = painter.picture(camera)
            turned.append(inwards)
            if inwards >= 0.5:  # the inside of a face, from behind
                continue
            face = source(picture, camera.id, 0).face
            if face.score > found:
                best, found = (camera, face), face.score
    if best is None or found < LEAST_SCORE:
        unseen = "no side of the scan shows a face; is it a head, its triangles facing out?"
        raise StageError(INWARDS if np.mean(turned) > 0.5 else unseen)
    # The face looks towards this camera, within 45 degrees; the landmarks show which way is up.
    camera, face = best
    axes = camera.cam_from_world[:3, :3]
    rise = face.points[NOSE_BRIDGE] - face.points[CHIN]
    return painter.middle_of(camera, face.points), rise @ axes[:2] / np.linalg.norm(rise), -axes[2]


def views_about_face(source: Source, painter: ScanPainter, pose: FacePose) -> list[LandmarkView]:
    """Draw a scan from in front of its face and around; return the views that show the face."""
    middle, up, ahead = pose
    right = np.cross(up, ahead)
    views: list[LandmarkView] = []
    for yaw in np.radians(YAWS):
        for pitch in np.radians(PITCHES):
            flat = ahead * np.cos(yaw) + right * np.sin(yaw)
            way = flat * np.cos(pitch) + up * np.sin(pitch)
            camera = place_camera(middle, way, up, SPAN_M, f"view{len(views):02d}")
            face = source(painter.picture(camera)[0], camera.id, 0).face
            if face.score >= LEAST_SCORE:
                views.append(LandmarkView(camera, face.points, face.sigma, face.score))
    return views


def place_camera(
    middle: np.ndarray, way: np.ndarray, up: np.ndarray, span: float, name: str = "view"
) -> Camera:
    """Place a camera in the direction `way` (3,) of `middle` (3,); it sees `span` metres across."""
    away = max(AWAY_M, 2.0 * span)
    focal = SIDE * away / span
    K = np.array([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1.0]])
    pose = look_at(middle + away * way / np.linalg.norm(way), middle, up)
    return pinhole_camera(name, K, SIDE, SIDE, pose)


class ScanPainter:
    """Draws a scan by ray casting, lit from beside the camera; the ray tree is built once.

    Triangles are lit on both sides, because some of a scan's may be turned over.
    """

    def __init__(self, scan: Scan) -> None:
        self.scan, self.centre = scan, scan.vertices.mean(0)
        self.scene = mesh_scene(scan.vertices - self.centre, scan.faces)
        self.normals = mesh_normals(scan.vertices, torch.from_numpy(scan.faces))

    def picture(self, camera: Camera) -> tuple[np.ndarray, float]:
        """Draw a picture (H, W, 3) uint8 sRGB; return it and the share of hits that face away."""
        origin, directions = rays(camera)
        hit = self.scene.cast_rays(join_rays(origin - self.centre, directions))
        seen = np.isfinite(hit["t_hit"].numpy())
        away = (hit["primitive_normals"].numpy()[seen] * directions[seen]).sum(1) > 0
        corners = self.scan.faces[hit["primitive_ids"].numpy()[seen].astype(np.int64)]
        weights = barycentrics(hit, seen)[..., None]
        normals = (self.normals[corners] * weights).sum(1)
        normals *= -np.sign((normals * directions[seen]).sum(1, keepdims=True))
        right, down, ahead = camera.cam_from_world[:3, :3]
        light = 0.3 * right - 0.5 * down - ahead
        shade = 0.25 + 0.75 * np.clip(normals @ light / np.linalg.norm(light), 0, 1)
        image = np.full((*seen.shape, 3), 0.05)
        image[seen] = (self.scan.colors[corners] * weights).sum(1) * shade[:, None]
        shown = np.rint(255 * linear_to_srgb(np.clip(image, 0, 1))).astype(np.uint8)
        return shown, float(away.mean()) if seen.any() else 0.0

    def check_near(self, given: np.ndarray) -> None:
        """Raise StageError if landmarks (68, 3), NaN where unknown, are far from the scan."""
        known = np.flatnonzero(np.isfinite(given).all(1))
        at = o3d.core.Tensor((given[known] - self.centre).astype(np.float32))
        away = self.scene.compute_distance(at).numpy()
        if (away > OFF_SCAN_M).any():
            raise StageError(
                f"the given landmarks: {(away > OFF_SCAN_M).sum()} of {len(known)} are off the scan"
                f", point {known[away.argmax()]} by {1e3 * away.max():.0f} mm, expected at most"
                f" {1e3 * OFF_SCAN_M:.0f} mm; give them in the unit and axes of the scan's file"
            )

    def middle_of(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return a head's middle (3,): half a head behind what the pixels (N, 2) show."""
        origin, directions = rays(camera)
        column, row = np.clip(points, 0, SIDE - 1).astype(np.int64).T
        hit = self.scene.cast_rays(join_rays(origin - self.centre, directions[row, column]))
        depth = hit["t_hit"].numpy()
        near = np.median(depth[np.isfinite(depth)]) if np.isfinite(depth).any() else AWAY_M
        ahead = camera.cam_from_world[2, :3]
        return (origin + near * directions[row, column]).mean(0) + HALF_HEAD_M * ahead
