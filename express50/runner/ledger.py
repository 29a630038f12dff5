"""Keep the ledger: SQLite receipts of what was made from what, last runs, digests of files.

Only the driver writes it; workers return receipts, and others may read meanwhile.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from express50.errors import FormatError, advised
from express50.files.atomic import disk_full, free_space
from express50.files.digests import file_sha256
from express50.files.text import parse_json, reason, unreadable


@dataclass(frozen=True)
class FileMark:
    """Size in bytes, modification time, inode and SHA-256 of a published file."""

    size: int
    mtime_ns: int
    inode: int
    sha256: str


@dataclass(frozen=True)
class Made:
    """The inputs and settings that an item was made from, and its files."""

    inputs: dict[str, str]  # their digests
    files: dict[str, FileMark]  # what was published
    # of the stage, as written in TOML; empty for imports
    settings: dict[str, str] = field(default_factory=dict)
    version: int = 0  # of the stage; 0 where that is not known


IMPORTED = "imported "  # begins the fingerprint of imported items


@dataclass(frozen=True, kw_only=True)
class Receipt:
    """The state of one item: what is published, and how its last attempt ended."""

    stage: str  # its name
    item: str  # its id
    fingerprint: str  # digest of stage version, config and inputs
    status: str  # ``done``, or ``failed`` where nothing is published
    # one line if the last attempt failed, else empty. The output of an earlier attempt may still be
    # valid: then the status stays ``done``, and all fields but this and the time describe that
    # attempt.
    reason: str = ""
    metrics: dict = field(default_factory=dict)  # what the stage returned
    seconds: float = 0.0  # wall time of the attempt
    core_seconds: float = 0.0  # processor time of the attempt
    peak_memory: int = 0  # largest resident memory while it ran, bytes
    attempts: int = 1  # number of tries in that run
    time: float = field(default_factory=time.time)  # end of the last attempt, seconds since 1970
    # inputs and files of what was published; read by `Ledger.made`, not by `Ledger.read`
    made: Made | None = None

    @property
    def imported(self) -> bool:
        """Return whether another tool made the item (``express50 import``)."""
        return self.fingerprint.startswith(IMPORTED)


@dataclass(frozen=True, kw_only=True)
class Run:
    """The last run of a stage; times are seconds since 1970."""

    stage: str
    items: int  # number of items to bring up to date
    current: int = 0  # number of those that already were up to date
    begun: float = 0.0  # when it began
    seen: float = 0.0  # when it was last known to be alive
    ended: float = 0.0  # when it ended; 0 if it did not
    running: dict[str, float] = field(default_factory=dict)  # start time of each item in work


def mark_file(path: Path) -> FileMark:
    """Read size, time and digest of a file as it is now."""
    stat = path.stat()
    return FileMark(stat.st_size, stat.st_mtime_ns, stat.st_ino, file_sha256(path))


SCHEMA = """
CREATE TABLE IF NOT EXISTS receipts (
    stage TEXT NOT NULL, item TEXT NOT NULL, fingerprint TEXT NOT NULL, status TEXT NOT NULL,
    reason TEXT NOT NULL, metrics TEXT NOT NULL, seconds REAL NOT NULL,
    peak_memory INTEGER NOT NULL, attempts INTEGER NOT NULL, time REAL NOT NULL,
    core_seconds REAL NOT NULL DEFAULT 0,
    PRIMARY KEY (stage, item)
);
CREATE TABLE IF NOT EXISTS made (
    stage TEXT NOT NULL, item TEXT NOT NULL, inputs TEXT NOT NULL, files TEXT NOT NULL,
    PRIMARY KEY (stage, item)
);
CREATE TABLE IF NOT EXISTS settings (
    stage TEXT NOT NULL, item TEXT NOT NULL, version INTEGER NOT NULL, settings TEXT NOT NULL,
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
OF_ITEMS = ("receipts", "made", "settings")
TABLES = {*OF_ITEMS, "digests", "runs"}
DELETE = "delete it and run the stages again; they make the same outputs"
COLUMNS = tuple(one.name for one in fields(Receipt) if one.name != "made")
KINDS = {"item": str, "fingerprint": str, "status": str, "reason": str, "metrics": dict}


def _check_schema(database: sqlite3.Connection) -> None:
    """Refuse a database, and close it, that holds more than a ledger's tables.

    A file from elsewhere may hold views and triggers, which run as programs whenever a receipt is
    read or written.

    Raises:
        sqlite3.DatabaseError: it does, or it is not a database.
    """
    try:
        database.execute("PRAGMA trusted_schema=OFF")
        for kind, name in database.execute("SELECT type, tbl_name FROM sqlite_master").fetchall():
            if kind not in ("table", "index") or name not in TABLES:
                raise sqlite3.DatabaseError(f"it has a {kind} {str(name)[:40]!r}")
    except sqlite3.DatabaseError:
        database.close()
        raise


class Ledger:
    """Receipts by stage and item, the inputs and files of each, last runs, and digests of files."""

    def __init__(self, path: Path, read_only: bool = False) -> None:
        self._fresh: dict[str, tuple] = {}  # digests not yet stored
        self._path, self._read_only = path, read_only
        with self._damage():
            if read_only:
                self._database = _open_to_read(path)
                _check_schema(self._database)
                return
            path.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileExistsError), path.open("xb"):  # SQLite would ignore the umask
                pass
            self._database = sqlite3.connect(path, timeout=60, isolation_level=None)
            _check_schema(self._database)
            self._database.execute("PRAGMA journal_mode=WAL")
            # A receipt lost in a power failure costs making one item again; waiting for the disk
            # after each would slow every item. `forget` waits, as its removals must not be lost.
            self._database.execute("PRAGMA synchronous=NORMAL")
            self._database.executescript(SCHEMA)

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *unused: object) -> None:
        self._database.close()

    @contextmanager
    def _damage(self) -> Iterator[None]:
        """Turn whatever may go wrong in SQLite (damage, a full disk, a lock) into one error."""
        try:
            yield
        except (sqlite3.DatabaseError, ValueError, TypeError, OverflowError) as error:
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF  # the rest says where
            # On a full disk SQLite often says only "disk I/O error".
            hidden = code == sqlite3.SQLITE_IOERR and free_space(self._path) < 1e6
            if hidden or code == sqlite3.SQLITE_FULL:
                raise disk_full(self._path, str(error)) from error
            if why := unreadable(self._path):
                words = why
            elif isinstance(error, UnicodeEncodeError):
                words = f"cannot name a folder that is not UTF-8 ({reason(error)}); rename it"
            elif self._read_only:  # a reader must not be advised to delete
                check = f"run {advised('express50 check', self._path.parent)}"
                words = f"cannot be read as a ledger ({error}); {check}"
            elif code == sqlite3.SQLITE_READONLY:
                words = "not writable; check its owner and permissions"
            elif isinstance(error, sqlite3.OperationalError) and "no such" not in str(error):
                words = (
                    f"the ledger cannot be used ({error}); fix that and run the same command again"
                )
            else:
                words = f"not a ledger ({error}); {DELETE}"
            raise FormatError(f"{self._path}: {words}") from error

    @contextmanager
    def _change(self) -> Iterator[sqlite3.Connection]:
        """Run one transaction: all of it is stored, or nothing."""
        with self._damage():
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield self._database
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                raise

    def check_whole(self) -> None:
        """Read every page; FormatError if one is damaged."""
        with self._damage():
            verdict = self._database.execute("PRAGMA quick_check(1)").fetchone()[0]
            if verdict != "ok":
                raise sqlite3.DatabaseError(verdict)

    def write(self, receipt: Receipt) -> None:
        """Store a receipt; it replaces the item's former one."""
        row = {name: getattr(receipt, name) for name in COLUMNS}
        row["metrics"] = json.dumps(receipt.metrics, sort_keys=True)
        key = (receipt.stage, receipt.item)
        with self._change() as database:
            self._replace("receipts", row)
            for table in OF_ITEMS[1:]:
                database.execute(f"DELETE FROM {table} WHERE stage = ? AND item = ?", key)
            if (made := receipt.made) is not None:
                files = {name: list(vars(m).values()) for name, m in made.files.items()}
                texts = [json.dumps(t, sort_keys=True) for t in (made.inputs, files, made.settings)]
                database.execute("INSERT INTO made VALUES (?, ?, ?, ?)", (*key, *texts[:2]))
                settings = (*key, made.version, texts[2])
                database.execute("INSERT INTO settings VALUES (?, ?, ?, ?)", settings)

    def note_attempt(self, last: Receipt) -> None:
        """Note reason and time of an item's last attempt; the receipt of its output stays."""
        with self._change() as database:
            database.execute(
                "UPDATE receipts SET reason = ?, time = ? WHERE stage = ? AND item = ?",
                (last.reason, last.time, last.stage, last.item),
            )

    def read(self, stage: str, item: str | None = None) -> dict[str, Receipt]:
        """Read a stage's receipts by item, sorted, or one; FormatError if a row is damaged."""
        found = {}
        for values in self._rows(COLUMNS, *_of("receipts", stage, item)):
            values["metrics"] = self._parsed(values["metrics"], stage)
            receipt = Receipt(**values)
            if any(type(getattr(receipt, k)) is not kind for k, kind in KINDS.items()):
                raise FormatError(
                    f"{self._path}: {stage}: the receipt of {receipt.item!r} is damaged; {DELETE}"
                )
            found[receipt.item] = receipt
        return found

    def made(self, stage: str, item: str | None = None) -> dict[str, Made]:
        """Read inputs, settings and files of a stage's published items, sorted, or of one item.

        Raises:
            FormatError: a row is damaged.
        """
        found = {}
        kept = self._rows(("item", "version", "settings"), *_of("settings", stage, item))
        settings = {k["item"]: (self._parsed(k["settings"], stage), k["version"]) for k in kept}
        columns = ("item", "inputs", "files")
        for row in self._rows(columns, *_of("made", stage, item)):
            inputs, files = (self._parsed(row[name], stage) for name in columns[1:])
            with self._damage():
                marks = {name: FileMark(*mark) for name, mark in files.items()}
                found[row["item"]] = Made(dict(inputs), marks, *settings.get(row["item"], ()))
        return found

    def read_whole(self, stage: str, item: str) -> Receipt | None:
        """Read the receipt of one item with what its output was made from; None without one."""
        receipt = self.read(stage, item).get(item)
        return receipt and replace(receipt, made=self.made(stage, item).get(item))

    def write_run(self, run: Run) -> None:
        """Store a run; it replaces the stage's former one."""
        with self._damage():
            self._replace("runs", dict(vars(run)) | {"running": json.dumps(run.running)})

    def runs(self) -> dict[str, Run]:
        """Read the last run of each stage; FormatError if a row is damaged."""
        rows = self._rows(tuple(one.name for one in fields(Run)), "runs")
        return {
            row["stage"]: Run(**row | {"running": self._parsed(row["running"], "runs")})
            for row in rows
        }

    def _replace(self, table: str, row: dict[str, Any]) -> None:
        marks = ", ".join(f":{name}" for name in row)
        query = f"INSERT OR REPLACE INTO {table} ({', '.join(row)}) VALUES ({marks})"
        self._database.execute(query, row)

    def _parsed(self, text: Any, where: str) -> dict:
        table = parse_json(text, f"{self._path}: {where}", FormatError, DELETE)
        if not isinstance(table, dict):
            raise FormatError(f"{self._path}: {where}: a row is damaged; {DELETE}")
        return table

    def _rows(self, names: tuple[str, ...], source: str, *values: str) -> list[dict[str, Any]]:
        """Read rows as tables; none where the ledger is new."""
        query = f"SELECT {', '.join(names)} FROM {source}"
        with self._damage():
            try:
                rows = self._database.execute(query, values).fetchall()
            except sqlite3.OperationalError as error:
                if "no such table" not in str(error):
                    raise
                return []
        return [dict(zip(names, row, strict=True)) for row in rows]

    def forget(self, stage: str, items: Iterable[str]) -> None:
        """Remove receipts; once this returns, they stay removed even if the power fails."""
        keys = [(stage, item) for item in items]
        with self._damage():
            self._database.execute("PRAGMA synchronous=FULL")
            with self._change() as database:
                for table in OF_ITEMS:
                    database.executemany(f"DELETE FROM {table} WHERE stage = ? AND item = ?", keys)
            self._database.execute("PRAGMA synchronous=NORMAL")

    def erase(
        self, subject: str, root: Path, paths: Iterable[Path], names: Callable[[bytes], bool]
    ) -> None:
        """Remove everything that belongs to a subject or names it; overwrite freed pages.

        Of ``paths``, which were removed below the dataset's ``root``, receipts and digests go; of
        others the reasons, inputs and footage in which ``names`` finds the subject.
        """
        below = [path.relative_to(root) for path in paths]
        items = {(one.parts[0], "/".join(one.parts[1:])) for one in below}
        files = [f"{root.resolve()}/{one.as_posix()}" for one in below]
        with self._damage():
            database = self._database
            database.create_function("names", 1, lambda text: names((text or "").encode()))
            database.execute("PRAGMA synchronous=FULL")
            database.execute("PRAGMA secure_delete=ON")
            for table in OF_ITEMS:
                database.executemany(f"DELETE FROM {table} WHERE stage = ? AND item = ?", items)
                database.execute(
                    f"DELETE FROM {table} WHERE item = ? OR substr(item, 1, ?) = ?",
                    (subject, len(subject) + 1, f"{subject}/"),
                )
            database.executemany(
                "DELETE FROM digests WHERE path = ? OR substr(path, 1, ?) = ?",
                [(file, len(file) + 1, f"{file}/") for file in files],
            )
            database.execute("DELETE FROM digests WHERE names(path)")
            database.execute("DELETE FROM receipts WHERE names(reason) OR names(metrics)")
            database.execute("DELETE FROM made WHERE names(inputs) OR names(files)")
            database.execute("DELETE FROM settings WHERE names(settings)")
            database.execute("DELETE FROM runs")  # they count the person's items
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.execute("VACUUM")
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def sha256(self, path: Path) -> str:
        """Return the SHA-256 of a file, which is read again only if its size or time changed."""
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

    def know(self, folder: Path, files: Mapping[str, FileMark]) -> None:
        """Take over digests of files below a folder, so that no later stage hashes them."""
        for name, mark in files.items():
            path = str(folder / name)
            self._fresh[path] = (path, mark.size, mark.mtime_ns, mark.inode, mark.sha256)

    def keep_digests(self) -> None:
        """Store new digests in one transaction; one per file would cost a disk sync each."""
        if self._read_only:
            return
        with self._change() as database:
            database.executemany(
                "INSERT OR REPLACE INTO digests VALUES (?, ?, ?, ?, ?)", self._fresh.values()
            )
        self._fresh.clear()


def _of(table: str, stage: str, item: str | None) -> tuple[str, ...]:
    """Return the SQL that selects a stage's rows, sorted, or one item's row; and its values."""
    if item is None:
        return f"{table} WHERE stage = ? ORDER BY item", stage
    return f"{table} WHERE stage = ? AND item = ?", stage, item


def _open_to_read(path: Path) -> sqlite3.Connection:
    """Open a connection that cannot write, also in a folder that cannot be written to."""
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
