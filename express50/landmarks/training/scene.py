"""Render random heads, painted per pixel, in the light of rooms, streets and flashes, with glasses.

Most light is as in photographs: from above or from the camera, soft, with shadows. The rest comes
from anywhere in any colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import open3d as o3d

from express50.geometry.conventions import cell_to_corner, corner_to_cell
from express50.geometry.raycast import barycentrics, join_rays, mesh_scene
from express50.geometry.transforms import make_transform, similarity_fit, transform_points, unit
from express50.head.load import load_builtin
from express50.head.model import HeadModel, landmarks_of
from express50.landmarks.training.random_heads import (
    LASHES,
    RandomHead,
    closest_places,
    paint,
    waves,
)

FRAME_SIDE_M = 0.38
HIDING_M = 0.005  # what lies this far or less in front of a landmark does not hide it
OPEN_RAYS, OPEN_M = 4, 0.08  # rays per vertex that measure the ambient light, and their length
GLASSES_SHARE, NATURAL_SHARE = 0.25, 0.75
LASHES_SHARE = 0.3  # of the heads with lashes that keep them: opaque lashes look too dense
RING = 24  # corners of a lens
# The outline of a face.
EYE_BAND_M, CHIN_BAND_M = 0.005, 0.004  # around the height of the eye corners; around the middle
MASK_SIDE, MASK_SHARE = 512, 0.9  # side of the face's mask, pixels, and the face's share of it
SMOOTHING = 6  # pixels of the mask, because the face ends along triangles
HALF = 8  # steps from an ear to the chin
Rng = np.random.Generator


@dataclass(frozen=True)
class TrainingView:
    """A rendered view."""

    rgba: np.ndarray  # (S, S, 4) uint8, black where empty
    points: np.ndarray  # (68 + 17, 2) float32 pixels, corner origin: landmarks, outline
    visible: np.ndarray  # (68,) bool, neither the head nor its glasses hide the landmark
    facing: np.float32  # cosine between the face's direction and that to the camera


@dataclass(frozen=True)
class _Hits:
    """First hits of rays: points, normals, directions to the camera (N, 3); pixels (S, S) bool."""

    points: np.ndarray
    normals: np.ndarray
    towards: np.ndarray
    openness: np.ndarray
    pixels: np.ndarray


class HeadScene:
    """A random head in a ray caster, which renders views of it."""

    def __init__(self, model: HeadModel, head: RandomHead) -> None:
        """Compile a head."""
        self.front = face_front(model)
        self.faces = model.faces.numpy()
        if LASHES in model.regions and head.look % 100 >= 100 * LASHES_SHARE:
            self.faces = self.faces[~model.regions[LASHES].numpy()[self.faces].all(1)]
        self.head = head
        self.canvas = head.canvas
        self.scene = mesh_scene(head.vertices, self.faces)
        # Share (V,) of the ambient light that reaches each vertex.
        rng, starts = np.random.default_rng(head.look), head.vertices + 6e-4 * head.normals
        free = np.zeros(len(starts), np.float32)
        for _ in range(OPEN_RAYS):
            way = unit(head.normals + unit(rng.normal(size=starts.shape).astype(np.float32)))
            free += ~self.scene.test_occlusions(join_rays(starts, way), 0.0, OPEN_M).numpy()
        self.openness = free / OPEN_RAYS

    def render(
        self, rng: Rng, side: int, yaw: float, close: tuple[np.ndarray, float] | None = None
    ) -> TrainingView:
        """Render (side, side) pixels from a yaw in radians, 0 in front; the rest is random.

        Shows the whole head, or `close`: a point (3,) and the metres around it.
        """
        marks = self.head.landmarks
        target, frame_m = close or (marks.mean(0) + np.array([0.0, 0.02, -0.06]), FRAME_SIDE_M)
        K, cam_from_world = _random_camera(target, frame_m, rng, side, yaw)
        rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
            intrinsic_matrix=o3d.core.Tensor(K),
            extrinsic_matrix=o3d.core.Tensor(cam_from_world),
            width_px=side,
            height_px=side,
        )
        rgba = self._shade(rays, rng)
        eye = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
        visible = self._seen(eye, marks)
        # Right eye to left eye is +x, brow to chin is -y: (-y) x (+x) = +z.
        forward = unit(np.cross(marks[8] - marks[27], marks[45] - marks[36]))
        facing = np.float32(forward @ unit(eye - marks[30]))
        projection = K @ cam_from_world[:3]
        pixels = project(projection, marks)
        if rng.random() < GLASSES_SHARE and facing > -0.1:
            for outline in self._wear_glasses(rgba, eye, projection, rng):
                ring = np.round(outline).astype(np.float32)
                visible &= [cv2.pointPolygonTest(ring, tuple(xy), False) <= 0 for xy in pixels]
        edge = self.front.outline(project(projection, self.head.skin), pixels)
        points = np.concatenate([pixels, edge]).astype(np.float32)
        return TrainingView(rgba, points, visible, facing)

    def _seen(self, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Mark the points (N, 3) that the head does not hide from an eye (3,)."""
        towards = points - eye
        share = self.scene.cast_rays(join_rays(eye, towards))["t_hit"].numpy()
        return (1.0 - share) * np.linalg.norm(towards, axis=1) < HIDING_M

    def _shade(self, rays: o3d.core.Tensor, rng: Rng) -> np.ndarray:
        """Cast rays, paint and light the hits; return rgba (side, side, 4) uint8."""
        cast = self.scene.cast_rays(rays)
        distance = cast["t_hit"].numpy()
        hit = np.isfinite(distance)
        face = self.faces[cast["primitive_ids"].numpy()[hit]]
        bary = barycentrics(cast, hit)
        canvas = self.canvas.at(face, bary)
        albedo = paint(canvas, np.random.default_rng(self.head.look))[0]
        normals = unit((self.head.normals[face] * bary[..., None]).sum(1))
        # Pores and, on old faces, wrinkles bend the normals.
        rough, bend = np.random.default_rng(self.head.look + 1), np.zeros_like(normals)
        skin = canvas.region["face"] | canvas.region["neck"]
        for low, high, most, flat in ((400.0, 2500.0, 0.12, 1.0), (150.0, 700.0, 0.35, 0.25)):
            amount = most * rough.beta(1.0, 2.5)
            places = canvas.rest * np.array([flat, 1.0, flat])
            field = np.stack([waves(places, rough, 8, low, high) for _ in range(3)], axis=1)
            bend += amount * field * skin[:, None]
        normals = unit(normals + 0.5 * bend)
        start, ahead = np.split(rays.numpy()[hit], 2, axis=1)
        points = start + ahead * distance[hit][:, None]
        openness = (self.openness[face] * bary).sum(1)
        diffuse, shine = self._light(_Hits(points, normals, -unit(ahead), openness, hit), rng)
        color = albedo * diffuse + shine
        # Exposed for what the camera sees, with some error.
        bright = np.percentile(color.mean(1), 90) if len(color) else 1.0
        color *= rng.uniform(0.5, 1.05) / max(bright, 0.02)
        image = np.zeros((*hit.shape, 4), np.uint8)
        image[hit, :3] = (255 * np.clip(color, 0, 1) ** rng.uniform(0.7, 1.3)).astype(np.uint8)
        image[hit, 3] = 255
        return image

    def _light(self, hits: _Hits, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
        """Draw ambient light and one to three lamps; return diffuse and specular light (N, 3)."""
        natural = rng.random() < NATURAL_SHARE
        above = unit(np.array([0.0, 1.0, 0.0]) + rng.normal(size=3) * (0.3 if natural else 2.0))
        sky = 0.5 + 0.5 * hits.normals @ above
        tint = rng.uniform(0.85 if natural else 0.7, 1.0, 3)
        diffuse = rng.uniform(0.1, 0.8) * (0.5 + 0.5 * sky[:, None]) * tint
        diffuse = diffuse * hits.openness[:, None]
        specular = np.zeros_like(diffuse)
        camera, wrap = unit(hits.towards.mean(0)), rng.uniform(0.0, 0.3)
        for _ in range(rng.integers(1, 4)):
            if not natural:
                direction = unit(rng.normal(size=3) + camera * rng.uniform(0.0, 2.0))
            elif rng.random() < 0.3:
                direction = unit(camera + 0.12 * rng.normal(size=3))  # a flash
            else:
                higher = np.array([0.0, rng.uniform(0.1, 1.2), 0.0])
                direction = unit(higher + unit(rng.normal(size=3)))
            color = rng.uniform(0.2, 1.0) * rng.uniform(0.8 if natural else 0.6, 1.0, 3)
            cosine = np.clip((hits.normals @ direction + wrap) / (1 + wrap), 0, None)
            if rng.random() < 0.5:
                cosine = cosine * self._shadow(hits, direction, rng)
            half = unit(direction + hits.towards)
            shine = np.clip((hits.normals * half).sum(1), 0, None) ** rng.uniform(8, 60)
            diffuse = diffuse + cosine[:, None] * color
            specular = specular + self.head.gloss * (shine * (cosine > 0))[:, None] * color
        return diffuse, specular

    def _shadow(self, hits: _Hits, direction: np.ndarray, rng: Rng) -> np.ndarray:
        """Return the share (N,) of a lamp that the head does not block, with hard or soft edges."""
        size, softness = rng.uniform(0.0, 0.25), rng.uniform(0.0, 0.6)
        jitter = size * rng.normal(size=hits.points.shape)
        rays = join_rays(hits.points + 1e-3 * hits.normals, unit(direction + jitter))
        free = np.where(self.scene.test_occlusions(rays).numpy(), softness, 1.0)
        mask = hits.pixels.astype(np.float32)
        image = np.zeros_like(mask)
        image[hits.pixels] = free
        # The jittered rays of neighbouring pixels together sample a lamp of some size.
        sigma = 0.5 + 8.0 * size
        image, mask = (cv2.GaussianBlur(one, (0, 0), sigma) for one in (image, mask))
        return (image / np.maximum(mask, 1e-6))[hits.pixels]

    def _wear_glasses(
        self, rgba: np.ndarray, eye: np.ndarray, projection: np.ndarray, rng: Rng
    ) -> list[np.ndarray]:
        """Draw glasses, in place; return the outlines (RING, 2) of lenses that hide the eyes."""
        size = rng.uniform([0.021, 0.015], [0.029, 0.025])
        square, lift = rng.uniform(0.5, 1.0), rng.uniform(0.012, 0.02)
        rings, bridge, temples = glasses_lines(self.head.landmarks, size, square, lift)
        color = (*(float(c) for c in rng.uniform(0, 255 if rng.random() < 0.4 else 70, 3)), 255.0)
        dark, opaque = rng.random() < 0.25, []
        rings_2d = [project(projection, ring) for ring in rings]
        for ring in rings_2d:
            strength = rng.uniform(0.5, 1.0) if dark else rng.uniform(0.0, 0.2)
            _blend(rgba, ring, rng.uniform(0, 90 if dark else 255, 3), strength)
            if rng.random() < 0.3:
                middle = ring.mean(0)
                shift = (ring[rng.integers(RING)] - middle) * rng.uniform(0, 0.6)
                glare = middle + shift + (ring - middle) * rng.uniform(0.1, 0.5, 2)
                _blend(rgba, glare, rng.uniform(180, 255, 3), rng.uniform(0.2, 0.9))
            if strength > 0.6:
                opaque.append(ring)
        width = float(np.ptp(np.concatenate(rings_2d), axis=0).max())
        thick = max(1, int(round(width * rng.uniform(0.0, 0.045))))
        for line, closed in [(rings[0], 1), (rings[1], 1), (bridge, 0), *((t, 0) for t in temples)]:
            # Only the parts that the head does not hide.
            seen, flat = self._seen(eye, line), project(projection, line)
            for k in range(len(line) - 1 + closed):
                j = (k + 1) % len(line)
                if seen[k] and seen[j]:
                    ends = [tuple(int(v) for v in np.round(flat[i] * 8)) for i in (k, j)]
                    cv2.line(rgba, *ends, color, thick, cv2.LINE_AA, 3)
        return opaque


def glasses_lines(
    marks: np.ndarray, size: np.ndarray, square: float, lift: float
) -> tuple[list[np.ndarray], np.ndarray, list[np.ndarray]]:
    """Place glasses in front of landmarks (68, 3), ``lift`` metres off the eyes.

    Returns:
        rings (RING, 3) around the lenses, with half-axes ``size`` (2,), metres, and sharper corners
        for a smaller ``square``; the bridge (3, 3); the temples (12, 3).
    """
    across = unit(marks[45] - marks[36])
    up = unit(marks[27] - marks[8] - across * (across @ (marks[27] - marks[8])))
    forward = np.cross(across, up)
    angle = np.linspace(0, 2 * np.pi, RING, endpoint=False)
    x, y = (np.sign(f) * np.abs(f) ** square for f in (np.cos(angle), np.sin(angle)))
    oval = size[0] * x[:, None] * across + size[1] * (y[:, None] - 0.1) * up
    off = lift * forward
    rings = [marks[ids].mean(0) + off + oval for ids in (range(36, 42), range(42, 48))]
    bridge = np.stack([rings[0][0], marks[27] + off, rings[1][RING // 2]])
    sides = ((rings[0][RING // 2], marks[0]), (rings[1][0], marks[16]))
    temples = [np.linspace(ring, ear + 0.02 * up - 0.01 * forward, 12) for ring, ear in sides]
    return rings, bridge, temples


def project(projection: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of points (N, 3) under a projection (3, 4)."""
    pixels = transform_points(projection, points)
    return pixels[:, :2] / pixels[:, 2:]


def _blend(rgba: np.ndarray, outline: np.ndarray, color: np.ndarray, strength: float) -> None:
    """Blend a colour into the inside of an outline (N, 2) of an image, in place."""
    mask = np.zeros(rgba.shape[:2], np.uint8)
    cv2.fillPoly(mask, [np.round(outline * 8).astype(np.int32)], 255, cv2.LINE_AA, 3)
    share = (strength / 255) * mask[..., None].astype(np.float32)
    over = np.array([*color, 255.0], np.float32)
    rgba[:] = (rgba * (1 - share) + over * share).astype(np.uint8)


def _random_camera(
    target: np.ndarray, frame_m: float, rng: Rng, side: int, yaw: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw K (3,3) and cam_from_world (4,4) that show some metres about a target (3,)."""
    pitch = np.clip(rng.normal() * 0.28, -0.8, 0.8)
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    target = target + rng.normal(size=3) * 0.02 * frame_m
    distance = np.exp(rng.uniform(np.log(0.45), np.log(2.0)))
    right = unit(np.cross(np.array([0.0, 1.0, 0.0]), forward))
    rotation = np.stack([right, -np.cross(forward, right), -forward])
    roll = rng.normal() * 0.12
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ rotation
    cam_from_world = make_transform(rotation, -rotation @ (target + distance * forward))
    focal = side * distance / frame_m * rng.uniform(0.85, 1.15)
    return np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]]), cam_from_world


class FaceFront:
    """The part of a head model whose edge is the outline: the face down to the jaw's lower edge.

    The outline is points 0 to 16 of the published mark-up of 68. People who mark photographs
    (Multi-PIE, 300-W) space them evenly along the visible edge of the face: from in front of the
    ears at eye height (0 and 16) down to the lowest edge of the chin (8). A head model's landmarks
    of the jaw are fixed places instead.
    """

    def __init__(self, model: HeadModel) -> None:
        """Find the part; other head models take its limits from the built-in one."""
        builtin = load_builtin()
        region = {name: mask.numpy() for name, mask in builtin.regions.items()}
        front = region["face"] & ~region["nose"] & ~region["lips"]
        rest = model.template.double().numpy()
        marks, builtin_marks = (landmarks_of(one).astype(np.float64) for one in (model, builtin))
        if model.name != builtin.name:
            s, R, t = similarity_fit(marks, builtin_marks)
            faces, weights = closest_places(builtin, s * rest @ R.T + t)
            inside = (front[builtin.faces.numpy()[faces]] * weights).sum(1) > 0.5
            front = inside & model.regions["face"].numpy()
        all_faces = model.faces.numpy()
        self.faces = all_faces[front[all_faces].all(1)]
        ids = np.unique(self.faces)
        level = np.abs(rest[ids, 1] - marks[[36, 45], 1].mean()) < EYE_BAND_M
        self.right, self.left = (ids[level & (sign * rest[ids, 0] > 0)] for sign in (-1, 1))
        low = (np.abs(rest[ids, 0]) < CHIN_BAND_M) & (rest[ids, 1] < marks[57, 1])
        self.chin = ids[low]

    def outline(self, pixels: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Return points 0 to 16 (17, 2) of a view with vertices (V, 2) and landmarks (68, 2)."""
        down = marks[8] - marks[27]
        across = np.array([down[1], -down[0]])  # towards the subject's left
        ends = (
            self.right[np.argmin(pixels[self.right] @ across)],
            self.chin[np.argmax(pixels[self.chin] @ down)],
            self.left[np.argmax(pixels[self.left] @ across)],
        )
        # The outer edge of the front, smoothed.
        used = pixels[np.unique(self.faces)]
        low, size = used.min(0), float(np.ptp(used, axis=0).max())
        scale = MASK_SHARE * MASK_SIDE / max(size, 1e-6)
        shift = 0.5 * (1 - MASK_SHARE) * MASK_SIDE
        mask = np.zeros((MASK_SIDE, MASK_SIDE), np.uint8)
        corners = corner_to_cell((pixels - low) * scale + shift)
        for triangle in np.round(corners[self.faces] * 16).astype(np.int32):
            cv2.fillConvexPoly(mask, triangle, 255, shift=4)
        inside = cv2.GaussianBlur(mask, (0, 0), SMOOTHING) > 127
        found = cv2.findContours(inside.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        edge = cell_to_corner(max(found, key=len)[:, 0].astype(np.float64))
        edge = (edge - shift) / scale + low
        first, middle, last = (
            int(np.linalg.norm(edge - pixels[one], axis=1).argmin()) for one in ends
        )
        edge = np.roll(edge, -first, axis=0)
        middle, last = (middle - first) % len(edge), (last - first) % len(edge)
        if middle > last:  # the edge runs the other way round
            edge = np.roll(edge[::-1], 1, axis=0)
            middle, last = len(edge) - middle, len(edge) - last
        halves = _spaced(edge[: middle + 1]), _spaced(edge[middle : last + 1])
        return np.concatenate([halves[0], halves[1][1:]])


@lru_cache(maxsize=4)
def face_front(model: HeadModel) -> FaceFront:
    """Return the part of a head model that has the outline."""
    return FaceFront(model)


def _spaced(line: np.ndarray) -> np.ndarray:
    """Return HALF + 1 evenly spaced points of a line (n, 2), including its ends."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    even = np.linspace(0.0, way[-1], HALF + 1)
    return np.stack([np.interp(even, way, line[:, axis]) for axis in (0, 1)], axis=1)
