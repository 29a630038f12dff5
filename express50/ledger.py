"""The ledger: SQLite receipts that say what was made from what, and digests of files already read.

Only the driver opens it; workers return receipts.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from express50.digests import file_sha256
from express50.errors import FormatError
from express50.reading import parse_json

SCHEMA = """
CREATE TABLE IF NOT EXISTS receipts (
    stage TEXT NOT NULL, item TEXT NOT NULL, fingerprint TEXT NOT NULL, status TEXT NOT NULL,
    reason TEXT NOT NULL, metrics TEXT NOT NULL, seconds REAL NOT NULL,
    peak_memory INTEGER NOT NULL, attempts INTEGER NOT NULL, time REAL NOT NULL,
    PRIMARY KEY (stage, item)
);
CREATE TABLE IF NOT EXISTS digests (
    path TEXT PRIMARY KEY, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL,
    inode INTEGER NOT NULL, sha256 TEXT NOT NULL
);
"""


DELETE = "delete it and run the stages again, the same outputs will be made"
KINDS = {"item": str, "fingerprint": str, "status": str, "reason": str, "metrics": dict}
TABLES = {"receipts", "digests"}


def check_schema(database: sqlite3.Connection) -> None:
    """Refuse a database that holds more than a ledger's tables.

    A file from elsewhere may hold views and triggers, which are programs: they would run, without
    end if they like, whenever a receipt is read or written.

    Raises:
        sqlite3.DatabaseError: it does, or is no database.
    """
    database.execute("PRAGMA trusted_schema=OFF")
    for kind, name in database.execute("SELECT type, tbl_name FROM sqlite_master").fetchall():
        if kind not in ("table", "index") or name not in TABLES:
            raise sqlite3.DatabaseError(f"it has a {kind} {str(name)[:40]!r}")


@dataclass(frozen=True, kw_only=True)
class Receipt:
    """What became of one item.

    Attributes:
        stage: stage name.
        item: item id.
        fingerprint: digest of stage version, config and inputs.
        status: ``done`` or ``failed``.
        reason: one line for a failure, else empty.
        metrics: what the stage returned.
        seconds: wall time of the last attempt.
        peak_memory: largest resident memory while it ran, bytes.
        attempts: how often it was tried in that run.
        time: when it ended, seconds since 1970.
    """

    stage: str
    item: str
    fingerprint: str
    status: str
    reason: str = ""
    metrics: dict = field(default_factory=dict)
    seconds: float = 0.0
    peak_memory: int = 0
    attempts: int = 1
    time: float = field(default_factory=time.time)


class Ledger:
    """Receipts by stage and item, and a cache of file digests."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._fresh: dict[str, tuple] = {}  # digests not yet stored
        self._path = path
        with self._damage():
            self._database = sqlite3.connect(path, timeout=60, isolation_level=None)
            check_schema(self._database)
            self._database.execute("PRAGMA journal_mode=WAL")
            # A receipt lost with the power costs an item once more; waiting for the disk after each
            # would cost every item. What must not be lost, `forget` waits for.
            self._database.execute("PRAGMA synchronous=NORMAL")
            self._database.executescript(SCHEMA)

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()

    def check_whole(self) -> None:
        """Read every page.

        Raises:
            FormatError: one is damaged.
        """
        with self._damage():
            told = self._database.execute("PRAGMA quick_check(1)").fetchone()[0]
            if told != "ok":
                raise sqlite3.DatabaseError(told)

    @contextmanager
    def _damage(self) -> Iterator[None]:
        """Any statement may be the one that meets a damaged page."""
        try:
            yield
        except (sqlite3.DatabaseError, ValueError, TypeError, OverflowError) as error:
            raise FormatError(
                f"{self._path}: not a ledger ({error}); delete it and run the stages again, the "
                "same outputs will be made"
            ) from error

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def write(self, receipt: Receipt) -> None:
        """Store a receipt in the place of the item's former one."""
        row = dict(vars(receipt)) | {"metrics": json.dumps(receipt.metrics, sort_keys=True)}
        marks = ", ".join(f":{name}" for name in row)
        with self._damage():
            self._database.execute(
                f"INSERT OR REPLACE INTO receipts ({', '.join(row)}) VALUES ({marks})", row
            )

    def read(self, stage: str) -> dict[str, Receipt]:
        """Receipts of a stage by item, sorted.

        Raises:
            FormatError: a row is damaged.
        """
        names = list(Receipt.__dataclass_fields__)
        with self._damage():
            rows = self._database.execute(
                f"SELECT {', '.join(names)} FROM receipts WHERE stage = ? ORDER BY item", (stage,)
            ).fetchall()
        found = {}
        for row in rows:
            values = dict(zip(names, row, strict=True))
            where = f"{self._path}: {stage}"
            values["metrics"] = parse_json(values["metrics"], where, FormatError, DELETE)
            receipt = Receipt(**values)
            if any(type(getattr(receipt, k)) is not kind for k, kind in KINDS.items()):
                raise FormatError(f"{where}: the receipt of {receipt.item!r} is damaged; {DELETE}")
            found[receipt.item] = receipt
        return found

    def forget(self, stage: str, items: Iterable[str]) -> None:
        """Remove receipts; when this returns they are gone, even if the power goes."""
        rows = [(stage, item) for item in items]
        with self._damage():
            self._database.execute("PRAGMA synchronous=FULL")
            self._database.execute("BEGIN IMMEDIATE")
            self._database.executemany("DELETE FROM receipts WHERE stage = ? AND item = ?", rows)
            self._database.execute("COMMIT")
            self._database.execute("PRAGMA synchronous=NORMAL")

    def sha256(self, path: Path) -> str:
        """SHA-256 of a file; read again only when its size or modification time changed."""
        stat = path.stat()
        key = (str(path), stat.st_size, stat.st_mtime_ns, stat.st_ino)
        with self._damage():
            row = self._database.execute(
                "SELECT sha256 FROM digests"
                " WHERE path = ? AND size = ? AND mtime_ns = ? AND inode = ?",
                key,
            ).fetchone()
        if row is not None:
            return row[0]
        digest = file_sha256(path)
        self._fresh[str(path)] = (*key, digest)
        return digest

    def keep_digests(self) -> None:
        """Store new digests in one transaction; one each would cost a disk sync a file."""
        with self._damage():
            self._database.execute("BEGIN IMMEDIATE")
            self._database.executemany(
                "INSERT OR REPLACE INTO digests VALUES (?, ?, ?, ?, ?)", self._fresh.values()
            )
            self._database.execute("COMMIT")
        self._fresh.clear()
