"""Write each labelled peak frame once, undistorted, colour-corrected and reduced, and the plates.

An item is an expression of a subject with all cameras, so that a changed label redoes one
expression only. A seek in 4K H.264 costs half a second with any grouping. The clean plates of a
subject and the sizes of its pictures are one more item. For cameras without a plate, it holds
the wall that several moments show (`pipelines/matte/wall.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from express50.capture.index import peak_items, read_index, read_peak_rows
from express50.contract.layout import PLATES, Dataset
from express50.contract.stage import Growth, Result, Stage
from express50.errors import CaptureError, ConfigError, advised


@dataclass(frozen=True, kw_only=True)
class FramesConfig:
    """Size of the pictures that every later stage works on."""

    image_side: int = 0
    """Longest side, pixels, to which peak frames, plates and cameras are reduced for all later
    stages and the shards, 16 to 32768; smaller footage is not enlarged. 0: as recorded."""

    def __post_init__(self) -> None:
        """Check the range."""
        if self.image_side and not 16 <= self.image_side <= 32768:
            raise ConfigError(f"frames.image_side is {self.image_side}, expected 16 to 32768, or 0")


PRESETS: dict[str, dict[str, object]] = {"draft": {"image_side": 1280}}


def items(dataset: Dataset) -> list[str]:
    """List `subject/expression` of every labelled peak, and `subject/_plates`.

    Only aligned and calibrated subjects have items.
    """
    peaks = [
        item for item in peak_items(dataset) if dataset.cameras_file(item.split("/")[0]).is_file()
    ]
    subjects = dict.fromkeys(item.split("/")[0] for item in peaks)
    return peaks + [f"{subject}/{PLATES}" for subject in subjects]


def inputs(dataset: Dataset, item: str, config: FramesConfig) -> dict[str, Path | str]:
    """Name the index, the cameras, and the peak or the plates; the index holds footage hashes."""
    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "index": dataset.index_file(subject),
        "cameras": dataset.cameras_file(subject),
    }
    if expression == PLATES:
        index = read_index(dataset, subject)
        if not index.capture.exists():  # or the mattes would be made again, without plates
            raise CaptureError(
                f"{index.capture}: no such folder; run"
                f" {advised('express50 ingest', dataset.root, 'CAPTURE')}"
                f" with the folder where {subject}'s capture is now"
            )
        paths = {c: index.capture / name for c, name in index.plates.items()}
        return found | {f"plate {c}": path for c, path in paths.items() if path.is_file()}
    return found | {"peak": repr(read_peak_rows(dataset, subject)[expression])}


def run(dataset: Dataset, item: str, config: FramesConfig, out: Path) -> Result:
    """Write one file per camera, and a contact sheet."""
    from pipelines.frames.stage import run as work

    return work(dataset, item, out, config.image_side)


STAGE = Stage(
    name="frames",
    version=13,
    config=FramesConfig,
    items=items,
    inputs=inputs,
    run=run,
    presets=PRESETS,
    help="write the labelled peak frames, undistorted and colour-corrected",
    purpose="Peak frames and clean plates as every later stage reads them: undistorted to the"
    " calibrated pinhole camera, colour-corrected, lossless, and reduced if the settings say so."
    " Without a clean plate, the wall is learned from several moments.",
    growth=Growth(
        items=("subjects", "expressions"),
        time=("views", "converted"),
        disk=("views", "picture"),
        more=("subjects",),
        reduces="image_side",
    ),  # fmt: skip
)
