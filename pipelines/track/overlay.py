"""Pictures that show whether a track is right: the mesh drawn into the frames it was fitted to."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import torch

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.contract.layout import Dataset
from express50.files.images import write_image
from express50.geometry.cameras import Camera
from express50.geometry.conventions import affine_to_opencv
from express50.geometry.raycast import mesh_scene
from express50.head.model import HeadModel, landmarks
from pipelines.track.observe import facing
from pipelines.track.pinhole import project_pinhole
from pipelines.track.state import Target

TILE = 384
SEEN_COLOR, FITTED_COLOR = (255, 210, 0), (0, 255, 120)


def draw_overlays(
    dataset: Dataset,
    subject: str,
    folder: Path,
    model: HeadModel,
    targets: list[Target],
    vertices: np.ndarray,
    rotations: np.ndarray,
) -> dict[str, np.ndarray]:
    """Write overlay_<expression>.jpg: frame above, mesh and landmarks below, in four views.

    Yellow: detected; green: fitted. Vertices (E, V, 3) world, rotations (E, 3, 3) from head to it.

    Returns:
        Expression to the overlay (TILE, TILE, 3) uint8 in the view that the face looks at.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras = read_cameras_of(dataset, subject)
    frontal = {}
    for target, mesh, rotation in zip(targets, vertices, rotations, strict=True):
        chosen, columns = _spread(target, cameras, rotation, mesh.mean(0)), {}
        for camera_id in sorted(chosen):
            frame = read_peak_frame(dataset, subject, target.observation.expression, camera_id)
            seen = [v.points for v in target.observation.views if v.camera_id == camera_id]
            columns[camera_id] = draw_column(frame, cameras[camera_id], model, mesh, seen)
        path = folder / f"overlay_{target.observation.expression}.jpg"
        write_image(path, np.concatenate(list(columns.values()), axis=1), quality=88)
        frontal[target.observation.expression] = columns[chosen[0]][TILE:]
    return frontal


def _spread(
    target: Target, cameras: dict[str, Camera], rotation: np.ndarray, middle: np.ndarray
) -> list[str]:
    """Up to four cameras: the one the face looks at, then those furthest from all chosen so far."""
    views = sorted(target.observation.views, key=lambda view: -facing(view, rotation, middle))
    chosen = [views[0].camera_id]
    pool = [view.camera_id for view in views[1:]]
    while pool and len(chosen) < 4:
        axes = np.stack([cameras[name].cam_from_world[2, :3] for name in chosen])
        far = [float((axes @ cameras[name].cam_from_world[2, :3]).max()) for name in pool]
        chosen.append(pool.pop(int(np.argmin(far))))
    return chosen


def draw_column(
    frame: np.ndarray,
    camera: Camera,
    model: HeadModel,
    mesh: np.ndarray,
    seen: list[np.ndarray],
    tile: int = TILE,
) -> np.ndarray:
    """Frame and overlay (2 tile, tile, 3) of the part of one view where the head is.

    Args:
        frame: (H, W, 3) uint8, undistorted.
        camera: pinhole; its id is written on the picture.
        model: the head model.
        mesh: (V, 3) world.
        seen: arrays (N, 2) of detected pixels.
        tile: side of the picture, pixels.
    """
    pixels, _ = project_pinhole(camera, mesh)
    low, high = pixels.min(0), pixels.max(0)
    side = 1.08 * float((high - low).max())
    corner = 0.5 * (low + high) - 0.5 * side
    scale = tile / side
    matrix = np.array([[scale, 0, -scale * corner[0]], [0, scale, -scale * corner[1]]])
    flags = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    crop = cv2.warpAffine(frame, affine_to_opencv(matrix), (tile, tile), flags=flags)
    shaded = _wireframe(crop, camera, matrix, model, mesh)
    marks = landmarks(model, torch.from_numpy(mesh)[None])[0].numpy()
    _dots(shaded, project_pinhole(camera, marks)[0] @ matrix[:, :2].T + matrix[:, 2], FITTED_COLOR)
    for points in seen:
        _dots(shaded, points @ matrix[:, :2].T + matrix[:, 2], SEEN_COLOR)
    cv2.putText(shaded, camera.id, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)
    return np.concatenate([crop, shaded])


def _wireframe(
    crop: np.ndarray, camera: Camera, matrix: np.ndarray, model: HeadModel, mesh: np.ndarray
) -> np.ndarray:
    """Blend visible triangle edges and the mesh's outline into a crop."""
    K = np.diag([matrix[0, 0], matrix[1, 1], 1.0]) @ camera.K
    K[:2, 2] += matrix[:, 2]
    scene = mesh_scene(mesh, model.faces.numpy())
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        intrinsic_matrix=o3d.core.Tensor(K),
        extrinsic_matrix=o3d.core.Tensor(camera.cam_from_world),
        width_px=crop.shape[1],
        height_px=crop.shape[0],
    )
    cast = scene.cast_rays(rays)
    hit = np.isfinite(cast["t_hit"].numpy())
    bary = cast["primitive_uvs"].numpy()
    smallest = np.minimum(bary.min(2), 1 - bary.sum(2))
    edge = hit & (smallest < 0.08)
    rim = hit ^ cv2.erode(hit.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    image = crop.astype(np.float32)
    image[edge] = 0.7 * image[edge] + 0.3 * np.array([90, 200, 255], np.float32)
    image[rim] = np.array([255, 60, 60], np.float32)
    return np.ascontiguousarray(image.astype(np.uint8))


def _dots(image: np.ndarray, points: np.ndarray, color: tuple[int, int, int]) -> None:
    """Draw small dots at tile pixels (N, 2), corner origin, in place."""
    for x, y in points:
        if 0 <= x < image.shape[1] and 0 <= y < image.shape[0]:
            cv2.circle(image, (int(x), int(y)), 1, color, -1, cv2.LINE_AA)
