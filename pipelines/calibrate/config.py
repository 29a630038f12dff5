"""Settings of the calibrate stage and its presets."""

from __future__ import annotations

import math
from dataclasses import dataclass

from express50.errors import ConfigError

AUTO = "auto"
REFINE = ("none", "poses", "all")
MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


LEAST = {"board_frames": 0, "rounds": 1, "min_corners": 4, "min_frames": 1, "weak_corners": 0,
         "weak_frames": 0, "check_moments": 0}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """Every field trades time, or strictness, for accuracy; none depends on a rig."""

    camera_model: str = AUTO
    """COLMAP model to solve for; auto: the simplest that fits, camera by camera."""
    board_frames: int = 80
    """Board images read a camera, evenly spaced; 0 reads all."""
    rounds: int = 3
    """Joint adjustments, each followed by rejection of corners."""
    reject_sigma: float = 4.0
    """Corners further off than this many robust standard deviations are rejected."""
    min_corners: int = 8
    """Corners a board image needs to count."""
    min_frames: int = 4
    """Board images a camera needs; fewer and it is dropped."""
    weak_corners: int = 200
    """A camera with fewer accepted corners is reported as weakly tied in."""
    weak_frames: int = 8
    """A camera that shares fewer board images with others is reported as weakly tied in."""
    solve_moments: int = 8
    """Moments of the footage from which cameras are solved where there is neither a calibration
    nor a board."""
    distance_m: float = 1.0
    """About how far cameras stand from the head: where the solution from footage starts when
    neither EXIF nor capture.toml tells the focal lengths."""
    focal_spread: float = 0.03
    """How much focal lengths of one rig differ, as a share (a standard deviation)."""
    eye_distance_mm: float = 63.0
    """Distance between the subject's pupils, which gives a solution from footage its metre. Adult
    mean (Dodgson 2004, Variation and extrema of human interpupillary distance); measure it."""
    refine: str = "none"
    """What of a given calibration is put right by the board, or without one by the footage:
    "none", "poses", or "all" (lenses too). What fits held-out points no better stays as given."""
    refine_turn_deg: float = 0.2
    """How far given cameras may be turned, without a board (a standard deviation)."""
    refine_move_mm: float = 3.0
    """How far given cameras may have moved, without a board (a standard deviation)."""
    check_moments: int = 2
    """Moments of the footage in which cameras that have moved are looked for; 0 looks at none."""

    def __post_init__(self) -> None:
        """Refuse models that cannot be solved for, and quantities that are none."""
        if self.camera_model not in (AUTO, *MODELS):
            raise ConfigError(
                f"calibrate.camera_model is {self.camera_model!r}; expected {AUTO} or "
                f"{', '.join(MODELS)}"
            )
        if self.refine not in REFINE:
            raise ConfigError(f"calibrate.refine is {self.refine!r}; expected {', '.join(REFINE)}")
        for name, least in LEAST.items():
            if getattr(self, name) < least:
                raise ConfigError(
                    f"calibrate.{name} is {getattr(self, name)}; expected {least} or more"
                )
        for name in ("distance_m", "focal_spread", "eye_distance_mm", "reject_sigma",
                     "refine_turn_deg", "refine_move_mm", "solve_moments"):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"calibrate.{name} is {value}; expected a positive number")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"board_frames": 36, "rounds": 1, "solve_moments": 4, "check_moments": 0},
    "standard": {},
    "reference": {"board_frames": 0, "solve_moments": 16, "check_moments": 4},
}
