"""Find and read the masks and depth maps of other tools, check them with cameras, fuse depth.

Files are named by patterns with places for subject, expression, camera and frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from express50.capture.index import read_index, read_peaks
from express50.contract.layout import Dataset
from express50.dataset.depth_files import FARTHEST_M as BACKGROUND_M
from express50.errors import ConfigError, FormatError, StageError
from express50.files.arrays import read_npy
from express50.files.images import read_image
from express50.files.text import expanded
from express50.geometry.cameras import (
    Camera,
    pinhole,
    project_pinhole,
    resized,
    triangulate,
    unproject,
)
from express50.geometry.conventions import K_to_opencv, cell_centres, cell_to_corner
from express50.geometry.meshes import write_surface
from express50.geometry.pixels import resize_area
from express50.geometry.sampling import undistort_image, undistort_maps

PLACES = ("subject", "expression", "camera", "frame", "clip_frame")
_PLACE = re.compile(r"\{([^{}:]*)(?::0?(\d+)d?)?\}")
SAMPLES = 1500  # pixels per view that are compared to the other views
NEAR_M = 0.01  # distance within which surface points of two views are the same
MOST_OFF = 0.6  # of half a mask's extent: how far its middle may be off the one all masks show
AGREE_SHARE = 0.4  # least share of the pixels known to two views that show the same surface
LEAST_COSINE = 0.5  # between the directions of two views that are compared
FINE_M, FINER_SHARE = 0.003, 0.1  # the other measure is right if so many more pixels agree so well
FACTORS = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001)
LEAST_VOXEL_M, VOXEL_PX = 0.0015, 1.4  # as depth's own
TRUNCATION = 4.0  # voxels
FARTHEST_M = 1e3
SLOPE = 3.0  # pixels of depth per half pixel across, of a surface seen at 80 degrees
SURE = 3.0  # views of a point for full confidence
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True, kw_only=True)
class PeakFrame:
    """Names the peak frame of an expression."""

    expression: str  # its id
    frame: int  # decode index in the footage
    clip_frame: int  # the same, counted from the first frame of the expression's cue window


def peak_frames(dataset: Dataset, subject: str) -> list[PeakFrame]:
    """List a subject's peak frames by expression, sorted."""
    starts = {cue.expression_id: cue.start_frame for cue in read_index(dataset, subject).cues}
    return [
        PeakFrame(expression=name, frame=frame, clip_frame=frame - starts.get(name, 0))
        for name, frame in sorted(read_peaks(dataset, subject).items())
    ]


def check_pattern(pattern: str, needed: tuple[str, ...]) -> set[str]:
    """Return a pattern's placeholders; ConfigError if one is unknown or a needed one is missing."""
    found = {match[1] for match in _PLACE.finditer(pattern)}
    known = ", ".join(f"{{{name}}}" for name in PLACES)
    if unknown := sorted(found - set(PLACES)):
        raise ConfigError(
            f"{pattern}: unknown placeholder {{{unknown[0]}}}; expected some of {known}"
        )
    if "expression" in needed and found & {"frame", "clip_frame"}:
        needed = tuple(name for name in needed if name != "expression")
    if missing := [name for name in needed if name not in found]:
        raise ConfigError(
            f"{pattern}: has no {{{missing[0]}}}; expected a pattern with {known}, and widths such"
            " as {frame:06d}"
        )
    return found


def fill(pattern: str, subject: str, peak: PeakFrame | None = None, camera: str = "") -> Path:
    """Return the path that a pattern names."""
    values: dict[str, str | int] = {"subject": subject, "camera": camera}
    if peak is not None:
        values |= vars(peak)

    def value(match: re.Match[str]) -> str:
        found = values.get(match[1], match[0])
        return f"{found:0{match[2] or 0}d}" if isinstance(found, int) else str(found)

    return expanded(_PLACE.sub(value, pattern))


def read_mask(path: Path, recorded: Camera, seen: Camera, distorted: bool) -> np.ndarray:
    """Read a mask as opacity (H, W) uint8 of a pinhole camera's picture.

    The opacity of a picture with four channels counts; masks of 0 and 1 are black and white. Its
    size is that of the footage as recorded, or that to which the `frames` stage reduced pictures.

    Raises:
        FormatError: it is missing, not a mask, or of another size.
    """
    image = read_image(path)
    if image.ndim == 3:
        if image.shape[2] == 3 and not (image == image[..., :1]).all():
            raise FormatError(f"{path}: holds colours, expected a grey mask or opacity (RGBA)")
        image = image[..., -1] if image.shape[2] in (2, 4) else image[..., 0]
    most = {"u1": 255.0, "u2": 65535.0}.get(image.dtype.str[1:], 1.0)
    if image.dtype.kind == "u" and image.max(initial=0) == 1:
        most = 1.0
    if not (
        np.isfinite(image).all() and image.min(initial=0) >= 0 and image.max(initial=0) <= most
    ):
        raise FormatError(f"{path}: holds values outside of 0 to {most:g}, expected opacity")
    alpha = np.rint(image * (255.0 / most)).astype(np.uint8)
    camera = _camera_of_size(path, alpha, recorded, seen)
    alpha = undistort_image(alpha, camera) if distorted else alpha
    return resize_area(alpha, seen.width, seen.height) if camera is recorded else alpha


def read_foreign_depth(
    path: Path, recorded: Camera, seen: Camera, metres: float, along_ray: bool, distorted: bool
) -> np.ndarray:
    """Read depth (H, W) float32, metres along z of a pinhole camera's picture; 0 is unknown.

    The file, a 16-bit PNG or TIFF, EXR, or .npy, has the size of the footage or of the picture. NaN
    and 10 km or more, as some tools write a background, are unknown too. It holds lengths of rays
    if `along_ray`, in units of so many `metres`, at pixels of the footage as `recorded` if
    `distorted`.

    Raises:
        FormatError: it is missing, not a depth map, or of another size.
    """
    if path.suffix == ".npy":
        values = read_npy(path, FormatError, "a depth map")
    else:
        values = read_image(path)
        if values.dtype == np.uint8:
            raise FormatError(f"{path}: has 8 bits, expected 16-bit PNG, EXR or .npy")
    if values.ndim == 3 and (values == values[..., :1]).all():
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "fui":
        raise FormatError(f"{path}: {values.dtype} {values.shape}, expected (H, W) depth")
    camera = _camera_of_size(path, values, recorded, seen)
    away = np.abs(values.astype(np.float64)) * metres
    known = (away > 0) & (away < BACKGROUND_M)
    depth = np.where(known, values, 0).astype(np.float32)
    if known.any() and (depth[known] < 0).mean() > 0.5:
        raise FormatError(
            f"{path}: is negative: it is z of OpenGL's axes, expected depth in front of the camera;"
            " change its sign"
        )
    depth = np.maximum(depth, 0) * np.float32(metres)
    if distorted and camera.dist.any():
        x, y = undistort_maps(camera)
        depth = cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    depth = depth / ray_lengths(pinhole(camera)) if along_ray else depth
    if camera is not recorded:
        return depth
    rows, columns = (
        (cell_centres(small) * (large / small)).astype(int)
        for small, large in zip((seen.height, seen.width), depth.shape, strict=True)
    )
    nearest = depth[np.ix_(rows, columns)]  # a mean across an edge would lie on neither side
    mean = cv2.resize(depth, (seen.width, seen.height), interpolation=cv2.INTER_LINEAR)
    steepest = SLOPE * nearest / camera.K[0, 0]  # more within half a pixel is an edge
    return np.where(np.abs(mean - nearest) < steepest, mean, nearest)


def ray_lengths(camera: Camera) -> np.ndarray:
    """Return the length (H, W) float32 of the rays of a pinhole camera at camera z 1."""
    x = (cell_centres(camera.width) - camera.K[0, 2]) / camera.K[0, 0]
    y = (cell_centres(camera.height) - camera.K[1, 2]) / camera.K[1, 1]
    return np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2).astype(np.float32)


def _camera_of_size(path: Path, image: np.ndarray, recorded: Camera, seen: Camera) -> Camera:
    """Return the camera, with its distortion, that has an image's size."""
    size = image.shape[1], image.shape[0]
    if size == (recorded.width, recorded.height):
        return recorded
    if size == (seen.width, seen.height):
        return resized(recorded, *size)
    fix = "export it at the footage's size"
    if size == (recorded.height, recorded.width):
        fix = "it is rotated by 90 degrees; rotate it back"
    raise FormatError(
        f"{path}: {size[0]}x{size[1]}, expected the {recorded.width}x{recorded.height} of camera"
        f" {recorded.id}; {fix}"
    )


def check_masks(cameras: Mapping[str, Camera], masks: Mapping[str, np.ndarray], where: str) -> None:
    """Refuse masks (H, W) uint8 by camera that are empty, full, or not of one thing.

    Raises:
        StageError: one is; the middle of what the masks show must lie within each of them.
    """
    middles = []
    for name, alpha in masks.items():
        inside = alpha > 127
        if not inside.any() or inside.all():
            what = f"is {'full' if inside.any() else 'empty'} ({alpha.min()} to {alpha.max()})"
            raise StageError(
                f"{where}: the mask of {name} {what}; expected 255 on the subject and 0 elsewhere"
            )
        y, x = np.nonzero(inside)
        middles.append([x.mean() + 0.5, y.mean() + 0.5])
    if len(masks) < 3:
        return
    views = [cameras[name] for name in masks]
    middle = triangulate(views, np.array(middles)[:, None])
    off = {}
    for name, camera, seen in zip(masks, views, middles, strict=True):
        y, x = np.nonzero(masks[name] > 127)
        half = 0.5 * np.array([np.ptp(x) + 1, np.ptp(y) + 1])
        off[name] = float((np.abs(project_pinhole(camera, middle)[0][0] - seen) / half).max())
    worst = max(off, key=lambda name: off[name] if np.isfinite(off[name]) else np.inf)
    if not off[worst] < MOST_OFF:
        raise StageError(
            f"{where}: the mask of {worst} does not show what the other cameras' masks show; is it"
            " of another camera or frame, or mirrored?"
        )


def check_depths(
    cameras: Mapping[str, Camera], depths: Mapping[str, np.ndarray], where: str
) -> float | None:
    """Return the share of pixels on which views (H, W), metres, agree; None if none overlap.

    Raises:
        StageError: too few do, or many more would by another unit or measure, which it names.
    """
    share = agreement(cameras, depths)
    if share is None:
        return None
    best = share
    why = "its cameras, subject or frame differ, or it is relative depth, which has no unit"
    if share < AGREE_SHARE:
        for factor in FACTORS:
            other = agreement(cameras, {n: factor * depth for n, depth in depths.items()}) or 0.0
            if other > max(best, AGREE_SHARE):
                best, why = other, f"its unit is {factor:g} times as large as the one given"
        raise StageError(
            f"{where}: views agree on {share:.0%} of what they share, expected {AGREE_SHARE:.0%}:"
            f" {why}"
        )
    closely = agreement(cameras, depths, FINE_M) or 0.0
    for change, fix in ((np.divide, "give --ray"), (np.multiply, "leave --ray out")):
        changed = {n: change(depth, ray_lengths(cameras[n])) for n, depth in depths.items()}
        if (agreement(cameras, changed, FINE_M) or 0.0) > closely + FINER_SHARE:
            raise StageError(
                f"{where}: views agree better with depth measured the other way; {fix}"
            )
    return round(share, 4)


def agreement(
    cameras: Mapping[str, Camera], depths: Mapping[str, np.ndarray], near: float = NEAR_M
) -> float | None:
    """Return the share of pixels whose surface point other views know at the same place.

    Pairs of views that look the same way within 60 degrees are compared; None without any. Points
    that leave the other's known pixels count against it.
    """
    same = total = 0
    for name, depth in depths.items():
        camera, (y, x) = cameras[name], np.nonzero(depth)
        chosen = np.unique(np.linspace(0, len(y) - 1, min(SAMPLES, len(y))).astype(int))
        y, x = y[chosen], x[chosen]
        corners = cell_to_corner(np.stack([x, y], 1).astype(float))
        points = unproject(camera, corners, depth[y, x])
        for other, there in depths.items():
            facing = cameras[other].cam_from_world[2, :3] @ camera.cam_from_world[2, :3]
            if other != name and facing >= LEAST_COSINE:
                found, z = pixels_showing(cameras[other], there, points)
                total += len(points)
                same += int(((found > 0) & (np.abs(found - z) < near)).sum())
    return same / total if total else None


def pixels_showing(
    camera: Camera, image: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (N[, C]) of an image that show world points (N, 3); their depth (N,).

    The camera is undistorted. Pixels outside the image are 0.
    """
    pixels, depth = project_pinhole(camera, points)
    size = (camera.width, camera.height)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
    column, row = np.where(inside[:, None], pixels, 0).astype(int).T
    found = image[row, column]
    found[~inside] = 0
    return found, depth


def write_fused(
    path: Path,
    cameras: Mapping[str, Camera],
    depths: Mapping[str, np.ndarray],
    pictures: Mapping[str, np.ndarray],
) -> int:
    """Write the fused surface of depths (H, W), metres, with colours; returns its vertices.

    Each map knows some pixels.

    Raises:
        StageError: the maps hold no surface.
    """
    steps = [
        float(np.median(depth[depth > 0])) / cameras[name].K[0, 0] for name, depth in depths.items()
    ]
    voxel = max(LEAST_VOXEL_M, VOXEL_PX * float(np.median(steps)))
    centre = np.mean([camera.center for camera in cameras.values()], axis=0)
    mesh = fuse(((cameras[name], depth) for name, depth in depths.items()), centre, voxel)
    if not len(mesh.vertex.positions):
        raise StageError(f"{path.name}: the depth maps hold no surface")
    mesh.compute_vertex_normals()
    vertices = mesh.vertex.positions.numpy().astype(np.float64) + centre
    seen, total = np.zeros(len(vertices)), np.zeros((len(vertices), 3))  # views, and their colours
    for name, depth in depths.items():
        found, z = pixels_showing(cameras[name], depth, vertices)
        shown = (found > 0) & (np.abs(found - z) < TRUNCATION * voxel)
        seen += shown
        total[shown] += pixels_showing(cameras[name], pictures[name], vertices[shown])[0]
    colours = np.rint(total / np.maximum(seen, 1)[:, None]).astype(np.uint8)
    faces, normals = mesh.triangle.indices.numpy(), mesh.vertex.normals.numpy()
    confidence = np.minimum(seen / SURE, 1.0).astype(np.float32)
    write_surface(path, vertices, faces, normals, colours, confidence)
    return len(vertices)


def fuse(
    maps: Iterable[tuple[Camera, np.ndarray]],
    centre: np.ndarray,
    voxel: float,
    least_views: float = 1.0,
) -> o3d.t.geometry.TriangleMesh:
    """Fuse depth maps (H, W), metres, of pinhole cameras: a mesh about `centre` (3,).

    Source: Curless and Levoy 1996, through Open3D.
    """
    volume = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (o3d.core.float32, o3d.core.float32), ((1,), (1,)),
        voxel_size=voxel, block_resolution=16, block_count=20_000,
    )  # fmt: skip
    for camera, depth in maps:
        image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth[..., None])))
        near = camera.cam_from_world.copy()
        near[:3, 3] += near[:3, :3] @ centre  # Open3D's world is in single precision
        pose = o3d.core.Tensor(K_to_opencv(camera.K)), o3d.core.Tensor(near)
        blocks = volume.compute_unique_block_coordinates(image, *pose, 1.0, FARTHEST_M, TRUNCATION)
        volume.integrate(blocks, image, *pose, 1.0, FARTHEST_M, TRUNCATION)
    return volume.extract_triangle_mesh(weight_threshold=least_views)
