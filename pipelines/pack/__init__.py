"""Pack cropped samples of every subject, expression and camera into checksummed shards."""

from __future__ import annotations

from pathlib import Path

from express50.contract.layout import Dataset, exclusion_reason
from express50.contract.stage import Growth, Result, Stage
from pipelines.pack.config import PRESETS, PackConfig


def items(dataset: Dataset) -> list[str]:
    """List the one item: the shards of all subjects."""
    return ["shards"] if dataset.subjects() else []


def inputs(dataset: Dataset, item: str, config: PackConfig) -> dict[str, Path | str]:
    """Name the outputs of every earlier stage for every subject, as far as they exist."""
    from express50.capture.readers.read import read_people
    from pipelines.pack.card import people_lines

    found: dict[str, Path | str] = {}
    included = []
    for subject in dataset.subjects():
        if (reason := exclusion_reason(dataset, subject)) is not None:
            found[f"{subject} excluded"] = reason
            continue
        included.append(subject)
        found[f"{subject} index"] = dataset.index_file(subject)
        parts = {
            "frames": dataset.item_dir("frames", subject),
            "calibrate": dataset.cameras_file(subject),
            "gains": dataset.gains_file(subject),
            "align": dataset.peaks_file(subject),
            "track": dataset.track_file(subject),
            "matte": dataset.item_dir("matte", subject),
            "depth": dataset.item_dir("depth", subject),
            "register": dataset.item_dir("register", subject),
            "regions": dataset.item_dir("regions", subject),
        }
        found |= {f"{subject} {name}": path for name, path in parts.items() if path.exists()}
    # The receipt keeps no more about people than the card: nothing where they are too few.
    return found | {"people": "\n".join(people_lines(read_people(dataset, included)))}


def run(dataset: Dataset, item: str, config: PackConfig, out: Path) -> Result:
    """Write shards, index, manifest, splits and card."""
    from pipelines.pack.stage import run as work

    return work(dataset, config, out)


STAGE = Stage(
    name="pack",
    version=11,
    config=PackConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="write shards, splits and dataset card",
    purpose="Samples packed into shards.",
    growth=Growth(
        items=(),
        time=("subjects", "expressions", "views", "pixels"),
        disk=("subjects", "expressions", "views"),
    ),
)
