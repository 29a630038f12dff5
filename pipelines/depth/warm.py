"""A warm start: the finished surface of another expression, carried by the tracked motion.

The subject's first tracked expression (neutral where it is tracked) is reconstructed from mattes
and photographs alone; every other one starts from its surface, moved as the tracked mesh moved, at
the finest levels, where only what the track missed is left to be found.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import open3d as o3d

from express50.capture.frames import read_peaks
from express50.contract.layout import Dataset
from express50.dataset.tracks import Track, read_track
from express50.errors import FormatError
from express50.files.arrays import DAMAGE
from express50.files.text import read_bytes, reason
from express50.geometry.raycast import mesh_scene
from express50.head.load import load_head
from pipelines.depth.config import DepthConfig
from pipelines.depth.grid import View
from pipelines.depth.prior import Prior, matte_agreement
from pipelines.depth.surface import graph_laplacian

NEAR, FAR = 0.04, 0.12  # metres off the tracked mesh: what lies nearer moves along, further stays
SURFACE_LIMIT = 1 << 30  # bytes
FAR_M = 1e6
AGAIN = "run 'express50 depth' on it again"
SMOOTHING = 12  # rounds of averaging of the motion, which jumps where the nearest triangle does


class Carried(Prior):
    """A closed surface that another expression ended with, in this one's place."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (N,) float32, metres, negative inside."""
        query = o3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        return self.scene.compute_signed_distance(query, nthreads=1, nsamples=3).numpy()


def track_path(dataset: Dataset, subject: str) -> Path:
    """The subject's track, whether it is there or not."""
    return dataset.item_dir("track", subject) / "track.npz"


def surface_file(dataset: Dataset, item: str) -> Path:
    """Mesh of a published item."""
    return dataset.item_dir("depth", item) / "surface.ply"


def source_of(dataset: Dataset, item: str, config: DepthConfig) -> str | None:
    """The item whose surface this one starts from: the subject's neutral, else first, tracked peak.

    None where the item is that one itself, nothing or not this one is tracked, or the start is off.
    """
    subject, expression = item.split("/")
    path = track_path(dataset, subject)
    if not config.warm_start or not path.is_file():
        return None
    stat = path.stat()
    tracked = _tracked(path, (stat.st_mtime_ns, stat.st_size, stat.st_ino))
    peaks = [name for name in sorted(read_peaks(dataset, subject)) if name in tracked]
    if expression not in peaks:
        return None
    first = "neutral" if "neutral" in peaks else peaks[0]
    return None if expression == first else f"{subject}/{first}"


@lru_cache(maxsize=64)
def _tracked(path: Path, version: tuple[int, ...]) -> tuple[str, ...]:
    return read_track(path).expressions


def carried_start(
    dataset: Dataset, item: str, views: Sequence[View], config: DepthConfig
) -> tuple[Carried | None, dict]:
    """The carried surface, or None, and what was made of it for the metrics.

    A surface that does not lie in this moment's mattes was carried wrongly, or was wrong itself.
    """
    source = source_of(dataset, item, config)
    if source is None:
        return None, {"used": False}
    if not surface_file(dataset, source).is_file():
        return None, {"used": False, "why": f"{source} could not be reconstructed"}
    subject, expression = item.split("/")
    track = read_track(track_path(dataset, subject))
    pair = source.split("/")[1], expression
    start, facts = start_from(read_surface(surface_file(dataset, source)), track, pair, views)
    facts |= {"from": source}
    if facts["agreement"] < config.track_agreement:
        return None, {"used": False, "why": "it does not lie in the mattes"} | facts
    return start, {"used": True} | facts


def start_from(
    mesh: tuple[np.ndarray, np.ndarray], track: Track, pair: tuple[str, str], views: Sequence[View]
) -> tuple[Carried, dict]:
    """A surface (V, 3), (F, 3) carried from one of a ``pair`` of tracked expressions to the other.

    Returns it with its ``agreement``, the share of it that lies in the views' mattes.
    """
    before, after = (track.vertices[track.row(name)].astype(np.float64) for name in pair)
    vertices, faces = mesh
    moved = carry(vertices, faces, before, after, load_head(track.head).faces.numpy())
    agreement = round(matte_agreement(views, moved, faces), 4)
    carried = Carried(mesh_scene(moved, faces), None, moved.min(0), moved.max(0))
    return carried, {"agreement": agreement}


def carry(
    vertices: np.ndarray, faces: np.ndarray, before: np.ndarray, after: np.ndarray,
    tracked_faces: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Vertices (V, 3) of a surface moved from one tracked expression to another.

    Args:
        vertices: (V, 3) metres, world, of the surface where the tracked mesh is ``before``.
        faces: (F, 3), closed.
        before: (T, 3) tracked vertices, metres, world.
        after: (T, 3) the same where the surface is wanted.
        tracked_faces: (G, 3).
    """
    query = o3d.core.Tensor(np.ascontiguousarray(vertices, np.float32))
    found = mesh_scene(before, tracked_faces).compute_closest_points(query, nthreads=1)
    corners = tracked_faces[found["primitive_ids"].numpy()]
    gap = np.linalg.norm(vertices - found["points"].numpy(), axis=1)
    u, v = found["primitive_uvs"].numpy().astype(np.float64).T
    share = np.stack([1 - u - v, u, v], axis=1)
    motion = ((after - before)[corners] * share[..., None]).sum(1)
    motion *= np.clip((FAR - gap) / (FAR - NEAR), 0, 1)[:, None]
    laplacian = graph_laplacian(faces, len(vertices))
    for _ in range(SMOOTHING):
        motion = motion - 0.5 * (laplacian @ motion)
    return vertices + motion


def read_surface(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) metres and faces (F, 3) of a ``surface.ply``.

    Raises:
        FormatError: it holds no triangles.
    """
    import trimesh

    # From bytes and not by name: a PLY may name a texture, which would be read wherever it lies.
    data = read_bytes(path, FormatError, SURFACE_LIMIT, AGAIN)
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    except (*DAMAGE, struct.error, UnboundLocalError) as error:
        raise FormatError(f"{path}: no surface ({reason(error)}); {AGAIN}") from None
    if not len(faces) or faces.shape[1:] != (3,) or not np.isfinite(vertices).all():
        raise FormatError(f"{path}: {len(faces)} triangles, expected a surface; {AGAIN}")
    if faces.min() < 0 or faces.max() >= len(vertices) or np.abs(vertices).max() > FAR_M:
        raise FormatError(f"{path}: a triangle or a vertex lies nowhere; {AGAIN}")
    return vertices, faces
