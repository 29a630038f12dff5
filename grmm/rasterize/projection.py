"""Project and blend 3D Gaussians in the readable torch form that every backend follows.

The projection is computed in float64, and only its results are rounded to the dtype of ``means``.
Needle-shaped and huge Gaussians cancel badly in float32, and N small matrices cost little.
`rasterize_reference` is the oracle: slow, for any device and float type. Tile by tile it forms
every (Gaussian, pixel) pair. It checks the other backends and renders small scenes where the native
library was not built.

Sources: EWA splatting (Zwicker et al. 2001) as in 3DGS (Kerbl et al. 2023), with the guards of
gsplat (Ye et al. 2025: dilation, field-of-view clamp of the Jacobian, near plane, 1/255 cut-off);
the depth plane is RaDe-GS's (Zhang et al. 2024), written as a regression.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from express50.errors import DivergedError
from express50.geometry.conventions import cell_to_corner
from express50.geometry.transforms_torch import quat_to_matrix

ALPHA_MIN = 1.0 / 255.0  # fainter contributions are skipped
NEAR_M = 0.01  # Gaussians whose mean is not beyond it are dropped
DILATION_PX2 = 0.3  # added to the diagonal of every 2D covariance
ALPHA_MAX = 0.99  # keeps 1 - alpha away from zero
TRANSMITTANCE_MIN = 1e-4  # a pixel stops before it gets darker than this
COMPENSATION_MIN = 0.005  # floor of the antialiasing factor: its square root has no slope at 0
FOV_MARGIN = 0.15  # the Jacobian is clamped this part of the image size beyond the border
TILE = 32  # pixels of the reference; only speed and memory depend on it


class NotFiniteTensorError(DivergedError, ValueError):
    """An argument of ``rasterize`` holds NaN, Inf or numbers too large to square."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """N Gaussians as ``rasterize`` takes them; see there for shapes and units."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Pinhole:
    """The camera of ``rasterize``; see there."""

    K: Tensor
    cam_from_world: Tensor
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """The settings of ``rasterize``; see there."""

    antialiased: bool
    median_depth: bool
    normals: bool


@dataclass(frozen=True)
class RenderOutput:
    """The images that ``rasterize`` returns."""

    colors: Tensor  # (H, W, C) blended colours (any channels), background included
    depth: Tensor  # (H, W) RaDe expected depth, camera z in metres; 0 where alpha is 0
    alpha: Tensor  # (H, W) in [0, 1)
    # (H, W) camera z in metres of the plane of the Gaussian at which the transmittance falls to one
    # half or less; 0 where it never does. None unless asked for.
    median_depth: Tensor | None = None
    # (H, W, 3) blended unit normals of those planes, camera axes, towards the camera, without
    # background; divide by their length for a direction. None unless asked for.
    normals: Tensor | None = None


@dataclass(frozen=True)
class Projection:
    """Gaussians in one image; rows of those that are not ``visible`` are finite but arbitrary."""

    means2d: Tensor  # (N, 2) pixels, corner origin
    conics: Tensor  # (N, 3) entries xx, xy, yy of the inverse of the dilated 2D covariance, 1/px^2
    depths: Tensor  # (N,) camera z of the means, metres
    # (N, 3) ray length l at the mean (m) and its slope (s_u, s_v) in m/px, so that the Gaussian
    # lies at ray length ``l + s . (pixel - mean2d)``
    planes: Tensor
    normals: Tensor  # (N, 3) unit normals of those planes, camera axes, towards the camera
    opacities: Tensor  # (N,) after the antialiasing compensation, if any
    extents: Tensor  # (N, 2) half width and height of the box in which alpha reaches 1/255, pixels
    visible: Tensor  # (N,) bool, in front of the near plane and touching the image


def project(scene: Splats, camera: Pinhole, antialiased: bool = False) -> Projection:
    """Project Gaussians into a camera; differentiable in their geometry and in the camera.

    Nothing is copied to a GPU or read from it, so that CUDA graphs can hold it.
    """
    dtype, width, height = scene.means.dtype, camera.width, camera.height
    means, quats, scales, opacities, _ = (tensor.double() for tensor in vars(scene).values())
    K, cam_from_world = camera.K.double(), camera.cam_from_world.double()
    R, t = cam_from_world[:3, :3], cam_from_world[:3, 3]
    points = means @ R.T + t
    front = points[:, 2] > NEAR_M
    # Culled points get a harmless place, so that gradients contain no division by zero.
    harmless = torch.eye(3, dtype=points.dtype, device=points.device)[2]
    points = torch.where(front[:, None], points, harmless)
    jacobian = _jacobian(points, K, width, height)
    rows = _product(jacobian, _product(R, quat_to_matrix(quats)) * scales[:, None, :])
    variances = rows.square().sum(2)  # of u, v and the ray length
    conics, slopes, compensation = _regression(rows, variances)
    planes = torch.cat([points.norm(dim=1, keepdim=True), slopes], 1)
    focal = torch.stack([K[0, 0], K[1, 1]])
    means2d = focal * points[:, :2] / points[:, 2:] + K[:2, 2]
    if antialiased:
        opacities = opacities * compensation
    # On the plane (ray length - slope . pixel) is constant, so minus its derivative by camera
    # coordinates points at the camera (RaDe-GS, section 3).
    steep = (slopes[:, :, None] * jacobian[:, :2]).sum(1) - jacobian[:, 2]
    extents, visible = _extents(means2d, variances[:, :2] + DILATION_PX2, opacities, width, height)
    return Projection(
        means2d=means2d.to(dtype),
        conics=conics.to(dtype),
        depths=points[:, 2].to(dtype),
        planes=planes.to(dtype),
        normals=torch.nn.functional.normalize(steep, dim=1).to(dtype),
        opacities=opacities.to(dtype),
        extents=extents,
        visible=visible & front,
    )


def _jacobian(points: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """Return the derivatives (N, 3, 3) of (u, v, ray length) by camera coordinates (N, 3).

    x/z and y/z of the pixel rows are clamped a little outside the image: beyond it the linear
    model of a wide Gaussian would explode.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    z = points[:, 2]
    tan_x = _clamp(
        points[:, 0] / z, -(cx + FOV_MARGIN * width) / fx, (width - cx + FOV_MARGIN * width) / fx
    )
    tan_y = _clamp(
        points[:, 1] / z, -(cy + FOV_MARGIN * height) / fy, (height - cy + FOV_MARGIN * height) / fy
    )
    zero = torch.zeros_like(z)
    row_u = torch.stack([fx / z, zero, -fx * tan_x / z], 1)
    row_v = torch.stack([zero, fy / z, -fy * tan_y / z], 1)
    row_t = points / points.norm(dim=1, keepdim=True)
    return torch.stack([row_u, row_v, row_t], 1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Multiply 3 x 3 matrices; ``@`` takes 1 ms on a GPU for 200,000 of them in float64."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def _clamp(value: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Clamp as torch does, but let the gradient reach the bounds (they depend on K)."""
    return torch.where(value < low, low, torch.where(value > high, high, value))


def _regression(rows: Tensor, variances: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the conics (N, 3), slopes (N, 2) of the ray length and antialiasing factors (N,).

    ``rows`` (N, 3, 3), a square root of the covariance over (u, v, ray length), and its diagonal
    ``variances`` (N, 3). The slope is that of the regression of the ray length t on the pixel,
    Cov(uv)^-1 Cov(uv, t). It equals the plane of RaDe-GS without inverting a 3x3 matrix, and the
    dilated Cov(uv) keeps it bounded for flat Gaussians.

    Determinants are computed from cross products of the rows (Cauchy-Binet). For a needle,
    ``xx * yy - xy**2`` would be the difference of two numbers that agree in all digits.
    """
    u, v, t = rows.unbind(1)
    xx, yy = variances[:, 0], variances[:, 1]
    xy, tu, tv = (u * v).sum(1), (t * u).sum(1), (t * v).sum(1)
    normal, eps2d = torch.linalg.cross(u, v), DILATION_PX2
    det_sharp = normal.square().sum(1)
    det = det_sharp + eps2d * (xx + yy) + eps2d * eps2d
    conics = torch.stack([(yy + eps2d) / det, -xy / det, (xx + eps2d) / det], 1)
    slope_u = (eps2d * tu + (normal * torch.linalg.cross(t, v)).sum(1)) / det
    slope_v = (eps2d * tv + (normal * torch.linalg.cross(u, t)).sum(1)) / det
    compensation = (det_sharp / det).clamp(min=COMPENSATION_MIN**2).sqrt()
    return conics, torch.stack([slope_u, slope_v], 1), compensation


@torch.no_grad()
def _extents(
    means2d: Tensor, variances: Tensor, opacities: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Return half sizes (N, 2) of the boxes where alpha >= 1/255, and if they are in the image."""
    level = 2.0 * torch.log((opacities / ALPHA_MIN).clamp(min=1.0))
    extents = (level[:, None] * variances).sqrt()
    low, high = means2d - extents, means2d + extents
    inside = (high >= 0).all(1) & (low[:, 0] <= width) & (low[:, 1] <= height)
    return extents, inside & (opacities >= ALPHA_MIN)


def ray_lengths(K: Tensor, width: int, height: int) -> Tensor:
    """Return length (H, W) of the ray through each pixel centre at camera z = 1; float64 inside."""
    K64 = K.double()
    u = cell_to_corner(torch.arange(width, device=K.device, dtype=torch.float64))
    v = cell_to_corner(torch.arange(height, device=K.device, dtype=torch.float64))
    x = (u - K64[0, 2]) / K64[0, 0]
    y = (v - K64[1, 2]) / K64[1, 1]
    return (1.0 + x[None, :].square() + y[:, None].square()).sqrt()


def depth_of_rays(ray_length: Tensor, K: Tensor) -> Tensor:
    """Convert ``ray_length`` (H, W) along the rays of pixel centres to camera z (H, W)."""
    height, width = ray_length.shape
    return ray_length / ray_lengths(K, width, height).to(ray_length.dtype)


def expected_depth(weighted_ray_length: Tensor, alpha: Tensor, K: Tensor) -> Tensor:
    """Compute the expected camera z (H, W), m, from sum of weight * ray length and alpha.

    Zero where nothing was hit. Source: RaDe-GS, section 3 (z = t / |K^-1 (u, v, 1)|).
    """
    height, width = alpha.shape
    hit = alpha > 0
    safe = torch.where(hit, alpha, torch.ones_like(alpha))
    lengths = ray_lengths(K, width, height).to(alpha.dtype)
    return torch.where(hit, weighted_ray_length / (safe * lengths), torch.zeros_like(alpha))


def pair_offsets(splats: Projection, gaussians: Tensor, pixels: Tensor, width: int) -> Tensor:
    """Return how far (M, 2) each pair's pixel centre lies from its Gaussian, pixels.

    ``pixels`` (M,) are numbered row by row in an image of this width.
    """
    places = torch.stack([pixels % width, pixels // width], 1).to(splats.means2d.dtype)
    return cell_to_corner(places) - splats.means2d[gaussians]


def pair_alphas(splats: Projection, gaussians: Tensor, pixels: Tensor, width: int) -> Tensor:
    """Return the alpha (M,) of each pair of Gaussian and pixel; see `pair_offsets`."""
    dx, dy = pair_offsets(splats, gaussians, pixels, width).unbind(1)
    xx, xy, yy = splats.conics[gaussians].unbind(1)
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    return (splats.opacities[gaussians] * torch.exp(-sigma)).clamp(max=ALPHA_MAX)


def rasterize_reference(
    scene: Splats, camera: Pinhole, background: Tensor | None, options: RenderOptions
) -> RenderOutput:
    """Render; see ``grmm.rasterize``."""
    width, height, K, colors = camera.width, camera.height, camera.K, scene.colors
    splats = project(scene, camera, options.antialiased)
    visible = splats.visible.nonzero()[:, 0]
    order = visible[torch.sort(splats.depths[visible].detach(), stable=True).indices]
    channels = torch.cat([colors, splats.normals], 1) if options.normals else colors
    rows = []
    for top in range(0, height, TILE):
        h = min(TILE, height - top)
        tiles = [
            _blend(splats, channels, order, left, top, min(TILE, width - left), h)
            for left in range(0, width, TILE)
        ]
        rows.append([torch.cat(parts, 1) for parts in zip(*tiles, strict=True)])
    image, weighted, alpha, median = (torch.cat(parts, 0) for parts in zip(*rows, strict=True))
    image, normals = image.split([colors.shape[1], image.shape[2] - colors.shape[1]], 2)
    if background is not None:
        image = image + (1.0 - alpha)[..., None] * background
    return RenderOutput(
        colors=image,
        depth=expected_depth(weighted, alpha, K),
        alpha=alpha,
        median_depth=depth_of_rays(median, K) if options.median_depth else None,
        normals=normals if options.normals else None,
    )


def _blend(
    splats: Projection, colors: Tensor, order: Tensor, left: int, top: int, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blend one tile front to back.

    Returns colours (h, w, C), and (h, w) each: ray length * weight, alpha, median ray length.

    Guards as gsplat: alpha capped at 0.99, contributions under 1/255 skipped, and a pixel stops
    before the Gaussian that would bring its transmittance to 1e-4 or less.
    """
    # Only Gaussians that can reach a pixel centre of the tile.
    low = splats.means2d[order].detach() - splats.extents[order]
    high = splats.means2d[order].detach() + splats.extents[order]
    corner, size = low.new_tensor([left, top]), low.new_tensor([width, height])
    ids = order[((high >= corner) & (low <= corner + size)).all(1)]
    dtype, device = colors.dtype, colors.device
    u = cell_to_corner(torch.arange(left, left + width, dtype=dtype, device=device))
    v = cell_to_corner(torch.arange(top, top + height, dtype=dtype, device=device))
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)
    delta = pixels[None] - splats.means2d[ids][:, None]  # (n, P, 2)
    dx, dy = delta.unbind(-1)
    xx, xy, yy = splats.conics[ids][:, :, None].unbind(1)
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    alpha = splats.opacities[ids][:, None] * torch.exp(-sigma.clamp(min=0.0))
    alpha = alpha.clamp(max=ALPHA_MAX)
    alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1.0 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    kept = after > TRANSMITTANCE_MIN
    weights = alpha * before * kept
    length, slope_u, slope_v = splats.planes[ids][:, :, None].unbind(1)
    lengths = length + slope_u * dx + slope_v * dy
    weighted = (weights * lengths).sum(0)
    # At most one Gaussian per pixel takes the transmittance through one half.
    crosses = kept & (before > 0.5) & (after <= 0.5)
    median = torch.where(crosses, lengths, torch.zeros_like(lengths)).sum(0)
    image = weights.T @ colors[ids]
    return (
        image.reshape(height, width, -1),
        weighted.reshape(height, width),
        weights.sum(0).reshape(height, width),
        median.reshape(height, width),
    )
