"""Define GRMM's networks and code tables: everything whose weights a checkpoint holds.

Widths and starting values that the paper leaves open are explained in docs/GRMM.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain, pairwise

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from express50.head.model import HeadModel
from grmm.config import ModelConfig

SLOPE = 0.2  # of every leaky ReLU, as RGCA's
DISPLACEMENT_M = 1e-2  # per unit of network output: displacements are centimetres (G5, G8)
VIEW_CHANNELS = 8  # channels of the view direction before it joins the seed (RGCA; G7)
FEATURE_STD = 0.3  # of features before training
CODE_STD = 0.01  # of codes before training (DeepSDF; G13)
EMPTY_RANGE_M = 1e-6  # a depth range thinner than a micrometre carries no shape


class Networks(nn.Module):
    """The decoders, the refinement, and one code per training subject and expression."""

    def __init__(
        self, config: ModelConfig, head: HeadModel, subjects: int, expressions: int
    ) -> None:
        """Build for a head model and the number of rows of the code tables."""
        super().__init__()
        self.config = config
        self.z_id = nn.Parameter(CODE_STD * torch.randn(subjects, config.z_id))
        self.z_exp = nn.Parameter(CODE_STD * torch.randn(expressions, config.z_exp))
        self.mesh = None
        if config.mesh_decoder:
            self.mesh = MeshDecoder(config, len(head.expression_names), head.regions["teeth"])
        self.transform = Ladder(config, config.z_id + config.z_exp, 10)
        self.opacity = Ladder(config, config.z_id, 1)
        self.colour = Ladder(
            config, config.z_id, 3 + config.features, view_dependent=True, mode_outputs=3
        )
        with torch.no_grad():
            self.opacity.bias.fill_(math.log(config.opacity_init / (1 - config.opacity_init)))
            # From all zeros the refinement could not distinguish texels and would learn slowly.
            self.colour.bias[3:].normal_(0, FEATURE_STD)
        self.refinement = None
        if config.refine_widths:
            inputs = 3 + config.features + 1 + config.refine_alpha  # colours, features, depth
            self.refinement = Refinement(inputs, config.refine_widths, config.refine_unshuffle)


class Doubling(nn.Module):
    """Transposed convolution 4 x 4, stride 2, with weight norm and an untied bias."""

    def __init__(self, inputs: int, outputs: int, side: int) -> None:
        """Map (inputs, side, side) to (outputs, 2 side, 2 side)."""
        super().__init__()
        convolution = nn.ConvTranspose2d(inputs, outputs, 4, 2, 1, bias=False)
        # Glorot with the slope's gain; at stride 2 an output sees 2 x 2 of the 4 x 4 taps.
        gain = math.sqrt(2 / (1 + SLOPE**2))
        bound = gain * math.sqrt(3 / (4 * 0.5 * (inputs + outputs)))
        nn.init.uniform_(convolution.weight, -bound, bound)
        self.convolution = weight_norm(convolution, dim=1)
        self.bias = nn.Parameter(torch.zeros(outputs, 2 * side, 2 * side))

    def forward(self, x: Tensor) -> Tensor:
        """Map (1, inputs, side, side) to (1, outputs, 2 side, 2 side)."""
        return nn.functional.leaky_relu(self.convolution(x) + self.bias, SLOPE)


class Ladder(nn.Module):
    """Decode a code to (outputs, n_g, n_g), which starts as ``bias``.

    The last layer is a transposed convolution without weight norm (which cannot be zero) whose
    weights start at zero. ``modes`` (modes, mode_outputs, n_g, n_g) adds a linear, per-texel
    dependence of the first outputs on the first entries of the code; see
    ModelConfig.identity_modes.
    """

    def __init__(
        self,
        config: ModelConfig,
        code: int,
        outputs: int,
        view_dependent: bool = False,
        mode_outputs: int | None = None,
    ) -> None:
        """Build for codes of this length.

        The seed of a view-dependent ladder also carries a lifted view direction (RGCA). The first
        ``mode_outputs`` outputs have modes; by default all have.
        """
        super().__init__()
        n_g, widths = config.n_g, config.ladder
        side = n_g // 2 ** (len(widths) + 1)
        self.seed_shape = (1, config.seed_channels, side, side)
        self.seed = nn.Linear(code, config.seed_channels * side * side)
        self.view = nn.Linear(3, VIEW_CHANNELS) if view_dependent else None
        channels = [config.seed_channels + VIEW_CHANNELS * view_dependent, *widths]
        self.doublings = nn.ModuleList(
            Doubling(a, b, side * 2**i) for i, (a, b) in enumerate(pairwise(channels))
        )
        self.last = nn.ConvTranspose2d(channels[-1], outputs, 4, 2, 1, bias=False)
        nn.init.zeros_(self.last.weight)
        self.bias = nn.Parameter(torch.zeros(outputs, n_g, n_g))
        self.modes = None
        if config.identity_modes:
            shape = (config.identity_modes, mode_outputs or outputs, n_g, n_g)
            self.modes = nn.Parameter(torch.zeros(shape))

    def forward(self, code: Tensor, direction: Tensor | None = None) -> Tensor:
        """Decode (code,) and, if used, a (3,) unit view direction to (outputs, n_g, n_g)."""
        x = nn.functional.leaky_relu(self.seed(code), SLOPE).view(self.seed_shape)
        if self.view is not None:
            lifted = nn.functional.leaky_relu(self.view(direction), SLOPE)
            tiled = lifted[None, :, None, None].expand(-1, -1, *self.seed_shape[2:])
            x = torch.cat([x, tiled], 1)
        x = x.contiguous(memory_format=torch.channels_last)
        for doubling in self.doublings:
            x = doubling(x)
        out = self.last(x)[0] + self.bias
        if self.modes is not None:
            change = torch.tensordot(code[: len(self.modes)], self.modes, 1)
            out = torch.cat([out[: len(change)] + change, out[len(change) :]])
        return out

    def texel_parameters(self) -> list[nn.Parameter]:
        """Return the parameters of the last layer that belong to one texel each."""
        return [self.bias] if self.modes is None else [self.bias, self.modes]


class MeshDecoder(nn.Module):
    """Decode residual vertex displacements of identity and expression (paper: Mesh Decoder).

    f_base = MLP_shared([z_id, neck, jaw]); identity displacements come from it alone. The
    expression's come from [f_base, z_exp] modulated by FiLM with the tracked coefficients, and
    skip the teeth (M_face). The last layers start at zero: no displacement, FiLM the identity.
    """

    def __init__(self, config: ModelConfig, coefficients: int, teeth: Tensor) -> None:
        """Build for a mesh whose teeth are marked in ``teeth`` (V,) bool; metres come out."""
        super().__init__()
        widths = [config.z_id + 6, *config.shared_widths]
        layers = ((nn.Linear(a, b), nn.LeakyReLU(SLOPE)) for a, b in pairwise(widths))
        self.shared = nn.Sequential(*chain.from_iterable(layers))
        base, both, outputs = widths[-1], widths[-1] + config.z_exp, 3 * len(teeth)
        self.film = _zero_last_mlp(coefficients, config.film_width, 2 * both)
        self.identity = _zero_last_mlp(base, config.mesh_width, outputs)
        self.expression = _zero_last_mlp(both, config.mesh_width, outputs)
        self.register_buffer("face_mask", (~teeth).to(torch.get_default_dtype())[:, None])

    def forward(
        self, z_id: Tensor, z_exp: Tensor, neck: Tensor, jaw: Tensor, coefficients: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return identity and masked expression displacements, each (V, 3) metres.

        Inputs are both codes, the axis-angles (3,) of neck and jaw, and the tracked expression
        coefficients (X,).
        """
        base = self.shared(torch.cat([z_id, neck, jaw]))
        feature = self.modulate(torch.cat([base, z_exp]), coefficients)
        identity = self.identity(base).view(-1, 3) * DISPLACEMENT_M
        expression = self.expression(feature).view(-1, 3) * DISPLACEMENT_M
        return identity, self.face_mask * expression

    def modulate(self, feature: Tensor, coefficients: Tensor) -> Tensor:
        """Modulate by FiLM in its residual form, f + gamma * f + beta (Perez et al. 2018)."""
        gamma, beta = self.film(coefficients).chunk(2)
        return feature + gamma * feature + beta


def _zero_last_mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Build a perceptron with one hidden layer that starts as the constant 0."""
    hidden, last = nn.Linear(inputs, width), nn.Linear(width, outputs)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(hidden, nn.LeakyReLU(SLOPE), last)


class Refinement(nn.Module):
    """I = I_rgb + U-Net([I_rgb, features, normalised depth]), with alpha too if so configured.

    The paper names inputs and purpose only; G9 has the rest. ``unshuffle`` folds r x r pixels into
    channels first, which a CPU needs. Sides that are not a multiple of the stride are padded.
    """

    def __init__(self, inputs: int, widths: Sequence[int], unshuffle: int) -> None:
        """Build for ``inputs`` channels, of which the first three are the colours refined."""
        super().__init__()
        self.unshuffle = unshuffle
        self.stride = unshuffle * 2 ** (len(widths) - 1)
        folded = inputs * unshuffle**2
        self.enter = _block(folded, widths[0])
        self.down = nn.ModuleList(_block(a, b, stride=2) for a, b in pairwise(widths))
        self.up = nn.ModuleList(_block(a + b, a) for a, b in reversed(list(pairwise(widths))))
        self.head = nn.Conv2d(widths[0], 3 * unshuffle**2, 3, padding=1)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                # Without norms torch's default would shrink activations thousandfold on the way.
                nn.init.kaiming_normal_(layer.weight, a=SLOPE)
                nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.head.weight)
        # The images' layout; with another one, reordering weights takes a fifth of each call.
        self.to(memory_format=torch.channels_last)

    def forward(self, maps: Tensor) -> Tensor:
        """Refine (inputs, H, W) to colours (3, H, W)."""
        height, width = maps.shape[1:]
        right, below = -width % self.stride, -height % self.stride
        x = maps[None]
        if right or below:  # otherwise padding and folding would only copy the images
            x = nn.functional.pad(x, (0, right, 0, below))
        if self.unshuffle > 1:
            x = nn.functional.pixel_unshuffle(x, self.unshuffle)
        x = x.contiguous(memory_format=torch.channels_last)
        levels = [self.enter(x)]
        for block in self.down:
            levels.append(block(levels[-1]))
        x = levels.pop()
        for block in self.up:
            skip = levels.pop()
            x = nn.functional.interpolate(x, size=skip.shape[2:], mode="nearest")
            x = block(torch.cat([skip, x], 1))
        residual = nn.functional.pixel_shuffle(self.head(x), self.unshuffle)
        return maps[:3] + residual[0, :, :height, :width].to(maps.dtype)


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1),
        nn.LeakyReLU(SLOPE),
        nn.Conv2d(outputs, outputs, 3, padding=1),
        nn.LeakyReLU(SLOPE),
    )


def normalise_depth(depth: Tensor, alpha: Tensor) -> Tensor:
    """Stretch the depth (H, W) of covered pixels to [0, 1]; 0 where alpha <= 0.5.

    The limits are detached (G10). A constant or empty depth map gives zeros, not 0 / 0.
    """
    mask = (alpha > 0.5) & torch.isfinite(depth)
    known = torch.where(mask, depth, 0.0)
    inner, most = known.detach(), torch.finfo(depth.dtype).max
    low = torch.where(mask, inner, most).min()  # no branch: it would wait for the GPU
    extent = torch.where(mask, inner, -most).max() - low
    scaled = (known - low) / extent.clamp_min(EMPTY_RANGE_M)
    return torch.where(mask, scaled.clamp(0, 1), 0.0)
