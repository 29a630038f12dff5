"""Configuration of the pack stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class PackConfig:
    """Size, codecs and split of the packed samples."""

    size: int = 512
    """Side of a sample, pixels, 16 to 8192."""
    margin: float = 0.1
    """Room around the head, as a share of its size."""
    hair: float = 0.3
    """How far beyond the tracked mesh the matte may widen the crop, as a share of its size."""
    profile: Literal["compact", "fast", "lossless"] = "fast"
    """rgb as JPEG q90 4:2:0 (compact), JPEG q95 4:4:4 (fast) or PNG (lossless); alpha, parts and
    depth as PNG, or as zstd and LERC (fast), which decode in a fraction of the time."""
    foreground: bool = True
    """Where a pixel mixes subject and background, store the subject's own colour alone."""
    even_colour: bool = True
    """Divide out what the cameras make differently of the same light, where calibration told it."""
    torso: Literal["remove", "keep"] = "remove"
    """Alpha without or with shoulders and clothes, where the regions stage told them apart."""
    min_confidence: float = 0.0
    """Depth pixels under this confidence count as not valid, 0 to 1."""
    shard_mb: int = 256
    """A shard is closed at this size, megabytes; a (subject, expression) is never split."""
    test_subjects: tuple[str, ...] = ()
    """Subjects of the test split; empty: chosen by test_fraction and seed."""
    test_fraction: float = 0.1
    """Share of subjects in the test split; 0: no test split."""
    seed: int = 0
    """Seed of the choice of test subjects."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 16 <= self.size <= 8192:
            raise ValueError(f"size is {self.size}, expected 16 to 8192")
        if not (0 <= self.margin <= 2 and 0 <= self.hair <= 2):
            raise ValueError(f"margin {self.margin} and hair {self.hair}, expected 0 to 2")
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"min_confidence is {self.min_confidence}, expected 0 to 1")
        if self.shard_mb < 1:
            raise ValueError(f"shard_mb is {self.shard_mb}, expected at least 1")
        if not 0 <= self.test_fraction < 1:
            raise ValueError(f"test_fraction is {self.test_fraction}, expected 0 to under 1")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"size": 256, "profile": "compact"},
    "standard": {},
    "reference": {"size": 1024, "profile": "lossless"},
}
