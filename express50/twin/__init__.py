"""Record synthetic raw captures, with ground truth beside them: the digital twin.

Heads are posed by a ``HeadModel`` and rendered by ray casting (Embree), never with the project's
own rasteriser. Only benchmarks, tests and reports open the truth, never a stage. Everything random
has its own generator, seeded by a list such as [seed, subject, 11, camera].
"""

from __future__ import annotations

from dataclasses import dataclass

from express50.contract.config import check_ranges
from express50.errors import ConfigError
from express50.head import BUILTIN_NAME

KINDS = ("glasses", "hand", "beard", "moustache", "fringe", "microphone", "mask")
"""What a subject can wear or hold."""


@dataclass(frozen=True, kw_only=True)
class TwinConfig:
    """Settings of ``express50 twin record``; the same settings give the same bytes."""

    head: str = BUILTIN_NAME
    "head model: procedural, or the path of a file; its expressions must have names"
    subjects: int = 4
    "number of subjects"
    first_subject: int = 1
    "number of the first subject, 1 for S001; a subject does not depend on how many there are"
    cameras: int = 24
    "number of cameras, spread over about 300 degrees"
    width: int = 960
    "image width, pixels"
    height: int = 540
    "image height, pixels"
    expressions: tuple[str, ...] | None = None
    "ids from the script, in order (default: all 60)"
    frames_per_expression: int = 8
    "frames of each cue window, at least 4"
    fps: float = 24.0
    "frames per second that the capture states"
    seed: int = 0
    "random seed"
    footage: str = "video"
    "``video`` (H.264, 4:4:4), ``png`` or ``jpg`` frames"
    crf: int = 10
    "H.264 constant rate factor; lower is closer to lossless"
    board_frames: int = 24
    "pictures of the ChArUco board per camera; 0 for none"
    give_calibration: bool = False
    "write calibration.json into the capture, so that no camera has to be solved"
    plates: bool = True
    "record plates"
    hair: bool = True
    "give subjects hair strands"
    wear: tuple[str, ...] = ()
    "what every subject wears or holds: glasses, hand, beard, moustache, fringe, microphone, mask"
    personal: float = 0.0
    "strength of each person's own motions, wrinkles and blushes, which no head model has, 0 to 2"
    noise: float = 1.0
    "sensor noise relative to a good studio camera's; 0 for none"

    def __post_init__(self) -> None:
        check_ranges(
            "twin", self, subjects=(1, 10_000), first_subject=(0, 99_999), cameras=(1, 200),
            width=(32, 16_384), height=(32, 16_384), frames_per_expression=(4, 10_000),
            fps=(1, 1000), crf=(0, 51), board_frames=(0, 1000), noise=(0, 100),
            seed=(0, 2**63 - 1), personal=(0, 2),
        )  # fmt: skip
        if unknown := set(self.wear) - set(KINDS):
            raise ConfigError(
                f"twin.wear names {', '.join(sorted(unknown))}, expected some of {', '.join(KINDS)}"
            )
        if self.footage not in ("video", "png", "jpg"):
            raise ConfigError(f"twin.footage is {self.footage!r}, expected video, png or jpg")
        if self.footage == "video" and (self.width % 2 or self.height % 2):
            raise ConfigError(
                f"twin: video frames are {self.width}x{self.height}, H.264 needs even sizes;"
                " change the size or record frames"
            )
