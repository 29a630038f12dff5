"""The ingest stage writes a capture's frame index and proxies, and checks its quality."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from express50.console import count
from express50.contract.config import check_ranges
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from express50.errors import FormatError
from express50.files.text import read_json_table


@dataclass(frozen=True, kw_only=True)
class IngestConfig:
    """Size of the proxies, and the checks of sync and focus."""

    proxy_long_side: int = 480
    """Longer side of a proxy, pixels (16 to 4096); smaller footage is not enlarged."""
    proxy_quality: int = 85
    """JPEG quality of proxies, 1 to 100."""
    every: int = 1
    """Decode one of this many frames, 1 or more; in videos, key frames only. With more than 1, sync
    is not checked, and the proxies of other frames are made on request."""
    sync_frames: int = 8
    """Largest offset searched for in a camera out of step, frames, 1 to 100; 0: no check."""
    focus_every: int = 24
    """Sharpness is measured in every n-th frame at full resolution, 1 or more; 0: no check."""
    blur_ratio: float = 2.0
    """A camera is out of focus if its edges are this many times as wide as usual."""

    def __post_init__(self) -> None:
        """Check ranges."""
        check_ranges(
            "ingest", self, proxy_long_side=(16, 4096), proxy_quality=(1, 100),
            every=(1, math.inf), sync_frames=(0, 100), focus_every=(0, math.inf),
            blur_ratio=(1.01, 100),
        )  # fmt: skip


PRESETS: dict[str, dict[str, object]] = {
    "draft": {"proxy_long_side": 320, "proxy_quality": 80, "every": 24, "focus_every": 96},
    "reference": {"proxy_long_side": 960, "proxy_quality": 92, "focus_every": 8},
}


def add_captures(dataset: Dataset, captures: Sequence[Path], replace: bool = False) -> list[str]:
    """Add captures to the dataset's table, see `pipelines.ingest.stage`."""
    from pipelines.ingest.stage import add_captures as work

    return work(dataset, list(captures), replace)


def items(dataset: Dataset) -> list[str]:
    """List the registered subjects."""
    return list(dataset.captures())


def inputs(dataset: Dataset, item: str, config: IngestConfig) -> dict[str, Path | str]:
    """Name what one item reads, see `pipelines.ingest.stage`."""
    from pipelines.ingest.stage import inputs as found

    return found(dataset, item)


def run(dataset: Dataset, item: str, config: IngestConfig, out: Path) -> Result:
    """Make one item, see `pipelines.ingest.stage`."""
    from pipelines.ingest.stage import run as work

    return work(dataset, item, out, **vars(config))


def account(dataset: Dataset, subjects: Sequence[str]) -> Iterator[str]:
    """Yield a line per ingested capture for people."""
    for subject in subjects:
        path = dataset.item_dir("ingest", subject) / "metrics.json"
        if not path.is_file():
            continue
        found = read_json_table(path, FormatError, "ingest again")
        counts = sorted({found["frame_count"], *found["frame_count_differs"].values()})
        frames = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        frames += " frame each" if counts == [1] else " frames each"
        yield (
            f"  {subject} ({found.get('layout', 'express50')}): "
            f"{count(found['cameras'], 'camera')}, {frames}, "
            f"{count(found['expressions'], 'expression')}"
        )


STAGE = Stage(
    name="ingest",
    version=11,
    config=IngestConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="index raw captures: hash frames, write proxies, check sync, light and focus",
    purpose="Footage indexed frame by frame, with proxies for scrubbing.",
    prepare=add_captures,
    account=account,
    # Proxies have one size, whatever that of the footage.
    growth=Growth(
        ("subjects",), ("decoded", "views", "pixels"), ("decoded", "views"), skips="every"
    ),
)
