"""Encode a subject's samples; gather all subjects' shards with splits, card and contact sheet."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from express50.capture.demographics import people_lines
from express50.capture.readers.read import read_people
from express50.console import count
from express50.contract.layout import Dataset, exclusion_reason
from express50.contract.stage import Note, Result
from express50.errors import UNREADABLE, FormatError, StageError, advised, few
from express50.files.atomic import write_json
from express50.files.images import write_image
from express50.files.text import read_json_table
from express50.geometry.pixels import contact_sheet
from express50.shards.reader import ShardReader, sample_panels, write_offsets, write_registered
from express50.shards.writer import ShardWriter, gather_shards, write_manifest
from pipelines.pack.sample import encode_sample, load_sample, read_subject

SHARD_BYTES = 256_000_000  # a shard is closed at this size; an expression is never split
QC_SAMPLES = 12
ON_CARD = ("subject", "expression", "camera", "label", "licence", "consent", "head", "parts")


def encode(
    dataset: Dataset, name: str, out: Path, *, size: int, profile: str, even_colour: bool,
    torso: str, min_confidence: float,
) -> Result:  # fmt: skip
    """Write one subject's shards, index and manifest.

    Raises:
        StageError: no sample of the subject can be encoded.
        FormatError, CaptureError: what its samples share cannot be read.
    """
    cv2.setNumThreads(1)
    subject = read_subject(dataset, name)
    if not even_colour:
        subject = replace(subject, gains={})
    writer = ShardWriter(out, SHARD_BYTES)
    metas: list[dict] = []
    dropped: list[Note] = []
    without_depth = 0
    for expression in sorted(subject.peaks):
        group = []
        for camera_id, camera in sorted(subject.cameras.items()):
            try:
                loaded = load_sample(
                    dataset, subject, expression, camera, torso == "remove", min_confidence
                )
                sample, meta = encode_sample(loaded, subject, expression, camera, size, profile)
            except UNREADABLE as error:
                dropped.append(Note(f"{name}/{expression}/{camera_id}", str(error)))
                continue
            group.append(sample)
            metas.append(meta)
            without_depth += not loaded.valid.any()
        if group:
            writer.add_group("subject", group)
    writer.close()
    if not metas:
        why = "; ".join(sorted({note.why for note in dropped})[:3])
        raise StageError(f"none of its {len(dropped)} samples can be packed ({why})")
    # Stored once per subject, not with every sample.
    if subject.track.offsets.any():
        write_offsets(out, name, subject.track.offsets)
    if subject.registered:
        meshes = {key: (one.offsets, one.sigma) for key, one in subject.registered.items()}
        write_registered(out, name, meshes)
    write_manifest(out, writer.digests)
    metrics = {
        "read": len(metas) + len(dropped),
        "kept": len(metas),
        "with_parts": sum(meta["parts"] for meta in metas),
        "torso_removed": sum(meta["torso"] == "removed" for meta in metas),
        "registered": sum(meta["track"]["registered"] for meta in metas),
        "size": size,
        "profile": profile,
    }
    warnings = warn_of_gaps(metas) + subject.notes
    if without_depth:
        why = f"{without_depth} of {count(len(metas), 'sample')} have no depth"
        if min_confidence > 0:
            why += f"; lower encode.min_confidence, which is {min_confidence:g}"
        warnings.append(Note("depth", why))
    return Result(metrics, dropped, warnings)


def warn_of_gaps(metas: list[dict]) -> list[Note]:
    """Warn of a subject's samples without labels of parts, and without consent or licence."""
    warnings = []
    if bare := sum(not meta["parts"] for meta in metas):
        why = (
            f"{bare} of {len(metas)} samples have no labels of parts, and their alpha holds the"
            " torso; run 'express50 regions', then pack again"
        )
        warnings.append(Note("regions", why))
    keys = {"consent": "consent_id", "licence": "licence"}
    if lacking := [keys[key] for key in keys if metas[0][key] is None]:
        why = f"gives no {' and no '.join(lacking)}; the samples will not state it"
        warnings.append(Note("capture.toml", why))
    return warnings


def pack(dataset: Dataset, out: Path, test_subjects: Sequence[str], test_fraction: float) -> Result:
    """Gather the encoded subjects' shards; write index, manifest, splits and card.

    Raises:
        StageError: no subject is encoded, or the split is impossible.
        FormatError: a subject's shards are damaged.
    """
    accounts, dropped = _read_accounts(dataset)
    if not accounts:
        why = "; ".join(f"{note.what}: {note.why}" for note in dropped[:3])
        raise StageError(f"shards: no subject can be packed ({why}); run the earlier stages")
    splits = split_subjects(list(accounts), test_subjects, test_fraction)
    sources = [(dataset.item_dir("encode", n), split) for split in splits for n in splits[split]]
    digests = gather_shards(sources, out)
    how = "named" if test_subjects else "hash of the subject's id"
    write_json(out / "splits.json", splits | {"chosen_by": how})
    reader = ShardReader(out)
    totals = _totals(out, reader, accounts)
    rows = [row for account in accounts.values() for row in account["dropped"]]
    left_out = dropped + [Note(row["what"], row["why"]) for row in rows]
    people = read_people(dataset, sorted(accounts))
    # All metas of a large dataset would fill the memory.
    metas = (reader.meta(number) for number in range(len(reader)))
    shown = [{key: meta[key] for key in ON_CARD} for meta in metas]
    card = write_card(splits, shown, left_out, totals, people)
    (out / "card.md").write_text(card, encoding="utf-8")
    by_split = {name: sum(entry.split == name for entry in reader.entries) for name in splits}
    coverage = _write_contact_sheet(out, reader)
    reader.close()
    write_manifest(out, digests)
    metrics = totals | {"samples_by_split": by_split, "depth_coverage": coverage}
    again = "run 'express50 pack' without a subset"
    mixed = [key for key in ("size", "profile") if "," in totals[key]]
    warnings = [Note(key, f"subjects were encoded with {totals[key]}; {again}") for key in mixed]
    if not test_subjects:
        warnings += warn_of_temporary_test_subjects(splits["test"], test_fraction)
    return Result(metrics, dropped, warnings)


def warn_of_temporary_test_subjects(test: Sequence[str], fraction: float) -> list[Note]:
    """Warn of a test subject that was chosen only because no id's hash is below the fraction."""
    why = (
        "moves to training as soon as a subject whose id has a lower hash is added; to keep it in"
        " the test split, name it in pack.test_subjects"
    )
    return [Note(name, why) for name in test if split_position(name) >= fraction]


def _read_accounts(dataset: Dataset) -> tuple[dict[str, dict], list[Note]]:
    """Read the metrics of every encoded subject; a note explains each subject left out."""
    accounts, dropped = {}, []
    for name in dataset.subjects():
        metrics = dataset.item_dir("encode", name) / "metrics.json"
        if (reason := exclusion_reason(dataset, name)) is not None:
            dropped.append(Note(name, f"excluded: {reason}"))
        elif not metrics.is_file():
            run_encode = advised("express50 encode", dataset.root)
            dropped.append(Note(name, f"not encoded; run {run_encode} to see why"))
        else:
            accounts[name] = read_json_table(metrics, FormatError)
    return accounts, dropped


def _totals(out: Path, reader: ShardReader, accounts: Mapping[str, dict]) -> dict[str, Any]:
    """Add up the subjects' accounts and the sizes of their shards."""
    shards = {entry.shard for entry in reader.entries}
    size = sum((out / shard).stat().st_size for shard in shards)
    summed = ("read", "kept", "with_parts", "torso_removed", "registered")
    kinds = {key: {str(one[key]) for one in accounts.values()} for key in ("size", "profile")}
    return {key: sum(one[key] for one in accounts.values()) for key in summed} | {
        "shards": len(shards),
        "bytes": size,
        "bytes_per_sample": round(size / len(reader)),
        **{key: ", ".join(sorted(values)) for key, values in kinds.items()},
    }


def _write_contact_sheet(out: Path, reader: ShardReader) -> float:
    """Draw evenly chosen samples; returns the share of their mattes that has depth."""
    columns, covered, keys = [], [], []
    for number in np.unique(np.linspace(0, len(reader) - 1, QC_SAMPLES).astype(int)):
        sample = reader.sample(int(number))
        inside = sample["alpha"] > 0.5
        covered.append(float(sample["valid"][inside].mean()) if inside.any() else 0.0)
        columns.append(sample_panels(sample))
        keys.append(sample["key"])
    (out / "qc").mkdir(exist_ok=True)
    rows = [list(row) for row in zip(*columns, strict=True)]
    sheet = contact_sheet(rows, ["rgb", "alpha", "depth", "parts"], (160, 160), keys)
    write_image(out / "qc" / "samples.jpg", sheet, quality=90)
    return round(float(np.mean(covered)), 4)


def split_subjects(
    subjects: Sequence[str], test_subjects: Sequence[str], fraction: float
) -> dict[str, list[str]]:
    """Divide the subjects into ``train`` and ``test``; no subject is in both.

    Without named test subjects a hash of each subject's id decides, so that a subject stays in its
    split when others join. If no hash of two or more falls below the fraction, the lowest is
    chosen, unless the fraction is 0. It returns to training when a lower one joins.

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
    totals: Mapping[str, Any],
    people: Sequence[Mapping],
) -> str:
    """Write the datasheet of the packed samples, of which these are the metas, as Markdown.

    ``dropped`` are samples and subjects that were left out, with reasons; ``totals`` are of all
    that were encoded. ``people`` are the facts in capture.toml; they are counted, never quoted.
    """
    subjects = sorted({meta["subject"] for meta in metas})
    expressions = sorted({meta["expression"] for meta in metas})
    cameras = sorted({meta["camera"] for meta in metas})
    counts = Counter((meta["subject"], meta["expression"]) for meta in metas)
    by_annotator = Counter(str(meta["label"].get("annotator", "unknown")) for meta in metas)
    labellers = [f"{name} ({count(n, 'sample')})" for name, n in sorted(by_annotator.items())]
    lines = [
        "# Dataset card",
        "",
        f"{count(len(metas), 'sample')} of {count(len(subjects), 'subject')} x"
        f" {count(len(expressions), 'expression')} x {count(len(cameras), 'camera')}: colour,"
        " matte, depth, camera and head-model parameters of one peak frame per expression.",
        "",
        "| | |",
        "|---|---|",
        f"| picture size | {totals['size']} pixels square |",
        f"| profile | {totals['profile']} |",
        f"| labels of parts | {totals['with_parts']} of {totals['kept']} samples |",
        f"| torso removed | {totals['torso_removed']} of {totals['kept']} samples |",
        f"| registered mesh | {totals['registered']} of {totals['kept']} samples |",
        f"| shards | {totals['shards']}, {totals['bytes'] / 1e6:.1f} MB |",
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
    lines += [f"- {n} x {why}" for why, n in sorted(reasons.items())] or ["Nothing."]
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


def _values(metas: Sequence[Mapping], key: str) -> str:
    found = sorted({str(meta[key]) if meta[key] is not None else "not stated" for meta in metas})
    return few(found, 5)
