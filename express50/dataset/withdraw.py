"""Withdraw a subject: remove all that the dataset holds of a person, then search for the rest.

Whatever mixes subjects (packed shards, reports, trained models' pictures) is removed whole and made
again without the person by running its command; others' outputs that name the person go too. A
checkpoint loses the person's codes and frames; only a new training removes what its other
weights learned. The raw capture lies outside the dataset and stays its owner's task.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from express50.contract.layout import Dataset
from express50.dataset.id_search import files_naming, names, says
from express50.errors import FormatError, StageError
from express50.files.atomic import write_json
from express50.files.digests import text_digest
from express50.files.text import NAME, read_json
from express50.runner.ledger import Ledger
from express50.runner.publish import hold_stages

Redact = Callable[[Path, str], bool]


@dataclass(frozen=True)
class Withdrawal:
    """Lists what was removed, which checkpoints changed, and which files still name the subject."""

    subject: str
    capture: Path | None
    removed: tuple[Path, ...]
    checkpoints: tuple[Path, ...]
    remaining: tuple[Path, ...]
    files: int


def plan(dataset: Dataset, subject: str) -> list[Path]:
    """List files and folders of a dataset to remove so that nothing of a subject stays.

    Raises:
        StageError: the dataset knows no such subject.
    """
    known = {*dataset.captures(), *dataset.subjects()}
    labelled = NAME.fullmatch(subject) and dataset.labels_file(subject).is_file()
    # Nothing else may pass: '', '..' or 'shards' would name other folders than a person's.
    if not (subject in known or labelled or text_digest(subject) in withdrawn(dataset)):
        there = ", ".join(sorted(known)) or "none"
        raise StageError(f"{dataset.root}: no subject {subject!r}; subjects: {there}")
    own = sorted(_own_paths(dataset, subject))
    paths = own + sorted(_mixed_paths(dataset))
    return paths + sorted(_naming_items(dataset, subject, paths))


def _own_paths(dataset: Dataset, subject: str) -> Iterator[Path]:
    for base in (dataset.root, dataset.stale_dir):
        yield from (path for path in base.glob(f"*/{subject}") if path.is_dir())
    if dataset.labels_file(subject).exists():
        yield dataset.labels_file(subject)
    reference = dataset.root / "labels" / "reference.json"
    if reference.is_file():
        with suppress(FormatError):
            table = read_json(reference, FormatError)
            if isinstance(table, dict) and subject in map(str, table.values()):
                yield reference  # the next subject becomes the reference
    test = names(subject)
    # Settings such as pack.test_subjects; the stage's next run writes its own.
    yield from (p for p in (dataset.root / "config").glob("*.toml") if says(p, test))
    for path in (dataset.root / "logs").glob("*/*.txt"):
        if path.stem.split("+")[0] == subject:
            yield path


def _mixed_paths(dataset: Dataset) -> Iterator[Path]:
    """Yield outputs that may hold several subjects: mixed items, reports, leftovers."""
    subjects = {*dataset.captures(), *dataset.subjects()}
    yield from dataset.slurm_dir.glob("*.out")
    for base in (dataset.root, dataset.stale_dir):
        for metrics in base.glob("*/*/metrics.json"):
            if metrics.parent.name not in subjects and base.joinpath("grmm") not in metrics.parents:
                yield metrics.parent
    yield from (p for p in (dataset.report_dir, dataset.root / "accuracy") if p.exists())
    yield from (path for path in dataset.staging_dir.glob("*") if path.is_dir())
    for path in (dataset.root / "grmm").rglob("*"):  # pictures and figures of whoever was trained
        if path.is_file() and path.suffix != ".pt":
            yield path


def _naming_items(dataset: Dataset, subject: str, gone: list[Path]) -> Iterator[Path]:
    """Yield others' outputs that name the subject: their reference's, or whose plate stood in."""
    for path in files_naming(dataset.root, subject):
        parents = [path, *path.parents]
        if not set(parents).isdisjoint(gone):
            continue
        for folder in parents:
            depth = len(folder.relative_to(dataset.root).parts) if folder != dataset.root else 0
            if depth in (2, 3) and (folder / "metrics.json").is_file():
                yield folder
                gone = [*gone, folder]
                break
            if depth == 0:
                break


def withdraw(
    dataset: Dataset,
    subject: str,
    checkpoints: Sequence[Path] = (),
    redact: Redact = lambda path, subject: False,
) -> Withdrawal:
    """Remove a subject and search what is left for its id.

    A record of it is kept (`withdrawn_file`), so that ingest refuses to take the person in again.

    Args:
        dataset: the dataset.
        subject: id.
        checkpoints: files outside the dataset to redact, beside those below ``grmm``.
        redact: removes a subject from a checkpoint, True where it was in there.

    Raises:
        StageError: the dataset knows no such subject, or a stage runs.
        FormatError: the ledger is damaged; then nothing was removed.
    """
    with hold_stages(dataset, sorted(p.stem for p in (dataset.root / "config").glob("*.toml"))):
        paths = plan(dataset, subject)
        if dataset.ledger.is_file():
            # Before anything is removed: half a withdrawal cannot be repeated.
            with Ledger(dataset.ledger) as ledger:
                ledger.check_whole()
        captures = dataset.captures()
        capture = captures.pop(subject, None)
        files = sum(1 if p.is_file() else sum(q.is_file() for q in p.rglob("*")) for p in paths)
        _record(dataset, subject, files)
        for path in paths:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        write_json(dataset.captures_file, {name: str(path) for name, path in captures.items()})
        if dataset.ledger.is_file():
            with Ledger(dataset.ledger) as ledger:
                ledger.erase(subject, dataset.root, paths, names(subject))
        changed, own = [], sorted((dataset.root / "grmm").rglob("*.pt"))
        for path in [*own, *(path for path in checkpoints if path.is_file())]:
            with suppress(FormatError):  # not a GRMM checkpoint: searched for the id below
                if redact(path, subject):
                    changed.append(path)
    test = names(subject)
    remaining = [
        *files_naming(dataset.root, subject),
        *(path for path in checkpoints if path.is_file() and says(path, test)),
    ]
    return Withdrawal(subject, capture, tuple(paths), tuple(changed), tuple(remaining), files)


def withdrawn_file(dataset: Dataset) -> Path:
    """Return the file of withdrawals' records."""
    return dataset.root / "withdrawn.json"


def _record(dataset: Dataset, subject: str, files: int) -> None:
    """Note when somebody was withdrawn and how many files went; the id only as a digest."""
    path = withdrawn_file(dataset)
    rows = _withdrawals(path) if path.is_file() else []
    time = datetime.now(UTC).isoformat(timespec="seconds")
    write_json(path, [*rows, {"id_sha256": text_digest(subject), "time": time, "files": files}])


def withdrawn(dataset: Dataset) -> set[str]:
    """Return the SHA-256 of withdrawn subjects' ids; the ids themselves are not kept."""
    path = withdrawn_file(dataset)
    if not path.is_file():
        return set()
    return {_digest(row) for row in _withdrawals(path)}


def _withdrawals(path: Path) -> list:
    """Read the records of withdrawals; old ones are digests alone, without time and count."""
    fix = "restore it: it says who must not be taken in again"
    rows = read_json(path, FormatError, fix)
    if not isinstance(rows, list) or not all(isinstance(_digest(row), str) for row in rows):
        raise FormatError(f"{path}: expected a list of digests; {fix}")
    return rows


def _digest(row: Any) -> Any:
    return row.get("id_sha256") if isinstance(row, dict) else row
