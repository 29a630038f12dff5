"""Settings of ingest."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class IngestConfig:
    """What ingest may trade, and from where on it warns."""

    proxy_long_side: int = 480
    """Longer side of a proxy, pixels (16 to 4096); smaller footage is not enlarged."""
    proxy_quality: int = 85
    """JPEG quality of proxies, 1 to 100."""
    sync_frames: int = 8
    """How many frames a camera may be out of step and be found, 1 to 100; 0 does not look."""
    focus_every: int = 24
    """Sharpness is measured in every such frame at full resolution, 1 or more; 0 does not look."""
    exposure_drift_ev: float = 0.15
    """Stops by which a camera's light may change over the capture without a warning."""
    colour_drift_ev: float = 0.06
    """Stops by which red or blue may change against green without a warning."""
    blur_ratio: float = 2.0
    """Edges this many times as wide as the other cameras', or as before, are out of focus."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 16 <= self.proxy_long_side <= 4096:
            raise ValueError(f"proxy_long_side is {self.proxy_long_side}, expected 16 to 4096")
        if not 1 <= self.proxy_quality <= 100:
            raise ValueError(f"proxy_quality is {self.proxy_quality}, expected 1 to 100")
        if not 0 <= self.sync_frames <= 100:
            raise ValueError(f"sync_frames is {self.sync_frames}, expected 0 to 100")
        if self.focus_every < 0:
            raise ValueError(f"focus_every is {self.focus_every}, expected 0 or more")
        for name in ("exposure_drift_ev", "colour_drift_ev"):
            if not 0 < getattr(self, name) < 100:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")
        if not 1 < self.blur_ratio < 100:
            raise ValueError(f"blur_ratio is {self.blur_ratio}, expected more than 1")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"proxy_long_side": 320, "proxy_quality": 80, "focus_every": 96},
    "standard": {},
    "reference": {"proxy_long_side": 960, "proxy_quality": 92, "focus_every": 8},
}
