"""The networks of GRMM and its tables of codes: all of a model that a checkpoint holds."""

from __future__ import annotations

import torch
from torch import nn

from express50.head.model import HeadModel
from grmm.config import ModelConfig
from grmm.decoders import Ladder
from grmm.mesh_decoder import MeshDecoder
from grmm.refine import Refinement

FEATURE_STD = 0.3  # of features before training; silent in the paper
CODE_STD = 0.01  # of codes before training; silent in the paper, DeepSDF's habit (survey point 13)


class Networks(nn.Module):
    """Decoders, refinement, and tables of codes of the training set."""

    def __init__(
        self, config: ModelConfig, head: HeadModel, subjects: int, expressions: int
    ) -> None:
        """Build for a head model and so many rows of the code tables."""
        super().__init__()
        self.config = config
        self.z_id = nn.Parameter(CODE_STD * torch.randn(subjects, config.z_id))
        self.z_exp = nn.Parameter(CODE_STD * torch.randn(expressions, config.z_exp))
        self.mesh = None
        if config.mesh_decoder:
            self.mesh = MeshDecoder(
                z_id=config.z_id,
                z_exp=config.z_exp,
                coefficients=len(head.expression_names),
                teeth=head.regions["teeth"],
                shared_widths=config.shared_widths,
                film_width=config.film_width,
                head_width=config.mesh_width,
                displacement_scale=config.displacement_scale,
            )
        both = config.z_id + config.z_exp
        self.transform = self._ladder(both, 10)
        self.opacity = self._ladder(both if config.opacity_from_expression else config.z_id, 1)
        self.colour = self._ladder(config.z_id, 3 + config.features, config.view_channels, 3)
        with torch.no_grad():
            self.opacity.bias.fill_(_logit(config.opacity_init))
            # Features tell texels apart to the refinement: from all zeros it learns slowly.
            self.colour.bias[3:].normal_(0, FEATURE_STD)
        self.refinement = None
        if config.refine_widths:
            self.refinement = Refinement(
                inputs=3 + config.features + 1 + config.refine_alpha,
                widths=config.refine_widths,
                unshuffle=config.refine_unshuffle,
            )

    def _ladder(
        self, code: int, outputs: int, view_channels: int = 0, mode_outputs: int | None = None
    ) -> Ladder:
        return Ladder(
            code=code,
            outputs=outputs,
            n_g=self.config.n_g,
            seed_channels=self.config.seed_channels,
            widths=self.config.ladder,
            modes=self.config.identity_modes,
            mode_outputs=mode_outputs,
            view_channels=view_channels,
        )


def _logit(probability: float) -> float:
    return float(torch.logit(torch.tensor(probability, dtype=torch.float64)))
