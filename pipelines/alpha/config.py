"""Settings of the alpha stage and its presets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from express50.errors import ConfigError

NETWORKS = ("bgmv2", "salient")
WITHOUT_PLATE = ("grabcut", "salient")


@dataclass(frozen=True, kw_only=True)
class AlphaConfig:
    """Lengths are shares of the image's longer side, differences are in noise deviations."""

    method: Literal["key", "grabcut", "bgmv2", "salient"] = "key"
    """Key against the plate, by colours about the face, or by BackgroundMattingV2 or BiRefNet."""
    weights: str = ""
    """File of the network's weights, TorchScript or ONNX; from a known origin, it is a program."""
    device: Literal["auto", "cuda"] = "auto"
    """Where the network runs: on CUDA where there is one, or only where there is one."""
    tile: int = 2048
    """Longest side, pixels, that bgmv2 sees at once; larger frames are cut up."""
    scale: float = 1.0
    """Key at this share of the resolution; below 1 the matte is enlarged afterwards."""
    low: float = 1.2
    """Differences of this size are as likely noise as subject; alpha is 0 below."""
    high: float = 6.0
    """Difference that proves foreground; weaker pixels must touch such ones."""
    light: Literal["linear", "display"] = "linear"
    """What mixes at soft edges: linear light, as in cameras, or sRGB values, as in composites."""
    spread: float = 0.2
    """Share by which hair may be brighter or darker than what is seen of it nearby."""
    firm: float = 0.5
    """A difference of this share of the local foreground's own may belong to the solid inside."""
    core: float = 0.018
    """Radius of the disc that must fit inside a part of the subject for it to be solid."""
    fill: float = 0.012
    """Plate-coloured spots and gaps in the solid subject are filled this far from its edge."""
    shadow: float = 0.25
    """Broad darkening of the plate up to this share is taken for a shadow; 0 turns it off."""
    smooth: bool = False
    """Smooth alpha along colours in the uncertain band (1.5 times the time; 5 at 4K)."""
    noise_frames: int = 4
    """Frames that the camera's noise is measured on."""
    noise_floor: float = 1.0
    """Least noise assumed, in 8-bit steps."""

    def __post_init__(self) -> None:
        """Refuse values that key nothing or everything."""
        if not 0.1 <= self.scale <= 1.0:
            raise ConfigError(f"alpha.scale is {self.scale}, expected 0.1 to 1")
        if not 0 < self.low < self.high:
            raise ConfigError(
                f"alpha.low {self.low} and alpha.high {self.high}: expected 0 < low < high"
            )
        if not 0.0 <= self.spread <= 1.0 or not 0.0 <= self.shadow < 1.0:
            raise ConfigError(
                f"alpha.spread {self.spread}, alpha.shadow {self.shadow}: expected 0 to 1, below 1"
            )
        if self.noise_frames < 1:
            raise ConfigError(f"alpha.noise_frames is {self.noise_frames}, expected 1 or more")
        for name in ("firm", "core", "fill", "noise_floor"):
            if not (math.isfinite(value := getattr(self, name)) and value >= 0):
                raise ConfigError(f"alpha.{name} is {value}, expected a number of 0 or more")
        self._check_networks()

    def _check_networks(self) -> None:
        if (self.method in NETWORKS) != bool(self.weights):
            raise ConfigError(
                f"alpha.method {self.method!r} with alpha.weights {self.weights!r}: key and grabcut"
                " take none, bgmv2 and salient need the file of the network's weights"
            )
        if self.tile < 512 or self.tile % 64:
            raise ConfigError(f"alpha.tile is {self.tile}, expected a multiple of 64, 512 or more")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"scale": 0.5, "noise_frames": 1},
    "standard": {},
    "reference": {"smooth": True, "noise_frames": 12},
}
