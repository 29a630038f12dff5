"""Find places on a head model by closest point, and the outline of the face in a view.

The outline is points 0 to 16 of the published mark-up of 68. People who mark photographs
(Multi-PIE, 300-W) space them evenly along the visible edge of the face: from in front of the ears
at eye height (0 and 16) down to the lowest edge of the chin (8). A head model's landmarks of the
jaw are fixed places instead.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import open3d as o3d

from express50.geometry.conventions import cell_to_corner, corner_to_cell
from express50.geometry.raycast import barycentrics, mesh_scene
from express50.geometry.transforms import similarity_fit
from express50.head.load import load_builtin
from express50.head.model import HeadModel, in_regions, landmarks_of

INSIDE = (
    "teeth", "tongue", "mouth_interior", "left_eyeball", "right_eyeball", "left_iris", "right_iris",
    "boundary",
)  # fmt: skip
Places = tuple[np.ndarray, np.ndarray]  # faces (N,), weights (N, 3)


@lru_cache(maxsize=4)
def _skin(model: HeadModel) -> tuple[o3d.t.geometry.RaycastingScene, np.ndarray]:
    """Return the skin of a head model at rest as a scene, and the ids of its faces."""
    faces = model.faces.numpy()
    skin = np.flatnonzero(~in_regions(model, INSIDE)[faces].any(1))
    return mesh_scene(model.template.numpy(), faces[skin]), skin


def closest_places(model: HeadModel, points: np.ndarray) -> Places:
    """Return the places on the skin of a head model at rest nearest to points (D, 3)."""
    scene, skin = _skin(model)
    found = scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
    weights = barycentrics(found).astype(np.float32)
    return skin[found["primitive_ids"].numpy()], weights


def place_points(
    model: HeadModel, places: Places, vertices: np.ndarray | None = None
) -> np.ndarray:
    """Return the points (D, 3) at places of a head model with vertices (V, 3), or at rest."""
    mesh = model.template.double().numpy() if vertices is None else vertices
    return (mesh[model.faces.numpy()[places[0]]] * places[1][..., None]).sum(1)


EYE_BAND_M, CHIN_BAND_M = 0.005, 0.004  # around the height of the eye corners; around the middle
MASK_SIDE, MASK_SHARE = 512, 0.9  # side of the face's mask, pixels, and the face's share of it
SMOOTHING = 6  # pixels of the mask, because the face ends along triangles
HALF = 8  # steps from an ear to the chin


class FaceFront:
    """The part of a head model whose edge is the outline: the face down to the jaw's lower edge."""

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
        edge = self._edge(pixels)
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

    def _edge(self, pixels: np.ndarray) -> np.ndarray:
        """Return the outer edge (n, 2) of the front in a view, smoothed."""
        used = pixels[np.unique(self.faces)]
        low, size = used.min(0), float(np.ptp(used, axis=0).max())
        scale = MASK_SHARE * MASK_SIDE / max(size, 1e-6)
        shift = 0.5 * (1 - MASK_SHARE) * MASK_SIDE
        mask = np.zeros((MASK_SIDE, MASK_SIDE), np.uint8)
        corners = corner_to_cell((pixels - low) * scale + shift)
        for triangle in np.round(corners[self.faces] * 16).astype(np.int32):
            cv2.fillConvexPoly(mask, triangle, 255, shift=4)
        mask = cv2.GaussianBlur(mask, (0, 0), SMOOTHING)
        found, _ = cv2.findContours(
            (mask > 127).view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        edge = max(found, key=len)[:, 0].astype(np.float64)
        return (cell_to_corner(edge) - shift) / scale + low


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
