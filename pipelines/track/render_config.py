"""Settings of the refinement by rendering."""

from __future__ import annotations

from dataclasses import dataclass

from express50.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Every field trades time for accuracy or states how far to trust something."""

    levels: tuple[int, ...] = (4, 2, 1)
    """Divisors of the pictures' size, in the order in which they are gone through."""
    rounds: int = 5
    """Visits of every expression at each level."""
    steps: int = 5
    """Steps of a visit; visibility is found at its start."""
    photometric: float = 1.0
    """Weight of the mean difference of colours."""
    outline: float = 3.0
    """Weight of the area between outlines, as a share of the head's."""
    softness: float = 0.02
    """Differences of colour below it count squared, those above it by their size."""
    prior: float = 2e-5
    """Weight of the priors (squared standard deviations) against the data terms."""
    shape_rate: float = 0.02
    """First step of shape coefficients; 0 leaves them alone. Steps fall to a tenth of it."""
    expression_rate: float = 0.02
    """First step of expression coefficients."""
    joint_rate: float = 0.005
    """First step of neck, jaw and eyes, radians."""
    turn_rate: float = 0.003
    """First step of the head's turn, radians."""
    move_rate: float = 0.001
    """First step of the head's place, metres."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not self.levels or min(self.levels) < 1 or min(self.rounds, self.steps) < 1:
            raise ConfigError("track: render levels, rounds and steps must be at least 1")
        if self.softness <= 0:
            raise ConfigError("track: render softness must be above 0")
        weights = (self.photometric, self.outline, self.prior)
        rates = (self.shape_rate, self.expression_rate, self.joint_rate, self.turn_rate)
        if min(*weights, *rates, self.move_rate) < 0:
            raise ConfigError("track: render weights and rates must not be negative")
