"""Write the shards of the whole dataset with splits, checksums, card and contact sheet."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from express50.capture.readers.read import read_people
from express50.contract.layout import Dataset, exclusion_reason
from express50.contract.stage import Note, Result
from express50.errors import CaptureError, FormatError, StageError
from express50.files.atomic import write_json
from express50.files.images import contact_sheet, write_image
from express50.shards.reader import ShardReader, sample_panels, write_offsets, write_registered
from express50.shards.writer import PackedSample, ShardWriter, write_manifest
from pipelines.pack.card import split_subjects, write_card
from pipelines.pack.config import PackConfig
from pipelines.pack.sample import PackedSubject, encode_sample, load_sample, read_subject

SHARD_BYTES = 256_000_000  # a shard is closed at this size; an expression is never split
QC_SAMPLES = 12

Pair = tuple[PackedSample, dict]
"""A sample and the content of its meta.json."""


def run(dataset: Dataset, config: PackConfig, out: Path) -> Result:
    """Write shards, index, manifest, splits and card.

    Raises:
        StageError: no sample can be packed, or the split is impossible.
    """
    cv2.setNumThreads(1)
    subjects, dropped = _read_subjects(dataset)
    read = len(dropped)
    if not subjects:
        why = "; ".join(f"{note.what}: {note.why}" for note in dropped[:3])
        raise StageError(f"shards: no subject can be packed ({why}); run the earlier stages")
    names = [subject.name for subject in subjects]
    splits = split_subjects(names, config.test_subjects, config.test_fraction)
    writer = ShardWriter(out, SHARD_BYTES)
    metas: list[dict] = []
    for split, chosen in splits.items():
        for subject in (one for one in subjects if one.name in chosen):
            for expression in sorted(subject.peaks):
                group, left_out = _pack_group(dataset, subject, expression, config)
                read += len(group) + len(left_out)
                dropped += left_out
                if group:
                    writer.add_group(split, [sample for sample, _ in group])
                metas += [meta | {"split": split} for _, meta in group]
    writer.close()
    if not metas:
        why = "; ".join(sorted({note.why for note in dropped})[:3])
        raise StageError(f"shards: none of {read} samples can be packed ({why})")
    packed = sorted({meta["subject"] for meta in metas})
    for subject in (one for one in subjects if one.name in packed):
        _write_subject_files(out, subject)
    how = "named" if config.test_subjects else "hash of the subject's id"
    write_json(out / "splits.json", splits | {"chosen_by": how})
    reader = ShardReader(out)
    shards = sorted({entry.shard for entry in reader.entries})
    size = sum((out / shard).stat().st_size for shard in shards)
    with_parts = sum(meta["parts"] for meta in metas)
    bare = sum(meta["torso"] == "removed" for meta in metas)
    registered = sum(meta["track"]["registered"] for meta in metas)
    statistics = {
        "picture size": f"{config.size} x {config.size}",
        "profile": config.profile,
        "labels of parts": f"{with_parts} of {len(metas)} samples",
        "torso removed": f"{bare} of {len(metas)} samples",
        "registered mesh": f"{registered} of {len(metas)} samples",
        "shards": f"{len(shards)}, {size / 1e6:.1f} MB",
    }
    card = write_card(splits, metas, dropped, statistics, read_people(dataset, packed))
    (out / "card.md").write_text(card, encoding="utf-8")
    metrics = {
        "read": read,
        "kept": len(metas),
        "shards": len(shards),
        "bytes": size,
        "bytes_a_sample": round(size / len(metas)),
        "samples_by_split": {s: sum(meta["split"] == s for meta in metas) for s in splits},
        "depth_coverage": _write_contact_sheet(out, reader),
        "with_parts": with_parts,
        "torso_removed": bare,
        "registered": registered,
    }
    reader.close()
    write_manifest(out, writer.digests)
    notes = [note for subject in subjects for note in subject.notes]
    return Result(metrics, dropped, warn_of_gaps(metas) + notes)


def _read_subjects(dataset: Dataset) -> tuple[list[PackedSubject], list[Note]]:
    """Read all subjects that can be packed; a note says why another one is left out."""
    subjects, dropped = [], []
    for name in dataset.subjects():
        if (reason := exclusion_reason(dataset, name)) is not None:
            dropped.append(Note(name, f"excluded: {reason}"))
            continue
        try:
            subjects.append(read_subject(dataset, name))
        except (StageError, FormatError, CaptureError) as error:
            dropped.append(Note(name, str(error)))
    return subjects, dropped


def _write_subject_files(out: Path, subject: PackedSubject) -> None:
    """Write what is stored once per subject, not with every sample."""
    if subject.offsets is not None:
        write_offsets(out, subject.name, subject.offsets)
    if meshes := {name: (one.offsets, one.sigma) for name, one in subject.registered.items()}:
        write_registered(out, subject.name, meshes)


def _pack_group(
    dataset: Dataset, subject: PackedSubject, expression: str, config: PackConfig
) -> tuple[list[Pair], list[Note]]:
    """Pack all cameras of one expression; a note says why a camera is left out."""
    group, dropped = [], []
    for camera_id, camera in sorted(subject.cameras.items()):
        try:
            loaded = load_sample(dataset, subject, expression, camera, config)
            group.append(encode_sample(loaded, subject, expression, camera, config))
        except (CaptureError, FormatError, StageError) as error:
            dropped.append(Note(f"{subject.name}/{expression}/{camera_id}", str(error)))
    return group, dropped


def warn_of_gaps(metas: list[dict]) -> list[Note]:
    """Warn of samples without labels of parts, and of subjects without consent or licence."""
    warnings = []
    if bare := sum(not meta["parts"] for meta in metas):
        why = (
            f"{bare} of {len(metas)} samples have no labels of parts, and their alpha holds the"
            " torso; run 'express50 regions', then pack again"
        )
        warnings.append(Note("regions", why))
    keys = {"consent": "consent_id", "licence": "licence"}
    lacking = {meta["subject"]: [keys[k] for k in keys if meta[k] is None] for meta in metas}
    return warnings + [
        Note(name, f"capture.toml gives no {' and no '.join(what)}; its samples lack it")
        for name, what in sorted(lacking.items())
        if what
    ]


def _write_contact_sheet(out: Path, reader: ShardReader) -> float:
    """Draw evenly chosen samples; returns the share of their mattes that has depth."""
    columns, covered = [], []
    for number in np.unique(np.linspace(0, len(reader) - 1, QC_SAMPLES).astype(int)):
        sample = reader.sample(int(number))
        inside = sample["alpha"] > 0.5
        covered.append(float(sample["valid"][inside].mean()) if inside.any() else 0.0)
        columns.append(sample_panels(sample))
    (out / "qc").mkdir(exist_ok=True)
    rows = [list(row) for row in zip(*columns, strict=True)]
    sheet = contact_sheet(rows, ["rgb", "alpha", "depth", "parts"], tile=(160, 160))
    write_image(out / "qc" / "samples.jpg", sheet, quality=90)
    return round(float(np.mean(covered)), 4)
