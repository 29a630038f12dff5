"""Two stages write the shards: encode a subject's samples, and pack all subjects' in one folder.

Encoding is slow and runs per subject; ``express50 pack`` runs it first. Packing gathers the encoded
subjects, so adding or removing a subject does not re-encode the others.
"""

from __future__ import annotations

from pathlib import Path

from express50.contract.layout import Dataset, exclusion_reason
from express50.contract.stage import Growth, Result, Stage
from pipelines.pack.config import ENCODE_PRESETS, EncodeConfig, PackConfig


def included(dataset: Dataset) -> list[str]:
    """List the subjects that no annotator excluded."""
    return [name for name in dataset.subjects() if exclusion_reason(dataset, name) is None]


def encode_inputs(dataset: Dataset, item: str, config: EncodeConfig) -> dict[str, Path | str]:
    """Name the existing outputs of every earlier stage for the subject."""
    stages = ("frames", "matte", "depth", "register", "regions")
    parts = {stage: dataset.item_dir(stage, item) for stage in stages} | {
        "calibrate": dataset.cameras_file(item),
        "gains": dataset.gains_file(item),
        "align": dataset.peaks_file(item),
        "track": dataset.track_file(item),
    }
    found: dict[str, Path | str] = {"index": dataset.index_file(item)}
    return found | {name: path for name, path in parts.items() if path.exists()}


def encode_run(dataset: Dataset, item: str, config: EncodeConfig, out: Path) -> Result:
    """Write the subject's samples as shards with index and manifest."""
    from pipelines.pack.stage import encode

    return encode(dataset, item, config, out)


def items(dataset: Dataset) -> list[str]:
    """List the one item: the shards of all subjects."""
    return ["shards"] if dataset.subjects() else []


def inputs(dataset: Dataset, item: str, config: PackConfig) -> dict[str, Path | str]:
    """Name the encoded and the excluded subjects."""
    from express50.capture.readers.read import read_people
    from pipelines.pack.card import people_lines

    found: dict[str, Path | str] = {}
    for subject in dataset.subjects():
        if (reason := exclusion_reason(dataset, subject)) is not None:
            found[f"{subject} excluded"] = reason
            continue
        folder = dataset.item_dir("encode", subject)
        for name in ("manifest.json", "metrics.json"):
            if (folder / name).exists():
                found[f"{subject} {name}"] = folder / name
    # Like the card, the receipt keeps nothing about people if there are too few.
    return found | {"people": "\n".join(people_lines(read_people(dataset, included(dataset))))}


def run(dataset: Dataset, item: str, config: PackConfig, out: Path) -> Result:
    """Gather the shards, and write index, manifest, splits and card."""
    from pipelines.pack.stage import pack

    return pack(dataset, config, out)


ENCODE = Stage(
    name="encode",
    version=2,
    config=EncodeConfig,
    presets=ENCODE_PRESETS,
    items=included,
    inputs=encode_inputs,
    run=encode_run,
    help="crop and encode each subject's samples (pack runs this first)",
    purpose="Each subject's samples, cropped to the head and encoded.",
    growth=Growth(
        items=("subjects",),
        time=("expressions", "views", "picture"),
        disk=("expressions", "views"),
        side=2 * EncodeConfig.size,  # if the head fills half of a picture
    ),
)

STAGE = Stage(
    name="pack",
    version=13,
    config=PackConfig,
    presets={"draft": {}, "standard": {}, "reference": {}},
    items=items,
    inputs=inputs,
    run=run,
    help="gather all samples into shards with splits and a dataset card",
    purpose="Samples packed into shards.",
    runs_first=(ENCODE.name,),
    growth=Growth(items=(), time=("subjects", "expressions", "views"), disk=("subjects",)),
)
