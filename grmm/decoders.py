"""Convolutional decoders from a code to a UV map of Gaussian attributes.

The paper follows RGCA (Saito et al. 2024) and ASH without giving widths; the survey's point 6
gives RGCA's: a linear layer to an 8 x 8 seed, transposed convolutions that double the map, weight
norm, an untied (per-texel) bias after each, leaky ReLU of slope 0.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

SLOPE = 0.2


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
        """(1, inputs, side, side) -> (1, outputs, 2 side, 2 side)."""
        return nn.functional.leaky_relu(self.convolution(x) + self.bias, SLOPE)


class Ladder(nn.Module):
    """Code -> (outputs, n_g, n_g), zero at the start but for what is written into ``bias``.

    The last layer is a transposed convolution without weight norm (which cannot be zero) whose
    weights start at zero. ``modes`` (modes, mode_outputs, n_g, n_g) adds a linear, per-texel
    dependence of the first outputs on the first entries of the code; see
    ModelConfig.identity_modes.
    """

    def __init__(
        self,
        *,
        code: int,
        outputs: int,
        n_g: int,
        seed_channels: int,
        widths: Sequence[int],
        modes: int = 0,
        mode_outputs: int | None = None,
        view_channels: int = 0,
    ) -> None:
        """Build; with ``view_channels`` the seed also carries a lifted view direction (RGCA)."""
        super().__init__()
        side = n_g // 2 ** (len(widths) + 1)
        self.seed_shape = (1, seed_channels, side, side)
        self.seed = nn.Linear(code, seed_channels * side * side)
        self.view = nn.Linear(3, view_channels) if view_channels else None
        channels = [seed_channels + view_channels, *widths]
        self.doublings = nn.ModuleList(
            Doubling(a, b, side * 2**i)
            for i, (a, b) in enumerate(zip(channels, channels[1:], strict=False))
        )
        self.last = nn.ConvTranspose2d(channels[-1], outputs, 4, 2, 1, bias=False)
        nn.init.zeros_(self.last.weight)
        self.bias = nn.Parameter(torch.zeros(outputs, n_g, n_g))
        self.modes = None
        if modes:
            shape = (modes, outputs if mode_outputs is None else mode_outputs, n_g, n_g)
            self.modes = nn.Parameter(torch.zeros(shape))

    def forward(self, code: Tensor, direction: Tensor | None = None) -> Tensor:
        """(code,), and (3,) unit view direction if built for one -> (outputs, n_g, n_g)."""
        x = nn.functional.leaky_relu(self.seed(code), SLOPE).view(self.seed_shape)
        if self.view is not None:
            if direction is None:
                raise ValueError("direction is missing: this decoder depends on the view")
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
        """Parameters of the last layer that belong to one texel each."""
        return [self.bias] if self.modes is None else [self.bias, self.modes]
