"""Define the settings of the calibrate stage and its presets."""

from __future__ import annotations

import math
from dataclasses import dataclass

from express50.contract.config import check_ranges
from express50.errors import ConfigError

AUTO = "auto"
LONG_SIDE = 1280  # pixels of the reduced images in which features are found
REFINE = ("none", "poses", "all")
MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


@dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """Settings that trade time for accuracy, or state what is known about the rig."""

    camera_model: str = AUTO
    """COLMAP model to solve for; auto: the simplest that fits, camera by camera."""
    board_frames: int = 80
    """Board images read per camera, evenly spaced; 0 reads all."""
    rounds: int = 3
    """Joint adjustments to the board, each followed by rejection of corners."""
    solve_frame_sets: int = 8
    """Frame sets from which cameras are solved if there is neither a calibration nor a board."""
    distance_m: float = 1.0
    """Rough distance of the cameras from the head, at which solving from footage starts if neither
    EXIF nor capture.toml gives the focal lengths."""
    eye_distance_mm: float = 63.0
    """Distance between the subject's pupils, which sets the scale of a rig solved from
    footage. The default is the adult mean (Dodgson 2004, Variation and extrema of human
    interpupillary distance); measure it."""
    refine: str = "none"
    """What the footage corrects in a given calibration: "none", "poses", or "all" (lenses too).
    Cameras are only changed if held-out points then fit better. Where there is a board, leave the
    calibration out of the capture instead: a rig solved from the board is better."""
    refine_turn_deg: float = 0.2
    """How far given cameras may be turned (a standard deviation)."""
    refine_move_mm: float = 3.0
    """How far given cameras may have moved (a standard deviation)."""
    check_frame_sets: int = 2
    """Number of frame sets in which to look for cameras that have moved; 0: no check."""

    def __post_init__(self) -> None:
        """Check names and ranges."""
        if self.camera_model not in (AUTO, *MODELS):
            raise ConfigError(
                f"calibrate.camera_model is {self.camera_model!r}; expected {AUTO} or "
                f"{', '.join(MODELS)}"
            )
        if self.refine not in REFINE:
            raise ConfigError(f"calibrate.refine is {self.refine!r}; expected {', '.join(REFINE)}")
        check_ranges(
            "calibrate", self, board_frames=(0, math.inf), rounds=(1, math.inf),
            solve_frame_sets=(1, math.inf), check_frame_sets=(0, math.inf),
            distance_m=(1e-6, math.inf), eye_distance_mm=(1e-6, math.inf),
            refine_turn_deg=(1e-6, math.inf), refine_move_mm=(1e-6, math.inf),
        )  # fmt: skip


# More board images and frame sets than standard's take longer and gain nothing (docs/TRADEOFFS.md).
PRESETS: dict[str, dict[str, object]] = {
    "draft": {"board_frames": 36, "rounds": 1, "solve_frame_sets": 4, "check_frame_sets": 0}
}
