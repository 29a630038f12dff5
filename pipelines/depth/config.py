"""Configuration of the depth stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass

from express50.dataset.depth_files import DEPTH_ENDINGS, NORMAL_STEPS


@dataclass(frozen=True, kw_only=True)
class DepthConfig:
    """How finely the surface is modelled, and how much the photographs may bend it."""

    voxel_mm: float = 1.6
    """Finest voxel of the last level, millimetres, 0.3 to 20."""
    voxel_px: float = 1.4
    """The last level's voxel is no smaller than so many pixels: finer ones would hold guesses."""
    coarse_mm: float = 6.0
    """Voxel of the first level, millimetres; each level is 1.47 times finer than the one before."""
    image_side: int = 1024
    """Longest side, pixels, of the images that silhouettes and photo-consistency use."""
    photo: bool = True
    """Move the surface by photo-consistency; False leaves the smoothed hull at its silhouettes."""
    use_track: bool = True
    """Start from the tracked mesh where it agrees with the mattes."""
    track_agreement: float = 0.85
    """Share of the tracked mesh's pixels that must lie in the mattes for it to be used."""
    inward_mm: float = 30.0
    """How far below the hull the first level searches, millimetres."""
    patch_samples: int = 5
    """Samples along a patch's side, odd."""
    noise: float = 0.8
    """Texture under this standard deviation (8-bit steps, after blurring) counts as none."""
    stiffness_voxels: float = 2.2
    """Length, in voxels, under which displacements are smoothed as by a thin plate."""
    rim_weight: float = 1.0
    """Weight of the silhouettes against a perfect photographic match."""
    fair_voxels: float = 1.4
    """Gaussian smoothing of the distances before each level, in voxels."""
    min_views: int = 2
    """Fewest usable cameras; at least 2."""
    depth_format: str = "png16"
    """Depth maps on disk: "png16" (0.05 mm steps to 3.27 m), "exr16" (half float), "exr32"."""
    normal_maps: str = "png8"
    """Normal maps on disk, camera axes: "png8", "png16" (8 or 16 bits a component), or "none"."""
    glb: bool = True
    """Write the mesh as surface.glb too, for viewers; surface.ply is always written."""
    consistency_side: int = 512
    """Longest side, pixels, at which views are compared through the depth, for the metrics."""
    qc_views: int = 4
    """Cameras in the quality picture."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 0.3 <= self.voxel_mm <= 20:
            raise ValueError(f"voxel_mm is {self.voxel_mm}, expected 0.3 to 20")
        if not 0 < self.fair_voxels <= 2:
            raise ValueError(f"fair_voxels is {self.fair_voxels}, expected over 0, at most 2")
        if not 0 <= self.inward_mm <= 100:
            raise ValueError(f"inward_mm is {self.inward_mm}, expected 0 to 100")
        if not 1 <= self.coarse_mm <= 40:
            raise ValueError(f"coarse_mm is {self.coarse_mm}, expected 1 to 40")
        if not 0 <= self.voxel_px <= 8:
            raise ValueError(f"voxel_px is {self.voxel_px}, expected 0 to 8")
        if self.patch_samples < 3 or self.patch_samples % 2 == 0:
            raise ValueError(f"patch_samples is {self.patch_samples}, expected an odd number >= 3")
        for name, known in (
            ("depth_format", DEPTH_ENDINGS),
            ("normal_maps", (*NORMAL_STEPS, "none")),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} is {getattr(self, name)!r}, expected one of {[*known]}")
        if self.consistency_side < 16:
            raise ValueError(f"consistency_side is {self.consistency_side}, expected at least 16")
        if self.min_views < 2:
            raise ValueError(f"min_views is {self.min_views}, expected at least 2")
        if self.noise <= 0 or self.stiffness_voxels <= 0 or self.image_side < 16:
            raise ValueError("noise, stiffness_voxels must be positive and image_side at least 16")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"voxel_mm": 4.0, "image_side": 512},
    "standard": {},
    "reference": {
        "voxel_mm": 1.0,
        "image_side": 2048,
    },
}
