"""Settings of the matte stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass

from express50.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class MatteConfig:
    """Lengths are shares of the image's longer side, differences are in noise deviations."""

    scale: float = 1.0
    """Key at this share of the resolution; below 1 the matte is enlarged afterwards."""
    low: float = 1.2
    """Difference from the plate up to which a pixel counts as plate."""
    high: float = 6.0
    """Difference that proves foreground; weaker pixels must touch such ones."""
    full: float = 0.92
    """A difference of this share of the local foreground's own counts as alpha 1."""
    firm: float = 0.5
    """A difference of this share of the local foreground's own may belong to the solid inside."""
    core: float = 0.018
    """Radius of the disc that must fit inside a part of the subject for it to be solid."""
    fill: float = 0.012
    """Plate-coloured spots inside the solid subject are filled where this far from its edge."""
    shadow: float = 0.25
    """Broad darkening of the plate up to this share is taken for a shadow; 0 turns it off."""
    smooth: bool = False
    """Smooth alpha along colours in the uncertain band (1.5 times the time; 5 at 4K)."""
    noise_frames: int = 4
    """Frames that the camera's noise is measured on."""
    noise_floor: float = 1.0
    """Least noise assumed, in 8-bit steps."""
    plate_frames: int = 31
    """Frames whose median stands in for a missing plate."""

    def __post_init__(self) -> None:
        """Refuse values that key nothing or everything."""
        if not 0.1 <= self.scale <= 1.0:
            raise ConfigError(f"matte.scale is {self.scale}, expected 0.1 to 1")
        if not 0 < self.low < self.high:
            raise ConfigError(
                f"matte.low {self.low} and matte.high {self.high}: expected 0 < low < high"
            )
        if not 0.1 <= self.full <= 1.0 or not 0.0 <= self.shadow < 1.0:
            raise ConfigError(
                f"matte.full {self.full}, matte.shadow {self.shadow}: expected 0.1 to 1, 0 to 1"
            )


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"scale": 0.5, "noise_frames": 1, "plate_frames": 15},
    "standard": {},
    "reference": {"smooth": True, "noise_frames": 12, "plate_frames": 61},
}
