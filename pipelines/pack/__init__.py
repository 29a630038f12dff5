"""Two stages write the shards: encode a subject's samples, and pack all subjects' in one folder.

Encoding is slow and runs per subject; ``express50 pack`` runs it first. Packing gathers the encoded
subjects, so adding or removing a subject does not re-encode the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from express50.console import count
from express50.contract.config import check_ranges
from express50.contract.layout import Dataset, exclusion_reason, included_subjects
from express50.contract.stage import Growth, Result, Stage
from express50.errors import FormatError, few
from express50.files.text import read_json_table


@dataclass(frozen=True, kw_only=True)
class EncodeConfig:
    """Size and codecs of the samples."""

    size: int = 512
    """Side of a sample, pixels, 16 to 8192."""
    profile: Literal["compact", "fast", "lossless"] = "fast"
    """rgb as JPEG q90 4:2:0 (compact), JPEG q95 4:4:4 (fast) or PNG (lossless); alpha, parts and
    depth as PNG, or as zstd and LERC (fast), which decode in a fraction of the time."""
    even_colour: bool = True
    """Divide out the cameras' different response to the same light, where calibration measured
    it."""
    torso: Literal["remove", "keep"] = "remove"
    """remove: alpha omits shoulders and clothes, if regions separated them; keep: it does not."""
    min_confidence: float = 0.0
    """Depth pixels with less confidence count as unknown, 0 to 1; 0.5 keeps bounds up to 2 mm."""

    def __post_init__(self) -> None:
        """Check ranges."""
        check_ranges("encode", self, size=(16, 8192), min_confidence=(0, 1))


@dataclass(frozen=True, kw_only=True)
class PackConfig:
    """Split of the packed subjects."""

    test_subjects: tuple[str, ...] = ()
    """Subjects of the test split; empty: chosen by test_fraction."""
    test_fraction: float = 0.1
    """Share of subjects in the test split, chosen by a hash of their ids; 0: no test split."""

    def __post_init__(self) -> None:
        """Check ranges."""
        check_ranges("pack", self, test_fraction=(0, 0.99))


ENCODE_PRESETS: dict[str, dict[str, object]] = {
    "draft": {"size": 256, "profile": "compact"},
    "reference": {"size": 1024, "profile": "lossless"},
}


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

    return encode(dataset, item, out, **vars(config))


def items(dataset: Dataset) -> list[str]:
    """List the one item: the shards of all subjects."""
    return ["shards"] if dataset.subjects() else []


def inputs(dataset: Dataset, item: str, config: PackConfig) -> dict[str, Path | str]:
    """Name the encoded and the excluded subjects."""
    from express50.capture.demographics import people_lines
    from express50.capture.readers.read import read_people

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
    people = read_people(dataset, included_subjects(dataset))
    return found | {"people": "\n".join(people_lines(people))}


def run(dataset: Dataset, item: str, config: PackConfig, out: Path) -> Result:
    """Gather the shards, and write index, manifest, splits and card."""
    from pipelines.pack.stage import pack

    return pack(dataset, out, **vars(config))


def account(dataset: Dataset, items: Sequence[str]) -> Iterator[str]:
    """Yield a line per split for people: who is kept out of training is easily overlooked."""
    for folder in (dataset.item_dir("pack", item) for item in items):
        splits = read_json_table(folder / "splits.json", FormatError, "pack again")
        metrics = read_json_table(folder / "metrics.json", FormatError, "pack again")
        for split in ("train", "test"):
            who = f" of {few(splits[split])}" if splits[split] else ""
            yield f"  {split}: {count(metrics['samples_by_split'][split], 'sample')}{who}"


ENCODE = Stage(
    name="encode",
    version=5,
    config=EncodeConfig,
    presets=ENCODE_PRESETS,
    items=included_subjects,
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
    version=14,
    config=PackConfig,
    presets={"draft": {}, "standard": {}, "reference": {}},
    items=items,
    inputs=inputs,
    run=run,
    help="gather all samples into shards with splits and a dataset card",
    purpose="Samples packed into shards.",
    runs_first=(ENCODE.name,),
    account=account,
    growth=Growth(items=(), time=("subjects", "expressions", "views"), disk=("subjects",)),
)
