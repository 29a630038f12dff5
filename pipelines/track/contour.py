"""Where people, and networks taught by them, mark the jaw line in one view: on what they see of it.

Where the head turns away, the edge of the cheek stands for the jaw behind it. So a point whose skin
faces the camera keeps its place in the embedding, one that has turned past the rim moves along its
line of candidates to the rim, and one that the head hides is left out. The choice is for the
current mesh and has to be made again as that changes. The embedded network marks fixed places, seen
or not: its points need none of this.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
import torch

from express50.geometry.cameras import Camera
from express50.geometry.raycast import mesh_scene
from express50.head.model import HeadModel, vertex_normals

JAW = 17
# Cosine of the angle between skin and line of sight: above it a point is in plain view, and within
# it of a right angle skin forms the rim (triangles are finite).
FACING, RIM = -0.1, 0.2
# Metres along the cheek that a point may go further for a cosine nearer to the rim by one.
RIM_REACH_M = 0.16
# A point is seen if a place this far before its skin is: the rim itself hides from any sight line.
CLEAR_M = 0.004


@dataclass(frozen=True)
class Contour:
    """The jaw line in one view.

    Attributes:
        corners: (17, 3) vertex ids.
        bary: (17, 3) their weights.
        moved: (17,) bool, points that left the embedding for the rim.
        usable: (17,) bool, points that the camera sees.
    """

    corners: np.ndarray
    bary: np.ndarray
    moved: np.ndarray
    usable: np.ndarray

    def positions(self, vertices: np.ndarray) -> np.ndarray:
        """World points (17, 3) on a mesh (V, 3)."""
        return (vertices[self.corners] * self.bary[..., None]).sum(1)


def contour_points(model: HeadModel, vertices: np.ndarray, camera: Camera) -> Contour:
    """Choose the 17 points of the jaw line that a camera sees.

    Args:
        model: the head model; without `contour` candidates every point keeps its place.
        vertices: (V, 3) of the current mesh, world.
        camera: pinhole.
    """
    faces = model.faces.numpy()
    corners = faces[model.landmark_faces[:JAW].numpy()].copy()
    bary = model.landmark_bary[:JAW].numpy().astype(np.float64)
    normals = vertex_normals(torch.from_numpy(vertices)[None], model.faces)[0].numpy()
    towards = camera.center - vertices
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    facing = (normals * towards).sum(1)
    own = (vertices[corners] * bary[..., None]).sum(1)
    moved = np.zeros(JAW, dtype=bool)
    for point, line in enumerate(model.contour or ()):
        if (facing[corners[point]] * bary[point]).sum() > FACING:
            continue
        rim = line.numpy()[np.abs(facing[line.numpy()]) < RIM]
        moved[point] = True
        if len(rim):
            way = np.linalg.norm(vertices[rim] - own[point], axis=1)
            best = rim[int((way + RIM_REACH_M * np.abs(facing[rim])).argmin())]
            corners[point], bary[point] = best, (1.0, 0.0, 0.0)
    clear = vertices[corners] + CLEAR_M * normals[corners]
    seen = _seen(vertices, faces, camera, (clear * bary[..., None]).sum(1))
    return Contour(corners, bary, moved, seen)


def _seen(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, points: np.ndarray
) -> np.ndarray:
    """Whether nothing of the mesh stands before points (N, 3), by ray casting."""
    sight = points - camera.center
    rays = np.concatenate([np.broadcast_to(camera.center, sight.shape), sight], axis=1)
    hits = mesh_scene(vertices, faces).cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
    # Directions are not unit vectors: the ray's parameter is 1 at the point.
    return hits["t_hit"].numpy() > 0.999
