"""Settings of the calibrate stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass

from express50.errors import ConfigError

AUTO = "auto"
MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


@dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """Every field trades time, or strictness, for accuracy; none depends on a rig."""

    camera_model: str = AUTO
    """COLMAP model to solve for; auto: the simplest that fits, camera by camera."""
    board_frames: int = 80
    """Board images read a camera, evenly spaced; 0 reads all."""
    single_frames: int = 30
    """Images used to start one camera's intrinsics (the joint adjustment uses all)."""
    rounds: int = 3
    """Joint adjustments, each followed by rejection of corners."""
    iterations: int = 60
    """Levenberg-Marquardt iterations a joint adjustment."""
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
    check_moments: int = 2
    """Moments of the footage in which cameras that have moved are looked for; 0 looks at none."""

    def __post_init__(self) -> None:
        """Refuse models that a board cannot be solved for."""
        if self.camera_model not in (AUTO, *MODELS):
            raise ConfigError(
                f"calibrate.camera_model is {self.camera_model!r}; expected {AUTO} or "
                f"{', '.join(MODELS)}"
            )


PRESETS: dict[str, dict[str, object]] = {
    "draft": {
        "board_frames": 24,
        "single_frames": 15,
        "rounds": 1,
        "iterations": 30,
        "check_moments": 0,
    },
    "standard": {},
    "reference": {
        "board_frames": 0,
        "single_frames": 60,
        "rounds": 5,
        "iterations": 200,
        "reject_sigma": 6.0,
        "check_moments": 4,
    },
}
