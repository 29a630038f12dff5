"""Settings of the observe and align stages."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ObserveConfig:
    """Settings of the observe stage."""

    cameras: int = 3
    """How many cameras watch the face; those that see it best at rest are taken."""
    stride: int = 1
    """Look at every stride-th frame of a cue window, at least 1."""
    min_score: float = 0.3
    """A camera whose face score at rest is lower does not watch, 0 to 1."""
    search: float = 0.25
    """Smallest windows searched where no face is found, of the image's longer side."""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        if self.cameras < 1 or self.stride < 1:
            raise ValueError(f"cameras {self.cameras}, stride {self.stride}: expected at least 1")
        if not 0 <= self.min_score <= 1:
            raise ValueError(f"min_score {self.min_score}: expected 0 to 1")
        if not 0.02 <= self.search <= 1:
            raise ValueError(f"search {self.search}: expected 0.02 to 1")


@dataclass(frozen=True, kw_only=True)
class AlignConfig:
    """Settings of the align stage."""

    accept: float = 0.0
    """Suggestions at least this sure are taken without a person, 0 (all) to 1 (none)."""
    match: bool = True
    """Match to the reference identity's canonical frames; off, everybody's own peak is taken."""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        if not 0.0 <= self.accept <= 1.0:
            raise ValueError(f"accept {self.accept}: expected 0 to 1")
