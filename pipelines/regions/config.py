"""Settings of the regions stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from express50.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class RegionsConfig:
    """What labels are made from, and how finely; lengths in millimetres."""

    segmentation: str = ""
    """File of Sapiens' body-part weights, TorchScript; its labels go before the mesh's."""
    device: Literal["auto", "cuda"] = "auto"
    """Where the network runs: on CUDA where there is one, or only where there is one."""
    image_side: int = 1536
    """Longest side, pixels, that the mesh is seen at; larger frames get enlarged labels."""
    depth: bool = True
    """Let depth maps, where there are any, tell how high over the neck's end a pixel is."""
    colour: bool = True
    """Let each view's own colours tell hair, skin and torso where geometry is not sure."""
    rim_mm: float = 5.0
    """What juts out this far beyond the mesh still is what the mesh shows there."""
    scalp: Literal["auto", "hair", "skin"] = "auto"
    """What the mesh's scalp shows; auto: skin where its colours are those of the face."""
    agreement: float = 0.85
    """A camera with less of the tracked mesh inside its matte is warned of, 0 to 1."""
    qc_views: int = 4
    """Cameras in the quality picture."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.image_side < 16:
            raise ConfigError(f"regions.image_side is {self.image_side}, expected 16 or more")
        if self.rim_mm < 0:
            raise ConfigError(f"regions.rim_mm is {self.rim_mm}, expected 0 or more")
        if not 0 <= self.agreement <= 1 or self.qc_views < 1:
            raise ConfigError(
                f"regions.agreement {self.agreement} and regions.qc_views {self.qc_views}:"
                " expected 0 to 1, and 1 or more"
            )


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"image_side": 512, "depth": False},
    "standard": {},
    "reference": {"image_side": 4096},
}
