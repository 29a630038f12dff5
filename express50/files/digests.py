"""Digest files and folders, and cache what was read from a file until the file changes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar

from express50.errors import StageError
from express50.files.text import open_file

T = TypeVar("T")


def cached_by_file(size: int) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Cache the last `size` results of a function of a path until the file changes.

    The function's first argument must be a path, or have a method `__fspath__`; all arguments must
    be hashable. A file counts as changed if its size, modification time or inode differs.

    Raises:
        OSError: on a call of the function, if the path cannot be examined.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:
        @lru_cache(maxsize=size)
        def read(version: FileVersion, path: Path, *arguments: Any) -> T:  # noqa: ARG001
            return function(path, *arguments)

        @wraps(function)
        def look(path: Path, *arguments: Any) -> T:
            return read(file_version(path), path, *arguments)

        return look

    return decorate


FileVersion = tuple[int, int, int]


def file_version(path: Path) -> FileVersion:
    """Return size, modification time (ns) and inode, which change whenever the bytes do."""
    stat = Path(path).stat()
    return stat.st_size, stat.st_mtime_ns, stat.st_ino


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes in hexadecimal; OSError if it cannot be read."""
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_of(folder: Path, hidden: bool = False) -> list[Path]:
    """List every file below a folder, also in linked folders, sorted; hidden names if asked to."""
    found: list[Path] = []
    for place, folders, names in os.walk(folder, followlinks=True):
        here = Path(place).resolve()
        parts = [[n for n in part if hidden or n[0] != "."] for part in (folders, names)]
        # A link to a folder that it lies in would never end.
        folders[:] = [n for n in parts[0] if not here.is_relative_to((here / n).resolve())]
        paths = [Path(place, name) for name in parts[1]]
        # Where nothing but names may be seen, a name counts as a file: nothing is passed over.
        found += filter(Path.is_file, paths) if os.access(place, os.X_OK) else paths
    return sorted(found)


def path_digest(path: Path, sha256: Callable[[Path], str] = file_sha256) -> str:
    """Digest a file's content, or the names and contents of a folder's files.

    ``sha256`` digests one file; the ledger passes a function that caches digests.

    Raises:
        StageError: the path does not exist.
    """
    if path.is_file():
        return sha256(path)
    if not path.is_dir():
        raise StageError(f"{path}: the input is missing; run the stage that writes it first")
    lines = [f"{file.relative_to(path).as_posix()} {sha256(file)}" for file in files_of(path)]
    return text_digest("\n".join(lines))


def stat_digest(path: Path) -> str:
    """Digest names, sizes and times of a file or a folder's files: cheap even for terabytes.

    The digest of a file that cannot be read differs from that of the same file once it can.
    """
    root, files = (path.parent, [path]) if path.is_file() else (path, files_of(path))
    lines = []
    for file in files:
        mark = "unreadable"  # permissions change neither size nor time
        if os.access(file, os.R_OK):
            size, time, _ = file_version(file)
            mark = f"{size} {time}"
        lines.append(f"{file.relative_to(root).as_posix()} {mark}")
    return text_digest("\n".join(lines))


def text_digest(text: str) -> str:
    """Return the SHA-256 of a text in hexadecimal."""
    # Names of files may be no text; `dump_json` then says which.
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()


def value_digest(value: object) -> str:
    """Return the SHA-256 of a value's canonical JSON (tuples as lists, keys sorted)."""
    return text_digest(json.dumps(value, sort_keys=True, ensure_ascii=False))
