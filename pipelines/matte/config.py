"""Define the settings of the matte stage."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from express50.contract.config import check_ranges
from express50.errors import ConfigError

NETWORKS = ("bgmv2", "salient")
WITHOUT_PLATE = ("grabcut", "salient")


@dataclass(frozen=True, kw_only=True)
class MatteConfig:
    """Set how each camera is matted, and whether the cameras of a peak correct each other."""

    method: Literal["key", "grabcut", "bgmv2", "salient"] = "key"
    """key: compare with the plate; cameras without one are cut out by colours and by what the
    other cameras see. grabcut: cut out all cameras that way. bgmv2, salient: run a network."""
    weights: str = ""
    """File of the network's weights, TorchScript or ONNX; such a file is a program, so use only
    those you trust."""
    device: Literal["auto", "cuda"] = "auto"
    """Run the network on CUDA if available (auto), or only on CUDA."""
    tile: int = 2048
    """Longest side, pixels, of a tile that bgmv2 sees; larger frames are cut into tiles."""
    shadow: float = 0.25
    """Broad darkening of the plate by up to this share is a shadow; 0 turns this off."""
    agree: bool = True
    """Let the cameras correct each other; false keeps every camera's own matte."""

    def __post_init__(self) -> None:
        """Refuse values that matte nothing or everything."""
        check_ranges("matte", self, shadow=(0, 0.99), tile=(512, math.inf))
        if (self.method in NETWORKS) != bool(self.weights):
            raise ConfigError(
                f"matte.method {self.method!r} with matte.weights {self.weights!r}: key and grabcut"
                " take no weights; bgmv2 and salient need the network's weights file"
            )
        if self.tile % 64:
            raise ConfigError(f"matte.tile is {self.tile}, expected a multiple of 64")
