"""Split the subjects, and write the dataset card."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence

from express50.capture.demographics import (
    LEAST_PEOPLE,
    age_counts,
    gender_counts,
    mean_age,
    shown_counts,
)
from express50.contract.stage import Note
from express50.errors import StageError, few


def split_subjects(
    subjects: Sequence[str], test_subjects: Sequence[str], fraction: float
) -> dict[str, list[str]]:
    """Divide the subjects into ``train`` and ``test``; no subject is in both.

    Without named test subjects a hash of each subject's id decides, so that a subject stays in its
    split when others join. Where no hash falls below the fraction, of two or more the one with the
    lowest is chosen, unless the fraction is 0; it returns to training when a lower one joins.

    Raises:
        StageError: a named subject does not exist, or nobody is left to train on.
    """
    unknown = sorted(set(test_subjects) - set(subjects))
    if unknown:
        raise StageError(
            f"pack.test_subjects names {', '.join(unknown)}; expected one or more of"
            f" {', '.join(sorted(subjects))}"
        )
    test = set(test_subjects)
    if not test and fraction > 0 and len(subjects) > 1:
        test = {name for name in subjects if split_position(name) < fraction} or {
            min(subjects, key=split_position)
        }
    train = sorted(set(subjects) - test)
    if not train:
        raise StageError(
            f"all {len(test)} subjects are in the test split; lower pack.test_fraction or name"
            " fewer pack.test_subjects"
        )
    return {"train": train, "test": sorted(test)}


def split_position(subject: str) -> float:
    """Return a subject's place in [0, 1), uniform over ids: a hash of its id."""
    return int.from_bytes(hashlib.sha256(f"0:{subject}".encode()).digest()[:8]) / 2**64


def write_card(
    splits: Mapping[str, Sequence[str]],
    metas: Sequence[Mapping],
    dropped: Sequence[Note],
    statistics: Mapping[str, object],
    people: Sequence[Mapping],
) -> str:
    """Write the datasheet of the packed samples, of which these are the metas, as Markdown.

    ``dropped`` are samples and subjects that were left out, with reasons, ``statistics`` further
    named numbers. ``people`` are the facts in capture.toml; they are counted, never quoted.
    """
    subjects = sorted({meta["subject"] for meta in metas})
    expressions = sorted({meta["expression"] for meta in metas})
    cameras = sorted({meta["camera"] for meta in metas})
    counts = Counter((meta["subject"], meta["expression"]) for meta in metas)
    by_annotator = Counter(str(meta["label"].get("annotator", "unknown")) for meta in metas)
    labellers = [f"{name} ({count} samples)" for name, count in sorted(by_annotator.items())]
    lines = [
        "# Dataset card",
        "",
        f"{len(metas)} samples of {len(subjects)} subjects x {len(expressions)} expressions x"
        f" {len(cameras)} cameras: colour, matte, depth, camera and head-model parameters of one"
        " peak frame per expression.",
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in statistics.items()),
        *(
            f"| {split} subjects | {', '.join(names) or 'none'} |"
            for split, names in splits.items()
        ),
        f"| licence | {_values(metas, 'licence')} |",
        f"| consent | {_values(metas, 'consent')} |",
        f"| head model | {_values(metas, 'head')} |",
        f"| labels by | {', '.join(labellers)} |",
        "",
        "## Cameras packed, by subject and expression",
        "",
        "| expression | " + " | ".join(subjects) + " |",
        "|---" * (len(subjects) + 1) + "|",
    ]
    for expression in expressions:
        row = [str(counts[subject, expression]) for subject in subjects]
        lines.append(f"| {expression} | " + " | ".join(row) + " |")
    lines += ["", "## People", "", *people_lines(people)]
    lines += ["", f"## Left out: {len(dropped)}", ""]
    reasons = Counter(note.why for note in dropped)
    lines += [f"- {count} x {why}" for why, count in sorted(reasons.items())] or ["Nothing."]
    lines += [
        "",
        "## Reading",
        "",
        "Pixels have a corner origin; `K` and `cam_from_world` (OpenCV axes, metres) are in each"
        " `meta.json`, and the head stands in the same world: world = R @ head + t. Depth is camera"
        " z in steps of `depth_scale_m`, 0 where unknown. The people shown may withdraw: see"
        " `express50 subject withdraw`.",
        "",
    ]
    return "\n".join(lines)


def people_lines(people: Sequence[Mapping]) -> list[str]:
    """Count gender and age of the subjects in tables, if enough captures state them."""
    lines = []
    if genders := shown_counts(gender_counts(people)):
        lines += _count_table("gender", genders)
    if mean := mean_age(people):
        lines += [f"Age: {mean[0]:g} years in the mean of {mean[1]} people.", ""]
    if ages := shown_counts(age_counts(people)):
        lines += _count_table("age", ages)
    few = f"Gender and age are not stated, or of fewer than {LEAST_PEOPLE} of {len(people)} people."
    return lines[:-1] or [few]


def _count_table(name: str, counts: Mapping[str, int]) -> list[str]:
    """Draw a table with a bar of one block per person, forty at most."""
    scale = min(1.0, 40 / max(counts.values()))
    rows = [
        f"| {' '.join(value.replace('|', '/').split())} | {count} | {'█' * round(count * scale)} |"
        for value, count in counts.items()
    ]
    return [f"| {name} | subjects | |", "|---|---|---|", *rows, ""]


def _values(metas: Sequence[Mapping], key: str) -> str:
    found = sorted({str(meta[key]) if meta[key] is not None else "not stated" for meta in metas})
    return few(found, 5)
