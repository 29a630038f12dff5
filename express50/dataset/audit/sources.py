"""Captures, labels and settings of a dataset: what stages start from."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from express50.capture.demographics import PUBLIC_KEYS
from express50.capture.index import index_path
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset, footage_root
from express50.contract.stage import Stage
from express50.dataset.audit.finding import Finding
from express50.errors import AnnotationError, ConfigError, Express50Error

WRONG_LABELS = ("identity", "window", "unknown", "unreadable")


def capture_findings(dataset: Dataset) -> Iterator[Finding]:
    """Captures that are gone, and subjects whose capture is not registered."""
    captures = dataset.captures()
    for subject, path in captures.items():
        try:
            why = "" if path.exists() and footage_root(path) else f"its capture {path} is gone"
        except Express50Error as error:
            why = str(error)
        if why:
            mend = f"express50 ingest {dataset.root} CAPTURE, with the place where it is now"
            yield Finding(kind="capture", what=f"captures.json {subject}", why=why, mend=mend)
    for subject in dataset.subjects():
        if subject not in captures:
            yield Finding(
                kind="capture",
                what=f"ingest {subject}",
                why="captures.json does not say where its capture is",
                mend=f"express50 ingest {dataset.root} CAPTURE",
            )


def label_findings(
    dataset: Dataset, problems: Callable[[Dataset, list[str]], Iterable[Any]]
) -> Iterator[Finding]:
    """Labels that point at frames, cameras or expressions that are not there.

    Args:
        dataset: the dataset.
        problems: what checks the labels of subjects against their footage.
    """
    known = set(dataset.subjects())
    for path in sorted((dataset.root / "labels").glob("*.jsonl")):
        name, subject = f"labels/{path.name}", path.stem
        if subject not in known:
            mend = "ingest the subject, or move the file away"
            why = f"labels of {subject}, which is not ingested"
            yield Finding(kind="label", what=name, why=why, mend=mend)
            continue
        try:
            found = [p for p in problems(dataset, [subject]) if p.kind in WRONG_LABELS]
        except AnnotationError as error:
            why = str(error).removeprefix(f"{path}: ")
            yield Finding(kind="label", what=name, why=why, mend="restore the file")
            continue
        except Express50Error:  # the index is damaged: a finding of its own
            continue
        for problem in found:
            yield Finding(
                kind="label",
                what=f"{name} {problem.expression}",
                why=problem.what,
                mend=f"express50 annotate ui {dataset.root}: undo it and mark the frame again "
                "(labels are people's work and are never rewritten)",
            )


def saved_config(dataset: Dataset, stage: Stage, known: Iterable[str]) -> Any | Finding:
    """The configuration that a stage last ran with, or what is wrong with its file."""
    path = dataset.config_file(stage.name)
    try:
        return resolve_config(stage, "standard", path, (), known)
    except ConfigError as error:
        return Finding(
            kind="config",
            what=f"config/{path.name}",
            why=str(error).removeprefix("--config "),
            mend=f"express50 {stage.name} {dataset.root}, with the settings that you want",
        )


def personal_keys(dataset: Dataset, subject: str) -> list[str]:
    """What a subject's index says of the person that it must not: keys of its ``meta``."""
    try:
        meta = json.loads(index_path(dataset, subject).read_text(encoding="utf-8"))["meta"]
        return sorted(set(meta) - PUBLIC_KEYS)
    except (OSError, ValueError, KeyError, TypeError):
        return []  # not there or damaged: found elsewhere


def leftovers(dataset: Dataset, stage: str) -> list[Path]:
    """Unfinished outputs of runs that were killed."""
    return sorted(dataset.staging_dir.glob(f"{stage}-*"))
