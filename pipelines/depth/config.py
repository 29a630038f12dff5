"""Define the settings of the depth stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from express50.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class DepthConfig:
    """How finely the surface is modelled, what it starts from, and what is written."""

    voxel_mm: float = 1.6
    """Finest voxel of the last level, millimetres, 0.3 to 20."""
    voxel_px: float = 1.4
    """The last level's voxel spans at least this many pixels: finer ones would hold guesses."""
    image_side: int = 1024
    """Longest side, pixels, of the images that silhouettes and photo-consistency use."""
    noise: float = 0.8
    """Texture under this standard deviation (8-bit steps, after blurring) does not count."""
    use_track: bool = True
    """Start from the tracked mesh where it agrees with the mattes."""
    track_agreement: float = 0.85
    """Share of the tracked mesh's pixels that must lie in the mattes for it to be used."""
    min_views: int = 2
    """Fewest usable cameras; at least 2."""
    depth_format: Literal["png16", "exr16", "exr32"] = "png16"
    """Depth maps on disk: 16-bit PNG (0.05 mm steps to 3.27 m), half-float or float EXR."""
    normal_maps: Literal["png8", "png16", "none"] = "png8"
    """Normal maps on disk, camera axes: 8 or 16 bits per component, or none."""
    glb: bool = True
    """Write the mesh as surface.glb too, for viewers; surface.ply is always written."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name, low, high in (
            ("voxel_mm", 0.3, 20),
            ("voxel_px", 0, 8),
            ("image_side", 16, 32768),
            ("noise", 1e-6, 255),
            ("track_agreement", 0, 1),
            ("min_views", 2, 10_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"depth.{name} is {value}, expected {low:g} to {high:g}")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"voxel_mm": 4.0, "image_side": 512},
    "reference": {"voxel_mm": 1.0, "image_side": 2048},
}
