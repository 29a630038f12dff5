"""The ledger: SQLite receipts that say what was made from what, and digests of files.

Only the driver writes it, workers return receipts; others may read meanwhile.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from express50.digests import file_sha256
from express50.errors import FormatError

SCHEMA = """
CREATE TABLE IF NOT EXISTS receipts (
    stage TEXT NOT NULL, item TEXT NOT NULL, fingerprint TEXT NOT NULL, status TEXT NOT NULL,
    reason TEXT NOT NULL, metrics TEXT NOT NULL, seconds REAL NOT NULL,
    peak_memory INTEGER NOT NULL, attempts INTEGER NOT NULL, time REAL NOT NULL,
    PRIMARY KEY (stage, item)
);
CREATE TABLE IF NOT EXISTS made (
    stage TEXT NOT NULL, item TEXT NOT NULL, inputs TEXT NOT NULL, files TEXT NOT NULL,
    PRIMARY KEY (stage, item)
);
CREATE TABLE IF NOT EXISTS digests (
    path TEXT PRIMARY KEY, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL,
    inode INTEGER NOT NULL, sha256 TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS runs (
    stage TEXT PRIMARY KEY, items INTEGER NOT NULL, current INTEGER NOT NULL,
    begun REAL NOT NULL, seen REAL NOT NULL, ended REAL NOT NULL, running TEXT NOT NULL
);
"""


@dataclass(frozen=True)
class FileMark:
    """A published file: size in bytes, modification time, inode, SHA-256."""

    size: int
    mtime_ns: int
    inode: int
    sha256: str


@dataclass(frozen=True)
class Made:
    """What an item was made from (digest of every input) and what it consists of."""

    inputs: dict[str, str]
    files: dict[str, FileMark]


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
        made: inputs and files of what was published; `Ledger.made` reads it, `Ledger.read` not.
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
    made: Made | None = None


COLUMNS = tuple(name for name in Receipt.__dataclass_fields__ if name != "made")


@dataclass(frozen=True, kw_only=True)
class Run:
    """The last run of a stage; times are seconds since 1970.

    Attributes:
        stage: stage name.
        items: how many it was to bring up to date.
        current: how many of them were already.
        begun: when it began.
        seen: when it last gave a sign of life.
        ended: when it ended; 0 if it did not.
        running: when each item that is being worked at was begun.
    """

    stage: str
    items: int
    current: int = 0
    begun: float = 0.0
    seen: float = 0.0
    ended: float = 0.0
    running: dict[str, float] = field(default_factory=dict)


class Ledger:
    """Receipts by stage and item, and a cache of file digests."""

    def __init__(self, path: Path, read_only: bool = False) -> None:
        self._fresh: dict[str, tuple] = {}  # digests not yet stored
        try:
            if read_only:
                self._database = _open_to_read(path)
                return
            path.parent.mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(path, timeout=60, isolation_level=None)
            self._database.execute("PRAGMA journal_mode=WAL")
            # A receipt lost with the power costs an item once more; waiting for the disk after each
            # would cost every item. What must not be lost, `forget` waits for.
            self._database.execute("PRAGMA synchronous=NORMAL")
            self._database.executescript(SCHEMA)
        except sqlite3.DatabaseError as error:
            if read_only:  # whoever only looks on is not told to delete
                raise FormatError(f"{path}: cannot be read as a ledger ({error})") from error
            raise FormatError(
                f"{path}: not a ledger ({error}); delete it and run the stages again, the same "
                "outputs will be made"
            ) from error

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def write(self, receipt: Receipt) -> None:
        """Store a receipt in the place of the item's former one."""
        row = {name: getattr(receipt, name) for name in COLUMNS}
        row["metrics"] = json.dumps(receipt.metrics, sort_keys=True)
        marks = ", ".join(f":{name}" for name in row)
        key = (receipt.stage, receipt.item)
        self._database.execute("BEGIN IMMEDIATE")
        self._database.execute(
            f"INSERT OR REPLACE INTO receipts ({', '.join(row)}) VALUES ({marks})", row
        )
        if receipt.made is None:
            self._database.execute("DELETE FROM made WHERE stage = ? AND item = ?", key)
        else:
            self._database.execute(
                "INSERT OR REPLACE INTO made VALUES (?, ?, ?, ?)", (*key, *_texts(receipt.made))
            )
        self._database.execute("COMMIT")

    def made(self, stage: str) -> dict[str, Made]:
        """Inputs and files of a stage's items, sorted; of those made since these are kept."""
        rows = self._database.execute(
            "SELECT item, inputs, files FROM made WHERE stage = ? ORDER BY item", (stage,)
        )
        return {
            item: Made(
                json.loads(inputs),
                {name: FileMark(*mark) for name, mark in json.loads(files).items()},
            )
            for item, inputs, files in rows
        }

    def read(self, stage: str) -> dict[str, Receipt]:
        """Receipts of a stage by item, sorted."""
        values = self._rows(Receipt, "receipts WHERE stage = ? ORDER BY item", stage)
        return {v["item"]: Receipt(**v | {"metrics": json.loads(v["metrics"])}) for v in values}

    def write_run(self, run: Run) -> None:
        """Store a run in the place of the stage's former one."""
        row = dict(vars(run)) | {"running": json.dumps(run.running)}
        marks = ", ".join(f":{name}" for name in row)
        self._database.execute(
            f"INSERT OR REPLACE INTO runs ({', '.join(row)}) VALUES ({marks})", row
        )

    def runs(self) -> dict[str, Run]:
        """Last runs by stage."""
        values = self._rows(Run, "runs")
        return {v["stage"]: Run(**v | {"running": json.loads(v["running"])}) for v in values}

    def _rows(self, kind: Any, source: str, *values: str) -> list[dict]:
        """Rows as tables; none where the ledger is being made, or of before its runs were kept."""
        names = COLUMNS if kind is Receipt else [one.name for one in fields(kind)]
        try:
            rows = self._database.execute(f"SELECT {', '.join(names)} FROM {source}", values)
        except sqlite3.OperationalError as error:
            if "no such table" not in str(error):
                raise
            return []
        return [dict(zip(names, row, strict=True)) for row in rows]

    def forget(self, stage: str, items: Iterable[str]) -> None:
        """Remove receipts; when this returns they are gone, even if the power goes."""
        self._database.execute("PRAGMA synchronous=FULL")
        self._database.execute("BEGIN IMMEDIATE")
        keys = [(stage, item) for item in items]
        for table in ("receipts", "made"):
            self._database.executemany(f"DELETE FROM {table} WHERE stage = ? AND item = ?", keys)
        self._database.execute("COMMIT")
        self._database.execute("PRAGMA synchronous=NORMAL")

    def sha256(self, path: Path) -> str:
        """SHA-256 of a file; read again only when its size or modification time changed."""
        stat = path.stat()
        key = (str(path), stat.st_size, stat.st_mtime_ns, stat.st_ino)
        row = self._database.execute(
            "SELECT sha256 FROM digests WHERE path = ? AND size = ? AND mtime_ns = ? AND inode = ?",
            key,
        ).fetchone()
        if row is not None:
            return row[0]
        digest = file_sha256(path)
        self._fresh[str(path)] = (*key, digest)
        return digest

    def know(self, folder: Path, files: Mapping[str, FileMark]) -> None:
        """Take over digests of files below a folder, so that no later stage hashes them again."""
        for name, mark in files.items():
            path = str(folder / name)
            self._fresh[path] = (path, mark.size, mark.mtime_ns, mark.inode, mark.sha256)

    def keep_digests(self) -> None:
        """Store new digests in one transaction; one each would cost a disk sync a file."""
        self._database.execute("BEGIN IMMEDIATE")
        self._database.executemany(
            "INSERT OR REPLACE INTO digests VALUES (?, ?, ?, ?, ?)", self._fresh.values()
        )
        self._database.execute("COMMIT")
        self._fresh.clear()


def _texts(made: Made) -> tuple[str, str]:
    """JSON of inputs and files."""
    files = {name: [m.size, m.mtime_ns, m.inode, m.sha256] for name, m in made.files.items()}
    return json.dumps(made.inputs, sort_keys=True), json.dumps(files, sort_keys=True)


def mark_file(path: Path) -> FileMark:
    """Size, time and digest of a file as it is now."""
    stat = path.stat()
    return FileMark(stat.st_size, stat.st_mtime_ns, stat.st_ino, file_sha256(path))


def _open_to_read(path: Path) -> sqlite3.Connection:
    """A connection that cannot write, also where the folder cannot be written to."""
    uri = path.resolve().as_uri()
    for mode in ("mode=ro", "mode=ro&immutable=1"):
        database = sqlite3.connect(f"{uri}?{mode}", uri=True, timeout=60, isolation_level=None)
        try:
            database.execute("PRAGMA schema_version").fetchone()
            return database
        except sqlite3.OperationalError as error:
            database.close()
            trouble = error
    raise trouble
