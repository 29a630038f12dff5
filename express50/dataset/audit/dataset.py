"""Audit a whole dataset: captures, labels, ledger, every stage, and traces of withdrawn people."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from express50.contract.layout import Dataset, footage_root
from express50.contract.stage import Stage
from express50.dataset.audit.finding import Audit, Finding
from express50.dataset.audit.stages import StageAudit
from express50.dataset.id_search import files_that, names_any_of, says
from express50.dataset.withdraw import withdrawn
from express50.errors import AnnotationError, Express50Error, FormatError
from express50.runner.ledger import Ledger
from express50.runner.publish import hold_stages

WRONG_LABELS = ("identity", "window", "unknown", "unreadable")
LabelProblems = Callable[[Dataset, list[str]], Iterable[Any]]


def audit(
    dataset: Dataset,
    stages: Sequence[Stage],
    *,
    deep: bool = False,
    fix: bool = False,
    label_problems: LabelProblems = lambda dataset, subjects: (),
    checkpoints: Sequence[Path] = (),
) -> Audit:
    """Check everything that the ledger knows, and set aside what can be made again.

    Args:
        dataset: the dataset.
        stages: its stages in order.
        deep: read every output's bytes; else only of files whose time of change is another.
        fix: set wrong outputs aside and forget their receipts; nothing is deleted that no stage
            can make again.
        label_problems: checks the labels of subjects against their footage; records with ``kind``,
            ``expression`` and ``what``.
        checkpoints: files outside the dataset in which no withdrawn person may be named.

    Raises:
        StageError: a stage that is to be fixed is running.
    """
    dataset, result = Dataset(dataset.root.resolve()), Audit()
    with hold_stages(dataset, [stage.name for stage in stages]) if fix else nullcontext():
        # First, as a fix takes away what labels are compared with.
        result.findings += _capture_findings(dataset)
        result.findings += _label_findings(dataset, label_problems)
        if what := _ledger_fault(dataset):
            result.findings.append(_ledger_finding(dataset, what, fix))
        else:
            with _open_ledger(dataset) as ledger:
                StageAudit(dataset, stages, ledger, result, deep, fix).run()
        result.findings += _person_findings(dataset, checkpoints)
    stale = [path for path in dataset.stale_dir.rglob("*") if path.is_file()]
    if stale:
        size = sum(path.stat().st_size for path in stale) / 1e6
        result.notes.append(
            f".stale: {len(stale)} files, {size:.1f} MB, of outputs set aside earlier, which"
            " nothing reads; making an item again removes its own"
        )
    return result


def _capture_findings(dataset: Dataset) -> Iterator[Finding]:
    """Find captures that are gone, and subjects whose capture is not registered."""
    try:
        captures = dataset.captures()
    except FormatError as error:
        yield Finding(kind="capture", where="captures.json", what=str(error), fix="restore it")
        return
    fix = f"express50 ingest {dataset.root} CAPTURE, with its present place"
    for subject, path in captures.items():
        try:
            what = "" if path.exists() and footage_root(path) else f"its capture {path} is gone"
        except Express50Error as error:
            what = str(error)
        if what:
            yield Finding(kind="capture", where=f"captures.json {subject}", what=what, fix=fix)
    for subject in sorted(set(dataset.subjects()) - set(captures)):
        what = "captures.json does not name its capture"
        yield Finding(kind="capture", where=f"ingest {subject}", what=what, fix=fix)


def _label_findings(dataset: Dataset, problems: LabelProblems) -> Iterator[Finding]:
    """Find labels that point at frames, cameras or expressions that do not exist."""
    known = set(dataset.subjects())
    for path in sorted((dataset.root / "labels").glob("*.jsonl")):
        where, subject = f"labels/{path.name}", path.stem
        if subject not in known:
            what, fix = f"{subject} is not ingested", "ingest the subject, or move the file away"
            yield Finding(kind="label", where=where, what=what, fix=fix)
            continue
        try:
            found = [p for p in problems(dataset, [subject]) if p.kind in WRONG_LABELS]
        except AnnotationError as error:
            yield Finding(kind="label", where=where, what=str(error), fix="restore the file")
            continue
        except Express50Error:  # the index is damaged, which is a finding of its own
            continue
        fix = (
            f"express50 annotate ui {dataset.root}: undo it and mark the frame again (labels are"
            " people's work and are never rewritten)"
        )
        for one in found:
            yield Finding(kind="label", where=f"{where} {one.expression}", what=one.what, fix=fix)


def _open_ledger(dataset: Dataset) -> Ledger:
    """Open the ledger, read-only where its folder is: such a connection leaves journals behind."""
    return Ledger(dataset.ledger, read_only=not os.access(dataset.root, os.W_OK))


def _ledger_fault(dataset: Dataset) -> str:
    """Return what is wrong with the ledger's file; empty when nothing is."""
    if not dataset.ledger.is_file():
        return "is missing; without it every output counts as made by nobody"
    try:
        with _open_ledger(dataset) as ledger:
            ledger.check_whole()
    except FormatError as error:
        return str(error)
    return ""


def _ledger_finding(dataset: Dataset, what: str, fix: bool) -> Finding:
    """Rename an unreadable ledger and its journals, so that stages start a new one."""
    again = f"express50 run {dataset.root}: every item is made again, to the same bytes"
    if dataset.ledger.exists():
        aside = f"ledger.sqlite.unreadable-{int(time.time())}"
        for ending in ("", "-wal", "-shm") if fix else ():
            path = dataset.root / f"ledger.sqlite{ending}"
            if path.exists():
                path.rename(dataset.root / f"{aside}{ending}")
        again = f"set aside as {aside}; {again}" if fix else f"--fix, then {again}"
    return Finding(kind="ledger", where="ledger.sqlite", what=what, fix=again, fixed=fix)


def _person_findings(dataset: Dataset, checkpoints: Sequence[Path]) -> Iterator[Finding]:
    if not (digests := withdrawn(dataset)):
        return
    test = names_any_of(digests)
    for path in [*files_that(test, dataset.root), *(p for p in checkpoints if says(p, test))]:
        inside = path.is_relative_to(dataset.root)
        yield Finding(
            kind="person",
            where=str(path.relative_to(dataset.root) if inside else path),
            what="names a person who was withdrawn",
            fix=f"express50 subject withdraw {dataset.root} ID --yes again (--checkpoint for one "
            "outside the dataset), or delete it",
        )
