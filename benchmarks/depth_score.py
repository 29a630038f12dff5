"""Measure a surface's errors against the twin's truth in every view, and summarise them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import open3d as o3d

from benchmarks.truth import Truth, align_worlds
from express50.geometry.cameras import Camera, transform_camera
from express50.geometry.raycast import camera_rays, mesh_scene
from pipelines.depth.maps import Picture

SUREST = (0.98, 0.96, 0.9, 0.7)  # shares of the pixels, the most confident ones

Mesh = tuple[np.ndarray, np.ndarray]  # vertices (V, 3), faces (F, 3)


def score(
    mesh: Mesh,
    truth: Truth,
    subject: str,
    frame: int,
    pictures: Sequence[Picture],
    sure: dict[str, np.ndarray] | None = None,
) -> dict:
    """Gather errors over all pictures, and the confidence of the same pixels.

    ``sure`` holds maps of confidence (H, W) by camera, if there are any.
    """
    cameras = {camera.id: camera for camera in (picture.camera for picture in pictures)}
    motion = align_worlds(cameras, truth.cameras(subject))
    none = np.zeros(0)
    rows = [
        compare(mesh, truth, subject, frame, camera, motion, alpha, (sure or {}).get(camera.id))
        for camera, alpha in ((picture.camera, picture.matte) for picture in pictures)
    ]
    found: dict = {
        key: np.concatenate([row.get(key, none) for row in rows])
        for key in ("errors", "skin", "degrees", "sure")
    }
    return found | {"covered": float(np.mean([row["covered"] for row in rows]))}


def compare(
    mesh: Mesh, truth: Truth, subject: str, frame: int, camera: Camera, motion: np.ndarray,
    alpha: np.ndarray, sure: np.ndarray | None = None,
) -> dict:  # fmt: skip
    """Measure absolute errors (N,), millimetres, of a view's pixels and skin; skin's normals."""
    seen = transform_camera(camera, motion)
    true_depth, true_valid = truth.render_depth(subject, frame, seen)
    depth, normals = cast(mesh, camera)
    both = np.isfinite(depth) & (alpha > 127) & true_valid
    errors = 1e3 * np.abs(np.where(both, depth, 0) - true_depth)
    skin = both & truth.skin(subject, frame, seen)
    head = truth.vertices(subject, frame), truth.head_model(subject).faces.numpy()
    _, true_normals = cast(head, seen)
    cosine = np.clip((normals * true_normals).sum(-1)[skin], -1, 1)
    return ({} if sure is None else {"sure": sure[both]}) | {
        "errors": errors[both],
        "skin": errors[skin],
        "degrees": np.degrees(np.arccos(cosine)),
        "covered": both.sum() / max(1, true_valid.sum()),
    }


def cast(mesh: Mesh, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Cast rays: depth (H, W), infinite without a hit; smooth normals (H, W, 3), camera axes."""
    vertices, faces = mesh
    hull = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces)
    )
    hull.compute_vertex_normals()
    own = np.asarray(hull.vertex_normals)
    hits = mesh_scene(vertices, faces).cast_rays(camera_rays(camera), nthreads=1)
    depth = hits["t_hit"].numpy()
    hit = np.isfinite(depth)
    corners = faces[np.where(hit, hits["primitive_ids"].numpy(), 0)]
    u, v = np.moveaxis(hits["primitive_uvs"].numpy(), -1, 0)
    bary = np.stack([1 - u - v, u, v], axis=-1)
    normals = (own[corners] * bary[..., None]).sum(-2) @ camera.cam_from_world[:3, :3].T
    return depth, normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)


def of_surest(errors: np.ndarray, sure: np.ndarray) -> dict:
    """Take 95th percentiles, millimetres, of errors (N,) over the most confident pixels.

    ``sure`` (N,) is the confidence, or empty for a baseline without one.
    """
    if not len(sure):
        return {}
    ordered = errors[np.argsort(-sure, kind="stable")]
    tails = {
        f"{share:g}": round(float(np.percentile(ordered[: int(share * len(errors))], 95)), 3)
        for share in SUREST
    }
    return {"abs_error_mm_p95_of_surest": tails}


def summary(rows: list[dict]) -> dict:
    """Summarise the pixels of all items; ``n/a`` if nothing could be measured."""
    if not rows:
        return {"n/a": "these items have no track"}
    errors, skin, degrees = (
        np.concatenate([row[key] for row in rows]) for key in ("errors", "skin", "degrees")
    )
    if not len(errors) or not len(skin):
        return {"n/a": "no surface was found where the truth has one"}
    figures: dict = {
        "abs_error_mm_median": round(float(np.median(errors)), 3),
        "abs_error_mm_p95": round(float(np.percentile(errors, 95)), 3),
        "skin_error_mm_median": round(float(np.median(skin)), 3),
        "normal_error_deg_median": round(float(np.median(degrees)), 2),
        "coverage": round(float(np.mean([row["covered"] for row in rows])), 4),
        "peak_memory_gib": round(max(row["gib"] for row in rows), 2),
    }
    figures |= of_surest(errors, np.concatenate([row["sure"] for row in rows]))
    seconds = [row["s"] for row in rows if row["s"] is not None]
    figures["seconds_per_frame"] = round(float(np.mean(seconds)), 2) if seconds else None
    if "voxels_dense" in rows[0]:
        figures["voxel_mm"] = round(rows[0]["voxel_mm"], 3)
        for key in ("voxels_allocated", "voxels_dense", "grid_bytes"):
            figures[key] = max(row[key] for row in rows)
        figures["raycast_ms_per_megapixel"] = {
            way: round(float(np.mean([row["raycast"]["ms"][way] for row in rows])), 1)
            for way in ("mesh", "sdf")
        }
        apart = [row["raycast"]["difference_mm"] for row in rows]
        figures["raycast_difference_mm"] = round(float(np.mean(apart)), 4)
    return figures
