"""The window of an image that holds the head; all else is background.

Training crops to it, and pictures are drawn in it: what lies outside is neither rasterised nor
refined.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from grmm.model import GRMM
from grmm.rasterize.projection import ALPHA_MIN
from grmm.scene import Gaussians, Rendering, View

WINDOW_STEP = 32  # pixels; windows have sides of whole steps
NEAR_M = 1e-2  # the rasteriser's default
NEAR_VERTEX_M = 1e-3


def draw_window(
    model: GRMM,
    gaussians: Gaussians,
    colours: Tensor,
    view: View,
    background: float = 0.0,
    *,
    refine: bool = True,
    margin_px: int = 16,
) -> Rendering:
    """`GRMM.draw` in the window around the Gaussians, the rest filled with background.

    Colours before refinement, depth and alpha are those of the whole image. Refined ones differ
    near the window's border as they do in training, whose crops have the same margin.

    Args:
        model: the model.
        gaussians: from `GRMM.geometry`.
        colours: (N, 3 + features) from `GRMM.appearance`.
        view: the whole image's camera.
        background: grey, sRGB in [0, 1].
        refine: as in `GRMM.draw`.
        margin_px: of training (DataConfig.crop_margin_px); -1 draws the whole image.
    """
    if margin_px < 0:
        return model.draw(gaussians, colours, view, background, refine)
    low, high = model.config.scale_bounds_mm
    rows, columns = gaussian_window(gaussians, view, (1e-3 * low, 1e-3 * high), margin_px)
    out = model.draw(gaussians, colours, crop_view(view, rows, columns), background, refine)
    if (out.image.shape[1], out.image.shape[2]) == (view.height, view.width):
        return out

    def paste(window: Tensor, fill: float) -> Tensor:
        whole = window.new_full((*window.shape[:-2], view.height, view.width), fill)
        whole[..., rows, columns] = window
        return whole

    rgb = paste(out.rgb, background)
    return Rendering(
        image=rgb if out.image is out.rgb else paste(out.image, background),
        rgb=rgb,
        depth=paste(out.depth, 0.0),
        alpha=paste(out.alpha, 0.0),
        gaussians=out.gaussians,
    )


def gaussian_window(
    gaussians: Gaussians, view: View, bounds_m: tuple[float, float], margin_px: int
) -> tuple[slice, slice]:
    """Rows and columns that hold every pixel a Gaussian reaches, with a margin.

    A Gaussian is bounded by the sphere of its largest scale at the distance where its alpha falls
    under a level of 8 bits; the whole image where none is in view.
    """
    with torch.no_grad():
        visible = gaussians.opacities > ALPHA_MIN
        largest = gaussians.scales_mm.amax(1).mul(1e-3).clamp(*bounds_m)
        sigmas = (gaussians.opacities / ALPHA_MIN).clamp_min(1.0).log().mul(2).sqrt()
        extra = margin_px + 2.0  # the rasteriser's blur (variance 0.3) reaches under two pixels
        reach = (largest * sigmas)[visible]
        columns, rows = _extents(gaussians.means[visible], reach, view, NEAR_M, extra)
    return _span(*rows, view.height), _span(*columns, view.width)


def head_window(
    vertices: Tensor, view: View, alpha: np.ndarray, margin_px: int
) -> tuple[slice, slice]:
    """Rows and columns that hold the projected mesh (V, 3) and the matte (H, W), with a margin.

    Sizes are rounded up to WINDOW_STEP where the image allows, so that few sizes occur: every new
    size costs convolutions their set-up.
    """
    extents = _extents(vertices, vertices.new_zeros(len(vertices)), view, NEAR_VERTEX_M)
    spans = []
    for axis, size in ((1, view.height), (0, view.width)):
        matte = np.flatnonzero((alpha > 0).any(axis=axis))
        low, high = extents[axis]
        if len(matte):
            low, high = min(low, float(matte[0])), max(high, float(matte[-1]))
        spans.append(_span(low - margin_px, high + 1 + margin_px, size))
    return spans[0], spans[1]


def _extents(
    points: Tensor, radii: Tensor, view: View, near_m: float, margin_px: float = 0.0
) -> tuple[tuple[float, float], tuple[float, float]]:
    """From where to where spheres reach, pixels: along x, then y; (inf, -inf) where none is seen.

    Args:
        points: (N, 3) centres, head space, metres.
        radii: (N,) metres.
        view: the camera.
        near_m: points nearer than this, or behind the camera, are not seen.
        margin_px: added on all sides.
    """
    camera, K = view.cam_from_head.to(points.dtype), view.K.to(points.dtype)
    points = points @ camera[:3, :3].T + camera[:3, 3]
    seen = points[:, 2] > near_m
    points, radii = points[seen], radii[seen]
    if not len(points):
        return (math.inf, -math.inf), (math.inf, -math.inf)
    # A sphere off the axis projects to a longer ellipse: by 1 / cosine of its angle.
    ray = points[:, :2] / points[:, 2:]
    stretch = 1 + (ray**2).sum(1)

    def ends(axis: int) -> tuple[float, float]:
        centre = K[axis, axis] * ray[:, axis] + K[axis, 2]
        wide = K[axis, axis] * radii / points[:, 2] * stretch + margin_px
        return float((centre - wide).min()), float((centre + wide).max())

    return ends(0), ends(1)


def _span(low: float, high: float, size: int) -> slice:
    """Whole steps around [low, high) that lie within [0, size); the whole axis if none is left."""
    low, high = max(0.0, low), min(float(size), high)
    if high <= low:
        return slice(0, size)
    length = min(size, math.ceil((high - low) / WINDOW_STEP) * WINDOW_STEP)
    start = min(max(0, round((low + high - length) / 2)), size - length)
    return slice(start, start + length)


def crop_view(view: View, rows: slice, columns: slice) -> View:
    """The same camera, seeing only some rows and columns."""
    K = view.K.clone()
    K[0, 2] -= columns.start
    K[1, 2] -= rows.start
    return View(
        K=K,
        cam_from_head=view.cam_from_head,
        width=columns.stop - columns.start,
        height=rows.stop - rows.start,
    )
