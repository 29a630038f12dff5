"""The observe and align stages, listed without loading what they compute with."""

from __future__ import annotations

from pathlib import Path

from annotations.config import AlignConfig, ObserveConfig
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage


def observe_inputs(dataset: Dataset, item: str, config: ObserveConfig) -> dict[str, Path | str]:
    """Name what observe reads of one subject, see `annotations.observe`."""
    from annotations.observe import item_inputs

    return item_inputs(dataset, item, config)


def observe(dataset: Dataset, item: str, config: ObserveConfig, out: Path) -> Result | dict:
    """Observe one subject, see `annotations.observe`."""
    from annotations.observe import run_item

    return run_item(dataset, item, config, out)


def align_inputs(dataset: Dataset, item: str, config: AlignConfig) -> dict[str, Path | str]:
    """Name what align reads of one subject, see `annotations.align`."""
    from annotations.align import item_inputs

    return item_inputs(dataset, item, config)


def align(dataset: Dataset, item: str, config: AlignConfig, out: Path) -> Result | dict:
    """Align one subject, see `annotations.align`."""
    from annotations.align import run_item

    return run_item(dataset, item, config, out)


OBSERVE = Stage(
    name="observe",
    version=2,
    config=ObserveConfig,
    presets={
        "draft": {"cameras": 1, "stride": 2},
        "standard": {},
        "reference": {"cameras": 6},
    },
    items=Dataset.subjects,
    inputs=observe_inputs,
    run=observe,
    help="watch the face through every cue window (align runs it first)",
    purpose="The cameras that watch the face through the cue windows.",
    growth=Growth(items=("subjects",), time=("frames",), disk=("frames",)),
)
ALIGN = Stage(
    name="align",
    version=5,
    config=AlignConfig,
    presets={"draft": {}, "standard": {}, "reference": {}},
    items=Dataset.subjects,
    inputs=align_inputs,
    run=align,
    help="suggest, match to the reference and take the frame of each expression",
    purpose="The labelled frame of every expression, with its cue window's first and last frame.",
    runs_first=("observe",),
    growth=Growth(items=("subjects",), time=("frames",), disk=("frames",)),
)
