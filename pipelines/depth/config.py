"""Define the settings of the depth stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass

from express50.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class DepthConfig:
    """The fineness of the surface, and the evidence that counts."""

    voxel_mm: float = 1.6
    """Finest voxel of the last level, millimetres, 0.3 to 20."""
    voxel_px: float = 1.4
    """The last level's voxel spans at least this many pixels: finer ones would hold guesses."""
    image_side: int = 1024
    """Longest side, pixels, of the images that silhouettes and photo-consistency use."""
    noise: float = 0.8
    """Texture under this standard deviation (8-bit steps, after blurring) does not count."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name, low, high in (
            ("voxel_mm", 0.3, 20),
            ("voxel_px", 0, 8),
            ("image_side", 16, 32768),
            ("noise", 1e-6, 255),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"depth.{name} is {value}, expected {low:g} to {high:g}")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"voxel_mm": 4.0, "image_side": 512},
    "reference": {"voxel_mm": 1.0, "image_side": 2048},
}
