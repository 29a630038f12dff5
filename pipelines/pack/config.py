"""Define the settings of the encode and pack stages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from express50.contract.config import check_ranges


@dataclass(frozen=True, kw_only=True)
class EncodeConfig:
    """Size and codecs of the samples."""

    size: int = 512
    """Side of a sample, pixels, 16 to 8192."""
    profile: Literal["compact", "fast", "lossless"] = "fast"
    """rgb as JPEG q90 4:2:0 (compact), JPEG q95 4:4:4 (fast) or PNG (lossless); alpha, parts and
    depth as PNG, or as zstd and LERC (fast), which decode in a fraction of the time."""
    even_colour: bool = True
    """Divide out the cameras' different response to the same light, where calibration measured
    it."""
    torso: Literal["remove", "keep"] = "remove"
    """remove: alpha omits shoulders and clothes, if regions separated them; keep: it does not."""
    min_confidence: float = 0.0
    """Depth pixels with less confidence count as unknown, 0 to 1; 0.5 keeps bounds up to 2 mm."""

    def __post_init__(self) -> None:
        """Check ranges."""
        check_ranges("encode", self, size=(16, 8192), min_confidence=(0, 1))


@dataclass(frozen=True, kw_only=True)
class PackConfig:
    """Split of the packed subjects."""

    test_subjects: tuple[str, ...] = ()
    """Subjects of the test split; empty: chosen by test_fraction."""
    test_fraction: float = 0.1
    """Share of subjects in the test split, chosen by a hash of their ids; 0: no test split."""

    def __post_init__(self) -> None:
        """Check ranges."""
        check_ranges("pack", self, test_fraction=(0, 0.99))


ENCODE_PRESETS: dict[str, dict[str, object]] = {
    "draft": {"size": 256, "profile": "compact"},
    "reference": {"size": 1024, "profile": "lossless"},
}
