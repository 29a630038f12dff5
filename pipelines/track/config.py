"""Define the settings of the track stage and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from express50.contract.config import check_ranges
from express50.errors import ConfigError
from express50.head import BUILTIN_NAME, absolute_head

VERSION = 34
UV_WEIGHTS = Path(__file__).with_name("face_uv_weights.npz")


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """Settings that trade time for accuracy or select the frames to track."""

    head: str = BUILTIN_NAME
    """Head model: procedural (the built-in one), or the path of a FLAME pickle, of ICT-FaceKit or
    of your own (docs/RECIPES.md)."""
    landmarks: str = "embedded"
    """Source of landmarks: embedded, fan:PATH of FAN's TorchScript weights, or the path of a file
    of points (docs/FORMAT.md)."""
    frames: Literal["peaks", "clips"] = "peaks"
    """Track the peak frames alone, or every frame of the cue windows as well."""
    stride: int = 1
    """Track every n-th frame of a clip."""
    neutral: str = "neutral"
    """Expression id of the resting face; it need not exist."""
    cameras: int = 0
    """How many cameras' landmarks are used at the peaks, the best views of the face; 0: all.
    Clips use all."""
    search: float = 0.25
    """Smallest window searched for a face, as a share of the image's longer side; at most 0.08 if
    fewer than two cameras then show one. A face is found in windows of up to three times its
    width."""
    photo_side: int = 512
    """Longer side of the head crops that patches are compared in, pixels."""
    samples: int = 4000
    """Places on the skin at which patches are compared."""
    outline_rounds: int = 3
    """Last rounds in which the mesh is fitted to the mattes' outlines; 0 for none."""
    patch_rounds: int = 3
    """Rounds in which the surface is searched for along the normals; 0 for none."""
    uv_rounds: int = 3
    """First rounds that find landmarks on the face UV map; later rounds keep the last reading. 0
    for none."""
    offset_modes: int = 150
    """Smooth static offsets of the skin beyond the head's shape directions; 0 for none."""
    texture_side: int = 512
    """Texels per side of the subject's albedo texture (albedo.png); 0 for none."""
    clip_rounds: int = 2
    """Rounds in which a frame of a clip is fitted to its pictures; 0 uses landmarks alone."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work; make the head model's path absolute.

        Track and shards name the model by this path, and other commands read it from there.
        """
        if not self.head.strip():  # its absolute path would be the present folder
            raise ConfigError("track.head is empty; give a head model, or leave the setting out")
        object.__setattr__(self, "head", absolute_head(self.head))
        check_ranges(
            "track", self, stride=(1, 10_000), cameras=(0, 10_000), search=(0.02, 1),
            photo_side=(32, 8192), samples=(100, 30_000), outline_rounds=(0, 100),
            patch_rounds=(0, 100), uv_rounds=(0, 100), offset_modes=(0, 2000),
            texture_side=(0, 8192), clip_rounds=(0, 100),
        )  # fmt: skip


PRESETS: dict[str, dict[str, object]] = {
    "draft": {
        "cameras": 6, "search": 0.5, "outline_rounds": 2,
        "samples": 2000, "offset_modes": 80, "texture_side": 256, "clip_rounds": 0,
    },
}  # fmt: skip
