"""Define the settings of the ingest stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class IngestConfig:
    """Size of the proxies, and the checks of sync and focus."""

    proxy_long_side: int = 480
    """Longer side of a proxy, pixels (16 to 4096); smaller footage is not enlarged."""
    proxy_quality: int = 85
    """JPEG quality of proxies, 1 to 100."""
    sync_frames: int = 8
    """Largest number of frames by which a camera out of step is found, 1 to 100; 0: no check."""
    focus_every: int = 24
    """Sharpness is measured in every n-th frame at full resolution, 1 or more; 0: no check."""
    blur_ratio: float = 2.0
    """A camera is out of focus if its edges are this many times as wide as usual."""

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
        if not 1 < self.blur_ratio < 100:
            raise ValueError(f"blur_ratio is {self.blur_ratio}, expected more than 1")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"proxy_long_side": 320, "proxy_quality": 80, "focus_every": 96},
    "reference": {"proxy_long_side": 960, "proxy_quality": 92, "focus_every": 8},
}
