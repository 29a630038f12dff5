"""The records that the model takes and returns: tracked heads, cameras, Gaussians, renderings."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadState:
    """The tracked head of one frame, in head space: (R, t) belong to the camera (`PinholeView`).

    Attributes:
        vertices: (V, 3) tracked mesh v_rec, metres, eye pose included.
        shape: (S,) identity coefficients alpha_id.
        expression: (X,) expression coefficients alpha_exp.
        neck: (3,) axis-angle.
        jaw: (3,) axis-angle.
    """

    vertices: Tensor
    shape: Tensor
    expression: Tensor
    neck: Tensor
    jaw: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeView:
    """A pinhole camera in canonical head space: pi' = K E [R t] (paper, equation 2).

    Attributes:
        K: (3, 3) pixels, corner origin.
        cam_from_head: (4, 4) rigid, metres, OpenCV axes.
        width: pixels.
        height: pixels.
    """

    K: Tensor
    cam_from_head: Tensor
    width: int
    height: int

    def direction(self) -> Tensor:
        """Return the unit vector (3,) from the head's origin to the camera (G7)."""
        centre = -self.cam_from_head[:3, :3].T @ self.cam_from_head[:3, 3]
        return nn.functional.normalize(centre, dim=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaussians:
    """N Gaussians in head space, without colour.

    Attributes:
        means: (N, 3) metres.
        quats: (N, 4) wxyz.
        scales_mm: (N, 3) unclamped standard deviations, which the regulariser sees.
        opacities: (N,) in (0, 1).
        displacement: (V, 3) metres, what the mesh decoder added.
    """

    means: Tensor
    quats: Tensor
    scales_mm: Tensor
    opacities: Tensor
    displacement: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Maps:
    """The outputs of the transform and opacity decoders for N Gaussians.

    Attributes:
        offsets: (N, 7) raw position and quaternion offsets.
        scales_mm: (N, 3) unclamped standard deviations.
        opacities: (N,) in (0, 1).
    """

    offsets: Tensor
    scales_mm: Tensor
    opacities: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """One rendered view.

    Attributes:
        image: (3, H, W) refined colours I; the same tensor as ``rgb`` without refinement.
        rgb: (3, H, W) rasterised colours I_rgb.
        depth: (H, W) camera z, metres; 0 where alpha is 0.
        alpha: (H, W).
        gaussians: what was drawn.
    """

    image: Tensor
    rgb: Tensor
    depth: Tensor
    alpha: Tensor
    gaussians: Gaussians
