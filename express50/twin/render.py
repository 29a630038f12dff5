"""Render by ray casting: colour, alpha and depth of a frame in any camera.

One ray per pixel finds where there is detail. Only there more rays are cast: many where silhouette
or hair make alpha fractional, a few inside. Images are made in bands of rows, so that memory does
not grow with the image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.spatial

from express50.geometry.cameras import Camera, crop_camera, project, rays
from express50.twin.surface import MISS, Caster, Material

# From directions (N, 3), faces (N,), barycentrics (N, 2) to premultiplied colours and alpha (N, 4).
Shade = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
BAND_PIXELS = 1 << 18
HALO = 4  # rows and columns beyond a band that the search for detail looks at
_DEPTH_STEP = 0.004  # metres between neighbours that count as an edge inside the silhouette


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Rays per pixel."""

    edge: int = 9  # at silhouettes and loose hair
    inside: int = 2  # at detail inside the silhouette
    sparing: bool = True  # silhouette pixels whose first third of rays agree get no more


@dataclass(frozen=True, kw_only=True)
class RowBand:
    """Rays of some rows of a camera, including a halo, in the world."""

    top: int  # rows of the image, without the halo
    bottom: int
    rows: slice  # the same rows of the arrays
    origin: np.ndarray  # (3,) float32
    centre: np.ndarray  # (h, w, 3) directions through pixel centres, camera z 1
    right: np.ndarray  # (h, w, 3) change of direction from pixel to pixel
    down: np.ndarray


def bands(camera: Camera) -> Iterator[RowBand]:
    """Split the image into bands of at most ``BAND_PIXELS`` pixels, top to bottom."""
    rows = max(1, BAND_PIXELS // camera.width)
    for top in range(0, camera.height, rows):
        bottom = min(top + rows, camera.height)
        start, end = max(0, top - HALO), min(camera.height, bottom + HALO)
        part = crop_camera(camera, -1, start - 1, camera.width + 2, end - start + 2)
        origin, grid = rays(part)
        # Central differences, for which the grid has one more pixel on every side.
        right = 0.5 * (grid[1:-1, 2:] - grid[1:-1, :-2])
        down = 0.5 * (grid[2:, 1:-1] - grid[:-2, 1:-1])
        yield RowBand(
            top=top, bottom=bottom, rows=slice(top - start, bottom - start),
            origin=origin.astype(np.float32),
            centre=grid[1:-1, 1:-1].astype(np.float32),
            right=right.astype(np.float32), down=down.astype(np.float32),
        )  # fmt: skip


def render_band(
    caster: Caster,
    material: np.ndarray,
    window: tuple[int, int, int, int],
    band: RowBand,
    sampling: Sampling,
    shade: Shade | None,
) -> tuple[np.ndarray, np.ndarray, tuple[slice, slice]] | None:
    """Render premultiplied colour and alpha of the part of a band where the subject may be.

    That is inside ``window``: columns and rows x0, y0, x1, y1 of the image. Returns colour (h, w,
    3), alpha (h, w) float32, and their rows and columns in the image; None if the band does not
    meet the window. Without ``shade``, colours are 0.
    """
    x0, x1 = window[0], window[2]
    y0, y1 = max(band.top, window[1]), min(band.bottom, window[3])
    if x0 >= x1 or y0 >= y1:
        return None
    first = band.top - band.rows.start
    above, left = max(y0 - HALO - first, 0), max(x0 - HALO, 0)
    around = slice(above, y1 + HALO - first), slice(left, x1 + HALO)
    inner = slice(y0 - first - above, y1 - first - above), slice(x0 - left, x1 - left)
    # (3, h * w, 3): pixels' centres, and the steps to the right and down.
    grid = np.stack([part[around] for part in (band.centre, band.right, band.down)])
    height, width = grid.shape[1:3]
    grid = grid.reshape(3, -1, 3)
    distance, face, bary = caster.cast(band.origin, grid[0])
    edge, inside = _detail(distance.reshape(height, width), face.reshape(height, width), material)
    keep = np.zeros((height, width), dtype=bool)
    keep[inner] = True
    colour = np.zeros((height * width, 3), np.float32)
    alpha = np.zeros(height * width, np.float32)
    # The ray through the centre is one of each pixel's samples.
    seen = np.flatnonzero(keep.ravel() & (face != MISS))
    alpha[seen] = 1.0
    if shade is not None and seen.size:
        rgba = shade(grid[0, seen], face[seen], bary[seen])
        colour[seen], alpha[seen] = rgba[:, :3], rgba[:, 3]
    for chosen, count in ((edge, sampling.edge), (inside & ~edge, sampling.inside)):
        index = np.flatnonzero((chosen & keep).ravel())
        for part in np.array_split(index, max(1, len(index) * count >> 18)):
            if part.size and count > 1:
                samples = colour[part], alpha[part]
                colour[part], alpha[part] = _refined(
                    caster, band.origin, grid[:, part], samples, count, sampling.sparing, shade
                )
    place = slice(y0, y1), slice(x0, x1)
    return colour.reshape(height, width, 3)[inner], alpha.reshape(height, width)[inner], place


def _detail(
    distance: np.ndarray, face: np.ndarray, material: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mark the pixels (h, w) whose alpha may be fractional, and other pixels with detail."""
    hit = face != MISS
    kind = np.where(hit, material[np.where(hit, face, 0)], 255).astype(np.uint8)
    box = np.ones((3, 3), np.uint8)
    covered = hit.astype(np.uint8)
    # Strands thinner than a pixel may lie between rays, so more pixels around hair count.
    wide = np.ones((5, 5), np.uint8)
    hair = cv2.dilate((kind == Material.HAIR).astype(np.uint8), wide)
    some, every = cv2.dilate(covered, box), cv2.erode(covered, box)
    edge = (some != every) | ((hair > 0) & (cv2.erode(covered, wide) == 0))
    z = np.where(hit, distance, 0.0).astype(np.float32)
    steps = cv2.dilate(z, box) - cv2.erode(z, box) > _DEPTH_STEP
    mixed = cv2.dilate(kind, box) != cv2.erode(kind, box)
    inside = (steps | mixed | (kind == Material.HAIR)) & (some > 0)
    return edge, inside


def _refined(
    caster: Caster,
    origin: np.ndarray,
    grid: np.ndarray,
    samples: tuple[np.ndarray, np.ndarray],
    count: int,
    sparing: bool,
    shade: Shade | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return colour (N, 3) and alpha (N,) of pixels (3, N, 3) as means of ``count`` samples.

    ``samples`` are those of their centres. If ``sparing``, pixels get a third of the rays first,
    and no more if these all hit or all miss.
    """
    places = np.stack(ray_pattern(count), axis=1)
    others = np.delete(np.arange(count), count // 2)
    first = others[:: len(others) // 2] if sparing and len(others) > 4 else others
    more = _cast_more(caster, origin, grid, places[first], shade)
    colour, alpha = samples[0] + more[0], samples[1] + more[1]
    weight = np.full(len(alpha), 1.0 + len(first), np.float32)
    if len(first) < len(others):
        mixed = np.flatnonzero((alpha > 0) & (alpha < weight))
        rest = np.setdiff1d(others, first)
        more = _cast_more(caster, origin, grid[:, mixed], places[rest], shade)
        colour[mixed] += more[0]
        alpha[mixed] += more[1]
        weight[mixed] += len(rest)
    return colour / weight[:, None], alpha / weight


def _cast_more(
    caster: Caster, origin: np.ndarray, grid: np.ndarray, places: np.ndarray, shade: Shade | None
) -> tuple[np.ndarray, np.ndarray]:
    """Cast rays at places (K, 2) in each pixel; return sums of colour (N, 3) and alpha (N,)."""
    centre, right, down = grid
    u, v = places.T[:, :, None, None]
    directions = (centre + u * right + v * down).reshape(-1, 3)
    _, face, bary = caster.cast(origin, directions)
    hit = np.flatnonzero(face != MISS)
    seen = np.zeros(len(directions), np.float32)
    seen[hit] = 1.0
    colours = np.zeros((len(directions), 3), np.float32)
    if shade is not None and hit.size:
        rgba = shade(directions[hit], face[hit], bary[hit])
        colours[hit], seen[hit] = rgba[:, :3], rgba[:, 3]
    count = len(places)
    return colours.reshape(count, -1, 3).sum(0), seen.reshape(count, -1).sum(0)


def ray_pattern(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places x and y (count,) in a pixel, from -0.5 up, evenly spread.

    They are a rank-1 lattice: every row and column of a count x count grid holds one ray. Number
    ``count // 2`` is the centre.
    """
    half = count // 2
    k = np.arange(count)
    stride = max(1, round(count * 0.618034))
    while np.gcd(stride, count) != 1:
        stride += 1
    u = (k - half) / count
    v = (((k - half) * stride + half) % count - half) / count
    return u.astype(np.float32), v.astype(np.float32)


def hull_of(vertices: np.ndarray) -> np.ndarray:
    """Return the corners (K, 3) of the convex hull of vertices (N, 3), not all in one plane."""
    return vertices[scipy.spatial.ConvexHull(vertices).vertices]


def window_of(camera: Camera, vertices: np.ndarray) -> tuple[int, int, int, int]:
    """Return columns and rows x0, y0, x1, y1 that contain all vertices (N, 3), with a margin.

    The corners of the convex hull (:func:`hull_of`) are enough.
    """
    pixels, depth = project(camera, vertices)
    if not (depth > 0.05).all():
        return 0, 0, camera.width, camera.height
    # The lens bends the hull's straight edges by less than this.
    margin = 3 + 0.005 * max(camera.width, camera.height)
    x0, y0 = np.floor(pixels.min(0) - margin).astype(int)
    x1, y1 = np.ceil(pixels.max(0) + margin).astype(int)
    x0, x1 = np.clip((x0, x1), 0, camera.width)
    y0, y1 = np.clip((y0, y1), 0, camera.height)
    return int(x0), int(y0), int(x1), int(y1)
