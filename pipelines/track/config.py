"""Settings of the track stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from express50.errors import ConfigError

VERSION = 11  # of the stage: outputs of another are made anew


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """Every field trades time for accuracy or states how far to trust something."""

    head: str = "procedural"
    """Head model: procedural, the path of a FLAME pickle, or of ICT-FaceKit."""
    landmarks: str = "embedded"
    """Where landmarks come from: embedded, fan:PATH of FAN's TorchScript weights, or the path of a
    file of points (docs/FORMAT.md)."""
    frames: Literal["peaks", "clips"] = "peaks"
    """What is tracked: the peak frames, or every frame of the cue windows as well."""
    stride: int = 1
    """Of clips, every so many frames."""
    window: int = 48
    """Frames of a clip that are tracked in one piece, and kept if the run is stopped."""
    sweeps: int = 2
    """Smoothing rounds over a clip; 0 for none."""
    clip_rounds: int = 2
    """Rounds in which a clip's frame is held to its pictures; 0 for landmarks alone, as without
    `photo_rounds`, which learn the skin."""
    smooth_mm: float = 1.0
    """How far a point may lie from the middle of the neighbouring frames', millimetres."""
    cameras: int = 0
    """Cameras whose landmarks place the peaks, those that see the face best; 0 uses all. Clips use
    all."""
    refinements: int = 3
    """Detector crops after the coarse pass."""
    search: float = 0.25
    """Smallest windows searched where no face is found, of the image's longer side. A face is found
    in windows of up to three times its width; cameras behind the head cost more the smaller."""
    iterations: int = 14
    """Levenberg-Marquardt steps of the landmark fit."""
    silhouette_rounds: int = 3
    """Rounds of outline matching to the mattes (each finds the outline anew); 0 for none."""
    photo_rounds: int = 2
    """Rounds of photometric refinement; 0 for none."""
    photo_side: int = 512
    """Pixels of the crops that colours are compared in, the longer side."""
    samples: int = 4000
    """Places on the skin at which colours are compared."""
    relief_rounds: int = 6
    """Rounds in which the surface is searched for along the normals; 0 for none."""
    relief_reach: float = 0.008
    """How far the first search goes, metres."""
    relief_weight: float = 1.0
    """Trust in the searched surface."""
    chart_rounds: int = 8
    """Of the rounds that there are, the first so many in which landmarks are found anew on the face
    laid flat; what the last of them said stays. 0 for none."""
    chart_weight: float = 1.0
    """Trust in these landmarks."""
    detail_radius: float = 0.003
    """Marks of the skin smaller than this are compared, metres."""
    photo_weight: float = 0.05
    """Trust in the photometric term."""
    photo_tie: float = 0.3
    """How firmly a moment's colours are tied to those of the other moments, 0 to 1."""
    texture_side: int = 512
    """Texels a side of the texture of the subject's colours (albedo.png); 0 for none."""
    round_iterations: int = 4
    """Levenberg-Marquardt steps a round of outlines and colours."""
    min_score: float = 0.2
    """Views whose face score is lower are left out."""
    min_landmarks: int = 20
    """Landmarks an expression needs after outlier rejection."""
    landmark_floor_px: float = 1.0
    """Least error assumed of a landmark, for a face 128 px tall; scales with the face."""
    landmark_bias: float = 0.003
    """Standard deviation of what the detector errs on a face in all frames alike, metres."""
    contour_weight: float = 0.25
    """Weight of the jaw line's landmarks (0..16), which slide along the jaw."""
    shape_prior: float = 1.0
    """Weight of the prior on shape coefficients (standard deviations)."""
    offset_modes: int = 150
    """Smooth static offsets of the skin along its normals, beyond the head's shape directions; 0
    for none."""
    offset_along: int = 40
    """The same along the skin, for each of three axes; 0 for none, as without `chart_rounds`."""
    offset_sigma: float = 0.001
    """Standard deviation of these offsets, metres."""
    offset_length: float = 0.02
    """Their correlation length, metres."""
    expression_prior: float = 0.2
    """Mean activation that is expected of an expression's muscles, of which few act at a time; in
    the neutral frame a fifth of it. Of coefficients that are no activations, as FLAME's, 4.5 times
    it is the standard deviation."""
    neck_prior: float = 0.2
    """Standard deviation of the neck's joint against the head, radians. A single view hardly sees
    it."""
    neutral: str = "neutral"
    """Expression id that is the resting face; none need exist."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if self.stride < 1 or self.window < 1 or min(self.sweeps, self.clip_rounds) < 0:
            raise ConfigError(
                "track: stride and window must be at least 1, sweeps and clip_rounds at least 0"
            )
        if self.iterations < 1 or self.refinements < 1:
            raise ConfigError("track: iterations and refinements must be at least 1")
        if not 0.02 <= self.search <= 1:
            raise ConfigError(f"track: search is {self.search}, expected 0.02 to 1")
        priors = (self.shape_prior, self.expression_prior, self.neck_prior)
        if min(self.landmark_floor_px, self.smooth_mm, self.landmark_bias, *priors) <= 0:
            raise ConfigError(
                "track: landmark_floor_px, landmark_bias, smooth_mm and the priors must be above 0"
            )
        rounds = [self.cameras, self.silhouette_rounds, self.photo_rounds, self.relief_rounds]
        rounds += [self.chart_rounds, self.offset_along]
        if min(rounds) < 0 or self.round_iterations < 1:
            raise ConfigError(
                "track: cameras, rounds and offset_along must not be negative, round_iterations"
                " at least 1"
            )
        lengths = (self.offset_sigma, self.offset_length, self.relief_reach, self.detail_radius)
        if min(*lengths, self.chart_weight) <= 0:
            raise ConfigError(
                "track: chart_weight and lengths (offset_sigma, offset_length, relief_reach,"
                " detail_radius) must be > 0"
            )
        if not 0 <= self.texture_side <= 8192:
            raise ConfigError("track: texture_side must be 0 to 8192")
        if not 100 <= self.samples <= 30_000 or not 32 <= self.photo_side <= 8192:
            raise ConfigError("track: samples must be 100 to 30000, photo_side 32 to 8192")


PRESETS: dict[str, dict[str, object]] = {
    "draft": {
        "cameras": 6, "refinements": 2, "search": 0.5, "iterations": 8, "silhouette_rounds": 2,
        "relief_rounds": 4, "photo_rounds": 0, "samples": 2000, "offset_modes": 80,
        "round_iterations": 2, "sweeps": 1, "texture_side": 256, "clip_rounds": 0,
        "chart_rounds": 4, "offset_along": 12,
    },
    "standard": {},
    "reference": {
        "refinements": 5, "iterations": 30, "photo_side": 1024, "texture_side": 1024,
        "round_iterations": 6, "sweeps": 4, "clip_rounds": 3,
    },
}  # fmt: skip
