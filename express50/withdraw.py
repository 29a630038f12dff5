"""Withdrawal of a subject: remove all that the dataset holds of a person, and look whether it did.

Whatever mixes subjects (packed shards, reports) is removed whole and made again without the
person by running its command. The raw capture lies outside the dataset and stays its owner's task.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3
import tarfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from express50.digests import text_digest
from express50.errors import FormatError, StageError
from express50.layout import Dataset
from express50.ledger import Ledger, check_schema
from express50.publish import write_json
from express50.reading import read_json

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".exr", ".tif", ".ply", ".glb"}
CHUNK = 1 << 24


@dataclass(frozen=True)
class Withdrawal:
    """What was (or would be) removed, and which files still name the subject."""

    subject: str
    capture: Path | None
    removed: tuple[Path, ...]
    remaining: tuple[Path, ...]


def plan(dataset: Dataset, subject: str) -> list[Path]:
    """Files and folders of a dataset to remove so that nothing of a subject stays.

    Raises:
        StageError: the dataset knows no such subject.
    """
    own = sorted(_own_paths(dataset, subject))
    if subject not in dataset.captures() and not own:
        known = ", ".join(dataset.captures()) or "none"
        raise StageError(f"{dataset.root}: no subject {subject!r}; subjects: {known}")
    return own + sorted(_mixed_paths(dataset))


def _own_paths(dataset: Dataset, subject: str) -> Iterator[Path]:
    for base in (dataset.root, dataset.stale_dir):
        yield from (path for path in base.glob(f"*/{subject}") if path.is_dir())
    if dataset.labels_file(subject).exists():
        yield dataset.labels_file(subject)
    for path in (dataset.root / "logs").glob("*/*.txt"):
        if path.stem.split("+")[0] == subject:
            yield path


def _mixed_paths(dataset: Dataset) -> Iterator[Path]:
    """Outputs that may hold several subjects: items that are no subject, reports, leftovers."""
    subjects = {*dataset.captures(), *dataset.subjects()}
    for base in (dataset.root, dataset.stale_dir):
        for metrics in base.glob("*/*/metrics.json"):
            if metrics.parent.name not in subjects:
                yield metrics.parent
    if dataset.report_dir.exists():
        yield dataset.report_dir
    yield from (path for path in dataset.staging_dir.glob("*") if path.is_dir())


def withdraw(dataset: Dataset, subject: str) -> Withdrawal:
    """Remove a subject and search what is left for its id.

    The subject's digest is remembered, so that ingest refuses to take the person in again.

    Raises:
        StageError: the dataset knows no such subject.
        FormatError: the ledger is damaged; then nothing was removed.
    """
    paths = plan(dataset, subject)
    _check_ledger(dataset)  # before anything is removed: half a withdrawal could not be repeated
    captures = dataset.captures()
    capture = captures.pop(subject, None)
    write_json(withdrawn_file(dataset), sorted(withdrawn(dataset) | {text_digest(subject)}))
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    write_json(dataset.captures_file, {name: str(path) for name, path in captures.items()})
    _forget(dataset, subject, paths)
    return Withdrawal(subject, capture, tuple(paths), tuple(files_naming(dataset, subject)))


def _check_ledger(dataset: Dataset) -> None:
    if dataset.ledger.is_file():
        with Ledger(dataset.ledger) as ledger:
            ledger.check_whole()


def withdrawn_file(dataset: Dataset) -> Path:
    """Digests of the ids of withdrawn subjects."""
    return dataset.root / "withdrawn.json"


def withdrawn(dataset: Dataset) -> set[str]:
    """SHA-256 of the ids of withdrawn subjects; the ids themselves are not kept."""
    path = withdrawn_file(dataset)
    if not path.is_file():
        return set()
    rows = read_json(path, FormatError, "restore it: it says who must not be taken in again")
    if not isinstance(rows, list) or not all(isinstance(row, str) for row in rows):
        raise FormatError(f"{path}: expected a list of digests; restore it")
    return set(rows)


def _forget(dataset: Dataset, subject: str, paths: list[Path]) -> None:
    """Remove receipts and digests, and overwrite the database's freed pages."""
    if not dataset.ledger.is_file():
        return
    try:
        _forget_rows(dataset, subject, paths)
    except sqlite3.DatabaseError as error:
        raise FormatError(f"{dataset.ledger}: not a ledger ({error}); delete it") from error


def _forget_rows(dataset: Dataset, subject: str, paths: list[Path]) -> None:
    items = {path.relative_to(dataset.root).parts[:2] for path in paths}
    root = str(dataset.root.resolve())
    with closing(sqlite3.connect(dataset.ledger, isolation_level=None)) as database:
        check_schema(database)
        database.execute("PRAGMA secure_delete=ON")
        for stage, item in (pair for pair in items if len(pair) == 2):
            database.execute("DELETE FROM receipts WHERE stage = ? AND item = ?", (stage, item))
        database.execute(
            "DELETE FROM receipts WHERE item = ? OR substr(item, 1, ?) = ?",
            (subject, len(subject) + 1, f"{subject}/"),
        )
        for path in paths:
            prefix = f"{root}/{path.relative_to(dataset.root).as_posix()}"
            database.execute(
                "DELETE FROM digests WHERE path = ? OR substr(path, 1, ?) = ?",
                (prefix, len(prefix) + 1, f"{prefix}/"),
            )
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        database.execute("VACUUM")
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def files_naming(dataset: Dataset, subject: str) -> Iterator[Path]:
    """Files of a dataset whose path, content or archive members name a subject."""
    word = re.compile(rb"(?<![A-Za-z0-9])" + re.escape(subject.encode()) + rb"(?![A-Za-z0-9])")
    for path in sorted(p for p in dataset.root.rglob("*") if p.is_file()):
        if word.search(str(path.relative_to(dataset.root)).encode()) or _names(path, word):
            yield path


def _names(path: Path, word: re.Pattern[bytes]) -> bool:
    suffix = path.suffix.lower()
    if suffix in IMAGE_SUFFIXES:  # pixels and points may hold any four bytes by chance
        return False
    if suffix == ".tar":
        with contextlib.suppress(tarfile.TarError, ValueError, EOFError, OverflowError):
            return _tar_names(path, word)
    with path.open("rb") as file:  # of a damaged tar too: it may still name somebody
        return _holds(file, word)


def _holds(file: IO[bytes], word: re.Pattern[bytes]) -> bool:
    tail = b""
    while block := file.read(CHUNK):
        if word.search(tail + block):
            return True
        tail = block[-256:]
    return False


def _tar_names(path: Path, word: re.Pattern[bytes]) -> bool:
    with tarfile.open(path, "r:") as tar:
        for member in tar:
            if word.search(member.name.encode(errors="surrogateescape")):
                return True
            if member.issparse():  # our shards have none; it may say to be of any size
                raise tarfile.ReadError("a sparse member")
            # A link would be followed to another member; only what a member itself holds counts.
            wanted = member.isreg() and member.name.endswith(".json")
            file = tar.extractfile(member) if wanted else None
            if file is not None and _holds(file, word):
                return True
    return False
