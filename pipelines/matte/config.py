"""Settings of the matte stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass

from express50.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class MatteConfig:
    """How finely the cameras of a moment are compared, and what it takes to overrule one."""

    views: bool = True
    """Let the cameras correct each other; false leaves every camera's alpha as it is."""
    side: int = 192
    """Longest side, pixels, of the images that are compared."""
    cells: int = 96
    """Cells along the sides of the cube in which the views are compared."""
    votes: int = 2
    """Other cameras that must see clear background before a place counts as empty."""
    margin: float = 0.01
    """Distance from a silhouette, a share of the image's longer side, that proves nothing."""
    strand: float = 0.03
    """What reaches no further beyond the other views' hull than this share may be hair; kept."""
    colour: float = 0.1
    """Largest difference of colour, of full scale, of one surface in neighbouring cameras."""

    def __post_init__(self) -> None:
        """Refuse values that compare nothing or believe anything."""
        if not 16 <= self.side <= 2048 or not 16 <= self.cells <= 256:
            raise ConfigError(
                f"matte.side {self.side} and matte.cells {self.cells}: expected 16 to 2048 pixels"
                " and 16 to 256 cells"
            )
        if self.votes < 2:
            raise ConfigError(f"matte.votes is {self.votes}, expected 2 or more: one may be wrong")
        if not 0 < self.margin <= self.strand < 1 or not 0 < self.colour < 1:
            raise ConfigError(
                f"matte.margin {self.margin}, matte.strand {self.strand}, matte.colour"
                f" {self.colour}: expected 0 < margin <= strand < 1 and a colour between 0 and 1"
            )


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"side": 128, "cells": 64},
    "standard": {},
    "reference": {"side": 256, "cells": 128},
}
