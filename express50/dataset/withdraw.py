"""Withdraw a subject: remove everything a dataset holds about a person, then search for the id.

Everything that mixes subjects (packed shards, reports, trained models' pictures) is removed;
running its command makes it again without the person. Others' outputs that name the person go too.
A checkpoint loses the person's codes and frames; only retraining removes what its other weights
learned. The raw capture lies outside the dataset: deleting it is up to its owner.

Ids match as whole words: with letters or digits next to it, it is a different id, and so is a part
of another subject's id (S001 of S001_2). A number in JSON or TOML is not an id. If another subject
has a camera of the same name, only what calls the id a subject or names its items counts.
Archives, arrays of text and the ledger are searched; pixels and points are not, as they may contain
any four bytes by chance.
"""

from __future__ import annotations

import io
import re
import shutil
import sqlite3
import string
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import IO, Any

from express50.capture.index import read_index
from express50.contract.layout import Dataset, existing_dataset
from express50.contract.stage import stages
from express50.errors import Express50Error, FormatError, check_known
from express50.files.atomic import alone_in, write_json
from express50.files.digests import files_of, text_digest
from express50.files.text import NAME, read_json, read_json_table
from express50.runner.ledger import Ledger
from express50.runner.publish import hold_stages

Redact = Callable[[Path, str], bool]
Finder = Callable[[bytes], bool]
"""Tells whether a text names a subject."""

# What damaged archives and databases raise.
DAMAGED = (
    tarfile.TarError, zipfile.BadZipFile, zlib.error, sqlite3.DatabaseError, ValueError, EOFError,
    OverflowError, NotImplementedError, RuntimeError,
)  # fmt: skip
IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".exr", ".tif", ".ply", ".glb", ".mp4"}
CHUNK = 1 << 24
OVERLAP = 256  # bytes; longer than any id
WORD = (string.ascii_letters + string.digits + "_-").encode()
TEXT_LIMIT = 1 << 24
RUN = re.compile(rb"[A-Za-z0-9][A-Za-z0-9_-]*")
PART = re.compile(rb"[A-Za-z0-9]+")
# Numbers in JSON and TOML, also several in one text, and decimals: an id of digits is none of them.
_RUN = rb"(?:\s*+,?\s*+-?\d[\d.eE+-]*+(?![\w/]))++"
NUMBERS = re.compile(
    rb"[:=\[]" + _RUN + rb"|,(?P<row>" + _RUN + rb')(?P<end>\s*\])?|"\d+(?: \d+)++"|\d{1,20}\.\d+'
)
LONGEST_ID = 6  # in parts joined by '_' or '-'


@dataclass(frozen=True)
class Withdrawal:
    """Lists what was removed, which checkpoints changed, and which files still name the subject."""

    subject: str
    capture: Path | None
    removed: tuple[Path, ...]
    checkpoints: tuple[Path, ...]
    remaining: tuple[Path, ...]
    files: int


def plan(dataset: Dataset, subject: str) -> dict[Path, str]:
    """Return the files and folders to remove so that nothing of a subject remains in a dataset.

    Each comes with the reason, which is empty for the subject's own.

    Raises:
        ConfigError: the folder is not a dataset; it may hold shards.
        UnknownNameError: the dataset has no such subject.
    """
    known = {*dataset.captures(), *dataset.subjects()}
    labelled = NAME.fullmatch(subject) and dataset.labels_file(subject).is_file()
    # Reject all other names: '', '..' or 'shards' would name folders that are not a person's.
    if not (subject in known or labelled or text_digest(subject) in withdrawn(dataset)):
        if not known:
            existing_dataset(dataset.root)
        check_known(str(dataset.root), "subject", [subject], sorted(known))
    paths = dict.fromkeys(sorted(_own_paths(dataset, subject)), "")
    if paths or subject in known:  # else an earlier withdrawal removed what mixes people
        mixed = set(_mixed_paths(dataset)) - paths.keys()  # what came back of the withdrawn is both
        paths |= dict.fromkeys(sorted(mixed), "may hold several people's data")
    # Other subjects' outputs that name this one, such as peaks matched to the reference person's.
    gone, naming, why = set(paths), [], f"made with data of {subject}; the next run makes it again"
    for path in files_naming(dataset_id_finder(dataset, subject), dataset.root):
        parts = path.relative_to(dataset.root).parts
        items = [dataset.root.joinpath(*parts[:depth]) for depth in (3, 2)]
        item = next((item for item in items if (item / "metrics.json").is_file()), None)
        if item is not None and gone.isdisjoint([path, *path.parents]):
            naming.append(item)
            gone.add(item)
    return paths | dict.fromkeys(sorted(naming), why)


def _own_paths(dataset: Dataset, subject: str) -> Iterator[Path]:
    for base in (dataset.root, dataset.stale_dir):
        yield from (path for path in base.glob(f"*/{subject}") if path.is_dir())
    if dataset.labels_file(subject).exists():
        yield dataset.labels_file(subject)
    reference = dataset.root / "labels" / "reference.json"
    if reference.is_file():
        with suppress(FormatError):
            if subject in map(str, read_json_table(reference, FormatError).values()):
                yield reference  # the next subject becomes the reference
    finder = dataset_id_finder(dataset, subject)
    # Settings such as pack.test_subjects; the stage's next run writes its own.
    yield from (p for p in (dataset.root / "config").glob("*.toml") if mentions(p, finder))
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
    whole = (dataset.report_dir, dataset.root / "accuracy", dataset.replaced_dir)
    yield from (path for path in whole if path.exists())
    yield from (path for path in dataset.staging_dir.glob("*") if path.is_dir())
    for path in (dataset.root / "grmm").rglob("*"):  # pictures and figures of the trained people
        if path.is_file() and path.suffix != ".pt":
            yield path


def withdraw(
    dataset: Dataset,
    subject: str,
    checkpoints: Sequence[Path] = (),
    redact: Redact = lambda path, subject: False,
) -> Withdrawal:
    """Remove a subject and search what is left for its id.

    A record is kept (`withdrawn_file`), so that ingest refuses to add the person again.
    ``checkpoints`` lie outside the dataset; they and those below ``grmm`` are passed to ``redact``,
    which removes the subject from a checkpoint and returns True if it was in there.

    Raises:
        UnknownNameError: the dataset has no such subject.
        StageError: a stage, or a run within a budget, is going on.
        NotReadyError: a model of the dataset, or one of ``checkpoints``, is being trained.
        FormatError: the ledger is damaged; nothing was removed.
    """
    finder = dataset_id_finder(dataset, subject)
    # A budgeted run holds "run" while its trials, datasets of their own, work on somebody. A stage
    # that never ran would begin with the person whose data are being removed.
    ran = {path.stem for path in (dataset.root / "config").glob("*.toml")}
    names, models = sorted({"run", *stages(), *ran}), dataset.root / "grmm"
    places = [path for path in (models, *models.rglob("*"), *checkpoints) if path.exists()]
    with hold_stages(dataset, names), ExitStack() as stack:
        for folder in {path if path.is_dir() else path.parent for path in places}:
            stack.enter_context(alone_in(folder))  # a training would save the person again
        paths = plan(dataset, subject)
        if dataset.ledger.is_file():
            # Check before anything is removed: a partial withdrawal cannot be repeated.
            with Ledger(dataset.ledger) as ledger:
                ledger.check_whole()
        captures = dataset.captures()
        capture = captures.pop(subject, None)
        files = sum(1 if p.is_file() else sum(q.is_file() for q in p.rglob("*")) for p in paths)
        # A digest and the number of files, not the id itself: the record must not name the person.
        now = datetime.now(UTC).isoformat(timespec="seconds")
        record = {"id_sha256": text_digest(subject), "time": now, "files": files}
        write_json(withdrawn_file(dataset), [*_withdrawals(dataset), record])
        for path in paths:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
        write_json(dataset.captures_file, {name: str(path) for name, path in captures.items()})
        if dataset.ledger.is_file():
            with Ledger(dataset.ledger) as ledger:
                ledger.erase(subject, dataset.root, paths, finder)
        changed, own = [], sorted(models.rglob("*.pt"))
        for path in [*own, *(path for path in checkpoints if path.is_file())]:
            with suppress(FormatError):  # not a GRMM checkpoint; it is searched for the id below
                if redact(path, subject):
                    changed.append(path)
    remaining = [
        *files_naming(finder, dataset.root),
        *(path for path in checkpoints if path.is_file() and mentions(path, finder)),
    ]
    return Withdrawal(subject, capture, tuple(paths), tuple(changed), tuple(remaining), files)


def withdrawn_file(dataset: Dataset) -> Path:
    """Return the path of the file that records withdrawals."""
    return dataset.root / "withdrawn.json"


def withdrawn(dataset: Dataset) -> set[str]:
    """Return the SHA-256 digests of withdrawn subjects' ids; the ids themselves are not kept."""
    return {row["id_sha256"] for row in _withdrawals(dataset)}


def _withdrawals(dataset: Dataset) -> list[dict[str, Any]]:
    """Read the records of withdrawals."""
    path = withdrawn_file(dataset)
    if not path.is_file():
        return []
    fix = "restore it: it lists people who must not be added again"
    rows = read_json(path, FormatError, fix)
    whole = isinstance(rows, list) and all(isinstance(row, dict) for row in rows)
    if not whole or not all(isinstance(row.get("id_sha256"), str) for row in rows):
        raise FormatError(f"{path}: expected a list of records with id_sha256; {fix}")
    return rows


def dataset_id_finder(dataset: Dataset, subject: str) -> Finder:
    """Make a finder of a subject's id in texts of a dataset."""
    captures = dataset.captures()
    if subject in cameras_of(dataset, {*dataset.subjects()} - {subject}):
        return subject_id_finder(subject, str(captures.get(subject, "")))
    return id_finder(subject, {*captures, *dataset.subjects()} - {subject})


def cameras_of(dataset: Dataset, subjects: Collection[str]) -> set[str]:
    """Return the ids of the subjects' cameras."""
    found: set[str] = set()
    for subject in subjects:
        with suppress(Express50Error):  # not ingested, or damaged
            found |= read_index(dataset, subject).cameras.keys()
    return found


def subject_id_finder(subject: str, capture: str = "") -> Finder:
    """Make a finder of an id that is a camera's too: it must be called a subject, or own an item.

    Paths below its raw ``capture`` name it as well.
    """
    word = re.escape(subject)
    uses = [
        rf'(?:subject|reference)\w*"?\s*[:=]\s*(?:\[[^]]*)?"?(?<![\w-]){word}(?![\w-])',
        rf'(?:^|"){word}(?:$|/[A-Za-z])',  # an item, in a table or quoted
        rf"^[\w.-]+/(?:[\w.-]+/)?{word}(?:$|/|\.jsonl$)",  # a path in a dataset
        *([re.escape(capture)] if capture else []),
    ]
    found = re.compile("|".join(uses).encode(), re.MULTILINE)
    return lambda text: found.search(text) is not None


def id_finder(subject: str, others: Collection[str] = ()) -> Finder:
    """Make a finder of a subject's id that does not take longer ids of ``others`` for it."""
    longer = sorted((other for other in others if subject in other), key=len, reverse=True)
    word, number = _words([*longer, subject]), subject.isdigit()

    def found(text: bytes) -> bool:
        text = _without_numbers(text) if number else text
        return any(m[0] == subject.encode() for m in word.finditer(text))

    return found


def _without_numbers(text: bytes) -> bytes:
    return NUMBERS.sub(lambda m: m[0] if m["row"] and not m["end"] else b" ", text)


def _words(ids: Sequence[str]) -> re.Pattern[bytes]:
    """Make a pattern that matches the first fitting id where it stands as a word."""
    choice = "|".join(map(re.escape, ids)) or "(?!)"
    return re.compile(rf"(?<![A-Za-z0-9])(?:{choice})(?![A-Za-z0-9])".encode())


def any_id_finder(digests: Collection[str], others: Collection[str] = ()) -> Finder:
    """Make a finder of any id whose SHA-256 is among the given ones.

    Ids of ``others``, who were not withdrawn, may have such an id as a part.
    """

    def is_wanted(run: bytes) -> bool:
        # Any part, and any run of adjacent parts, may be an id: ``S001_smile`` names S001.
        spans = [match.span() for match in PART.finditer(run)]
        words = (
            run[first:last]
            for number, (first, _) in enumerate(spans)
            for _, last in spans[number : number + LONGEST_ID]
        )
        return any(text_digest(word.decode()) in digests for word in (run, *words))

    there = (other for other in others if text_digest(other) not in digests)
    longer = _words(sorted((o for o in there if is_wanted(o.encode())), key=len, reverse=True))

    @cache
    def hit(run: bytes) -> bool:
        return any(map(is_wanted, longer.sub(b" ", run).split()))

    return lambda text: any(hit(run) for run in set(RUN.findall(_without_numbers(text))))


def files_naming(finder: Finder, root: Path) -> Iterator[Path]:
    """Yield files below a folder whose path or content names a subject."""
    for path in files_of(root, hidden=True):
        if finder(str(path.relative_to(root)).encode()) or mentions(path, finder):
            yield path


def mentions(path: Path, finder: Finder) -> bool:
    """Return True if a file's content names a subject."""
    return any(map(finder, texts_of(path)))


def texts_of(path: Path) -> Iterator[bytes]:
    """Yield the text in a file, piece by piece."""
    suffix = path.suffix.lower()
    if suffix in IMAGE_SUFFIXES or path.name.endswith(("sqlite-wal", "sqlite-shm")):
        return
    with path.open("rb") as file:
        head = file.read(16)
    try:
        if suffix == ".tar":
            yield from _tar_texts(path)
        elif head.startswith(b"SQLite format 3\0"):
            with closing(sqlite3.connect(path)) as database:
                query = "SELECT name FROM sqlite_master WHERE type = 'table'"
                for (table,) in database.execute(query).fetchall():
                    # Row by row: the raw file stores texts next to each other without a gap.
                    for row in database.execute(f'SELECT * FROM "{table}"'):
                        yield "\n".join(value for value in row if isinstance(value, str)).encode()
        elif head.startswith(b"PK\x03\x04") and zipfile.is_zipfile(path):
            yield from _zip_texts(path)
        else:
            yield from _blocks(path)
    except DAMAGED:
        yield from _blocks(path)  # a damaged archive may still name somebody


def _blocks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        yield from _pieces(file)


def _pieces(file: IO[bytes]) -> Iterator[bytes]:
    tail = b""  # the last word, which may go on in the next block
    while block := file.read(CHUNK):
        text = tail + block
        tail = text[len(text.rstrip(WORD)) :][-OVERLAP:]
        yield text[: len(text) - len(tail)]
    yield tail


def _tar_texts(path: Path) -> Iterator[bytes]:
    with tarfile.open(path, "r:") as tar:
        for member in tar:
            yield member.name.encode(errors="surrogateescape")
            if member.issparse():  # our shards have none, and it may claim any size
                raise tarfile.ReadError("a sparse member")
            # A link only repeats another member, so it is skipped.
            wanted = member.isreg() and member.name.endswith(".json")
            file = tar.extractfile(member) if wanted else None
            if file is not None:
                yield from _pieces(file)


def _zip_texts(path: Path) -> Iterator[bytes]:
    """Yield names and text of an archive such as .npz or a checkpoint, but not its numbers."""
    import numpy as np

    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            yield member.filename.encode()
            if member.filename.endswith((".pkl", ".json", ".txt")):
                with archive.open(member) as file:
                    yield from _pieces(file)
            elif member.filename.endswith(".npy") and member.file_size < TEXT_LIMIT:
                data = archive.read(member)
                if b"'descr': '<U" in data[:128] or b"'descr': '|S" in data[:128]:
                    array = np.load(io.BytesIO(data), allow_pickle=False)
                    yield "\n".join(map(str, array.ravel())).encode()
