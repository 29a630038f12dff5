"""The align stage finds, for every expression, the frame that matches the reference's.

Item: a subject. Its observations are compared with the reference identity's labels or peaks. A
suggestion of enough confidence is accepted automatically, in the label store that annotators
write to, under the name ``auto``; a person's label always ranks above it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from annotations.labels import human_digest
from annotations.observe import STAGE as OBSERVE
from annotations.suggestions import reference_subject
from express50.contract.config import check_ranges
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage


@dataclass(frozen=True, kw_only=True)
class AlignConfig:
    """Settings of the align stage."""

    accept: float = 0.0
    """Accept suggestions with at least this confidence automatically, 0 (all) to 1 (none)."""
    match: bool = True
    """Match to the reference person's canonical frames; false takes each subject's own peak."""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_ranges("align", self, accept=(0, 1))


def inputs(dataset: Dataset, item: str, config: AlignConfig) -> dict[str, Path | str]:
    """List the index, observations and human labels of the subject and of the reference."""
    read: dict[str, Path | str] = {}
    subjects = {"": item}
    if config.match and (other := reference_subject(dataset)) != item:
        read["reference"] = subjects["reference_"] = other
    for prefix, subject in subjects.items():
        observations = dataset.observations_file(subject)
        read[f"{prefix}index"] = dataset.index_file(subject)
        read[f"{prefix}observe"] = observations if observations.is_file() else "absent"
        read[f"{prefix}labels"] = human_digest(dataset, subject)
    return read


def run(dataset: Dataset, item: str, config: AlignConfig, out: Path) -> Result:
    """Suggest, accept and write ``suggestions.json``, ``peaks.json`` and a contact sheet."""
    from annotations.align.stage import run as work

    return work(dataset, item, out, **vars(config))


STAGE = Stage(
    name="align",
    version=9,
    config=AlignConfig,
    items=Dataset.subjects,
    inputs=inputs,
    run=run,
    help="suggest each expression's peak frame, matched to the reference, and accept it",
    purpose="The peak frame of every expression, with the first and last frame of its cue window.",
    runs_first=(OBSERVE.name,),
    growth=Growth(items=("subjects",), time=("frames",), disk=("frames",)),
)
