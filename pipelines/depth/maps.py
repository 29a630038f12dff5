"""Cast rays at the surface: depth, normals and error bounds per camera, checked by its neighbours.

Bounds follow from figures of each pixel: agreement of patches, slant, jumps and roughness of the
surface, and photometric errors. For these, each view is warped into its neighbours' pictures
through its own depth map. Where the surface is right, colours agree up to gain, highlights and
noise. On bare skin a small error proves little, but a large one always shows (Seitz et al. 2006).
`express50.error_model` turns these figures into millimetres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import open3d as o3d

from express50.capture.frames import reduced
from express50.error_model import HEAD_SIZE_SPREAD, Bounds, error_bounds
from express50.geometry.cameras import Camera, crop_camera, cut_about, rays, resized, unproject
from express50.geometry.conventions import cell_centres, cell_to_corner
from express50.geometry.pixels import box_about
from express50.geometry.raycast import barycentrics, camera_rays, join_rays, mesh_scene
from express50.geometry.sampling import bilinear, edge_width, local_moments
from pipelines.depth.prior import TrackedSolid
from pipelines.depth.surface import HeadSurface
from pipelines.depth.views import INSIDE, in_picture, project_fast

SURE_MM = 2.0  # bound at which confidence is a half
COMPARED_SIDE = 512  # longest side, pixels, at which views are compared through the depth
NEIGHBOURS = 4  # views that each is compared with, those whose directions are closest
CONSISTENT_STEPS = 10.0  # 8-bit steps up to which colours agree: noise and highlights take some
DARK = 16.0  # 8-bit steps; gains are not measured on darker pixels
FLAT = 4.0  # tangent of the angle between line of sight and normal from which colours smear
HIDDEN_M = 0.004  # metres behind the neighbour's own depth at which a point counts as hidden
RAY_PIXELS = 2.0  # rays per voxel, at least, where not every pixel has its own
WINDOW = 5  # pixels, odd: colours around a wrong depth agree here and there by chance

GRAINS = 7  # every n-th pixel counts for the typical grain of all views


@dataclass(frozen=True)
class Picture:
    """One camera's picture; of the full size only what counts, as all would take a gigabyte."""

    camera: Camera  # pinhole, of the full size
    # camera, frame (h, w, 3) and matte (h, w), uint8, as they are compared
    small: tuple[Camera, np.ndarray, np.ndarray]
    box: tuple[slice, slice]  # rows and columns of the full size about the matte
    grey: np.ndarray  # frame (h, w), uint8, in this box
    alpha: np.ndarray  # matte (h, w), uint8, in this box
    grains: np.ndarray  # (N,) `grain` at some pixels of the matte
    edge_px: float  # how blurred it is: width of its sharpest edges at the small size, or NaN

    @property
    def matte(self) -> np.ndarray:
        """Return the matte (H, W) uint8 in the full size."""
        found = np.zeros((self.camera.height, self.camera.width), np.uint8)
        found[self.box] = self.alpha
        return found


def picture_of(camera: Camera, rgb: np.ndarray, alpha: np.ndarray) -> Picture:
    """Describe a frame (H, W, 3) and a matte (H, W), uint8."""
    box = box_about(alpha, WINDOW)
    grey = cv2.cvtColor(np.ascontiguousarray(rgb[box]), cv2.COLOR_RGB2GRAY)
    grains = grain(grey, alpha[box] > 255 * INSIDE)[::GRAINS]
    small = reduced(camera, rgb, alpha, COMPARED_SIDE)
    part = np.ascontiguousarray(small[1][box_about(small[2] > 255 * INSIDE)])
    edge = edge_width(part) if part.size else None
    edge_px = np.nan if edge is None else edge
    return Picture(camera, small, box, grey, alpha[box].copy(), grains, edge_px)


@dataclass(frozen=True)
class DepthMaps:
    """The maps (h, w) of the surface in a window of one camera."""

    depth: np.ndarray  # metres, 0 where not valid
    valid: np.ndarray  # inside the matte
    normals: np.ndarray  # (h, w, 3) camera axes, 0 where not valid
    covered: float  # share of the matte with depth
    spill: float  # share of the surface outside
    figures: Mapping[str, np.ndarray | float]  # how well each of N valid pixels is known
    bounds: Bounds | None = None  # that follow from the figures
    window: tuple[slice, slice] | None = None  # rows and columns; None if the maps cover all
    size: tuple[int, int] = (0, 0)  # (H, W) of the picture

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Return values (h, w[, C]) of the window as those of the picture (H, W[, C]), else 0."""
        if self.window is None:
            return values
        found = np.zeros((*self.size, *values.shape[2:]), values.dtype)
        found[self.window] = values
        return found

    @property
    def confidence(self) -> np.ndarray:
        """Return SURE_MM / (SURE_MM + bound), (h, w) float32 in [0, 1]; 0 where not valid."""
        found = np.zeros(self.depth.shape, np.float32)
        if self.bounds is not None:
            found[self.valid] = SURE_MM / (SURE_MM + self.bounds.bound)
        return found


@dataclass(frozen=True)
class ComparedView:
    """One camera's colours at the size of the comparison."""

    camera: Camera
    colour: np.ndarray  # (H, W, 3) float32, 8-bit steps
    depth: np.ndarray  # (H, W) metres, 0 where there is none
    plain: np.ndarray  # (H, W) pixels off every edge that see the surface at no flat angle


@dataclass(frozen=True)
class PhotoErrors:
    """Photometric errors of one view."""

    errors: np.ndarray  # (H, W) 8-bit steps; NaN where no neighbour sees the point
    compared: float  # share of pixels that neighbours see

    def figures(self) -> dict[str, float]:
        """Summarise the errors and the shares compared and consistent for the metrics."""
        known = self.errors[np.isfinite(self.errors)]
        if not len(known):
            return {"photo_compared": 0.0}
        median, tail = np.percentile(known, [50, 95])
        return {
            "photo_error_median": float(median),
            "photo_error_p95": float(tail),
            "photo_consistent": float((known <= CONSISTENT_STEPS).mean()),
            "photo_compared": self.compared,
        }


def surface_maps(
    surface: HeadSurface, pictures: Sequence[Picture], solid: TrackedSolid | None = None
) -> Iterator[tuple[str, DepthMaps, PhotoErrors]]:
    """Yield camera id, maps of the surface and neighbours' errors of one camera after the other.

    Surface away from the tracked head, `solid`, is hair, cloth or wrong. The maps of all cameras
    together would take gigabytes.
    """
    apart = None
    if solid is not None:
        query = o3d.core.Tensor(surface.vertices.astype(np.float32))
        apart = 1e3 * solid.scene.compute_distance(query, nthreads=1).numpy()
    scene = mesh_scene(surface.vertices, surface.faces)
    shots = [
        compared_view(scene, camera, rgb, alpha.astype(np.float32) / 255)
        for camera, rgb, alpha in (picture.small for picture in pictures)
    ]
    photo = photo_errors(shots)
    common = common_figures(surface, pictures, photo)
    for picture, errors in zip(pictures, photo, strict=True):
        camera = picture.camera
        seen = cast_window(surface, scene, camera, picture.matte, apart)
        valid = seen.whole(seen.valid)
        figures = {
            **seen.figures,
            **common,
            "photo": smoothed_errors(errors, valid, WINDOW),
            "photo_wide": smoothed_errors(errors, valid, 3 * WINDOW),
            "grain": grain(picture.grey, valid[picture.box]),
        }
        shared = 1e3 * HEAD_SIZE_SPREAD * seen.depth[seen.valid] if len(pictures) == 1 else 0.0
        bounds = error_bounds("depth", figures, shared)
        yield camera.id, replace(seen, figures=figures, bounds=bounds), errors


def common_figures(
    surface: HeadSurface, pictures: Sequence[Picture], photo: Sequence[PhotoErrors]
) -> dict[str, float]:
    """Return the figures that all pixels of an item share."""
    middle = surface.vertices.mean(0)
    cameras = [picture.camera for picture in pictures]
    pixels = [np.linalg.norm(c.center - middle) / c.K[0, 0] for c in cameras]
    known = np.concatenate([one.errors[np.isfinite(one.errors)] for one in photo])
    every = np.concatenate([picture.grains for picture in pictures])
    edges = [picture.edge_px for picture in pictures if np.isfinite(picture.edge_px)]
    return {
        "voxel_mm": surface.figures["voxel_mm"],
        "pixel_mm": 1e3 * float(np.median(pixels)),
        "views": float(len(pictures)),
        "photo_all": float(np.median(known)) if len(known) else np.inf,
        "grain_all": float(np.median(every)) if len(every) else np.inf,
        "edge_px": 0.5 + float(np.median(edges)) if edges else np.inf,
    }


def cast_window(
    surface: HeadSurface,
    scene: o3d.t.geometry.RaycastingScene,
    camera: Camera,
    alpha: np.ndarray,
    apart_mm: np.ndarray | None,
) -> DepthMaps:
    """Cast rays only where the surface projects to; `alpha` (H, W) uint8 is of the whole picture.

    A head fills a third of a picture.
    """
    pixels, depth = project_fast(camera, surface.vertices)
    part, window = camera, np.s_[:, :]
    if (depth > 0).all():  # two pixels more for what looks at neighbours
        part, window = cut_about(camera, pixels, 2)
    seen = cast_maps(surface, scene, part, alpha[window].astype(np.float32) / 255, apart_mm)
    covered = float(seen.valid.sum() / max(int((alpha > 255 * INSIDE).sum()), 1))
    return replace(seen, covered=covered, window=window, size=alpha.shape)


def cast_maps(
    surface: HeadSurface,
    scene: o3d.t.geometry.RaycastingScene,
    camera: Camera,
    alpha: np.ndarray,
    apart_mm: np.ndarray | None = None,
) -> DepthMaps:
    """Cast a camera's rays; depth is valid where they hit inside the matte (H, W).

    Where pixels are much finer than voxels, fewer rays are cast and the values between them
    interpolated, but not across jumps of depth. `apart_mm` (V,) are the vertices' distances to the
    tracked head.
    """
    apart = np.full(len(surface.vertices), np.nan) if apart_mm is None else 1 + apart_mm
    of_vertices = np.column_stack([surface.normals, surface.confidence, apart]).astype(np.float32)

    def cast(ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hits = scene.cast_rays(join_rays(camera.center, ways), nthreads=1)
        depth = hits["t_hit"].numpy()
        hit = np.isfinite(depth)
        faces = surface.faces[hits["primitive_ids"].numpy()[hit]]
        found = np.zeros((*hit.shape, of_vertices.shape[1]), np.float32)
        found[hit] = np.einsum("nk,nkc->nc", barycentrics(hits, hit), of_vertices[faces])
        return np.where(hit, depth, 0), found

    away = np.linalg.norm(surface.vertices.mean(0) - camera.center)
    pixel = float(away) / camera.K[0, 0]
    step = max(1, int(1e-3 * surface.figures["voxel_mm"] / (RAY_PIXELS * pixel)))
    width, height = -(-camera.width // step), -(-camera.height // step)
    wide = crop_camera(camera, 0, 0, width * step, height * step)
    coarse = resized(wide, width, height)
    depth, seen = cast(rays(coarse)[1])
    if step > 1:
        known, steep = depth > 0, jumps(coarse, depth) > 2 * FLAT
        depth, seen = (_enlarged(values, wide, cv2.INTER_LINEAR) for values in (depth, seen))
        known, steep = (_enlarged(mask, wide, cv2.INTER_NEAREST) for mask in (known, steep))
        box = np.s_[: camera.height, : camera.width]
        depth, seen = (depth * known)[box], seen[box]
        y, x = np.nonzero(steep[box] & (alpha > INSIDE))
        pixels = cell_to_corner(np.stack([x, y], 1))
        depth[y, x], seen[y, x] = cast(unproject(camera, pixels, np.ones(len(x))) - camera.center)
    # A fifth of the time of `take`, and half of that of a mask.
    seen = seen.reshape(-1, seen.shape[2]).compress(_inside(depth, alpha).ravel(), axis=0)
    return make_maps(camera, alpha, depth, seen[:, :3], seen[:, 3], seen[:, 4])


def _enlarged(values: np.ndarray, camera: Camera, how: int) -> np.ndarray:
    """Enlarge values (h, w[, C]) to a camera's size."""
    values = values.astype(np.uint8 if values.dtype == bool else np.float32)
    return cv2.resize(values, (camera.width, camera.height), interpolation=how)


def make_maps(
    camera: Camera,
    alpha: np.ndarray,
    depth: np.ndarray,
    normals: np.ndarray,
    agreement: np.ndarray,
    apart_mm: np.ndarray | float,
) -> DepthMaps:
    """Keep what is hit inside the matte (H, W), and describe how well it is known.

    `depth` (H, W) is 0 where nothing is hit. Of the N pixels that are kept, `normals` (N, 3) are
    the world's, the patches' `agreement` (N,) is in [0, 1], and `apart_mm` (N,) is the distance to
    the tracked head.
    """
    valid = _inside(depth, alpha)
    inside, hit = alpha > INSIDE, depth > 0
    turn = camera.cam_from_world[:3, :3].T.astype(np.float32)
    lengths = np.sqrt(np.einsum("ni,ni->n", normals, normals))  # faster than np.linalg.norm
    known = (normals / np.maximum(lengths, 1e-9)[:, None]) @ turn
    y, x = np.nonzero(valid)
    K = camera.K
    across, down = (
        ((cell_centres(side) - K[axis, 2]) / K[axis, axis]).astype(np.float32).take(place)
        for axis, (side, place) in enumerate(((camera.width, x), (camera.height, y)))
    )
    cosine = -(known[:, 0] * across + known[:, 1] * down + known[:, 2])
    cosine /= np.sqrt(1 + across * across + down * down)
    depth = np.where(valid, depth, 0).astype(np.float32)
    turned = np.zeros((*depth.shape, 3), np.float32)
    turned.reshape(-1, 3)[y * depth.shape[1] + x] = known
    return DepthMaps(
        depth=depth,
        valid=valid,
        normals=turned,
        covered=float(valid.sum() / max(int(inside.sum()), 1)),
        spill=float((hit & ~inside).sum() / max(int(hit.sum()), 1)),
        figures={
            "disagreement": 1.05 - np.clip(agreement, 0, 1),
            "slant": 1 / np.clip(cosine, 0.05, 1),
            "jump": np.minimum(jumps(camera, depth)[valid], 1e3),
            "rough": roughness(turned)[valid],
            "soft": 1.05 - np.clip(alpha[valid], 0, 1),
            "apart_mm": apart_mm,
        },
    )


def _inside(depth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Mark the pixels (H, W) whose ray hits the surface and that lie inside the matte."""
    return (depth > 0) & (alpha > INSIDE)


def roughness(normals: np.ndarray) -> np.ndarray:
    """Measure (H, W) how much unit normals (H, W, 3; 0: none) differ within a window: 0 to 1."""
    count = cv2.blur(has_normal(normals).astype(np.float32), (WINDOW, WINDOW))
    mean = cv2.blur(normals, (WINDOW, WINDOW))
    mean = np.sqrt(np.einsum("hwi,hwi->hw", mean, mean))
    return 1.001 - np.minimum(mean / np.maximum(count, 1e-6), 1)


def has_normal(normals: np.ndarray) -> np.ndarray:
    """Mark the pixels (H, W) whose normal (H, W, 3) is not 0; `any` takes ten times as long."""
    return cv2.inRange(normals, (0, 0, 0), (0, 0, 0)) == 0


def jumps(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Measure the range (H, W) of depth (H, W; 0: none) over a pixel and its eight neighbours.

    The unit is a pixel's width at that depth; outlines are infinite.
    """
    square = np.ones((3, 3), np.uint8)
    low, high = (way(depth.astype(np.float32), square) for way in (cv2.erode, cv2.dilate))
    return np.where(low > 0, (high - low) * float(camera.K[0, 0]) / np.maximum(high, 1e-12), np.inf)


def compared_view(
    scene: o3d.t.geometry.RaycastingScene,
    camera: Camera,
    rgb: np.ndarray,
    alpha: np.ndarray,
    side: int = COMPARED_SIDE,
) -> ComparedView:
    """Reduce a picture (H, W, 3) uint8 to at most ``side`` pixels, with depth inside its matte."""
    camera, rgb, alpha = reduced(camera, rgb, alpha, side)
    depth = scene.cast_rays(camera_rays(camera), nthreads=1)["t_hit"].numpy()
    seen = np.isfinite(depth) & (alpha > INSIDE)
    depth = np.where(seen, depth, 0).astype(np.float32)
    # At a neighbour's outline colours mix with the background, and a pixel spans centimetres.
    plain = jumps(camera, depth) < 2 * FLAT  # over the two steps from side to side
    return ComparedView(camera, rgb.astype(np.float32), depth, plain)


def photo_errors(views: Sequence[ComparedView]) -> list[PhotoErrors]:
    """Compare each view with its neighbours through its depth: their median colour difference."""
    forward = np.stack([view.camera.cam_from_world[2, :3] for view in views])
    closeness = forward @ forward.T
    np.fill_diagonal(closeness, -2.0)
    order = np.argsort(-closeness, axis=1, kind="stable")[:, : min(NEIGHBOURS, len(views) - 1)]
    found = []
    for i, (view, row) in enumerate(zip(views, order, strict=True)):
        others = [views[k] for k in row if closeness[i, k] > 0]
        errors = np.full(view.depth.shape, np.nan, np.float32)
        seen = view.depth > 0
        if not seen.any() or not others:
            found.append(PhotoErrors(errors, 0.0))
            continue
        origin, directions = rays(view.camera)
        points = origin + view.depth[seen, None] * directions[seen]
        table = np.sort([_difference(view.colour[seen], points, other) for other in others], 0)
        count = np.isfinite(table).sum(0)  # NaN is sorted last
        column = np.arange(len(points))
        low, high = (table[np.maximum(k, 0) // 2, column] for k in (count - 1, count))
        middle = (low + np.where(count > 1, high, low)) / 2
        errors[seen] = np.where(count > 0, middle, np.nan)
        found.append(PhotoErrors(errors, float((count > 0).mean())))
    return found


def _difference(colour: np.ndarray, points: np.ndarray, other: ComparedView) -> np.ndarray:
    """Compare colours (N, 3) with a neighbour's, gains evened: (N,), NaN where hidden."""
    pixels, depth = project_fast(other.camera, points)
    there = in_picture(other.camera, pixels, depth, inset=1)
    column, row = np.floor(pixels[there]).astype(int).T
    hidden = depth[there] - other.depth[row, column] > HIDDEN_M
    there[there] = other.plain[row, column] & ~hidden
    found = np.full(len(points), np.nan, np.float32)
    theirs = bilinear(other.colour, pixels[there])
    mine = colour[there]
    bright = (mine > DARK) & (theirs > DARK)
    gain = [
        float(np.median(mine[b, k] / theirs[b, k])) if (b := bright[:, k]).any() else 1.0
        for k in range(3)
    ]
    found[there] = np.abs(mine - theirs * gain).mean(1)
    return found


def grain(grey: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Measure how much a picture (H, W) uint8 varies around the N pixels of a mask: (N,).

    It is the deviation within a window over the light. Hair varies, whose strands no surface
    follows.
    """
    box = box_about(mask, WINDOW)
    moments = local_moments(grey[box].astype(np.float32), WINDOW)
    mean, variance = (values[mask[box]] for values in moments)
    return (1 + np.sqrt(variance)) / (DARK + mean)


def smoothed_errors(photo: PhotoErrors, valid: np.ndarray, window: int) -> np.ndarray:
    """Average a view's errors over a window at the N valid pixels (H, W): (N,) 8-bit steps.

    NaN where no neighbour sees the window.
    """
    known = np.isfinite(photo.errors)
    total, count = (
        cv2.blur(values.astype(np.float32), (window, window))
        for values in (np.where(known, photo.errors, 0.0), known)
    )
    mean = np.where(count > 0.5 / window**2, total / np.maximum(count, 1e-6), np.nan)
    box = box_about(valid)
    rows, columns = (
        np.arange(part.start, part.stop) * small // large
        for part, small, large in zip(box, mean.shape, valid.shape, strict=True)
    )
    return 0.5 + mean[np.ix_(rows, columns)][valid[box]]
