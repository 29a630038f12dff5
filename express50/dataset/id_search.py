"""Search a dataset's files for subjects' ids: by the id, or by its digest alone.

An id is found as a word: letters and digits beside it would make it another. Archives, arrays of
texts and the ledger are searched; pixels and points are not, as they may hold any four bytes by
chance.
"""

from __future__ import annotations

import io
import re
import sqlite3
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import IO

from express50.files.digests import text_digest

DAMAGED = (
    tarfile.TarError, zipfile.BadZipFile, zlib.error, sqlite3.DatabaseError, ValueError, EOFError,
    OverflowError, NotImplementedError, RuntimeError,
)  # fmt: skip

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".exr", ".tif", ".ply", ".glb", ".mp4"}
CHUNK = 1 << 24
OVERLAP = 256
TEXT_LIMIT = 1 << 24
RUN = re.compile(rb"[A-Za-z0-9][A-Za-z0-9_-]*")
PART = re.compile(rb"[A-Za-z0-9]+")
LONGEST_ID = 6  # parts joined by '_' or '-'


Test = Callable[[bytes], bool]


def names(subject: str) -> Test:
    """Make a test of whether a text names a subject."""
    word = re.compile(rb"(?<![A-Za-z0-9])" + re.escape(subject.encode()) + rb"(?![A-Za-z0-9])")
    return lambda text: word.search(text) is not None


def names_any_of(digests: Collection[str]) -> Test:
    """Make a test of whether a text holds an id whose SHA-256 is one of the given."""
    seen: dict[bytes, bool] = {}

    def hit(word: bytes) -> bool:
        if word not in seen:
            seen[word] = text_digest(word.decode()) in digests
        return seen[word]

    return lambda text: any(hit(word) for run in set(RUN.findall(text)) for word in _ids(run))


def files_that(test: Test, root: Path) -> Iterator[Path]:
    """Yield files below a folder whose path or content passes a test."""
    for path in sorted(p for p in root.rglob("*") if p.is_file()):
        if test(str(path.relative_to(root)).encode()) or says(path, test):
            yield path


def says(path: Path, test: Test) -> bool:
    """True if a file's content passes a test."""
    return any(map(test, texts_of(path)))


def files_naming(root: Path, subject: str) -> Iterator[Path]:
    """Yield files below a folder whose path, content or archive members name a subject."""
    return files_that(names(subject), root)


def _ids(run: bytes) -> Iterator[bytes]:
    """Yield every id that letters, digits, '_' and '-' may hold: ``S001_smile`` names S001."""
    parts = [match.span() for match in PART.finditer(run)]
    for first in range(len(parts)):
        for last in range(first, min(first + LONGEST_ID, len(parts))):
            yield run[parts[first][0] : parts[last][1]]
    yield run


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
            yield from _ledger_texts(path)
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
    tail = b""
    while block := file.read(CHUNK):
        yield tail + block
        tail = block[-OVERLAP:]


def _tar_texts(path: Path) -> Iterator[bytes]:
    with tarfile.open(path, "r:") as tar:
        for member in tar:
            yield member.name.encode(errors="surrogateescape")
            if member.issparse():  # our shards have none; it may say to be of any size
                raise tarfile.ReadError("a sparse member")
            # A link would lead to another member; only what a member itself holds counts.
            wanted = member.isreg() and member.name.endswith(".json")
            file = tar.extractfile(member) if wanted else None
            if file is not None:
                yield from _pieces(file)


def _zip_texts(path: Path) -> Iterator[bytes]:
    """Yield names and texts of an archive such as .npz or a checkpoint, without its numbers."""
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


def _ledger_texts(path: Path) -> Iterator[bytes]:
    """Yield every text of every table: a page of the file runs them together without a gap."""
    with closing(sqlite3.connect(path)) as database:
        tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        for (table,) in tables:
            for row in database.execute(f'SELECT * FROM "{table}"'):
                yield "\n".join(value for value in row if isinstance(value, str)).encode()
