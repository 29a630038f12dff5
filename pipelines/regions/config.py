"""Define the settings of the regions stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from express50.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class RegionsConfig:
    """The sources of the labels, and their size."""

    segmentation: str = ""
    """File of Sapiens' body-part weights, TorchScript; its labels replace those of the mesh."""
    device: Literal["auto", "cuda"] = "auto"
    """Run the network on CUDA if there is a GPU, or refuse to run without one."""
    image_side: int = 1536
    """Longest side, pixels, at which views are labelled; larger frames get enlarged labels."""
    depth: bool = True
    """Use depth maps, where there are any, to place pixels above or below the neck's end."""
    scalp: Literal["auto", "hair", "skin"] = "auto"
    """Label of the mesh's scalp; auto: skin where its colours are those of the face."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.image_side < 16:
            raise ConfigError(f"regions.image_side is {self.image_side}, expected 16 or more")
