"""Label the pixels of a view by the tracked head's geometry, and cut the torso off its matte."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import open3d as o3d

from express50.contract.segmentation_labels import HEAD, LABELS, label_mask
from express50.geometry.cameras import Camera, cut_about, project, rays, unproject
from express50.geometry.conventions import opencv_pixels_to_corner
from express50.geometry.meshes import mesh_parts
from express50.geometry.pixels import disc, edge_distance
from express50.geometry.raycast import barycentrics, join_rays, mesh_scene
from express50.head.load import HeadTopology

if TYPE_CHECKING:
    from express50.head.model import HeadModel

SCALP = len(LABELS)
"""Skin that may bear hair: a label of the mesh alone, never written."""
HAIR, TORSO = np.uint8(LABELS.index("hair")), np.uint8(LABELS.index("torso"))
FACE = ("skin", "lips", "eyes")  # labels of the face; what opens behind lips lies off the mesh
BEARINGS = 36  # around the neck, at which the height of its lower end is known
CLEAR_M, HAND_M, WIDTH_M = 0.007, 0.022, 0.006  # off the face; a hand's back; least width
RIM_M = 0.005  # what juts out this far beyond the mesh is still what the mesh shows there
# Labels of skin that is seen from outside only; from inside it is seen through the neck's open end.
_OUTER = tuple(LABELS.index(name) for name in ("skin", "ears", "lips", "neck")) + (SCALP,)

# Later rows win: lids and lips are skin to some models, teeth are mouth to others.
_REGIONS = (
    ("neck", ("neck", "boundary")),
    ("skin", ("face", "forehead", "nose", "left_eye_region", "right_eye_region")),
    ("ears", ("left_ear", "right_ear")),
    ("lips", ("lips",)),
    ("mouth", ("mouth_interior",)),
    ("tongue", ("tongue",)),
    ("teeth", ("teeth", "upper_teeth", "lower_teeth")),
    ("eyes", ("left_eyeball", "right_eyeball")),
)


@dataclass(frozen=True)
class HeadLabels:
    """The labels of a head model."""

    faces: np.ndarray  # (F, 3) that can be seen; sheets without a region (lash cards) are left out
    vertices: np.ndarray  # (V,) uint8 indices into LABELS, or SCALP
    end: np.ndarray  # (n,) indices of the vertices around the neck's lower end; empty if unknown
    missing: tuple[str, ...]  # names of LABELS that the model cannot give


def head_labels(model: HeadModel | HeadTopology) -> HeadLabels:
    """Label a model's vertices by its regions; a vertex without one is skin."""
    masks = {name: np.asarray(mask) for name, mask in model.regions.items()}
    none = np.zeros(len(model.template), bool)
    scalp = masks.get("scalp", none)
    labels = np.where(scalp, SCALP, LABELS.index("skin")).astype(np.uint8)
    for label, names in _REGIONS:
        for name in names:
            labels[masks.get(name, none)] = LABELS.index(label)
    faces = np.asarray(model.faces)
    present = set(np.unique(labels[faces]).tolist()) | {LABELS.index("background")}
    by_mesh = [label for label, _ in _REGIONS if LABELS.index(label) not in present]
    end = np.flatnonzero(masks.get("boundary", none))
    missing = [*by_mesh, *(["torso"] if len(end) < 3 else [])]
    named = np.any(list(masks.values()), axis=0) if masks else ~none
    # Connected sheets without a vertex of any region are lash cards.
    sheet = mesh_parts(faces, len(none))
    kept = np.isin(sheet, sheet[named])
    return HeadLabels(faces[kept[faces[:, 0]]], labels, end, tuple(missing))


@dataclass(frozen=True)
class NeckEnd:
    """The neck's lower end: a height by bearing, in axes of the head, level beyond the neck."""

    center: np.ndarray  # (3,) middle of the end, world
    R: np.ndarray  # (3, 3) world from head axes; y up
    heights: np.ndarray  # (BEARINGS,) metres above the middle

    def height(self, points: np.ndarray) -> np.ndarray:
        """Measure metres (N,) of points (N, 3), world, above the end; negative below."""
        x, y, z = ((points - self.center) @ self.R).T
        place = np.arctan2(z, x) / (2 * np.pi) * BEARINGS
        return y - np.interp(place, np.arange(BEARINGS), self.heights, period=BEARINGS)


@dataclass(frozen=True)
class TrackedHead:
    """One expression's mesh, ready to be seen."""

    vertices: np.ndarray  # (V, 3) world, metres
    R: np.ndarray  # (3, 3) world from head axes; y up, z along the gaze
    labels: HeadLabels  # the head model's
    end: NeckEnd | None  # the neck's lower end; None if the model does not mark it
    center: np.ndarray  # (3,) origin of the scene, which keeps digits far from the world's origin
    scene: o3d.t.geometry.RaycastingScene  # for casting rays

    def faces_camera(self, camera: Camera) -> bool:
        """Return whether a camera stands in front of the face, not behind the head."""
        return bool((camera.center - self.center) @ self.R[:, 2] > 0)

    def metre_px(self, camera: Camera) -> float:
        """Return the number of pixels that a metre spans at the head in a camera."""
        return float(camera.K[0, 0] / np.linalg.norm(self.center - camera.center))


def make_head(vertices: np.ndarray, R: np.ndarray, labels: HeadLabels) -> TrackedHead:
    """Make a head of tracked vertices (V, 3), world, and its rotation (3, 3), world from head."""
    center = vertices.mean(0)
    scene = mesh_scene(vertices - center, labels.faces)
    if "torso" in labels.missing:
        return TrackedHead(vertices, R, labels, None, center, scene)
    loop = vertices[labels.end]
    middle = 0.5 * (loop.min(0) + loop.max(0))
    x, y, z = ((loop - middle) @ R).T
    place = np.arctan2(z, x) / (2 * np.pi) * BEARINGS
    order = np.argsort(place, kind="stable")
    heights = np.interp(np.arange(BEARINGS), place[order], y[order], period=BEARINGS)
    return TrackedHead(vertices, R, labels, NeckEnd(middle, R, heights), center, scene)


def render_head(head: TrackedHead, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Cast a pinhole camera's rays at a head alone: labels (H, W) uint8 and depth (H, W) float32.

    Depth is camera z, metres; both are 0 beside the head.
    """
    labels = np.zeros((camera.height, camera.width), np.uint8)
    depth = np.zeros(labels.shape, np.float32)
    pixels, ahead = project(camera, head.vertices)
    if not (ahead > 0).any():
        return labels, depth
    part, window = camera, np.s_[:, :]
    if (ahead > 0).all():  # elsewhere no ray meets the head
        part, window = cut_about(camera, pixels)
    origin, directions = rays(part)
    hits = head.scene.cast_rays(join_rays(origin - head.center, directions), nthreads=1)
    distance = hits["t_hit"].numpy()
    hit = np.isfinite(distance) & (distance > 0)
    corner = barycentrics(hits, hit).argmax(1)
    vertex = head.labels.faces[hits["primitive_ids"].numpy()[hit], corner]
    found = head.labels.vertices[vertex]
    away = (hits["primitive_normals"].numpy()[hit] * directions[hit]).sum(1) > 0
    found = np.where(away & np.isin(found, _OUTER), np.uint8(0), found)
    labels[window][hit] = found
    depth[window][hit] = np.where(found > 0, distance[hit], 0)
    return labels, depth


@dataclass(frozen=True)
class HeadGeometry:
    """Every pixel of one camera relative to the tracked head."""

    mesh: np.ndarray  # (H, W) uint8 label of the mesh, SCALP among them, 0 beside it
    depth: np.ndarray  # (H, W) float32 camera z of the mesh, metres, 0 beside it
    near: np.ndarray  # (H, W) uint8 label at the nearest pixel of the mesh; 0 if no pixel shows it
    rim: np.ndarray  # (H, W) bool, just beyond the mesh
    height: np.ndarray  # (H, W) float32 metres above the neck's end; inf if that is unknown
    # (H, W) float32 metres from the mesh to what is in front of its face; 0 where nothing is
    # CLEAR_M in front of it
    off: np.ndarray

    def labels(self) -> np.ndarray:
        """Label all pixels (H, W) uint8 by geometry alone, whatever the matte.

        The mesh and its rim have the mesh's labels; what lies below the neck's end is torso, and
        everything else is hair.
        """
        around = np.where(self.rim, self.near, HAIR)
        return np.where(self.mesh > 0, self.mesh, np.where(self.height < 0, TORSO, around))


def head_geometry(
    head: TrackedHead, camera: Camera, alpha: np.ndarray, depth: np.ndarray | None
) -> HeadGeometry:
    """Place a pinhole camera's pixels relative to a head, with a rim of `RIM_M` metres.

    Depth (H, W) is camera z, metres. Where it is 0, unknown, the nearest known pixel of the matte
    (H, W) replaces it; without a depth map, the mesh's own depth does. If no pixel shows the mesh,
    all pixels are far below the neck's end.
    """
    mesh, mesh_depth = render_head(head, camera)
    hit = mesh > 0
    if not hit.any():
        height = np.full(mesh.shape, np.inf if head.end is None else -np.inf, np.float32)
        return HeadGeometry(mesh, mesh_depth, mesh, hit, height, np.zeros_like(height))
    row, column, pixels = nearest(hit)
    surface = mesh_depth[row, column]
    rim = ~hit & (pixels * surface / camera.K[0, 0] <= RIM_M)
    known = hit if depth is None else (alpha > 0) & (depth > 0)
    if depth is not None and known.any():
        there = nearest(known)[:2]
        surface = depth[there]
    height = np.full(mesh.shape, np.inf, np.float32)
    off = np.zeros(mesh.shape, np.float32)
    y, x = np.nonzero(alpha > 0)
    points = unproject(camera, opencv_pixels_to_corner(np.stack([x, y], axis=1)), surface[y, x])
    if head.end is not None:
        height[y, x] = head.end.height(points)
    if depth is not None:
        # Nothing is further from the mesh than along its own ray; searching takes long.
        scale = np.linalg.norm(points - camera.center, axis=1) / np.maximum(surface[y, x], 1e-9)
        before = (depth[y, x] > 0) & ((mesh_depth[y, x] - depth[y, x]) * scale > CLEAR_M)
        before &= label_mask(mesh, *FACE)[y, x]
        places = o3d.core.Tensor((points[before] - head.center).astype(np.float32))
        off[y[before], x[before]] = head.scene.compute_distance(places, nthreads=1).numpy()
    return HeadGeometry(mesh, mesh_depth, mesh[row, column], rim, height, off)


def find_hands(geometry: HeadGeometry, labels: np.ndarray, metre_px: float) -> np.ndarray:
    """Find hands (H, W) bool: wide things far in front of the face.

    Only parts that are clear of the mesh count, without what `labels` (H, W) call hair.
    ``metre_px`` is the number of pixels that a metre spans at the head.
    """
    clear = label_mask(geometry.mesh, *FACE) & (geometry.off > CLEAR_M) & (labels != HAIR)
    narrow = disc(max(1, int(WIDTH_M * metre_px) // 2))
    solid = cv2.morphologyEx(clear.astype(np.uint8), cv2.MORPH_OPEN, narrow)
    count, part = cv2.connectedComponents(solid, connectivity=8)
    far = [k for k in range(1, count) if np.quantile(geometry.off[part == k], 0.9) > HAND_M]
    return np.isin(part, far)


def nearest(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find row, column and distance in pixels (H, W) of the nearest pixel of a mask (H, W)."""
    distance, cell = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    places = np.zeros(int(cell.max()) + 1, np.int64)
    places[cell[mask]] = np.flatnonzero(mask)
    row, column = np.divmod(places[cell], mask.shape[1])
    return row, column, distance


def head_alpha(alpha: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Keep the alpha (H, W) of the head alone by labels (h, w), which may be smaller.

    Pixels of neither (strands that a network calls background, glasses, hats, collars) go with the
    nearer of head and torso. The cut is a pixel of the matte wide. Without a head the matte is
    empty, without a torso it is unchanged.
    """
    head, torso = label_mask(labels, *HEAD), label_mask(labels, "torso")
    if not head.any() or not torso.any():
        return alpha * np.float32(head.any())
    nearer = edge_distance(~torso) - edge_distance(~head)
    if labels.shape != alpha.shape:
        size = alpha.shape[1], alpha.shape[0]
        nearer = cv2.resize(nearer, size, interpolation=cv2.INTER_LINEAR)
        nearer *= max(alpha.shape) / max(labels.shape)
    return alpha * np.clip(0.5 + nearer / 2, 0, 1).astype(np.float32)
