"""The mesh decoder: residual vertex displacements from identity, pose and expression."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

SLOPE = 0.2  # of every leaky ReLU, as RGCA's


class MeshDecoder(nn.Module):
    """Identity and expression displacements of vertices (paper: Method, Mesh Decoder).

    f_base = MLP_shared([z_id, neck, jaw]); identity displacements come from it alone. The
    expression's come from [f_base, z_exp] modulated by FiLM with the tracked coefficients, and
    skip the teeth (M_face). The last layers start at zero: no displacement, FiLM the identity.
    """

    def __init__(
        self,
        *,
        z_id: int,
        z_exp: int,
        coefficients: int,
        teeth: Tensor,
        shared_widths: Sequence[int],
        film_width: int,
        head_width: int,
        displacement_scale: float,
    ) -> None:
        """Build for a mesh whose teeth are marked in ``teeth`` (V,) bool; metres come out."""
        super().__init__()
        widths = [z_id + 6, *shared_widths]
        self.shared = nn.Sequential(
            *(
                layer
                for a, b in zip(widths, widths[1:], strict=False)
                for layer in (nn.Linear(a, b), nn.LeakyReLU(SLOPE))
            )
        )
        base = widths[-1]
        self.film = zero_last(mlp(coefficients, film_width, 2 * (base + z_exp)))
        self.identity = zero_last(mlp(base, head_width, 3 * len(teeth)))
        self.expression = zero_last(mlp(base + z_exp, head_width, 3 * len(teeth)))
        self.displacement_scale = displacement_scale
        self.register_buffer("face_mask", (~teeth).to(torch.get_default_dtype())[:, None])

    def forward(
        self, z_id: Tensor, z_exp: Tensor, neck: Tensor, jaw: Tensor, coefficients: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return identity and masked expression displacements, each (V, 3) metres.

        Args:
            z_id: (Z,) identity code.
            z_exp: (E,) expression code.
            neck: (3,) axis-angle.
            jaw: (3,) axis-angle.
            coefficients: (X,) tracked expression coefficients.
        """
        base = self.shared(torch.cat([z_id, neck, jaw]))
        feature = self.modulate(torch.cat([base, z_exp]), coefficients)
        identity = self.identity(base).view(-1, 3) * self.displacement_scale
        expression = self.expression(feature).view(-1, 3) * self.displacement_scale
        return identity, self.face_mask * expression

    def modulate(self, feature: Tensor, coefficients: Tensor) -> Tensor:
        """FiLM: f + gamma * f + beta (Perez et al. 2018, residual form of the paper)."""
        gamma, beta = self.film(coefficients).chunk(2)
        return feature + gamma * feature + beta


def mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """One hidden layer with a leaky ReLU."""
    return nn.Sequential(nn.Linear(inputs, width), nn.LeakyReLU(SLOPE), nn.Linear(width, outputs))


def zero_last(network: nn.Sequential) -> nn.Sequential:
    """Zero the last layer, so that the network starts as the constant 0."""
    last = network[-1]
    assert isinstance(last, nn.Linear)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return network
