"""Turn codes and tracked parameters into Gaussians on the head's UV map, and into an image.

The steps are separate, so that a caller pays only for what changes: `geometry` once per
identity, expression and pose; `appearance` per view; `draw` rasterises and refines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from express50.geometry.transforms_torch import matrix_to_quat
from express50.head.model import HeadModel
from grmm.anchors import interpolate, make_anchors, tangent_frames, uv_gradients
from grmm.config import SCALE_RANGE_MM, ModelConfig
from grmm.networks import DISPLACEMENT_M, Networks, normalise_depth
from grmm.rasterize import rasterize
from grmm.recorded import Recorded

THICKNESS = 0.3  # of a Gaussian before training, along the normal over the tangents (G2)


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadState:
    """The tracked head of one frame, in head space: (R, t) belong to the camera (`PinholeView`)."""

    vertices: Tensor  # (V, 3) tracked mesh v_rec, metres, eye pose included
    shape: Tensor  # (S,) identity coefficients alpha_id
    expression: Tensor  # (X,) expression coefficients alpha_exp
    neck: Tensor  # (3,) axis-angle
    jaw: Tensor  # (3,) axis-angle


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeView:
    """A pinhole camera in canonical head space: pi' = K E [R t] (paper, equation 2)."""

    K: Tensor  # (3, 3) pixels, corner origin
    cam_from_head: Tensor  # (4, 4) rigid, metres, OpenCV axes
    width: int  # pixels
    height: int  # pixels

    def direction(self) -> Tensor:
        """Return the unit vector (3,) from the head's origin to the camera (G7)."""
        centre = -self.cam_from_head[:3, :3].T @ self.cam_from_head[:3, 3]
        return nn.functional.normalize(centre, dim=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaussians:
    """N Gaussians in head space, without colour."""

    means: Tensor  # (N, 3) metres
    quats: Tensor  # (N, 4) wxyz
    scales_mm: Tensor  # (N, 3) unclamped standard deviations, which the regulariser sees
    opacities: Tensor  # (N,) in (0, 1)
    displacement: Tensor  # (V, 3) metres, what the mesh decoder added


@dataclass(frozen=True, kw_only=True, eq=False)
class Maps:
    """The outputs of the transform and opacity decoders for N Gaussians."""

    offsets: Tensor  # (N, 7) raw position and quaternion offsets
    scales_mm: Tensor  # (N, 3) unclamped standard deviations
    opacities: Tensor  # (N,) in (0, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """One rendered view."""

    image: Tensor  # (3, H, W) refined colours I; the same tensor as ``rgb`` without refinement
    rgb: Tensor  # (3, H, W) rasterised colours I_rgb
    depth: Tensor  # (H, W) camera z, metres; 0 where alpha is 0
    alpha: Tensor  # (H, W)
    gaussians: Gaussians  # what was drawn


class GRMM(Networks):
    """The morphable model: its networks and codes on the UV map of a head."""

    def __init__(
        self,
        config: ModelConfig,
        head: HeadModel,
        subjects: Sequence[str],
        expressions: Sequence[str],
    ) -> None:
        """Build for a head model; subjects and expressions name the rows of the code tables."""
        super().__init__(config, head, len(subjects), len(expressions))
        self.subjects, self.expressions = tuple(subjects), tuple(expressions)
        anchors, gradients = make_anchors(head, config.n_g, config.mouth), uv_gradients(head)
        _, reach = tangent_frames(head.template, head.faces, gradients)
        spacing_mm = 1e3 * reach[anchors.faces] / config.n_g
        # Constants of the head model are rebuilt from it, so checkpoints lack them.
        constants = {
            "texels": anchors.texels,
            "corners": head.faces[anchors.faces],  # (N, 3) vertices of each anchor's face
            "gradients": gradients[anchors.faces],
            "barycentrics": anchors.barycentrics.to(head.dtype),
            "scale_bias": initial_scales(spacing_mm, config),
            # The middle of its box: the mean vertex is in the face, which has most of them.
            "head_centre": (head.template.amin(0) + head.template.amax(0)) / 2,
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def rows(self, subject: str, expression: str) -> tuple[int, int]:
        """Return the rows of a training subject and expression in the code tables."""
        return self.subjects.index(subject), self.expressions.index(expression)

    def codes(self, subject: int, expression: int) -> tuple[Tensor, Tensor]:
        """Return the rows of the code tables: (z_id,) and (z_exp,)."""
        return self.z_id[subject], self.z_exp[expression]

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return all parameters: codes, those of one texel each, decoders, refinement."""
        ladders = (self.transform, self.opacity, self.colour)
        groups = {
            "codes": [self.z_id, self.z_exp],
            "texels": [one for ladder in ladders for one in ladder.texel_parameters()],
            "refinement": [] if self.refinement is None else [*self.refinement.parameters()],
        }
        named = {id(parameter) for group in groups.values() for parameter in group}
        rest = [parameter for parameter in self.parameters() if id(parameter) not in named]
        return groups | {"decoders": rest}

    def forward(
        self,
        subject: int,
        expression: int,
        state: HeadState,
        view: PinholeView,
        background: float = 0.0,
    ) -> Rendering:
        """Render a training subject and expression (indices into the code tables)."""
        return self.render(*self.codes(subject, expression), state, view, background)

    def render(
        self,
        z_id: Tensor,
        z_exp: Tensor,
        state: HeadState,
        view: PinholeView,
        background: float = 0.0,
        shade_view: PinholeView | None = None,
    ) -> Rendering:
        """Render any codes: (z_id,), (z_exp,); colours as ``shade_view`` sees them, if given."""
        gaussians = self.geometry(z_id, z_exp, state)
        colours = self.appearance(z_id, state, view if shade_view is None else shade_view)
        return self.draw(gaussians, colours, view, background)

    def geometry(
        self, z_id: Tensor, z_exp: Tensor, state: HeadState, maps: Maps | None = None
    ) -> Gaussians:
        """Decode everything that does not depend on the view; ``maps`` if they are known."""
        if maps is None:
            return _whole_geometry(z_id, z_exp, *vars(state).values(), module=self)
        z_id, z_exp = self._inputs(z_id, z_exp, state)
        displacement = torch.zeros_like(state.vertices)
        if self.mesh is not None:
            parts = self.mesh(z_id, z_exp, state.neck, state.jaw, state.expression)
            displacement = sum(part.to(state.vertices.dtype) for part in parts)
        vertices, offsets = state.vertices + displacement, maps.offsets
        shift = DISPLACEMENT_M * offsets[:, :3]
        # q = normalise(dq + identity), so that zeros mean no rotation (G1).
        turned = torch.cat([offsets[:, 3:4] + 1.0, offsets[:, 4:7]], 1)
        quats = nn.functional.normalize(turned, dim=1, eps=1e-8)
        if self.config.frame != "head":
            # No gradient passes through the frames: it is ill-conditioned on slivers.
            with torch.no_grad():
                frames, _ = tangent_frames(vertices, self.corners, self.gradients)
                turn = matrix_to_quat(frames)
            shift, quats = (frames * shift[:, None, :]).sum(2), quat_multiply(turn, quats)
        return Gaussians(
            means=interpolate(vertices, self.corners, self.barycentrics) + shift,
            quats=quats,
            scales_mm=maps.scales_mm,
            opacities=maps.opacities,
            displacement=displacement,
        )

    def decode(
        self, z_id: Tensor, z_exp: Tensor, state: HeadState, opacities: Tensor | None = None
    ) -> Maps:
        """Decode the maps of transforms and opacity, which no pose changes.

        Opacity depends on the identity alone, so a caller may pass the ``opacities`` of the same
        person's last maps.
        """
        z_id, z_exp = self._inputs(z_id, z_exp, state)
        offsets = self._sample(self.transform(torch.cat([z_id, z_exp])))
        if opacities is None:
            opacities = torch.sigmoid(self._sample(self.opacity(z_id))[:, 0])
        return Maps(
            offsets=offsets[:, :7],
            scales_mm=nn.functional.softplus(offsets[:, 7:] + self.scale_bias),
            opacities=opacities,
        )

    def appearance(self, z_id: Tensor, state: HeadState, view: PinholeView) -> Tensor:
        """Decode colours in [0, 1] and features, (N, 3 + features), as one view sees them."""
        z_id, _ = self._inputs(z_id, self.z_exp[0], state)
        return _appearance(z_id, view.direction().to(z_id.dtype), module=self)

    def draw(
        self,
        gaussians: Gaussians,
        colours: Tensor,
        view: PinholeView,
        background: float = 0.0,
        refine: bool = True,
    ) -> Rendering:
        """Rasterise and refine; features are rasterised only if the refinement will read them."""
        refinement = self.refinement if refine else None
        if refinement is None:
            colours = colours[:, :3]
        behind = colours.new_zeros(colours.shape[1])
        behind[:3] = background
        out = rasterize(
            gaussians.means,
            gaussians.quats,
            1e-3 * gaussians.scales_mm.clamp(*SCALE_RANGE_MM),
            gaussians.opacities,
            colours,
            view.K,
            view.cam_from_head,
            view.width,
            view.height,
            background=behind,
        )
        rgb = image = out.colors.permute(2, 0, 1)[:3]
        if refinement is not None:
            shown = [out.colors, normalise_depth(out.depth, out.alpha)[..., None]]
            shown += [out.alpha[..., None]] * self.config.refine_alpha
            image = refinement(torch.cat(shown, 2).permute(2, 0, 1))
        return Rendering(
            image=image, rgb=rgb, depth=out.depth, alpha=out.alpha, gaussians=gaussians
        )

    def _inputs(self, z_id: Tensor, z_exp: Tensor, state: HeadState) -> tuple[Tensor, Tensor]:
        """Return the codes, or for the ablation "no residuals" the tracked parameters."""
        if self.config.residual_codes:
            return z_id, z_exp
        return _to_length(state.shape, len(z_id)), _to_length(state.expression, len(z_exp))

    def _sample(self, maps: Tensor) -> Tensor:
        """Sample (C, n_g, n_g) at the covered texels, (N, C)."""
        return maps.flatten(1).index_select(1, self.texels).T.to(self.head_centre.dtype)


@Recorded
def _whole_geometry(model: GRMM, z_id: Tensor, z_exp: Tensor, *parts: Tensor) -> Gaussians:
    """Decode `GRMM.geometry` with its maps; ``parts`` are those of a `HeadState`."""
    names = (field.name for field in fields(HeadState))
    state = HeadState(**dict(zip(names, parts, strict=True)))
    return model.geometry(z_id, z_exp, state, model.decode(z_id, z_exp, state))


@Recorded
def _appearance(model: GRMM, z_id: Tensor, direction: Tensor) -> Tensor:
    maps = model._sample(model.colour(z_id, direction))
    return torch.cat([torch.sigmoid(maps[:, :3]), maps[:, 3:]], 1)


def initial_scales(spacing_mm: Tensor, config: ModelConfig) -> Tensor:
    """Compute inputs of softplus (N, 3) whose scales match texel spacings (N, 2), mm.

    ``tangent``: along tangent, bitangent and, thinner, the normal; ``head``: the same on all axes.
    """
    low, high = SCALE_RANGE_MM
    along = (config.scale_init * spacing_mm).clamp(1.05 * low, 0.95 * high)
    if config.frame == "tangent":
        thickness = THICKNESS * along.amin(1, keepdim=True)
        scales = torch.cat([along, thickness.clamp_min(1.05 * low)], 1)
    else:
        scales = along.prod(1, keepdim=True).sqrt().expand(-1, 3)
    return scales + torch.log(-torch.expm1(-scales))  # the inverse of softplus


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Multiply quaternions (..., 4), wxyz: first b, then a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def _to_length(values: Tensor, length: int) -> Tensor:
    return nn.functional.pad(values[:length], (0, max(0, length - len(values))))
