"""Find the window around the head, draw in it, and find the neck that a torso hides or cuts.

Training and drawing are limited to the window; outside of it nothing is rasterised or refined.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from express50.geometry.conventions import corner_to_cell
from express50.geometry.transforms import transform_points
from express50.geometry.transforms_torch import quat_to_matrix
from express50.head.model import HeadModel
from grmm.config import SCALE_RANGE_MM
from grmm.model import GRMM, Gaussians, PinholeView, Rendering
from grmm.rasterize.projection import ALPHA_MIN, NEAR_M

CROP_MARGIN_PX = 16  # of the window that training and drawing take
WINDOW_STEP = 32  # pixels; windows have sides of whole steps
NEAR_VERTEX_M = 1e-3
GROW_PX, FAR_PX = 2, 1e5  # of a silhouette's blurred border; off the picture
CUT_M = 0.02  # above the neck's open end, which collars hide in most footage
CUT_SIGMAS = 2.0  # deviations by which a Gaussian reaches down
CUT_LEAST = 0.5  # share of its size under which a Gaussian at the cut is left out


def draw_window(
    model: GRMM,
    gaussians: Gaussians,
    colours: Tensor,
    view: PinholeView,
    background: float = 0.0,
    *,
    refine: bool = True,
) -> Rendering:
    """Draw the window around the Gaussians with `GRMM.draw`; the rest is background.

    Refined colours near the window's border differ from those of the whole image, as they do in
    training, whose crops have the same margin; everything else is the same. ``colours`` (N, 3 +
    features) are from `GRMM.appearance`; ``background`` is grey, sRGB in [0, 1].
    """
    rows, columns = gaussian_window(gaussians, view)
    out = model.draw(gaussians, colours, crop_view(view, rows, columns), background, refine)
    if (out.image.shape[1], out.image.shape[2]) == (view.height, view.width):
        return out

    def paste(window: Tensor, fill: float) -> Tensor:
        whole = window.new_full((*window.shape[:-2], view.height, view.width), fill)
        whole[..., rows, columns] = window
        return whole

    rgb = paste(out.rgb, background)
    image = rgb if out.image is out.rgb else paste(out.image, background)
    depth, alpha = paste(out.depth, 0.0), paste(out.alpha, 0.0)
    return replace(out, image=image, rgb=rgb, depth=depth, alpha=alpha)


def gaussian_window(gaussians: Gaussians, view: PinholeView) -> tuple[slice, slice]:
    """Return the rows and columns that hold every pixel a Gaussian reaches, with a margin.

    A Gaussian is bounded by the sphere outside of which its alpha is under 1/255. The whole image
    is returned if no Gaussian is in view.
    """
    with torch.no_grad():
        visible = gaussians.opacities > ALPHA_MIN
        largest = 1e-3 * gaussians.scales_mm.amax(1).clamp(*SCALE_RANGE_MM)
        sigmas = (gaussians.opacities / ALPHA_MIN).clamp_min(1.0).log().mul(2).sqrt()
        extra = CROP_MARGIN_PX + 2.0  # the rasteriser's blur reaches under two pixels
        reach = torch.where(visible, largest * sigmas, -math.inf)
        columns, rows = _extents(gaussians.means, reach, view, NEAR_M, extra)
    return _span(*rows, view.height), _span(*columns, view.width)


def head_window(
    vertices: Tensor, view: PinholeView, alpha: np.ndarray, margin_px: int = CROP_MARGIN_PX
) -> tuple[slice, slice]:
    """Return the window around the projected mesh (V, 3) and the matte (H, W).

    Sizes are rounded up to WINDOW_STEP where the image allows, so that few sizes occur: every new
    size makes convolutions set up again.
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


def sees_head(view: PinholeView, vertices: Tensor) -> bool:
    """Return whether the projected mesh (V, 3) reaches into the picture."""
    extents = _extents(vertices, vertices.new_zeros(len(vertices)), view, NEAR_VERTEX_M)
    sizes = view.width, view.height
    return all(low < size and high > 0 for (low, high), size in zip(extents, sizes, strict=True))


def _extents(
    points: Tensor, radii: Tensor, view: PinholeView, near_m: float, margin_px: float = 0.0
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the pixel range of spheres along x, then y; (inf, -inf) if none is seen.

    Spheres have centres (N, 3) in head space and radii (N,), metres. Those nearer than ``near_m``
    are not seen, nor are those with radius -inf; ``margin_px`` is added on all sides.
    """
    camera, K = view.cam_from_head.to(points.dtype), view.K.to(points.dtype)
    points = points @ camera[:3, :3].T + camera[:3, 3]
    seen = (points[:, 2] > near_m)[:, None]
    z = torch.where(seen, points[:, 2:], 1.0)
    # A sphere off the axis projects to a longer ellipse: by 1 / cosine of its angle.
    ray, focal = points[:, :2] / z, K.diagonal()[:2]
    stretch = 1 + (ray**2).sum(1, keepdim=True)
    centre = focal * ray + K[:2, 2]
    wide = focal * radii[:, None] / z * stretch + margin_px
    low = torch.where(seen, centre - wide, math.inf).amin(0)
    high = torch.where(seen, centre + wide, -math.inf).amax(0)
    # One transfer for all four, because each waits for a GPU to finish what it was given.
    (left, top), (right, bottom) = torch.stack([low, high]).tolist()
    return (left, right), (top, bottom)


def _span(low: float, high: float, size: int) -> slice:
    """Round [low, high) up to whole steps in [0, size); the whole axis if it is outside."""
    low, high = max(0.0, low), min(float(size), high)
    if high <= low:
        return slice(0, size)
    length = min(size, math.ceil((high - low) / WINDOW_STEP) * WINDOW_STEP)
    start = min(max(0, round((low + high - length) / 2)), size - length)
    return slice(start, start + length)


def behind_torso(
    head: HeadModel, vertices: Tensor, view: PinholeView, torso: np.ndarray
) -> np.ndarray:
    """Mark the pixels (H, W) bool of a torso (H, W) that hide the neck of the tracked mesh.

    ``vertices`` (V, 3) and the view are in head space. Without a region ``neck`` in the head model
    no pixel is marked.
    """
    found = np.zeros(torso.shape, np.uint8)
    regions = [head.regions[name] for name in ("neck", "boundary") if name in head.regions]
    if not torso.any() or not regions:
        return found > 0
    neck = torch.stack(regions).any(0)
    faces = head.faces[neck[head.faces].any(1)].cpu().numpy()
    K, camera = view.K.cpu().numpy(), view.cam_from_head.cpu().numpy()
    points = transform_points(camera, vertices.detach().cpu().double().numpy())
    ahead = (points[:, 2] > NEAR_M)[faces].all(1)
    with np.errstate(all="ignore"):  # points behind the camera are in no face that is drawn
        places = corner_to_cell((points @ K.T)[:, :2] / points[:, 2:])
    for corners in np.round(places[faces[ahead]].clip(-FAR_PX, FAR_PX)).astype(np.int32):
        cv2.fillConvexPoly(found, corners, 1)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return torso & (cv2.dilate(found, cross, iterations=GROW_PX) > 0)


def neck_cut(
    head: HeadModel, vertices: Tensor, means: Tensor, quats: Tensor, scales: Tensor
) -> Tensor:
    """Return the share (N,) of its size that each Gaussian keeps at a straight cut of the neck.

    Below it, training hardly sees the neck, and what it left there ends in a fringe: the share is
    0. Gaussians that reach across are made smaller. The cut is parallel to the plane of the neck's
    open end, the head model's region ``boundary``; without it all shares are 1. ``vertices`` (V, 3)
    of the deformed mesh, ``means`` (N, 3) and standard deviations ``scales`` (N, 3) are in metres,
    ``quats`` (N, 4) wxyz.
    """
    end = head.regions.get("boundary")
    if end is None or int(end.sum()) < 3:
        return torch.ones_like(means[:, 0])
    loop = vertices[end].double()
    centre = loop.mean(0)
    up = torch.linalg.svd(loop - centre, full_matrices=False)[2][2]
    up = up * torch.sign(up @ (vertices.double().mean(0) - centre))
    along = torch.einsum("nij,i->nj", quat_to_matrix(quats.double()), up) * scales
    height = (means.double() - centre) @ up - CUT_M
    share = (height / (CUT_SIGMAS * along.norm(dim=1)).clamp_min(1e-9)).clamp(0, 1)
    return torch.where(share < CUT_LEAST, 0.0, share).to(means.dtype)


def without_neck_end(head: HeadModel, vertices: Tensor, gaussians: Gaussians) -> Gaussians:
    """Apply `neck_cut` to a tracked mesh's (V, 3) Gaussians; those left out turn transparent."""
    scales = gaussians.scales_mm.clamp(*SCALE_RANGE_MM)
    deformed = vertices + gaussians.displacement
    share = neck_cut(head, deformed, gaussians.means, gaussians.quats, 1e-3 * scales)
    opacities = torch.where(share > 0, gaussians.opacities, 0.0)
    return replace(gaussians, scales_mm=scales * share[:, None], opacities=opacities)


def crop_view(view: PinholeView, rows: slice, columns: slice) -> PinholeView:
    """Crop a camera to some rows and columns."""
    K = view.K.clone()
    K[0, 2] -= columns.start
    K[1, 2] -= rows.start
    return replace(view, K=K, width=columns.stop - columns.start, height=rows.stop - rows.start)
